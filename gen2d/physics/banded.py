"""Banded L D L^T factorisation.

A symmetric band matrix of R rows and `width` diagonals from the main one on is an array [R, width, ...]: entry (i, k)
is that of row i and column i + k, 0 beyond the last column.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.xla import materialize

UNROLL = 4  # rows per iteration of a loop


class BandFactors(NamedTuple):
    """Factors L and D of a symmetric band matrix L D L^T."""

    below: Array  # [R, width - 1, ...]: the diagonals of L after the main one, which is 1
    inverse: Array  # [R, ...]: 1 / D


def factor(bands: Array, usable: Array, compliance: float = 0.0) -> BandFactors:
    """Factors of the usable rows [R, ...] of a symmetric positive band matrix; the others get a solution of zero.

    Rows that repeat others need a compliance, relative to the main diagonal, which is added there.
    """
    width, end = bands.shape[1], jnp.zeros_like(bands[0, :1])

    def row(less: list[Array], values: tuple[Array, Array]) -> tuple[list[Array], BandFactors]:
        """What the rows so far subtract from the next ones, and this row's factors."""
        terms, use = values
        first, *others = [jnp.concatenate([x, end]) for x in less] + [end] * (width > len(less))
        own = materialize(terms - first)
        inverse = jnp.where(use, 1 / jnp.where(use, own[0] + compliance * terms[0], 1.0), 0.0)
        below = materialize(inverse * own[1:])
        return materialize([below[p] * own[1 + p :] + x for p, x in enumerate(others)]), BandFactors(below, inverse)

    start = [jnp.zeros_like(bands[0, : width - 1 - p]) for p in range(width - 1)]
    return jax.lax.scan(row, start, (bands, usable), unroll=UNROLL)[1]


def inverse_band(factors: BandFactors) -> Array:
    """The band [R, width, ...] of the inverse of L D L^T.

    Source: K. Takahashi, J. Fagan and M.-S. Chin (1973): the band of the inverse needs no entry outside it.
    """
    ahead, zero = factors.below.shape[1], jnp.zeros_like(factors.inverse[0])

    def row(later: list[list[Array]], of: BandFactors) -> tuple[list[list[Array]], Array]:
        """Entries of the inverse at the next rows, and this row's."""
        below = [of.below[i] for i in range(ahead)]
        beyond = [-sum((f * x for f, x in zip(below, column, strict=True)), zero) for column in later]
        own = [of.inverse - sum((f * x for f, x in zip(below, beyond, strict=True)), zero), *beyond]
        rows = [own, *([x, *older] for x, older in zip(beyond, later, strict=True))]
        return [entries[:ahead] for entries in rows[:ahead]], jnp.stack(own)

    return jax.lax.scan(row, [[zero] * ahead] * ahead, factors, reverse=True, unroll=UNROLL)[1]


def solve_factored(factors: BandFactors, b: Array) -> Array:
    """Solution x [R, ...] of L D L^T x = b."""
    ahead = factors.below.shape[1]
    start = [jnp.zeros_like(b[0])] * ahead

    def down(less: list[Array], row: tuple[BandFactors, Array]) -> tuple[list[Array], Array]:
        (below, inverse), value = row
        value = materialize(value - less[0]) if less else value
        return [below[i] * value + x for i, x in enumerate([*less[1:], 0.0][:ahead])], inverse * value

    def up(later: list[Array], row: tuple[Array, Array]) -> tuple[list[Array], Array]:
        below, x = row
        for i, y in enumerate(later):
            x = x - below[i] * y
        x = materialize(x)
        return [x, *later][:ahead], x

    scaled = jax.lax.scan(down, start, (factors, b), unroll=UNROLL)[1]
    return jax.lax.scan(up, start, (factors.below, scaled), reverse=True, unroll=UNROLL)[1]


def multiply(bands: Array, x: Array) -> Array:
    """Product of a symmetric band matrix and a vector x [R, ...]."""
    product = bands[:, 0] * x
    for offset in range(1, bands.shape[1]):
        end, band = jnp.zeros_like(x[:offset]), bands[:, offset]
        later, earlier = jnp.concatenate([x[offset:], end]), (band * x)[:-offset]
        product = product + band * later + jnp.concatenate([end, earlier])
    return product
