"""Banded L D L^T factorisation."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array

UNROLL = 4  # rows per iteration of a loop


class BandFactors(NamedTuple):
    """Factors L and D of a symmetric band matrix L D L^T, each [R, ...]."""

    below: list[Array]  # the diagonals of L after the main one, which is 1
    inverse: Array  # 1 / D


def factor(bands: list[Array]) -> BandFactors:
    """Factors of a symmetric positive band matrix from its diagonals [R, ...], the main one first.

    A row whose main diagonal is infinite gets a solution of zero.
    """
    width, zero = len(bands), jnp.zeros_like(bands[0][0])

    def row(less: list, terms: list) -> tuple:
        """Terms that the rows so far subtract from the next ones, and this row's factors."""
        first, *others = less or [[]]
        own = [x - y for x, y in zip(terms, [*first, zero], strict=True)]
        inverse = 1 / own[0]
        below = [inverse * x for x in own[1:]]
        older = [[*other, zero] for other in [*others, []]]
        new = [[f * x + y for x, y in zip(own[1 + p :], older[p], strict=True)] for p, f in enumerate(below)]
        return new, BandFactors(below, inverse)

    start = [[zero] * (width - 1 - p) for p in range(width - 1)]
    return jax.lax.scan(row, start, bands, unroll=UNROLL)[1]


def inverse_band(factors: BandFactors) -> list[Array]:
    """Diagonals [R, ...] of the inverse of L D L^T, as many as the factors have, the main one first.

    Source: K. Takahashi, J. Fagan and M.-S. Chin (1973): the band of the inverse needs no entry outside it.
    """
    ahead, zero = len(factors.below), jnp.zeros_like(factors.inverse[0])

    def row(later: list[list[Array]], of: BandFactors) -> tuple[list[list[Array]], list[Array]]:
        """Entries of the inverse at the next rows, and this row's."""
        beyond = [-sum((f * x for f, x in zip(of.below, column, strict=True)), zero) for column in later]
        own = [of.inverse - sum((f * x for f, x in zip(of.below, beyond, strict=True)), zero), *beyond]
        rows = [own, *([x, *older] for x, older in zip(beyond, later, strict=True))]
        return [entries[:ahead] for entries in rows[:ahead]], own

    return jax.lax.scan(row, [[zero] * ahead] * ahead, factors, reverse=True, unroll=UNROLL)[1]


def solve_factored(factors: BandFactors, b: Array) -> Array:
    """Solution x [R, ...] of L D L^T x = b."""
    start = [jnp.zeros_like(b[0])] * len(factors.below)

    def down(less: list, row: tuple[BandFactors, Array]) -> tuple:
        (below, inverse), value = row
        value = value - less[0] if less else value
        return [f * value + x for f, x in zip(below, [*less[1:], 0.0], strict=False)], (below, inverse * value)

    def up(later: list, row: tuple) -> tuple:
        below, x = row
        for f, y in zip(below, later, strict=True):
            x = x - f * y
        return [x, *later][: len(later)], x

    scaled = jax.lax.scan(down, start, (factors, b), unroll=UNROLL)[1]
    return jax.lax.scan(up, start, scaled, reverse=True, unroll=UNROLL)[1]
