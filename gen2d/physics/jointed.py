"""Contacts of bodies that rigid joints hold.

A bob on a rod cannot move along the rod, so an impact at an angle to it meets less of the bob's inverse mass than that
of a free bob. Contacts are solved before the joints. So each body has the matrix that its joints take from its inverse
mass, S = E^T M^-1 J^T (J M^-1 J^T)^-1 J M^-1 E, with E the body's columns and J the rows of the joints. In a pass,
contacts use the inverse mass M^-1 - S and see the motion that it gives. What the joints have taken from the motion is
given back before the joints are solved. They then find the impulses that take it again, from this body and from all
others.

Contacts of two bodies that the same joints hold see the matrix of each alone.
"""

import jax
import jax.numpy as jnp

from gen2d.physics.collision import perpendicular
from gen2d.physics.constraint import ActiveContact, ContactConstraint, ContactFrame, Motion, reciprocal
from gen2d.physics.contact_state import BodySide
from gen2d.physics.symmetric import Direction, inner, product
from gen2d.records.axes import Array

LEAST = 0.01  # share of a contact's compliance that joints leave at least, as the rest would be rounding


def hold(side: BodySide, schur: Array) -> BodySide:
    """The side with what joints take from its inverse mass, at the start of a pass."""
    if side.motion is None:
        return side
    zero = jax.tree.map(jnp.zeros_like, side.motion)
    return side._replace(schur=schur, joint_motion=zero, joint_drift=None if side.drift is None else zero)


def release(side: BodySide) -> BodySide:
    """The side with the motion that its contacts alone gave it, at the end of a pass."""
    if side.joint_motion is None:
        return side
    drift = (
        None if side.drift is None or side.joint_drift is None else jax.tree.map(jnp.add, side.drift, side.joint_drift)
    )
    return side._replace(motion=free_motion(side), drift=drift, schur=None, joint_motion=None, joint_drift=None)


def with_motions(side: BodySide, motion: Motion | None, free: Motion | None) -> BodySide:
    """The side with a motion, and, on a joint, with that which its contacts alone gave it."""
    joint_motion = None if side.joint_motion is None else jax.tree.map(jnp.subtract, free, motion)
    return side._replace(motion=motion, joint_motion=joint_motion)


def free_motion(side: BodySide) -> Motion | None:
    """Motion of a side that its contacts alone gave it."""
    return side.motion if side.joint_motion is None else jax.tree.map(jnp.add, side.motion, side.joint_motion)


def with_joints(constraint: ContactConstraint, a: BodySide, b: BodySide) -> ContactConstraint:
    """Constraint of bodies with what joints take from their inverse masses."""
    return constraint._replace(schur_a=a.schur, schur_b=b.schur)


def jointed_frame(constraint: ContactConstraint, frame: ContactFrame, normal: Array) -> ContactFrame:
    """Frame with the effective masses that the joints leave."""
    if constraint.schur_a is None and constraint.schur_b is None:
        return frame
    near, unit = frame.normal_mass > 0, perpendicular(normal)
    normals = _directions(frame.normal_a, frame.normal_b, normal)
    tangents = _directions(frame.tangent_a, frame.tangent_b, unit)

    def left(k: Array, directions: tuple[Direction, Direction]) -> Array:
        return jnp.maximum(k - _schur_complement(constraint, directions, directions), LEAST * k)

    ks = left(frame.k_normal, normals), left(frame.k_tangent, tangents)
    levers = frame.normal_a, frame.normal_b, frame.tangent_a, frame.tangent_b
    return ContactFrame(*levers, *ks, *(reciprocal(k, near) for k in ks))


def joint_coupling(constraint: ContactConstraint, p: ActiveContact, q: ActiveContact) -> Array | float:
    """What joints take from the normal speed at one point that a unit impulse at another causes, 1/kg."""
    return _schur_complement(
        constraint, *(_directions(of.frame.normal_a, of.frame.normal_b, of.normal) for of in (p, q))
    )


def _directions(lever_a: Array | None, lever_b: Array | None, unit: Array) -> tuple[Direction, Direction]:
    return (unit, lever_a), (unit, lever_b)


def _schur_complement(
    constraint: ContactConstraint, p: tuple[Direction, Direction], q: tuple[Direction, Direction]
) -> Array | float:
    """What joints take from the speed along q that a unit impulse along p causes, 1/kg."""
    taken = 0.0
    for matrix, one, other in zip((constraint.schur_a, constraint.schur_b), p, q, strict=True):
        if matrix is not None:
            taken = taken + inner(other, product(matrix, one))
    return taken
