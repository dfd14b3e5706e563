"""What the slots of a scene look like in pixels: their figures, the parts that a look paints, and each part's coverage.

Written for one video at some instants. `object_parts` gives arrays that begin with [k, I], the slots of one run and the
instants; the rest is the same for any leading axes.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.records.layout import SlotGroup
from gen2d.renderers.camera import CameraView, to_pixels
from gen2d.renderers.paint import Paint


class BodyGeometry(NamedTuple):
    """What of a video's objects matters to their figures; [K, ...]."""

    radius: Array
    half_length: Array
    vertices: Array | None


class Instants(NamedTuple):
    """Where everything is at some instants, [I, ...]."""

    position: Array  # [I, K, 2] m
    angle: Array  # [I, K] rad
    view: CameraView


class Primitive(NamedTuple):
    """Discs (the two numbers of `corners` are a centre), or rounded polygons; without an area, nothing."""

    corners: Array  # [..., 2] or [..., V, 2] px, x right and y down
    radius: Array | None  # [...] px


class ObjectParts(NamedTuple):
    """What is painted of some slots: all of it, what is inside the line along its rim, and its mark."""

    whole: Primitive
    inner: Primitive | None
    mark: Primitive | None
    turn: "BodyTransform"


class BodyTransform(NamedTuple):
    """From a pixel to a body's own frame."""

    column: Array  # [...] px, of the centre
    row: Array
    cos: Array  # of the angle in the picture, y down
    sin: Array
    scale: Array  # px/m
    reach: Array  # px, from the centre to the farthest point


def object_parts(
    run: SlotGroup, first: int, bodies: BodyGeometry, at: Instants, paint: Paint, height: int, width: int
) -> ObjectParts:
    """The parts of the slots of a run, in pixels; arrays [k, I, ...]."""
    slots = slice(first, first + run.count)
    scale, drawn = at.view.scale, paint.drawn[slots, None]
    center = jnp.moveaxis(to_pixels(at.view, at.position[:, slots], height, width), 1, 0)
    angle = at.view.angle - at.angle[:, slots].T  # clockwise as seen: y is down
    radius = bodies.radius[slots, None] * scale + (0.0 if paint.grow is None else paint.grow[slots, None])
    own, reach, ahead = _own(run, slots, bodies, scale, radius)
    turn = BodyTransform(
        center[..., 0], center[..., 1], jnp.cos(angle), jnp.sin(angle), scale + jnp.zeros_like(angle), reach
    )
    whole = _primitive(run, turn, own, radius, drawn)
    inner = mark = None
    if paint.rim is not None:
        rim = paint.rim[slots, None]
        some = drawn & (radius > rim) if run.shape != "polygon" else drawn
        inner = _primitive(run, turn, _inset(run, own, rim, radius), jnp.maximum(radius - rim, 0.0), some)
    if paint.mark is not None:
        # Its round end is beyond the rim, where nothing is painted.
        end = jnp.where(drawn, ahead, 0.0)
        zero = jnp.zeros_like(end)
        bar = jnp.stack([jnp.stack([zero, zero], -1), jnp.stack([end, zero], -1)], -2)
        half = paint.mark[slots, None] * _nearest(run, own, radius)
        mark = Primitive(_placed(bar, turn), jnp.where(drawn, half, 0.0))
    return ObjectParts(whole, inner, mark, turn)


def _own(
    run: SlotGroup, slots: slice, bodies: BodyGeometry, scale: Array, radius: Array
) -> tuple[Array | None, Array, Array]:
    """The corners [k, I, V, 2] of the core in the body's own frame (x ahead, y down; a disc has none), its reach, and
    how far it goes ahead of its centre; px."""
    if run.shape == "circle":
        return None, radius, radius
    if run.shape == "polygon":
        assert bodies.vertices is not None, "a layout with polygons needs objects.vertices"
        # Turned over with y, and so in the other order.
        corners = bodies.vertices[slots, None, ::-1] * jnp.asarray([1.0, -1.0]) * scale[:, None, None]
        square = (corners**2).sum(-1).max(-1)
        reach = jnp.sqrt(jnp.maximum(square, 1e-12)) + radius  # an empty slot's has a derivative too
        return corners, reach, _ahead(corners) + radius
    half = bodies.half_length[slots, None] * scale
    zero = jnp.zeros_like(half)
    corners = jnp.stack([jnp.stack([-half, zero], -1), jnp.stack([half, zero], -1)], -2)
    return corners, half + radius, half + radius


def _sides(corners: Array) -> tuple[Array, Array]:
    """The outward normals [..., V, 2] of the sides, and how far these are from the centre [..., V]; a side without
    length is infinitely far."""
    side = jnp.roll(corners, -1, axis=-2) - corners
    square = (side**2).sum(-1)
    normal = jnp.stack([side[..., 1], -side[..., 0]], -1) / jnp.sqrt(jnp.where(square > 0, square, 1.0))[..., None]
    return normal, jnp.where(square > 1e-12, (normal * corners).sum(-1), jnp.inf)


def _ahead(corners: Array) -> Array:
    """How far a polygon goes along its own x axis."""
    normal, distance = _sides(corners)
    facing = normal[..., 0] > 1e-6
    return jnp.where(facing, distance / jnp.where(facing, normal[..., 0], 1.0), jnp.inf).min(-1)


def _nearest(run: SlotGroup, corners: Array | None, radius: Array) -> Array:
    """How far the nearest point of the rim is from the centre."""
    return radius if run.shape != "polygon" or corners is None else _sides(corners)[1].min(-1) + radius


def _inset(run: SlotGroup, corners: Array | None, rim: Array, radius: Array) -> Array | None:
    """A polygon's corners moved inwards by what a rim takes beyond the radius, at most to its middle."""
    if run.shape != "polygon" or corners is None:
        return corners
    normal, distance = _sides(corners)
    by = jnp.clip(rim - radius, 0.0, 0.999 * distance.min(-1))[..., None, None]
    # A corner may be given more than once: its sides are those that have a length.
    one = normal
    for _ in range(corners.shape[-2] - 1):
        one = jnp.where(jnp.isfinite(distance)[..., None], one, jnp.roll(one, -1, axis=-2))
    other = jnp.roll(normal, 1, axis=-2)
    known = jnp.roll(jnp.isfinite(distance), 1, axis=-1)
    for _ in range(corners.shape[-2] - 1):
        other = jnp.where(known[..., None], other, jnp.roll(other, 1, axis=-2))
    together = 1 + (one * other).sum(-1, keepdims=True)
    return corners - by * (one + other) / jnp.maximum(together, 1e-3)


def _placed(corners: Array, turn: BodyTransform) -> Array:
    cos, sin = turn.cos[..., None], turn.sin[..., None]
    x, y = corners[..., 0], corners[..., 1]
    return jnp.stack([turn.column[..., None] + x * cos - y * sin, turn.row[..., None] + x * sin + y * cos], -1)


def _primitive(run: SlotGroup, turn: BodyTransform, corners: Array | None, radius: Array, drawn: Array) -> Primitive:
    """The figure of slots, without an area where it is not drawn."""
    radius = jnp.where(drawn, radius, 0.0)
    if corners is None:
        return Primitive(jnp.stack([turn.column, turn.row], -1), radius)
    placed = _placed(jnp.where(drawn[..., None, None], corners, 0.0), turn)
    return Primitive(placed, None if run.shape == "polygon" and not run.rounded else radius)


class PixelWindow(NamedTuple):
    """Which pixels are looked at: so many rows and columns from a first one."""

    top: Any  # [...]
    left: Any
    rows: int
    columns: int
