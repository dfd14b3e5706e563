"""What the three passes of a step do to a row: warm starting, the biased solve, the relaxing solve.

A row is any number of pairs; dense.py hands it all pairs of a round, sparse.py those that are near each other.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.contacts import FAR, NEAREST, Disc, Stadium, dot, from_core, inverse_length, touches, turned
from gen2d.impacts import (
    SLOWEST,
    Path,
    arrival,
    either,
    plane_arrival,
    plane_path,
    rebound,
    round_path,
    time_of_impact,
)
from gen2d.ledger import Work, spent, spent_by_discs
from gen2d.rows import (
    Core,
    Found,
    Grip,
    Impulse,
    Inertia,
    Motion,
    Row,
    Rules,
    Touch,
    added,
    biased,
    grip_at,
    pushed,
    relative,
    relaxed,
    resisted,
    rubbed,
    softness,
    spun,
    struck,
)
from gen2d.tournament import settled
from gen2d.types import Array


class Setup(NamedTuple):
    """What the passes need to know of a video."""

    gravity: Array  # [2, 1, ...] m/s^2
    threshold: Array  # [...] m/s: slower impacts do not bounce
    one: Array  # see settled()
    contacts: bool  # whether touches shall say where they are


class Drift(NamedTuple):
    """What a pass changes in where a body goes, beyond its new velocity."""

    way: Motion  # m, rad: impacts act at their time, not at the start of the step
    push: Array  # [N, ...] m/s: what pushing overlaps apart may have added to its speed; 0: no contact holds it


class Memory(NamedTuple):
    """What a row leaves to the next step."""

    impulses: list[Impulse]  # at its points; `kept` says what of them counts
    roll: Array | None  # N m s, against rolling


class Solved(NamedTuple):
    """A row before or after a pass."""

    touches: list[Touch]
    impulses: list[Impulse]
    roll: Array | None


UP = (0.0, 1e-6)  # m: the offset of discs whose centres coincide; any would do


def _apart(offset: Array) -> Array:
    near = dot(offset, offset) < NEAREST
    return jnp.stack([jnp.where(near, up, x) for up, x in zip(UP, offset, strict=True)])


MIDDLE, END, ELSEWHERE = 1.0, 2.0, 3.0  # of a segment: what is nearest to a disc, or that it is another segment's


def _offset(row: Row, a: Any, b: Disc) -> tuple[Array, Array | None]:
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


def _found(row: Row, a: Any, b: Any, pressed: list[Array], fall: Array | None, setup: Setup) -> list[Found]:
    if row.grip is not None:
        apart, where = _offset(row, a, b)
        apart, inverse, where = settled((apart, inverse_length(apart), where), setup.one)
        gap, flat = 1 / inverse - a.radius - b.radius, None
        if where is not None:
            gap, flat = jnp.where(where == ELSEWHERE, FAR, gap), where == MIDDLE
        place = b.centre if setup.contacts else None
        normal, core = apart * inverse, Core(apart, a.radius + b.radius, flat)
        return [Found(row.grip, normal, gap, pressed[0], fall, place, core)]
    points = settled(touches(a, b, setup.one), setup.one)
    places = [b.centre + p.arm_b if setup.contacts else None for p in points]
    return [
        Found(settled(grip_at(row, p), setup.one), p.normal, p.gap, last, fall, place)
        for p, last, place in zip(points, pressed, places, strict=True)
    ]


class Course(NamedTuple):
    """How the two bodies of a row come to a point of it."""

    a: Motion | None
    b: Motion
    shift: Array  # [2, ...] m: what b's path over a's was shifted by what they have met before in this step
    threshold: Array  # m/s: slower impacts do not bounce


def _met(row: Row, at: Found, a: tuple, b: tuple, setup: Setup, h: float) -> Touch:
    """A point of a row with its impact, if there is one in this step; a and b are motion and drift.

    What a body has met before in this step has shifted its path: it comes from there.
    """
    (motion_a, drift_a), (motion_b, drift_b) = a, b
    speed, pull = _closing(at, at.normal, motion_a, motion_b)
    shift = drift_b.way.velocity if drift_a is None else drift_b.way.velocity - drift_a.way.velocity
    threshold = _threshold(at, at.pressed, None if drift_a is None else drift_a.push, drift_b.push, setup)
    course, approach = Course(motion_a, motion_b, shift, threshold), -speed - pull * h
    grip, normal = at.grip, at.normal
    if at.core is None:
        path, approach = _to_plane(at, shift, approach, pull)
        tau = settled(time_of_impact(path, approach, h, threshold), setup.one)
    else:
        tau, normal = _met_round(at, at.core, course, approach, pull, setup.one, h)
        speed, pull = _closing(at, normal, motion_a, motion_b)
        grip = _levered(row, at, tau)
    arrived = arrival(speed, pull, tau, h)
    target = rebound(arrived, pull, row.elasticity, tau, h)
    place = at.place
    if place is not None:
        place = place + jnp.maximum(tau, 0.0) * motion_b.velocity
        place = place if row.grip is None else place + grip.tangent_b * normal  # the lever of b is minus its radius
    return Touch(grip, normal, at.gap, tau, arrived, target, place)


def _closing(at: Found, normal: Array, a: Motion | None, b: Motion) -> tuple[Array, Array | float]:
    """Along a normal: the speed of b over a, m/s, and the acceleration of b to a, m/s^2."""
    return relative(at.grip, normal, a, b)[0], 0.0 if at.fall is None else -dot(normal, at.fall)


def _to_plane(at: Found, shift: Array, approach: Array, pull: Array | float) -> tuple[Path, Array]:
    """The path to a plane, and the speed of arrival at it."""
    gap = jnp.maximum(at.gap + dot(at.normal, shift), 0.0)
    return plane_path(gap, approach, pull), plane_arrival(gap, approach, pull)


def _met_round(
    at: Found, core: Core, course: Course, approach: Array, pull: Array | float, one: Array, h: float
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
        path = either(flat, straight, path._replace(c=jnp.where(at.gap < FAR / 2, path.c, FAR**2)))
    tau = time_of_impact(path, approach, h, course.threshold)
    # Two round shapes meet in the normal of that time, at which their distance is what both radii make.
    scale = jnp.where((tau >= 0) & (gap > 0), 1 / jnp.maximum(core.reach, SLOWEST), inverse)
    tau, scale = settled((tau, scale), one)
    met = jnp.where(tau >= 0, (apart + jnp.maximum(tau, 0.0) * mean) * scale, at.normal)
    return tau, settled(met, one) if core.flat is None else jnp.where(core.flat, at.normal, met)


def _threshold(at: Found | Touch, pressed: Array, push_a: Array | None, push_b: Array, setup: Setup) -> Array:
    """The approach speed of an impact, m/s.

    It is more than pushing overlaps apart adds, and more than the impulse that has pressed the two together gives in a
    step, or a pile would bounce on itself.
    """
    pushes = push_b if push_a is None else push_a + push_b
    return setup.threshold + pushes + at.grip.k_normal * pressed


def _levered(row: Row, at: Found, tau: Array) -> Grip:
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


def _both(row: Row, touches: list[Touch], speeds: list[Array]) -> list[Array | None]:
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


def _exchange(
    row: Row, was: Solved, press: Callable, a: Motion | None, b: Motion, work: Work | None, one: Array
) -> tuple[Motion | None, Motion, Solved, Work | None]:
    """Both motions after a row's normal impulses, its friction and what resists its rolling; the row; the work.

    `press(i, touch, speed, old)` gives the accumulated normal impulse at point i.
    """
    before, roll = (a, b), was.roll
    if row.grip is not None and roll is None:
        # What presses two discs gives them no slip, so both impulses can be had at once.
        (at,), (old,) = was.touches, was.impulses
        speed, slip = relative(at.grip, at.normal, a, b)
        pressed = settled(press(0, at, speed, old), one)
        impulse = Impulse(pressed, settled(rubbed(row, at, pressed, slip, old), one))
        more = added(impulse, old)
        a, b = pushed(row, at, more, a, b)
        return a, b, Solved(was.touches, [impulse], None), spent_by_discs(work, row.grip, more, speed, slip)
    pressed, impulses = [], []
    for i, (at, old) in enumerate(zip(was.touches, was.impulses, strict=True)):
        speed, _ = relative(at.grip, at.normal, a, b)
        pressed.append(settled(press(i, at, speed, old), one))
        a, b = pushed(row, at, (pressed[-1] - old.normal, None), a, b)
    for at, old, normal in zip(was.touches, was.impulses, pressed, strict=True):
        _, slip = relative(at.grip, at.normal, a, b)
        impulses.append(Impulse(normal, settled(rubbed(row, at, normal, slip, old), one)))
        a, b = pushed(row, at, (None, impulses[-1].tangent - old.tangent), a, b)
    if roll is not None:
        roll = settled(resisted(row, sum(pressed[1:], pressed[0]), a, b, roll), one)
        a, b = spun(row, roll - was.roll, a, b)
    more = [added(new, old) for new, old in zip(impulses, was.impulses, strict=True)]
    twist = None if roll is None else roll - was.roll
    return a, b, Solved(was.touches, impulses, roll), spent(work, row, was.touches, more, twist, before, (a, b))


def warm(row: Row, memory: Memory, a: tuple, b: tuple, setup: Setup) -> tuple[tuple, tuple, list[Found]]:
    """Both sides with the last step's impulses, and the row's points.

    A side is its shape, motion, acceleration (None where all fall alike) and work; a fixed one has no motion where it
    stands still.
    """
    (shape_a, motion_a, fall_a, _), (shape_b, motion_b, fall_b, work) = a, b
    olds, roll = kept(memory.impulses), memory.roll
    fall = setup.gravity if row.firm else None
    if fall_b is not None:
        fall = fall_b if row.firm else fall_b - fall_a
    points = _found(row, shape_a, shape_b, [jnp.abs(old.normal) for old in memory.impulses], fall, setup)
    new_a, new_b = motion_a, motion_b
    for at, old in zip(points, olds, strict=True):
        new_a, new_b = pushed(row, at, old, new_a, new_b)
    if roll is not None:
        new_a, new_b = spun(row, roll, new_a, new_b)
    if row.grip is not None and roll is None:
        speeds = relative(row.grip, points[0].normal, motion_a, motion_b)
        work = spent_by_discs(work, row.grip, olds[0], *speeds)
    else:
        work = spent(work, row, points, olds, roll, (motion_a, motion_b), (new_a, new_b))
    new_b = settled(new_b, setup.one) if row.firm else new_b
    return (shape_a, new_a, fall_a, a[3]), (shape_b, new_b, fall_b, work), points


HELD = 1e-9  # m/s: the push of a contact that does not push


def _pushes(row: Row, points: list[Touch], impulses: list[Impulse], a: Drift | None, b: Drift, rules: Rules) -> Array:
    """What a row's contact may add to its bodies' speeds, or hand on; 0 where there is none but an impact."""
    rate, *_ = softness(row, rules)
    found = b.push if a is None else jnp.maximum(a.push, b.push)
    pushes = jnp.zeros_like(found)
    for at, impulse in zip(points, impulses, strict=True):
        own = jnp.maximum(found, jnp.clip(-rate * at.gap, HELD, rules.push_speed))
        pushes = jnp.maximum(pushes, jnp.where((at.tau < 0) & (impulse.normal > 0), own, 0.0))
    return pushes


def _drifted(drift: Drift, points: list[Touch], pushes: Array, old: Motion, new: Motion) -> Drift:
    """The drift with what the time of an impact takes off the way.

    Of two points that bounce in the same step the way counts from the mean of their times.
    """
    tau = jnp.maximum(points[0].tau, 0.0)
    if len(points) == 2:
        second = jnp.maximum(points[1].tau, 0.0)
        both = (points[0].tau >= 0) & (points[1].tau >= 0)
        tau = jnp.where(both, 0.5 * (tau + second), tau + second)
    way = Motion(drift.way.velocity - tau * (new.velocity - old.velocity), drift.way.spin - tau * (new.spin - old.spin))
    return Drift(way, jnp.maximum(drift.push, pushes))


def solve(
    row: Row, memory: Memory, found: list[Found], a: tuple, b: tuple, setup: Setup, rules: Rules
) -> tuple[tuple, tuple, Solved]:
    """Both sides after the biased solve, and the row. A side is its motion, drift and work."""
    (motion_a, drift_a, _), (motion_b, drift_b, work) = a, b
    points = [_met(row, at, a[:2], b[:2], setup, rules.step) for at in found]
    both = _both(row, points, [relative(p.grip, p.normal, motion_a, motion_b)[0] for p in points])

    def press(i: int, touch: Touch, speed: Array, old: Impulse) -> Array:
        alone = biased(row, touch, speed, old, rules)
        together = both[i]
        return alone if together is None else jnp.where(together >= 0, old.normal + together, alone)

    was = Solved(points, kept(memory.impulses), memory.roll)
    new_a, new_b, solved, work = _exchange(row, was, press, motion_a, motion_b, work, setup.one)
    pushes = _pushes(row, points, solved.impulses, drift_a, drift_b, rules)
    drift_b = _drifted(drift_b, points, pushes, motion_b, new_b)
    if row.a is not None and drift_a is not None and new_a is not None:
        drift_a = _drifted(drift_a, points, pushes, motion_a, new_a)
    new_b, drift_b = settled((new_b, drift_b), setup.one) if row.firm else (new_b, drift_b)
    return (new_a, drift_a, a[2]), (new_b, drift_b, work), solved


JOLT = 1.0  # m/s: what is faster than this is an impact, also in a pile


def _left(at: Touch, bounced: Array, impulse: Impulse) -> Impulse:
    """What the next step starts with.

    An impact may not warm-start it: its impulse is negative, for `kept` to drop, but if the two were in contact it is
    told, so that a pile that was taken for one is not for ever.
    """
    told = jnp.minimum(impulse.normal, JOLT * at.grip.normal_mass)
    normal = jnp.where(bounced, jnp.where(at.gap <= 0, -told, 0.0), impulse.normal)
    return Impulse(normal, jnp.where(bounced, 0.0, impulse.tangent))


def kept(impulses: list[Impulse]) -> list[Impulse]:
    """What warm-starts a step, of what the last one left."""
    return [Impulse(jnp.maximum(i.normal, 0.0), i.tangent) for i in impulses]


def relax(row: Row, solved: Solved, a: tuple, b: tuple, setup: Setup) -> tuple[tuple, tuple, tuple[Solved, Memory]]:
    """Both sides after the relaxing solve, the row, and what it leaves to the next step.

    A side is its motion, the push of its drift, and its work.
    """
    (motion_a, push_a, _), (motion_b, push_b, work), again = a, b, []

    def press(_: int, touch: Touch, speed: Array, old: Impulse) -> Array:
        threshold = _threshold(touch, jnp.where(touch.tau < 0, old.normal, 0.0), push_a, push_b, setup)
        again.append(struck(touch, speed, threshold))
        return relaxed(row, touch, speed, old, threshold)

    new_a, new_b, now, work = _exchange(row, solved, press, motion_a, motion_b, work, setup.one)
    left = []
    for at, hit, impulse in zip(now.touches, again, now.impulses, strict=True):
        left.append(_left(at, (at.tau >= 0) | hit, impulse))
    left = settled(left, setup.one)
    new_b = settled(new_b, setup.one) if row.firm else new_b
    return (new_a, *a[1:]), (new_b, push_b, work), (now, Memory(left, now.roll))


def touching(solved: Solved, last: Solved) -> Array:
    """Whether anything pressed the two of a row together in a step, in its biased solve or in its last one."""
    pressed = [i.normal > 0 for row in (solved, last) for i in row.impulses]
    return functools.reduce(jnp.logical_or, pressed)


def seen(solved: Solved, memory: Memory) -> tuple[Array, Array]:
    """A row's deepest overlap, m, and whether a contact began; a bounce begins one."""
    depth = jnp.zeros_like(solved.touches[0].gap)
    for touch in solved.touches:
        depth = jnp.maximum(depth, jnp.where(touch.grip.normal_mass > 0, -touch.gap, 0.0))
    now, before = (sum(i.normal for i in x[1:]) + x[0].normal for x in (solved.impulses, memory.impulses))
    return depth, (now > 0) & (before == 0)


def kept_in(ways: list[Motion], shapes: list, walls: list[Stadium]) -> list[Motion]:
    """The ways, none of which takes a disc deeper than half of its radius into a segment that stands still.

    A body meets each row once in a step, so one that is very fast, or wedged in, may be thrown back through a wall that
    it has met before. It is left where it is, or at the first wall on its way. Nothing of the kind can happen where no
    way is as long as a quarter of a radius and no overlap as deep as a half.
    """
    lines = [(wall, g) for wall in walls for g, shape in enumerate(shapes) if isinstance(shape, Disc)]
    if not lines:
        return ways
    risky = [_risky(ways[g].velocity, wall, shapes[g]) for wall, g in lines]
    some = jnp.any(jnp.stack([jnp.any(x) for x in risky]))
    return jax.lax.cond(some, lambda: _kept_in(ways, shapes, lines, risky), lambda: ways)


def _risky(way: Array, a: Stadium, b: Disc) -> Array:
    offset = b.centre - a.centre
    deep = jnp.abs(dot(turned(a.direction), offset)) < a.radius + 0.5 * b.radius
    deep = deep & (jnp.abs(dot(a.direction, offset)) <= a.half_length + 0.9 * b.radius)
    return (16 * dot(way, way) > b.radius**2) | deep


def _kept_in(ways: list[Motion], shapes: list, lines: list[tuple[Stadium, int]], risky: list[Array]) -> list[Motion]:
    parts = [jnp.ones_like(way.spin) for way in ways]  # of its way that a body goes
    for (a, g), may in zip(lines, risky, strict=True):
        b, way = shapes[g], ways[g].velocity
        normal, offset = turned(a.direction), b.centre - a.centre
        aside, across = dot(normal, offset), dot(normal, way)
        left = jnp.sign(aside) * (aside + across) - a.radius - b.radius
        through = (aside * across < 0) & (left < -0.5 * b.radius)
        share = aside / jnp.where(through, -across, 1.0)  # where its centre is on the line
        through = through & (jnp.abs(dot(a.direction, offset + share * way)) <= a.half_length + 0.9 * b.radius)
        through = through & may  # so that what other scenes do does not count
        room = jnp.maximum(1 - (a.radius + b.radius) / jnp.maximum(jnp.abs(aside), SLOWEST), 0.0)
        parts[g] = jnp.minimum(parts[g], jnp.where(through, share * room, 1.0))
    return [Motion(part * way.velocity, way.spin) for part, way in zip(parts, ways, strict=True)]
