"""What the three passes of a step do to a row: warm starting, the biased solve, the relaxing solve.

A row is any number of pairs; dense.py hands it all pairs of a round, sparse.py those that are near each other.
"""

import functools
from collections.abc import Callable

import jax.numpy as jnp

from gen2d.physics.constraint import (
    ActiveContact,
    ContactConstraint,
    ContactPoint,
    Impulse,
    Motion,
    add_impulses,
    apply_impulse,
    biased_impulse,
    friction_impulse,
    impact_impulse,
    relative,
    relaxed_impulse,
    rolling_impulse,
    softness,
    spin_change,
)
from gen2d.physics.contact_points import both_points, bounce_threshold, contact_points, impact_of
from gen2d.physics.contact_state import Displacement, PassSetup, SolvedPair, WarmStart
from gen2d.physics.energy import Work, dissipated, dissipated_by_discs
from gen2d.physics.params import SolverParams
from gen2d.records.axes import Array
from gen2d.xla import materialize


def _exchange(
    row: ContactConstraint, was: SolvedPair, press: Callable, a: Motion | None, b: Motion, work: Work | None
) -> tuple[Motion | None, Motion, SolvedPair, Work | None]:
    """Both motions after a row's normal impulses, its friction and what resists its rolling; the row; the work.

    `press(i, touch, speed, old)` gives the accumulated normal impulse at point i.
    """
    before, roll = (a, b), was.roll
    if row.grip is not None and roll is None:
        # What presses two discs gives them no slip, so both impulses can be had at once.
        (at,), (old,) = was.touches, was.impulses
        speed, slip = relative(at.grip, at.normal, a, b)
        pressed = materialize(press(0, at, speed, old))
        impulse = Impulse(pressed, materialize(friction_impulse(row, at, pressed, slip, old)))
        more = add_impulses(impulse, old)
        a, b = apply_impulse(row, at, more, a, b)
        return a, b, SolvedPair(was.touches, [impulse], None), dissipated_by_discs(work, row.grip, more, speed, slip)
    pressed, impulses = [], []
    for i, (at, old) in enumerate(zip(was.touches, was.impulses, strict=True)):
        speed, _ = relative(at.grip, at.normal, a, b)
        pressed.append(materialize(press(i, at, speed, old)))
        a, b = apply_impulse(row, at, (pressed[-1] - old.normal, None), a, b)
    for at, old, normal in zip(was.touches, was.impulses, pressed, strict=True):
        _, slip = relative(at.grip, at.normal, a, b)
        impulses.append(Impulse(normal, materialize(friction_impulse(row, at, normal, slip, old))))
        a, b = apply_impulse(row, at, (None, impulses[-1].tangent - old.tangent), a, b)
    if roll is not None:
        roll = materialize(rolling_impulse(row, sum(pressed[1:], pressed[0]), a, b, roll))
        a, b = spin_change(row, roll - was.roll, a, b)
    more = [add_impulses(new, old) for new, old in zip(impulses, was.impulses, strict=True)]
    twist = None if roll is None else roll - was.roll
    return (
        a,
        b,
        SolvedPair(was.touches, impulses, roll),
        dissipated(work, row, was.touches, more, twist, before, (a, b)),
    )


def warm_start(
    row: ContactConstraint, memory: WarmStart, a: tuple, b: tuple, setup: PassSetup
) -> tuple[tuple, tuple, list[ContactPoint]]:
    """Both sides with the last step's impulses, and the row's points.

    A side is its shape, motion, acceleration (None where all fall alike) and work; a fixed one has no motion where it
    stands still.
    """
    (shape_a, motion_a, fall_a, _), (shape_b, motion_b, fall_b, work) = a, b
    olds, roll = kept_impulses(memory.impulses), memory.roll
    fall = setup.gravity if row.firm else None
    if fall_b is not None:
        fall = fall_b if row.firm else fall_b - fall_a
    points = contact_points(row, shape_a, shape_b, [jnp.abs(old.normal) for old in memory.impulses], fall, setup)
    new_a, new_b = motion_a, motion_b
    for at, old in zip(points, olds, strict=True):
        new_a, new_b = apply_impulse(row, at, old, new_a, new_b)
    if roll is not None:
        new_a, new_b = spin_change(row, roll, new_a, new_b)
    if row.grip is not None and roll is None:
        speeds = relative(row.grip, points[0].normal, motion_a, motion_b)
        work = dissipated_by_discs(work, row.grip, olds[0], *speeds)
    else:
        work = dissipated(work, row, points, olds, roll, (motion_a, motion_b), (new_a, new_b))
    new_b = materialize(new_b) if row.firm else new_b
    return (shape_a, new_a, fall_a, a[3]), (shape_b, new_b, fall_b, work), points


HELD = 1e-9  # m/s: the push of a contact that does not push


def _pushes(
    row: ContactConstraint,
    points: list[ActiveContact],
    impulses: list[Impulse],
    a: Displacement | None,
    b: Displacement,
    rules: SolverParams,
) -> Array:
    """What a row's contact may add to its bodies' speeds, or hand on; 0 where there is none but an impact."""
    rate, *_ = softness(row, rules)
    found = b.push if a is None else jnp.maximum(a.push, b.push)
    pushes = jnp.zeros_like(found)
    for at, impulse in zip(points, impulses, strict=True):
        own = jnp.maximum(found, jnp.clip(-rate * at.gap, HELD, rules.push_speed))
        pushes = jnp.maximum(pushes, jnp.where((at.tau < 0) & (impulse.normal > 0), own, 0.0))
    return pushes


def _drifted(drift: Displacement, points: list[ActiveContact], pushes: Array, old: Motion, new: Motion) -> Displacement:
    """The drift with what the time of an impact takes off the way.

    Of two points that bounce in the same step the way counts from the mean of their times.
    """
    tau = jnp.maximum(points[0].tau, 0.0)
    if len(points) == 2:
        second = jnp.maximum(points[1].tau, 0.0)
        both = (points[0].tau >= 0) & (points[1].tau >= 0)
        tau = jnp.where(both, 0.5 * (tau + second), tau + second)
    way = Motion(drift.way.velocity - tau * (new.velocity - old.velocity), drift.way.spin - tau * (new.spin - old.spin))
    return Displacement(way, jnp.maximum(drift.push, pushes))


def solve(
    row: ContactConstraint,
    memory: WarmStart,
    found: list[ContactPoint],
    a: tuple,
    b: tuple,
    setup: PassSetup,
    rules: SolverParams,
) -> tuple[tuple, tuple, SolvedPair]:
    """Both sides after the biased solve, and the row. A side is its motion, drift and work."""
    (motion_a, drift_a, _), (motion_b, drift_b, work) = a, b
    points = [impact_of(row, at, a[:2], b[:2], setup, rules.step) for at in found]
    both = both_points(row, points, [relative(p.grip, p.normal, motion_a, motion_b)[0] for p in points])

    def press(i: int, touch: ActiveContact, speed: Array, old: Impulse) -> Array:
        alone = biased_impulse(row, touch, speed, old, rules)
        together = both[i]
        return alone if together is None else jnp.where(together >= 0, old.normal + together, alone)

    was = SolvedPair(points, kept_impulses(memory.impulses), memory.roll)
    new_a, new_b, solved, work = _exchange(row, was, press, motion_a, motion_b, work)
    pushes = _pushes(row, points, solved.impulses, drift_a, drift_b, rules)
    drift_b = _drifted(drift_b, points, pushes, motion_b, new_b)
    if row.a is not None and drift_a is not None and new_a is not None:
        drift_a = _drifted(drift_a, points, pushes, motion_a, new_a)
    new_b, drift_b = materialize((new_b, drift_b)) if row.firm else (new_b, drift_b)
    return (new_a, drift_a, a[2]), (new_b, drift_b, work), solved


JOLT = 1.0  # m/s: what is faster than this is an impact, also in a pile


def _left(at: ActiveContact, bounced: Array, impulse: Impulse) -> Impulse:
    """What the next step starts with.

    Impacts do not warm-start the next step, so `kept_impulses` drops negative impulses. The impulse is stored negated
    when the bodies were already touching, so that a resting pile mistaken for an impact recovers in the next step.
    """
    told = jnp.minimum(impulse.normal, JOLT * at.grip.normal_mass)
    normal = jnp.where(bounced, jnp.where(at.gap <= 0, -told, 0.0), impulse.normal)
    return Impulse(normal, jnp.where(bounced, 0.0, impulse.tangent))


def kept_impulses(impulses: list[Impulse]) -> list[Impulse]:
    """What warm-starts a step, of what the last one left."""
    return [Impulse(jnp.maximum(i.normal, 0.0), i.tangent) for i in impulses]


def relax(
    row: ContactConstraint, solved: SolvedPair, a: tuple, b: tuple, setup: PassSetup
) -> tuple[tuple, tuple, tuple[SolvedPair, WarmStart]]:
    """Both sides after the relaxing solve, the row, and what it leaves to the next step.

    A side is its motion, the push of its drift, and its work.
    """
    (motion_a, push_a, _), (motion_b, push_b, work), again = a, b, []

    def press(_: int, touch: ActiveContact, speed: Array, old: Impulse) -> Array:
        threshold = bounce_threshold(touch, jnp.where(touch.tau < 0, old.normal, 0.0), push_a, push_b, setup)
        again.append(impact_impulse(touch, speed, threshold))
        return relaxed_impulse(row, touch, speed, old, threshold)

    new_a, new_b, now, work = _exchange(row, solved, press, motion_a, motion_b, work)
    left = []
    for at, hit, impulse in zip(now.touches, again, now.impulses, strict=True):
        left.append(_left(at, (at.tau >= 0) | hit, impulse))
    left = materialize(left)
    new_b = materialize(new_b) if row.firm else new_b
    return (new_a, *a[1:]), (new_b, push_b, work), (now, WarmStart(left, now.roll))


def touching(solved: SolvedPair, last: SolvedPair) -> Array:
    """Whether anything pressed the two of a row together in a step, in its biased solve or in its last one."""
    pressed = [i.normal > 0 for row in (solved, last) for i in row.impulses]
    return functools.reduce(jnp.logical_or, pressed)
