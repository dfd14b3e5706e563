"""JPEG round trip in whole numbers: the loss of baseline JPEG at 4:4:4, without its files.

ITU-T T.81: YCbCr of JFIF, the discrete cosine transform of blocks of 8 x 8 pixels, division by the example tables of
Annex K, scaled by the quality as the Independent JPEG Group's library scales them, rounding, and the way back. A frame
whose sides are no multiples of 8 is continued by its last rows and columns. All arithmetic is in int32, so every device
gives the same bits.
"""

import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array

SIDE = 8
BASIS_BITS, DROPPED = 12, 5  # bits of the cosines, and those dropped after the transform of columns
BITS = 2 * BASIS_BITS - DROPPED
HALF = 1 << 15  # of the coefficients of colours, which have 16 bits
TO_YCC = np.array([[19595, 38470, 7471], [-11059, -21709, 32768], [32768, -27439, -5329]], np.int32)
TO_RGB = np.array([[1 << 16, 0, 91881], [1 << 16, -22554, -46802], [1 << 16, 116130, 0]], np.int32)
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
    padded = jnp.pad(frames, padding, mode="edge")
    rows, columns = (size // SIDE for size in padded.shape[1:3])
    # The blocks come last, so that each operation runs over many of them.
    blocks = padded.reshape(count, rows, SIDE, columns, SIDE, 3).transpose(5, 2, 4, 0, 1, 3).reshape(3, SIDE, SIDE, -1)
    tables = _scaled_tables(quality)[..., None]
    coefficients = _row_products(_column_products(_ycc(blocks), BASIS), BASIS)
    scaled = tables << BITS
    sizes = _quotient(jnp.abs(coefficients) + (scaled >> 1), scaled)  # halves away from zero
    values = _row_products(_column_products(jnp.sign(coefficients) * sizes * tables, BASIS.T), BASIS.T)
    planes = jnp.clip((values + (1 << (BITS - 1))) >> BITS, -128, 127)
    blocks = _rgb(planes).reshape(3, SIDE, SIDE, count, rows, columns)
    frames = blocks.transpose(3, 4, 1, 5, 2, 0).reshape(padded.shape)
    return frames[:, :height, :width]


def _scaled_tables(quality: Array) -> Array:
    """Tables of divisors [3, 8, 8] of a quality."""
    quality = jnp.clip(quality.astype(jnp.int32), 1, 100)
    scale = jnp.where(quality < 50, 5000 // quality, 200 - 2 * quality)
    return jnp.clip((jnp.asarray(TABLES) * scale + 50) // 100, 1, 255)


def _quotient(number: Array, divisor: Array) -> Array:
    """Whole quotients of positive numbers. The estimate in floats is off by one at most, whatever their rounding."""
    estimate = (number.astype(jnp.float32) * (1 / divisor.astype(jnp.float32))).astype(jnp.int32)
    rest = number - estimate * divisor
    return estimate + (rest >= divisor).astype(jnp.int32) - (rest < 0).astype(jnp.int32)


def _column_products(blocks: Array, basis: np.ndarray) -> Array:
    """Products of a basis [8, 8] with the columns of blocks [3, 8, 8, N], times 2^(BASIS_BITS - DROPPED), rounded."""
    products = jnp.einsum("ij,kjcn->kicn", jnp.asarray(basis), blocks)
    return (products + (1 << (DROPPED - 1))) >> DROPPED


def _row_products(blocks: Array, basis: np.ndarray) -> Array:
    """Products of a basis [8, 8] with the rows of blocks [3, 8, 8, N], times 2^BASIS_BITS."""
    return jnp.einsum("ij,krjn->krin", jnp.asarray(basis), blocks)


def _ycc(colors: Array) -> Array:
    """Y, Cb and Cr [3, ...], each less 128, of colours [3, ...] uint8."""
    sums = jnp.einsum("kc,c...->k...", jnp.asarray(TO_YCC), colors.astype(jnp.int32))
    half = jnp.asarray([HALF - (128 << 16), HALF - 1, HALF - 1])
    return (sums + half.reshape(3, *[1] * (colors.ndim - 1))) >> 16


def _rgb(planes: Array) -> Array:
    """Colours [3, ...] uint8 of planes as in `_ycc`."""
    sums = (jnp.einsum("kc,c...->k...", jnp.asarray(TO_RGB), planes) + HALF) >> 16
    return jnp.clip(sums + 128, 0, 255).astype(jnp.uint8)
