"""Colours: random palettes, perceptual contrast, sRGB and linear light."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array

TRIES = 64  # candidates for each colour of a palette


def palette(key: Array, count: int, distance: float, backgrounds: Array) -> Array:
    """Random sRGB colours [count, 3], each at least `distance` from the backgrounds [B, 3] and from those before it.

    Each colour is the first of `TRIES` candidates at that distance, or the farthest candidate if there is none. The
    distance is `contrast`, from 0 to 765.
    """
    candidates, offset = _vivid_colors(key, count * TRIES).reshape(count, TRIES, 3), len(backgrounds)

    def add(chosen: Array, entry: tuple[Array, Array]) -> tuple[Array, Array]:
        index, colors = entry
        filled = jnp.arange(offset + count) < offset + index
        distances = jnp.where(filled, contrast(colors[:, None], chosen[None]), jnp.inf).min(1)
        best = jnp.where((distances >= distance).any(), jnp.argmax(distances >= distance), jnp.argmax(distances))
        return chosen.at[offset + index].set(colors[best]), colors[best]

    initial = jnp.zeros((offset + count, 3)).at[:offset].set(backgrounds)
    return jax.lax.scan(add, initial, (jnp.arange(count), candidates))[1]


def contrast(a: Array, b: Array) -> Array:
    """Perceptual distance, 0 to 765, of sRGB colours [..., 3]: weighted Euclidean (T. Riemersma, 'Colour metric')."""
    mean, (red, green, blue) = (a[..., 0] + b[..., 0]) / 2, jnp.moveaxis(a - b, -1, 0)
    return jnp.sqrt((2 + mean / 256) * red**2 + 4 * green**2 + (2 + (255 - mean) / 256) * blue**2)


def _vivid_colors(key: Array, count: int) -> Array:
    """Random saturated sRGB colours [count, 3] of any hue, rounded to integers."""
    hue, saturation, value = jax.random.uniform(
        key, (3, count), minval=jnp.asarray([[0.0], [0.45], [0.55]]), maxval=jnp.asarray([[6.0], [1.0], [1.0]])
    )
    offset = jnp.abs((hue[:, None] + jnp.asarray([0.0, 4.0, 2.0])) % 6 - 3) - 1
    pure = jnp.clip(offset, 0, 1)
    return jnp.round(255 * value[:, None] * (1 - saturation[:, None] * (1 - pure)))


# ---- sRGB and linear light (IEC 61966-2-1)


def to_linear(color: Array) -> Array:
    """Linear light, 0 to 1, of sRGB values, 0 to 255."""
    value = color / 255
    return jnp.where(value <= 0.04045, value / 12.92, jnp.maximum((value + 0.055) / 1.055, 0.0) ** 2.4)


def to_srgb(light: Array) -> Array:
    """sRGB values, 0 to 255, of linear light, 0 to 1."""
    bright = 1.055 * jnp.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return 255 * jnp.where(light <= 0.0031308, 12.92 * light, bright)


# ---- The same by polynomials, which compilers vectorize: within 0.03 sRGB values

OFFSET = 255 * 0.055  # of the curve's power, in sRGB values
LAST_DARK = 255 * 0.04045  # up to which sRGB values are proportional to light


def _polynomial(x: Array, *coefficients: float) -> Array:
    *others, highest = coefficients
    return functools.reduce(lambda total, c: total * x + c, others[::-1], jnp.float32(highest))


def light_of(color: Array) -> Array:
    """Linear light, 0 to 1, of whole sRGB values, 0 to 255, in floats."""
    power = 9.242264e-4, 1.2773246e-4, 8.0064153e-6, 4.0026888e-8, -7.1732873e-11, 7.9386779e-14
    return jnp.where(color <= LAST_DARK, color * (1 / (255 * 12.92)), _polynomial(color, *power))


def values_of(light: Array) -> Array:
    """sRGB values of linear light, 0 to 1."""
    power = -7.5172851, 359.16623, -239.94885, 285.59000, -200.60767, 58.395650
    root = jnp.sqrt(jnp.maximum(light - 0.0005, 0.0))
    return jnp.where(light <= 0.0031308, 255 * 12.92 * light, _polynomial(root, *power))


def scaled_values(color: Array, factor: Array) -> Array:
    """sRGB values, which may exceed 255, of the light of whole sRGB values, 0 to 255, times `factor` ** 2.4.

    Beyond the dark values the curve is a power, so they are scaled as they are.
    """
    root = jnp.sqrt(color)
    dark = root * _polynomial(root, 11.118138, -2.5347757, 0.68771856, -0.075406760)
    scaled = jnp.where(color <= LAST_DARK, dark, color + OFFSET) * factor
    bright = scaled * scaled * _polynomial(scaled, 6.7438438e-3, 6.1204176e-4, -7.1680147e-6)
    return jnp.where(scaled <= LAST_DARK + OFFSET, bright, scaled - OFFSET)


LINEAR = np.asarray(
    [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in np.arange(256) / 255], np.float32
)  # linear light of the sRGB values 0 to 255
