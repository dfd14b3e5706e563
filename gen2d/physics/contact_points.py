"""Contact points of a pair, with their impact in this step."""

from typing import Any

import jax.numpy as jnp

from gen2d.physics.collision import FAR, NEAREST, Disc, dot, inverse_length, manifold, offset_from_core
from gen2d.physics.constraint import (
    ActiveContact,
    ContactConstraint,
    ContactFrame,
    ContactPoint,
    CoreOffset,
    Motion,
    frame_at,
    relative_speed,
)
from gen2d.physics.contact_state import BodySide, PassSetup
from gen2d.physics.time_of_impact import (
    SLOWEST,
    ApproachPath,
    plane_approach_speed,
    plane_path,
    round_path,
    select_path,
    time_of_impact,
)
from gen2d.records.axes import Array
from gen2d.xla import materialize

UP = (0.0, 1e-6)  # m: the offset of discs whose centres coincide; any would do
MIDDLE, END, NEIGHBOUR = 1.0, 2.0, 3.0  # the part of a segment that a disc is nearest to, or a neighbouring segment


def _nonzero_offset(offset: Array) -> Array:
    coincide = dot(offset, offset) < NEAREST
    return jnp.stack([jnp.where(coincide, up, x) for up, x in zip(UP, offset, strict=True)])


def _core_offset(constraint: ContactConstraint, a: Any, b: Disc) -> tuple[Array, Array | None]:
    """Offset from a's centre, or the nearest point of its core line, to b's centre, and the part of the core line.

    A disc beyond an end where another segment continues belongs to that segment, so that it does not stumble over the
    joint.
    """
    if isinstance(a, Disc):
        return _nonzero_offset(b.centre - a.centre), None
    offset, along, inside = offset_from_core(a, b.centre)
    offset, part = _nonzero_offset(offset), jnp.where(along == inside, MIDDLE, END)
    if constraint.left is None or constraint.right is None:
        return offset, part
    sides = zip(constraint.left, constraint.right, strict=True)
    onward = [dot(offset, jnp.where(along > 0, right, left)) for left, right in sides]
    return offset, jnp.where((part == END) & (jnp.maximum(*onward) > 0), NEIGHBOUR, part)


def contact_points(
    constraint: ContactConstraint,
    a: Any,
    b: Any,
    last_normals: list[Array],
    acceleration: Array | None,
    setup: PassSetup,
) -> list[ContactPoint]:
    """Contact points of shapes a and b, from the normal impulses of the last step and b's relative acceleration."""
    if constraint.frame is not None:
        offset, part = _core_offset(constraint, a, b)
        offset, inverse, part = materialize((offset, inverse_length(offset), part))
        gap, flat = 1 / inverse - a.radius - b.radius, None
        if part is not None:
            gap, flat = jnp.where(part == NEIGHBOUR, FAR, gap), part == MIDDLE
        position = b.centre if setup.log else None
        normal, core = offset * inverse, CoreOffset(offset, a.radius + b.radius, flat)
        return [ContactPoint(constraint.frame, normal, gap, last_normals[0], acceleration, position, core)]
    points = materialize(manifold(a, b))
    positions = [b.centre + p.arm_b if setup.log else None for p in points]
    return [
        ContactPoint(materialize(frame_at(constraint, p)), p.normal, p.gap, last, acceleration, position)
        for p, last, position in zip(points, last_normals, positions, strict=True)
    ]


def impact_of(
    constraint: ContactConstraint, point: ContactPoint, a: BodySide, b: BodySide, setup: PassSetup, h: float
) -> ActiveContact:
    """Contact point with its impact in this step, if there is one.

    Earlier impacts in this step have shifted the bodies' paths; the impact is computed on the shifted paths.
    """
    assert b.motion, "only static bodies lack a motion"
    assert b.drift, "only static bodies lack a drift"
    speed, pull = _speed_and_pull(point, point.normal, a.motion, b.motion)
    shift = b.drift.velocity if a.drift is None else b.drift.velocity - a.drift.velocity
    threshold = bounce_threshold(point, point.last_normal, a, b, setup)
    approach, frame, normal = -speed - pull * h, point.frame, point.normal
    if point.core is None:
        path, approach = _plane_approach(point, shift, approach, pull)
        tau = materialize(time_of_impact(path, approach, h, threshold))
    else:
        tau, normal = _round_impact(point, point.core, a.motion, b.motion, shift, approach, pull, threshold, h)
        speed, pull = _speed_and_pull(point, normal, a.motion, b.motion)
        frame = _frame_of_discs(constraint, point, tau)
    fall = pull * (h - tau)
    position = point.position
    if position is not None:
        position = position + jnp.maximum(tau, 0.0) * b.motion.velocity
        # A disc's lever is minus its radius.
        position = position if constraint.frame is None else position + frame.tangent_b * normal
    return ActiveContact(frame, normal, point.gap, tau, -speed - fall, fall, position)


def _speed_and_pull(point: ContactPoint, normal: Array, a: Motion | None, b: Motion) -> tuple[Array, Array | float]:
    """Speed of b relative to a along a normal, m/s, and acceleration of b towards a, m/s^2."""
    speed, _ = relative_speed(point.frame, normal, a, b)
    return speed, 0.0 if point.acceleration is None else -dot(normal, point.acceleration)


def _plane_approach(
    point: ContactPoint, shift: Array, approach: Array, pull: Array | float
) -> tuple[ApproachPath, Array]:
    """Path to a plane and the speed of arrival there."""
    gap = jnp.maximum(point.gap + dot(point.normal, shift), 0.0)
    return plane_path(gap, approach, pull), plane_approach_speed(gap, approach, pull)


def _round_impact(
    point: ContactPoint,
    core: CoreOffset,
    a: Motion | None,
    b: Motion,
    shift: Array,
    approach: Array,
    pull: Array | float,
    threshold: Array,
    h: float,
) -> tuple[Array, Array]:
    """Time of impact and normal of two round shapes, or of a disc and a core line."""
    plane = None if core.flat is None else (core.flat, *_plane_approach(point, shift, approach, pull))
    velocity = b.velocity if a is None else b.velocity - a.velocity
    mean = velocity if point.acceleration is None else velocity - 0.5 * h * point.acceleration
    offset = core.offset + shift
    inverse = inverse_length(offset)
    gap = jnp.maximum(1 / inverse - core.reach, 0.0)
    path = round_path(offset, gap, core.reach, mean)
    if plane is not None:  # a contact that belongs to a neighbouring segment has no impact
        flat, straight, approach = plane
        path = select_path(flat, straight, path._replace(c=jnp.where(point.gap < FAR / 2, path.c, FAR**2)))
    tau = time_of_impact(path, approach, h, threshold)
    # The normal is that at the time of impact, when the distance equals the sum of the radii.
    scale = jnp.where((tau >= 0) & (gap > 0), 1 / jnp.maximum(core.reach, SLOWEST), inverse)
    tau, scale = materialize((tau, scale))
    normal = jnp.where(tau >= 0, (offset + jnp.maximum(tau, 0.0) * mean) * scale, point.normal)
    return tau, materialize(normal) if core.flat is None else jnp.where(core.flat, point.normal, normal)


def bounce_threshold(
    point: ContactPoint | ActiveContact, normal: Array, a: BodySide, b: BodySide, setup: PassSetup
) -> Array:
    """Approach speed above which a contact bounces, m/s.

    It exceeds what pushing overlaps apart may add and what the pair's last normal impulse causes in a step; otherwise
    a pile would bounce on itself.
    """
    push = b.push if a.push is None else a.push + b.push
    return setup.threshold + push + point.frame.k_normal * normal


def _frame_of_discs(constraint: ContactConstraint, point: ContactPoint, tau: Array) -> ContactFrame:
    """Frame of two discs whose levers add up to the distance of their centres, also where they do not just touch."""
    frame = point.frame
    if constraint.a is None or frame.tangent_a is None:
        return frame
    half_gap = jnp.where(tau >= 0, 0.0, 0.5 * point.gap)
    tangent_b = frame.tangent_b - half_gap
    tangent_a = frame.tangent_a + half_gap
    k = frame.k_tangent + constraint.b.moment * (tangent_b**2 - frame.tangent_b**2)
    k = k + constraint.a.moment * (tangent_a**2 - frame.tangent_a**2)
    return frame._replace(tangent_a=tangent_a, tangent_b=tangent_b, k_tangent=k)
