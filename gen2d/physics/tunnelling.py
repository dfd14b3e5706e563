"""Limits on displacements, so that nothing passes through a static segment or into a static polygon."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.collision import FAR, Disc, Hull, Shape, Stadium, dot, perpendicular
from gen2d.physics.constraint import Motion
from gen2d.physics.springs import rotate
from gen2d.physics.time_of_impact import SLOWEST
from gen2d.records.axes import Array

DEEPEST = 0.5  # part of its radius that a disc may be inside a barrier


class _InnerDisc(NamedTuple):
    """A disc inside a body, with its displacement."""

    group: int
    centre: Array  # [2, N, ...] m
    radius: Array  # [N, ...] m
    displacement: Array  # [2, N, ...] m
    body: Array | None = None  # [2, N, ...] m: centre of the body, if it is another one


def _inner_discs(group: int, shape: Shape, displacement: Motion) -> list[_InnerDisc]:
    """Discs that may not pass through a segment: a disc itself, both ends of a capsule, the disc about the centre of a
    polygon."""
    if isinstance(shape, Disc):
        return [_InnerDisc(group, shape.centre, shape.radius, displacement.velocity)]
    if isinstance(shape, Stadium):
        arm = shape.half_length * shape.direction
        turn = rotate(arm, displacement.spin) - arm
        ends = (shape.centre + arm, displacement.velocity + turn), (shape.centre - arm, displacement.velocity - turn)
        return [_InnerDisc(group, centre, shape.radius, moved, shape.centre) for centre, moved in ends]
    sides = zip(shape.normals, shape.vertices, strict=True)
    # A repeated corner has no normal.
    distances = [jnp.where(dot(n, n) > 0, dot(n, vertex - shape.centre), jnp.inf) for n, vertex in sides]
    inner = functools.reduce(jnp.minimum, distances)
    radius = jnp.where(jnp.isfinite(inner), inner, 0.0) + shape.radius
    return [_InnerDisc(group, shape.centre, radius, displacement.velocity)]


class Barrier(NamedTuple):
    """A static segment, or a side of a static polygon."""

    line: Stadium  # [..., 1, n]; of negative length where absent
    one_sided: bool  # a side of a polygon lets a body out, where perpendicular(line.direction) points
    passing: Sequence[np.ndarray]  # of each group: [N, 1] the bodies that it does not stop


def barriers_of(shape: Shape, present: Array, passing: Sequence[np.ndarray]) -> list[Barrier]:
    """Barriers of a static body [..., 1, n], which do not stop the bodies that are `passing`; a disc has none."""

    def barrier(line: Stadium, one_sided: bool) -> Barrier:
        return Barrier(line._replace(half_length=jnp.where(present, line.half_length, -FAR)), one_sided, passing)

    if isinstance(shape, Stadium):
        return [barrier(shape, one_sided=False)]
    if not isinstance(shape, Hull):
        return []
    sides = []
    for i, (start, normal) in enumerate(zip(shape.vertices, shape.normals, strict=True)):
        end = shape.vertices[(i + 1) % len(shape.vertices)]
        length = jnp.sqrt(dot(end - start, end - start))
        half = jnp.where(dot(normal, normal) > 0, length / 2, -FAR)  # a repeated corner has no normal
        sides.append(barrier(Stadium((start + end) / 2, -perpendicular(normal), half, shape.radius), one_sided=True))
    return sides


def clamp_displacement(
    displacements: list[Motion], shapes: list[Shape | None], barriers: list[Barrier]
) -> list[Motion]:
    """Displacements that take no disc, end of a capsule or disc inside a polygon deeper than half of its radius into a
    static segment or polygon.

    A body meets each contact once in a step, so one that is very fast, or wedged in, may be thrown back through a
    segment that it met before; a joint or a far heavier body may push it there. It stops at the first barrier on its
    way, or stays where it is. Displacements shorter than a quarter of the radius, with overlaps less than half as deep,
    need no clamping. None as a shape is that of bodies that touch nothing.
    """
    of = zip(shapes, displacements, strict=True)
    discs = [disc for g, (shape, moved) in enumerate(of) if shape for disc in _inner_discs(g, shape, moved)]
    pairs = [(barrier, disc) for barrier in barriers for disc in discs if not barrier.passing[disc.group].all()]
    if not pairs:
        return displacements
    risky = []
    for (a, _, passing), b in pairs:
        offset = b.centre - a.centre
        deep = jnp.abs(dot(perpendicular(a.direction), offset)) < a.radius + DEEPEST * b.radius
        deep = deep & (jnp.abs(dot(a.direction, offset)) <= a.half_length + DEEPEST * b.radius)
        fast = 16 * dot(b.displacement, b.displacement) > b.radius**2
        risky.append((fast | deep) & ~passing[b.group])
    some = jnp.any(jnp.stack([jnp.any(x) for x in risky]))
    return jax.lax.cond(some, lambda: _clamp(displacements, shapes, pairs, risky), lambda: displacements)


def _is_through(barrier: Stadium, disc: _InnerDisc, distance: Array) -> Array:
    """Whether a disc at this signed distance, m, is on the other side of a barrier than the centre of its body."""
    assert disc.body is not None, "a disc is the body itself"
    offset = disc.body - barrier.centre
    of_body = dot(perpendicular(barrier.direction), offset)
    part = of_body / jnp.where(of_body == distance, 1.0, of_body - distance)
    along = dot(barrier.direction, offset + part * (disc.centre - disc.body))
    return (distance * of_body < 0) & (jnp.abs(along) <= barrier.half_length)


def _clamp(
    displacements: list[Motion], shapes: list[Shape | None], pairs: list[tuple[Barrier, _InnerDisc]], risky: list[Array]
) -> list[Motion]:
    fractions = [jnp.ones_like(displacement.spin) for displacement in displacements]
    for ((a, one_sided, _), b), risk in zip(pairs, risky, strict=True):
        normal, offset = perpendicular(a.direction), b.centre - a.centre
        distance, across = dot(normal, offset), dot(normal, b.displacement)
        side = jnp.sign(distance)
        if b.body is not None and not one_sided:
            side = jnp.where(_is_through(a, b, distance), -side, side)
        inwards = side * across < 0
        crossing = distance / jnp.where(inwards, -across, 1.0)  # the fraction at which the centre is on the line
        crossing = jnp.maximum(crossing, 0.0)
        nearest = jnp.minimum(crossing, 1.0)
        beside = jnp.maximum(side * (distance + nearest * across) - a.radius, 0.0)
        along = jnp.abs(dot(a.direction, offset + nearest * b.displacement))
        beyond = jnp.maximum(along - a.half_length, 0.0)
        through = inwards & (beside**2 + beyond**2 < (DEEPEST * b.radius) ** 2)
        if one_sided:
            through = through & (distance > 0)
        through = through & risk  # so that other scenes of the batch have no effect
        room = jnp.maximum(1 - (a.radius + b.radius) / jnp.maximum(jnp.abs(distance), SLOWEST), 0.0)
        fractions[b.group] = jnp.minimum(fractions[b.group], jnp.where(through, crossing * room, 1.0))
    of = zip(shapes, fractions, displacements, strict=True)
    return [Motion(part * d.velocity, part * d.spin if isinstance(shape, Stadium) else d.spin) for shape, part, d in of]
