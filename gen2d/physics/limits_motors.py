"""Limits and motors of hinges, solved with the other joints.

A twist on a hinge, an angular impulse on b and its reaction on a, turns other bodies too, through the rigid joints. So
the system of the joints (rigid_joints.py) has a row for the angle of each hinge. Each hinge is free, driven by its
motor with all of its torque, or pinned: to a limit, or to the speed of its motor. The rows of all pinned ones and of
the joints are solved at once, as a chain of pinned ones is a beam, which would take thousands of sweeps of one after
the other. A few rounds find which hinges these are, from those of the last step on (a primal-dual active set, M.
Hintermueller, K. Ito and K. Kunisch, 2002). Without an answer after ROUNDS, as where other joints do not let a hinge
turn to its limit, the limits of the video wait for the next pass. A pass keeps the twists alone: the joints are solved
again after it.

The first pass stops a hinge at its limit at the end of the step, and turns it back from beyond; the relaxing pass takes
the speed of turning back away.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.banded import factor, multiply, solve_factored
from gen2d.physics.constraint import Motion
from gen2d.physics.energy import Work
from gen2d.physics.params import SolverParams
from gen2d.physics.rigid_joints import (
    ANGLE,
    Anchors,
    JointSystem,
    bands_of,
    places_of_bodies,
    rows_at,
    speeds_along,
    table_of_changes,
    usable_rows,
)
from gen2d.physics.springs import JointBatch, groups_of, table_of, take_rows
from gen2d.records.axes import Array
from gen2d.xla import materialize

HERTZ, DAMPING_RATIO = 60.0, 5.0  # of turning back (E. Catto, 'Solver2D', 2024)
ROUNDS, LEAST_ROUNDS = 4, 2  # the second refines the solution of the first
COMPLIANCE = 5e-6  # relative to a row's diagonal: a beam of 30 locked bars needs a small one
UNSOLVED = 0.3  # share of the speeds to remove: more than this is left only where rows contradict each other


class LimitSystem(NamedTuple):
    """Hinges that may have limits or a motor, in the order of their rows."""

    joints: JointSystem  # all joints of the scene, with rows for the angles of these hinges
    hinges: JointBatch
    early: bool  # whether rounds end early, which has no reverse-mode derivative

    @property
    def rows(self) -> np.ndarray:
        """Row of the angle of each hinge, [H]."""
        return np.flatnonzero(self.joints.plan.direction == ANGLE)

    def at_rows(self, values: Array) -> Array:
        """Values of the hinges [H, ...] at the rows of their angles, 0 or False at others, [R, ...]."""
        places = np.full(len(self.joints.plan.joint), len(values))
        places[self.rows] = np.arange(len(values))
        return take_rows(jnp.concatenate([values, jnp.zeros_like(values[:1])]), places)


def zero_twists(system: LimitSystem | None) -> Array | None:
    """Twists before the first step, N m s [H, ...]; None without such hinges."""
    return None if system is None else jnp.zeros_like(system.hinges.rest)


def hinge_angles(hinges: JointBatch, angles: Array) -> Array:
    """Angles of b relative to a, less those at rest, rad [H, ...], from a table of the angles of all bodies."""
    return take_rows(angles, hinges.b.rows) - take_rows(angles, hinges.a.rows) - hinges.rest


def relative_spins(hinges: JointBatch, table: Motion) -> Array:
    """Spins of b relative to a, rad/s [H, ...]."""
    return take_rows(table.spin, hinges.b.rows) - take_rows(table.spin, hinges.a.rows)


class _Status(NamedTuple):
    """What pins each hinge, bool [H, ...]; a free one has no twist, or all of its motor's."""

    low: Array  # its lower limit
    high: Array
    at_speed: Array  # its motor, which has reached its speed

    @property
    def pinned(self) -> Array:
        """Whether anything does."""
        return self.low | self.high | self.at_speed


class _Hinges(NamedTuple):
    """What hinges do in a pass, each [H, ...]."""

    usable: Array  # bool: present, of bodies that can turn
    torque: Array  # N m s: the motor's largest twist; infinite if its limits lock the hinge
    motor: Array  # rad/s
    slowest: Array  # rad/s, by the lower limit; -infinite without one
    fastest: Array  # by the upper one

    def status(self, twists: Array) -> _Status:
        """Status of hinges that need these twists: a limit can only push back, and a motor has a largest torque."""
        # A motor that turns a hinge into a limit pushes with all of its torque there.
        low = twists > jnp.where(self.motor < self.slowest, -self.torque, self.torque)
        high = twists < jnp.where(self.motor > self.fastest, self.torque, -self.torque)
        low, high = low & jnp.isfinite(self.slowest), high & jnp.isfinite(self.fastest)
        return _Status(*(x & self.usable for x in (low, high, ~low & ~high & (jnp.abs(twists) < self.torque))))

    def updated(self, status: _Status, twists: Array, speeds: Array) -> _Status:
        """Status after a solution with another one, which gave these twists and relative spins."""
        needed = self.status(twists)
        free = self.usable & ~status.pinned
        reached = free & (jnp.where(twists > 0, speeds > self.motor, speeds < self.motor) & (self.torque > 0))
        low = (needed.low & status.low) | (free & (speeds < self.slowest))
        high = (needed.high & status.high) | (free & (speeds > self.fastest))
        return _Status(low, high, ~low & ~high & (needed.at_speed | reached))

    def target(self, status: _Status) -> Array:
        """Relative spin that pinned hinges have, rad/s."""
        return jnp.where(status.low, self.slowest, jnp.where(status.high, self.fastest, self.motor))


def _hinges(hinges: JointBatch, angle: Array, params: SolverParams, first: bool) -> _Hinges:
    """What hinges at these angles do in a pass; the first one turns back those that are beyond a limit."""
    rate = params.bias_rate(HERTZ, DAMPING_RATIO) if first else 0.0
    ends = []
    for sign, limit in ((-1.0, hinges.lower), (1.0, hinges.upper)):
        limited = jnp.isfinite(limit)
        room = sign * (jnp.where(limited, limit, 0.0) - angle)
        ends.append(jnp.where(limited, sign * jnp.where(room > 0, room / params.step, rate * room), sign * jnp.inf))
    usable = hinges.present & (hinges.a.inertia.moment + hinges.b.inertia.moment > 0)
    locked = hinges.lower == hinges.upper
    torque = jnp.where(locked, jnp.inf, params.step * hinges.motor_torque)
    motor = jnp.where(locked, jnp.clip(0.0, *ends), hinges.motor_speed)
    return _Hinges(usable, *materialize((torque, motor, *ends)))


class _Rounds(NamedTuple):
    """State of the rounds."""

    status: _Status  # for the next one
    twists: Array
    speeds: Array  # along all rows [R, ...]
    most: Array  # [...]: the largest of the speeds that the rounds had to remove
    failed: Array  # bool [...]: whether a limit of a video pulls, or contradicts the joints
    again: Array  # bool [...]: whether other limits would act in a video
    number: Array | int


def limit(
    system: LimitSystem,
    anchors: Anchors,
    motions: list[Motion],
    drifts: list[Motion] | None,
    fixed: list[Motion],
    angle: Array,
    twists: Array,
    params: SolverParams,
) -> tuple[list[Motion], Array, Work]:
    """Motions after the limits and motors of a pass, their twists, N m s [H, ...], and their work.

    The first pass limits the displacement, with its drifts, and begins with the twists of the last step, which the
    motions do not have yet; the relaxing pass has no drifts. The angles are those at the start of the step, rad
    [H, ...].
    """
    joints, hinges, _ = system
    first, now = drifts is not None, table_of(motions, fixed)
    mean, applied = now, twists
    if drifts is not None:
        mean = jax.tree.map(lambda x, y: x + y / params.step, now, table_of_changes(joints, drifts))
        applied = jnp.zeros_like(twists)
    rows = rows_at(joints, anchors)
    bands = bands_of(joints, rows)
    rigid, is_angle = usable_rows(joints, bands), (joints.plan.direction == ANGLE)[:, None]
    of, at_rows = _hinges(hinges, angle, params, first), system.at_rows

    def largest(speeds: Array, where: Array) -> Array:
        return jnp.max(jnp.where(where, jnp.abs(speeds), 0.0), axis=0)

    def solve_round(state: _Rounds) -> _Rounds:
        status, twists, speeds = state.status, state.twists, state.speeds
        free = jnp.clip(twists, -of.torque, of.torque)
        change = at_rows(jnp.where(status.pinned, 0.0, free - twists))
        speeds = materialize(speeds + multiply(bands, change))
        used, target = rigid & (~is_angle | at_rows(status.pinned)), at_rows(of.target(status))
        missing = materialize(speeds - target)
        more = materialize(-solve_factored(factor(bands, used, COMPLIANCE), missing))
        twists = jnp.where(status.pinned, twists + take_rows(more, system.rows), free)
        speeds = materialize(speeds + multiply(bands, more))
        new = of.updated(status, twists, take_rows(speeds, system.rows))
        others = jnp.any((new.low != status.low) | (new.high != status.high), axis=0)
        again, number = others | (state.number + 1 < LEAST_ROUNDS), state.number + 1
        most = jnp.maximum(state.most, largest(missing, used))
        pulls = jnp.any((status.low & ~new.low) | (status.high & ~new.high), axis=0)
        failed = pulls | (largest(speeds - target, used) > UNSOLVED * most)
        end = _Rounds(new, twists, speeds, most, failed, again, number)
        kept = jax.tree.map(lambda new, old: jnp.where(state.again, new, old), end, state)
        return kept._replace(number=number)

    speeds = speeds_along(joints, rows, mean)
    status = of.updated(of.status(twists), twists, take_rows(speeds, system.rows))
    speeds = materialize(speeds + multiply(bands, at_rows(twists - applied)))
    every = jnp.ones_like(speeds[0], bool)
    start = _Rounds(status, twists, speeds, jnp.zeros_like(speeds[0]), failed=~every, again=every, number=0)
    if system.early:
        end = jax.lax.while_loop(lambda now: jnp.any(now.again) & (now.number < ROUNDS), solve_round, start)
    else:
        end = jax.lax.fori_loop(0, ROUNDS, lambda _, now: solve_round(now), start)
    new = jnp.where(end.failed, jnp.clip(twists, -of.torque, of.torque), end.twists)
    now, work = apply(system, now, applied, new, params)
    return groups_of(now, motions), new, work


def apply(system: LimitSystem, table: Motion, old: Array, new: Array, params: SolverParams) -> tuple[Motion, Work]:
    """Motions of all bodies with new twists in place of old ones, and the work, J [1, ...]."""
    hinges, twist = system.hinges, materialize(new - old)
    before, moments = relative_spins(hinges, table), system.joints.inertia.moment
    bodies = places_of_bodies(np.concatenate([hinges.a.rows, hinges.b.rows]), len(moments))
    parts = jnp.concatenate([-twist, twist, jnp.zeros_like(twist[:1])])
    total = functools.reduce(jnp.add, (take_rows(parts, places) for places in bodies))
    moved = Motion(table.velocity, materialize(table.spin + moments * total))
    mean, bound = 0.5 * (before + relative_spins(hinges, moved)), params.step * hinges.motor_torque
    by_motor = jnp.clip(new, -bound, bound) - jnp.clip(old, -bound, bound)
    lost, driven = (by_motor - twist) * mean, by_motor * mean
    for side, outwards in ((hinges.a, -1), (hinges.b, 1)):
        if side.static.any():  # a kinematic body does work where it is held
            work = jnp.where(side.static[:, None], take_rows(moved.spin, side.rows) * twist, 0.0)
            driven = driven - outwards * work
    lost, driven = (jnp.sum(x, axis=-2, keepdims=True) for x in (lost, driven))
    return moved, Work(lost, driven, None)
