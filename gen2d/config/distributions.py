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


def to_float32(value: float) -> float:
    """The nearest float32."""
    return float(np.float32(value))


def next_float32(value: float) -> float:
    """The next float32 above a number."""
    return float(np.nextafter(np.float32(value), np.float32(np.inf)))


class Span(NamedTuple):
    """The half-open interval [low, high); its whole numbers only, if `whole`."""

    low: float
    high: float
    whole: bool = False

    @property
    def last(self) -> float:
        """Largest number of the span, as float32."""
        below = float(np.nextafter(np.float32(self.high), np.float32(-np.inf)))
        return max(math.ceil(self.high) - 1, math.ceil(self.low)) if self.whole else below

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
            return min(low for low, _ in ends), max(high for _, high in ends)
        if self.kind == "normal":
            return (self.numbers[2], self.numbers[3]) if len(self.numbers) == 4 else (-math.inf, math.inf)
        return min(self.numbers), max(self.numbers)

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
            return jax.random.randint(key, shape, int(n[0]), int(n[1]) + 1)
        if self.kind in ("choice", "grid"):
            return jnp.asarray(n, jnp.float32)[jax.random.randint(key, shape, 0, len(n))]
        if self.kind == "normal" and len(n) == 2:
            return n[0] + n[1] * jax.random.normal(key, shape)
        if self.kind == "uniform":
            samples = jax.random.uniform(key, shape, minval=n[0], maxval=n[1])
        elif self.kind == "log_uniform":
            samples = jnp.exp(jax.random.uniform(key, shape, minval=math.log(n[0]), maxval=math.log(n[1])))
        else:
            low, high = ((end - n[0]) / n[1] for end in n[2:])
            samples = n[0] + n[1] * jax.random.truncated_normal(key, low, high, shape)
        return jnp.clip(samples, self.spans[0].low, self.spans[0].last)  # rounding may leave the support

    @property
    def weighted(self) -> list[tuple[float, "Distribution"]]:
        """Components of a mixture, or the distribution itself, each with its probability."""
        if self.kind != "mixture":
            return [(1.0, self)]
        return [(weight / sum(self.numbers), part) for weight, part in zip(self.numbers, self.parts, strict=True)]

    def _sample_mixture(self, key: Array, shape: tuple[int, ...]) -> Array:
        component_key, value_key = jax.random.split(key)
        thresholds = np.cumsum(self.numbers)[:-1] / sum(self.numbers)
        chosen = (jax.random.uniform(component_key, shape)[..., None] >= jnp.asarray(thresholds, jnp.float32)).sum(-1)
        samples = [part.sample(value_key, shape) for part in self.parts]
        return jnp.select([chosen == i for i in range(len(samples))], samples)
