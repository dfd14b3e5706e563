"""JPEG round trip in whole numbers: the loss of baseline JPEG at 4:4:4, without its files.

ITU-T T.81: YCbCr of JFIF, the discrete cosine transform of blocks of 8 x 8 pixels, division by the example tables of
Annex K, scaled by the quality as the Independent JPEG Group's library scales them, rounding, and the way back. A frame
whose sides are no multiples of 8 is continued by its last rows and columns. All arithmetic is in int32, so every device
gives the same bits.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array

SIDE = 8
BASIS_BITS, DROPPED = 12, 5  # bits of the cosines, and those dropped after the transform of columns
BITS = 2 * BASIS_BITS - DROPPED
HALF = 1 << 15  # of the coefficients of colours, which have 16 bits
_ROWS, _COLUMNS = np.mgrid[:SIDE, :SIDE]
_COSINES = np.cos((2 * _COLUMNS + 1) * _ROWS * np.pi / (2 * SIDE)) * np.where(_ROWS, 0.5, 0.5**1.5)
BASIS = np.round(_COSINES * 2**BASIS_BITS).astype(np.int32)  # [frequency, pixel]; its rows have a length of 2^12

_LUMINANCE = """16 11 10 16 24 40 51 61 12 12 14 19 26 58 60 55 14 13 16 24 40 57 69 56 14 17 22 29 51 87 80 62
18 22 37 56 68 109 103 77 24 35 55 64 81 104 113 92 49 64 78 87 103 121 120 101 72 92 95 98 112 100 103 99"""
_CHROMINANCE = """17 18 24 47 99 99 99 99 18 21 26 66 99 99 99 99 24 26 56 99 99 99 99 99 47 66 99 99 99 99 99 99
99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99"""
TABLES = np.stack([np.array(_LUMINANCE.split(), np.int32)] + [np.array(_CHROMINANCE.split(), np.int32)] * 2)
TABLES = TABLES.reshape(3, SIDE, SIDE)  # of Y, Cb and Cr


def round_trip(frames: Array, quality: Array) -> Array:
    """Frames [T, H, W, 3] uint8 after a round trip of this quality, from 1 to 100."""
    count, height, width = frames.shape[:3]
    padding = [(0, 0), (0, -height % SIDE), (0, -width % SIDE), (0, 0)]
    planes = _ycc(jnp.pad(frames.astype(jnp.int32), padding, mode="edge"))
    rows, columns = (size // SIDE for size in planes.shape[2:])
    # The blocks come last, so that each operation runs over many of them.
    blocks = planes.reshape(3, count, rows, SIDE, columns, SIDE).transpose(0, 3, 5, 1, 2, 4).reshape(3, SIDE, SIDE, -1)
    # Two loops, or the compiler would divide again for each product that a coefficient is in.
    sizes, tables = jax.lax.map(_encoded, (blocks, _scaled_tables(quality)[..., None]))
    blocks = jax.lax.map(_decoded, (sizes, tables))
    planes = blocks.reshape(3, SIDE, SIDE, count, rows, columns).transpose(0, 3, 4, 1, 5, 2).reshape(planes.shape)
    return _rgb(planes)[:, :height, :width]


def _scaled_tables(quality: Array) -> Array:
    """Tables of divisors [3, 8, 8] of a quality."""
    quality = jnp.clip(quality.astype(jnp.int32), 1, 100)
    scale = jnp.where(quality < 50, 5000 // quality, 200 - 2 * quality)
    return jnp.clip((jnp.asarray(TABLES) * scale + 50) // 100, 1, 255)


def _encoded(plane: tuple[Array, Array]) -> tuple[Array, Array]:
    """Coefficients [8, 8, N] of blocks [8, 8, N] from -128 to 127 over divisors [8, 8, 1], rounded; the divisors."""
    blocks, divisors = plane
    coefficients, scaled = _transformed(blocks, BASIS), divisors << BITS
    sizes = (jnp.abs(coefficients) + (scaled >> 1)) // scaled  # halves away from zero
    return jnp.sign(coefficients) * sizes, divisors


def _decoded(plane: tuple[Array, Array]) -> Array:
    """Blocks [8, 8, N] from -128 to 127 of what `_encoded` returns."""
    sizes, divisors = plane
    values = _transformed(sizes * divisors, BASIS.T)
    return jnp.clip((values + (1 << (BITS - 1))) >> BITS, -128, 127)


def _transformed(blocks: Array, basis: np.ndarray) -> Array:
    """Products of a basis [8, 8] with the rows and the columns of blocks [8, 8, ...], times 2^BITS."""
    columns = (_products(blocks, basis) + (1 << (DROPPED - 1))) >> DROPPED
    return jnp.swapaxes(_products(jnp.swapaxes(columns, 0, 1), basis), 0, 1)


def _products(blocks: Array, basis: np.ndarray) -> Array:
    """Products of a basis [8, 8] with the columns of blocks [8, ...]; sums of whole rows, which vectorize."""
    return jnp.stack([functools.reduce(jnp.add, map(jnp.multiply, row.tolist(), blocks)) for row in basis])


def _ycc(frames: Array) -> Array:
    """Planes Y, Cb and Cr [3, T, H, W], each less 128, of frames [T, H, W, 3] from 0 to 255."""
    red, green, blue = jnp.moveaxis(frames, -1, 0)
    light = (19595 * red + 38470 * green + 7471 * blue + HALF) >> 16
    blueness = (-11059 * red - 21709 * green + 32768 * blue + HALF - 1) >> 16
    redness = (32768 * red - 27439 * green - 5329 * blue + HALF - 1) >> 16
    return jnp.stack([light - 128, blueness, redness])


def _rgb(planes: Array) -> Array:
    """Frames [T, H, W, 3] uint8 of three planes as in `_ycc`."""
    light, blueness, redness = planes
    red = light + ((91881 * redness + HALF) >> 16)
    green = light + ((-22554 * blueness - 46802 * redness + HALF) >> 16)
    blue = light + ((116130 * blueness + HALF) >> 16)
    return jnp.clip(jnp.stack([red, green, blue], -1) + 128, 0, 255).astype(jnp.uint8)
