"""The books of energy and momentum: what there is, where it went and what came in, each computed by itself.

An impulse P changes the kinetic energy by P . (u + u') / 2 with u and u' the speeds at its point before and after: so a
row knows what it takes, from its own impulses and speeds. What gravity's discrete kick m a . (h v + h^2 a / 2) and the
real fall m a . dx differ by belongs to what changed the fall: contacts, or damping.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp

from gen2d.physics.collision import dot
from gen2d.physics.constraint import (
    ActiveContact,
    ContactConstraint,
    ContactFrame,
    ContactPoint,
    Impulse,
    Motion,
    relative,
    turning,
)
from gen2d.records.axes import Array
from gen2d.xla import sum_bodies


class Work(NamedTuple):
    """What was done to a body since frame 0, J [N, ...], or by joints, J [1, ...]. None: nothing can do such work."""

    lost: Array  # in contacts and rigid joints
    driven: Array | None  # by forces, motors, and bodies that move as they like
    damped: Array | None  # lost to damping, of bodies and of springs


class Ledger(NamedTuple):
    """The work on each group of bodies, and by all joints."""

    groups: list[Work]
    joints: Work | None


def dissipated_by_discs(
    work: Work | None, grip: ContactFrame, impulse: Impulse, speed: Array, slip: Array
) -> Work | None:
    """The work with an impulse at a point where the two directions do not mix; speeds before it."""
    if work is None:
        return None
    gained = impulse.normal * (speed + 0.5 * grip.k_normal * impulse.normal)
    gained = gained + impulse.tangent * (slip + 0.5 * grip.k_tangent * impulse.tangent)
    return work._replace(lost=work.lost - gained)


def _of_surface(grip: ContactFrame, normal: Array, a: Motion) -> tuple[Array, Array]:
    """Normal and tangential speed of a's own point."""
    still = Motion(jnp.zeros_like(a.velocity), jnp.zeros_like(a.spin))
    speed, slip = relative(grip, normal, a, still)
    return -speed, -slip


MotionPair: TypeAlias = tuple[Motion | None, Motion]  # of a and b


def dissipated(
    work: Work | None,
    row: ContactConstraint,
    points: Sequence[ContactPoint | ActiveContact],
    impulses: list[Impulse],
    roll: Array | None,
    before: MotionPair,
    after: MotionPair,
) -> Work | None:
    """The work with all impulses of a row, which led from motions to others."""
    if work is None:
        return None
    lost, driven = work.lost, work.driven
    mover = before[0] if row.firm else None  # what moves as it likes does work where it pushes
    for at, impulse in zip(points, impulses, strict=True):
        sums = (x + y for x, y in zip(*(relative(at.grip, at.normal, *m) for m in (before, after)), strict=True))
        lost = lost - 0.5 * sum(p * s for p, s in zip(impulse, sums, strict=True))
        if mover is not None and driven is not None:
            surface = _of_surface(at.grip, at.normal, mover)
            driven = driven + sum(p * s for p, s in zip(impulse, surface, strict=True))
    if roll is not None:
        lost = lost - 0.5 * roll * (turning(*before) + turning(*after))
        driven = driven if mover is None or driven is None else driven + roll * mover.spin
    return Work(lost, driven, work.damped)


def _energies(motion: Motion, group: Any) -> Array:
    return 0.5 * (group.mass * dot(motion.velocity, motion.velocity) + group.moment * motion.spin**2)


def _taken(group: Any, fall: Array, spin_up: Array | float, aside: Motion) -> Array:
    """m a . dx, and the same of the angle."""
    linear = group.mass * dot(fall, aside.velocity)
    return linear if isinstance(spin_up, float) else linear + group.moment * spin_up * aside.spin


def record_energy(
    work: Work,
    group: Any,
    old: Motion,
    flying: Motion,
    more: Motion,
    way: Motion,
    fall: Array,
    spin_up: Array | float,
    gravity: Array,
    h: float,
) -> Work:
    """The work on a group after a step, from its motion before it, and its motion and way if nothing had touched it.

    How far it went beyond that: that, times m a, was not gravity's work but that of what touched it. Likewise damping
    is what is missing of the energy and of the way of a fall without it.
    """
    free = Motion(h * flying.velocity + more.velocity, h * flying.spin + more.spin)
    aside = Motion(way.velocity - free.velocity, way.spin - free.spin)
    lost, driven, damped = work.lost + _taken(group, fall, spin_up, aside), work.driven, work.damped
    if damped is not None:
        kicked = Motion(old.velocity + h * fall, old.spin + h * spin_up)
        undamped = h * old.velocity + 0.5 * h**2 * fall, h * old.spin + 0.5 * h**2 * spin_up
        behind = Motion(free.velocity - undamped[0], free.spin - undamped[1])
        damped = damped + _energies(kicked, group) - _energies(flying, group) + _taken(group, fall, spin_up, behind)
    if driven is not None:
        driven = driven + _taken(group, fall - gravity[:, None], spin_up, way)
    return Work(lost, driven, damped)


def accumulate(work: Work | None, passes: list[Work]) -> Work | None:
    """The work by all joints after a step's passes."""
    if work is None or not passes:
        return work
    lost, driven, damped = zip(*passes, strict=True)
    return Work(sum(lost, work.lost), _sum(work.driven, driven), _sum(work.damped, damped))


def _sum(old: Array | None, parts: Sequence[Array | None]) -> Array | None:
    return None if old is None else sum((part for part in parts if part is not None), old)


def close_balance(book: Ledger, springs: Array) -> tuple[Array, ...]:
    """Lost in contact, put in, lost to damping, by now; what springs hold now is not lost."""
    works = book.groups if book.joints is None else [*book.groups, book.joints]
    lost, driven, damped = (
        sum((sum_bodies(part) for part in parts if part is not None), jnp.zeros_like(springs))
        for parts in zip(*works, strict=True)
    )
    return lost, driven, damped - springs


def balance(groups: list[Any], bodies: list[Any], gravity: Array, springs: Array) -> tuple[Array | float, ...]:
    """Kinetic, rotational and potential energy, linear [2, ...] and angular momentum of all bodies, now."""
    kinetic = rotational = potential = angular = 0.0
    linear = jnp.zeros_like(gravity)
    for g, body in zip(groups, bodies, strict=True):
        (x, y), v, spin = body.position, body.motion.velocity, body.motion.spin
        kinetic = kinetic + sum_bodies(0.5 * g.mass * dot(v, v))
        rotational = rotational + sum_bodies(0.5 * g.moment * spin**2)
        potential = potential - sum_bodies(g.mass * dot(gravity[:, None], body.position))
        linear = linear + sum_bodies(g.mass * v)
        angular = angular + sum_bodies(g.mass * (x * v[1] - y * v[0]) + g.moment * spin)
    return kinetic, rotational, potential + springs, linear, angular
