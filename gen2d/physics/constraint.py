"""A row of the solver: pairs of bodies that are solved at once, and the impulses at one point of contact of each.

All arrays are [pairs, ...], vectors [2, pairs, ...], scenes last. Velocity at a point r from the centre of mass is
v + spin x r, so a normal impulse has the lever r x n and a tangential one r . n; discs have a normal lever of zero, and
the tangential one is their radius.
"""

from typing import NamedTuple, TypeAlias

import jax.numpy as jnp

from gen2d.physics.collision import FAR, Point, dot, turned
from gen2d.physics.params import SolverParams
from gen2d.physics.time_of_impact import MISSES
from gen2d.records.axes import Array


class Inertia(NamedTuple):
    """One over mass (1/kg) and over moment of inertia (1 / (kg m^2)); zero of what nothing can move."""

    mass: Array
    moment: Array


class Motion(NamedTuple):
    """How bodies move while they are solved; also by how much impacts change where they go."""

    velocity: Array  # [2, N, ...] m/s; m
    spin: Array  # [N, ...] rad/s; rad


class Impulse(NamedTuple):
    """Accumulated impulses at a point; what is left of them at the end of a step warm-starts the next."""

    normal: Array  # N s
    tangent: Array  # N s


class ContactFrame(NamedTuple):
    """How an impulse at a point becomes motion. A lever that is None is zero, always."""

    normal_a: Array | None  # m
    normal_b: Array | None
    tangent_a: Array | None
    tangent_b: Array
    k_normal: Array  # 1/kg: speed that a unit impulse gives
    k_tangent: Array
    normal_mass: Array  # one over it; zero where there is nothing to push
    tangent_mass: Array


class ContactConstraint(NamedTuple):
    """What stays the same of a row for a whole video. Where not both bodies are `present` it has no mass."""

    a: Inertia | None  # None: nothing moves it
    b: Inertia
    present: Array
    elasticity: Array
    friction: Array
    rolling: Array | None  # m: torque over normal force
    grip: ContactFrame | None  # of two discs, or of a disc on something fixed; of others it changes with every step
    firm: bool  # against something fixed: twice as stiff
    # Of a fixed segment, where others go on from its ends: two directions [2, 1, ...], zero where there is none.
    left: tuple[Array, Array] | None = None
    right: tuple[Array, Array] | None = None


class CoreOffset(NamedTuple):
    """What the impact of two round shapes needs to know, or of a disc and the core line of another shape."""

    apart: Array  # [2, ...] m: offset of the centres, or of the disc from the core line
    reach: Array  # m: sum of the radii
    flat: Array | None  # where the core line's middle, not its end, is nearest; None: two discs


class ContactPoint(NamedTuple):
    """A point of a row as the step begins."""

    grip: ContactFrame
    normal: Array
    gap: Array
    pressed: Array  # N s: normal impulse of the last step
    fall: Array | None  # [2, ...] m/s^2: acceleration of b over a; None where they fall alike
    place: Array | None  # [2, ...] m: of the point, or of b's centre where b is a disc; None where nobody asks
    core: CoreOffset | None = None  # None: of shapes with corners


class ActiveContact(NamedTuple):
    """A point of a row as it stands in this step; tau < 0 where it does not bounce (impacts.py)."""

    grip: ContactFrame
    normal: Array
    gap: Array
    tau: Array
    arrival: Array  # m/s: approach speed at tau
    target: Array  # m/s: normal speed at the end of the step, of a bounce
    place: Array | None  # [2, ...] m: of the point; None where nobody asks


def reciprocal(x: Array, usable: Array) -> Array:
    """1 / x where it is usable, else 0; finite in its gradient, too."""
    return jnp.where(usable, 1 / jnp.where(usable, x, 1.0), 0.0)


def mix_materials(a: Array, b: Array, mixing: str) -> Array:
    """The coefficient of a pair."""
    return {"mean": (a + b) / 2, "product": a * b, "max": jnp.maximum(a, b), "geometric": jnp.sqrt(a * b)}[mixing]


def frame_of(
    row: ContactConstraint, levers: tuple[Array | None, Array | None, Array | None, Array], near: Array
) -> ContactFrame:
    """The grip with these levers: normal a, normal b, tangent a, tangent b; no mass where it is not `near`."""
    normal_a, normal_b, tangent_a, tangent_b = levers
    k_mass, moment_a = row.b.mass, 0.0
    if row.a is not None:
        k_mass, moment_a = row.a.mass + row.b.mass, row.a.moment

    def k(a: Array | None, b: Array | None) -> Array:
        of_a = 0.0 if a is None else moment_a * a**2
        return k_mass + of_a + (0.0 if b is None else row.b.moment * b**2)

    ks = k(normal_a, normal_b), k(tangent_a, tangent_b)
    return ContactFrame(*levers, *ks, *(reciprocal(k, near) for k in ks))


def frame_at(row: ContactConstraint, point: Point) -> ContactFrame:
    """The grip of a point of contact."""
    (ax, ay), (bx, by), (nx, ny) = point.arm_a, point.arm_b, point.normal
    a = (None, None) if row.a is None else (ax * ny - ay * nx, ax * nx + ay * ny)
    levers = a[0], bx * ny - by * nx, a[1], bx * nx + by * ny
    return frame_of(row, levers, row.present & (point.gap < FAR / 2))


def relative(grip: ContactFrame, normal: Array, a: Motion | None, b: Motion) -> tuple[Array, Array]:
    """Normal and tangential speed of b over a at the point, m/s."""
    velocity = b.velocity if a is None else b.velocity - a.velocity
    speed = dot(normal, velocity)
    slip = normal[0] * velocity[1] - normal[1] * velocity[0] + grip.tangent_b * b.spin
    if grip.normal_b is not None:
        speed = speed + grip.normal_b * b.spin
    if a is not None and grip.normal_a is not None:
        speed = speed - grip.normal_a * a.spin
    if a is not None and grip.tangent_a is not None:
        slip = slip - grip.tangent_a * a.spin
    return speed, slip


Components: TypeAlias = tuple[Array | None, Array | None]  # of an impulse or its levers: normal, tangential; None: zero


def _twist(levers: Components, impulse: Components) -> Array | float:
    parts = zip(levers, impulse, strict=True)
    found = [lever * p for lever, p in parts if lever is not None and p is not None]
    return sum(found[1:], found[0]) if found else 0.0


def apply_impulse(
    row: ContactConstraint, at: ContactPoint | ActiveContact, impulse: Impulse | Components, a: Motion | None, b: Motion
) -> tuple[Motion | None, Motion]:
    """Both motions after the impulse on b and its reaction on a."""
    grip, directions = at.grip, (at.normal, turned(at.normal))
    parts = [p * d for p, d in zip(impulse, directions, strict=True) if p is not None]
    push = sum(parts[1:], parts[0])
    turn = _twist((grip.normal_b, grip.tangent_b), impulse)
    b = Motion(b.velocity + row.b.mass * push, b.spin + row.b.moment * turn)
    if row.a is None or a is None:
        return a, b
    turn = _twist((grip.normal_a, grip.tangent_a), impulse)
    return Motion(a.velocity - row.a.mass * push, a.spin - row.a.moment * turn), b


def add_impulses(new: Impulse, old: Impulse) -> Impulse:
    """What a solve added to an impulse."""
    return Impulse(new.normal - old.normal, new.tangent - old.tangent)


def softness(row: ContactConstraint, rules: SolverParams) -> tuple[float, float, float]:
    """`Rules.softness` of a row's overlaps."""
    return rules.softness(2 * rules.hertz if row.firm else rules.hertz, rules.damping_ratio)


def biased_impulse(
    row: ContactConstraint, touch: ActiveContact, speed: Array, old: Impulse, rules: SolverParams
) -> Array:
    """The accumulated normal impulse after the biased solve of a row.

    Apart: the gap may be closed, no more. Overlapping: a soft push. Bouncing: its target exactly. Passing: nothing, as
    the straight line of a soft contact would stop a body that only grazes the other, or that comes a step later.
    """
    rate, mass_scale, impulse_scale = softness(row, rules)
    apart, mass = touch.gap > 0, touch.grip.normal_mass
    bias = jnp.where(apart, touch.gap / rules.step, jnp.maximum(rate * touch.gap, -rules.push_speed))
    soft = old.normal - jnp.where(apart, 1.0, mass_scale) * mass * (speed + bias)
    soft = jnp.maximum(soft - jnp.where(apart, 0.0, impulse_scale) * old.normal, 0.0)
    soft = jnp.where(touch.tau == MISSES, 0.0, soft)
    hard = old.normal + mass * (touch.target - speed)
    return jnp.where(mass > 0, jnp.where(touch.tau >= 0, hard, soft), 0.0)


def impact_impulse(touch: ActiveContact, speed: Array, threshold: Array) -> Array:
    """Where a neighbour's bounce has closed a row that is in contact: it bounces, too."""
    return (speed < -threshold) & (touch.gap <= 0) & (touch.grip.normal_mass > 0)


def relaxed_impulse(
    row: ContactConstraint, touch: ActiveContact, speed: Array, old: Impulse, threshold: Array
) -> Array:
    """The accumulated normal impulse after the relaxing solve, without bias.

    No say has a row that bounced and parts, one that is apart and carried nothing (it would brake a body one step
    before its impact), and one that a neighbour closes across a gap (it bounces in a later step).
    """
    mass = touch.grip.normal_mass
    pushes = (touch.tau < 0) & ((old.normal > 0) | (touch.gap <= 0)) & (speed >= -threshold) & (mass > 0)
    soft = jnp.where(pushes, jnp.maximum(old.normal - mass * speed, 0.0), old.normal)
    hard = old.normal - (1 + row.elasticity) * mass * speed
    return jnp.where(impact_impulse(touch, speed, threshold), hard, soft)


def friction_impulse(
    row: ContactConstraint, touch: ActiveContact, normal_impulse: Array, slip: Array, old: Impulse
) -> Array:
    """The accumulated tangential impulse: what stops the slip, within Coulomb's bound of the normal impulse now.

    Without a bound there is none; said so, as the gradient of a clip between two zeros is not zero.
    """
    bound = row.friction * normal_impulse
    rub = jnp.clip(old.tangent - touch.grip.tangent_mass * slip, -bound, bound)
    return jnp.where(bound > 0, rub, 0.0)


def spin_change(row: ContactConstraint, roll: Array, a: Motion | None, b: Motion) -> tuple[Motion | None, Motion]:
    """Both motions after an angular impulse on b and its reaction on a."""
    b = b._replace(spin=b.spin + row.b.moment * roll)
    if row.a is None or a is None:
        return a, b
    return a._replace(spin=a.spin - row.a.moment * roll), b


def turning(a: Motion | None, b: Motion) -> Array:
    """Spin of b over a, rad/s."""
    return b.spin if a is None else b.spin - a.spin


def rolling_impulse(row: ContactConstraint, normal_impulse: Array, a: Motion | None, b: Motion, old: Array) -> Array:
    """The accumulated angular impulse that stops rolling, within its bound of the normal impulse now."""
    assert row.rolling is not None, "only rows with rolling resistance have such an impulse"
    k = row.b.moment if row.a is None else row.a.moment + row.b.moment
    mass = reciprocal(k, row.present & (k > 0))
    bound = row.rolling * normal_impulse
    return jnp.clip(old - mass * turning(a, b), -bound, bound)
