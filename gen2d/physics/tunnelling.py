"""Limits on displacements, so that nothing passes through a static segment."""

import jax
import jax.numpy as jnp

from gen2d.physics.collision import Disc, Stadium, dot, perpendicular
from gen2d.physics.constraint import Motion
from gen2d.physics.time_of_impact import SLOWEST
from gen2d.records.axes import Array


def clamp_displacement(displacements: list[Motion], shapes: list, segments: list[Stadium]) -> list[Motion]:
    """Displacements that take no disc deeper than half of its radius into a static segment.

    A body meets each contact once in a step, so one that is very fast, or wedged in, may be thrown back through a
    segment that it met before. It stops at the first segment on its way, or stays where it is. Displacements shorter
    than a quarter of the radius, with overlaps less than half as deep, need no clamping.
    """
    pairs = [(segment, g) for segment in segments for g, shape in enumerate(shapes) if isinstance(shape, Disc)]
    if not pairs:
        return displacements
    risky = []
    for a, g in pairs:
        b, displacement = shapes[g], displacements[g].velocity
        offset = b.centre - a.centre
        deep = jnp.abs(dot(perpendicular(a.direction), offset)) < a.radius + 0.5 * b.radius
        deep = deep & (jnp.abs(dot(a.direction, offset)) <= a.half_length + 0.9 * b.radius)
        risky.append((16 * dot(displacement, displacement) > b.radius**2) | deep)
    some = jnp.any(jnp.stack([jnp.any(x) for x in risky]))
    return jax.lax.cond(some, lambda: _clamp(displacements, shapes, pairs, risky), lambda: displacements)


def _clamp(
    displacements: list[Motion], shapes: list, pairs: list[tuple[Stadium, int]], risky: list[Array]
) -> list[Motion]:
    fractions = [jnp.ones_like(displacement.spin) for displacement in displacements]
    for (a, g), risk in zip(pairs, risky, strict=True):
        b, displacement = shapes[g], displacements[g].velocity
        normal, offset = perpendicular(a.direction), b.centre - a.centre
        distance, across = dot(normal, offset), dot(normal, displacement)
        gap = jnp.sign(distance) * (distance + across) - a.radius - b.radius
        through = (distance * across < 0) & (gap < -0.5 * b.radius)
        crossing = distance / jnp.where(through, -across, 1.0)  # the fraction at which the centre is on the line
        along = jnp.abs(dot(a.direction, offset + crossing * displacement))
        through = through & (along <= a.half_length + 0.9 * b.radius)
        through = through & risk  # so that other scenes of the batch have no effect
        room = jnp.maximum(1 - (a.radius + b.radius) / jnp.maximum(jnp.abs(distance), SLOWEST), 0.0)
        fractions[g] = jnp.minimum(fractions[g], jnp.where(through, crossing * room, 1.0))
    return [Motion(part * d.velocity, d.spin) for part, d in zip(fractions, displacements, strict=True)]
