"""A batch of contact constraints, and the impulses at one point of each.

Arrays are [pairs, ...], vectors [2, pairs, ...], scenes last. The velocity at a point r from the centre of mass is
v + spin x r, so a normal impulse has the lever r x n and a tangential one r . n. A disc's normal lever is zero, its
tangential one the radius.
"""

from typing import NamedTuple, TypeAlias

import jax.numpy as jnp

from gen2d.physics.collision import FAR, ManifoldPoint, dot, perpendicular
from gen2d.physics.segment_lines import Neighbours
from gen2d.physics.symmetric import product
from gen2d.records.axes import Array


class Inertia(NamedTuple):
    """Inverse mass (1/kg) and inverse moment of inertia (1 / (kg m^2)); zero for bodies that nothing moves."""

    mass: Array
    moment: Array


class Motion(NamedTuple):
    """Velocity and spin of bodies, or a displacement and an angle."""

    velocity: Array  # [2, N, ...] m/s; m
    spin: Array  # [N, ...] rad/s; rad


class Impulse(NamedTuple):
    """Accumulated impulses at a point."""

    normal: Array  # N s
    tangent: Array  # N s


class ContactFrame(NamedTuple):
    """Levers and effective masses of a contact point. A lever that is None is always zero."""

    normal_a: Array | None  # m
    normal_b: Array | None
    tangent_a: Array | None
    tangent_b: Array
    k_normal: Array  # 1/kg: speed per unit impulse
    k_tangent: Array
    normal_mass: Array  # its inverse; zero without contact
    tangent_mass: Array


class ContactConstraint(NamedTuple):
    """Constants of a batch of pairs over a video. A pair has no mass unless both bodies are `present`."""

    a: Inertia | None  # None: nothing moves it
    b: Inertia
    present: Array
    elasticity: Array
    friction: Array
    rolling: Array | None  # m: torque over normal force
    frame: ContactFrame | None  # of two discs, or a disc on a static body at rest; else it changes from step to step
    static: bool  # against a static or kinematic body: twice as stiff
    neighbours: Neighbours | None = None  # of a static segment
    schur_a: Array | None = None  # [6, pairs, ...] what rigid joints take from the inverse mass (jointed.py)
    schur_b: Array | None = None


class CoreOffset(NamedTuple):
    """Geometry of the impact of two round shapes, or of a disc and the core line of another shape."""

    offset: Array  # [2, ...] m: between the centres, or from the core line to the disc
    reach: Array  # m: sum of the radii
    flat: Array | None  # whether the nearest point of the core line is not an end; None: two discs


class ContactPoint(NamedTuple):
    """A contact point at the start of a step."""

    frame: ContactFrame
    normal: Array
    gap: Array
    last_normal: Array  # N s: normal impulse of the last step
    acceleration: Array | None  # [2, ...] m/s^2: of b relative to a; None: equal
    position: Array | None  # [2, ...] m: of the point, or of b's centre if b is a disc; None: not logged
    core: CoreOffset | None = None  # None: shapes with corners
    moves_with_a: bool = False  # a is a disc, and the point moves with it; else with b
    stop: Array | None = None  # N s: normal impulse that is known before the first pass; None: of static bodies


class ActiveContact(NamedTuple):
    """A contact point with its impact in this step."""

    frame: ContactFrame
    normal: Array
    gap: Array
    tau: Array  # s: time of impact; negative without a bounce (time_of_impact.py)
    arrival: Array  # m/s: approach speed at tau
    fall: Array | float  # m/s: approach speed that the acceleration adds after tau
    position: Array | None  # [2, ...] m: of the point; None: not logged


def reciprocal(x: Array, usable: Array) -> Array:
    """1 / x where usable, else 0, with a finite gradient."""
    return jnp.where(usable, 1 / jnp.where(usable, x, 1.0), 0.0)


def mix_materials(a: Array, b: Array, mixing: str) -> Array:
    """Coefficient of a pair from those of its bodies."""
    return {"mean": (a + b) / 2, "product": a * b, "max": jnp.maximum(a, b), "geometric": jnp.sqrt(a * b)}[mixing]


def frame_of(
    constraint: ContactConstraint, levers: tuple[Array | None, Array | None, Array | None, Array], near: Array
) -> ContactFrame:
    """Frame with these levers (normal a, normal b, tangent a, tangent b), without mass where not `near`."""
    normal_a, normal_b, tangent_a, tangent_b = levers
    k_mass, moment_a = constraint.b.mass, 0.0
    if constraint.a is not None:
        k_mass, moment_a = constraint.a.mass + constraint.b.mass, constraint.a.moment

    def k(a: Array | None, b: Array | None) -> Array:
        k_a = 0.0 if a is None else moment_a * a**2
        return k_mass + k_a + (0.0 if b is None else constraint.b.moment * b**2)

    ks = k(normal_a, normal_b), k(tangent_a, tangent_b)
    return ContactFrame(*levers, *ks, *(reciprocal(k, near) for k in ks))


def frame_at(constraint: ContactConstraint, point: ManifoldPoint) -> ContactFrame:
    """Frame of a point of contact."""
    (ax, ay), (bx, by), (nx, ny) = point.arm_a, point.arm_b, point.normal
    a = (None, None) if constraint.a is None else (ax * ny - ay * nx, ax * nx + ay * ny)
    levers = a[0], bx * ny - by * nx, a[1], bx * nx + by * ny
    return frame_of(constraint, levers, constraint.present & (point.gap < FAR / 2))


def relative_velocity(a: Motion | None, b: Motion) -> Array:
    """Velocity [2, ...] in m/s, or displacement in m, of b relative to a."""
    return b.velocity if a is None else b.velocity - a.velocity


def relative_speed(frame: ContactFrame, normal: Array, a: Motion | None, b: Motion) -> tuple[Array, Array]:
    """Normal and tangential speed of b relative to a at the point, m/s."""
    velocity = relative_velocity(a, b)
    speed = dot(normal, velocity)
    slip = normal[0] * velocity[1] - normal[1] * velocity[0] + frame.tangent_b * b.spin
    if frame.normal_b is not None:
        speed = speed + frame.normal_b * b.spin
    if a is not None and frame.normal_a is not None:
        speed = speed - frame.normal_a * a.spin
    if a is not None and frame.tangent_a is not None:
        slip = slip - frame.tangent_a * a.spin
    return speed, slip


def speed_bound(velocity: Array) -> Array:
    """Bound on the speeds of velocities [2, ...], m/s: |x| + |y|."""
    x, y = jnp.abs(velocity)
    return x + y


Components: TypeAlias = tuple[Array | None, Array | None]  # normal and tangential; None: zero


def _angular(levers: Components, impulse: Components) -> Array | float:
    """Angular impulse of an impulse, N m s."""
    parts = zip(levers, impulse, strict=True)
    terms = [lever * p for lever, p in parts if lever is not None and p is not None]
    return sum(terms[1:], terms[0]) if terms else 0.0


def apply_impulse(
    constraint: ContactConstraint,
    point: ContactPoint | ActiveContact,
    impulse: Impulse | Components,
    a: Motion | None,
    b: Motion,
) -> tuple[Motion | None, Motion]:
    """Both motions after the impulse on b and its reaction on a."""
    frame, directions = point.frame, (point.normal, perpendicular(point.normal))
    parts = [p * d for p, d in zip(impulse, directions, strict=True) if p is not None]
    linear = sum(parts[1:], parts[0])
    angular = _angular((frame.normal_b, frame.tangent_b), impulse)
    b = _after_impulse(b, constraint.b, constraint.schur_b, linear, angular)
    if constraint.a is None or a is None:
        return a, b
    angular = _angular((frame.normal_a, frame.tangent_a), impulse)
    return _after_impulse(a, constraint.a, constraint.schur_a, -linear, -angular), b


def _after_impulse(
    motion: Motion, inverse: Inertia, schur: Array | None, linear: Array, angular: Array | float
) -> Motion:
    """Motion after an impulse, N s [2, ...] and N m s."""
    new = Motion(motion.velocity + inverse.mass * linear, motion.spin + inverse.moment * angular)
    if schur is None:
        return new
    velocity, spin = product(schur, (linear, angular + jnp.zeros_like(motion.spin)))
    return Motion(new.velocity - velocity, new.spin - spin)


def impulse_change(new: Impulse, old: Impulse) -> Impulse:
    """Difference of two accumulated impulses."""
    return Impulse(new.normal - old.normal, new.tangent - old.tangent)


def impulse_vectors(normal: Array, impulse: Impulse) -> Impulse:
    """Normal and tangential impulse as vectors [2, ...], N s."""
    return Impulse(impulse.normal * normal, impulse.tangent * perpendicular(normal))
