"""Random keys by purpose and by video."""

import functools
import zlib
from collections.abc import Sequence

import jax
import numpy as np

from gen2d.records.axes import Array


def key_for(key: Array, what: str) -> Array:
    """The key for one named purpose, such as the name of a factor."""
    return keys_for(key, [what])[0]


def keys_for(key: Array, whats: Sequence[str]) -> list[Array]:
    """The keys for several named purposes, from one vmapped `fold_in`."""
    codes = np.array([zlib.crc32(what.encode()) for what in whats], np.uint32)
    return list(jax.vmap(functools.partial(jax.random.fold_in, key))(codes))


def seed_words(seed: int, split: int) -> np.ndarray:
    """A seed up to 2**63 - 1 and a split's number as uint32 [3], so that jax needs no 64-bit mode."""
    return np.array([seed >> 32, seed & 0xFFFFFFFF, split], np.uint32)


def video_keys(words: Array, numbers: Array) -> Array:
    """One key per video, `fold_in(fold_in(key(seed), split), i)`, from `words = seed_words(seed, split)`."""
    root = jax.random.fold_in(wrapped(words[:2]), words[2])
    return jax.vmap(lambda i: jax.random.fold_in(root, i))(numbers)


def unwrapped(keys: Array) -> Array:
    """Words uint32 [..., 2] of keys [...], as programs pass them to each other."""
    return jax.random.key_data(keys)


def wrapped(words: Array) -> Array:
    """Keys [...] of these words [..., 2]."""
    return jax.random.wrap_key_data(words, impl="threefry2x32")


MAX_VIDEOS = 2**32 - 1
