"""Distributions over numbers: where their values lie, and draws from them.

What is drawn is a float32, so all ends are. A range holds its lower end and not its upper one: then ranges that meet
have nothing in common, and what is left of one without another is a range again. So supports are compared and cut
exactly (cuts.py), not by drawing from them.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array


def single(value: float) -> float:
    """The nearest float32."""
    return float(np.float32(value))


def after(value: float) -> float:
    """The next float32 above a number."""
    return float(np.nextafter(np.float32(value), np.float32(np.inf)))


class Span(NamedTuple):
    """The numbers from `low` on and below `high`; of these the whole ones, if `whole`."""

    low: float
    high: float
    whole: bool = False

    @property
    def last(self) -> float:
        """The largest of its numbers."""
        below = float(np.nextafter(np.float32(self.high), np.float32(-np.inf)))
        return max(math.ceil(self.high) - 1, math.ceil(self.low)) if self.whole else below

    def contains(self, values: Any) -> np.ndarray:
        """For each value whether it is one of these numbers, as float32."""
        x = np.asarray(values, np.float32).astype(np.float64)
        return (x >= self.low) & (x < self.high) & (~np.asarray(self.whole) | (x == np.floor(x)))

    def meet(self, other: "Span") -> "Span | None":
        """What both hold; None if that is nothing."""
        both = Span(max(self.low, other.low), min(self.high, other.high), self.whole or other.whole)
        first = math.ceil(both.low) if both.whole and math.isfinite(both.low) else both.low
        return both if first < both.high else None


def point(value: float) -> Span:
    """A number alone."""
    return Span(single(value), after(value))


EVERYTHING = Span(-math.inf, math.inf)


@dataclasses.dataclass(frozen=True)
class Distribution:
    """A named distribution over numbers. A mixture's `numbers` are the weights of its `parts`."""

    kind: str
    numbers: tuple[float, ...]
    parts: tuple["Distribution", ...] = ()

    @property
    def support(self) -> tuple[float, float]:
        """The closed interval that it never leaves."""
        if self.kind == "mixture":
            ends = [part.support for part in self.parts]
            return min(low for low, _ in ends), max(high for _, high in ends)
        if self.kind == "normal":
            return (self.numbers[2], self.numbers[3]) if len(self.numbers) == 4 else (-math.inf, math.inf)
        return min(self.numbers), max(self.numbers)

    @property
    def spans(self) -> tuple[Span, ...]:
        """Where its values lie; each number at least once."""
        if self.kind == "mixture":
            return tuple(dict.fromkeys(span for part in self.parts for span in part.spans))
        if self.kind in ("constant", "choice", "grid"):
            return tuple(point(x) for x in dict.fromkeys(self.numbers))
        low, high = self.support
        if self.kind == "integer":
            return (Span(low, high + 1, whole=True),)
        return (point(low),) if low == high else (Span(single(low), single(high)),)

    def contains(self, values: Any) -> np.ndarray:
        """For each value whether the distribution can give it."""
        return np.any([span.contains(values) for span in self.spans], axis=0)

    def plain(self) -> Any:
        """The value as it is written in a config."""
        numbers = [int(x) if self.kind == "integer" or float(x).is_integer() else x for x in self.numbers]
        if self.kind == "mixture":
            return {"mixture": [part.plain() for part in self.parts], "weights": list(self.numbers)}
        return numbers[0] if self.kind == "constant" else {self.kind: numbers}

    def sample(self, key: Array, shape: tuple[int, ...]) -> Array:
        """Independent draws, float32 (int32 for `integer`)."""
        n = self.numbers
        if self.kind == "mixture":
            return self._mixed(key, shape)
        if self.kind == "constant":
            return jnp.full(shape, n[0], jnp.float32)
        if self.kind == "integer":
            return jax.random.randint(key, shape, int(n[0]), int(n[1]) + 1)
        if self.kind in ("choice", "grid"):
            return jnp.asarray(n, jnp.float32)[jax.random.randint(key, shape, 0, len(n))]
        if self.kind == "normal" and len(n) == 2:
            return n[0] + n[1] * jax.random.normal(key, shape)
        if self.kind == "uniform":
            draws = jax.random.uniform(key, shape, minval=n[0], maxval=n[1])
        elif self.kind == "log_uniform":
            draws = jnp.exp(jax.random.uniform(key, shape, minval=math.log(n[0]), maxval=math.log(n[1])))
        else:
            low, high = ((end - n[0]) / n[1] for end in n[2:])
            draws = n[0] + n[1] * jax.random.truncated_normal(key, low, high, shape)
        return jnp.clip(draws, self.spans[0].low, self.spans[0].last)  # rounding must not leave the support

    @property
    def weighted(self) -> list[tuple[float, "Distribution"]]:
        """The parts of a mixture, or the distribution alone, each with its share of all."""
        if self.kind != "mixture":
            return [(1.0, self)]
        return [(weight / sum(self.numbers), part) for weight, part in zip(self.numbers, self.parts, strict=True)]

    def _mixed(self, key: Array, shape: tuple[int, ...]) -> Array:
        choice, draw = jax.random.split(key)
        ends = np.cumsum(self.numbers)[:-1] / sum(self.numbers)
        chosen = (jax.random.uniform(choice, shape)[..., None] >= jnp.asarray(ends, jnp.float32)).sum(-1)
        draws = [part.sample(draw, shape) for part in self.parts]
        return jnp.select([chosen == i for i in range(len(draws))], draws)
