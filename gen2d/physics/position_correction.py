"""Overlaps corrected by displacements of their own (split impulses), which leave no velocity.

A pair that overlaps at the start of a step is pushed apart in it by the share of the overlap that a damped spring would
correct, at most at `push_speed`. A push is the displacement of an impulse at the contact, without its velocity. So a
body that is pushed out of another one does not strike a third, and the impulse of a contact at rest is its load alone,
which neither leaks nor grows.

Two bodies that are pushed apart while they slide past each other would gain angular momentum. As under a central force,
their relative velocity across the contact falls as their distance grows.

Source: E. Guendelman, R. Bridson and R. Fedkiw (2003) and E. Catto (2006) for corrections without velocities.
"""

import functools

import jax
import jax.numpy as jnp

from gen2d.physics.collision import dot, perpendicular
from gen2d.physics.constraint import (
    ActiveContact,
    ContactConstraint,
    Impulse,
    Inertia,
    Motion,
    apply_impulse,
    relative_speed,
    relative_velocity,
)
from gen2d.physics.contact_state import BodySide, PassSetup
from gen2d.physics.energy import Work
from gen2d.physics.normal_impulse import NormalTarget, solve_normals
from gen2d.physics.params import SolverParams
from gen2d.physics.support import SupportedContacts
from gen2d.physics.time_of_impact import SLOWEST
from gen2d.records.axes import Array
from gen2d.xla import materialize


def correct_positions(
    constraint: ContactConstraint,
    contacts: list[ActiveContact],
    seen: SupportedContacts,
    acceleration: Array | None,
    a: BodySide,
    b: BodySide,
    setup: PassSetup,
    params: SolverParams,
) -> tuple[BodySide, BodySide]:
    """Both sides with drifts that push the pair apart where it overlaps.

    `acceleration` is that of b relative to a, and `seen` are the contacts with what supports leave of their bodies. An
    overlap that speeds below the bounce threshold cause in one step stays, so that contacts at rest do not part.
    """
    assert b.motion is not None, "only static bodies lack a motion"
    assert b.drift is not None, "only static bodies lack a drift"
    h, allowed = params.step, 0.5 * params.step * setup.threshold
    rate = params.bias_rate(2 * params.hertz if constraint.static else params.hertz, params.damping_ratio)
    ends = seen.kept((None if a.motion is None else _end(a.motion, a.drift, h), _end(b.motion, b.drift, h)))
    zero, gaps, targets = jnp.zeros_like(contacts[0].gap), [], []
    pushed, taken = seen.pushed(contacts)
    for contact in pushed:
        moved, _ = relative_speed(contact.frame, contact.normal, *ends)
        fall = 0.0 if acceleration is None else -0.5 * h**2 * dot(contact.normal, acceleration)
        gaps.append(contact.gap + moved + fall)
        deep = jnp.maximum(-contact.gap - allowed, 0.0)
        wanted = contact.gap + jnp.minimum(h * rate * deep, h * params.push_speed)
        overlaps = (deep > 0) & (contact.frame.normal_mass > 0)
        targets.append(NormalTarget(overlaps, wanted, zero, jnp.zeros_like(overlaps)))
    nothing = [Impulse(zero, zero)] * len(contacts)
    pushes = materialize(solve_normals(constraint, pushed, gaps, nothing, targets, taken))  # kg m
    drifts = a.drift, b.drift
    for contact, push in zip(contacts, pushes, strict=True):
        drifts = apply_impulse(constraint, contact, (push, None), *drifts)
    drifts = seen.kept(drifts)
    new_a, new_b = a._replace(drift=drifts[0]), b._replace(drift=drifts[1])
    if constraint.a is None or a.motion is None or constraint.static or b.joint_motion is not None:
        return new_a, new_b
    push = functools.reduce(jnp.add, pushes)
    if seen.crush is not None:
        push = jnp.where(seen.crush.crushed, 0.0, push)  # obstacles take up the angular momentum
    work, of_a, of_b = _slowed((constraint.a, constraint.b), contacts[0], push, a.motion, b.motion, b.work)
    return new_a._replace(motion=of_a), new_b._replace(motion=of_b, work=work)


def _end(motion: Motion, drift: Motion | None, h: float) -> Motion:
    """Displacement of bodies in the step, m and rad."""
    moved = jax.tree.map(lambda x: h * x, motion)
    return moved if drift is None else jax.tree.map(jnp.add, moved, drift)


def _slowed(
    inertia: tuple[Inertia, Inertia], contact: ActiveContact, push: Array, a: Motion, b: Motion, work: Work | None
) -> tuple[Work | None, Motion, Motion]:
    """Work and motions of two bodies after impulses at their centres that keep the angular momentum before a push."""
    unit = perpendicular(contact.normal)
    assert contact.frame.tangent_a is not None, "both bodies move"
    distance = contact.frame.tangent_a - contact.frame.tangent_b  # of the centres, along the normal
    speed = dot(unit, relative_velocity(a, b))
    impulse = jnp.where(distance > SLOWEST, -push * speed / jnp.maximum(distance, SLOWEST), 0.0)
    (mass_a, _), (mass_b, _) = inertia
    if work is not None:
        work = work._replace(lost=work.lost - impulse * (speed + 0.5 * (mass_a + mass_b) * impulse))
    new_a, new_b = a.velocity - mass_a * impulse * unit, b.velocity + mass_b * impulse * unit
    return work, a._replace(velocity=new_a), b._replace(velocity=new_b)
