"""In which order videos come: permutations that are computed, not stored, and random numbers without a state."""

import numpy as np

# What a random number is for, so that no two uses share one.
ORDER, WINDOWS, SOURCES = 0, 1, 2


def order(seed: int, epoch: int, positions: np.ndarray, count: int) -> np.ndarray:
    """The numbers of the videos at these positions of an epoch: a permutation of 0 to count - 1, nowhere stored.

    A Feistel network permutes the smallest square power of two that holds `count`; what falls outside goes through
    again until it falls inside (Black and Rogaway, CT-RSA 2002).
    """
    half = np.uint64(max(1, ((count - 1).bit_length() + 1) // 2))
    keys = [hashed(ORDER, seed, epoch, step) for step in range(8)]
    values = positions.astype(np.uint64)
    outside = np.ones(values.shape, bool)
    while outside.any():
        values[outside] = _feistel(values[outside], keys, half)
        outside = values >= count
    return values.astype(np.int64)


def _feistel(values: np.ndarray, keys: list[np.ndarray], half: np.uint64) -> np.ndarray:
    mask = (np.uint64(1) << half) - np.uint64(1)
    left, right = values >> half, values & mask
    for key in keys:
        left, right = right, left ^ (_mixed(right ^ key) & mask)
    return (left << half) | right


def hashed(*parts: int | np.ndarray) -> np.ndarray:
    """64 random bits that the parts decide, uint64, for each element of the parts."""
    bits = np.zeros(1, np.uint64)
    for part in parts:
        bits = _mixed(bits ^ np.asarray(part).astype(np.uint64))
    return bits


def _mixed(bits: np.ndarray) -> np.ndarray:
    """The next output of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), for each element."""
    bits = bits + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))
