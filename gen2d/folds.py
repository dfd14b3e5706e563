"""Sums and the like as plain chains of operations: XLA's CPU compiler hands its own reductions to a library, or to a
loop over single numbers, that takes many times as long over few bodies or over the bytes of a mask."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from gen2d.types import Array


def _bodies(values: Array) -> list[Array]:
    return [values[..., i, :] for i in range(values.shape[-2])]


def total(values: Array) -> Array:
    """The sum [..., n] over the bodies of values [..., N, n]."""
    return functools.reduce(jnp.add, _bodies(values))


def largest(values: Array) -> Array:
    """The maximum [..., n] over the bodies of values [..., N, n]."""
    return functools.reduce(jnp.maximum, _bodies(values))


def folded(values: Array, axis: int, combine: Callable[[Array, Array], Array]) -> Array:
    """The values combined along an axis, which is gone: halves are laid on each other until one is left."""
    while (size := values.shape[axis]) > 1:
        half = size // 2
        one, other = (jax.lax.slice_in_dim(values, a, a + half, axis=axis) for a in (0, half))
        rest = jax.lax.slice_in_dim(values, 2 * half, size, axis=axis)
        values = combine(one, other)
        if rest.shape[axis]:
            first = combine(jax.lax.slice_in_dim(values, 0, 1, axis=axis), rest)
            values = jnp.concatenate([first, jax.lax.slice_in_dim(values, 1, half, axis=axis)], axis)
    return jnp.squeeze(values, axis)
