"""Random numbers of several samplers from few calls of jax.random.

Each call is a dozen loops and kernels to compile, whatever its size. A sampler is therefore a generator that yields
requests, such as `RandomRequest(uniform, key, shape, (low, high))`, and is sent their results. `answer_together`
runs many such generators, and answers requests of one kind by a single call, with the bits of separate calls.
"""

import math
from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array


class RandomRequest(NamedTuple):
    """Samples of one of the functions below."""

    function: Callable[..., Array]  # called with the key, the shape and the parameters
    key: Array
    shape: tuple[int, ...] = ()
    parameters: tuple[Any, ...] = ()  # broadcast to the shape


Draws = Generator[RandomRequest, Array, Array]  # yields requests, and returns its samples


def answer_together(draws: Sequence[Draws]) -> list[Array]:
    """Results of generators whose requests are answered together."""
    results: dict[int, Array] = {}
    answers: dict[int, Any] = dict.fromkeys(range(len(draws)))  # of the generators that are not finished
    while answers:
        requests: dict[int, RandomRequest] = {}
        for number, answer in answers.items():
            try:
                requests[number] = draws[number].send(answer)
            except StopIteration as finished:
                results[number] = finished.value
        answers = dict(zip(requests, answer_requests([*requests.values()]), strict=True))
    return [results[number] for number in range(len(draws))]


def answer_requests(requests: Sequence[RandomRequest]) -> list[Array]:
    """The result of each request; those of one function are computed at once."""
    answers: dict[int, Array] = {}
    for function in dict.fromkeys(request.function for request in requests):
        own = {number: request for number, request in enumerate(requests) if request.function is function}
        answers |= dict(zip(own, _call(function, [*own.values()]), strict=True))
    return [answers[number] for number in range(len(requests))]


def _call(function: Callable[..., Array], requests: Sequence[RandomRequest]) -> list[Array]:
    """Results of requests of one function, from one call for the largest of them.

    Sample i depends on the key and on i alone, so a smaller request takes the first samples.
    """
    if len(requests) == 1:
        ((_, key, shape, parameters),) = requests
        return [function(key, shape, *parameters)]
    size = max(math.prod(request.shape) for request in requests)

    def padded(parameter: Any, shape: tuple[int, ...]) -> Array:
        values = jnp.broadcast_to(jnp.asarray(parameter), shape).reshape(-1)
        return jnp.pad(values, (0, size - len(values)), mode="edge")

    keys = jnp.stack([request.key for request in requests])
    rows = [[padded(x, request.shape) for x in request.parameters] for request in requests]
    columns = [jnp.stack(column) for column in zip(*rows, strict=True)]
    samples = jax.vmap(lambda key, *parameters: function(key, (size,), *parameters))(keys, *columns)
    return [
        sample[: math.prod(request.shape)].reshape(*request.shape, *sample.shape[1:])
        for sample, request in zip(samples, requests, strict=True)
    ]


# ---- Functions of jax.random, with the parameters last


def split(key: Array, shape: tuple[int, ...]) -> Array:
    """Keys [n] from a key, for the shape (n,)."""
    return jax.random.split(key, shape)


def uniform(key: Array, shape: tuple[int, ...], low: Any, high: Any) -> Array:
    """Samples from low to high, without high."""
    return jax.random.uniform(key, shape, jnp.float32, low, high)


def integers(key: Array, shape: tuple[int, ...], low: Any, stop: Any) -> Array:
    """Whole samples from low to stop, without stop, int32."""
    return jax.random.randint(key, shape, low, stop, jnp.int32)


def normal(key: Array, shape: tuple[int, ...]) -> Array:
    """Samples of mean 0 and standard deviation 1."""
    return jax.random.normal(key, shape, jnp.float32)


def truncated_normal(key: Array, shape: tuple[int, ...], low: Any, high: Any) -> Array:
    """Samples of mean 0 and standard deviation 1 before truncation from low to high."""
    return jax.random.truncated_normal(key, low, high, shape, jnp.float32)
