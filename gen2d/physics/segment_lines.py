"""Static segments that continue each other: nothing that slides or bounces over their joints feels these.

Segments that lie on a straight line and meet are one segment for the contact points of boxes, polygons and capsules.
Only the segment below a body's centre acts on it, with the whole line as its shape. Where a line turns, a contact at
its end counts only if the next segment is not nearer (`admissible`); discs need only this.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.collision import FAR, Stadium, dot, offset_from_core
from gen2d.records.axes import Array

ENDS_MEET = 1e-4  # m: ends that are so near to another segment lie on it
OVERLAP = 1e-6  # m: a body so near to the joint of two segments touches both, as rounding may not lose it
ONWARD = 1e-4  # cosine above which a direction leads towards a body


class SegmentLine(NamedTuple):
    """The straight line that a segment is part of, in m along the segment from its middle."""

    first: Array  # the ends of the line
    last: Array
    low: Array  # the part in which the segment acts; FAR beyond an end of the line
    high: Array


class Neighbours(NamedTuple):
    """Two directions [2, ...] in which other segments continue at each end; zero without one."""

    left: tuple[Array, Array]
    right: tuple[Array, Array]
    line: SegmentLine | None  # the ends are those of the line; None: of the segment, for discs


def _continuing_directions(ends: Array, own: np.ndarray, shapes: Stadium) -> tuple[Array, Array]:
    """Two directions in which other segments continue at the ends [2, E, n] of segments `own` [E]; zero without one.

    Segments [S, ..., 1, n] are visited in a loop, so that its body is compiled once.
    """

    def visit(directions: tuple[Array, Array], other: tuple[Stadium, Array]) -> tuple[tuple[Array, Array], None]:
        (first, second), (shape, number) = directions, other
        offset, along, _ = offset_from_core(shape, ends)
        meets = (dot(offset, offset) < ENDS_MEET**2) & (shape.half_length > ENDS_MEET) & (number != own)[:, None]
        for sign, goes in ((1, along < shape.half_length - ENDS_MEET), (-1, along > ENDS_MEET - shape.half_length)):
            new, empty = meets & goes, dot(first, first) == 0
            first, second = (
                jnp.where(new & empty, sign * shape.direction, first),
                jnp.where(new & ~empty, sign * shape.direction, second),
            )
        return (first, second), None

    zero = jnp.zeros_like(ends)
    return jax.lax.scan(visit, (zero, zero), (shapes, jnp.arange(len(shapes.radius))))[0]


def _lines(shapes: Stadium) -> tuple[Array, Array]:
    """Ends [S, n] of the straight line of each segment [S, ..., n], in m along the segment from its middle."""
    centre, axis = jnp.moveaxis(shapes.centre, 1, 0), jnp.moveaxis(shapes.direction, 1, 0)  # [2, S, n]
    half, radius = shapes.half_length, shapes.radius
    offset, other = centre[:, None] - centre[:, :, None], axis[:, None]  # [2, S, S, n]: of the second from the first
    own = axis[:, :, None]
    along, across = dot(offset, own), own[0] * offset[1] - own[1] * offset[0]
    turn = own[0] * other[1] - own[1] * other[0]
    straight = jnp.abs(across) + jnp.abs(turn) * half < ENDS_MEET
    straight = straight & (half > ENDS_MEET) & (radius[:, None] == radius)
    sign = jnp.where(dot(own, other) > 0, 1.0, -1.0)

    def extend(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        first, last = ends
        low, high = along + jnp.minimum(sign * first, sign * last), along + jnp.maximum(sign * first, sign * last)
        meets = straight & (low < last[:, None] + ENDS_MEET) & (high > first[:, None] - ENDS_MEET)
        first = jnp.minimum(first, jnp.min(jnp.where(meets, low, FAR), axis=1))
        return first, jnp.maximum(last, jnp.max(jnp.where(meets, high, -FAR), axis=1))

    # What a segment knows of its line at least doubles each time.
    return jax.lax.fori_loop(0, len(half).bit_length() + 1, extend, (-half, half))


def neighbours_of(segments: dict[int, Stadium]) -> tuple[dict[int, Neighbours], dict[int, Neighbours]]:
    """Neighbours of each static segment, [..., 1, n], for discs and for other shapes; empty for a single segment."""
    if len(segments) < 2:
        return {}, {}
    shapes: Stadium = jax.tree.map(lambda *x: jnp.stack(jnp.broadcast_arrays(*x)), *segments.values())
    flat = jax.tree.map(lambda x: x[..., 0, :], shapes)
    half, numbers = flat.half_length, np.arange(2 * len(segments))
    first, last = _lines(flat)
    # Ends within rounding of those of the line are its ends.
    low, high = jnp.where(first < -half - ENDS_MEET, -half, -FAR), jnp.where(last > half + ENDS_MEET, half, FAR)

    def directions(left: Array, right: Array) -> list[tuple[Array, Array]]:
        ends = jnp.stack([left, right], axis=1)[:, :, None] * flat.direction[:, None] + flat.centre[:, None]
        ends = jnp.moveaxis(ends, 2, 0).reshape(2, len(numbers), -1)
        found = _continuing_directions(ends, numbers // 2, shapes)
        return [(found[0][:, k : k + 1], found[1][:, k : k + 1]) for k in numbers]

    of_segments, of_lines = directions(-half, half), directions(first, last)
    discs, others = {}, {}
    for k, i in enumerate(segments):
        line = SegmentLine(*(x[k : k + 1] for x in (first, last, low, high)))
        discs[i] = Neighbours(*of_segments[2 * k : 2 * k + 2], line=None)
        others[i] = Neighbours(*of_lines[2 * k : 2 * k + 2], line=line)
    return discs, others


def whole_line(segment: Stadium, line: SegmentLine, centre: Array) -> tuple[Stadium, Array]:
    """The line of a segment as one, and whether the segment acts on a body with a centre [2, ...] in m."""
    along = dot(centre - segment.centre, segment.direction)
    acts = (along > line.low - OVERLAP) & (along < line.high + OVERLAP)
    middle, half = 0.5 * (line.first + line.last), 0.5 * (line.last - line.first)
    return segment._replace(centre=segment.centre + middle * segment.direction, half_length=half), acts


def onward(neighbours: Neighbours, vector: Array, at_right: Array) -> Array:
    """How far a vector [2, ...] from the left or the right end leads along the neighbours there; 0 without any."""
    pairs = zip(neighbours.left, neighbours.right, strict=True)
    return jnp.maximum(*(dot(vector, jnp.where(at_right, right, left)) for left, right in pairs))


def admissible(segment: Stadium, neighbours: Neighbours) -> Callable[[Array], Array]:
    """Function of a normal [2, ...] away from an end of a segment: whether no neighbour leads that way."""

    def admits(normal: Array) -> Array:
        return onward(neighbours, normal, dot(normal, segment.direction) > 0) < ONWARD

    return admits
