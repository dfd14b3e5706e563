"""Springs, in rounds, and tables of the bodies that joints connect.

A spring is a force, not a constraint: the mean of its values at both ends of the step, found implicitly and applied at
half of the step (the implicit midpoint rule). This keeps the energy of a linear spring exactly and is stable at any
stiffness. Contacts see it as an acceleration (contact_points.py). Where impacts have changed the way, its work differs
from what the spring has lost, and the difference goes into the speeds at the end of the step. Rods and hinges are rigid
and solved all at once (rigid_joints.py), with the limits and motors of hinges (limits_motors.py).

A round is a batch of springs that share no moving body. A chain of any length takes two rounds, so programs do not grow
with it. Bodies are rows of a table, those of all groups before the static ones.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.collision import dot, perpendicular
from gen2d.physics.constraint import Inertia, Motion, reciprocal, speed_bound
from gen2d.physics.energy import Work
from gen2d.records.axes import Array
from gen2d.records.layout import JointSpec
from gen2d.xla import materialize

Anchors: TypeAlias = tuple[Array, Array, Array]  # both arms and the offset between the anchors, m [2, P, ...]
SHORTEST = 1e-6  # m: a shorter rod has no direction


class JointSide(NamedTuple):
    """One of the two bodies of each joint of a batch."""

    rows: np.ndarray  # [P] in the table of bodies
    static: np.ndarray  # [P] bool: static or kinematic
    inertia: Inertia  # [P, ...]; zero of a static body
    anchor: Array  # [2, P, ...] m, in the body's frame


class JointBatch(NamedTuple):
    """Constants of some joints, each [P, ...]. A distance joint of finite stiffness is a spring."""

    a: JointSide
    b: JointSide
    present: Array
    rest: Array
    stiffness: Array
    damping: Array
    lower: Array
    upper: Array
    motor_speed: Array
    motor_torque: Array

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """Stiffness in N/m and damping in N s/m of springs; zero for other joints."""
        soft = self.present & jnp.isfinite(self.stiffness)
        return jnp.where(soft, self.stiffness, 0.0), jnp.where(soft, self.damping, 0.0)

    def both(self, table: Any) -> list[Any]:
        """Values of both bodies of each joint, from a table."""
        return [take_rows(table, side.rows) for side in (self.a, self.b)]


def spring_rounds(joints: Sequence[JointSpec], moving: int) -> list[list[int]]:
    """Numbers of the distance joints of each round; a joint is in the first round where both bodies are free.

    Joints name bodies by table row; rows below `moving` are moving bodies.
    """
    rounds: list[tuple[set[int], list[int]]] = []
    for number, joint in enumerate(joints):
        if joint.kind == "distance":
            bodies = {row for row in (joint.a, joint.b) if row < moving}
            free = next((r for r in rounds if not r[0] & bodies), None)
            if free is None:
                free = set(), []
                rounds.append(free)
            free[0].update(bodies)
            free[1].append(number)
    return [numbers for _, numbers in rounds]


def table_of(groups: Sequence[Any], statics: Sequence[Any]) -> Any:
    """Values of all bodies in one table, [..., N, n]."""
    return jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *groups, *statics)


def poses_of(bodies: Sequence[Any], statics: Sequence[Any]) -> Any:
    """Positions and angles of all bodies in one table."""
    return table_of(*([(body.position, body.angle) for body in some] for some in (bodies, statics)))


def take_rows(table: Any, rows: np.ndarray) -> Any:
    """Values of some rows of a table."""
    return jax.tree.map(lambda x: x[..., rows, :], table)


def groups_of(table: Any, groups: list[Any]) -> list[Any]:
    """Values of the groups of a table."""
    ends = list(itertools.accumulate((jax.tree.leaves(group)[0].shape[-2] for group in groups), initial=0))
    return [jax.tree.map(lambda x, span=slice(*span): x[..., span, :], table) for span in itertools.pairwise(ends)]


def rotate(vector: Array, angle: Array) -> Array:
    """Vectors [2, ...] rotated counter-clockwise by an angle."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])


def direction_of(offset: Array) -> tuple[Array, Array]:
    """Unit direction and length of a vector; both zero where it is shorter than SHORTEST."""
    squared = dot(offset, offset)
    length = jnp.sqrt(jnp.where(squared > SHORTEST**2, squared, 1.0))
    return jnp.where(squared > SHORTEST**2, offset / length, 0.0), jnp.where(squared > SHORTEST**2, length, 0.0)


def anchors_of(a: JointSide, b: JointSide, poses: Any) -> Anchors:
    """Both arms, and the offset between the anchors, m [2, P, ...], from a table of positions and angles."""
    (position_a, angle_a), (position_b, angle_b) = (take_rows(poses, side.rows) for side in (a, b))
    arm_a, arm_b = materialize((rotate(a.anchor, angle_a), rotate(b.anchor, angle_b)))
    return arm_a, arm_b, position_b + arm_b - position_a - arm_a


def _put(table: Any, batch: JointBatch, a: Any, b: Any) -> Any:
    """Table with both bodies of each joint replaced."""

    def put(x: Array, new_a: Array, new_b: Array) -> Array:
        count, rows = x.shape[-2], np.concatenate([batch.a.rows, batch.b.rows])
        order = np.arange(count)
        order[rows] = count + np.arange(len(rows))  # a static body may occur twice, but does not change
        return jnp.concatenate([x, new_a, new_b], axis=-2)[..., order, :]

    return jax.tree.map(put, table, a, b)


def _apply_impulse(side: JointSide, arm: Array, motion: Motion, impulse: Array) -> Motion:
    """Motion after an impulse at an arm."""
    spin = side.inertia.moment * dot(perpendicular(arm), impulse)
    return Motion(motion.velocity + side.inertia.mass * impulse, motion.spin + spin)


def _moved(arms: Sequence[Array], ways: Sequence[Motion]) -> tuple[list[Array], Array]:
    """Arms after displacements of both bodies, and how far the anchor on b moves relative to that on a, m."""
    turned = [rotate(arm, way.spin) for arm, way in zip(arms, ways, strict=True)]
    of_a, of_b = (way.velocity + new - old for way, new, old in zip(ways, turned, arms, strict=True))
    return turned, of_b - of_a


def _total(x: Array) -> Array:
    """Sum over a round, [1, ...]."""
    return jnp.sum(x, axis=-2, keepdims=True)


class _Lines(NamedTuple):
    """Springs of a batch with the line through their anchors."""

    batch: JointBatch
    arms: list[Array]  # [2, P, ...] m, of both bodies
    axis: Array  # [2, P, ...] unit vector from the anchor on a to that on b

    @property
    def sides(self) -> tuple[tuple[JointSide, Array, int], ...]:
        """Both sides, with their arms, and the sign of an impulse on them."""
        return (self.batch.a, self.arms[0], -1), (self.batch.b, self.arms[1], 1)

    @property
    def inverse_mass(self) -> Array:
        """Stretch rate that a unit impulse causes, 1/kg."""
        return sum(  # pyright: ignore[reportReturnType]
            side.inertia.mass + side.inertia.moment * dot(perpendicular(arm), self.axis) ** 2
            for side, arm, _ in self.sides
        )

    def anchor_velocities(self, motions: list[Motion]) -> list[Array]:
        """Velocities of both anchors, m/s [2, P, ...]."""
        return [m.velocity + m.spin * perpendicular(arm) for m, arm in zip(motions, self.arms, strict=True)]

    def stretch_rate(self, motions: list[Motion]) -> Array:
        """Speed at which the springs get longer, m/s."""
        of_a, of_b = self.anchor_velocities(motions)
        return dot(self.axis, of_b - of_a)

    def apply(self, motions: list[Motion], impulse: Array) -> list[Motion]:
        """Motions, or displacements, of both bodies after an impulse [2, ...] on b and its reaction on a."""
        return [
            _apply_impulse(side, arm, motion, sign * impulse)
            for (side, arm, sign), motion in zip(self.sides, motions, strict=True)
        ]

    def driven(self, motions: list[Motion], impulse: Array) -> Array:
        """Work of kinematic bodies where the springs hold them, J."""
        driven = jnp.zeros_like(impulse[0])
        for (side, arm, sign), motion in zip(self.sides, motions, strict=True):
            if side.static.any():
                work = dot(motion.velocity + motion.spin * perpendicular(arm), impulse)
                driven = driven - sign * jnp.where(side.static[:, None], work, 0.0)
        return driven


class Sprung(NamedTuple):
    """Bodies after the impulses of all springs at half of a step."""

    motions: list[Motion]
    changes: list[Motion] | None  # of the motions; None without springs
    impulses: list[Array]  # [2, P, ...] N s of each batch, on its bodies b
    works: list[Work]


def speed_bounds(
    batches: list[JointBatch], anchors: list[Anchors], statics: list[Motion], motions: list[Motion], h: float
) -> list[Array] | None:
    """Bounds on what springs add to the speeds of each group in a step, m/s [N, ...]; None without springs."""
    if not batches:
        return None
    now = table_of(motions, statics)
    bounds = jnp.zeros_like(now.spin)
    for batch, (arm_a, arm_b, offset) in zip(batches, anchors, strict=True):
        axis, length = direction_of(offset)
        lines = _Lines(batch, [arm_a, arm_b], axis)
        (k, c), inverse, (of_a, of_b) = batch.coefficients, lines.inverse_mass, lines.anchor_velocities(batch.both(now))
        fastest = speed_bound(of_b - of_a)
        impulse = h * (k * jnp.abs(length - batch.rest) + (0.5 * h * k + c) * fastest)
        impulse = materialize(impulse / (1 + inverse * h * (0.25 * h * k + 0.5 * c)))
        more = (old + s.inertia.mass * impulse for (s, *_), old in zip(lines.sides, batch.both(bounds), strict=True))
        bounds = _put(bounds, batch, *more)
    return groups_of(bounds, motions)


def apply(
    batches: list[JointBatch],
    anchors: list[Anchors],
    statics: list[Motion],
    motions: list[Motion],
    drifts: list[Motion],
    accelerations: list[Array],
    h: float,
) -> Sprung:
    """Bodies after the impulses of all springs; drifts are all displacements beyond h times these motions."""
    if not batches:
        return Sprung(motions, None, [], [])
    now, drift = table_of(motions, statics), table_of(drifts, [jax.tree.map(jnp.zeros_like, m) for m in statics])
    acceleration, impulses, works = table_of(accelerations, [jnp.zeros_like(m.velocity) for m in statics]), [], []
    for batch, start in zip(batches, anchors, strict=True):
        now, drift, impulse, work = _spring(batch, start, now, drift, acceleration, h)
        impulses.append(impulse)
        works.append(work)
    news = groups_of(now, motions)
    changes = [jax.tree.map(jnp.subtract, *of) for of in zip(news, motions, strict=True)]
    return Sprung(news, changes, impulses, works)


def _spring(
    batch: JointBatch, anchors: Anchors, now: Motion, drift: Motion, acceleration: Array, h: float
) -> tuple[Motion, Motion, Array, Work]:
    """Motions and drifts after the impulse of springs at half of the step, the impulse, and the work that it took.

    The energy stored in springs is subtracted in `energy.close_balance`.
    """
    olds, drifts = batch.both(now), batch.both(drift)
    *starts, offset = anchors
    halves = [jax.tree.map(lambda v, x: 0.5 * (h * v + x), *of) for of in zip(olds, drifts, strict=True)]
    (arms, more), (axis, _) = _moved(starts, halves), direction_of(offset)
    # Only the sideways part turns the axis: a stiff spring would swing through zero length in half a step.
    along = dot(axis, more)
    axis, length = direction_of(offset + more - along * axis)
    arms, axis, length, along = materialize((arms, axis, length, along))
    lines = _Lines(batch, arms, axis)
    (k, c), inverse, speed = batch.coefficients, lines.inverse_mass, lines.stretch_rate(olds)
    stretch = length - batch.rest + along
    rate = speed + lines.stretch_rate(drifts) / h
    size = -h * (k * stretch + c * rate) / (1 + inverse * h * (0.25 * h * k + 0.5 * c))
    size = materialize(size)
    impulse = size * axis
    news = lines.apply(olds, impulse)
    lost = -0.5 * size * (speed + lines.stretch_rate(news))
    # The work of the acceleration over the spring's own change of displacement is not that of contacts.
    over_drift = jnp.zeros_like(lost)
    for side, _, sign in lines.sides:
        over_drift = over_drift + 0.5 * h * sign * dot(take_rows(acceleration, side.rows), impulse)
    drifts = lines.apply(drifts, -0.5 * h * impulse)
    work = Work(_total(-over_drift), _total(lines.driven(news, impulse)), _total(lost + over_drift))
    return _put(now, batch, *news), _put(drift, batch, *drifts), impulse, work


def conserve(
    batches: list[JointBatch],
    anchors: list[Anchors],
    statics: list[Motion],
    displacements: list[Motion],
    motions: list[Motion],
    impulses: list[Array],
    h: float,
) -> tuple[list[Motion], list[Work]]:
    """Motions at the end of a step, in which springs have given what they have lost, and the works.

    The impulses were found for bodies that nothing hits. Over the displacements that impacts and joints have left, they
    have done another work than what the springs have lost. The difference goes into the speeds of the anchors.
    """
    if not batches:
        return motions, []
    moved = table_of(displacements, [jax.tree.map(lambda x: h * x, motion) for motion in statics])
    now, works = table_of(motions, statics), []
    for batch, start, impulse in zip(batches, anchors, impulses, strict=True):
        now, work = _conserve(batch, start, moved, now, impulse, h)
        works.append(work)
    return groups_of(now, motions), works


def _conserve(
    batch: JointBatch, anchors: Anchors, moved: Motion, now: Motion, impulse: Array, h: float
) -> tuple[Motion, Work]:
    """Motions of a batch after displacements, in which the energy is what it should be, and the work for it."""
    *starts, offset = anchors
    arms, way = _moved(starts, batch.both(moved))
    (_, before), (axis, after) = direction_of(offset), direction_of(offset + way)
    longer = dot(way, offset + offset + way) / jnp.maximum(before + after, SHORTEST)
    lines = _Lines(batch, *materialize((arms, axis)))
    (k, c), inverse, olds = batch.coefficients, lines.inverse_mass, batch.both(now)
    # What springs and dampers have given over this way, less what the impulse has.
    missing = -longer * (k * (0.5 * (before + after) - batch.rest) + c * longer / h) - dot(impulse, way) / h
    speed = lines.stretch_rate(olds)
    square = speed**2 + 2 * inverse * missing
    root = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    exact = 2 * missing * reciprocal(jnp.where(speed < 0, speed - root, speed + root), square > 0)
    size = jnp.where(square > 0, exact, -speed * reciprocal(inverse, inverse > 0))  # the anchors stop at most
    more = jnp.where((k > 0) & (inverse > 0), materialize(size), 0.0)
    news = lines.apply(olds, more * axis)
    lost = -0.5 * more * (speed + lines.stretch_rate(news))
    work = Work(_total(jnp.zeros_like(lost)), _total(lines.driven(news, more * axis)), _total(lost))
    return _put(now, batch, *news), work


def springs_energy(batches: list[JointBatch], bodies: list[Any], statics: list[Any]) -> Array | float:
    """Energy stored in all springs, J [...]: k x^2 / 2 each."""
    if not batches:
        return 0.0
    poses, energy = poses_of(bodies, statics), 0.0
    for batch in batches:
        length = direction_of(anchors_of(batch.a, batch.b, poses)[2])[1]
        stiffness, _ = batch.coefficients
        energy = energy + jnp.sum(0.5 * stiffness * (length - batch.rest) ** 2, axis=-2)
    return energy
