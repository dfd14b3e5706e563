"""What a look gives for a video: what each slot is painted with, and what is behind everything. Colours are sRGB, 0 to
255 as floats; what a look leaves None does not exist and costs nothing.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.types import Array

TRIES = 64  # colours from which a palette chooses


class Texture(NamedTuple):
    """A pattern of procedural noise that sticks to what it is on."""

    seed: Array  # [...] uint32
    cell: Array  # [...] m, size of the coarsest spots
    color: Array  # [..., 3] of the brightest spots; the darkest have the colour of what it is on


class Background(NamedTuple):
    """Behind everything."""

    color: Array  # [3]
    to_color: Array | None = None  # [3] of a gradient's other end
    direction: Array | None = None  # rad, in which a gradient goes
    texture: Texture | None = None


class Paint(NamedTuple):
    """What a look gives for one video."""

    background: Background
    color: Array  # [K, 3]
    drawn: Array  # [K] bool
    grow: Array | None = None  # [K] px, beyond the object's own rim: the width of a line without one
    fill: Array | None = None  # [K, 3] of the inside, where that is not of the object's colour
    rim: Array | None = None  # [K] px, width of a line along the inside of the rim
    rim_color: Array | None = None  # [K, 3]
    mark: Array | None = None  # [K] half the width of a bar from the centre to the rim, over the way to the nearest rim
    mark_color: Array | None = None  # [K, 3]
    shade: Array | None = None  # [K] how much darker the rim is than the middle, 0 to 1
    texture: Texture | None = None  # of [K]


def _hashed(x: Array) -> Array:
    """A well-mixed 32-bit word of another (the finalizer 'lowbias32' of C. Wellons, 2018)."""
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return x ^ (x >> 16)


def hashed(*words: Any) -> Array:
    """A random 32-bit word for each combination of integers."""
    total = jnp.uint32(0x9E3779B9)
    for word in words:
        total = _hashed(total ^ jnp.asarray(word).astype(jnp.uint32))
    return total


def fraction(word: Array) -> Array:
    """A word as a number from 0 to below 1: its first 24 bits."""
    return (word >> 8).astype(jnp.float32) * (1 / 2**24)


def noise(x: Array, y: Array, seed: Array) -> Array:
    """Smooth noise between 0 and 1, with a cell of 1: random values at whole numbers, between them a cubic blend; two
    octaves."""
    fine = _octave(2 * x + 0.37, 2 * y + 0.71, hashed(seed, 1))
    return (2 * _octave(x, y, seed) + fine) / 3


def _octave(x: Array, y: Array, seed: Array) -> Array:
    left, top = jnp.floor(x), jnp.floor(y)
    u, v = (t * t * (3 - 2 * t) for t in (x - left, y - top))
    i, j = left.astype(jnp.int32), top.astype(jnp.int32)

    def at(di: int, dj: int) -> Array:
        return fraction(_hashed(_hashed((i + di).astype(jnp.uint32) ^ seed) ^ (j + dj).astype(jnp.uint32)))

    upper, lower = at(0, 0) * (1 - u) + at(1, 0) * u, at(0, 1) * (1 - u) + at(1, 1) * u
    return upper * (1 - v) + lower * v


def textured(color: Array, texture: Texture, x: Array, y: Array) -> Array:
    """The colours [..., 3] of a texture at x and y [...] in m, on something of `color` [..., 3] or what fits it."""
    share = noise(x / texture.cell, y / texture.cell, texture.seed)[..., None]
    return color + share * (texture.color - color)


def palette(key: Array, count: int, distance: float, backgrounds: Array) -> Array:
    """`count` random colours [count, 3], each at least `distance` from backgrounds [B, 3] and from those before it.

    The first of some tries that is so far from all is taken, and the farthest where none is. Distances are those of
    a Euclidean approximation of what the eye sees (T. Riemersma, 'Colour metric').
    """
    tries, first = _vivid(key, count * TRIES).reshape(count, TRIES, 3), len(backgrounds)

    def add(chosen: Array, entry: tuple[Array, Array]) -> tuple[Array, Array]:
        number, colors = entry
        known = jnp.arange(first + count) < first + number
        apart = jnp.where(known, contrast(colors[:, None], chosen[None]), jnp.inf).min(1)
        best = jnp.where((apart >= distance).any(), jnp.argmax(apart >= distance), jnp.argmax(apart))
        return chosen.at[first + number].set(colors[best]), colors[best]

    start = jnp.zeros((first + count, 3)).at[:first].set(backgrounds)
    return jax.lax.scan(add, start, (jnp.arange(count), tries))[1]


def contrast(a: Array, b: Array) -> Array:
    """The distance of two colours [..., 3] as the eye sees it, 0 to 765."""
    mean, (red, green, blue) = (a[..., 0] + b[..., 0]) / 2, jnp.moveaxis(a - b, -1, 0)
    return jnp.sqrt((2 + mean / 256) * red**2 + 4 * green**2 + (2 + (255 - mean) / 256) * blue**2)


def _vivid(key: Array, count: int) -> Array:
    """Random colours [count, 3] of any hue, whole numbers."""
    hue, saturation, value = jax.random.uniform(
        key, (3, count), minval=jnp.asarray([[0.0], [0.45], [0.55]]), maxval=jnp.asarray([[6.0], [1.0], [1.0]])
    )
    distance = jnp.abs((hue[:, None] + jnp.asarray([0.0, 4.0, 2.0])) % 6 - 3) - 1
    pure = jnp.clip(distance, 0, 1)
    return jnp.round(255 * value[:, None] * (1 - saturation[:, None] * (1 - pure)))


# ---- sRGB and linear light (IEC 61966-2-1)


def to_linear(color: Array) -> Array:
    """Linear light, 0 to 1, of sRGB values 0 to 255."""
    value = color / 255
    return jnp.where(value <= 0.04045, value / 12.92, jnp.maximum((value + 0.055) / 1.055, 0.0) ** 2.4)


def to_srgb(light: Array) -> Array:
    """sRGB values 0 to 255 of linear light, 0 to 1."""
    bright = 1.055 * jnp.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return 255 * jnp.where(light <= 0.0031308, 12.92 * light, bright)


LINEAR = np.asarray(
    [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in np.arange(256) / 255], np.float32
)  # of each sRGB value
