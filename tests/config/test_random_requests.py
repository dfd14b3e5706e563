"""Requests of random numbers that are answered together have the bits of separate calls."""

import jax
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

FUNCTIONS = {uniform: (-2.0, 3.0), normal: (), truncated_normal: (-0.5, 2.0), integers: (-4, 9)}


def test_answers_have_the_bits_of_separate_calls() -> None:
    requests = [
        RandomRequest(function, jax.random.key(seed), shape, numbers)
        for seed, shape in enumerate([(), (7,), (2, 3), (1,)])
        for function, numbers in FUNCTIONS.items()
    ]
    requests += [RandomRequest(split, jax.random.key(20 + n), (n,)) for n in (1, 2, 5)]

    def one(request: RandomRequest) -> Draws:
        return (yield request)

    together = answer_together([one(request) for request in requests])
    for request, answer in zip(requests, together, strict=True):
        alone = request.function(request.key, request.shape, *request.parameters)
        if request.function is split:
            alone, answer = jax.random.key_data(alone), jax.random.key_data(answer)
        assert answer.shape == alone.shape
        np.testing.assert_array_equal(np.asarray(answer), np.asarray(alone))


def test_generators_of_any_length_end() -> None:
    def draws(length: int) -> Draws:
        key, total = jax.random.key(length), jnp.zeros(())
        for _ in range(length):
            keys = yield RandomRequest(split, key, (2,))
            key = keys[0]
            total += yield RandomRequest(uniform, keys[1], (), (0.0, 1.0))
        return total

    together = answer_together([draws(n) for n in (0, 3, 1)])
    assert [float(x) for x in together] == [float(answer_together([draws(n)])[0]) for n in (0, 3, 1)]
    assert float(together[0]) == 0
