"""Distributions cut by supports, exactly: what lies within some spans of numbers, and what lies without.

A cut is a list of pieces, none of them a mixture, each with the share of all draws that it is.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from gen2d.config.distributions import Distribution, Span

Intervals = list[tuple[float, Distribution]]
MOST_POINTS = 1000  # whole numbers that are cut out of a range one by one
FAR = 10.0  # deviations from the mean, beyond which a normal in float32 has nothing
LEAST = 1e-7  # of a piece that a normal is cut into: less is not drawn


def mixture(pieces: Sequence[tuple[float, Distribution]]) -> Distribution:
    """Weighted distributions as one, equal ones together."""
    shares: dict[Distribution, float] = {}
    for weight, part in pieces:
        for share, simple in part.weighted:
            shares[simple] = shares.get(simple, 0.0) + weight * share
    if len(shares) == 1:
        return next(iter(shares))
    return Distribution("mixture", tuple(shares.values()), tuple(shares))


def total(pieces: Intervals) -> float:
    """The share of all draws that these pieces are."""
    return sum(share for share, _ in pieces)


def inside(source: Distribution, spans: Iterable[Span]) -> Intervals:
    """What of a distribution lies within any of these spans."""
    found, rest = [], source.weighted
    for span in spans:
        found += _within(rest, span)
        rest = _without(rest, span)
    return found


def outside(source: Distribution, spans: Iterable[Span]) -> Intervals:
    """What of a distribution lies within none of these spans."""
    rest = source.weighted
    for span in spans:
        rest = _without(rest, span)
    return rest


def _within(pieces: Intervals, span: Span) -> Intervals:
    return [(share * part, cut) for share, piece in pieces for part, cut in _meeting(piece, span)]


def _without(pieces: Intervals, span: Span) -> Intervals:
    """Below the span and above it; also between whole numbers, if it is one of those."""
    found = []
    for share, piece in pieces:
        holes = [span] if not span.whole or piece.kind == "integer" else _points(span)
        rest = [(share, piece)]
        for hole in holes:
            rest = [*_within(rest, Span(-math.inf, hole.low)), *_within(rest, Span(hole.high, math.inf))]
        found += rest
    return found


def _points(span: Span) -> list[Span]:
    """The whole numbers of a span one by one."""
    first = math.ceil(span.low)
    if not span.last - first < MOST_POINTS:
        raise ValueError(f"of at most {MOST_POINTS} whole numbers where they are cut out of a range")
    return [
        Span(float(x), float(np.nextafter(np.float32(x), np.float32(np.inf)))) for x in range(first, int(span.last) + 1)
    ]


def _meeting(piece: Distribution, span: Span) -> Intervals:
    """The part of one piece that lies within a span, if any."""
    if piece.kind in ("constant", "choice", "grid"):
        kept = np.asarray(piece.numbers)[span.contains(piece.numbers)].tolist()
        return [(len(kept) / len(piece.numbers), Distribution(piece.kind, tuple(kept)))] if kept else []
    own = piece.spans[0]
    both = own.meet(span)
    if both is None or (both.whole and not own.whole):  # single numbers of a range are never drawn
        return []
    if both == own:
        return [(1.0, piece)]
    if piece.kind == "integer":
        low, high = math.ceil(both.low), math.ceil(both.high)
        return [((high - low) / (own.high - own.low), Distribution("integer", (low, high - 1)))]
    share = (_rises(piece, both.high) - _rises(piece, both.low)) / (_rises(piece, own.high) - _rises(piece, own.low))
    if piece.kind == "normal":
        mean, deviation = piece.numbers[:2]
        low, high = max(both.low, mean - FAR * deviation), min(both.high, mean + FAR * deviation)
        cut = Distribution("normal", (mean, deviation, low, high))
        return [(share, cut)] if share > LEAST else []
    return [(share, Distribution(piece.kind, (both.low, both.high)))]


def _rises(piece: Distribution, x: float) -> float:
    """What grows with x as the probability of a smaller value does."""
    if piece.kind == "uniform":
        return x
    if piece.kind == "log_uniform":
        return math.log(x)
    return math.erf((x - piece.numbers[0]) / (piece.numbers[1] * math.sqrt(2))) / 2
