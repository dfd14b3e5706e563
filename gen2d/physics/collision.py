"""Where two shapes are nearest, how far apart and in which direction: one function per pair of shapes, in `PAIRS`.

Vectors have shape [2, ...], scalars [...], in metres; the last axes (pairs, scenes) are never named. Every function is
elementwise and gives its points at any distance, as the solver looks ahead. Where two things coincide and a direction
is lost, another unit vector stands in, and no gradient is NaN.

A stadium meets a hull, or another stadium, as the hull of its two ends. Two hulls meet as in Box2D v3 (E. Catto,
`b2CollidePolygons`): the face that separates them most gives the normal, the edges that look at each other along
it are clipped to each other, and only if two corners are nearest, the line between them is the normal.

`one` is 1.0 in a way that the compiler cannot know (`xla.materialize`): without it a CPU computes the faces and
edges of two hulls again for each of the results (measured for two boxes: 10 times slower).
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jax import lax

from gen2d.records.axes import Array
from gen2d.xla import materialize

NEAREST = 1e-12  # m^2: squared distances below this have no direction
SLOP = 1e-5  # m: lengths below this are rounding, and do not decide which features touch
FAR = 1e9  # m: the gap of a point that there is not


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
    """A convex polygon, counter-clockwise, in world coordinates. A repeated corner makes an edge without length, whose
    normal is zero; it is never touched. Made by `hull`."""

    centre: Array  # [2, ...]: of mass
    vertices: tuple[Array, ...]  # each [2, ...]
    normals: tuple[Array, ...]  # each [2, ...], outward, unit: of the edge from this vertex to the next
    radius: Array  # [...]: rounding, usually 0


Shape: TypeAlias = Disc | Stadium | Hull


class Point(NamedTuple):
    """A point of contact, midway between the two surfaces: centre_a + arm_a = centre_b + arm_b."""

    normal: Array  # [2, ...], unit, from a to b
    gap: Array  # [...]: negative when overlapping, FAR where there is no such point
    arm_a: Array  # [2, ...]: from the centre of mass
    arm_b: Array  # [2, ...]


def dot(a: Array, b: Array) -> Array:
    """The inner product over the first axis."""
    return a[0] * b[0] + a[1] * b[1]


def turned(a: Array) -> Array:
    """The vector a quarter turn counter-clockwise: the tangent of a normal."""
    return jnp.stack([-a[1], a[0]])


def inverse_length(a: Array) -> Array:
    """1 / |a|, finite at zero."""
    return lax.rsqrt(jnp.maximum(dot(a, a), NEAREST))


def direction(a: Array, otherwise: Array) -> Array:
    """a / |a|, or `otherwise` where a has no length."""
    return jnp.where(dot(a, a) > NEAREST, a * inverse_length(a), otherwise)


def from_core(stadium: Stadium, point: Array) -> tuple[Array, Array, Array]:
    """A point's offset [2, ...] from the nearest one of a core line; where that line is beside it, as if it had no ends
    [...], and with them [...], in metres from its middle."""
    offset = point - stadium.centre
    along = dot(offset, stadium.direction)
    inside = jnp.clip(along, -stadium.half_length, stadium.half_length)
    return offset - inside * stadium.direction, along, inside


# Hulls --------------------------------------------------------------------------------------------------------------


def edge_normals(vertices: Sequence[Array] | Array) -> tuple[Array, ...]:
    """The outward unit normal of each edge [2, ...], zero where a vertex is repeated; vertices counter-clockwise."""
    edges = [vertices[(i + 1) % len(vertices)] - vertices[i] for i in range(len(vertices))]
    return tuple(-turned(edge) * inverse_length(edge) for edge in edges)


def hull(
    vertices: Sequence[Array] | Array, normals: Sequence[Array] | Array, position: Array, angle: Array, radius: Array
) -> Hull:
    """The hull in the world of vertices and their `edge_normals`, about its centre of mass, at a position and angle."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)

    def turn(a: Array) -> Array:
        # Axes of its own for each vector: XLA's CPU compiler makes the gradient ten times slower if they are shared.
        return a[0] * jnp.stack([cos, sin]) + a[1] * jnp.stack([-sin, cos])

    return Hull(position, tuple(position + turn(v) for v in vertices), tuple(turn(n) for n in normals), radius)


def core(stadium: Stadium) -> Hull:
    """The stadium as the hull of its core line's two ends."""
    reach, normal = stadium.half_length * stadium.direction, turned(stadium.direction)
    ends = (stadium.centre - reach, stadium.centre + reach)
    return Hull(stadium.centre, ends, (-normal, normal), stadium.radius)


def widest(a: Hull, b: Hull) -> tuple[Array, Array]:
    """The largest distance of b from a face of a [...], and that face's normal [2, ...]."""
    best, normal = jnp.full_like(a.normals[0][0], -FAR), a.normals[0]
    for vertex, face in zip(a.vertices, a.normals, strict=True):
        apart = reduce(jnp.minimum, (dot(face, v) for v in b.vertices)) - dot(face, vertex)
        wider = (apart > best) & ((face[0] != 0) | (face[1] != 0))
        best, normal = jnp.where(wider, apart, best), jnp.where(wider, face, normal)
    return best, normal


def facing(a: Hull, way: Array) -> tuple[Array, Array]:
    """Start and end [2, ...] of the edge whose normal is nearest to a way."""
    best, start, end = dot(a.normals[0], way), a.vertices[0], a.vertices[1]
    for i in range(1, len(a.vertices)):
        cosine = dot(a.normals[i], way)
        nearer = cosine > best
        start = jnp.where(nearer, a.vertices[i], start)
        end = jnp.where(nearer, a.vertices[(i + 1) % len(a.vertices)], end)
        best = jnp.maximum(cosine, best)
    return start, end


def nearest_ends(low_a: Array, high_a: Array, low_b: Array, high_b: Array) -> tuple[Array, Array, Array]:
    """The nearest ends of two edges, each [2, ...], and whether they are the nearest points of the edges, too: if
    neither edge comes nearer by leaving its end. If not, any ends."""
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


def clipped(low: Array, high: Array, left: Array, right: Array, tangent: Array) -> tuple[Array, Array]:
    """The two ends of an edge, cut where they reach beyond `left` and `right` [2, ...] along the tangent."""
    edge = high - low
    inverse = 1 / jnp.maximum(dot(edge, tangent), SLOP)
    over_left, over_right = dot(left - low, tangent), dot(high - right, tangent)
    # An upright edge at the very end of the other stays whole.
    cut_low, cut_high = (jnp.clip(jnp.where(x > SLOP, x, 0.0) * inverse, 0.0, 1.0) for x in (over_left, over_right))
    return low + cut_low * edge, high - cut_high * edge


# Pairs --------------------------------------------------------------------------------------------------------------


def point(normal: Array, on_a: Array, on_b: Array, a: Shape, b: Shape) -> Point:
    """The point of contact that two points of the cores [2, ...] make, given the normal."""
    middle = 0.5 * (on_a + on_b + (a.radius - b.radius) * normal)
    return Point(normal, dot(normal, on_b - on_a) - a.radius - b.radius, middle - a.centre, middle - b.centre)


def disc_disc(a: Disc, b: Disc) -> tuple[Point]:
    """One point; discs with the same centre part upwards."""
    offset = b.centre - a.centre
    up = jnp.stack([jnp.zeros_like(offset[0]), jnp.ones_like(offset[1])])
    return (point(direction(offset, up), a.centre, b.centre, a, b),)


def stadium_disc(a: Stadium, b: Disc) -> tuple[Point]:
    """One point; a disc centred on the core line parts across it."""
    along = jnp.clip(dot(b.centre - a.centre, a.direction), -a.half_length, a.half_length)
    nearest = a.centre + along * a.direction
    return (point(direction(b.centre - nearest, turned(a.direction)), nearest, b.centre, a, b),)


def hull_disc(a: Hull, b: Disc) -> tuple[Point]:
    """One point; a disc centred inside parts through the face of least penetration."""
    only = Hull(b.centre, (b.centre,), (b.centre,), b.radius)
    gap, face = materialize(widest(a, only))
    start, end = facing(a, face)
    tangent = turned(face)
    along = jnp.clip(dot(b.centre - start, tangent), 0.0, dot(end - start, tangent))
    nearest = start + along * tangent
    normal = jnp.where(gap > 0, direction(b.centre - nearest, face), face)
    return (point(normal, nearest, b.centre, a, b),)


def hull_hull(a: Hull, b: Hull) -> tuple[Point, Point]:
    """Two points, in the order of the normal's tangent; the second is FAR where two corners touch."""
    (gap_a, face_a), (gap_b, face_b) = materialize((widest(a, b), widest(b, a)))
    other = gap_b > gap_a + SLOP
    face = jnp.where(other, -face_b, face_a)
    tangent = turned(face)
    (low_a, high_a), (high_b, low_b) = materialize((facing(a, face), facing(b, -face)))

    end_a, end_b, nearest = nearest_ends(low_a, high_a, low_b, high_b)
    # Overlapping hulls may have edges whose nearest points are corners; lines have no inside.
    apart = True if len(a.vertices) == len(b.vertices) == 2 else jnp.maximum(gap_a, gap_b) > 0
    at_corners = nearest & apart & (jnp.abs(dot(end_b - end_a, tangent)) > SLOP)
    normal = jnp.where(at_corners, direction(end_b - end_a, face), face)

    left_a, right_a = clipped(low_a, high_a, low_b, high_b, tangent)
    left_b, right_b = clipped(low_b, high_b, low_a, high_a, tangent)
    first = point(normal, jnp.where(at_corners, end_a, left_a), jnp.where(at_corners, end_b, left_b), a, b)
    second = point(normal, right_a, right_b, a, b)
    return first, second._replace(gap=jnp.where(at_corners, FAR, second.gap))


def hull_stadium(a: Hull, b: Stadium) -> tuple[Point, Point]:
    """Two points, as `hull_hull`."""
    return hull_hull(a, core(b))


def stadium_stadium(a: Stadium, b: Stadium) -> tuple[Point, Point]:
    """Two points, as `hull_hull`."""
    return hull_hull(core(a), core(b))


PAIRS: dict[tuple[type, type], Callable[..., tuple[Point, ...]]] = {
    (Disc, Disc): disc_disc,
    (Stadium, Disc): stadium_disc,
    (Hull, Disc): hull_disc,
    (Stadium, Stadium): stadium_stadium,
    (Hull, Stadium): hull_stadium,
    (Hull, Hull): hull_hull,
}


def touches(a: Shape, b: Shape) -> tuple[Point, ...]:
    """The points of any pair of shapes. If only (b, a) is in the table, seen from there: the tangent turns round, and
    with it the order."""
    if pair := PAIRS.get((type(a), type(b))):
        return pair(a, b)
    mirrored = PAIRS[type(b), type(a)](b, a)
    return tuple(Point(-p.normal, p.gap, p.arm_b, p.arm_a) for p in reversed(mirrored))
