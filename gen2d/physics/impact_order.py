"""Impacts of one step in the order of their times.

A disc that is hit twice in a step takes the first impact first. The warm start finds the first impact of each body on
its path at the start of the step. In the first pass an impact acts if it is the next one of both its bodies, and waits
otherwise. Then turns follow until nothing waits: the impacts of all bodies that an impact has moved are found anew, and
those act that come next. Two discs, and a disc and a static segment, take part. A contact with corners, whose path is
linear within a step, acts in the order of the pass, as do bodies that touch from the start of the step.
"""

import jax
import jax.numpy as jnp

from gen2d.physics.constraint import ActiveContact, ContactPoint
from gen2d.physics.contact_points import impact_times, pair_clock
from gen2d.physics.contact_state import BodySide, PassSetup
from gen2d.physics.time_of_impact import NONE, WAITS
from gen2d.records.axes import Array

SAME_TIME = 1e-4  # relative difference of times of impact that are one, as they are computed twice
TURNS = 8  # after the first pass; a longer sequence of impacts goes on in the next step


def takes_part(points: list[ContactPoint], b: BodySide) -> bool:
    """Whether impacts of these pairs act in the order of their times."""
    return points[0].core is not None and b.first is not None


def not_hit(sides: list[BodySide]) -> list[BodySide]:
    """Sides of moving bodies without a first impact."""
    return [side._replace(first=jnp.full_like(side.motion.spin, jnp.inf)) for side in sides if side.motion is not None]


def with_first(a: BodySide, b: BodySide, tau: Array) -> tuple[BodySide, BodySide]:
    """Both sides with `first` reduced to a time of impact, s; a negative one is none."""
    tau = jax.lax.stop_gradient(jnp.where(tau >= 0, tau, jnp.inf))

    def reduced(side: BodySide) -> BodySide:
        return side if side.first is None else side._replace(first=jnp.minimum(side.first, tau))

    return reduced(a), reduced(b)


def _comes_next(side: BodySide, tau: Array) -> Array | bool:
    """Whether no other impact of the body comes before tau, or those have acted."""
    if side.first is None or side.clock is None:
        return True
    return (tau <= (1 + SAME_TIME) * side.first) | (side.clock >= (1 - SAME_TIME) * side.first)


def in_order(point: ContactPoint, tau: Array, a: BodySide, b: BodySide) -> Array:
    """Time of impact in s; WAITS for an impact that is not the next one of both bodies."""
    waits = (tau >= 0) & (point.gap > 0) & ~(_comes_next(a, tau) & _comes_next(b, tau))
    return jnp.where(waits, WAITS, tau)


def after_impact(a: BodySide, b: BodySide, happens: Array, time: Array) -> tuple[BodySide, BodySide]:
    """Both sides with their clocks at `time` where an impact happens."""

    def later(side: BodySide) -> BodySide:
        return side if side.clock is None else side._replace(clock=jnp.where(happens, time, side.clock))

    return later(a), later(b)


def may_follow(contact: ActiveContact, clock: Array) -> Array:
    """Whether an impact may follow, as one of the bodies had another one since the last of this pair."""
    return (clock > jnp.maximum(contact.tau, 0.0)) | (contact.tau == WAITS)


def later_impact(
    point: ContactPoint, contact: ActiveContact, a: BodySide, b: BodySide, setup: PassSetup, h: float
) -> Array:
    """Time of an impact that follows others of its bodies in this step, s; negative without one."""
    clock = pair_clock(a, b)
    assert clock is not None, "moving bodies have clocks"
    (tau,) = impact_times([point], a, b, setup, h)
    return jnp.where(may_follow(contact, clock), tau, NONE)
