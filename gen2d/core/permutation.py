"""Stateless pseudo-random permutations and hashes of integers: a Feistel network and SplitMix64."""

import numpy as np


def feistel(values: np.ndarray, keys: list[np.ndarray], half: np.uint64) -> np.ndarray:
    """Image of each value, uint64 below 2**(2 * half), under a Feistel network with one round per key."""
    mask = (np.uint64(1) << half) - np.uint64(1)
    left, right = values >> half, values & mask
    for key in keys:
        left, right = right, left ^ (splitmix64(right ^ key) & mask)
    return (left << half) | right


def hashed(*parts: int | np.ndarray) -> np.ndarray:
    """Hash of the parts, elementwise: 64 pseudo-random bits, uint64."""
    bits = np.zeros(1, np.uint64)
    for part in parts:
        bits = splitmix64(bits ^ np.asarray(part).astype(np.uint64))
    return bits


def splitmix64(bits: np.ndarray) -> np.ndarray:
    """Output of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014) for each state, uint64."""
    bits = bits + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))
