"""Springs, and the limits and motors of hinges, in rounds.

A spring is a force, not a constraint: the mean of its values at both ends of the step, found implicitly and applied at
half of the step (the implicit midpoint rule). This keeps the energy of a linear spring exactly and is stable at any
stiffness. Rods and the points of hinges are rigid and solved all at once (rigid_joints.py).

A round is a batch of joints of one kind that share no moving body. A chain of any length takes two rounds, so programs
do not grow with it. Bodies are rows of a table, those of all groups before the static ones.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.collision import dot, perpendicular
from gen2d.physics.constraint import Inertia, Motion, reciprocal
from gen2d.physics.energy import Work
from gen2d.physics.params import SolverParams
from gen2d.records.axes import Array
from gen2d.records.layout import JointSpec
from gen2d.xla import materialize

HERTZ, DAMPING_RATIO = 60.0, 5.0  # of limits (E. Catto, 'Solver2D', 2024)
SHORTEST = 1e-6  # m: a shorter rod has no direction


class JointSide(NamedTuple):
    """One of the two bodies of each joint of a batch."""

    rows: np.ndarray  # [P] in the table of bodies
    static: np.ndarray  # [P] bool: static or kinematic
    inertia: Inertia  # [P, ...]; zero of a static body
    anchor: Array  # [2, P, ...] m, in the body's frame


class JointBatch(NamedTuple):
    """Constants of some joints, each [P, ...]. A distance joint of finite stiffness is a spring."""

    kind: str
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


class JointState(NamedTuple):
    """Joints of a round in this step."""

    batch: JointBatch
    arm_a: Array  # [2, P, ...] m
    arm_b: Array
    offset: Array  # [2, P, ...] m: from a's anchor to b's
    angle: Array  # [P, ...] rad: of b relative to a, less the rest angle
    impulses: tuple[Array, ...]


def joint_rounds(joints: Sequence[JointSpec], moving: int) -> list[list[int]]:
    """Numbers of the joints of each round; a joint is in the first round of its kind where both bodies are free.

    Joints name bodies by table row; rows below `moving` are moving bodies.
    """
    rounds: list[tuple[str, set[int], list[int]]] = []
    for number, joint in enumerate(joints):
        bodies = {row for row in (joint.a, joint.b) if row < moving}
        free = next((r for r in rounds if r[0] == joint.kind and not r[1] & bodies), None)
        if free is None:
            free = joint.kind, set(), []
            rounds.append(free)
        free[1].update(bodies)
        free[2].append(number)
    return [numbers for *_, numbers in rounds]


def zero_impulses(batch: JointBatch) -> tuple[Array, ...]:
    """Impulses before the first step: of hinges at both limits and by the motor."""
    return (jnp.zeros_like(batch.rest),) * (0 if batch.kind == "distance" else 3)


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


def anchors_of(a: JointSide, b: JointSide, poses: Any) -> tuple[Array, Array, Array]:
    """Both arms, and the offset between the anchors, m [2, P, ...], from a table of positions and angles."""
    (position_a, angle_a), (position_b, angle_b) = (take_rows(poses, side.rows) for side in (a, b))
    arm_a, arm_b = materialize((rotate(a.anchor, angle_a), rotate(b.anchor, angle_b)))
    return arm_a, arm_b, position_b + arm_b - position_a - arm_a


def _put(table: Any, joint: JointState, a: Any, b: Any) -> Any:
    """Table with both bodies of each joint replaced."""

    def put(x: Array, new_a: Array, new_b: Array) -> Array:
        count, rows = x.shape[-2], np.concatenate([joint.batch.a.rows, joint.batch.b.rows])
        order = np.arange(count)
        order[rows] = count + np.arange(len(rows))  # a static body may occur twice, but does not change
        return jnp.concatenate([x, new_a, new_b], axis=-2)[..., order, :]

    return jax.tree.map(put, table, a, b)


def _apply_impulse(side: JointSide, arm: Array, motion: Motion, impulse: Array) -> Motion:
    """Motion after an impulse at an arm."""
    spin = side.inertia.moment * dot(perpendicular(arm), impulse)
    return Motion(motion.velocity + side.inertia.mass * impulse, motion.spin + spin)


def _total(x: Array) -> Array:
    """Sum over a round, [1, ...]."""
    return jnp.sum(x, axis=-2, keepdims=True)


def warm_start(
    batches: list[JointBatch], bodies: list[Any], statics: list[Any], motions: list[Motion], impulses: list[tuple]
) -> tuple[list[JointState], list[Motion], list[Work]]:
    """Joints of every round in this step, motions with the impulses of the last step, and their work."""
    if not batches:
        return [], motions, []
    poses = poses_of(bodies, statics)
    now, joints, works = table_of(motions, [body.motion for body in statics]), [], []
    for batch, old in zip(batches, impulses, strict=True):
        angle_a, angle_b = (take_rows(poses[1], side.rows) for side in (batch.a, batch.b))
        angle = angle_b - angle_a - batch.rest
        joint = JointState(batch, *anchors_of(batch.a, batch.b, poses), angle, old)
        joints.append(joint)
        if batch.kind != "distance":
            hinges = _Hinges(joint, now)
            hinges.apply(old[0] - old[1])
            hinges.apply(old[2], motor=True)
            now = _put(now, joint, hinges.a, hinges.b)
            works.append(hinges.work)
    return joints, groups_of(now, motions), works


def solve(
    joints: list[JointState],
    motions: list[Motion],
    drifts: list[Motion],
    accelerations: list[Array],
    statics: list[Any],
    params: SolverParams,
    biased: bool,
) -> tuple[list[JointState], list[Motion], list[Motion], list[Work]]:
    """Joints, motions, drifts (displacements beyond h times the velocity) and works after a pass."""
    if not joints:
        return [], motions, drifts, []
    still = [body.motion for body in statics]
    now, drift = table_of(motions, still), table_of(drifts, [jax.tree.map(jnp.zeros_like, motion) for motion in still])
    acceleration = table_of(accelerations, [jnp.zeros_like(motion.velocity) for motion in still])
    solved, works = [], []
    for joint in joints:
        if joint.batch.kind != "distance":
            hinges = _Hinges(joint, now)
            joint = joint._replace(impulses=hinges.solve(params, biased))
            now = _put(now, joint, hinges.a, hinges.b)
            works.append(hinges.work)
        elif biased:
            now, drift, work = _spring(joint, now, drift, acceleration, params.step)
            works.append(work)
        solved.append(joint)
    return solved, groups_of(now, motions), groups_of(drift, drifts), works


class _Hinges:
    """Motions of both bodies of a round of hinges while angular impulses are applied, and the work of these.

    Results are materialized; otherwise a CPU computes each impulse again for all later ones, and compiling two hinges
    takes minutes.
    """

    def __init__(self, joint: JointState, motions: Motion) -> None:
        self._joint = joint
        self.a, self.b = take_rows(motions, joint.batch.a.rows), take_rows(motions, joint.batch.b.rows)
        self._lost, self._driven = jnp.zeros_like(joint.angle), jnp.zeros_like(joint.angle)

    @property
    def speed(self) -> Array:
        """Spin of b relative to a."""
        return self.b.spin - self.a.spin

    @property
    def work(self) -> Work:
        """Work so far."""
        return Work(_total(self._lost), _total(self._driven), None)

    def apply(self, twist: Array, motor: bool = False) -> None:
        """Applies an angular impulse on b and its reaction on a, and adds their work."""
        batch, before = self._joint.batch, self.speed
        twist, before = materialize((twist, before))
        spins = self.a.spin - batch.a.inertia.moment * twist, self.b.spin + batch.b.inertia.moment * twist
        spin_a, spin_b = materialize(spins)
        self.a, self.b = self.a._replace(spin=spin_a), self.b._replace(spin=spin_b)
        gain = 0.5 * twist * (before + self.speed)
        if motor:
            self._driven = self._driven + gain
        else:
            self._lost = self._lost - gain
        for side, motion, sign in ((batch.a, self.a, -1), (batch.b, self.b, 1)):
            if side.static.any():  # a kinematic body does work where it is held
                self._driven = self._driven - sign * jnp.where(side.static[:, None], motion.spin * twist, 0.0)

    def solve(self, params: SolverParams, biased: bool) -> tuple[Array, ...]:
        """Applies and returns the impulses at both limits and by the motor."""
        batch, (low, high, motor) = self._joint.batch, self._joint.impulses
        rate, mass_scale, impulse_scale = params.softness(HERTZ, DAMPING_RATIO) if biased else (0.0, 1.0, 0.0)
        k = batch.a.inertia.moment + batch.b.inertia.moment
        mass = reciprocal(k, batch.present & (k > 0))
        bound = params.step * batch.motor_torque
        new_motor = jnp.clip(motor - mass * (self.speed - batch.motor_speed), -bound, bound)
        self.apply(new_motor - motor, motor=True)
        limits = []
        angle = self._joint.angle
        for old, sign, room in ((low, 1, angle - batch.lower), (high, -1, batch.upper - angle)):
            limited = jnp.isfinite(room)
            room = jnp.where(limited, room, 1.0)
            bias = jnp.where(room > 0, room / params.step, rate * room)
            scale, keep = jnp.where(room > 0, 1.0, mass_scale), jnp.where(room > 0, 0.0, impulse_scale)
            new = jnp.maximum(old - scale * mass * (sign * self.speed + bias) - keep * old, 0.0)
            limits.append(jnp.where(limited, new, 0.0))
            self.apply(sign * (limits[-1] - old))
        return *limits, new_motor


def _spring(
    joint: JointState, now: Motion, drift: Motion, acceleration: Array, h: float
) -> tuple[Motion, Motion, Work]:
    """Motions and drifts after the impulse of springs at half of the step, and the work that it took from the motion.

    The energy stored in springs is subtracted in `energy.close_balance`.
    """
    batch = joint.batch
    soft = batch.present & jnp.isfinite(batch.stiffness)
    k, c = (jnp.where(soft, x, 0.0) for x in (batch.stiffness, batch.damping))
    sides = (batch.a, joint.arm_a, -1), (batch.b, joint.arm_b, 1)
    axis, length = direction_of(joint.offset)
    olds = [take_rows(now, side.rows) for side, *_ in sides]
    inverse = sum(
        side.inertia.mass + side.inertia.moment * dot(perpendicular(arm), axis) ** 2 for side, arm, _ in sides
    )

    def stretch_rate(motions: list[Motion]) -> Array:
        of_a, of_b = (m.velocity + m.spin * perpendicular(arm) for m, (_, arm, _) in zip(motions, sides, strict=True))
        return dot(axis, of_b - of_a)

    speed = stretch_rate(olds)
    stretch = length - batch.rest + 0.5 * h * speed
    size = -h * (k * stretch + c * speed) / (1 + inverse * h * (0.25 * h * k + 0.5 * c))
    size, axis = materialize((size, axis))
    impulse = size * axis
    news = [_apply_impulse(side, arm, old, sign * impulse) for (side, arm, sign), old in zip(sides, olds, strict=True)]
    lost = -0.5 * size * (speed + stretch_rate(news))
    driven = jnp.zeros_like(lost)
    for (side, arm, sign), motion in zip(sides, news, strict=True):
        if side.static.any():  # a kinematic body does work where it is held
            work = dot(motion.velocity + motion.spin * perpendicular(arm), impulse)
            driven = driven - sign * jnp.where(side.static[:, None], work, 0.0)
    # The work of the acceleration over the spring's own change of displacement is not that of contacts.
    over_drift = jnp.zeros_like(lost)
    for side, _, sign in sides:
        over_drift = over_drift + 0.5 * h * sign * dot(take_rows(acceleration, side.rows), impulse)
    drifts = [
        _apply_impulse(side, arm, take_rows(drift, side.rows), -0.5 * h * sign * impulse) for side, arm, sign in sides
    ]
    work = Work(_total(-over_drift), _total(driven), _total(lost + over_drift))
    return _put(now, joint, *news), _put(drift, joint, *drifts), work


def springs_energy(batches: list[JointBatch], bodies: list[Any], statics: list[Any]) -> Array | float:
    """Energy stored in all springs, J [...]: k x^2 / 2 each."""
    springs = [batch for batch in batches if batch.kind == "distance"]
    if not springs:
        return 0.0
    poses, energy = poses_of(bodies, statics), 0.0
    for batch in springs:
        length = direction_of(anchors_of(batch.a, batch.b, poses)[2])[1]
        stiffness = jnp.where(batch.present & jnp.isfinite(batch.stiffness), batch.stiffness, 0.0)
        energy = energy + jnp.sum(0.5 * stiffness * (length - batch.rest) ** 2, axis=-2)
    return energy
