"""When two shapes meet within a step, and how fast they part: exact, so that paths and their gradients are."""

from typing import NamedTuple

import jax.numpy as jnp

from gen2d.physics.collision import dot
from gen2d.records.axes import Array

SLOWEST = 1e-12  # m/s or m: keeps a division finite where nothing moves or nothing has a size
# In place of a time of impact, in s:
NONE = -1.0  # a slow approach, or none: the soft contact has the say
MISSES = -2.0  # a fast approach that stays apart in this step: nothing may touch it, it is an impact in a later one


def _root(x: Array) -> Array:
    return jnp.sqrt(jnp.where(x > 0, x, 1.0))  # where it is not taken, its gradient is finite too


class ApproachPath(NamedTuple):
    """c + 2 b tau + a tau^2 is how far apart two shapes are after tau s; b is negative where they approach."""

    a: Array
    b: Array
    c: Array


def round_path(apart: Array, gap: Array, reach: Array, velocity: Array) -> ApproachPath:
    """Of two discs: |apart + tau velocity|^2 - reach^2.

    `apart` [2, ...] is the offset of their centres, `reach` the sum of their radii and `velocity` [2, ...] the relative
    one. If they fall differently it is their mean velocity in the step, which is right to g h^2 / 8.
    """
    return ApproachPath(dot(velocity, velocity), dot(apart, velocity), gap * (gap + 2 * reach))


def plane_path(gap: Array, approach: Array, pull: Array | float) -> ApproachPath:
    """Of a point and a plane: gap - V tau - p tau^2 / 2, with V the approach speed at the start of the step and p the
    part of gravity that pulls the point there."""
    return ApproachPath(jnp.full_like(gap, -0.5) * pull, -0.5 * approach, gap)


def select(which: Array, x: ApproachPath, y: ApproachPath) -> ApproachPath:
    """The first where `which`, else the second."""
    return ApproachPath(*(jnp.where(which, *of) for of in zip(x, y, strict=True)))


def time_of_impact(path: ApproachPath, approach: Array, h: float, threshold: Array) -> Array:
    """Time of impact in s, from the start of the step; NONE or PASSES where there is none in it.

    It is the smaller root of the path, in the form that does not cancel. `approach` is the speed that has to be over
    the threshold.
    """
    inside = path.b**2 - path.a * path.c
    tau = path.c / jnp.maximum(_root(inside) - path.b, SLOWEST)
    # One that is due with the end of the step is taken now: at the start of the next its time would be a clamped zero,
    # without a gradient.
    meet = (inside > 0) & (tau <= 1.001 * h)
    return jnp.where(approach > threshold, jnp.where(meet, tau, MISSES), NONE)


def plane_approach_speed(gap: Array, approach: Array, pull: Array | float) -> Array:
    """The speed at which a point that falls from `gap` arrives at a plane; with its sign, if it does not approach."""
    squared = approach**2 + 2 * pull * gap
    return jnp.where((approach > 0) & (squared > 0), _root(squared), approach)


def approach_speed(speed: Array, pull: Array | float, tau: Array, h: float) -> Array:
    """The approach speed at time tau, of a normal speed that has the whole step's gravity in it."""
    return -speed - pull * (h - tau)


def post_impact_speed(arrival: Array, pull: Array | float, elasticity: Array, tau: Array, h: float) -> Array:
    """The normal speed at the end of the step, of what arrives at tau.

    It leaves at e times the speed of arrival, of which gravity takes a (h - tau); where it takes all of it, it has come
    to rest.
    """
    return jnp.maximum(elasticity * arrival - pull * (h - tau), 0.0)
