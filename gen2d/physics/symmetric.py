"""Symmetric 3 x 3 matrices of bodies, by x, y and angle: what something takes from their inverse masses."""

from typing import TypeAlias

import jax.numpy as jnp

from gen2d.physics.collision import dot
from gen2d.records.axes import Array

Direction: TypeAlias = tuple[Array, Array | None]  # of an impulse: a vector [2, ...], and its lever in m (None: 0)


def product(matrix: Array, direction: Direction) -> tuple[Array, Array]:
    """Matrix [6, ...] (xx, xy, yy, xt, yt, tt) times a direction."""
    (xx, xy, yy, xt, yt, tt), ((x, y), lever) = matrix, direction
    turn = jnp.zeros_like(x) if lever is None else lever
    return jnp.stack([xx * x + xy * y + xt * turn, xy * x + yy * y + yt * turn]), xt * x + yt * y + tt * turn


def inner(p: Direction, q: Direction) -> Array:
    """Inner product of two directions."""
    k = dot(p[0], q[0])
    return k if p[1] is None or q[1] is None else k + p[1] * q[1]


def outer(p: tuple[Array, ...], q: tuple[Array, ...]) -> Array:
    """Matrix [6, ...] of the symmetric part of p q^T, of two vectors (x, y, angle)."""
    return jnp.stack([0.5 * (p[i] * q[j] + p[j] * q[i]) for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))])
