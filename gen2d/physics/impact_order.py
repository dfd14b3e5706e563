"""Impacts of one step in the order of their times.

A disc that is hit twice in a step takes the first impact first. Before the first pass, the first impact of each body is
found on its path. In the pass an impact acts if it is the next one of both its bodies, and waits otherwise. Then turns
follow until nothing waits: the impacts of all bodies that an impact has moved are found anew, and those act that come
next. Two discs, and a disc and a static segment, take part. A contact with corners, whose path is linear within a step,
acts in the order of the pass, as do bodies that touch from the start of the step, and impacts on light bodies that
static ones bear.

Impacts may follow others where one waits, and where a body is hit that has met another one nearby, earlier in the pass.
The solver of nearby pairs looks for them in such scenes alone (`with_clearance`).
"""

import functools

import jax
import jax.numpy as jnp

from gen2d.physics.constraint import ActiveContact, ContactPoint, Motion
from gen2d.physics.contact_points import accelerated, impact_times, pair_clock
from gen2d.physics.contact_state import BodySide, PassSetup, SolvedPair
from gen2d.physics.time_of_impact import NONE, WAITS
from gen2d.records.axes import Array

SAME_TIME = 1e-4  # relative difference of times of impact that are one, as they are computed twice
TURNS = 8  # after the first pass; a longer sequence of impacts goes on in the next step


def ordered(points: list[ContactPoint]) -> bool:
    """Whether impacts of these pairs can act in the order of their times."""
    return points[0].core is not None


def takes_part(points: list[ContactPoint], b: BodySide) -> bool:
    """Whether impacts of these pairs act in the order of their times."""
    return ordered(points) and b.first is not None


def alone(sides: list[BodySide]) -> list[BodySide]:
    """Sides of moving bodies that have met nothing."""
    return [
        side._replace(clearance=jnp.full_like(side.motion.spin, jnp.inf)) for side in sides if side.motion is not None
    ]


def with_clearance(
    pair: SolvedPair, takes_part: bool, old: tuple[BodySide, BodySide], a: BodySide, b: BodySide, h: float
) -> tuple[BodySide, BodySide, Array]:
    """Both sides with `clearance` reduced by a solved pair, and whether an impact may follow that was not found.

    One may follow where an impact leads a body to what it has met before in this pass, or waits. The pair is that of
    the sides `old`; of two bodies that both are hit later, the faster one goes at least half of the way.
    """
    taus = [contact.tau for contact in pair.contacts]
    hits, follows = functools.reduce(jnp.logical_or, [tau >= 0 for tau in taus]), taus[0] == WAITS
    ways = [0.0 if side.motion is None else h * _speed(side.motion) for side in old]

    def after(side: BodySide, way: Array | float) -> tuple[BodySide, Array]:
        if side.clearance is None or side.motion is None:
            return side, jnp.zeros_like(hits)
        near = hits & (side.clearance < 2 * h * _speed(side.motion))
        if not takes_part:
            return side, near
        return side._replace(clearance=jnp.minimum(side.clearance, pair.contacts[0].gap - way)), near

    (a, near_a), (b, near_b) = after(a, ways[1]), after(b, ways[0])
    return a, b, follows | near_a | near_b


def _speed(motion: Motion) -> Array:
    """Bound on a speed, m/s, at most an eighth above it."""
    x, y = jnp.abs(jax.lax.stop_gradient(motion.velocity))
    return jnp.maximum(x, y) + 0.5 * jnp.minimum(x, y)


def not_hit(sides: list[BodySide]) -> list[BodySide]:
    """Sides of moving bodies without a first impact."""
    return [side._replace(first=jnp.full_like(side.motion.spin, jnp.inf)) for side in sides if side.motion is not None]


def _there(point: ContactPoint) -> Array:
    """Whether both bodies are there: the solver of all pairs finds times for absent ones, too."""
    return point.frame.normal_mass > 0


def first_time(tau: Array) -> Array:
    """Time of an impact, s; infinite without one, which is negative."""
    return jax.lax.stop_gradient(jnp.where(tau >= 0, tau, jnp.inf))


def with_first(point: ContactPoint, a: BodySide, b: BodySide, tau: Array) -> tuple[BodySide, BodySide]:
    """Both sides with `first` reduced to a time of impact, s; a negative one is none."""
    tau = jnp.where(_there(point), first_time(tau), jnp.inf)

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
    return jnp.where(_there(point), jnp.where(waits, WAITS, tau), NONE)


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
    (tau,) = impact_times(accelerated([point], a, b), a, b, setup, h)
    return jnp.where(may_follow(contact, clock) & _there(point), tau, NONE)
