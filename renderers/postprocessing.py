"""The average of whole frames over an exposure: motion blur."""

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.color import LINEAR, to_srgb


def exposure_start(shape: tuple[int, ...], linear: bool) -> Array:
    """Sum of no images, to which `expose` adds."""
    return jnp.zeros(shape, jnp.float32 if linear else jnp.uint16)


def expose(total: Array, image: Array, linear: bool) -> Array:
    """Sum of images with one more, uint8: a sum of sRGB values, or of linear light."""
    return total + (jnp.asarray(LINEAR)[image.astype(jnp.int32)] if linear else image.astype(jnp.uint16))


def exposure_average(total: Array, count: int, linear: bool) -> Array:
    """Mean, uint8 in sRGB, of `count` images whose sum is `total`."""
    if linear:
        return (to_srgb(total / count) + 0.5).astype(jnp.uint8)
    return ((total + count // 2) // count).astype(jnp.uint8)
