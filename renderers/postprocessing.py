"""Postprocessing of whole frames: the average over an exposure (motion blur), and sensor noise."""

import functools
import math

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.noise import hashed


def exposure_average(total: Array, count: int) -> Array:
    """Mean, uint8, of `count` images whose sum is `total`."""
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
