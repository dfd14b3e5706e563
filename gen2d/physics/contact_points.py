"""Contact points of a pair, with their impact in this step."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from gen2d.physics.collision import FAR, NEAREST, Disc, dot, from_core, inverse_length, touches
from gen2d.physics.constraint import (
    ActiveContact,
    ContactConstraint,
    ContactFrame,
    ContactPoint,
    CoreOffset,
    Inertia,
    Motion,
    frame_at,
    relative,
)
from gen2d.physics.contact_state import PassSetup
from gen2d.physics.time_of_impact import (
    SLOWEST,
    ApproachPath,
    approach_speed,
    plane_approach_speed,
    plane_path,
    post_impact_speed,
    round_path,
    select,
    time_of_impact,
)
from gen2d.records.axes import Array
from gen2d.xla import materialize

UP = (0.0, 1e-6)  # m: the offset of discs whose centres coincide; any would do


def _apart(offset: Array) -> Array:
    near = dot(offset, offset) < NEAREST
    return jnp.stack([jnp.where(near, up, x) for up, x in zip(UP, offset, strict=True)])


MIDDLE, END, ELSEWHERE = 1.0, 2.0, 3.0  # of a segment: what is nearest to a disc, or that it is another segment's


def _offset(row: ContactConstraint, a: Any, b: Disc) -> tuple[Array, Array | None]:
    """From a's centre, or from where its core line is nearest, to b's centre; and where that is.

    At an end from which another segment goes on, a disc over that one is not this one's: else it would stumble on it.
    """
    if isinstance(a, Disc):
        return _apart(b.centre - a.centre), None
    offset, along, inside = from_core(a, b.centre)
    offset, where = _apart(offset), jnp.where(along == inside, MIDDLE, END)
    if row.left is None or row.right is None:
        return offset, where
    ways = zip(row.left, row.right, strict=True)
    onward = [dot(offset, jnp.where(along > 0, right, left)) for left, right in ways]
    return offset, jnp.where((where == END) & (jnp.maximum(*onward) > 0), ELSEWHERE, where)


def contact_points(
    row: ContactConstraint, a: Any, b: Any, pressed: list[Array], fall: Array | None, setup: PassSetup
) -> list[ContactPoint]:
    if row.grip is not None:
        apart, where = _offset(row, a, b)
        apart, inverse, where = materialize((apart, inverse_length(apart), where))
        gap, flat = 1 / inverse - a.radius - b.radius, None
        if where is not None:
            gap, flat = jnp.where(where == ELSEWHERE, FAR, gap), where == MIDDLE
        place = b.centre if setup.contacts else None
        normal, core = apart * inverse, CoreOffset(apart, a.radius + b.radius, flat)
        return [ContactPoint(row.grip, normal, gap, pressed[0], fall, place, core)]
    points = materialize(touches(a, b))
    places = [b.centre + p.arm_b if setup.contacts else None for p in points]
    return [
        ContactPoint(materialize(frame_at(row, p)), p.normal, p.gap, last, fall, place)
        for p, last, place in zip(points, pressed, places, strict=True)
    ]


class Approach(NamedTuple):
    """How the two bodies of a row come to a point of it."""

    a: Motion | None
    b: Motion
    shift: Array  # [2, ...] m: what b's path over a's was shifted by what they have met before in this step
    threshold: Array  # m/s: slower impacts do not bounce


def impact_of(
    row: ContactConstraint, at: ContactPoint, a: tuple, b: tuple, setup: PassSetup, h: float
) -> ActiveContact:
    """A point of a row with its impact, if there is one in this step; a and b are motion and drift.

    What a body has met before in this step has shifted its path: it comes from there.
    """
    (motion_a, drift_a), (motion_b, drift_b) = a, b
    speed, pull = _closing(at, at.normal, motion_a, motion_b)
    shift = drift_b.way.velocity if drift_a is None else drift_b.way.velocity - drift_a.way.velocity
    threshold = bounce_threshold(at, at.pressed, None if drift_a is None else drift_a.push, drift_b.push, setup)
    course, approach = Approach(motion_a, motion_b, shift, threshold), -speed - pull * h
    grip, normal = at.grip, at.normal
    if at.core is None:
        path, approach = _to_plane(at, shift, approach, pull)
        tau = materialize(time_of_impact(path, approach, h, threshold))
    else:
        tau, normal = _met_round(at, at.core, course, approach, pull, h)
        speed, pull = _closing(at, normal, motion_a, motion_b)
        grip = _levered(row, at, tau)
    arrived = approach_speed(speed, pull, tau, h)
    target = post_impact_speed(arrived, pull, row.elasticity, tau, h)
    place = at.place
    if place is not None:
        place = place + jnp.maximum(tau, 0.0) * motion_b.velocity
        place = place if row.grip is None else place + grip.tangent_b * normal  # the lever of b is minus its radius
    return ActiveContact(grip, normal, at.gap, tau, arrived, target, place)


def _closing(at: ContactPoint, normal: Array, a: Motion | None, b: Motion) -> tuple[Array, Array | float]:
    """Along a normal: the speed of b over a, m/s, and the acceleration of b to a, m/s^2."""
    return relative(at.grip, normal, a, b)[0], 0.0 if at.fall is None else -dot(normal, at.fall)


def _to_plane(at: ContactPoint, shift: Array, approach: Array, pull: Array | float) -> tuple[ApproachPath, Array]:
    """The path to a plane, and the speed of arrival at it."""
    gap = jnp.maximum(at.gap + dot(at.normal, shift), 0.0)
    return plane_path(gap, approach, pull), plane_approach_speed(gap, approach, pull)


def _met_round(
    at: ContactPoint, core: CoreOffset, course: Approach, approach: Array, pull: Array | float, h: float
) -> tuple[Array, Array]:
    """Time of impact, and normal, of two round shapes, or of a disc and a core line."""
    plane = None if core.flat is None else (core.flat, *_to_plane(at, course.shift, approach, pull))
    velocity = course.b.velocity if course.a is None else course.b.velocity - course.a.velocity
    mean = velocity if at.fall is None else velocity - 0.5 * h * at.fall
    apart = core.apart + course.shift
    inverse = inverse_length(apart)
    gap = jnp.maximum(1 / inverse - core.reach, 0.0)
    path = round_path(apart, gap, core.reach, mean)
    if plane is not None:  # none meets what is not its own
        flat, straight, approach = plane
        path = select(flat, straight, path._replace(c=jnp.where(at.gap < FAR / 2, path.c, FAR**2)))
    tau = time_of_impact(path, approach, h, course.threshold)
    # Two round shapes meet in the normal of that time, at which their distance is what both radii make.
    scale = jnp.where((tau >= 0) & (gap > 0), 1 / jnp.maximum(core.reach, SLOWEST), inverse)
    tau, scale = materialize((tau, scale))
    met = jnp.where(tau >= 0, (apart + jnp.maximum(tau, 0.0) * mean) * scale, at.normal)
    return tau, materialize(met) if core.flat is None else jnp.where(core.flat, at.normal, met)


def bounce_threshold(
    at: ContactPoint | ActiveContact, pressed: Array, push_a: Array | None, push_b: Array, setup: PassSetup
) -> Array:
    """The approach speed of an impact, m/s.

    It is more than pushing overlaps apart adds, and more than the impulse that has pressed the two together gives in a
    step, or a pile would bounce on itself.
    """
    pushes = push_b if push_a is None else push_a + push_b
    return setup.threshold + pushes + at.grip.k_normal * pressed


def _levered(row: ContactConstraint, at: ContactPoint, tau: Array) -> ContactFrame:
    """The grip of discs that do not just touch: both levers together are as long as the centres are apart."""
    grip = at.grip
    if row.a is None or grip.tangent_a is None:
        return grip
    half_gap = jnp.where(tau >= 0, 0.0, 0.5 * at.gap)
    tangent_b = grip.tangent_b - half_gap
    tangent_a = grip.tangent_a + half_gap
    k = grip.k_tangent + row.b.moment * (tangent_b**2 - grip.tangent_b**2)
    k = k + row.a.moment * (tangent_a**2 - grip.tangent_a**2)
    return grip._replace(tangent_a=tangent_a, tangent_b=tangent_b, k_tangent=k)


def _spun_by(inertia: Inertia, lever: Array | None, other: Array | None) -> Array | float:
    """The speed at one lever that a unit impulse at another gives by the spin."""
    return 0.0 if lever is None or other is None else inertia.moment * lever * other


def both_points(row: ContactConstraint, touches: list[ActiveContact], speeds: list[Array]) -> list[Array | None]:
    """Normal impulses that bounce both points at once, which one after the other would turn a flat landing.

    The matrix of two impulses to two speeds is inverted; where it cannot be, or a point would be pulled, each point
    goes alone (-1).
    """
    if len(touches) == 1:
        return [None]
    (p, q), wanted = touches, [t.target - s for t, s in zip(touches, speeds, strict=True)]
    k = row.b.mass + _spun_by(row.b, p.grip.normal_b, q.grip.normal_b)
    if row.a is not None:
        k = k + row.a.mass + _spun_by(row.a, p.grip.normal_a, q.grip.normal_a)
    det = p.grip.k_normal * q.grip.k_normal - k * k
    regular = det > 1e-4 * p.grip.k_normal * q.grip.k_normal
    one_over = 1 / jnp.where(regular, det, 1.0)
    first = (q.grip.k_normal * wanted[0] - k * wanted[1]) * one_over
    second = (p.grip.k_normal * wanted[1] - k * wanted[0]) * one_over
    both = regular & (p.tau >= 0) & (q.tau >= 0) & (first >= 0) & (second >= 0)
    both = both & (p.grip.normal_mass > 0) & (q.grip.normal_mass > 0)
    return [jnp.where(both, x, -1.0) for x in (first, second)]
