"""When two shapes meet within a step, and how fast they part: exact, so that paths and their gradients are."""

import jax.numpy as jnp

from gen2d.contacts import dot
from gen2d.types import Array

SLOWEST = 1e-12  # m/s or m: keeps a division finite where nothing moves or nothing has a size
# In place of a time of impact, in s:
NONE = -1.0  # a slow approach, or none: the soft contact has the say
PASSES = -2.0  # a fast approach that stays apart in this step: nothing may touch it, it is an impact in a later one


def _root(x: Array) -> Array:
    return jnp.sqrt(jnp.where(x > 0, x, 1.0))  # where it is not taken, its gradient is finite too


def disc_impact(
    apart: Array, inverse: Array, reach: Array, velocity: Array, h: float, threshold: Array
) -> tuple[Array, Array]:
    """Time of impact of two discs, and what scales their offset at that time to a unit normal.

    `apart` [2, ...] is the offset of their centres, `inverse` one over its length, `reach` the sum of their radii and
    `velocity` [2, ...] the relative one. The time is the root of |apart + tau velocity| = reach, in the form that does
    not cancel. Both discs fall alike, so gravity does not come into it.
    """
    gap = jnp.maximum(1 / inverse - reach, 0.0)
    closing = dot(apart, velocity)
    left = gap * (gap + 2 * reach)
    inside = closing**2 - dot(velocity, velocity) * left
    tau = left / jnp.maximum(_root(inside) - closing, SLOWEST)
    fast, meet = closing * inverse < -threshold, (inside > 0) & (tau <= h)
    scale = jnp.where(fast & meet & (gap > 0), 1 / jnp.maximum(reach, SLOWEST), inverse)
    return jnp.where(fast, jnp.where(meet, tau, PASSES), NONE), scale


def wall_impact(
    gap: Array, speed: Array, pull: Array, elasticity: Array, h: float, threshold: Array
) -> tuple[Array, Array]:
    """Time of impact of a disc on a fixed plane, and its normal speed at the end of the step.

    `gap` is the distance at the start, `speed` the normal speed with this step's gravity in it, `pull` gravity's part
    towards the plane (a below). With V the approach speed at the start the disc arrives at u = sqrt(V^2 + 2 a gap),
    after tau = 2 gap / (V + u), and leaves at e u, of which gravity takes a (h - tau) until the end. Where it takes all
    of it the disc has come to rest.
    """
    approach = -speed - pull * h
    above = jnp.maximum(gap, 0.0)
    squared = approach**2 + 2 * pull * above
    arrival = _root(squared)
    tau = 2 * above / jnp.maximum(approach + arrival, SLOWEST)
    target = jnp.maximum(elasticity * arrival - pull * (h - tau), 0.0)
    closes = gap + h * speed + 0.5 * h**2 * pull < 0
    return jnp.where(approach > threshold, jnp.where(closes & (squared > 0), tau, PASSES), NONE), target
