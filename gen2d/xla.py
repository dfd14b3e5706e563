"""Workarounds for XLA's CPU compiler."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


def _bodies(values: Array) -> list[Array]:
    return [values[..., i, :] for i in range(values.shape[-2])]


def sum_bodies(values: Array) -> Array:
    """Sum [..., n] over the bodies of values [..., N, n]."""
    return functools.reduce(jnp.add, _bodies(values))


def max_bodies(values: Array) -> Array:
    """Maximum [..., n] over the bodies of values [..., N, n]."""
    return functools.reduce(jnp.maximum, _bodies(values))


def reduce_halves(values: Array, axis: int, combine: Callable[[Array, Array], Array]) -> Array:
    """Reduction over an axis by combining its two halves until one element is left."""
    while (size := values.shape[axis]) > 1:
        half = size // 2
        low, high = (jax.lax.slice_in_dim(values, a, a + half, axis=axis) for a in (0, half))
        rest = jax.lax.slice_in_dim(values, 2 * half, size, axis=axis)
        values = combine(low, high)
        if rest.shape[axis]:
            first = combine(jax.lax.slice_in_dim(values, 0, 1, axis=axis), rest)
            values = jnp.concatenate([first, jax.lax.slice_in_dim(values, 1, half, axis=axis)], axis)
    return jnp.squeeze(values, axis)


_ONE: ContextVar[Array | None] = ContextVar("one", default=None)


@contextlib.contextmanager
def runtime_one(one: Array) -> Iterator[None]:
    """Context in which `materialize` divides by `one`, a scalar 1.0 whose value the compiler cannot know.

    Enter and leave it within one trace: a tracer must not outlive its trace.
    """
    token = _ONE.set(one)
    try:
        yield
    finally:
        _ONE.reset(token)


def materialize(values: Any) -> Any:
    """The same values, each computed once within `runtime_one`; unchanged elsewhere and on other devices than CPUs.

    XLA's CPU compiler fuses a cheap producer into each of its consumers and so repeats a whole chain of operations for
    each of its results. It does not fuse across a division, and a division by 1.0 changes no bit. With 8 discs the
    solver is 2.4 times as fast. The compiler drops `optimization_barrier` before it fuses.
    """
    one = _ONE.get()
    return values if one is None or not on_cpu() else jax.tree.map(lambda x: x / one, values)


def each_video(function: Callable[..., Any], *arrays: Any) -> Any:
    """Results of a function for each video of arrays [n, ...]; on a CPU one video after the other, so that intermediate
    results stay in the caches, elsewhere all at once."""
    if on_cpu():
        return jax.lax.map(lambda video: function(*video), arrays)
    return jax.vmap(function)(*arrays)


def on_cpu() -> bool:
    """Whether programs run on a CPU, where small loops are fastest, and not on a GPU."""
    return jax.default_backend() == "cpu"
