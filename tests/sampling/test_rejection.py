"""Rejection: each attempt at a video has a key of its own, and the first that fits takes the video's row."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_array_equal

from gen2d.config.config import load_config
from gen2d.programs.rollout import DeviceBatch
from gen2d.sampling import rejection


def test_each_attempt_has_a_key_of_its_own_and_the_first_that_of_the_video() -> None:
    keys = jnp.repeat(jax.random.split(jax.random.key(0), 2), 3)
    attempts = jnp.array([0, 1, 2] * 2)
    words = np.asarray(jax.random.key_data(rejection.attempt_keys(keys, attempts)))
    assert_array_equal(words[::3], jax.random.key_data(keys)[::3])
    assert len(np.unique(words, axis=0)) == 6


def test_the_accepted_attempt_is_in_the_row_of_its_video() -> None:
    """Video i has as many contacts in attempt a as i and a say; those with 20 or more are accepted."""
    wanted = np.array([5, 0, 3, 9, 0, 2, 40, 1])

    def make(rows: np.ndarray, attempts: np.ndarray) -> DeviceBatch:
        contacts = np.where(attempts >= wanted[rows], 20 + rows, 0)
        columns = {"quality/contacts": jnp.asarray(contacts), "attempt": jnp.asarray(attempts)}
        undrawn: Any = ()
        return DeviceBatch(columns, undrawn, jnp.ones(len(rows), bool))

    options = load_config({"scene": "bouncing", "quality": {"min_contacts": 20, "attempts": 40}}).quality
    batch, chosen = rejection.accepted_batch(make, np.arange(8), options)
    assert_array_equal(chosen, wanted)
    assert_array_equal(batch.columns["quality/contacts"], 20 + np.arange(8))
    assert_array_equal(batch.columns["attempt"], wanted)
