"""How much of each pixel a shape covers: the exact area of the shape in the pixel's square, between 0 and 1.

The area left of a shape's right rim and right of its left one is an integral over y. For a pixel whose left and right
edges are x0 and x1, and a boundary X(y) run through counter-clockwise,

    area = E(x0) - E(x1),   E(x) = closed integral of max(x - X(y), 0) dy over the pixel's row,

and each E is a sum over the boundary's pieces, lines and arcs, in closed form (lines: a parabola in x between the
piece's ends; arcs: by U(t) = integral of sqrt(r^2 - s^2) ds from 0 to t). Nothing is sampled. Whatever depends on a row
or a column alone comes first (`disc_cuts`, `rounded_cuts`), so that what is left to do for each pixel is little.

float32 sums of order r^2 lose digits: arcs are exact to .1 of 255 grey levels up to r = 64 px, and discs beyond that
are taken as straight rims, corrected for their curvature, which is more exact the larger they are. Derivatives are
those of the areas: U has its own, and where an arc leaves a column does not matter to first order.

Coordinates are pixels, x to the right and y down, with vertices in an order that is counter-clockwise in these.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.coverage.arc import FAR, THIN, under_arc
from gen2d.renderers.coverage.disc import shift

# ---- Convex shapes with straight sides, their corners rounded


class PolygonSide(NamedTuple):
    """A side in each row: how far it goes down there, and between which x."""

    down: Array  # [..., rows]
    low: Array
    width: Array


class CornerArc(NamedTuple):
    """One half, right or left, of a rounded corner: where it runs in each row, and where each column leaves it."""

    begin: Array  # [..., rows] y from the centre, and U of it
    begin_area: Array
    end: Array
    end_area: Array
    at: tuple[Array, Array]  # [..., columns] x from the centre, of the left and the right edges of the pixels
    leave: tuple[Array, Array]
    leave_area: tuple[Array, Array]


class RoundedPolygon(NamedTuple):
    """A rounded polygon cut by the edges of a grid's columns and rows."""

    x: Array  # [..., columns]
    lines: list[PolygonSide]
    rights: list[CornerArc]
    lefts: list[CornerArc]


def rounded_cuts(x: Array, y: Array, vertices: Array, radius: Array | None) -> RoundedPolygon:
    """The cuts of convex polygons `vertices` [..., V, 2] px, grown by `radius` [...] px with round corners (None: not),
    by pixels with left edges x [..., columns] and top edges y [..., rows]. Vertices may be repeated, and two are a
    segment, with a radius a capsule; without an area there is nothing."""
    count = vertices.shape[-2]
    corner = [vertices[..., i, :] for i in range(count)]
    normal = _normals(corner)
    lines, rights, lefts = [], [], []
    for i in range(count):
        offset = 0.0 if radius is None else radius[..., None] * normal[i]
        lines.append(_line(y, corner[i] + offset, corner[(i + 1) % count] + offset))
        if radius is not None:
            arc = _arc_ends(normal[i - 1], normal[i])
            u, v = x - corner[i][..., :1], y - corner[i][..., 1:]
            rights.append(_arc(u, v, radius, *arc[0], side=1))
            lefts.append(_arc(u, v, radius, *arc[1], side=-1))
    return RoundedPolygon(x + jnp.zeros_like(corner[0][..., :1]), lines, rights, lefts)


def _normals(corner: list[Array]) -> list[Array]:
    """The outward normal of the side after each corner; of a side without length that of the side before."""
    found = []
    count = len(corner)
    for i in range(count):
        side = corner[(i + 1) % count] - corner[i]
        square = (side * side).sum(-1, keepdims=True)
        length = jnp.sqrt(jnp.where(square > 0, square, 1.0))
        found.append((square > 1e-12, jnp.stack([side[..., 1], -side[..., 0]], -1) / length))
    normal = []
    for i in range(count):
        turn = 2 * math.pi * i / count  # a point is a disc: all around it
        best = jnp.zeros_like(corner[0]) + jnp.asarray([math.cos(turn), math.sin(turn)], corner[0].dtype)
        for back in range(count - 1, -1, -1):
            there, value = found[i - back]
            best = jnp.where(there, value, best)
        normal.append(best)
    return normal


def _line(y: Array, begin: Array, end: Array) -> PolygonSide:
    side = end - begin
    rise = side[..., 1:]
    flat = jnp.abs(rise) < 1e-9

    def part(edge: Array) -> Array:
        """Which part of the side lies above an edge between rows."""
        along = jnp.clip((edge - begin[..., 1:]) / jnp.where(flat, 1.0, rise), 0.0, 1.0)
        return jnp.where(flat, (edge > begin[..., 1:]).astype(along.dtype), along)

    (first, second), across = map(part, shift(y)), side[..., :1]
    one, other = begin[..., :1] + first * across, begin[..., :1] + second * across
    low = jnp.minimum(one, other)
    return PolygonSide(jnp.abs(second - first) * rise, low, jnp.maximum(jnp.abs(one - other), THIN))


def _arc_ends(before: Array, after: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Between which sines the arc from one normal to the next, half a turn at most, runs in its right half, and in its
    left one."""

    (c0, s0), (c1, s1) = ((n[..., 0], n[..., 1]) for n in (before, after))
    straight = (c0 * s1 - c1 * s0 <= 0) & (c0 * c1 + s0 * s1 > 0)  # no arc, but for rounding: it passes no end
    turn = jnp.where(straight, -1.0, 1.0)

    def half(sign: float) -> tuple[Array, Array]:
        begins = (sign * c0 > 0) | ((c0 == 0) & (sign * s0 < 0))
        ends = (sign * c1 > 0) | ((c1 == 0) & (sign * s1 > 0))
        first, last = jnp.where(begins, s0, -sign * turn), jnp.where(ends, s1, sign * turn)
        return jnp.where(begins | ends, first, 0.0), jnp.where(begins | ends, last, 0.0)

    return half(1.0), half(-1.0)


def _arc(x: Array, y: Array, radius: Array, begin: Array, end: Array, side: int) -> CornerArc:
    radius = jnp.maximum(radius, 1e-6)[..., None]
    low, high = (radius * sine[..., None] for sine in ((begin, end) if side > 0 else (end, begin)))
    (top, bottom) = (jnp.clip(edge, low, high) for edge in shift(y))
    columns = shift(x)
    # Where a column leaves the arc does not matter to first order. One on the other side of the centre never does: a
    # bound that is never met, as halves of slopes would be lost where it is just met.
    away = [jnp.maximum(side * at, 0.0) for at in columns]
    leave = [jax.lax.stop_gradient(jnp.sqrt(jnp.maximum(radius**2 - at**2, 0.0))) for at in away]
    areas = [jnp.where(at > 0, under_arc(value, radius), FAR) for at, value in zip(away, leave, strict=True)]
    leave = [jnp.where(at > 0, value, FAR) for at, value in zip(away, leave, strict=True)]
    begin, end = (top, bottom) if side > 0 else (bottom, top)
    ends = begin, under_arc(begin, radius), end, under_arc(end, radius)
    return CornerArc(*ends, (columns[0], columns[1]), (leave[0], leave[1]), (areas[0], areas[1]))


def _grid(rows: Array) -> Array:
    return rows[..., :, None]


def rounded_area(cuts: RoundedPolygon) -> Array:
    """The coverage [..., rows, columns] of rounded polygons."""
    area: Any = 0.0
    for line in cuts.lines:
        low, width = _grid(line.low), _grid(line.width)
        left, right = (jnp.maximum(edge[..., None, :] - low, 0.0) for edge in shift(cuts.x))
        area = area + _grid(line.down) * (_below(left, width) - _below(right, width))
    for arcs, beyond in ((cuts.rights, _beyond_right), (cuts.lefts, _beyond_left)):
        for arc in arcs:
            area = area + beyond(arc, 0) - beyond(arc, 1)
    return area


def _below(past: Array, width: Array) -> Array:
    """The mean of max(x - X, 0) over a line from x = 0 to `width`, for an x that is `past` its begin."""
    inner = jnp.minimum(past, width)
    return inner * inner / (2 * width) + (past - inner)


@jax.custom_jvp
def _within(value: Array, end: Array) -> Array:
    """The value, or the nearer end."""
    return jnp.clip(value, -end, end)


@_within.defjvp
def _within_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (value, end), (moved, stretched) = primals, tangents
    # On an end, where rounding may put it, it moves as the end does.
    return _within(value, end), jnp.where(jnp.abs(value) < end, moved, jnp.sign(value) * stretched)


def _beyond_right(arc: CornerArc, edge: int) -> Array:
    """The integral of max(x - sqrt(r^2 - y^2), 0) dy along an arc."""
    at, leave, area = (a[edge][..., None, :] for a in (arc.at, arc.leave, arc.leave_area))

    def to(y: Array, under: Array) -> Array:
        y, under = _grid(y), _grid(under)
        return at * (y - _within(y, leave)) - (under - _within(under, area))

    return to(arc.end, arc.end_area) - to(arc.begin, arc.begin_area)


def _beyond_left(arc: CornerArc, edge: int) -> Array:
    """The integral of max(x + sqrt(r^2 - y^2), 0) dy along an arc."""
    at, leave, area = (a[edge][..., None, :] for a in (arc.at, arc.leave, arc.leave_area))

    def to(y: Array, under: Array) -> Array:
        y, under = _grid(y), _grid(under)
        return at * _within(y, leave) + _within(under, area)

    return to(arc.end, arc.end_area) - to(arc.begin, arc.begin_area)
