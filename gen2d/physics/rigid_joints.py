"""Rigid joints, solved all at once: rods keep the distance of two anchors, hinges keep them in one place.

One joint after the other, as contacts are solved, a light body between heavy ones stretches: what a pass leaves shrinks
by a hundredth where the masses are as 100 to 1. So each pass solves the whole system J M^-1 J^T x = b, a row for each
rod and two for each hinge. Rows share a body only with few others; in the order that reverse Cuthill-McKee gives them
the matrix is a narrow band (of four for a chain of any length), and L D L^T of a band takes one loop over its rows.

A step with these passes is RATTLE (H. C. Andersen, 1983), which keeps a pendulum's energy: the first makes the anchors
meet at the end of the step, with the turn of the arms meanwhile, the second takes away the speed with which they would
part there. Contacts come before, so joints have the last word.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.banded import factor, solve_factored
from gen2d.physics.collision import dot, turned
from gen2d.physics.constraint import Inertia, Motion
from gen2d.physics.energy import Work
from gen2d.physics.joint_forces import JointSide, anchors_of, direction_of, groups_of, joint_lines, table_of
from gen2d.records.axes import Array
from gen2d.records.layout import JointSpec
from gen2d.xla import materialize

X, Y, ALONG, ACROSS = range(4)  # the direction of a row
COMPLIANCE = 1e-5  # of a row's own term, as softness: what keeps the impulses of joints bounded that say the same twice
NEWTON_ITERATIONS = 2  # times: one leaves a fast double pendulum three times the error of energy
FASTEST = 10.0  # m/s: anchors that are apart come together no faster


@dataclasses.dataclass(frozen=True)
class JointSystemPlan:
    """Which rows there are and what they share; R rows of J joints in a table with N moving bodies."""

    joint: np.ndarray  # [R] whose row it is
    way: np.ndarray  # [R] X, Y or ALONG; ACROSS: the line from another hinge of the same two bodies
    other: np.ndarray  # [R] that hinge
    lines: tuple[np.ndarray, np.ndarray]  # [J] of both bodies
    moving: int  # N

    @property
    def ends(self) -> np.ndarray:
        """The bodies of each row, [2, R]; -1: a fixed one."""
        ends = np.stack(self.lines)[:, self.joint]
        return np.where(ends < self.moving, ends, -1)

    def shared(self, offset: int) -> list[tuple[int, int, np.ndarray]]:
        """Which sides of a row and of the one so many rows later are the same body: both sides and, by row, 1 where
        both have the same sign there, -1 where not, 0 where they are two bodies."""
        ends, rows = self.ends, len(self.joint) - offset
        found = []
        for a in (0, 1):
            for b in (0, 1):
                same = (ends[a, :rows] == ends[b, offset:]) & (ends[a, :rows] >= 0)
                if same.any():
                    found.append((a, b, np.where(same, 1.0 if a == b else -1.0, 0.0)))
        return found

    @property
    def width(self) -> int:
        """How many diagonals are not zero, from the main one on."""
        return max(o + 1 for o in range(len(self.joint)) if self.shared(o))

    def pushers(self) -> np.ndarray:
        """For each moving body the places of its rows among those of side 0, then of side 1; 2 R: none."""
        rows, ends = len(self.joint), self.ends
        places = [np.flatnonzero(ends.reshape(-1) == line) for line in range(self.moving)]
        deep = max(map(len, places))
        return np.stack([np.pad(p, (0, deep - len(p)), constant_values=2 * rows) for p in places], axis=1)


def joint_system_plan(ties: Sequence[JointSpec], moving: int) -> JointSystemPlan:
    """The plan of joints, whose bodies are named by their lines in the table, moving ones first.

    Two hinges weld two bodies: the second has a row only across the line between them, a third would say nothing new.
    """
    from scipy.sparse import csr_array  # not above: it takes .2 s, for which no scene without joints should wait
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    a, b = (np.array([getattr(tie, side) for tie in ties]) for side in "ab")
    mine = [{line for line in (tie.a, tie.b) if line < moving} for tie in ties]
    near = np.array([[bool(one & other) for other in mine] for one in mine])
    order = reverse_cuthill_mckee(csr_array(near), symmetric_mode=True)
    hinges: dict[frozenset, list[int]] = {}
    for j, tie in enumerate(ties):
        if tie.kind != "distance":
            hinges.setdefault(frozenset((tie.a, tie.b)), []).append(j)

    def ways(j: int) -> list[tuple[int, int, int]]:
        if ties[j].kind == "distance":
            return [(j, ALONG, j)]
        alike = hinges[frozenset((ties[j].a, ties[j].b))]
        return [[(j, X, j), (j, Y, j)], [(j, ACROSS, alike[0])], []][min(alike.index(j), 2)]

    rows = [row for j in order for row in ways(int(j))]
    joint, way, other = (np.array(x) for x in zip(*rows, strict=True))
    return JointSystemPlan(joint, way, other, (a, b), moving)


class JointSystem(NamedTuple):
    """All joints of a scene, each [J, ...]."""

    plan: JointSystemPlan
    a: JointSide
    b: JointSide
    inertia: Inertia  # of all bodies in the table; zero of fixed ones
    rigid: Array  # bool: whether it is there, and no spring
    rest: Array  # m, of rods


class JointRows(NamedTuple):
    """The rows as they stand, each [R, ...]."""

    direction: Array  # [2, R, ...]
    levers: tuple[Array, Array]  # m, of both sides: what turns a body


def zero_impulses(linkage: JointSystem) -> Array:
    """The rows' impulses, N s [R, ...], when they have done nothing."""
    return jnp.zeros_like(linkage.rest[..., linkage.plan.joint, :])


class Anchors(NamedTuple):
    """The joints as they stand, each [2, J, ...] m."""

    arm_a: Array
    arm_b: Array
    apart: Array  # from a's anchor to b's


def _apart(linkage: JointSystem, rows: JointRows, apart: Array) -> Array:
    """How far the anchors are from where they belong, along each row, m [R, ...]."""
    plan = linkage.plan
    length = direction_of(apart)[1] - linkage.rest
    beside = dot(joint_lines(apart, plan.joint), rows.direction)
    return jnp.where((plan.way == ALONG)[:, None], joint_lines(length, plan.joint), beside)


def _rows(linkage: JointSystem, stance: Anchors) -> JointRows:
    plan, dtype = linkage.plan, linkage.rest.dtype
    direction = jnp.asarray(np.stack([plan.way == X, plan.way == Y])[..., None], dtype)
    direction = jnp.broadcast_to(direction, (*direction.shape[:2], *linkage.rest.shape[1:]))
    if (plan.way == ALONG).any():
        along = joint_lines(direction_of(stance.apart)[0], plan.joint)
        direction = jnp.where((plan.way == ALONG)[:, None], along, direction)
    if (plan.way == ACROSS).any():
        a, of_other = plan.lines[0], joint_lines(stance.arm_a, plan.other)
        same = (a[plan.joint] == a[plan.other])[:, None]
        between = joint_lines(stance.arm_a, plan.joint) - jnp.where(
            same, of_other, joint_lines(stance.arm_b, plan.other)
        )
        direction = jnp.where((plan.way == ACROSS)[:, None], turned(direction_of(between)[0]), direction)
    lever_a, lever_b = (dot(turned(joint_lines(arm, plan.joint)), direction) for arm in (stance.arm_a, stance.arm_b))
    return materialize(JointRows(direction, (lever_a, lever_b)))


def _pushed(linkage: JointSystem, rows: JointRows, table: Motion, impulses: Array) -> Motion:
    """The motions after the rows' impulses."""
    push, (lever_a, lever_b) = impulses * rows.direction, rows.levers
    parts = Motion(
        jnp.concatenate([-push, push, jnp.zeros_like(push[:, :1])], axis=-2),
        jnp.concatenate([-lever_a * impulses, lever_b * impulses, jnp.zeros_like(impulses[:1])], axis=-2),
    )
    parts, total = materialize(parts), None
    for places in linkage.plan.pushers():
        part = joint_lines(parts, places)
        total = part if total is None else jax.tree.map(jnp.add, total, part)
    assert total is not None
    moving = linkage.plan.moving
    mass, moment = (x[:moving] for x in linkage.inertia)
    more = Motion(mass * total.velocity, moment * total.spin)
    new = jax.tree.map(lambda x, y: jnp.concatenate([x[..., :moving, :] + y, x[..., moving:, :]], axis=-2), table, more)
    return materialize(new)


def _speeds(linkage: JointSystem, rows: JointRows, table: Motion) -> Array:
    """How fast the anchors part along each row, m/s."""
    plan, speeds = linkage.plan, []
    for lines, lever in zip(plan.lines, rows.levers, strict=True):
        motion = joint_lines(table, lines[plan.joint])
        speeds.append(dot(rows.direction, motion.velocity) + lever * motion.spin)
    return speeds[1] - speeds[0]


def _bands(linkage: JointSystem, rows: JointRows) -> list[Array]:
    """The diagonals of J M^-1 J^T, 1/kg [R, ...], from the main one on: the speed along the row so many rows later that
    a unit impulse along this one gives."""
    plan, bands = linkage.plan, []
    usable = joint_lines(linkage.rigid, plan.joint)
    inertias = [joint_lines(end.inertia, plan.joint) for end in (linkage.a, linkage.b)]
    count = len(plan.joint)
    for offset in range(plan.width):
        here, there = slice(0, count - offset), slice(offset, count)
        straight = dot(rows.direction[:, here], rows.direction[:, there])
        band = jnp.zeros_like(straight)
        for a, b, sign in plan.shared(offset):
            mass, moment = (x[here] for x in inertias[a])
            turning = moment * rows.levers[a][here] * rows.levers[b][there]
            band = band + jnp.asarray(sign, straight.dtype)[:, None] * (mass * straight + turning)
        bands.append(jnp.concatenate([band, jnp.zeros_like(rows.levers[0][:offset])], axis=-2))
    usable = usable & (bands[0] > 0)
    for offset in range(1, plan.width):
        both = usable & jnp.concatenate([usable[offset:], jnp.zeros_like(usable[:offset])], axis=-2)
        bands[offset] = jnp.where(both, bands[offset], 0.0)
    bands[0] = jnp.where(usable, (1 + COMPLIANCE) * bands[0], jnp.inf)
    return materialize(bands)


def _exchanged(linkage: JointSystem, rows: JointRows, table: Motion, impulses: Array) -> tuple[Motion, Work]:
    """The motions after impulses, and the work that these do, J [1, ...]."""
    new = _pushed(linkage, rows, table, impulses)
    gained = 0.5 * impulses * (_speeds(linkage, rows, table) + _speeds(linkage, rows, new))
    driven = jnp.zeros_like(gained)
    for end, lever, sign in zip((linkage.a, linkage.b), rows.levers, (-1, 1), strict=True):
        of = linkage.plan.joint
        if end.fixed.any():  # what moves as it likes does work where it is held
            motion = joint_lines(new, end.lines[of])
            work = impulses * (dot(rows.direction, motion.velocity) + lever * motion.spin)
            driven = driven - sign * jnp.where(end.fixed[of][:, None], work, 0.0)
    lost, driven = (jnp.sum(x, axis=-2, keepdims=True) for x in (-gained, driven))
    return new, Work(lost, driven, None)


def warm_start(
    linkage: JointSystem, bodies: list[Any], fixed: list[Any], motions: list[Motion], impulses: Array
) -> tuple[Anchors, list[Motion], Work]:
    """The joints as they stand, the motions with the last step's impulses, and the work done."""
    places = table_of(*([(body.position, body.angle) for body in some] for some in (bodies, fixed)))
    stance = Anchors(*anchors_of(linkage.a, linkage.b, places))
    now = table_of(motions, [body.motion for body in fixed])
    now, work = _exchanged(linkage, _rows(linkage, stance), now, impulses)
    return stance, groups_of(now, motions), work


def solve(
    linkage: JointSystem,
    stance: Anchors,
    motions: list[Motion],
    beyond: list[Motion],
    fixed: list[Any],
    impulses: Array,
    h: float,
) -> tuple[list[Motion], Array, Work]:
    """The motions with which the anchors meet after a step of h seconds, the impulses by then, and the work done.

    `beyond` is by how much more than h times its motion a body goes.
    """
    still = [body.motion for body in fixed]
    now, more = table_of(motions, still), table_of(beyond, [jax.tree.map(jnp.zeros_like, m) for m in still])
    rows, works = _rows(linkage, stance), []
    early = _apart(linkage, rows, stance.apart)
    undone = early - jnp.clip(early, -h * FASTEST, h * FASTEST)
    matrix = _Matrix(linkage, rows)
    for _ in range(NEWTON_ITERATIONS):
        way = jax.tree.map(lambda x, y: h * x + y, now, more)
        late = _apart(linkage, rows, _gone(linkage, stance, way).apart)
        impulses, now, work = matrix.closed(now, impulses, (late - undone) / h)
        works.append(work)
    return groups_of(now, motions), impulses, jax.tree.map(lambda *x: sum(x), *works)


def relax(
    linkage: JointSystem,
    stance: Anchors,
    motions: list[Motion],
    ways: list[Motion],
    fixed: list[Any],
    impulses: Array,
    h: float,
) -> tuple[list[Motion], Array, Work]:
    """The motions with which the anchors stay together after the bodies have gone their ways."""
    still = [body.motion for body in fixed]
    now, way = table_of(motions, still), table_of(ways, [jax.tree.map(lambda x: h * x, m) for m in still])
    rows = _rows(linkage, _gone(linkage, stance, way))
    impulses, now, work = _Matrix(linkage, rows).closed(now, impulses, _speeds(linkage, rows, now))
    return groups_of(now, motions), impulses, work


def _gone(linkage: JointSystem, stance: Anchors, ways: Motion) -> Anchors:
    """The joints as they stand after the bodies have gone their ways."""
    arms, apart = [], stance.apart
    for lines, arm, sign in zip(linkage.plan.lines, stance[:2], (-1, 1), strict=True):
        way = joint_lines(ways, lines)
        more = jnp.sin(way.spin) * turned(arm) - 2 * jnp.sin(way.spin / 2) ** 2 * arm
        arms.append(materialize(arm + more))
        apart = apart + sign * (way.velocity + more)
    return Anchors(arms[0], arms[1], apart)


class _Matrix:
    """The system of the rows, factored."""

    def __init__(self, linkage: JointSystem, rows: JointRows) -> None:
        bands = _bands(linkage, rows)
        self._of, self._rows = linkage, rows
        self._give = jnp.where(jnp.isfinite(bands[0]), COMPLIANCE * bands[0], 0.0)
        self._factors = factor(bands)

    def closed(self, now: Motion, impulses: Array, speeds: Array) -> tuple[Array, Motion, Work]:
        """The impulses that take these speeds from the rows, the motions with them, and the work done."""
        wanted = materialize(speeds + self._give * impulses)
        more = -materialize(solve_factored(self._factors, wanted))
        return impulses + more, *_exchanged(self._of, self._rows, now, more)
