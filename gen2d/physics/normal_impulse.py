"""Normal impulses at the one or two points of a contact: a linear complementarity problem, solved exactly.

At each point speed >= target and impulse >= 0, one of them with equality. Two points of one
contact that both bounce, or both rest, are solved together, as one after the other would turn a box that lands flat, or
tilt one that stands. If only one bounces, they are solved one after the other: a bounce keeps the energy of the speeds
that it finds.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp

from gen2d.physics.constraint import ActiveContact, ContactConstraint, Impulse, Inertia
from gen2d.physics.jointed import joint_coupling
from gen2d.physics.time_of_impact import MISSES
from gen2d.records.axes import Array

REGULAR = 1e-4  # relative determinant: two points with a smaller one act as one


class NormalTarget(NamedTuple):
    """What the accumulated impulse at a point is to reach."""

    active: Array
    speed: Array  # m/s
    idle: Array  # N s: the impulse where not active
    bounces: Array
    apart: Array | None = None  # whether it is an impact of its own, whose friction is bounded by its own impulse


TargetOf: TypeAlias = Callable[[ActiveContact, Array, Impulse], NormalTarget]


def bounce_speed(constraint: ContactConstraint, contact: ActiveContact, speed: Array) -> Array:
    """Normal speed at the end of the step after a bounce, m/s; that without a bounce if the points part already.

    It is e times the arrival speed less what the acceleration takes after tau, and zero if that is more.
    """
    arrival = -speed - contact.fall
    return jnp.where(arrival > 0, jnp.maximum(constraint.elasticity * arrival - contact.fall, 0.0), speed)


def step_target(
    constraint: ContactConstraint, contact: ActiveContact, speed: Array, old: Impulse, h: float
) -> NormalTarget:
    """Target of the first pass.

    A separated contact may close its gap, a touching one does not approach, and a bounce reaches its target speed. A
    fast approach that misses in this step gets no impulse, as the straight line of a contact at rest would stop a body
    that only grazes the other or arrives a step later.
    """
    bounces = contact.tau >= 0
    bounce = bounce_speed(constraint, contact, speed)
    touches = contact.frame.normal_mass > 0
    active = touches & jnp.where(bounces, bounce > speed, contact.tau > MISSES)
    return NormalTarget(
        active=active,
        speed=jnp.where(bounces, bounce, -jnp.maximum(contact.gap, 0.0) / h),
        idle=jnp.where(touches & bounces, old.normal, 0.0),
        bounces=bounces,
    )


def impact_target(
    constraint: ContactConstraint, contact: ActiveContact, speed: Array, old: Impulse, happens: Array
) -> NormalTarget:
    """Target of an impact alone, where it happens: the speed of its bounce."""
    bounce = bounce_speed(constraint, contact, speed)
    active = happens & (bounce > speed) & (contact.frame.normal_mass > 0)
    return NormalTarget(active, bounce, old.normal, happens, apart=happens)


class _Row:
    """A point of the problem: k (impulse - old) + (what the other point adds) >= missing."""

    def __init__(self, contact: ActiveContact, speed: Array, old: Impulse, target: NormalTarget) -> None:
        k_normal, mass = contact.frame.k_normal, contact.frame.normal_mass
        self.active, self.bounces = target.active, target.active & target.bounces
        self.old, self.k = old.normal, k_normal
        self.missing = target.speed - speed
        self.least = jnp.where(target.active, 0.0, target.idle)
        self._mass = mass

    def impulse(self, added: Array | float) -> Array:
        """Impulse at this point alone, if the other adds a speed in m/s."""
        impulse = jnp.maximum(self.old + self._mass * (self.missing - added), 0.0)
        return jnp.where(self.active, impulse, self.least)


def solve_normals(
    constraint: ContactConstraint,
    contacts: Sequence[ActiveContact],
    speeds: Sequence[Array],
    olds: Sequence[Impulse],
    targets: Sequence[NormalTarget],
    taken: Array | float = 0.0,
) -> list[Array]:
    """Accumulated normal impulses, N s, at the points of a contact with these speeds, m/s.

    A support takes `taken`, 1/kg, from the coupling of two points.
    """
    rows = [_Row(*of) for of in zip(contacts, speeds, olds, targets, strict=True)]
    if len(rows) == 1:
        return [rows[0].impulse(0.0)]
    p, q = rows
    k = _coupling(constraint, *contacts) - taken
    det = p.k * q.k - k * k
    regular = det > REGULAR * p.k * q.k
    inverse = 1 / jnp.where(regular, det, 1.0)
    both_p = p.old + (q.k * p.missing - k * q.missing) * inverse
    both_q = q.old + (p.k * q.missing - k * p.missing) * inverse
    both = p.active & q.active & regular & (both_p >= 0) & (both_q >= 0)
    # Else one of them carries its least: q if p alone satisfies it too.
    only_p, only_q = p.impulse(k * (q.least - q.old)), q.impulse(k * (p.least - p.old))
    enough = ~q.active | (q.k * (q.least - q.old) + k * (only_p - p.old) >= q.missing)
    together_p = jnp.where(both, both_p, jnp.where(enough, only_p, p.least))
    together_q = jnp.where(both, both_q, jnp.where(enough, q.least, only_q))
    first = p.impulse(0.0)
    after = q.impulse(k * (first - p.old))
    mixed = p.bounces ^ q.bounces
    return [jnp.where(mixed, first, together_p), jnp.where(mixed, after, together_q)]


def _coupling(constraint: ContactConstraint, p: ActiveContact, q: ActiveContact) -> Array:
    """Speed at one point that a unit impulse at the other causes, 1/kg."""

    def turning(inertia: Inertia, lever: Array | None, other: Array | None) -> Array | float:
        return 0.0 if lever is None or other is None else inertia.moment * lever * other

    k = constraint.b.mass + turning(constraint.b, p.frame.normal_b, q.frame.normal_b)
    if constraint.a is not None:
        k = k + constraint.a.mass + turning(constraint.a, p.frame.normal_a, q.frame.normal_a)
    return k - joint_coupling(constraint, p, q)
