"""Colours: sRGB and linear light, palettes, contrast."""

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array

TRIES = 64  # colours from which a palette chooses


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
