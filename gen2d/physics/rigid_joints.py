"""Rigid joints, solved all at once: rods keep the distance of two anchors, hinges keep them in one place.

Solved one after the other, as contacts are, joints stretch between bodies of very different masses: with a ratio of
100 a pass reduces the error by a hundredth. So each pass solves the whole system J M^-1 J^T x = b, with a row for each
rod and two for each hinge. Few rows share a body. In reverse Cuthill-McKee order the matrix is a narrow band, of four
diagonals for a chain of any length, and its L D L^T factors take one loop over the rows.

The two passes make a step RATTLE (H. C. Andersen, 1983), which keeps a pendulum's energy: the first makes the anchors
meet at the end of the step, with arms that have turned by then, the second removes the speed with which they would part
there. Contacts are solved between, and see the joints (jointed.py). Limits and motors of hinges add rows for the angle
of their hinge (limits_motors.py).
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.banded import factor, inverse_band, solve_factored
from gen2d.physics.collision import dot, perpendicular
from gen2d.physics.constraint import Inertia, Motion
from gen2d.physics.energy import Work
from gen2d.physics.springs import (
    JointSide,
    anchors_of,
    direction_of,
    groups_of,
    poses_of,
    table_of,
    take_rows,
)
from gen2d.physics.symmetric import outer
from gen2d.records.axes import Array
from gen2d.records.layout import JointSpec
from gen2d.xla import materialize

X, Y, ALONG, ACROSS, ANGLE = range(5)  # the direction of a row
COMPLIANCE = 2e-5  # relative to a row's diagonal: bounds the impulses of redundant joints
NEWTON_ITERATIONS = 2  # with one, a level bridge of 20 planks falls
FASTEST = 10.0  # m/s: the fastest correction of anchors that are apart


@dataclasses.dataclass(frozen=True)
class JointSystemPlan:
    """Rows of the system and the bodies that they share; R rows of J joints in a table with N moving bodies."""

    joint: np.ndarray  # [R]
    direction: np.ndarray  # [R] X, Y or ALONG; ACROSS the line from another hinge of the same two bodies; ANGLE
    other: np.ndarray  # [R] that hinge
    bodies: tuple[np.ndarray, np.ndarray]  # [J] table rows of both bodies
    moving: int  # N

    @property
    def ends(self) -> np.ndarray:
        """Bodies of each row, [2, R]; -1: a static one."""
        ends = np.stack(self.bodies)[:, self.joint]
        return np.where(ends < self.moving, ends, -1)

    def shared(self, offset: int) -> list[tuple[int, int, np.ndarray]]:
        """Sides of each row and of the row `offset` later that are the same body.

        Each entry has both sides and, by row, 1 for the same body with equal signs, -1 with opposite signs, else 0.
        """
        ends, rows = self.ends, len(self.joint) - offset
        sides = []
        for a in (0, 1):
            for b in (0, 1):
                same = (ends[a, :rows] == ends[b, offset:]) & (ends[a, :rows] >= 0)
                if same.any():
                    sides.append((a, b, np.where(same, 1.0 if a == b else -1.0, 0.0)))
        return sides

    @property
    def width(self) -> int:
        """Number of nonzero diagonals, from the main one on."""
        return max(o + 1 for o in range(len(self.joint)) if self.shared(o))

    def rows_of_bodies(self) -> np.ndarray:
        """Rows of each moving body, those of side 0 before those of side 1, padded with 2 R."""
        return places_of_bodies(self.ends.reshape(-1), self.moving)


def places_of_bodies(bodies: np.ndarray, moving: int) -> np.ndarray:
    """Places of each body in a list of bodies, [most, N], padded with the list's length."""
    places = [np.flatnonzero(bodies == body) for body in range(moving)]
    most = max(map(len, places))
    return np.stack([np.pad(p, (0, most - len(p)), constant_values=len(bodies)) for p in places], axis=1)


def joint_system_plan(joints: Sequence[JointSpec], moving: int, angles: bool = False) -> JointSystemPlan:
    """Plan of joints whose bodies are named by table row, moving ones first.

    Two hinges weld two bodies: the second has only a row across the line between them, a third is redundant. With
    `angles`, each hinge that may have limits or a motor, and is the only one of its bodies, has a row for its angle.
    """
    from scipy.sparse import csr_array  # takes .2 s to import, for which scenes without joints need not wait
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    a, b = (np.array([getattr(joint, side) for joint in joints]) for side in "ab")
    bodies = [{row for row in (joint.a, joint.b) if row < moving} for joint in joints]
    near = np.array([[bool(own & other) for other in bodies] for own in bodies])
    order = reverse_cuthill_mckee(csr_array(near), symmetric_mode=True)
    hinges: dict[frozenset, list[int]] = {}
    for j, joint in enumerate(joints):
        if joint.kind != "distance":
            hinges.setdefault(frozenset((joint.a, joint.b)), []).append(j)

    def rows_of(j: int) -> list[tuple[int, int, int]]:
        if joints[j].kind == "distance":
            return [(j, ALONG, j)]
        alike = hinges[frozenset((joints[j].a, joints[j].b))]
        if angles and joints[j].limited and len(alike) == 1:
            return [(j, X, j), (j, Y, j), (j, ANGLE, j)]
        return [[(j, X, j), (j, Y, j)], [(j, ACROSS, alike[0])], []][min(alike.index(j), 2)]

    rows = [row for j in order for row in rows_of(int(j))]
    joint, direction, other = (np.array(x) for x in zip(*rows, strict=True))
    return JointSystemPlan(joint, direction, other, (a, b), moving)


class JointSystem(NamedTuple):
    """All joints of a scene, each [J, ...]."""

    plan: JointSystemPlan
    a: JointSide
    b: JointSide
    inertia: Inertia  # of all bodies in the table; zero of static ones
    rigid: Array  # bool: present, and no spring
    rest: Array  # m, of rods


class JointRows(NamedTuple):
    """Rows in this step, each [R, ...]."""

    direction: Array  # [2, R, ...]
    levers: tuple[Array, Array]  # m, of both sides


def zero_impulses(system: JointSystem) -> Array:
    """Impulses of the rows at the start of a step, N s [R, ...]."""
    return jnp.zeros_like(system.rest[..., system.plan.joint, :])


class Solved(NamedTuple):
    """Motions of the groups after the joints, the accumulated impulses of the rows, and the work."""

    motions: list[Motion]
    impulses: Array
    work: Work


class Anchors(NamedTuple):
    """Anchors of the joints, each [2, J, ...] m."""

    arm_a: Array
    arm_b: Array
    offset: Array  # from a's anchor to b's


def _error(system: JointSystem, rows: JointRows, offset: Array) -> Array:
    """Position error along each row, m [R, ...]."""
    plan = system.plan
    length = direction_of(offset)[1] - system.rest
    along = dot(take_rows(offset, plan.joint), rows.direction)
    return jnp.where((plan.direction == ALONG)[:, None], take_rows(length, plan.joint), along)


def rows_at(system: JointSystem, anchors: Anchors) -> JointRows:
    """Rows of joints with these anchors."""
    plan, dtype = system.plan, system.rest.dtype
    direction = jnp.asarray(np.stack([plan.direction == X, plan.direction == Y])[..., None], dtype)
    direction = jnp.broadcast_to(direction, (*direction.shape[:2], *system.rest.shape[1:]))
    if (plan.direction == ALONG).any():
        along = take_rows(direction_of(anchors.offset)[0], plan.joint)
        direction = jnp.where((plan.direction == ALONG)[:, None], along, direction)
    if (plan.direction == ACROSS).any():
        a, other = plan.bodies[0], take_rows(anchors.arm_a, plan.other)
        same = (a[plan.joint] == a[plan.other])[:, None]
        between = take_rows(anchors.arm_a, plan.joint) - jnp.where(same, other, take_rows(anchors.arm_b, plan.other))
        direction = jnp.where((plan.direction == ACROSS)[:, None], perpendicular(direction_of(between)[0]), direction)
    lever_a, lever_b = (
        dot(perpendicular(take_rows(arm, plan.joint)), direction) for arm in (anchors.arm_a, anchors.arm_b)
    )
    if (plan.direction == ANGLE).any():
        lever_a, lever_b = (jnp.where((plan.direction == ANGLE)[:, None], 1.0, x) for x in (lever_a, lever_b))
    return materialize(JointRows(direction, (lever_a, lever_b)))


def speeds_along(system: JointSystem, rows: JointRows, table: Motion) -> Array:
    """Speed with which the anchors part along each row, m/s, or the relative spin, rad/s, [R, ...]."""
    plan, speeds = system.plan, []
    for bodies, lever in zip(plan.bodies, rows.levers, strict=True):
        motion = take_rows(table, bodies[plan.joint])
        speeds.append(dot(rows.direction, motion.velocity) + lever * motion.spin)
    return speeds[1] - speeds[0]


def bands_of(system: JointSystem, rows: JointRows) -> Array:
    """The band matrix J M^-1 J^T, 1/kg [R, width, ...].

    An entry is the speed along a later row that a unit impulse along this row causes.
    """
    plan, bands = system.plan, []
    inertias = [take_rows(side.inertia, plan.joint) for side in (system.a, system.b)]
    count = len(plan.joint)
    for offset in range(plan.width):
        here, there = slice(0, count - offset), slice(offset, count)
        linear = dot(rows.direction[:, here], rows.direction[:, there])
        band = jnp.zeros_like(linear)
        for a, b, sign in plan.shared(offset):
            mass, moment = (x[here] for x in inertias[a])
            angular = moment * rows.levers[a][here] * rows.levers[b][there]
            band = band + jnp.asarray(sign, linear.dtype)[:, None] * (mass * linear + angular)
        bands.append(jnp.concatenate([band, jnp.zeros_like(rows.levers[0][:offset])], axis=-2))
    return materialize(jnp.stack(bands, axis=1))


def usable_rows(system: JointSystem, bands: Array) -> Array:
    """Whether each row is of a present joint that can move a body, bool [R, ...]."""
    return take_rows(system.rigid, system.plan.joint) & (bands[:, 0] > 0)


def _apply(system: JointSystem, rows: JointRows, table: Motion, impulses: Array) -> tuple[Motion, Work]:
    """Motions after impulses, and their work, J [1, ...]."""
    linear, (lever_a, lever_b) = impulses * rows.direction, rows.levers
    parts = Motion(
        jnp.concatenate([-linear, linear, jnp.zeros_like(linear[:, :1])], axis=-2),
        jnp.concatenate([-lever_a * impulses, lever_b * impulses, jnp.zeros_like(impulses[:1])], axis=-2),
    )
    parts, moving = materialize(parts), system.plan.moving
    each = (take_rows(parts, places) for places in system.plan.rows_of_bodies())
    total = functools.reduce(lambda x, y: jax.tree.map(jnp.add, x, y), each)
    mass, moment = (x[:moving] for x in system.inertia)
    more = Motion(mass * total.velocity, moment * total.spin)
    new = jax.tree.map(lambda x, y: jnp.concatenate([x[..., :moving, :] + y, x[..., moving:, :]], axis=-2), table, more)
    new = materialize(new)
    gain = 0.5 * impulses * (speeds_along(system, rows, table) + speeds_along(system, rows, new))
    driven, joint = jnp.zeros_like(gain), system.plan.joint
    for side, lever, sign in zip((system.a, system.b), rows.levers, (-1, 1), strict=True):
        if side.static.any():  # a kinematic body does work where it is held
            motion = take_rows(new, side.rows[joint])
            work = impulses * (dot(rows.direction, motion.velocity) + lever * motion.spin)
            driven = driven - sign * jnp.where(side.static[joint][:, None], work, 0.0)
    lost, driven = (jnp.sum(x, axis=-2, keepdims=True) for x in (-gain, driven))
    return new, Work(lost, driven, None)


def anchors_at(system: JointSystem, bodies: list[Any], statics: list[Any]) -> Anchors:
    """Anchors in these states of all bodies."""
    return Anchors(*anchors_of(system.a, system.b, poses_of(bodies, statics)))


def table_of_changes(system: JointSystem, changes: list[Motion]) -> Motion:
    """Table of changes of the moving bodies, with zeros for the static ones."""
    moving, rows = system.plan.moving, len(system.inertia.mass)
    table = table_of(changes, [])
    return jax.tree.map(lambda x: jnp.pad(x, [*[(0, 0)] * (x.ndim - 2), (0, rows - moving), (0, 0)]), table)


class FactoredSystem:
    """The rows of the joints, factored: at the start of a step, or after displacements of all bodies."""

    def __init__(self, system: JointSystem, anchors: Anchors, displacements: Motion | None = None) -> None:
        self._system = system
        self.anchors = anchors if displacements is None else _displace(system, anchors, displacements)
        self._rows = rows_at(system, self.anchors)
        bands = bands_of(system, self._rows)
        usable = usable_rows(system, bands)
        self._compliance = jnp.where(usable, COMPLIANCE * bands[:, 0], 0.0)
        self._factors = factor(bands, usable, COMPLIANCE)

    def meet(
        self,
        motions: list[Motion],
        drifts: list[Motion],
        free_drifts: list[Motion],
        fixed: list[Motion],
        impulses: Array,
        h: float,
    ) -> tuple[Solved, list[Motion]]:
        """Motions with which the anchors meet after a step of h seconds, and the drifts.

        A body's displacement is h times its motion plus its drifts: those of impulses within the step, and the free
        ones of forces. The joints answer an impulse at its time, so they take their share of its motion and of its
        drift. Newton's iterations alone would put all of it into the motion, and start where a light body that is hit
        far from its hinge has turned by a radian.
        """
        system, rows, anchors = self._system, self._rows, self.anchors
        error = _error(system, rows, anchors.offset)
        remaining = error - jnp.clip(error, -h * FASTEST, h * FASTEST)
        impulses, now, work = self._stay(table_of(motions, fixed), impulses)
        drift, works = table_of_changes(system, drifts), [work]
        drift, _ = _apply(system, rows, drift, self._impulses(speeds_along(system, rows, drift)))
        drift = jax.tree.map(jnp.add, drift, table_of_changes(system, free_drifts))
        for _ in range(NEWTON_ITERATIONS):
            displacement = jax.tree.map(lambda x, y: h * x + y, now, drift)
            error = _error(system, rows, _displace(system, anchors, displacement).offset)
            impulses, now, work = self._solve(now, impulses, (error - remaining) / h)
            works.append(work)
        total = jax.tree.map(lambda *x: sum(x), *works)
        return Solved(groups_of(now, motions), impulses, total), groups_of(drift, motions)

    def hold(self, motions: list[Motion], fixed: list[Motion], impulses: Array) -> Solved:
        """Motions with which the anchors stay together."""
        impulses, now, work = self._stay(table_of(motions, fixed), impulses)
        return Solved(groups_of(now, motions), impulses, work)

    def _stay(self, now: Motion, impulses: Array) -> tuple[Array, Motion, Work]:
        """Accumulated impulses, motions with which the anchors stay together, and the work done."""
        return self._solve(now, impulses, speeds_along(self._system, self._rows, now))

    def _solve(self, now: Motion, impulses: Array, speeds: Array) -> tuple[Array, Motion, Work]:
        """Accumulated impulses that cancel the speeds of the rows, motions with them, and the work done."""
        more = self._impulses(speeds + self._compliance * impulses)
        return impulses + more, *_apply(self._system, self._rows, now, more)

    def _impulses(self, speeds: Array) -> Array:
        return -materialize(solve_factored(self._factors, materialize(speeds)))

    def schur_complements(self, groups: list[Motion]) -> list[Array]:
        """What the joints take from the inverse mass of each body, [6, N, ...] of x, y and angle, by group.

        It is the Schur complement of the rows: the change of a body's motion by a unit impulse on it that the joints
        cancel.
        """
        plan, parts, bodies = self._system.plan, [], []
        inverse = inverse_band(self._factors)
        for offset in range(plan.width):
            for a, b, sign in plan.shared(offset):
                rows = np.flatnonzero(sign)
                share = jnp.asarray(sign[rows], inverse.dtype)[:, None] * inverse[rows, offset]
                p, q = self._pushes(a, rows), self._pushes(b, rows + offset)
                parts.append((share if offset == 0 else 2 * share) * outer(p, q))
                bodies.append(plan.ends[a, rows])
        parts, bodies = jnp.concatenate(parts, axis=-2), np.concatenate(bodies)
        parts = materialize(jnp.concatenate([parts, jnp.zeros_like(parts[:, :1])], axis=-2))
        each = (take_rows(parts, places) for places in places_of_bodies(bodies, plan.moving))
        return groups_of(functools.reduce(jnp.add, each), groups)

    def _pushes(self, side: int, rows: np.ndarray) -> tuple[Array, Array, Array]:
        """Change of the motion (x, y, angle) of the bodies on a side of some rows by unit impulses."""
        system = self._system
        mass, moment = take_rows((system.a, system.b)[side].inertia, system.plan.joint[rows])
        x, y = take_rows(self._rows.direction, rows)
        return mass * x, mass * y, moment * take_rows(self._rows.levers[side], rows)


def _displace(system: JointSystem, anchors: Anchors, displacement: Motion) -> Anchors:
    """Anchors after the displacements."""
    arms, offset = [], anchors.offset
    for bodies, arm, sign in zip(system.plan.bodies, anchors[:2], (-1, 1), strict=True):
        own = take_rows(displacement, bodies)
        more = jnp.sin(own.spin) * perpendicular(arm) - 2 * jnp.sin(own.spin / 2) ** 2 * arm
        arms.append(materialize(arm + more))
        offset = offset + sign * (own.velocity + more)
    return Anchors(arms[0], arms[1], offset)
