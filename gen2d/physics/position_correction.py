"""Overlaps pushed apart by displacements of their own, which leave no velocity behind.

A pair that overlaps at the start of a step is moved apart within it: by a share of the overlap that a damped spring of
the frequency and damping ratio of contacts would take, and at most at `push_speed`. The displacements are those of an
impulse at the contact, without its velocity. So a body that is pushed out of another one does not strike a third, and
the impulse of a contact is its load alone.

A displacement P / m across a velocity would change the angular momentum of two moving bodies. As a central force would,
a pair of impulses at both centres of mass makes up for it.
"""

import jax
import jax.numpy as jnp

from gen2d.physics.collision import dot, perpendicular
from gen2d.physics.constraint import (
    ActiveContact,
    ContactConstraint,
    Impulse,
    Motion,
    apply_impulse,
    relative_speed,
    relative_velocity,
    softness,
)
from gen2d.physics.contact_state import BodySide
from gen2d.physics.normal_impulse import NormalTarget, solve_normals
from gen2d.physics.params import SolverParams
from gen2d.records.axes import Array
from gen2d.xla import materialize


def _displacement(side: BodySide, h: float) -> Motion | None:
    """Displacement of bodies in the step, m and rad; None: static bodies at rest."""
    if side.motion is None:
        return None
    moved = jax.tree.map(lambda x: h * x, side.motion)
    return moved if side.drift is None else jax.tree.map(jnp.add, moved, side.drift)


def correct_positions(
    constraint: ContactConstraint,
    contacts: list[ActiveContact],
    acceleration: Array | None,
    a: BodySide,
    b: BodySide,
    params: SolverParams,
    threshold: Array,
) -> tuple[BodySide, BodySide]:
    """Both sides with drifts that push the pair apart where it overlaps."""
    h, (rate, *_) = params.step, softness(constraint, params)
    import os
    slop, rate = float(os.environ.get("SLOP","1"))*h*threshold, float(os.environ.get("RATE", rate))
    moved_a, moved_b = _displacement(a, h), _displacement(b, h)
    assert moved_b is not None, "only static bodies lack a motion"
    zero = jnp.zeros_like(contacts[0].gap)
    none, gaps, targets = Impulse(zero, zero), [], []
    fall = 0.0 if acceleration is None else 0.5 * h**2 * acceleration
    for contact in contacts:
        gap = contact.gap - (0.0 if acceleration is None else dot(contact.normal, fall))
        gap = gap + relative_speed(contact.frame, contact.normal, moved_a, moved_b)[0]
        wanted = contact.gap + jnp.minimum(-h * rate * (contact.gap + slop), h * params.push_speed)
        overlaps = (contact.gap < -slop) & (contact.frame.normal_mass > 0)
        gaps.append(gap)
        targets.append(NormalTarget(overlaps, wanted, zero, jnp.zeros_like(overlaps)))
    pushes = materialize(solve_normals(constraint, contacts, gaps, [none] * len(contacts), targets))
    return _pushed(constraint, contacts, pushes, a, b)


def _pushed(
    constraint: ContactConstraint, contacts: list[ActiveContact], pushes: list[Array], a: BodySide, b: BodySide
) -> tuple[BodySide, BodySide]:
    """Both sides after pushes, kg m."""
    assert b.drift is not None, "only static bodies lack a drift"
    drifts = a.drift, b.drift
    for contact, push in zip(contacts, pushes, strict=True):
        drifts = apply_impulse(constraint, contact, (push, None), *drifts)
    new_a, new_b = a._replace(drift=drifts[0]), b._replace(drift=drifts[1])
    if b.joint_drift is not None:
        return new_a, new_b
    if constraint.a is None or a.motion is None or constraint.static:
        return new_a, new_b
    return _central(constraint, contacts[0], sum(pushes[1:], pushes[0]), new_a, new_b)


def _central(
    constraint: ContactConstraint, contact: ActiveContact, push: Array, a: BodySide, b: BodySide
) -> tuple[BodySide, BodySide]:
    """Both sides with the angular momentum before the push."""
    assert a.motion is not None and b.motion is not None and constraint.a is not None
    frame, unit = contact.frame, perpendicular(contact.normal)
    distance = frame.tangent_a - frame.tangent_b
    slip = dot(unit, relative_velocity(a.motion, b.motion))
    impulse = jnp.where(distance > 1e-6, -push * slip / jnp.maximum(distance, 1e-6), 0.0)
    of_a = a.motion._replace(velocity=a.motion.velocity - constraint.a.mass * impulse * unit)
    of_b = b.motion._replace(velocity=b.motion.velocity + constraint.b.mass * impulse * unit)
    work = b.work
    if work is not None:
        work = work._replace(lost=work.lost - impulse * (slip + 0.5 * (constraint.a.mass + constraint.b.mass) * impulse))
    return a._replace(motion=of_a), b._replace(motion=of_b, work=work)
