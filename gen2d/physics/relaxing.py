"""Targets of the relaxing passes, and the impacts that these find at the end of a step.

The first pass solves each pair once. A body that strikes another one that a wall stops meets it again and again in one
step, so at its end the two still approach, and their gap may have closed since the start. A single relaxing pass leaves
that to the next step, as it cannot undo the overlap. Several passes solve such a pair as an impact. Its impulse belongs
to the time when the gap closed, so it also displaces the bodies by what it would have done since.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics.constraint import ActiveContact, ContactConstraint, ContactPoint, Impulse, Motion, relative_speed
from gen2d.physics.contact_points import displaced_gap, pull_along
from gen2d.physics.contact_state import BodySide
from gen2d.physics.normal_impulse import NormalTarget
from gen2d.physics.params import SolverParams
from gen2d.records.axes import Array


class LateImpact(NamedTuple):
    """An impact of a contact that a neighbour causes."""

    happens: Array
    age: Array  # s: from the impact to the end of the step; zero without one
    fall: Array | float  # m/s: approach speed that the acceleration adds in this time
    arrival: Array  # m/s: approach speed at its time

    def seen_at(self, speed: Array) -> "LateImpact":
        """The impact of contacts that still approach at its time, where they have this normal speed, m/s."""
        return self._replace(happens=self.happens & (speed < 0), arrival=-speed - self.fall)


def touching_impact(contact: ActiveContact, speed: Array, threshold: Array) -> LateImpact:
    """Impact at the end of the step of a contact that touches at its start."""
    happens = _approaches(contact, speed, threshold) & (contact.gap <= 0)
    return LateImpact(happens, jnp.zeros_like(speed), 0.0, -speed)


def closing_impact(
    point: ContactPoint, contact: ActiveContact, threshold: Array, a: BodySide, b: BodySide, h: float
) -> LateImpact:
    """Impact of a contact that touches at the start or at the end of the step."""
    assert b.motion is not None, "only static bodies lack a motion"
    assert b.displacement is not None, "only static bodies lack a displacement"
    of_a = a.displacement
    if of_a is None and a.motion is not None:  # a kinematic body
        of_a = jax.tree.map(lambda x: h * x, a.motion)
    gap = displaced_gap(point, of_a, b.displacement)
    speed, _ = relative_speed(contact.frame, contact.normal, a.motion, b.motion)
    happens = _approaches(contact, speed, threshold) & (jnp.minimum(contact.gap, gap) <= 0)
    approach = jnp.where(happens, -speed, 1.0)
    deeper = jnp.maximum(jnp.minimum(contact.gap, 0.0) - gap, 0.0)  # than at the start
    age = jnp.where(happens, jnp.minimum(deeper / approach, h), 0.0)
    fall = jnp.minimum(pull_along(point, contact.normal) * age, approach)
    return LateImpact(happens, age, fall, -speed - fall)


def _approaches(contact: ActiveContact, speed: Array, threshold: Array) -> Array:
    return (speed < -threshold) & (contact.frame.normal_mass > 0)


def late_scenes(sides: list[BodySide], scenes: tuple[int, ...]) -> Array:
    """Scenes [...] that take the passes with late impacts: those of bodies that ask for them, or all if none can."""
    flags = [jnp.any(side.late, axis=0) for side in sides if side.late is not None]
    return functools.reduce(jnp.logical_or, flags) if flags else jnp.ones(scenes, bool)


def unsolved_scenes(unsolved: Array, late: Array, number: Array, params: SolverParams) -> Array:
    """Scenes that need another pass after this number of passes; `late` are those with late impacts in the last one."""
    return unsolved & (late | (number < params.fewest_late_passes))


def relaxed_target(
    constraint: ContactConstraint,
    contact: ActiveContact,
    late: LateImpact,
    speed: Array,
    old: Impulse,
    threshold: Array,
) -> NormalTarget:
    """Target of a relaxing pass.

    Leave unchanged: contacts that bounced and are separating; separated contacts that carried no impulse, which would
    brake a body one step before its impact; and gaps that a neighbour is closing, which bounce in a later step.
    """
    rests = (contact.tau < 0) & ((old.normal > 0) | (contact.gap <= 0)) & (speed >= -threshold)
    active = late.happens | (rests & (contact.frame.normal_mass > 0))
    bounce = jnp.maximum(constraint.elasticity * late.arrival - late.fall, 0.0)
    target, apart = jnp.where(late.happens, bounce, 0.0), late.happens | (contact.tau >= 0)
    return NormalTarget(active, target, old.normal, late.happens, apart)


def displacement_before(side: BodySide, age: Array) -> Motion | None:
    """Displacement of a side this time, s, before the end of the step."""
    if side.displacement is None or side.motion is None:
        return side.displacement
    return jax.tree.map(lambda x, v: x - age * v, side.displacement, side.motion)


def displaced_since(old: BodySide, new: BodySide, age: Array) -> BodySide:
    """The new side with the displacement that the change of its motion would have caused in this time, s."""
    if old.displacement is None or old.motion is None or new.motion is None:
        return new
    of = old.displacement, new.motion, old.motion
    return new._replace(displacement=jax.tree.map(lambda x, v, u: x + age * (v - u), *of))
