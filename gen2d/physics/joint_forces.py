"""What joints do beyond holding anchors in place: springs, and the limits and motors of hinges, in rounds.

A spring is not a constraint but a force: the mean of what it is at both ends of the step, found implicitly and acting
at half of the step, which keeps the energy of a linear spring exactly and is stable at any stiffness (the implicit
midpoint rule). What is rigid, rods and the points of hinges, is solved all at once: linkage.py.

A round is some joints of one kind that share no moving body, solved at once; so a chain of any length takes two, and a
program does not grow with it. Bodies lie in a table: those of all groups, then the fixed ones.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.collision import dot, turned
from gen2d.physics.constraint import Inertia, Motion, reciprocal
from gen2d.physics.energy import Work
from gen2d.physics.params import SolverParams
from gen2d.records.axes import Array
from gen2d.records.layout import JointSpec
from gen2d.xla import materialize

HERTZ, DAMPING_RATIO = 60.0, 5.0  # of limits (E. Catto, 'Solver2D', 2024)
SHORTEST = 1e-6  # m: a shorter rod has no direction


class JointSide(NamedTuple):
    """One of the two bodies of each of some joints."""

    lines: np.ndarray  # [P] in the table of bodies
    fixed: np.ndarray  # [P] bool: whether it is a fixed one
    inertia: Inertia  # [P, ...]; zero of a fixed one
    anchor: Array  # [2, P, ...] m, in the body's frame


class JointBatch(NamedTuple):
    """What stays the same of some joints, each [P, ...]. A distance joint is a spring where its stiffness is finite."""

    kind: str
    a: JointSide
    b: JointSide
    there: Array
    rest: Array
    stiffness: Array
    damping: Array
    lower: Array
    upper: Array
    motor_speed: Array
    motor_torque: Array


class JointState(NamedTuple):
    """The joints of a round in this step."""

    tied: JointBatch
    arm_a: Array  # [2, P, ...] m
    arm_b: Array
    apart: Array  # [2, P, ...] m: from a's anchor to b's
    angle: Array  # [P, ...] rad: b's over a's, beyond that at rest
    impulses: tuple[Array, ...]


def joint_rounds(ties: Sequence[JointSpec], moving: int) -> list[list[int]]:
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


def zero_impulses(tied: JointBatch) -> tuple[Array, ...]:
    """The impulses of joints that have done nothing: of a hinge, at both limits and by the motor."""
    return (jnp.zeros_like(tied.rest),) * (0 if tied.kind == "distance" else 3)


def table_of(groups: Sequence[Any], fixed: Sequence[Any]) -> Any:
    """The bodies' values one after the other, [..., N, n]."""
    return jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *groups, *fixed)


def joint_lines(table: Any, lines: np.ndarray) -> Any:
    """The table's values of these bodies."""
    return jax.tree.map(lambda x: x[..., lines, :], table)


def groups_of(table: Any, groups: list[Any]) -> list[Any]:
    """The groups' part of a table."""
    ends = list(itertools.accumulate((jax.tree.leaves(group)[0].shape[-2] for group in groups), initial=0))
    return [jax.tree.map(lambda x, span=slice(*span): x[..., span, :], table) for span in itertools.pairwise(ends)]


def rotated(vector: Array, angle: Array) -> Array:
    """Vectors [2, ...] turned by an angle."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])


def direction_of(apart: Array) -> tuple[Array, Array]:
    """Unit direction and length, finite at zero."""
    squared = dot(apart, apart)
    length = jnp.sqrt(jnp.where(squared > SHORTEST**2, squared, 1.0))
    return jnp.where(squared > SHORTEST**2, apart / length, 0.0), jnp.where(squared > SHORTEST**2, length, 0.0)


def anchors_of(a: JointSide, b: JointSide, places: Any) -> tuple[Array, Array, Array]:
    """Both arms, and how far the anchors are apart, m [2, P, ...]; of a table of positions and angles."""
    (place_a, angle_a), (place_b, angle_b) = (joint_lines(places, end.lines) for end in (a, b))
    arm_a, arm_b = materialize((rotated(a.anchor, angle_a), rotated(b.anchor, angle_b)))
    return arm_a, arm_b, place_b + arm_b - place_a - arm_a


def _with(table: Any, held: JointState, a: Any, b: Any) -> Any:
    """The table with both bodies of each joint put back into it."""

    def put(x: Array, new_a: Array, new_b: Array) -> Array:
        count, lines = x.shape[-2], np.concatenate([held.tied.a.lines, held.tied.b.lines])
        order = np.arange(count)
        order[lines] = count + np.arange(len(lines))  # of a fixed one any, as it stays as it is
        return jnp.concatenate([x, new_a, new_b], axis=-2)[..., order, :]

    return jax.tree.map(put, table, a, b)


def _pushed(end: JointSide, arm: Array, motion: Motion, push: Array) -> Motion:
    """The motion after an impulse at an arm."""
    turn = end.inertia.moment * dot(turned(arm), push)
    return Motion(motion.velocity + end.inertia.mass * push, motion.spin + turn)


def _total(x: Array) -> Array:
    """The sum over a round, [1, ...]."""
    return jnp.sum(x, axis=-2, keepdims=True)


def warm_start(
    ties: list[JointBatch], bodies: list[Any], fixed: list[Any], motions: list[Motion], memory: list[tuple]
) -> tuple:
    """Every round as it stands, the motions with its last impulses, and the work done."""
    if not ties:
        return [], motions, []
    places = table_of(*([(body.position, body.angle) for body in some] for some in (bodies, fixed)))
    now, held, works = table_of(motions, [body.motion for body in fixed]), [], []
    for tied, impulses in zip(ties, memory, strict=True):
        angle_a, angle_b = (joint_lines(places[1], end.lines) for end in (tied.a, tied.b))
        angle = angle_b - angle_a - tied.rest
        joint = JointState(tied, *anchors_of(tied.a, tied.b, places), angle, impulses)
        held.append(joint)
        if tied.kind != "distance":
            book = _Turns(joint, now)
            book.apply(impulses[0] - impulses[1])
            book.apply(impulses[2], motor=True)
            now = _with(now, joint, book.a, book.b)
            works.append(book.work)
    return held, groups_of(now, motions), works


def solve(
    held: list[JointState],
    motions: list[Motion],
    ways: list[Motion],
    falls: list[Array],
    fixed: list[Any],
    rules: SolverParams,
    biased: bool,
) -> tuple:
    """Every round after a pass, motions and ways (what a body goes beyond its velocity), and the work done."""
    if not held:
        return [], motions, ways, []
    still = [body.motion for body in fixed]
    now, way = table_of(motions, still), table_of(ways, [jax.tree.map(jnp.zeros_like, motion) for motion in still])
    fall = table_of(falls, [jnp.zeros_like(motion.velocity) for motion in still])
    done, works = [], []
    for joint in held:
        if joint.tied.kind != "distance":
            book = _Turns(joint, now)
            joint = joint._replace(impulses=_turn(joint, book, rules, biased))
            now = _with(now, joint, book.a, book.b)
            works.append(book.work)
        elif biased:
            now, way, work = _spring(joint, now, way, fall, rules.step)
            works.append(work)
        done.append(joint)
    return done, groups_of(now, motions), groups_of(way, ways), works


class _Turns:
    """Both bodies' motions while angular impulses of a round of hinges are applied, and the work that these do.

    What is found is settled, or a CPU computes each impulse again for all that come after it, and takes minutes to
    compile two hinges.
    """

    def __init__(self, held: JointState, motions: Motion) -> None:
        self.held = held
        self.a, self.b = joint_lines(motions, held.tied.a.lines), joint_lines(motions, held.tied.b.lines)
        self._lost, self._driven = jnp.zeros_like(held.angle), jnp.zeros_like(held.angle)

    @property
    def speed(self) -> Array:
        """Spin of b over a."""
        return self.b.spin - self.a.spin

    @property
    def work(self) -> Work:
        """What has been done so far."""
        return Work(_total(self._lost), _total(self._driven), None)

    def apply(self, twist: Array, motor: bool = False) -> None:
        """Applies an angular impulse on b and its reaction on a; books their work."""
        tied, before = self.held.tied, self.speed
        twist, before = materialize((twist, before))
        spins = (
            self.a.spin - tied.a.inertia.moment * twist,
            self.b.spin + tied.b.inertia.moment * twist,
        )
        spin_a, spin_b = materialize(spins)
        self.a, self.b = self.a._replace(spin=spin_a), self.b._replace(spin=spin_b)
        gained = 0.5 * twist * (before + self.speed)
        if motor:
            self._driven = self._driven + gained
        else:
            self._lost = self._lost - gained
        for end, motion, sign in ((tied.a, self.a, -1), (tied.b, self.b, 1)):
            if end.fixed.any():  # what moves as it likes does work where it is held
                self._driven = self._driven - sign * jnp.where(end.fixed[:, None], motion.spin * twist, 0.0)


def _turn(joint: JointState, book: _Turns, rules: SolverParams, biased: bool) -> tuple[Array, ...]:
    """The impulses of hinges at both limits and by the motor after a pass."""
    tied, (low, high, motor) = joint.tied, joint.impulses
    rate, mass_scale, impulse_scale = rules.softness(HERTZ, DAMPING_RATIO) if biased else (0.0, 1.0, 0.0)
    k = tied.a.inertia.moment + tied.b.inertia.moment
    mass = reciprocal(k, tied.there & (k > 0))
    bound = rules.step * tied.motor_torque
    new_motor = jnp.clip(motor - mass * (book.speed - tied.motor_speed), -bound, bound)
    book.apply(new_motor - motor, motor=True)
    news = []
    for old, sign, room in ((low, 1, joint.angle - tied.lower), (high, -1, tied.upper - joint.angle)):
        limited = jnp.isfinite(room)
        room = jnp.where(limited, room, 1.0)
        bias = jnp.where(room > 0, room / rules.step, rate * room)
        scale, keep = jnp.where(room > 0, 1.0, mass_scale), jnp.where(room > 0, 0.0, impulse_scale)
        new = jnp.maximum(old - scale * mass * (sign * book.speed + bias) - keep * old, 0.0)
        news.append(jnp.where(limited, new, 0.0))
        book.apply(sign * (news[-1] - old))
    return *news, new_motor


def _spring(joint: JointState, now: Motion, way: Motion, fall: Array, h: float) -> tuple[Motion, Motion, Work]:
    """Motions and ways with an impulse at half of the step, and the work that it took from the motion.

    What the spring holds of that is taken off when the books are closed.
    """
    tied = joint.tied
    soft = tied.there & jnp.isfinite(tied.stiffness)
    k, c = (jnp.where(soft, x, 0.0) for x in (tied.stiffness, tied.damping))
    ends = (tied.a, joint.arm_a, -1), (tied.b, joint.arm_b, 1)
    axis, length = direction_of(joint.apart)
    olds = [joint_lines(now, end.lines) for end, *_ in ends]
    inverse = sum(end.inertia.mass + end.inertia.moment * dot(turned(arm), axis) ** 2 for end, arm, _ in ends)

    def closing(motions: list[Motion]) -> Array:
        of_a, of_b = (m.velocity + m.spin * turned(arm) for m, (_, arm, _) in zip(motions, ends, strict=True))
        return dot(axis, of_b - of_a)

    speed = closing(olds)
    stretch = length - tied.rest + 0.5 * h * speed
    pushed = -h * (k * stretch + c * speed) / (1 + inverse * h * (0.25 * h * k + 0.5 * c))
    pushed, axis = materialize((pushed, axis))
    push = pushed * axis
    news = [_pushed(end, arm, old, sign * push) for (end, arm, sign), old in zip(ends, olds, strict=True)]
    lost = -0.5 * pushed * (speed + closing(news))
    driven = jnp.zeros_like(lost)
    for (end, arm, sign), motion in zip(ends, news, strict=True):
        if end.fixed.any():  # what moves as it likes does work where it is held
            work = dot(motion.velocity + motion.spin * turned(arm), push)
            driven = driven - sign * jnp.where(end.fixed[:, None], work, 0.0)
    # What it changes in the fall is its own, not the contacts'.
    aside = jnp.zeros_like(lost)
    for end, _, sign in ends:
        aside = aside + 0.5 * h * sign * dot(joint_lines(fall, end.lines), push)
    gone = [_pushed(end, arm, joint_lines(way, end.lines), -0.5 * h * sign * push) for end, arm, sign in ends]
    work = Work(_total(-aside), _total(driven), _total(lost + aside))
    return _with(now, joint, *news), _with(way, joint, *gone), work


def springs_energy(ties: list[JointBatch], bodies: list[Any], fixed: list[Any]) -> Array | float:
    """What all springs hold now, J [...]: k x^2 / 2 each."""
    soft = [tied for tied in ties if tied.kind == "distance"]
    if not soft:
        return 0.0
    places, energy = table_of(*([(body.position, body.angle) for body in some] for some in (bodies, fixed))), 0.0
    for tied in soft:
        length = direction_of(anchors_of(tied.a, tied.b, places)[2])[1]
        stiffness = jnp.where(tied.there & jnp.isfinite(tied.stiffness), tied.stiffness, 0.0)
        energy = energy + jnp.sum(0.5 * stiffness * (length - tied.rest) ** 2, axis=-2)
    return energy
