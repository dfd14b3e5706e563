"""Contact points of a pair, with their impact in this step."""

from typing import Any

import jax.numpy as jnp

from gen2d.physics.collision import (
    FAR,
    NEAREST,
    Disc,
    ManifoldPoint,
    dot,
    inverse_length,
    manifold,
    offset_from_core,
    segment_contacts,
)
from gen2d.physics.constraint import (
    ActiveContact,
    ContactConstraint,
    ContactFrame,
    ContactPoint,
    CoreOffset,
    Motion,
    frame_at,
    frame_of,
    reciprocal,
    relative_speed,
    relative_velocity,
)
from gen2d.physics.contact_state import BodySide, PassSetup
from gen2d.physics.jointed import jointed_frame
from gen2d.physics.segment_lines import admissible, onward, whole_line
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
    if constraint.neighbours is None:
        return offset, part
    continues = onward(constraint.neighbours, offset, along > 0) > 0
    return offset, jnp.where((part == END) & continues, NEIGHBOUR, part)


def _manifold(constraint: ContactConstraint, a: Any, b: Any) -> tuple[ManifoldPoint, ...]:
    """Contact points of two shapes of which one has corners; a segment acts with its whole line."""
    neighbours = constraint.neighbours
    if neighbours is None or neighbours.line is None:
        return manifold(a, b)
    line, acts = whole_line(a, neighbours.line, b.centre)
    points = segment_contacts(line, b, admissible(line, neighbours))
    return tuple(point._replace(gap=jnp.where(acts, point.gap, FAR)) for point in points)


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
    points = materialize(_manifold(constraint, a, b))
    positions = [b.centre + p.arm_b if setup.log else None for p in points]
    return [
        ContactPoint(
            materialize(frame_at(constraint, p)),
            p.normal,
            p.gap,
            last,
            acceleration,
            position,
            None,
            isinstance(a, Disc),
        )
        for p, last, position in zip(points, last_normals, positions, strict=True)
    ]


def displaced_points(
    constraint: ContactConstraint, points: list[ContactPoint], a: Motion | None, b: Motion
) -> list[ContactPoint]:
    """Contact points after displacements of both bodies, in which an impulse and its reaction act at one point."""
    shift = relative_velocity(a, b)
    return [_displaced_point(constraint, point, shift) for point in points]


def displaced_gap(point: ContactPoint, a: Motion | None, b: Motion) -> Array:
    """Gap of a contact point after displacements of both bodies, m."""
    moved, _ = relative_speed(point.frame, point.normal, a, b)
    gap, core = point.gap + moved, point.core
    if core is None:
        return gap
    between = 1 / inverse_length(core.offset + relative_velocity(a, b)) - core.reach
    gap = between if core.flat is None else jnp.where(core.flat, gap, between)
    return jnp.where(point.gap < FAR / 2, gap, point.gap)


def _displaced_point(constraint: ContactConstraint, point: ContactPoint, shift: Array) -> ContactPoint:
    if point.core is not None:
        offset = point.core.offset + shift
        inverse = inverse_length(offset)
        normal = offset * inverse
        if point.core.flat is not None:
            normal = jnp.where(point.core.flat, point.normal, normal)
        frame = _frame_of_discs(constraint, point.frame, 1 / inverse - point.core.reach)
        return point._replace(frame=frame, normal=normal)
    if constraint.static or constraint.a is None:
        return point
    frame, (nx, ny), (x, y) = point.frame, point.normal, shift
    assert frame.normal_a is not None, "a body with corners has levers"
    assert frame.tangent_a is not None, "a body with corners has levers"
    assert frame.normal_b is not None, "a body with corners has levers"
    across, along = x * ny - y * nx, x * nx + y * ny
    if point.moves_with_a:
        levers = frame.normal_a, frame.normal_b - across, frame.tangent_a, frame.tangent_b - along
    else:
        levers = frame.normal_a + across, frame.normal_b, frame.tangent_a + along, frame.tangent_b
    return point._replace(frame=frame_of(constraint, levers, frame.normal_mass > 0))


def impact_times(points: list[ContactPoint], a: BodySide, b: BodySide, setup: PassSetup, h: float) -> list[Array]:
    """Time of impact of each point in s, or NONE or MISSES.

    Earlier impulses in this step have shifted the bodies' paths; an impact is computed on the shifted paths, from the
    last impact of either body on.
    """
    return [_time_of_impact(point, a, b, pair_clock(a, b), setup, h) for point in points]


def accelerated(points: list[ContactPoint], a: BodySide, b: BodySide) -> list[ContactPoint]:
    """Contact points with the acceleration of springs, which warm starting does not see."""
    pull = _pull_of_springs(a, b)
    if pull is None:
        return points
    return [
        point._replace(acceleration=pull if point.acceleration is None else point.acceleration + pull)
        for point in points
    ]


def _pull_of_springs(a: BodySide, b: BodySide) -> Array | None:
    """Acceleration [2, ...] of b relative to a by springs, m/s^2; None without springs."""
    return b.pull if a.pull is None or b.pull is None else b.pull - a.pull


def pair_clock(a: BodySide, b: BodySide) -> Array | None:
    """Time of the last impact of either body in the step so far, s; None: of no body."""
    return b.clock if a.clock is None or b.clock is None else jnp.maximum(a.clock, b.clock)


def active_contacts(
    constraint: ContactConstraint, points: list[ContactPoint], taus: list[Array], a: BodySide, b: BodySide, h: float
) -> tuple[list[ActiveContact], Array]:
    """Contact points with their times of impact, and the time in s at which impulses act.

    If two points bounce in the same step, the impulses act at the mean of their times, and at half of the step if none
    does.
    """
    assert b.motion, "only static bodies lack a motion"
    assert b.drift, "only static bodies lack a drift"
    taus, time = materialize((taus, _time_of_impulses(taus, h)))
    shift, velocity = relative_velocity(a.drift, b.drift), _mean_velocity(points[0], a.motion, b.motion, h)
    contacts = []
    for point, tau in zip(points, taus, strict=True):
        frame, normal = materialize(_displaced_point(constraint, point, shift + time * velocity)[:2])
        frame = jointed_frame(constraint, frame, normal)
        speed, _ = relative_speed(frame, normal, a.motion, b.motion)
        fall = pull_along(point, normal) * (h - tau)
        position = position_of(constraint, point, frame, normal, _path(a if point.moves_with_a else b, time))
        contacts.append(ActiveContact(frame, normal, point.gap, tau, -speed - fall, fall, position))
    if b.pull is not None:
        time = _time_of_impulses([_time_with_rest(constraint, contact, h) for contact in contacts], h)
    return contacts, time


def position_of(
    constraint: ContactConstraint, point: ContactPoint, frame: ContactFrame, normal: Array, path: Array | float
) -> Array | None:
    """Position [2, ...] in m of a contact point that has moved along this path [2, ...]; None: not logged."""
    if point.position is None:
        return None
    position = point.position + path
    return position if constraint.frame is None else position + frame.tangent_b * normal  # the lever is minus a radius


def _time_of_impulses(taus: list[Array], h: float) -> Array:
    """Time at which the impulses at one or two points act, s."""
    if len(taus) == 1:
        return jnp.where(taus[0] >= 0, taus[0], 0.5 * h)
    first, second = taus
    both, total = (first >= 0) & (second >= 0), jnp.maximum(first, 0.0) + jnp.maximum(second, 0.0)
    return jnp.where(both, 0.5 * total, jnp.where((first >= 0) | (second >= 0), total, 0.5 * h))


def _time_with_rest(constraint: ContactConstraint, contact: ActiveContact, h: float) -> Array:
    """Mean time of an impact and of the force that holds the bodies together after it, s; negative without an impact.

    A strong spring brings the bodies together again in this step, where they come to rest. An impulse at the time of
    impact that leaves them no speed at the end of the step would throw them apart first, against the spring.
    """
    rests = constraint.elasticity * contact.arrival < contact.fall
    share = contact.fall / jnp.maximum(contact.arrival + contact.fall, SLOWEST)  # of the impulse
    held = (contact.tau >= 0) & (contact.arrival > 0) & rests
    return jnp.where(held, contact.tau + 0.5 * (h - contact.tau) * share, contact.tau)


def _path(side: BodySide, time: Array) -> Array | float:
    """Displacement [2, ...] in m of a body until a time in the step; zero at rest."""
    velocity = 0.0 if side.motion is None else time * side.motion.velocity
    return velocity if side.drift is None else velocity + side.drift.velocity


def _mean_velocity(point: ContactPoint, a: Motion | None, b: Motion, h: float) -> Array:
    """Velocity [2, ...] of b relative to a in the step, at the end of which they have these motions."""
    velocity = relative_velocity(a, b)
    return velocity if point.acceleration is None else velocity - 0.5 * h * point.acceleration


def pull_along(point: ContactPoint, normal: Array) -> Array | float:
    """Acceleration of b towards a along a normal, m/s^2."""
    return 0.0 if point.acceleration is None else -dot(normal, point.acceleration)


def _time_of_impact(
    point: ContactPoint, a: BodySide, b: BodySide, clock: Array | None, setup: PassSetup, h: float
) -> Array:
    """Time of impact in s after the clock, or NONE or MISSES."""
    assert b.motion, "only static bodies lack a motion"
    speed, _ = relative_speed(point.frame, point.normal, a.motion, b.motion)
    pull, threshold = pull_along(point, point.normal), bounce_threshold(point, point.last_normal, a, b, setup)
    approach, core = -speed - pull * h, point.core
    shift = jnp.zeros_like(point.normal) if b.drift is None else relative_velocity(a.drift, b.drift)
    if core is None:  # its corners turn within the step, so a path from a later time on is no better
        return time_of_impact(*_plane_approach(point, shift, approach, pull), h, threshold)
    offset, velocity = core.offset + shift, _mean_velocity(point, a.motion, b.motion, h)
    if clock is not None:
        offset = offset + clock * velocity
    gap = jnp.maximum(1 / inverse_length(offset) - core.reach, 0.0)
    path = round_path(offset, gap, core.reach, velocity)
    if core.flat is not None:  # a contact that belongs to a neighbouring segment has no impact
        path = path._replace(c=jnp.where(point.gap < FAR / 2, path.c, FAR**2))
        straight, approach = _plane_approach(point, shift, approach, pull, clock)
        path = select_path(core.flat, straight, path)
    return time_of_impact(path, approach, h, threshold, clock)


def _plane_approach(
    point: ContactPoint, shift: Array, approach: Array, pull: Array | float, clock: Array | None = None
) -> tuple[ApproachPath, Array]:
    """Path to a plane from the clock on, and the speed of arrival there; `approach` is the speed without a clock."""
    gap = point.gap + dot(point.normal, shift)
    if clock is not None:
        gap, approach = gap - clock * (approach + 0.5 * clock * pull), approach + clock * pull
    gap = jnp.maximum(gap, 0.0)
    return plane_path(gap, approach, pull), plane_approach_speed(gap, approach, pull)


def bounce_threshold(
    point: ContactPoint | ActiveContact, normal: Array, a: BodySide, b: BodySide, setup: PassSetup
) -> Array:
    """Approach speed above which a contact bounces, m/s.

    It exceeds what contacts at rest have added, and what the pair's last normal impulse causes in a step. Otherwise a
    pile would bounce on itself: the answer to what is no impact would press on the contacts at rest, which would add
    more in the next step.
    """
    frame, approach = point.frame, jnp.zeros_like(normal)
    for side, lever, sign in ((a, frame.normal_a, 1.0), (b, frame.normal_b, -1.0)):
        if side.resting is not None:
            velocity, spin = side.resting
            speed = dot(point.normal, velocity) if lever is None else dot(point.normal, velocity) + lever * spin
            approach = approach + sign * speed
    push = sum(side.push for side in (a, b) if side.push is not None)
    return setup.threshold + frame.k_normal * normal + jnp.maximum(approach, 0.0) + push


def _frame_of_discs(constraint: ContactConstraint, frame: ContactFrame, gap: Array) -> ContactFrame:
    """Frame of two discs whose levers add up to the distance of their centres, also where they do not just touch."""
    if constraint.a is None or frame.tangent_a is None:
        return frame
    tangent_b = frame.tangent_b - 0.5 * gap
    tangent_a = frame.tangent_a + 0.5 * gap
    k = frame.k_tangent + constraint.b.moment * (tangent_b**2 - frame.tangent_b**2)
    k = k + constraint.a.moment * (tangent_a**2 - frame.tangent_a**2)
    mass = reciprocal(k, frame.normal_mass > 0)
    return frame._replace(tangent_a=tangent_a, tangent_b=tangent_b, k_tangent=k, tangent_mass=mass)
