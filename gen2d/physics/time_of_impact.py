"""Time of impact of two shapes within a step, and their speed after it, exact like the gradients of both."""

from typing import NamedTuple

import jax.numpy as jnp

from gen2d.physics.collision import dot
from gen2d.records.axes import Array

SLOWEST = 1e-12  # m/s or m: keeps divisions finite where nothing moves or has a size
# Values that stand for a time of impact, in s:
NONE = -1.0  # no fast approach: a contact at rest
MISSES = -2.0  # a fast approach without an impact in this step: no impulse yet
WAITS = -3.0  # an impact after another one of the same bodies, which has not acted yet: no impulse yet
# Contacts with tau > MISSES may get an impulse, so WAITS lies below it.


def _root(x: Array) -> Array:
    return jnp.sqrt(jnp.where(x > 0, x, 1.0))  # its gradient is finite where it is not used


class ApproachPath(NamedTuple):
    """Distance c + 2 b tau + a tau^2 of two shapes after tau s; b is negative where they approach."""

    a: Array
    b: Array
    c: Array


def round_path(offset: Array, gap: Array, reach: Array, velocity: Array) -> ApproachPath:
    """Path of two discs: |offset + tau velocity|^2 - reach^2.

    `offset` [2, ...] is that of their centres, `reach` the sum of their radii and `velocity` [2, ...] the relative
    velocity, or its mean in the step if their accelerations differ, with an error up to g h^2 / 8.
    """
    return ApproachPath(dot(velocity, velocity), dot(offset, velocity), gap * (gap + 2 * reach))


def plane_path(gap: Array, approach: Array, pull: Array | float) -> ApproachPath:
    """Path of a point to a plane: gap - V tau - p tau^2 / 2.

    V is the approach speed at the start of the step and p the acceleration towards the plane.
    """
    return ApproachPath(jnp.full_like(gap, -0.5) * pull, -0.5 * approach, gap)


def select_path(which: Array, x: ApproachPath, y: ApproachPath) -> ApproachPath:
    """Path x where `which`, else y."""
    return ApproachPath(*(jnp.where(which, *of) for of in zip(x, y, strict=True)))


def time_of_impact(
    path: ApproachPath, approach: Array, h: float, threshold: Array, clock: Array | None = None
) -> Array:
    """Time of impact in s from the start of the step; NONE or MISSES without an impact in it.

    It is the smaller root of the path, which begins at the clock, in the form without cancellation. `approach` is the
    speed that is compared with the threshold.
    """
    inside = path.b**2 - path.a * path.c
    tau = path.c / jnp.maximum(_root(inside) - path.b, SLOWEST)
    tau = tau if clock is None else clock + tau
    # An impact at the end of the step counts now: in the next its time would be clamped to zero, without a gradient.
    meet = (inside > 0) & (tau <= 1.001 * h)
    return jnp.where(approach > threshold, jnp.where(meet, tau, MISSES), NONE)


def plane_approach_speed(gap: Array, approach: Array, pull: Array | float) -> Array:
    """Speed with which a point arrives at a plane from `gap`; the signed approach speed if it does not approach."""
    squared = approach**2 + 2 * pull * gap
    return jnp.where((approach > 0) & (squared > 0), _root(squared), approach)
