"""Exact truncation of distributions: their parts inside and outside given spans.

A truncated distribution is a list of pieces, none of them a mixture, each with its probability under the original
distribution.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from gen2d.config.distributions import Distribution, Span, next_float32

Pieces = list[tuple[float, Distribution]]
MAX_POINTS = 1000  # whole numbers removed from a continuous range, at most
MAX_DEVIATIONS = 10.0  # standard deviations; a float32 normal never gets farther from its mean
MIN_PROBABILITY = 1e-7  # probability of a piece of a normal; less likely pieces are dropped, and those far in a tail


def far_in_tail(mean: float, deviation: float, low: float, high: float) -> bool:
    """Whether a truncated normal is so far in its tail that float32 cannot resolve its probabilities."""
    return low > mean + 4 * deviation or high < mean - 4 * deviation


def mixture(pieces: Sequence[tuple[float, Distribution]]) -> Distribution:
    """Mixture of weighted distributions, with equal components merged."""
    shares: dict[Distribution, float] = {}
    for weight, part in pieces:
        for share, simple in part.weighted:
            shares[simple] = shares.get(simple, 0.0) + weight * share
    if len(shares) == 1:
        return next(iter(shares))
    return Distribution("mixture", tuple(shares.values()), tuple(shares))


def total(pieces: Pieces) -> float:
    """Total probability of the pieces."""
    return sum(share for share, _ in pieces)


def inside(source: Distribution, spans: Iterable[Span]) -> Pieces:
    """Pieces of a distribution inside the union of the spans."""
    kept, remaining = [], source.weighted
    for span in spans:
        kept += _pieces_inside(remaining, span)
        remaining = _pieces_outside(remaining, span)
    return kept


def outside(source: Distribution, spans: Iterable[Span]) -> Pieces:
    """Pieces of a distribution outside all spans."""
    remaining = source.weighted
    for span in spans:
        remaining = _pieces_outside(remaining, span)
    return remaining


def _pieces_inside(pieces: Pieces, span: Span) -> Pieces:
    return [(share * part, truncated) for share, piece in pieces for part, truncated in _truncated_to(piece, span)]


def _pieces_outside(pieces: Pieces, span: Span) -> Pieces:
    """Pieces below and above the span and, for a span of whole numbers, between these numbers."""
    remaining = []
    for share, piece in pieces:
        holes = [span] if not span.whole or piece.kind == "integer" else _points(span)
        parts = [(share, piece)]
        for hole in holes:
            parts = [
                *_pieces_inside(parts, Span(-math.inf, hole.low)),
                *_pieces_inside(parts, Span(hole.high, math.inf)),
            ]
        remaining += parts
    return remaining


def _points(span: Span) -> list[Span]:
    """One span for each whole number of a span. Raises ValueError if there are too many."""
    first = math.ceil(span.low)
    if not span.last - first < MAX_POINTS:
        raise ValueError(f"of at most {MAX_POINTS} whole numbers where they are cut out of a range")
    return [Span(float(x), next_float32(x)) for x in range(first, int(span.last) + 1)]


def _truncated_to(piece: Distribution, span: Span) -> Pieces:
    """The part of a piece inside a span; an empty list if there is none."""
    if piece.kind in ("constant", "choice", "grid"):
        kept = np.asarray(piece.numbers)[span.contains(piece.numbers)].tolist()
        return [(len(kept) / len(piece.numbers), Distribution(piece.kind, tuple(kept)))] if kept else []
    support = piece.spans[0]
    overlap = support.intersect(span)
    # Single numbers have probability 0 in a continuous range.
    if overlap is None or (overlap.whole and not support.whole):
        return []
    if overlap == support:
        return [(1.0, piece)]
    if piece.kind == "integer":
        low, high = math.ceil(overlap.low), math.ceil(overlap.high)
        return [((high - low) / (support.high - support.low), Distribution("integer", (low, high - 1)))]
    share = (_unscaled_cdf(piece, overlap.high) - _unscaled_cdf(piece, overlap.low)) / (
        _unscaled_cdf(piece, support.high) - _unscaled_cdf(piece, support.low)
    )
    if piece.kind == "normal":
        mean, deviation = piece.numbers[:2]
        reach = MAX_DEVIATIONS * deviation
        low, high = max(overlap.low, mean - reach), min(overlap.high, mean + reach)
        truncated = Distribution("normal", (mean, deviation, low, high))
        return [(share, truncated)] if share > MIN_PROBABILITY and not far_in_tail(*truncated.numbers) else []
    return [(share, Distribution(piece.kind, (overlap.low, overlap.high)))]


def _unscaled_cdf(piece: Distribution, x: float) -> float:
    """The cumulative distribution function at x, up to a constant factor and offset."""
    if piece.kind == "uniform":
        return x
    if piece.kind == "log_uniform":
        return math.log(x)
    return math.erf((x - piece.numbers[0]) / (piece.numbers[1] * math.sqrt(2))) / 2
