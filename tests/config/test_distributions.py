"""Draws: every value within its distribution, distributed as declared, fixed by its name, seed, split and number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from gen2d.config.config import load_config
from gen2d.config.distribution_syntax import parse
from gen2d.records.keys import key_for, keys_for, seed_words, video_keys
from gen2d.sampling.sampler import Sampler

COUNT = 20_000
# Config value -> cumulative distribution function, or None where the counts are compared.
LAWS = {
    "uniform": ([2.0, 5.0], lambda x: (x - 2) / 3),
    "log_uniform": ({"log_uniform": [0.1, 10]}, lambda x: np.log(x / 0.1) / np.log(100)),
    "normal": ({"normal": [1, 2]}, lambda x: _normal((x - 1) / 2)),
    "truncated": (
        {"normal": [1, 2, 0, 4]},
        lambda x: (_normal((x - 1) / 2) - _normal(-0.5)) / (_normal(1.5) - _normal(-0.5)),
    ),
}


def _normal(z):
    return (1 + np.vectorize(__import__("math").erf)(z / np.sqrt(2))) / 2


@pytest.mark.parametrize("name", LAWS)
def test_draws_follow_their_law(name):
    value, law = LAWS[name]
    distribution = parse(value)
    x = np.sort(np.asarray(distribution.sample(jax.random.key(1), (COUNT,)), float))
    assert x[0] >= distribution.support[0]
    assert x[-1] <= distribution.support[1]
    rank = np.arange(COUNT)
    distance = max(np.max(law(x) - rank / COUNT), np.max((rank + 1) / COUNT - law(x)))
    assert distance < 1.95 / np.sqrt(COUNT)  # Kolmogorov-Smirnov, p = 0.001


def test_a_mixture_has_its_weights():
    parts = {"mixture": [[0, 1], [2, 3], [4, 5]], "weights": [1, 2, 5]}
    shares = np.bincount(np.asarray(parse(parts).sample(jax.random.key(4), (COUNT,))).astype(int) // 2) / COUNT
    assert np.abs(shares - np.array([1, 2, 5]) / 8).max() < 4 * 0.5 / np.sqrt(COUNT)


def test_the_part_of_a_mixture_says_nothing_of_the_place_in_it():
    x = np.asarray(parse({"mixture": [[0, 1], [2, 3]]}).sample(jax.random.key(5), (COUNT,)))
    for low in (0, 2):
        assert abs(np.mean(x[(x >= low) & (x < low + 1)] - low) - 0.5) < 4 * 0.29 / np.sqrt(COUNT / 2)


@pytest.mark.parametrize("value", [{"log_uniform": [0.1, 0.3]}, {"normal": [1.1, 0.1, 1.05, 1.15]}, [0.1, 0.1000001]])
def test_no_sample_is_rounded_out_of_its_range(value):
    """exp(log(x)) is not x in float32, nor is a mean plus a cut number of deviations the value at the cut."""
    distribution = parse(value)
    assert distribution.contains(distribution.sample(jax.random.key(6), (10**6,))).all()


@pytest.mark.parametrize("value", [[3, 8], {"choice": [3, 4, 5, 6, 7, 8]}])
def test_whole_numbers_are_equally_frequent(value):
    x = np.asarray(parse(value, whole=True).sample(jax.random.key(2), (COUNT,)))
    counts = np.bincount(x.astype(int), minlength=9)[3:]
    assert counts.sum() == COUNT
    assert np.abs(counts / COUNT - 1 / 6).max() < 0.015


def test_a_factor_does_not_depend_on_the_others():
    def drawn(**scene):
        sampler = Sampler(load_config({"scene": {"name": "bouncing", "balls": 4, "radius": [1, 2]} | scene}))
        return sampler.sample_factors(jax.random.key(3))

    one, other = drawn(), drawn(spin=[0, 1], elasticity=0.5)
    assert_array_equal(one["radius"], other["radius"])
    assert one["velocity"].shape == (4, 2)
    assert one["gravity"].shape == (2,)


def test_each_factor_has_a_key_of_its_own():
    keys = [jax.random.key_data(key).tolist() for key in keys_for(jax.random.key(3), ["radius", "density", "spin"])]
    assert len({tuple(words) for words in keys}) == 3
    assert keys[1] == jax.random.key_data(key_for(jax.random.key(3), "density")).tolist()
    assert keys[1] != jax.random.key_data(key_for(jax.random.key(4), "density")).tolist()


def test_a_key_is_of_seed_split_and_number_alone():
    def keys(seed: int, split: int, numbers: list[int]) -> np.ndarray:
        return np.asarray(
            jax.random.key_data(video_keys(jnp.asarray(seed_words(seed, split)), jnp.asarray(numbers, jnp.uint32)))
        )

    assert_array_equal(keys(7, 1, [0, 1, 2, 3])[2], keys(7, 1, [2])[0])
    every = np.concatenate([keys(s, p, [0, 1, 2**32 - 1]) for s in (0, 1, 2**32, 2**63 - 1) for p in (0, 1)])
    assert len(np.unique(every, axis=0)) == len(every)


def test_a_key_is_what_jax_makes_of_the_seed():
    root = jax.random.fold_in(jax.random.key(5), 9)
    expected = jax.random.key_data(jax.random.fold_in(root, 3))
    assert_array_equal(jax.random.key_data(video_keys(jnp.asarray(seed_words(5, 9)), jnp.uint32([3])))[0], expected)
