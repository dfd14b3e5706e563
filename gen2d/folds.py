"""Sums and maxima over bodies, as plain chains of operations: XLA's CPU compiler hands its own reductions to a library
that takes ten times as long for so few."""

import functools

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
