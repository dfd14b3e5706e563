"""Limits and motors of hinges, solved with the other joints.

A twist on a hinge, an angular impulse on b and its reaction on a, turns other bodies too, through the rigid joints.
The relative spins of all hinges change by W = E^T (M^-1 - M^-1 J^T (J M^-1 J^T)^-1 J M^-1) E times the twists, with
the directions E of the twists and the rows J of the joints (rigid_joints.py). Each hinge is free, driven by its motor
with all of its torque, or pinned: to a limit, or to the speed of its motor. All pinned ones are solved at once, as one
after the other would need thousands of sweeps where a chain of them hangs; a few rounds find which these are. Sweeps of
projected Gauss-Seidel remove what is left.

The first pass stops a hinge at its limit at the end of the step, and turns it back from beyond; the relaxing pass takes
the speed of turning back away.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.constraint import Motion, reciprocal
from gen2d.physics.energy import Work
from gen2d.physics.params import SolverParams
from gen2d.physics.springs import JointBatch, take_rows
from gen2d.records.axes import Array
from gen2d.xla import materialize

HERTZ, DAMPING_RATIO = 60.0, 5.0  # of turning back (E. Catto, 'Solver2D', 2024)
ROUNDS, SWEEPS = 2, 2
LEAST = 1e-4  # share of a hinge's compliance that the joints leave at least, as the rest would be rounding


def zero_twists(hinges: JointBatch | None) -> Array | None:
    """Twists before the first step, N m s [H, ...]; None without hinges."""
    return None if hinges is None else jnp.zeros_like(hinges.rest)


def hinge_angles(hinges: JointBatch, angles: Array) -> Array:
    """Angles of b relative to a, less those at rest, rad [H, ...], from a table of the angles of all bodies."""
    return take_rows(angles, hinges.b.rows) - take_rows(angles, hinges.a.rows) - hinges.rest


def relative_spins(hinges: JointBatch, table: Motion) -> Array:
    """Spins of b relative to a, rad/s [H, ...]."""
    return take_rows(table.spin, hinges.b.rows) - take_rows(table.spin, hinges.a.rows)


def compliances(hinges: JointBatch) -> Array:
    """Relative spins of all hinges [H, H, ...] after a unit twist on each, without the other joints: E^T M^-1 E."""
    total: Array | float = 0.0
    for p, sign in ((hinges.a, -1.0), (hinges.b, 1.0)):
        for q, other in ((hinges.a, -1.0), (hinges.b, 1.0)):
            same = jnp.asarray(sign * other * (p.rows[:, None] == q.rows), hinges.rest.dtype)
            total = total + same[..., None] * p.inertia.moment[:, None]
    return total


class _Hinge(NamedTuple):
    """What a hinge alone does, each [H, ...] or of one hinge."""

    own: Array  # 1/(kg m^2): W on the diagonal
    mass: Array  # its inverse, 0 where the joints leave nothing
    torque: Array  # N m s: the motor's largest twist
    motor: Array  # rad/s
    slowest: Array  # rad/s, by the lower limit; -infinite without one
    fastest: Array  # by the upper one

    def answer(self, twist: Array, speed: Array) -> tuple[Array, Array, Array]:
        """Twist that it needs alone, whether it is pinned, and to which speed; `speed` is that with `twist`."""
        alone = speed - self.own * twist
        driven = jnp.clip(self.mass * (self.motor - alone), -self.torque, self.torque)
        turning = alone + self.own * driven
        low, high = turning < self.slowest, turning > self.fastest
        limit = jnp.where(low, self.slowest, jnp.where(high, self.fastest, 0.0))
        pinned = (self.mass > 0) & (low | high | (jnp.abs(driven) < self.torque))
        target = jnp.where(low | high, limit, self.motor)
        return jnp.where(low | high, self.mass * (limit - alone), driven), pinned, target


def solve(
    hinges: JointBatch,
    compliance: Array,
    speeds: Array,
    angle: Array,
    twists: Array,
    params: SolverParams,
    first: bool,
) -> Array:
    """Twists [H, ...] after a pass, from those of the last one; the `first` turns hinges back that are beyond a limit.

    compliance: W, 1/(kg m^2) [H, H, ...]; speeds: relative spins of all hinges without twists, rad/s [H, ...];
    angle: that of each hinge at the start of the step, rad [H, ...].
    """
    count = len(hinges.a.rows)
    numbers = np.arange(count)
    own, alone = compliance[numbers, numbers], hinges.a.inertia.moment + hinges.b.inertia.moment
    mass = reciprocal(own, hinges.present & (own > LEAST * alone))
    rate = params.bias_rate(HERTZ, DAMPING_RATIO) if first else 0.0
    ends = []
    for sign, limit in ((-1.0, hinges.lower), (1.0, hinges.upper)):
        limited = jnp.isfinite(limit)
        room = sign * (jnp.where(limited, limit, 0.0) - angle)
        ends.append(jnp.where(limited, sign * jnp.where(room > 0, room / params.step, rate * room), sign * jnp.inf))
    hinge = _Hinge(own, mass, params.step * hinges.motor_torque, hinges.motor_speed, *ends)
    hinge, compliance = materialize((hinge, compliance))

    def with_twists(twists: Array) -> Array:
        return speeds + jnp.sum(compliance * twists, axis=1)

    def together(_: int, twists: Array) -> Array:
        new, pinned, target = hinge.answer(twists, with_twists(twists))
        free = jnp.where(pinned, 0.0, new)
        return free + _pinned_twists(compliance, pinned, target - with_twists(free))

    def one(speeds: Array, values: tuple) -> tuple[Array, Array]:
        number, old, hinge, row = values
        new, *_ = hinge.answer(old, jax.lax.dynamic_index_in_dim(speeds, number, keepdims=False))
        return speeds + row * (new - old), new

    if count > 1:
        twists = jax.lax.fori_loop(0, ROUNDS, together, twists)
    for _ in range(SWEEPS if count > 1 else 1):
        twists = jax.lax.scan(one, with_twists(twists), (numbers, twists, hinge, compliance))[1]
    return twists


def _pinned_twists(compliance: Array, pinned: Array, missing: Array) -> Array:
    """Twists [H, ...] that change the speeds of the pinned hinges by what is missing; 0 of others."""
    numbers = np.arange(len(missing))
    matrix = jnp.where(pinned[:, None] & pinned, compliance, 0.0)
    matrix = matrix.at[numbers, numbers].add(jnp.where(pinned, LEAST * matrix[numbers, numbers], 1.0))

    def eliminate(k: int, system: tuple[Array, Array]) -> tuple[Array, Array]:
        matrix, values = system
        row, value = (jax.lax.dynamic_index_in_dim(x, k, keepdims=False) for x in (matrix, values))
        column = jax.lax.dynamic_index_in_dim(matrix, k, axis=1, keepdims=False)
        share = column / jax.lax.dynamic_index_in_dim(row, k, keepdims=False)
        share = jnp.where(numbers[:, None] == k, 0.0, share)
        return matrix - share[:, None] * row, values - share * value

    system = matrix, jnp.where(pinned, missing, 0.0)
    matrix, values = jax.lax.fori_loop(0, len(numbers), eliminate, system)
    return values / matrix[numbers, numbers]


def apply(
    hinges: JointBatch, moments: Array, table: Motion, old: Array, new: Array, params: SolverParams
) -> tuple[Motion, Work]:
    """Motions of all bodies with new twists in place of old ones, and the work, J [1, ...]; moments are inverse."""
    bodies, before = np.arange(len(moments))[:, None], relative_spins(hinges, table)
    sign = jnp.asarray(1.0 * (bodies == hinges.b.rows) - 1.0 * (bodies == hinges.a.rows), before.dtype)
    twist = materialize(new - old)
    moved = Motion(table.velocity, materialize(table.spin + moments * jnp.sum(sign[..., None] * twist, axis=1)))
    mean, bound = 0.5 * (before + relative_spins(hinges, moved)), params.step * hinges.motor_torque
    by_motor = jnp.clip(new, -bound, bound) - jnp.clip(old, -bound, bound)
    lost, driven = (by_motor - twist) * mean, by_motor * mean
    for side, outwards in ((hinges.a, -1), (hinges.b, 1)):
        if side.static.any():  # a kinematic body does work where it is held
            work = jnp.where(side.static[:, None], take_rows(moved.spin, side.rows) * twist, 0.0)
            driven = driven - outwards * work
    lost, driven = (jnp.sum(x, axis=-2, keepdims=True) for x in (lost, driven))
    return moved, Work(lost, driven, None)
