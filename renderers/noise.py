"""Hashed noise and textures."""

from typing import Any

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.paint import Texture

FADE = 0.25  # of an octave, over the square of a pixel's width in cells: fitted to averages over pixels


def _hash_word(x: Array) -> Array:
    """Well-mixed 32-bit hash of a 32-bit word (the finalizer 'lowbias32' of C. Wellons, 2018)."""
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return x ^ (x >> 16)


def hashed(*words: Any, state: Array | int = 0x9E3779B9) -> Array:
    """Random 32-bit words, uint32, of combinations of integers; the arguments are broadcast.

    `state` is the result for the words before these, if they were hashed before.
    """
    state = jnp.asarray(state, jnp.uint32)
    for word in words:
        state = _hash_word(state ^ jnp.asarray(word).astype(jnp.uint32))
    return state


def fraction(word: Array) -> Array:
    """Upper 24 bits of a 32-bit word as a float32 in [0, 1)."""
    return (word >> 8).astype(jnp.float32) * (1 / 2**24)


def noise(x: Array, y: Array, seed: Array, pixel: Array | float = 0.0) -> Array:
    """Value noise in [0, 1] with a cell of 1: two octaves of random values on the integers, with cubic blending.

    `pixel` is the width of a pixel, in cells: each octave is as faint as its average over a pixel, within a tenth.
    """
    fine = _octave(2 * x + 0.37, 2 * y + 0.71, hashed(seed, 1))
    coarse, wide = _octave(x, y, seed) - 0.5, pixel * pixel
    return 0.5 + (2 * coarse / (1 + FADE * wide) + (fine - 0.5) / (1 + 4 * FADE * wide)) / 3


def _octave(x: Array, y: Array, seed: Array) -> Array:
    left, top = jnp.floor(x), jnp.floor(y)
    u, v = (t * t * (3 - 2 * t) for t in (x - left, y - top))
    i, j = left.astype(jnp.int32), top.astype(jnp.int32)

    def at(di: int, dj: int) -> Array:
        return fraction(_hash_word(_hash_word((i + di).astype(jnp.uint32) ^ seed) ^ (j + dj).astype(jnp.uint32)))

    upper, lower = at(0, 0) * (1 - u) + at(1, 0) * u, at(0, 1) * (1 - u) + at(1, 1) * u
    return upper * (1 - v) + lower * v


def textured(color: Array, texture: Texture, x: Array, y: Array, scale: Array) -> Array:
    """Colours [..., 3] of a texture at x and y [...] in m, on a base of `color` [..., 3] (broadcast), in pixels of
    `scale` [...] px/m."""
    pixel = 1 / (texture.cell * scale)
    tall = texture.cell if texture.stretch is None else texture.cell * texture.stretch
    share = noise(x / texture.cell, y / tall, texture.seed, pixel)[..., None]
    return color + share * (texture.color - color)
