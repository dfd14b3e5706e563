"""Where two shapes are nearest and how far apart: one function per pair of shapes.

Vectors have shape [2, ...]; a gap is in metres, negative when the shapes overlap; a normal points from the first shape
to the second. Distances are kept off zero, so that coincident centres give a finite normal (zero) and no NaN gradient.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from gen2d.types import Array

NEAREST = 1e-12  # m^2: squared distances below this have no direction


class Segments(NamedTuple):
    """Fixed segments: centre [2, ...], unit direction [2, ...], half length and radius [...] in metres."""

    centre: Array
    direction: Array
    half_length: Array
    radius: Array


def dot(a: Array, b: Array) -> Array:
    """The inner product over the first axis."""
    return a[0] * b[0] + a[1] * b[1]


def turned(a: Array) -> Array:
    """The vector a quarter turn counter-clockwise: the tangent of a normal."""
    return jnp.stack([-a[1], a[0]])


def inverse_length(a: Array) -> Array:
    """1 / |a|, finite at zero."""
    return lax.rsqrt(jnp.maximum(dot(a, a), NEAREST))


def segment_disc(segment: Segments, centre: Array, radius: Array) -> tuple[Array, Array]:
    """Normal [2, ...] from segment to disc, and gap [...]. A disc that has passed through is seen from its own side."""
    offset = centre - segment.centre
    along = jnp.clip(dot(offset, segment.direction), -segment.half_length, segment.half_length)
    apart = offset - along * segment.direction
    inverse = inverse_length(apart)
    return apart * inverse, dot(apart, apart) * inverse - segment.radius - radius
