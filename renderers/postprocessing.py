"""Postprocessing of whole frames: the average over an exposure (motion blur), and sensor noise."""

import functools
import math

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.color import LINEAR, to_srgb
from gen2d.renderers.noise import hashed


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


def add_noise(frames: Array, deviation: Array, seed: Array, numbers: Array) -> Array:
    """Frames [T, H, W, 3] with approximately Gaussian noise of standard deviation `deviation`, seeded by frame number.

    The noise of a value is the sum of four random bytes, which has a variance of (256^2 - 1) / 3.
    """
    pixels = jnp.arange(math.prod(frames.shape[1:]), dtype=jnp.uint32).reshape(frames.shape[1:])
    words = hashed(seed, numbers[:, None, None, None], pixels)
    sums = functools.reduce(jnp.add, [((words >> shift) & 255).astype(jnp.int32) for shift in (0, 8, 16, 24)])
    noise = (sums - 510).astype(jnp.float32) * (deviation / math.sqrt((256**2 - 1) / 3))
    return jnp.clip(jnp.floor(frames.astype(jnp.float32) + noise + 0.5), 0, 255).astype(jnp.uint8)
