"""Shock propagation: heavy bodies on light ones that a static body supports.

A light body between a heavy one and a floor cannot give way, but sequential impulses pass on only a share of the load
in each step, which falls with the ratio of the masses. With `physics.shock_propagation`, the contact of two moving
bodies therefore sees the lighter one as its contacts with static bodies leave it: with its inverse mass less the Schur
complement of those that bore a load in the last step, and with the velocity that it will have after their impulses.
Impulse and reaction stay equal, so momentum is conserved. Static bodies come last in a pass and take up what the
lighter body cannot.

Source: E. Guendelman, R. Bridson and R. Fedkiw, 'Nonconvex rigid bodies with stacking' (2003), give supported bodies an
infinite mass.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp

from gen2d.physics.collision import dot
from gen2d.physics.constraint import (
    ActiveContact,
    ContactConstraint,
    ContactFrame,
    ContactPoint,
    Impulse,
    Inertia,
    Motion,
    reciprocal,
)
from gen2d.physics.symmetric import Direction, inner, outer, product
from gen2d.records.axes import Array

Motions: TypeAlias = tuple[Motion | None, Motion]  # of both bodies of a pair

REGULAR = 1e-3  # share of its compliance that a contact must keep beside others to take more from a body
LARGEST_RATIO = 3000.0  # of two masses: a lighter body gives way, as its rounding errors would move the heavy one
PRESSED = 0.5  # least cosine of the angle between a contact's load and that of the static bodies


class Support(NamedTuple):
    """What the static bodies that bear a body take from its inverse mass."""

    load: Array  # [2, N, ...] N s: sum of their normal impulses in the last step
    matrix: Array  # [6, N, ...] of x, y and angle, symmetric: xx, xy, yy, xt, yt, tt


def no_support(velocity: Array) -> Support:
    """Support of bodies [2, N, ...] that nothing bears."""
    return Support(jnp.zeros_like(velocity), jnp.zeros((6, *velocity.shape[1:]), velocity.dtype))


def _with_row(support: Support, inverse: Inertia, direction: Direction, k: Array, acts: Array) -> Support:
    """Support with another direction in which the body cannot move, where it `acts`; k is its compliance alone."""
    (linear, turn), (unit, lever) = product(support.matrix, direction), direction
    linear = inverse.mass * unit - linear
    turn = -turn if lever is None else inverse.moment * lever - turn
    left = inner(direction, (linear, turn))
    share, row = reciprocal(left, acts & (left > REGULAR * k)), (*linear, turn)
    return support._replace(matrix=support.matrix + share * outer(row, row))


def add_support(
    support: Support, constraint: ContactConstraint, points: Sequence[ContactPoint], impulses: Sequence[Impulse]
) -> Support:
    """Support with the contact with a static body, from its impulses in the last step."""
    for point, impulse in zip(points, impulses, strict=True):
        frame = point.frame
        row = point.normal, frame.normal_b
        support = _with_row(support, constraint.b, row, frame.k_normal, impulse.normal > 0)
        support = support._replace(load=support.load + impulse.normal * point.normal)
    return support


def _normals(contact: ActiveContact) -> tuple[Direction, Direction]:
    """Direction of the normal impulse, for a and for b."""
    return (contact.normal, contact.frame.normal_a), (contact.normal, contact.frame.normal_b)


class SupportedPair(NamedTuple):
    """Two moving bodies in contact, of which static bodies may bear the lighter."""

    inertia: tuple[Inertia, Inertia]
    supports: tuple[Support, Support]
    pressed: tuple[Array, Array]  # whether the contact presses the body, which is the lighter, onto what bears it

    def speed(self, contact: ActiveContact, speed: Array, motions: Motions) -> Array:
        """Normal speed of b relative to a at a point after the support's impulses, m/s; `speed` is that before."""
        taken, of = [], zip(self.inertia, self.supports, self.pressed, motions, _normals(contact), strict=True)
        for inertia, support, pressed, motion, direction in of:
            assert motion is not None, "both bodies move"
            mass, moment = (reciprocal(x, x > 0) for x in inertia)
            momentum = mass * motion.velocity, moment * motion.spin
            taken.append(jnp.where(pressed, inner(direction, product(support.matrix, momentum)), 0.0))
        return speed - (taken[1] - taken[0])

    def _compliance(self, p: tuple[Direction, Direction], q: tuple[Direction, Direction]) -> Array:
        """What the support takes from the speed along q that a unit impulse along p causes, 1/kg."""
        of_a, of_b = (inner(y, product(support.matrix, x)) for support, x, y in zip(self.supports, p, q, strict=True))
        return jnp.where(self.pressed[0], of_a, 0.0) + jnp.where(self.pressed[1], of_b, 0.0)

    def frame(self, contact: ActiveContact, rests: Array) -> ContactFrame:
        """Frame of a contact, with the effective mass that the support leaves where it `rests`."""
        normals = _normals(contact)
        k = contact.frame.k_normal - jnp.where(rests, self._compliance(normals, normals), 0.0)
        return contact.frame._replace(k_normal=k, normal_mass=reciprocal(k, contact.frame.normal_mass > 0))

    def coupling(self, first: ActiveContact, second: ActiveContact, rests: Array) -> Array:
        """What the support takes from the speed at one point that a unit impulse at another causes, 1/kg."""
        return jnp.where(rests, self._compliance(_normals(first), _normals(second)), 0.0)

    def pushes(self, impulse: Array, rests: Array) -> tuple[Array, Array]:
        """Bounds on the speed, m/s, that a change of the normal impulse gives to the supported body of each side."""
        of = zip(self.inertia, self.pressed, strict=True)
        a, b = (jnp.where(pressed & rests, inertia.mass * impulse, 0.0) for inertia, pressed in of)
        return a, b


def supported_pair(
    constraint: ContactConstraint, normal: Array, supports: tuple[Support | None, Support | None]
) -> SupportedPair | None:
    """The pair in contact along a normal; None without shock propagation, and for a static body."""
    a, b = supports
    if constraint.static or constraint.a is None or a is None or b is None:
        return None
    mass_a, mass_b = constraint.a.mass, constraint.b.mass  # 1/kg
    heavier_a = (mass_b > mass_a) & (mass_b <= LARGEST_RATIO * mass_a)
    heavier_b = (mass_a > mass_b) & (mass_a <= LARGEST_RATIO * mass_b)

    def onto(load: Array, direction: Array) -> Array:
        along = dot(load, direction)
        return (along > 0) & (along * along > PRESSED**2 * dot(load, load))

    pressed = heavier_b & onto(a.load, normal), heavier_a & onto(b.load, -normal)
    return SupportedPair((constraint.a, constraint.b), (a, b), pressed)
