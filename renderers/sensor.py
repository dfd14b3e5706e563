"""What a camera's sensor does to frames: the average over an exposure, and noise."""

import functools
import math

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.noise import hashed

# ---- After all layers


def exposure_average(total: Array, count: int) -> Array:
    """The uint8 mean of so many images, of their sum."""
    return ((total + count // 2) // count).astype(jnp.uint8)


def add_noise(frames: Array, deviation: Array, seed: Array, numbers: Array) -> Array:
    """The frames [T, H, W, 3] with Gaussian noise of a sensor: for each value four random bytes, whose sum has a
    variance of (256^2 - 1) / 3."""
    places = jnp.arange(math.prod(frames.shape[1:]), dtype=jnp.uint32).reshape(frames.shape[1:])
    word = hashed(seed, numbers[:, None, None, None], places)
    total = functools.reduce(jnp.add, [((word >> shift) & 255).astype(jnp.int32) for shift in (0, 8, 16, 24)])
    spread = (total - 510).astype(jnp.float32) * (deviation / math.sqrt((256**2 - 1) / 3))
    return jnp.clip(jnp.floor(frames.astype(jnp.float32) + spread + 0.5), 0, 255).astype(jnp.uint8)
