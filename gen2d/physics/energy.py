"""Energy and momentum accounting; every term is computed by itself.

An impulse P changes the kinetic energy by P . (u + u') / 2, with u and u' the speeds at its point before and after, so
a contact knows its work from its own impulses and speeds. Gravity's discrete kick does the work
m a . (h v + h^2 a / 2); its difference from that of the real fall, m a . dx, belongs to what changed the fall: contacts
or damping.
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
    Inertia,
    Motion,
    reciprocal,
    relative_speed,
)
from gen2d.physics.friction import relative_spin
from gen2d.records.axes import Array
from gen2d.xla import sum_bodies


class Work(NamedTuple):
    """Work since frame 0 on bodies, J [N, ...], or by joints, J [1, ...]. None: no such work is possible."""

    lost: Array  # in contacts and rigid joints
    driven: Array | None  # by forces, motors and kinematic bodies
    damped: Array | None  # lost to damping of bodies and springs


class Ledger(NamedTuple):
    """Work on each group of bodies and by all joints."""

    groups: list[Work]
    joints: Work | None


def kinetic_energy(inverse: Inertia, motion: Motion | None) -> Array:
    """Kinetic energy of bodies with these inverse masses, J."""
    assert motion is not None, "only moving bodies have energy"
    (mass, moment), (velocity, spin) = (reciprocal(x, x > 0) for x in inverse), motion
    return 0.5 * (mass * dot(velocity, velocity) + moment * spin**2)


def add_loss(
    work: Work | None, inverse: Inertia, old: Motion | None, new: Motion | None, changed: Array | bool = True
) -> Work | None:
    """Work with the kinetic energy that is lost where the new motion of bodies takes the place of the old one."""
    if work is None:
        return None
    lost = kinetic_energy(inverse, old) - kinetic_energy(inverse, new)
    return work._replace(lost=work.lost + jnp.where(changed, lost, 0.0))  # without rounding errors elsewhere


def add_disc_dissipation(
    work: Work | None, frame: ContactFrame, impulse: Impulse, speed: Array, slip: Array
) -> Work | None:
    """Work with that of an impulse whose two directions do not interact; speeds are those before it."""
    if work is None:
        return None
    gain = impulse.normal * (speed + 0.5 * frame.k_normal * impulse.normal)
    gain = gain + impulse.tangent * (slip + 0.5 * frame.k_tangent * impulse.tangent)
    return work._replace(lost=work.lost - gain)


MotionPair: TypeAlias = tuple[Motion | None, Motion]  # of a and b


def add_dissipation(
    work: Work | None,
    constraint: ContactConstraint,
    points: Sequence[ContactPoint | ActiveContact],
    impulses: list[Impulse],
    roll: Array | None,
    before: MotionPair,
    after: MotionPair,
) -> Work | None:
    """Work with that of all impulses of a pair, from the motions before and after them."""
    if work is None:
        return None
    lost, driven = work.lost, work.driven
    mover = before[0] if constraint.static else None  # a kinematic body does work where it pushes
    for point, impulse in zip(points, impulses, strict=True):
        speeds = (relative_speed(point.frame, point.normal, *motions) for motions in (before, after))
        sums = (x + y for x, y in zip(*speeds, strict=True))
        lost = lost - 0.5 * sum(p * s for p, s in zip(impulse, sums, strict=True))
        if mover is not None and driven is not None:
            rest = Motion(jnp.zeros_like(mover.velocity), jnp.zeros_like(mover.spin))
            speed, slip = relative_speed(point.frame, point.normal, mover, rest)
            driven = driven + sum(p * s for p, s in zip(impulse, (-speed, -slip), strict=True))
    if roll is not None:
        lost = lost - 0.5 * roll * (relative_spin(*before) + relative_spin(*after))
        driven = driven if mover is None or driven is None else driven + roll * mover.spin
    return Work(lost, driven, work.damped)


def _kinetic(motion: Motion, group: Any) -> Array:
    return 0.5 * (group.mass * dot(motion.velocity, motion.velocity) + group.moment * motion.spin**2)


def _work_of(group: Any, acceleration: Array, angular: Array | float, displacement: Motion) -> Array:
    """Work m a . dx, with its angular part."""
    linear = group.mass * dot(acceleration, displacement.velocity)
    return linear if isinstance(angular, float) else linear + group.moment * angular * displacement.spin


def record_energy(
    work: Work,
    group: Any,
    old: Motion,
    free: Motion,
    flown: Motion,
    displacement: Motion,
    acceleration: Array,
    angular: Array | float,
    gravity: Array,
    h: float,
) -> Work:
    """Work on a group after a step.

    `old` is the motion before the step; `free`, and the displacement `flown`, are those of a step without any contact
    or joint. The work of the acceleration over the displacement that differs from the free one belongs to
    contacts and joints. Damping takes the energy and the displacement that an undamped fall would have more.
    """
    deviation = Motion(displacement.velocity - flown.velocity, displacement.spin - flown.spin)
    lost = work.lost + _work_of(group, acceleration, angular, deviation)
    driven, damped = work.driven, work.damped
    if damped is not None:
        undamped = Motion(old.velocity + h * acceleration, old.spin + h * angular)
        fall = Motion(h * old.velocity + 0.5 * h**2 * acceleration, h * old.spin + 0.5 * h**2 * angular)
        missing = Motion(flown.velocity - fall.velocity, flown.spin - fall.spin)
        damped = damped + _kinetic(undamped, group) - _kinetic(free, group)
        damped = damped + _work_of(group, acceleration, angular, missing)
    if driven is not None:
        driven = driven + _work_of(group, acceleration - gravity[:, None], angular, displacement)
    return Work(lost, driven, damped)


def spring_work_over(groups: list[Any], pulls: list[Motion], displacements: list[Motion]) -> Work:
    """Work of springs, which give bodies these accelerations, over displacements by contacts, as lost in these."""
    of = zip(groups, pulls, displacements, strict=True)
    each = [jnp.sum(_work_of(group, *pull, way), axis=-2, keepdims=True) for group, pull, way in of]
    total = sum(each[1:], each[0])
    return Work(total, None, -total)


def accumulate(work: Work | None, passes: list[Work]) -> Work | None:
    """Work by all joints after the passes of a step."""
    if work is None or not passes:
        return work
    lost, driven, damped = zip(*passes, strict=True)

    def total(old: Array | None, parts: Sequence[Array | None]) -> Array | None:
        return None if old is None else sum((part for part in parts if part is not None), old)

    return Work(sum(lost, work.lost), total(work.driven, driven), total(work.damped, damped))


def close_balance(ledger: Ledger, springs: Array) -> tuple[Array, ...]:
    """Energy lost in contacts, put in, and lost to damping so far; energy stored in springs is not lost."""
    works = ledger.groups if ledger.joints is None else [*ledger.groups, ledger.joints]
    lost, driven, damped = (
        sum((sum_bodies(part) for part in parts if part is not None), jnp.zeros_like(springs))
        for parts in zip(*works, strict=True)
    )
    return lost, driven, damped - springs


def balance(groups: list[Any], bodies: list[Any], gravity: Array, springs: Array) -> tuple[Array | float, ...]:
    """Kinetic, rotational and potential energy, and linear [2, ...] and angular momentum of all bodies."""
    kinetic = rotational = potential = angular = 0.0
    linear = jnp.zeros_like(gravity)
    for group, body in zip(groups, bodies, strict=True):
        (x, y), v, spin = body.position, body.motion.velocity, body.motion.spin
        kinetic = kinetic + sum_bodies(0.5 * group.mass * dot(v, v))
        rotational = rotational + sum_bodies(0.5 * group.moment * spin**2)
        potential = potential - sum_bodies(group.mass * dot(gravity[:, None], body.position))
        linear = linear + sum_bodies(group.mass * v)
        angular = angular + sum_bodies(group.mass * (x * v[1] - y * v[0]) + group.moment * spin)
    return kinetic, rotational, potential + springs, linear, angular
