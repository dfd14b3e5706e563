"""Limits and motors of hinges, solved with the other joints.

A twist on a hinge, an angular impulse on b and its reaction on a, turns other bodies too, through the rigid joints.
The relative spins of all hinges change by W = E^T (M^-1 - M^-1 J^T (J M^-1 J^T)^-1 J M^-1) E times the twists, with
the directions E of the twists and the rows J of the joints (rigid_joints.py). Projected Gauss-Seidel over W gives the
impulses of limits, which only push, and of motors, whose torque is bounded.

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
SWEEPS = 8  # over several hinges; one needs a single sweep
LEAST = 1e-4  # share of a hinge's compliance that the joints leave at least, as the rest would be rounding


class HingeImpulses(NamedTuple):
    """Impulses of both limits, 0 or more, and of the motor of each hinge, N m s [H, ...]."""

    lower: Array
    upper: Array
    motor: Array

    @property
    def twist(self) -> Array:
        """Angular impulse on b, and the negative of that on a."""
        return self.lower - self.upper + self.motor


def zero_impulses(hinges: JointBatch | None) -> HingeImpulses | None:
    """Impulses before the first step; None without hinges."""
    return None if hinges is None else HingeImpulses(*[jnp.zeros_like(hinges.rest)] * 3)


def hinge_angles(hinges: JointBatch, angles: Array) -> Array:
    """Angles of b relative to a, less those at rest, rad [H, ...], from a table of the angles of all bodies."""
    return take_rows(angles, hinges.b.rows) - take_rows(angles, hinges.a.rows) - hinges.rest


def relative_spins(hinges: JointBatch, table: Motion) -> Array:
    """Spins of b relative to a, rad/s [H, ...]."""
    return take_rows(table.spin, hinges.b.rows) - take_rows(table.spin, hinges.a.rows)


def compliances(hinges: JointBatch) -> Array:
    """Relative spins of all hinges [H, H, ...] after a unit twist on each, without the other joints: E^T M^-1 E."""
    total = jnp.zeros_like(hinges.rest[:, None] + hinges.rest)
    for p, sign in ((hinges.a, -1.0), (hinges.b, 1.0)):
        for q, other in ((hinges.a, -1.0), (hinges.b, 1.0)):
            same = jnp.asarray(sign * other * (p.rows[:, None] == q.rows), total.dtype)
            total = total + same[..., None] * p.inertia.moment[:, None]
    return total


def solve(
    hinges: JointBatch,
    compliance: Array,
    speeds: Array,
    angle: Array,
    impulses: HingeImpulses,
    params: SolverParams,
    biased: bool,
) -> HingeImpulses:
    """Impulses after a pass.

    compliance: W, 1/(kg m^2) [H, H, ...]; speeds: relative spins of all hinges with these impulses, rad/s [H, ...];
    angle: that of each hinge at the start of the step, rad [H, ...].
    """
    count = len(hinges.a.rows)
    numbers = np.arange(count)
    own, alone = compliance[numbers, numbers], hinges.a.inertia.moment + hinges.b.inertia.moment
    mass = reciprocal(own, hinges.present & (own > LEAST * alone))
    rate = params.softness(HERTZ, DAMPING_RATIO)[0] if biased else 0.0
    limits = []
    for room in (angle - hinges.lower, hinges.upper - angle):
        limited = jnp.isfinite(room)
        room = jnp.where(limited, room, 1.0)
        slowest = -jnp.where(room > 0, room / params.step, rate * room)
        limits.append((slowest, jnp.where(limited, mass, 0.0)))
    constants = compliance, own, mass, params.step * hinges.motor_torque, hinges.motor_speed, *limits
    constants = materialize(constants)

    def one(speeds: Array, values: tuple) -> tuple[Array, HingeImpulses]:
        number, old, (row, own, mass, bound, motor_speed, low, high) = values
        speed = jax.lax.dynamic_index_in_dim(speeds, number, keepdims=False)
        motor = jnp.clip(old.motor - mass * (speed - motor_speed), -bound, bound)
        speed = speed + own * (motor - old.motor)
        lower = jnp.maximum(old.lower - low[1] * (speed - low[0]), 0.0)
        speed = speed + own * (lower - old.lower)
        new = HingeImpulses(lower, jnp.maximum(old.upper + high[1] * (speed + high[0]), 0.0), motor)
        return speeds + row * (new.twist - old.twist), new

    def sweep(carry: tuple, _: None) -> tuple[tuple, None]:
        speeds, old = carry
        return jax.lax.scan(one, speeds, (numbers, old, constants)), None

    return jax.lax.scan(sweep, (speeds, impulses), length=1 if count == 1 else SWEEPS)[0][1]


def apply(hinges: JointBatch, moments: Array, table: Motion, change: HingeImpulses) -> tuple[Motion, Work]:
    """Motions of all bodies, with these inverse moments, after more impulses, and the work of these, J [1, ...]."""
    bodies, before = np.arange(len(moments))[:, None], relative_spins(hinges, table)
    sign = jnp.asarray(1.0 * (bodies == hinges.b.rows) - 1.0 * (bodies == hinges.a.rows), before.dtype)
    twist = materialize(change.twist)
    new = Motion(table.velocity, materialize(table.spin + moments * jnp.sum(sign[..., None] * twist, axis=1)))
    mean = 0.5 * (before + relative_spins(hinges, new))
    driven = change.motor * mean
    for side, outwards in ((hinges.a, -1), (hinges.b, 1)):
        if side.static.any():  # a kinematic body does work where it is held
            work = jnp.where(side.static[:, None], take_rows(new.spin, side.rows) * twist, 0.0)
            driven = driven - outwards * work
    lost, driven = (jnp.sum(x, axis=-2, keepdims=True) for x in ((change.upper - change.lower) * mean, driven))
    return new, Work(lost, driven, None)
