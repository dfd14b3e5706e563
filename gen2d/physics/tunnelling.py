"""Displacements clamped so that nothing passes through another body."""

import jax
import jax.numpy as jnp

from gen2d.physics.collision import Disc, Stadium, dot, turned
from gen2d.physics.constraint import Motion
from gen2d.physics.contact_state import SolvedPair, WarmStart
from gen2d.physics.time_of_impact import SLOWEST
from gen2d.records.axes import Array


def visible_motion(solved: SolvedPair, memory: WarmStart) -> tuple[Array, Array]:
    """A row's deepest overlap, m, and whether a contact began; a bounce begins one."""
    depth = jnp.zeros_like(solved.touches[0].gap)
    for touch in solved.touches:
        depth = jnp.maximum(depth, jnp.where(touch.grip.normal_mass > 0, -touch.gap, 0.0))
    now, before = (sum(i.normal for i in x[1:]) + x[0].normal for x in (solved.impulses, memory.impulses))
    return depth, (now > 0) & (before == 0)


def clamp_displacement(ways: list[Motion], shapes: list, walls: list[Stadium]) -> list[Motion]:
    """The ways, none of which takes a disc deeper than half of its radius into a segment that stands still.

    A body meets each row once in a step, so one that is very fast, or wedged in, may be thrown back through a wall that
    it has met before. It is left where it is, or at the first wall on its way. Nothing of the kind can happen where no
    way is as long as a quarter of a radius and no overlap as deep as a half.
    """
    lines = [(wall, g) for wall in walls for g, shape in enumerate(shapes) if isinstance(shape, Disc)]
    if not lines:
        return ways
    risky = [_risky(ways[g].velocity, wall, shapes[g]) for wall, g in lines]
    some = jnp.any(jnp.stack([jnp.any(x) for x in risky]))
    return jax.lax.cond(some, lambda: _kept_in(ways, shapes, lines, risky), lambda: ways)


def _risky(way: Array, a: Stadium, b: Disc) -> Array:
    offset = b.centre - a.centre
    deep = jnp.abs(dot(turned(a.direction), offset)) < a.radius + 0.5 * b.radius
    deep = deep & (jnp.abs(dot(a.direction, offset)) <= a.half_length + 0.9 * b.radius)
    return (16 * dot(way, way) > b.radius**2) | deep


def _kept_in(ways: list[Motion], shapes: list, lines: list[tuple[Stadium, int]], risky: list[Array]) -> list[Motion]:
    parts = [jnp.ones_like(way.spin) for way in ways]  # of its way that a body goes
    for (a, g), may in zip(lines, risky, strict=True):
        b, way = shapes[g], ways[g].velocity
        normal, offset = turned(a.direction), b.centre - a.centre
        aside, across = dot(normal, offset), dot(normal, way)
        left = jnp.sign(aside) * (aside + across) - a.radius - b.radius
        through = (aside * across < 0) & (left < -0.5 * b.radius)
        share = aside / jnp.where(through, -across, 1.0)  # where its centre is on the line
        through = through & (jnp.abs(dot(a.direction, offset + share * way)) <= a.half_length + 0.9 * b.radius)
        through = through & may  # so that what other scenes do does not count
        room = jnp.maximum(1 - (a.radius + b.radius) / jnp.maximum(jnp.abs(aside), SLOWEST), 0.0)
        parts[g] = jnp.minimum(parts[g], jnp.where(through, share * room, 1.0))
    return [Motion(part * way.velocity, way.spin) for part, way in zip(parts, ways, strict=True)]
