"""Contact points of two shapes: one function per pair of shapes, in `PAIRS`.

Vectors have shape [2, ...], scalars [...], in metres; the last axes are pairs and scenes. Every function is elementwise
and returns its points at any distance, as the solver looks ahead. Where a direction has no length, another unit vector
replaces it, and no gradient is NaN.

A stadium meets a hull, or another stadium, as the hull of its two ends. Two hulls meet as in Box2D v3 (E. Catto,
`b2CollidePolygons`): the face that separates them most gives the normal, and the edges that face each other are clipped
to each other. If two corners are nearest, the normal is along the line between them.

The faces and edges of two hulls are materialized (`xla.materialize`), or a CPU computes them again for each result; for
two boxes that is 10 times slower.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jax import lax

from gen2d.records.axes import Array
from gen2d.xla import materialize

NEAREST = 1e-12  # m^2: squared distances below this have no direction
SLOP = 1e-5  # m: shorter lengths are rounding and do not decide which features touch
FAR = 1e9  # m: the gap of a missing point


class Disc(NamedTuple):
    """All points within `radius` [...] of `centre` [2, ...]."""

    centre: Array
    radius: Array


class Stadium(NamedTuple):
    """All points within `radius` [...] of a core line: a segment (radius may be 0) or a capsule."""

    centre: Array  # [2, ...]
    direction: Array  # [2, ...], unit
    half_length: Array  # [...]: of the core line
    radius: Array  # [...]


class Hull(NamedTuple):
    """A convex polygon, counter-clockwise, in world coordinates.

    A repeated corner makes an edge without length, whose normal is zero and which is never touched.
    """

    centre: Array  # [2, ...]: of mass
    vertices: tuple[Array, ...]  # each [2, ...]
    normals: tuple[Array, ...]  # each [2, ...], outward, unit: of the edge from this vertex to the next
    radius: Array  # [...]: rounding, usually 0


Shape: TypeAlias = Disc | Stadium | Hull


class ManifoldPoint(NamedTuple):
    """A point of contact, midway between the two surfaces: centre_a + arm_a = centre_b + arm_b."""

    normal: Array  # [2, ...], unit, from a to b
    gap: Array  # [...]: negative for an overlap, FAR for a missing point
    arm_a: Array  # [2, ...]: from the centre of mass
    arm_b: Array  # [2, ...]


def dot(a: Array, b: Array) -> Array:
    """Inner product over the first axis."""
    return a[0] * b[0] + a[1] * b[1]


def perpendicular(a: Array) -> Array:
    """Vector rotated by a quarter turn counter-clockwise, as the tangent of a normal."""
    return jnp.stack([-a[1], a[0]])


def inverse_length(a: Array) -> Array:
    """1 / |a|, finite at zero."""
    return lax.rsqrt(jnp.maximum(dot(a, a), NEAREST))


def direction(a: Array, otherwise: Array) -> Array:
    """a / |a|, or `otherwise` where a has no length."""
    return jnp.where(dot(a, a) > NEAREST, a * inverse_length(a), otherwise)


def offset_from_core(stadium: Stadium, point: Array) -> tuple[Array, Array, Array]:
    """Offset [2, ...] of a point from the nearest point of a core line, and positions along the line from its middle.

    The positions [...] in m are the one on the infinite line and the one clipped to the core line.
    """
    offset = point - stadium.centre
    along = dot(offset, stadium.direction)
    inside = jnp.clip(along, -stadium.half_length, stadium.half_length)
    return offset - inside * stadium.direction, along, inside


# Hulls --------------------------------------------------------------------------------------------------------------


def edge_normals(vertices: Sequence[Array] | Array) -> tuple[Array, ...]:
    """Outward unit normals of the edges, each [2, ...]; zero for a repeated vertex. Vertices are counter-clockwise."""
    edges = [vertices[(i + 1) % len(vertices)] - vertices[i] for i in range(len(vertices))]
    return tuple(-perpendicular(edge) * inverse_length(edge) for edge in edges)


def hull_at(
    vertices: Sequence[Array] | Array, normals: Sequence[Array] | Array, position: Array, angle: Array, radius: Array
) -> Hull:
    """Hull in the world at a position and angle, of vertices about its centre of mass and their `edge_normals`."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)

    def turn(a: Array) -> Array:
        # Each vector has its own axes; shared ones make the gradient ten times slower on a CPU.
        return a[0] * jnp.stack([cos, sin]) + a[1] * jnp.stack([-sin, cos])

    return Hull(position, tuple(position + turn(v) for v in vertices), tuple(turn(n) for n in normals), radius)


def core_hull(stadium: Stadium) -> Hull:
    """Hull of the two ends of a core line."""
    reach, normal = stadium.half_length * stadium.direction, perpendicular(stadium.direction)
    ends = (stadium.centre - reach, stadium.centre + reach)
    return Hull(stadium.centre, ends, (-normal, normal), stadium.radius)


def largest_separation(a: Hull, b: Hull) -> tuple[Array, Array]:
    """Largest distance [...] of b from a face of a, and the normal [2, ...] of that face."""
    best, normal = jnp.full_like(a.normals[0][0], -FAR), a.normals[0]
    for vertex, face in zip(a.vertices, a.normals, strict=True):
        distance = reduce(jnp.minimum, (dot(face, v) for v in b.vertices)) - dot(face, vertex)
        larger = (distance > best) & ((face[0] != 0) | (face[1] != 0))
        best, normal = jnp.where(larger, distance, best), jnp.where(larger, face, normal)
    return best, normal


def facing_edge(a: Hull, along: Array) -> tuple[Array, Array]:
    """Start and end [2, ...] of the edge whose normal is nearest to a direction."""
    best, start, end = dot(a.normals[0], along), a.vertices[0], a.vertices[1]
    for i in range(1, len(a.vertices)):
        cosine = dot(a.normals[i], along)
        nearer = cosine > best
        start = jnp.where(nearer, a.vertices[i], start)
        end = jnp.where(nearer, a.vertices[(i + 1) % len(a.vertices)], end)
        best = jnp.maximum(cosine, best)
    return start, end


def nearest_ends(low_a: Array, high_a: Array, low_b: Array, high_b: Array) -> tuple[Array, Array, Array]:
    """Nearest ends of two edges, each [2, ...], and whether they are also the nearest points of the edges.

    If they are not, the ends are arbitrary.
    """
    offset, edge_a, edge_b = low_b - low_a, high_a - low_a, high_b - low_b
    aa, ab, bb = dot(edge_a, edge_a), dot(edge_a, edge_b), dot(edge_b, edge_b)
    da, db = dot(offset, edge_a), dot(offset, edge_b)
    low_low = (da <= 0) & (db >= 0)
    low_high = (da + ab <= 0) & (db + bb <= 0)
    high_low = (da >= aa) & (db >= ab)
    high_high = (da + ab >= aa) & (db + bb <= ab)
    end_a = jnp.where(high_low | high_high, high_a, low_a)
    end_b = jnp.where(low_high | high_high, high_b, low_b)
    return end_a, end_b, low_low | low_high | high_low | high_high


def clip_edge(low: Array, high: Array, left: Array, right: Array, tangent: Array) -> tuple[Array, Array]:
    """Both ends of an edge, clipped at `left` and `right` [2, ...] along the tangent."""
    edge = high - low
    inverse = 1 / jnp.maximum(dot(edge, tangent), SLOP)
    over_left, over_right = dot(left - low, tangent), dot(high - right, tangent)
    # An edge across the tangent at the very end of the other is not clipped.
    cut_low, cut_high = (jnp.clip(jnp.where(x > SLOP, x, 0.0) * inverse, 0.0, 1.0) for x in (over_left, over_right))
    return low + cut_low * edge, high - cut_high * edge


# Pairs --------------------------------------------------------------------------------------------------------------


def manifold_point(normal: Array, on_a: Array, on_b: Array, a: Shape, b: Shape) -> ManifoldPoint:
    """Contact point of two points of the cores [2, ...] with a normal."""
    middle = 0.5 * (on_a + on_b + (a.radius - b.radius) * normal)
    return ManifoldPoint(normal, dot(normal, on_b - on_a) - a.radius - b.radius, middle - a.centre, middle - b.centre)


def disc_disc(a: Disc, b: Disc) -> tuple[ManifoldPoint]:
    """Contact point of two discs; with equal centres they separate upwards."""
    offset = b.centre - a.centre
    up = jnp.stack([jnp.zeros_like(offset[0]), jnp.ones_like(offset[1])])
    return (manifold_point(direction(offset, up), a.centre, b.centre, a, b),)


def stadium_disc(a: Stadium, b: Disc) -> tuple[ManifoldPoint]:
    """Contact point of a stadium and a disc; one centred on the core line separates across it."""
    along = jnp.clip(dot(b.centre - a.centre, a.direction), -a.half_length, a.half_length)
    nearest = a.centre + along * a.direction
    return (manifold_point(direction(b.centre - nearest, perpendicular(a.direction)), nearest, b.centre, a, b),)


def hull_disc(a: Hull, b: Disc) -> tuple[ManifoldPoint]:
    """Contact point of a hull and a disc; one centred inside separates through the face of least penetration."""
    only = Hull(b.centre, (b.centre,), (b.centre,), b.radius)
    gap, face = materialize(largest_separation(a, only))
    start, end = facing_edge(a, face)
    tangent = perpendicular(face)
    along = jnp.clip(dot(b.centre - start, tangent), 0.0, dot(end - start, tangent))
    nearest = start + along * tangent
    normal = jnp.where(gap > 0, direction(b.centre - nearest, face), face)
    return (manifold_point(normal, nearest, b.centre, a, b),)


def hull_hull(a: Hull, b: Hull, admits: Callable[[Array], Array] | None = None) -> tuple[ManifoldPoint, ManifoldPoint]:
    """Contact points of two hulls, in order along the tangent; the second is FAR where two corners are nearest.

    Where `admits` refuses a normal that is not of a face of a, the nearest face of a gives the normal, and both points
    are FAR if b is beyond its ends.
    """
    (gap_a, face_a), (gap_b, face_b) = materialize((largest_separation(a, b), largest_separation(b, a)))
    better = gap_b > gap_a + SLOP
    other = better if admits is None else better & admits(-face_b)
    face = jnp.where(other, -face_b, face_a)
    tangent = perpendicular(face)
    (low_a, high_a), (high_b, low_b) = materialize((facing_edge(a, face), facing_edge(b, -face)))

    end_a, end_b, nearest = nearest_ends(low_a, high_a, low_b, high_b)
    # The edges of overlapping hulls may be nearest at corners; lines do not overlap.
    apart = True if len(a.vertices) == len(b.vertices) == 2 else jnp.maximum(gap_a, gap_b) > 0
    at_corners = nearest & apart & (jnp.abs(dot(end_b - end_a, tangent)) > SLOP)
    normal, missing = jnp.where(at_corners, direction(end_b - end_a, face), face), False
    if admits is not None:
        refused = at_corners & ~admits(normal)
        normal, at_corners = jnp.where(refused, face, normal), at_corners & ~refused
        beyond = (dot(low_b - high_a, tangent) > 0) | (dot(low_a - high_b, tangent) > 0)
        missing = beyond & (refused | (better & ~other))

    left_a, right_a = clip_edge(low_a, high_a, low_b, high_b, tangent)
    left_b, right_b = clip_edge(low_b, high_b, low_a, high_a, tangent)
    first = manifold_point(normal, jnp.where(at_corners, end_a, left_a), jnp.where(at_corners, end_b, left_b), a, b)
    second = manifold_point(normal, right_a, right_b, a, b)
    first = first._replace(gap=jnp.where(missing, FAR, first.gap))
    return first, second._replace(gap=jnp.where(at_corners | missing, FAR, second.gap))


def hull_stadium(a: Hull, b: Stadium) -> tuple[ManifoldPoint, ManifoldPoint]:
    """Contact points of a hull and a stadium, as `hull_hull`."""
    return hull_hull(a, core_hull(b))


def stadium_stadium(a: Stadium, b: Stadium) -> tuple[ManifoldPoint, ManifoldPoint]:
    """Contact points of two stadiums, as `hull_hull`."""
    return hull_hull(core_hull(a), core_hull(b))


def segment_contacts(
    segment: Stadium, b: Hull | Stadium, admits: Callable[[Array], Array]
) -> tuple[ManifoldPoint, ManifoldPoint]:
    """Contact points of a segment and another shape with corners; see `hull_hull` for normals that `admits` refuses."""
    return hull_hull(core_hull(segment), core_hull(b) if isinstance(b, Stadium) else b, admits)


PAIRS: dict[tuple[type, type], Callable[..., tuple[ManifoldPoint, ...]]] = {
    (Disc, Disc): disc_disc,
    (Stadium, Disc): stadium_disc,
    (Hull, Disc): hull_disc,
    (Stadium, Stadium): stadium_stadium,
    (Hull, Stadium): hull_stadium,
    (Hull, Hull): hull_hull,
}


def manifold(a: Shape, b: Shape) -> tuple[ManifoldPoint, ...]:
    """Contact points of any two shapes.

    If only the mirrored pair is in the table, the tangent is reversed, and so is the order of the points.
    """
    if pair := PAIRS.get((type(a), type(b))):
        return pair(a, b)
    mirrored = PAIRS[type(b), type(a)](b, a)
    return tuple(ManifoldPoint(-p.normal, p.gap, p.arm_b, p.arm_a) for p in reversed(mirrored))
