"""Joints: rigid rods, springs, hinges with limits and motors, solved one round after the other before the contacts.

A rod keeps the distance of two anchors, a hinge ('revolute') keeps them in one place; both are soft constraints at
60 Hz (E. Catto, 'Solver2D', 2024), warm-started and relaxed like contacts. A spring is not a constraint but a force:
the mean of what it is at both ends of the step, found implicitly and acting at half of the step, which keeps the energy
of a linear spring exactly and is stable at any stiffness (the implicit midpoint rule).

A round is some joints of one kind that share no moving body, solved at once; so a chain of any length takes two, and a
program does not grow with it. Bodies lie in a table: those of all groups, then the fixed ones.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.contacts import dot, turned
from gen2d.ledger import Work
from gen2d.rows import Inertia, Motion, Rules, reciprocal
from gen2d.tournament import settled
from gen2d.types import Array, Tie

HERTZ, DAMPING_RATIO = 60.0, 5.0  # of rigid joints; at 120 Hz a light chain with a heavy end explodes
SHORTEST = 1e-6  # m: a shorter rod has no direction


class End(NamedTuple):
    """One of the two bodies of each joint in a round."""

    lines: np.ndarray  # [P] in the table of bodies
    fixed: np.ndarray  # [P] bool: whether it is a fixed one
    inertia: Inertia  # [P, ...]; zero of a fixed one
    anchor: Array  # [2, P, ...] m, in the body's frame


class Tied(NamedTuple):
    """What stays the same of the joints of a round, each [P, ...]. A distance joint is a spring where its stiffness is
    finite."""

    kind: str
    a: End
    b: End
    there: Array
    rest: Array
    stiffness: Array
    damping: Array
    lower: Array
    upper: Array
    motor_speed: Array
    motor_torque: Array


class Held(NamedTuple):
    """The joints of a round in this step."""

    tied: Tied
    arm_a: Array  # [2, P, ...] m
    arm_b: Array
    apart: Array  # [2, P, ...] m: from a's anchor to b's
    angle: Array  # [P, ...] rad: b's over a's, beyond that at rest
    impulses: tuple[Array, ...]


def rounds(ties: Sequence[Tie], moving: int) -> list[list[int]]:
    """The numbers of the joints of each round: every joint is in the first of its kind in which both of its bodies are
    free. They are named by their lines in the table, of which those below `moving` are moving bodies."""
    found: list[tuple[str, set[int], list[int]]] = []
    for number, tie in enumerate(ties):
        ours = {line for line in (tie.a, tie.b) if line < moving}
        place = next((r for r in found if r[0] == tie.kind and not r[1] & ours), None)
        if place is None:
            place = tie.kind, set(), []
            found.append(place)
        place[1].update(ours)
        place[2].append(number)
    return [numbers for *_, numbers in found]


def nothing(tied: Tied) -> tuple[Array, ...]:
    """The impulses of joints that have done nothing.

    A rod has one, along it; a hinge has five: along x and y, at both limits, and by the motor.
    """
    return (jnp.zeros_like(tied.rest),) * (1 if tied.kind == "distance" else 5)


def _table(groups: Sequence[Any], fixed: Sequence[Any]) -> Any:
    """The bodies' values one after the other, [..., N, n]."""
    return jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *groups, *fixed)


def _at(table: Any, lines: np.ndarray) -> Any:
    return jax.tree.map(lambda x: x[..., lines, :], table)


def _with(table: Any, held: Held, a: Any, b: Any) -> Any:
    """The table with both bodies of each joint put back into it."""

    def put(x: Array, new_a: Array, new_b: Array) -> Array:
        count, lines = x.shape[-2], np.concatenate([held.tied.a.lines, held.tied.b.lines])
        order = np.arange(count)
        order[lines] = count + np.arange(len(lines))  # of a fixed one any, as it stays as it is
        return jnp.concatenate([x, new_a, new_b], axis=-2)[..., order, :]

    return jax.tree.map(put, table, a, b)


def _groups(table: Any, groups: list[Any]) -> list[Any]:
    """The groups' part of a table."""
    ends = list(itertools.accumulate((jax.tree.leaves(group)[0].shape[-2] for group in groups), initial=0))
    return [jax.tree.map(lambda x, span=slice(*span): x[..., span, :], table) for span in itertools.pairwise(ends)]


def _turned(vector: Array, angle: Array) -> Array:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])


def _pushed(end: End, arm: Array, motion: Motion, push: Array | None, twist: Array | None) -> Motion:
    """The motion after an impulse at an arm, and an angular one beside it."""
    velocity = motion.velocity if push is None else motion.velocity + end.inertia.mass * push
    return Motion(velocity, motion.spin + end.inertia.moment * _twist(arm, push, twist))


def _twist(arm: Array, push: Array | None, twist: Array | None) -> Array:
    """The angular impulse of an impulse at an arm and an angular one; not both are None."""
    if push is None:
        assert twist is not None
        return twist
    return dot(turned(arm), push) if twist is None else dot(turned(arm), push) + twist


def _reaction(impulse: Array | None) -> Array | None:
    return None if impulse is None else -impulse


def _speed(held: Held, a: Motion, b: Motion) -> tuple[Array, Array]:
    """Velocity of b's anchor over a's, and spin of b over a."""
    of_a, of_b = (m.velocity + m.spin * turned(arm) for m, arm in ((a, held.arm_a), (b, held.arm_b)))
    return of_b - of_a, b.spin - a.spin


def _k(held: Held, direction: Array) -> Array:
    """Speed along a direction that a unit impulse along it gives, 1/kg."""
    k = jnp.zeros_like(held.tied.rest)
    for end, arm in ((held.tied.a, held.arm_a), (held.tied.b, held.arm_b)):
        k = k + end.inertia.mass + end.inertia.moment * dot(turned(arm), direction) ** 2
    return k


def _over(x: Array, usable: Array) -> Array:
    return reciprocal(x, usable & (x > 0))


def _along(apart: Array) -> tuple[Array, Array]:
    """Unit direction and length, finite at zero."""
    squared = dot(apart, apart)
    length = jnp.sqrt(jnp.where(squared > SHORTEST**2, squared, 1.0))
    return jnp.where(squared > SHORTEST**2, apart / length, 0.0), jnp.where(squared > SHORTEST**2, length, 0.0)


def _total(x: Array) -> Array:
    """The sum over a round, [1, ...]."""
    return jnp.sum(x, axis=-2, keepdims=True)


class _Book:
    """Both bodies' motions while the impulses of a round are applied, and the work that these do, each [P, ...].

    `one` is 1.0 in a way that the compiler cannot know: else a CPU computes each impulse again for all that come after
    it, and takes minutes to compile two hinges.
    """

    def __init__(self, held: Held, motions: Motion, one: Array) -> None:
        self.held, self.one = held, one
        self.a, self.b = _at(motions, held.tied.a.lines), _at(motions, held.tied.b.lines)
        self.lost, self.driven = jnp.zeros_like(held.angle), jnp.zeros_like(held.angle)

    @property
    def speed(self) -> tuple[Array, Array]:
        """Velocity of b's anchor over a's, and spin of b over a."""
        return _speed(self.held, self.a, self.b)

    def apply(self, push: Array | None, twist: Array | None, motor: bool = False) -> None:
        """Applies an impulse on b at its anchor, an angular one beside it, and their reactions on a; books their
        work."""
        held, before = self.held, self.speed
        push, twist, before = settled((push, twist, before), self.one)
        back = _reaction(push), _reaction(twist)
        moved = (
            _pushed(held.tied.a, held.arm_a, self.a, *back), _pushed(held.tied.b, held.arm_b, self.b, push, twist)
        )  # fmt: skip
        self.a, self.b = settled(moved, self.one)
        sums = [x + y for x, y in zip(before, self.speed, strict=True)]
        parts = [dot(push, sums[0])] if push is not None else []
        parts += [twist * sums[1]] if twist is not None else []
        gained = 0.5 * sum(parts[1:], parts[0])
        if motor:
            self.driven = self.driven + gained
        else:
            self.lost = self.lost - gained
        for end, arm, motion, sign in ((held.tied.a, held.arm_a, self.a, -1), (held.tied.b, held.arm_b, self.b, 1)):
            if end.fixed.any():  # what moves as it likes does work where it is held
                work = motion.spin * _twist(arm, push, twist)
                work = work if push is None else work + dot(motion.velocity, push)
                self.driven = self.driven - sign * jnp.where(end.fixed[:, None], work, 0.0)


def warm(
    ties: list[Tied], bodies: list[Any], fixed: list[Any], motions: list[Motion], memory: list[tuple], one: Array
) -> tuple:
    """Every round as it stands, the motions with its last impulses, and the work done."""
    if not ties:
        return [], motions, []
    places = _table(*([(body.position, body.angle) for body in some] for some in (bodies, fixed)))
    now, held, works = _table(motions, [body.motion for body in fixed]), [], []
    for tied, impulses in zip(ties, memory, strict=True):
        (place_a, angle_a), (place_b, angle_b) = (_at(places, end.lines) for end in (tied.a, tied.b))
        arm_a, arm_b = settled((_turned(tied.a.anchor, angle_a), _turned(tied.b.anchor, angle_b)), one)
        apart = place_b + arm_b - place_a - arm_a
        joint = Held(tied, arm_a, arm_b, apart, angle_b - angle_a - tied.rest, impulses)
        book = _Book(joint, now, one)
        if tied.kind == "distance":
            book.apply(impulses[0] * _along(apart)[0], None)
        else:
            book.apply(jnp.stack(impulses[:2]), impulses[2] - impulses[3])
            book.apply(None, impulses[4], motor=True)
        now = _with(now, joint, book.a, book.b)
        held.append(joint)
        works.append(Work(_total(book.lost), _total(book.driven), None))
    return held, _groups(now, motions), works


def solve(
    held: list[Held],
    motions: list[Motion],
    ways: list[Motion],
    falls: list[Array],
    fixed: list[Any],
    rules: Rules,
    one: Array,
    biased: bool,
) -> tuple:
    """Every round after a pass, motions and ways (what a body goes beyond its velocity), and the work done."""
    if not held:
        return [], motions, ways, []
    still = [body.motion for body in fixed]
    goes = [jax.tree.map(lambda x: rules.step * x, motion) for motion in still]
    now, way = _table(motions, still), _table(ways, goes)
    fall = _table(falls, [jnp.zeros_like(motion.velocity) for motion in still])
    done, works = [], []
    for joint in held:
        joint = joint if biased else _moved(joint, way, one)
        book = _Book(joint, now, one)
        if joint.tied.kind == "distance":
            impulses, spring = _rod(joint, book, rules, biased), None
            if biased:
                way, spring = _spring(joint, book, way, fall, rules.step)
            works.append(Work(_total(book.lost), _total(book.driven), spring))
        else:
            impulses = _hinge(joint, book, rules, biased)
            works.append(Work(_total(book.lost), _total(book.driven), None))
        done.append(joint._replace(impulses=impulses))
        now = _with(now, joint, book.a, book.b)
    return done, _groups(now, motions), _groups(way, ways), works


def _moved(joint: Held, way: Motion, one: Array) -> Held:
    """The joints as they stand after the bodies have gone their ways."""
    arms, apart = [], joint.apart
    for end, arm, sign in ((joint.tied.a, joint.arm_a, -1), (joint.tied.b, joint.arm_b, 1)):
        gone = _at(way, end.lines)
        arms.append(settled(_turned(arm, gone.spin), one))
        apart = apart + sign * (gone.velocity + arms[-1] - arm)
    return joint._replace(arm_a=arms[0], arm_b=arms[1], apart=apart)


def _curve(joint: Held, book: _Book, h: float) -> Array:
    """How much faster the anchors part over a step than at its start, m/s, as their arms turn meanwhile.

    A pass that knows of it, and a second pass at the new arms, are RATTLE (H. C. Andersen, 1983): a pendulum keeps its
    energy, while the straight line at the start leaves the circle and loses (h spin)^2 of it in every step.
    """
    aside = jnp.zeros_like(joint.apart)
    for motion, arm, sign in ((book.a, joint.arm_a, -1), (book.b, joint.arm_b, 1)):
        turn = h * motion.spin
        beyond = (jnp.sin(turn) - turn) * turned(arm) - 2 * jnp.sin(turn / 2) ** 2 * arm
        aside = aside + sign / h * beyond
    return aside


def _rod(joint: Held, book: _Book, rules: Rules, biased: bool) -> tuple[Array, ...]:
    tied, (old,) = joint.tied, joint.impulses
    rate, mass_scale, impulse_scale = rules.softness(HERTZ, DAMPING_RATIO) if biased else (0.0, 1.0, 0.0)
    axis, length = _along(joint.apart)
    velocity = book.speed[0]
    speed = dot(axis, velocity)
    if biased:
        mean = velocity + _curve(joint, book, rules.step)
        way = rules.step * mean
        speed = dot(2 * joint.apart + way, mean) / jnp.maximum(_along(joint.apart + way)[1] + length, SHORTEST)
    mass = _over(_k(joint, axis), tied.there & ~jnp.isfinite(tied.stiffness))
    new = old - mass_scale * mass * (speed + rate * (length - tied.rest)) - impulse_scale * old
    new = jnp.where(mass > 0, new, 0.0)
    book.apply((new - old) * axis, None)
    return (new,)


def _spring(joint: Held, book: _Book, way: Motion, fall: Array, h: float) -> tuple[Motion, Array]:
    """The ways with an impulse at half of the step, and the work that it took from the motion.

    What the spring holds of that is taken off when the books are closed.
    """
    tied = joint.tied
    soft = tied.there & jnp.isfinite(tied.stiffness)
    k, c = (jnp.where(soft, x, 0.0) for x in (tied.stiffness, tied.damping))
    axis, length = _along(joint.apart)
    speed, inverse = dot(axis, book.speed[0]), _k(joint, axis)
    stretch = length - tied.rest + 0.5 * h * speed
    push = -h * (k * stretch + c * speed) / (1 + inverse * h * (0.25 * h * k + 0.5 * c)) * axis
    lost = book.lost
    book.apply(push, None)
    ends = ((tied.a, joint.arm_a, -1), (tied.b, joint.arm_b, 1))
    aside = sum((0.5 * h * sign * dot(_at(fall, end.lines), push) for end, _, sign in ends), jnp.zeros_like(push[0]))
    spent = book.lost - lost + aside
    book.lost = lost - aside  # what it changes in the fall is its own, not the contacts'
    gone = (_pushed(end, arm, _at(way, end.lines), -0.5 * h * sign * push, None) for end, arm, sign in ends)
    return _with(way, joint, *gone), _total(spent)


def springs_energy(ties: list[Tied], bodies: list[Any], fixed: list[Any]) -> Array | float:
    """What all springs hold now, J [...]: k x^2 / 2 each."""
    soft = [tied for tied in ties if tied.kind == "distance"]
    if not soft:
        return 0.0
    places, energy = _table(*([(body.position, body.angle) for body in some] for some in (bodies, fixed))), 0.0
    for tied in soft:
        (place_a, angle_a), (place_b, angle_b) = (_at(places, end.lines) for end in (tied.a, tied.b))
        length = _along(place_b + _turned(tied.b.anchor, angle_b) - place_a - _turned(tied.a.anchor, angle_a))[1]
        stiffness = jnp.where(tied.there & jnp.isfinite(tied.stiffness), tied.stiffness, 0.0)
        energy = energy + jnp.sum(0.5 * stiffness * (length - tied.rest) ** 2, axis=-2)
    return energy


def _hinge(joint: Held, book: _Book, rules: Rules, biased: bool) -> tuple[Array, ...]:
    tied, (x, y, low, high, motor) = joint.tied, joint.impulses
    rate, mass_scale, impulse_scale = rules.softness(HERTZ, DAMPING_RATIO) if biased else (0.0, 1.0, 0.0)
    turn_mass = _over(tied.a.inertia.moment + tied.b.inertia.moment, tied.there)
    spin = book.speed[1]
    bound = rules.step * tied.motor_torque
    new_motor = jnp.clip(motor - turn_mass * (spin - tied.motor_speed), -bound, bound)
    book.apply(None, new_motor - motor, motor=True)
    news = []
    for old, sign, room in ((low, 1, joint.angle - tied.lower), (high, -1, tied.upper - joint.angle)):
        limited = jnp.isfinite(room)
        room = jnp.where(limited, room, 1.0)
        speed = sign * book.speed[1]
        bias = jnp.where(room > 0, room / rules.step, rate * room)
        scale, keep = jnp.where(room > 0, 1.0, mass_scale), jnp.where(room > 0, 0.0, impulse_scale)
        new = jnp.maximum(old - scale * turn_mass * (speed + bias) - keep * old, 0.0)
        news.append(jnp.where(limited, new, 0.0))
        book.apply(None, sign * (news[-1] - old))
    velocity = book.speed[0]
    if biased:
        velocity = velocity + rate * joint.apart + _curve(joint, book, rules.step)
    push = _point_push(joint, velocity)
    old = jnp.stack([x, y])
    added = jnp.where(tied.there, mass_scale * push - impulse_scale * old, 0.0)
    book.apply(added, None)
    return *(old + added), *news, new_motor


def _point_push(joint: Held, velocity: Array) -> Array:
    """The impulse that takes away the anchors' relative velocity: the inverse of a symmetric matrix."""
    kxx = kxy = kyy = jnp.zeros_like(joint.angle)
    for end, (rx, ry) in ((joint.tied.a, joint.arm_a), (joint.tied.b, joint.arm_b)):
        m, i = end.inertia
        kxx, kxy, kyy = kxx + m + i * ry * ry, kxy - i * rx * ry, kyy + m + i * rx * rx
    one_over = _over(kxx * kyy - kxy * kxy, joint.tied.there)
    x, y = velocity
    return -one_over * jnp.stack([kyy * x - kxy * y, kxx * y - kxy * x])
