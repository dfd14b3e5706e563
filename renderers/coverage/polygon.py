"""Pixel coverage of convex polygons with rounded corners: the exact area of the shape in each pixel, from 0 to 1.

The area of a shape in a pixel is an integral over y along its boundary X(y), traversed counter-clockwise. For a pixel
with left and right edges x0 and x1,

    area = E(x0) - E(x1),   E(x) = closed integral of max(x - X(y), 0) dy over the pixel's row.

E is a sum over the lines and arcs of the boundary in closed form: a line adds a parabola in x between its ends, an arc
adds U(t) = integral of sqrt(r^2 - s^2) ds from 0 to t. Nothing is sampled. Terms that depend on a row or a column alone
are computed first (`disc_cuts`, `polygon_edge_terms`), which leaves little work per pixel.

float32 sums of order r^2 lose digits: arcs are exact to .1 of 255 grey levels up to r = 64 px. Larger discs use a
straight rim corrected for its curvature, which is more accurate the larger the disc. Derivatives are those of the exact
areas: U has a custom derivative, and the point where an arc leaves a column has no first-order effect.

Coordinates are pixels, x to the right and y down; vertices are counter-clockwise in these coordinates.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.coverage.arc import BEYOND_ARCS, MIN_WIDTH, under_arc
from gen2d.renderers.coverage.disc import pixel_edges


class PolygonSide(NamedTuple):
    """One side in each row."""

    down: Array  # [..., rows] signed height within the row
    low: Array  # smallest x within the row
    width: Array  # extent in x within the row


class CornerArc(NamedTuple):
    """Right or left half of a rounded corner: its ends in each row, and its intersection with each column edge."""

    begin: Array  # [..., rows] y relative to the centre
    begin_area: Array  # U(begin)
    end: Array
    end_area: Array
    at: tuple[Array, Array]  # [..., columns] x relative to the centre, of the left and right pixel edges
    leave: tuple[Array, Array]  # |y| of the arc at these x
    leave_area: tuple[Array, Array]


class RoundedPolygon(NamedTuple):
    """Rounded polygons with the edge terms of the columns and rows of a pixel grid."""

    x: Array  # [..., columns]
    lines: list[PolygonSide]
    rights: list[CornerArc]
    lefts: list[CornerArc]


def polygon_edge_terms(x: Array, y: Array, vertices: Array, radius: Array | None) -> RoundedPolygon:
    """Edge terms of convex polygons, for pixels with left edges x [..., columns] and top edges y [..., rows].

    The polygons have `vertices` [..., V, 2] px and grow by `radius` [...] px with round corners; None adds nothing.
    Vertices may be repeated. Two vertices and a radius are a capsule. A shape without area covers nothing.
    """
    count = vertices.shape[-2]
    corners = [vertices[..., i, :] for i in range(count)]
    normals = _normals(corners)
    lines, rights, lefts = [], [], []
    for i in range(count):
        offset = 0.0 if radius is None else radius[..., None] * normals[i]
        lines.append(_side(y, corners[i] + offset, corners[(i + 1) % count] + offset))
        if radius is not None:
            arc = _arc_ends(normals[i - 1], normals[i])
            from_left, from_top = x - corners[i][..., :1], y - corners[i][..., 1:]
            rights.append(_corner_arc(from_left, from_top, radius, *arc[0], side=1))
            lefts.append(_corner_arc(from_left, from_top, radius, *arc[1], side=-1))
    return RoundedPolygon(x + jnp.zeros_like(corners[0][..., :1]), lines, rights, lefts)


def _normals(corner: list[Array]) -> list[Array]:
    """Outward normal of the side after each corner; a side of length 0 takes that of the side before."""
    sides = []
    count = len(corner)
    for i in range(count):
        side = corner[(i + 1) % count] - corner[i]
        square = (side * side).sum(-1, keepdims=True)
        length = jnp.sqrt(jnp.where(square > 0, square, 1.0))
        sides.append((square > 1e-12, jnp.stack([side[..., 1], -side[..., 0]], -1) / length))
    normals = []
    for i in range(count):
        turn = 2 * math.pi * i / count  # a single point is a disc: normals around the circle
        best = jnp.zeros_like(corner[0]) + jnp.asarray([math.cos(turn), math.sin(turn)], corner[0].dtype)
        for back in range(count - 1, -1, -1):
            has_length, candidate = sides[i - back]
            best = jnp.where(has_length, candidate, best)
        normals.append(best)
    return normals


def _side(y: Array, begin: Array, end: Array) -> PolygonSide:
    side = end - begin
    rise = side[..., 1:]
    flat = jnp.abs(rise) < 1e-9

    def crossing(edge: Array) -> Array:
        """Position on the side, 0 at `begin` and 1 at `end`, where it crosses an edge between rows."""
        along = jnp.clip((edge - begin[..., 1:]) / jnp.where(flat, 1.0, rise), 0.0, 1.0)
        return jnp.where(flat, (edge > begin[..., 1:]).astype(along.dtype), along)

    (first, second), across = map(crossing, pixel_edges(y)), side[..., :1]
    upper, lower = begin[..., :1] + first * across, begin[..., :1] + second * across
    low = jnp.minimum(upper, lower)
    return PolygonSide(jnp.abs(second - first) * rise, low, jnp.maximum(jnp.abs(upper - lower), MIN_WIDTH))


def _arc_ends(before: Array, after: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Sines of both ends of the right and of the left half of the arc between two normals, of at most half a turn."""
    (c0, s0), (c1, s1) = ((n[..., 0], n[..., 1]) for n in (before, after))
    straight = (c0 * s1 - c1 * s0 <= 0) & (c0 * c1 + s0 * s1 > 0)  # parallel normals up to rounding: no arc
    turn = jnp.where(straight, -1.0, 1.0)

    def half(sign: float) -> tuple[Array, Array]:
        begins = (sign * c0 > 0) | ((c0 == 0) & (sign * s0 < 0))
        ends = (sign * c1 > 0) | ((c1 == 0) & (sign * s1 > 0))
        first, last = jnp.where(begins, s0, -sign * turn), jnp.where(ends, s1, sign * turn)
        return jnp.where(begins | ends, first, 0.0), jnp.where(begins | ends, last, 0.0)

    return half(1.0), half(-1.0)


def _corner_arc(x: Array, y: Array, radius: Array, begin: Array, end: Array, side: int) -> CornerArc:
    radius = jnp.maximum(radius, 1e-6)[..., None]
    low, high = (radius * sine[..., None] for sine in ((begin, end) if side > 0 else (end, begin)))
    (top, bottom) = (jnp.clip(edge, low, high) for edge in pixel_edges(y))
    columns = pixel_edges(x)
    # The point where a column leaves the arc has no first-order effect, so stop its gradient. A column on the other
    # side of the centre never does: its bound is BEYOND_ARCS, since a value equal to its bound loses half of its
    # derivative.
    distances = [jnp.maximum(side * at, 0.0) for at in columns]
    leave = [jax.lax.stop_gradient(jnp.sqrt(jnp.maximum(radius**2 - at**2, 0.0))) for at in distances]
    areas = [
        jnp.where(at > 0, under_arc(value, radius), BEYOND_ARCS) for at, value in zip(distances, leave, strict=True)
    ]
    leave = [jnp.where(at > 0, value, BEYOND_ARCS) for at, value in zip(distances, leave, strict=True)]
    begin, end = (top, bottom) if side > 0 else (bottom, top)
    row_terms = begin, under_arc(begin, radius), end, under_arc(end, radius)
    return CornerArc(*row_terms, (columns[0], columns[1]), (leave[0], leave[1]), (areas[0], areas[1]))


def _per_row(rows: Array) -> Array:
    return rows[..., :, None]


def polygon_coverage(terms: RoundedPolygon) -> Array:
    """Coverage [..., rows, columns] of rounded polygons."""
    area: Any = 0.0
    for line in terms.lines:
        low, width = _per_row(line.low), _per_row(line.width)
        left, right = (jnp.maximum(edge[..., None, :] - low, 0.0) for edge in pixel_edges(terms.x))
        area = area + _per_row(line.down) * (_mean_excess(left, width) - _mean_excess(right, width))
    for arcs, beyond in ((terms.rights, _beyond_right), (terms.lefts, _beyond_left)):
        for arc in arcs:
            area = area + beyond(arc, 0) - beyond(arc, 1)
    return area


def _mean_excess(past: Array, width: Array) -> Array:
    """Mean of max(past - X, 0) for X uniform from 0 to `width`."""
    inner = jnp.minimum(past, width)
    return inner * inner / (2 * width) + (past - inner)


@jax.custom_jvp
def _clip(value: Array, end: Array) -> Array:
    """Value clipped to [-end, end]."""
    return jnp.clip(value, -end, end)


@_clip.defjvp
def _clip_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (value, end), (moved, stretched) = primals, tangents
    # A value that rounding put on the bound has the derivative of the bound.
    return _clip(value, end), jnp.where(jnp.abs(value) < end, moved, jnp.sign(value) * stretched)


def _beyond_right(arc: CornerArc, edge: int) -> Array:
    """Integral of max(x - sqrt(r^2 - y^2), 0) dy along an arc in each row."""
    at, leave, area = (a[edge][..., None, :] for a in (arc.at, arc.leave, arc.leave_area))

    def to(y: Array, under: Array) -> Array:
        y, under = _per_row(y), _per_row(under)
        return at * (y - _clip(y, leave)) - (under - _clip(under, area))

    return to(arc.end, arc.end_area) - to(arc.begin, arc.begin_area)


def _beyond_left(arc: CornerArc, edge: int) -> Array:
    """Integral of max(x + sqrt(r^2 - y^2), 0) dy along an arc in each row."""
    at, leave, area = (a[edge][..., None, :] for a in (arc.at, arc.leave, arc.leave_area))

    def to(y: Array, under: Array) -> Array:
        y, under = _per_row(y), _per_row(under)
        return at * _clip(y, leave) + _clip(under, area)

    return to(arc.end, arc.end_area) - to(arc.begin, arc.begin_area)
