"""Distributions over numbers: their supports and samples.

Samples are float32, and so are the ends of every range. A range includes its lower end and excludes its upper end, so
adjacent ranges are disjoint and the difference of two ranges consists of ranges. Supports can therefore be compared and
truncated exactly (truncation.py), without sampling.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

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
def _thresholds(*weights: float) -> np.ndarray:
    """Cumulative probabilities of components, without the last."""
    return np.cumsum(weights)[:-1] / sum(weights)


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

    def sample(self, key: Array, shape: tuple[int, ...]) -> Array:
        """Independent samples of this shape, float32 (int32 for `integer`)."""
        n = self.numbers
        if self.kind == "mixture":
            return self._sample_mixture(key, shape)
        if self.kind == "constant":
            return jnp.full(shape, n[0], jnp.float32)
        if self.kind == "integer":
            return jax.random.randint(key, shape, apply(int, n[0]), apply(int, n[1]) + 1)
        if self.kind in ("choice", "grid"):
            return jnp.asarray(n, jnp.float32)[jax.random.randint(key, shape, 0, len(n))]
        if self.kind == "normal" and len(n) == 2:
            return n[0] + n[1] * jax.random.normal(key, shape)
        if self.kind == "uniform":
            samples = jax.random.uniform(key, shape, minval=n[0], maxval=n[1])
        elif self.kind == "log_uniform":
            low, high = (apply(math.log, x) for x in n)
            samples = jnp.exp(jax.random.uniform(key, shape, minval=low, maxval=high))
        else:
            low, high = ((end - n[0]) / n[1] for end in n[2:])
            samples = n[0] + n[1] * jax.random.truncated_normal(key, low, high, shape)
        low, high = self.support
        return jnp.clip(samples, to_float32(low), _last_sample(low, high))  # rounding may leave the support

    @property
    def weighted(self) -> list[tuple[float, "Distribution"]]:
        """Components of a mixture, or the distribution itself, each with its probability."""
        if self.kind != "mixture":
            return [(1.0, self)]
        return [(weight / sum(self.numbers), part) for weight, part in zip(self.numbers, self.parts, strict=True)]

    def _sample_mixture(self, key: Array, shape: tuple[int, ...]) -> Array:
        component_key, value_key = jax.random.split(key)
        thresholds = jnp.asarray(_thresholds(*self.numbers), jnp.float32)
        chosen = (jax.random.uniform(component_key, shape)[..., None] >= thresholds).sum(-1)
        samples = [part.sample(value_key, shape) for part in self.parts]
        return jnp.select([chosen == i for i in range(len(samples))], samples)
