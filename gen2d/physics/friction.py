"""Sliding friction and rolling resistance of a contact, bounded by its normal impulse.

Coefficients of a pair are mixed in setup.py; contact_passes.py applies the impulses.
"""

import jax.numpy as jnp

from gen2d.physics.constraint import ActiveContact, ContactConstraint, Impulse, Motion, reciprocal
from gen2d.records.axes import Array


def friction_impulse(
    constraint: ContactConstraint,
    contact: ActiveContact,
    normal_impulse: Array,
    slip: Array,
    old: Impulse,
    apart: Array | None = None,
) -> Array:
    """Accumulated tangential impulse that stops the slip, within Coulomb's bound.

    Where an impact is `apart` from what has acted before, the bound holds for its own impulses.
    """
    kept = jnp.zeros_like(slip)
    if apart is not None:
        limit = constraint.friction * normal_impulse
        kept = jnp.where(apart, jnp.clip(old.tangent, -limit, limit), 0.0)
        normal_impulse = normal_impulse - jnp.where(apart, old.normal, 0.0)
    bound = constraint.friction * normal_impulse
    tangent = kept + jnp.clip(old.tangent - kept - contact.frame.tangent_mass * slip, -bound, bound)
    return jnp.where(bound > 0, tangent, kept)  # the gradient of a clip between two zeros is not zero


def apply_angular_impulse(
    constraint: ContactConstraint, roll: Array, a: Motion | None, b: Motion
) -> tuple[Motion | None, Motion]:
    """Both motions after an angular impulse on b and its reaction on a."""
    b = _after_twist(b, constraint.b.moment, constraint.schur_b, roll)
    if constraint.a is None or a is None:
        return a, b
    return _after_twist(a, constraint.a.moment, constraint.schur_a, -roll), b


def _after_twist(motion: Motion, moment: Array, schur: Array | None, roll: Array) -> Motion:
    """Motion after an angular impulse, N m s."""
    if schur is None:
        return motion._replace(spin=motion.spin + moment * roll)
    xt, yt, tt = schur[3:]
    return Motion(motion.velocity - jnp.stack([xt, yt]) * roll, motion.spin + (moment - tt) * roll)


def relative_spin(a: Motion | None, b: Motion) -> Array:
    """Spin of b relative to a, rad/s."""
    return b.spin if a is None else b.spin - a.spin


def rolling_impulse(
    constraint: ContactConstraint, normal_impulse: Array, a: Motion | None, b: Motion, old: Array
) -> Array:
    """Accumulated angular impulse that stops rolling, within its bound by the normal impulse."""
    assert constraint.rolling is not None, "the constraint has no rolling resistance"
    k = constraint.b.moment if constraint.a is None else constraint.a.moment + constraint.b.moment
    for schur in (constraint.schur_a, constraint.schur_b):
        k = k if schur is None else k - schur[-1]
    mass = reciprocal(k, constraint.present & (k > 0))
    bound = constraint.rolling * normal_impulse
    return jnp.clip(old - mass * relative_spin(a, b), -bound, bound)
