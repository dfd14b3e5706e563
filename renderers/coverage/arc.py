"""Area under a circular arc, in closed form."""

import math

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array

LARGE_RADIUS = 64.0  # px; discs of this radius or more have a straight rim in each pixel, corrected for curvature
QUARTER = math.pi / 4
BEYOND_ARCS = 1e12  # px or px^2, beyond every arc
MIN_WIDTH = 1e-6  # px, width in a row of a vertical line

# Polynomial in 1 - u for the integral of sqrt(1 - s^2) from u to 1, divided by (1 - u)^1.5: a least-squares fit with an
# error of 4e-8 in the integral.
TAIL = (0.942809007, -0.141419555, -0.0126500054, -0.00233471418, -0.000931415786, 0.000194733329, -0.000269845138)


def _tail(u: Array) -> Array:
    """Integral of sqrt(1 - s^2) from u to 1, for u from 0 to 1."""
    v = 1 - u
    total = jnp.full_like(v, TAIL[-1])
    for coefficient in TAIL[-2::-1]:
        total = total * v + coefficient
    return v * jnp.sqrt(v) * total


@jax.custom_jvp
def under_arc(t: Array, radius: Array) -> Array:
    """Area U(t) px^2 under the arc sqrt(r^2 - s^2) for s from 0 to t, constant beyond +-r."""
    u = jnp.minimum(jnp.abs(t) / radius, 1.0)
    return jnp.copysign(radius * radius * (QUARTER - _tail(u)), t)


@under_arc.defjvp
def _under_arc_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (t, radius), (dt, dr) = primals, tangents
    height = jnp.sqrt(jnp.maximum(radius * radius - t * t, 0.0))
    return under_arc(t, radius), height * dt + radius * jnp.arcsin(jnp.clip(t / radius, -1.0, 1.0)) * dr
