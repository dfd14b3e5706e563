"""Distributions over numbers: their supports and samples.

Samples are float32, and so are the ends of every range. A range includes its lower end and excludes its upper end, so
adjacent ranges are disjoint and the difference of two ranges consists of ranges. Supports can therefore be compared and
truncated exactly (truncation.py), without sampling.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gen2d.config.random_requests import (
    Draws,
    RandomRequest,
    answer_together,
    integers,
    normal,
    split,
    truncated_normal,
    uniform,
)
from gen2d.records.axes import Array
from gen2d.records.parameter import apply, recorded


@recorded
def to_float32(value: float) -> float:
    """The nearest float32."""
    return float(np.float32(value))


@recorded
def next_float32(value: float) -> float:
    """The next float32 above a number."""
    return float(np.nextafter(np.float32(value), np.float32(np.inf)))


@recorded
def _lowest(*numbers: float) -> float:
    return min(numbers)


@recorded
def _highest(*numbers: float) -> float:
    return max(numbers)


@recorded
def _last(low: float, high: float, whole: bool = False) -> float:
    """Largest float32 of the half-open range [low, high); its largest whole number, if `whole`."""
    below = float(np.nextafter(np.float32(high), np.float32(-np.inf)))
    return max(math.ceil(high) - 1, math.ceil(low)) if whole else below


@recorded
def _last_sample(low: float, high: float) -> float:
    """Largest sample of a continuous range, as float32."""
    return (point(low) if low == high else Span(to_float32(low), to_float32(high))).last


@recorded
def thresholds(length: int, *weights: float) -> np.ndarray:
    """Cumulative probabilities [length - 1] of components, without the last; 2 where there is none."""
    ends = np.full(length - 1, 2.0)
    ends[: len(weights) - 1] = np.cumsum(weights)[:-1] / sum(weights)
    return ends


@recorded
def stacked(*values: Any) -> np.ndarray:
    """Numbers, or arrays of one shape, along a new first axis."""
    return np.stack(values)


class Span(NamedTuple):
    """The half-open interval [low, high); its whole numbers only, if `whole`."""

    low: float
    high: float
    whole: bool = False

    @property
    def last(self) -> float:
        """Largest number of the span, as float32."""
        return _last(self.low, self.high, self.whole)

    def contains(self, values: Any) -> np.ndarray:
        """Whether each value, rounded to float32, lies in the span."""
        x = np.asarray(values, np.float32).astype(np.float64)
        return (x >= self.low) & (x < self.high) & (~np.asarray(self.whole) | (x == np.floor(x)))

    def intersect(self, other: "Span") -> "Span | None":
        """Intersection of two spans; None if it is empty."""
        overlap = Span(max(self.low, other.low), min(self.high, other.high), self.whole or other.whole)
        first = math.ceil(overlap.low) if overlap.whole and math.isfinite(overlap.low) else overlap.low
        return overlap if first < overlap.high else None


def point(value: float) -> Span:
    """Span of a single float32."""
    return Span(to_float32(value), next_float32(value))


@dataclasses.dataclass(frozen=True)
class Distribution:
    """A distribution over numbers: a kind and its parameters.

    `numbers` holds the parameters in the order of a config; for a mixture, the weights of its `parts`.
    """

    kind: str
    numbers: tuple[float, ...]
    parts: tuple["Distribution", ...] = ()

    @property
    def support(self) -> tuple[float, float]:
        """Closed interval (low, high) that contains all values."""
        if self.kind == "mixture":
            ends = [part.support for part in self.parts]
            return _lowest(*(low for low, _ in ends)), _highest(*(high for _, high in ends))
        if self.kind == "normal":
            return (self.numbers[2], self.numbers[3]) if len(self.numbers) == 4 else (-math.inf, math.inf)
        return _lowest(*self.numbers), _highest(*self.numbers)

    @property
    def spans(self) -> tuple[Span, ...]:
        """Spans whose union is the support; spans of a mixture may overlap."""
        if self.kind == "mixture":
            return tuple(dict.fromkeys(span for part in self.parts for span in part.spans))
        if self.kind in ("constant", "choice", "grid"):
            return tuple(point(x) for x in dict.fromkeys(self.numbers))
        low, high = self.support
        if self.kind == "integer":
            return (Span(low, high + 1, whole=True),)
        return (point(low),) if low == high else (Span(to_float32(low), to_float32(high)),)

    def contains(self, values: Any) -> np.ndarray:
        """Whether each value lies in the support."""
        return np.any([span.contains(values) for span in self.spans], axis=0)

    def plain(self) -> Any:
        """The distribution as a plain value, as written in a config."""
        numbers = [int(x) if self.kind == "integer" or float(x).is_integer() else x for x in self.numbers]
        if self.kind == "mixture":
            return {"mixture": [part.plain() for part in self.parts], "weights": list(self.numbers)}
        return numbers[0] if self.kind == "constant" else {self.kind: numbers}

    @property
    def form(self) -> tuple[str, int]:
        """Kind, and number of parameters: distributions of one form are sampled alike. Mixtures are of one form."""
        return self.kind, 0 if self.kind == "mixture" else len(self.numbers)

    @property
    def flat_numbers(self) -> tuple[float, ...]:
        """All numbers, followed by those of the parts."""
        return *self.numbers, *(x for part in self.parts for x in part.flat_numbers)

    @property
    def intervals(self) -> list[tuple[float, float]]:
        """Closed intervals of float32 numbers, some of which may be equal; the samples are those inside one of them."""
        if self.kind == "mixture":
            return [interval for part in self.parts for interval in part.intervals]
        if self.kind in ("constant", "choice", "grid"):
            return [(to_float32(x), to_float32(x)) for x in self.numbers]
        low, high = self.support
        if self.form in (("integer", 2), ("normal", 2)):
            return [(low, high)]
        return [(to_float32(low), _last_sample(low, high))]

    def sample(self, key: Array, shape: tuple[int, ...]) -> Array:
        """Independent samples of this shape, float32 (int32 for `integer`)."""
        return sample_one_of([self], 0, key, shape)

    @property
    def weighted(self) -> list[tuple[float, "Distribution"]]:
        """Components of a mixture, or the distribution itself, each with its probability."""
        if self.kind != "mixture":
            return [(1.0, self)]
        return [(weight / sum(self.numbers), part) for weight, part in zip(self.numbers, self.parts, strict=True)]

    @property
    def constants(self) -> tuple[Any, ...]:
        """Numbers that `sample_one_of` needs of a distribution that is no mixture, computed in float64."""
        n = self.numbers
        if self.kind == "integer":
            return apply(int, n[0]), apply(int, n[1]) + 1
        if self.kind in ("choice", "grid"):
            return (stacked(*n),)
        if self.form in (("constant", 1), ("normal", 2)):
            return n
        if self.kind == "log_uniform":
            n = tuple(apply(math.log, x) for x in n)
        elif self.kind == "normal":
            n = n[0], n[1], (n[2] - n[0]) / n[1], (n[3] - n[0]) / n[1]
        return *n, *self.intervals[0]


def sample_one_of(sources: Sequence[Distribution], index: Any, key: Array, shape: tuple[int, ...]) -> Array:
    """Independent samples of this shape, from distribution number `index` of the sources.

    The index is a number, or has one for each sample. Samples are those of `sources[index].sample(key, shape)`.
    """
    return answer_together([draws(sources, index, key, shape)])[0]


def draws(sources: Sequence[Distribution], index: Any, key: Array, shape: tuple[int, ...]) -> Draws:
    """Requests of `sample_one_of`, and its samples.

    All distributions of one form are sampled at once, from numbers that are gathered by index, so a program depends on
    the forms alone.
    """
    forms = [source.form for source in sources]
    if len(set(forms)) > 1:
        samples, distinct = [], list(dict.fromkeys(forms))
        for form in distinct:
            own = np.array([other == form for other in forms])
            places = np.maximum(np.cumsum(own) - 1, 0)  # among those of this form; of others, any
            group = [source for source, is_own in zip(sources, own, strict=True) if is_own]
            samples.append((yield from draws(group, jnp.asarray(places)[index], key, shape)))
        chosen = jnp.asarray([distinct.index(form) for form in forms])[index]
        return jnp.select([chosen == i for i in range(len(distinct))], samples)

    kind, count = forms[0]
    place = (index,) if len(sources) > 1 else ()

    def table(values: Sequence[Any], dtype: Any = jnp.float32) -> Array:
        """Values of all sources along the first axis, or those of the only one."""
        return jnp.asarray(stacked(*values) if place else values[0], dtype)

    if kind == "mixture":
        component_key, key = yield RandomRequest(split, key, (2,))
        counts = [len(source.parts) for source in sources]
        ends = table([thresholds(max(counts), *source.numbers) for source in sources])[place]
        component = ((yield RandomRequest(uniform, component_key, shape, (0.0, 1.0)))[..., None] >= ends).sum(-1)
        firsts = table([*np.cumsum([0, *counts[:-1]])], jnp.int32)[place]
        return (yield from draws([part for source in sources for part in source.parts], firsts + component, key, shape))
    columns = list(zip(*(source.constants for source in sources), strict=True))
    if kind in ("choice", "grid"):
        return table(columns[0])[(*place, (yield RandomRequest(integers, key, shape, (0, count))))]
    if kind == "integer":
        low, stop = (table(column, jnp.int32)[place] for column in columns)
        return (yield RandomRequest(integers, key, shape, (low, stop)))
    n = [table(column)[place] for column in columns]
    if kind == "constant":
        return jnp.broadcast_to(n[0], shape)
    if kind == "normal" and count == 2:
        return n[0] + n[1] * (yield RandomRequest(normal, key, shape))
    if kind == "normal":
        samples = n[0] + n[1] * (yield RandomRequest(truncated_normal, key, shape, (n[2], n[3])))
    else:
        samples = yield RandomRequest(uniform, key, shape, (n[0], n[1]))
    samples = jnp.exp(samples) if kind == "log_uniform" else samples
    return jnp.clip(samples, *n[-2:])  # rounding may leave the support
