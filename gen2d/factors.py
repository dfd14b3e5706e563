"""Every number that a sampler draws, by name: distributions, and the one place where they are drawn from.

In a config a number is a constant, `[low, high]` a uniform range (whole numbers with both ends where the option is a
whole number), `{log_uniform: [low, high]}` and so on a named distribution. A vector is a list of such values.
"""

import dataclasses
import math
import zlib
from collections.abc import Mapping
from numbers import Integral, Real
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.types import Array


@dataclasses.dataclass(frozen=True)
class Distribution:
    """A named distribution over numbers; `support` is the closed interval that it never leaves."""

    kind: str
    numbers: tuple[float, ...]

    @property
    def support(self) -> tuple[float, float]:
        if self.kind == "normal":
            return (self.numbers[2], self.numbers[3]) if len(self.numbers) == 4 else (-math.inf, math.inf)
        return min(self.numbers), max(self.numbers)

    def plain(self) -> Any:
        """The value as it is written in a config."""
        numbers = [int(x) if self.kind == "integer" or float(x).is_integer() else x for x in self.numbers]
        return numbers[0] if self.kind == "constant" else {self.kind: numbers}

    def sample(self, key: Array, shape: tuple[int, ...]) -> Array:
        """Independent draws, float32 (int32 for `integer`)."""
        n = self.numbers
        if self.kind == "constant":
            return jnp.full(shape, n[0], jnp.float32)
        if self.kind == "uniform":
            return jax.random.uniform(key, shape, minval=n[0], maxval=n[1])
        if self.kind == "log_uniform":
            draws = jnp.exp(jax.random.uniform(key, shape, minval=math.log(n[0]), maxval=math.log(n[1])))
            return jnp.clip(draws, n[0], n[1])  # rounding of exp must not leave the support
        if self.kind == "integer":
            return jax.random.randint(key, shape, int(n[0]), int(n[1]) + 1)
        if self.kind == "choice":
            return jnp.asarray(n, jnp.float32)[jax.random.randint(key, shape, 0, len(n))]
        if len(n) == 2:
            return n[0] + n[1] * jax.random.normal(key, shape)
        low, high = ((end - n[0]) / n[1] for end in n[2:])
        return jnp.clip(n[0] + n[1] * jax.random.truncated_normal(key, low, high, shape), n[2], n[3])


LENGTHS = {"constant": (1,), "uniform": (2,), "log_uniform": (2,), "integer": (2,), "normal": (2, 4)}
KINDS = (*LENGTHS, "choice")
FORMS = "a number, [low, high], or one of " + ", ".join(f"{{{kind}: [...]}}" for kind in KINDS[1:])


LARGEST = 1e12  # in any unit: the square of a larger number leaves no room in a float32


def is_number(value: Any) -> bool:
    """Whether the value is a real number that a simulation can take."""
    return isinstance(value, Real) and not isinstance(value, bool) and abs(float(value)) <= LARGEST


def _far_in_the_tail(mean: float, deviation: float, low: float, high: float) -> bool:
    """Where float32 has no probabilities left to draw from."""
    return low > mean + 4 * deviation or high < mean - 4 * deviation


def parse(value: Any, whole: bool = False) -> Distribution:
    """The distribution that a config's value stands for; ValueError with what is allowed where it stands for none."""
    if is_number(value):
        kind, numbers = "constant", [value]
    elif isinstance(value, list | tuple):
        kind, numbers = "integer" if whole else "uniform", value
    elif isinstance(value, dict) and len(value) == 1 and next(iter(value)) in KINDS:
        kind, numbers = next(iter(value.items()))
        kind = "integer" if whole and kind == "uniform" else kind
    else:
        raise ValueError(FORMS)
    if not isinstance(numbers, list | tuple) or not numbers or not all(map(is_number, numbers)):
        raise ValueError(f"{kind} of finite numbers in a list")
    if kind != "choice" and len(numbers) not in LENGTHS[kind]:
        raise ValueError(f"{kind} of {' or '.join(map(str, LENGTHS[kind]))} numbers")
    if kind in ("uniform", "log_uniform", "integer") and numbers[0] > numbers[1]:
        raise ValueError("a range with its lower end first")
    if kind == "log_uniform" and numbers[0] <= 0:
        raise ValueError("a log_uniform range above 0")
    if len(numbers) == 4 and kind == "normal" and _far_in_the_tail(*numbers):
        raise ValueError("a normal cut off within 4 deviations of its mean")
    if kind == "normal" and (numbers[1] <= 0 or (len(numbers) == 4 and numbers[2] >= numbers[3])):
        raise ValueError("normal: [mean, deviation above 0] or [mean, deviation, low, high]")
    if (whole or kind == "integer") and not all(float(x).is_integer() for x in numbers):
        raise ValueError("whole numbers")
    if whole and kind in ("log_uniform", "normal"):
        raise ValueError("a whole number, [low, high] or {choice: [...]}")
    return Distribution(kind, tuple(int(x) if isinstance(x, Integral) else float(x) for x in numbers))


def key_for(key: Array, what: str) -> Array:
    """The key of one of the things that numbers are drawn for."""
    return jax.random.fold_in(key, zlib.crc32(what.encode()))


Drawn = Distribution | tuple[Distribution, ...]


def draw(key: Array, wanted: Mapping[str, tuple[Drawn, tuple[int, ...]]]) -> dict[str, Array]:
    """For each name its draws: `shape` of them, or `shape + (parts,)` for a vector of distributions.

    Each name has a key of its own, so that one factor's draws do not depend on which others there are.
    """
    drawn = {}
    for name, (source, shape) in wanted.items():
        own = key_for(key, name)
        if isinstance(source, Distribution):
            drawn[name] = source.sample(own, shape)
        else:
            keys = jax.random.split(own, len(source))
            drawn[name] = jnp.stack([part.sample(k, shape) for k, part in zip(keys, source, strict=True)], axis=-1)
    return drawn


def options_of(module: ModuleType) -> dict[str, Any]:
    """The option behind each factor of a scene family, by name."""
    found = {field.name: field.metadata["option"] for field in dataclasses.fields(module.Options)}
    return {name: spec for name, spec in found.items() if spec.draw}


def seed_words(seed: int, split: int) -> np.ndarray:
    """A seed up to 2**63 - 1 and a split's number as three 32-bit words, so that jax needs no 64-bit mode."""
    return np.array([seed >> 32, seed & 0xFFFFFFFF, split], np.uint32)


def video_keys(words: Array, numbers: Array) -> Array:
    """A key per video: `fold_in(fold_in(key(seed), split), i)`; `words` as `seed_words` gives them."""
    root = jax.random.fold_in(jax.random.wrap_key_data(words[:2], impl="threefry2x32"), words[2])
    return jax.vmap(lambda i: jax.random.fold_in(root, i))(numbers)
