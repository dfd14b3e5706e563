"""Mass and moment of inertia of the shapes, for one object or arrays of them."""

import jax.numpy as jnp

from gen2d.types import Array


def disc_mass(radius: Array, density: Array) -> Array:
    """Mass in kg of a solid disc; density in kg/m^2."""
    return jnp.pi * radius**2 * density


def disc_moment(radius: Array, mass: Array) -> Array:
    """Moment of inertia in kg m^2 of a solid disc about its centre: m r^2 / 2."""
    return 0.5 * mass * radius**2
