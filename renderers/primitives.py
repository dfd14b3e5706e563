"""Primitives: discs and rounded polygons in pixels, for the parts of each slot that a look paints.

Functions take one video at I instants. Arrays of a run's k slots have the shape [k, I, ...].
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.records.layout import SlotGroup
from gen2d.renderers.camera import CameraView, to_pixels
from gen2d.renderers.paint import Paint


class BodyGeometry(NamedTuple):
    """Shape parameters of a video's objects."""

    radius: Array  # [K] m
    half_length: Array  # [K] m
    vertices: Array | None  # [K, V, 2] m, in the body frame


class Instants(NamedTuple):
    """Poses and view at I instants."""

    position: Array  # [I, K, 2] m
    angle: Array  # [I, K] rad
    view: CameraView


class Primitive(NamedTuple):
    """Discs (`corners` is the centre) or rounded polygons. Nothing is rendered where the area is 0."""

    corners: Array  # [..., 2] or [..., V, 2] px, x right and y down
    radius: Array | None  # [...] px


class ObjectParts(NamedTuple):
    """Parts of some slots: the whole object, its interior without the rim line, and its mark."""

    whole: Primitive
    inner: Primitive | None
    mark: Primitive | None
    pose: "ImagePose"


class ImagePose(NamedTuple):
    """Poses of bodies in the image."""

    column: Array  # [...] px, of the centre
    row: Array
    cos: Array  # of the angle in the image, y down
    sin: Array
    scale: Array  # px/m
    reach: Array  # px, from the centre to the farthest point


def object_parts(
    run: SlotGroup, first: int, bodies: BodyGeometry, at: Instants, paint: Paint, height: int, width: int
) -> ObjectParts:
    """Parts of a run's slots in pixels; arrays [k, I, ...]."""
    slots = slice(first, first + run.count)
    scale, drawn = at.view.scale, paint.drawn[slots, None]
    center = jnp.moveaxis(to_pixels(at.view, at.position[:, slots], height, width), 1, 0)
    angle = at.view.angle - at.angle[:, slots].T  # clockwise in the image, as y is down
    radius = bodies.radius[slots, None] * scale + (0.0 if paint.grow is None else paint.grow[slots, None])
    corners, reach, ahead = _body_shape(run, slots, bodies, scale, radius)
    pose = ImagePose(
        center[..., 0], center[..., 1], jnp.cos(angle), jnp.sin(angle), scale + jnp.zeros_like(angle), reach
    )
    whole = _primitive(run, pose, corners, radius, drawn)
    inner = mark = None
    if paint.rim is not None:
        rim = paint.rim[slots, None]
        visible = drawn & (radius > rim) if run.shape != "polygon" else drawn
        inset = _inset_corners(run, corners, rim, radius)
        inner = _primitive(run, pose, inset, jnp.maximum(radius - rim, 0.0), visible)
    if paint.mark is not None:
        # The round end of the bar lies beyond the rim, where nothing is painted.
        end = jnp.where(drawn, ahead, 0.0)
        zero = jnp.zeros_like(end)
        bar = jnp.stack([jnp.stack([zero, zero], -1), jnp.stack([end, zero], -1)], -2)
        half = paint.mark[slots, None] * _inradius(run, corners, radius)
        mark = Primitive(_to_image(bar, pose), jnp.where(drawn, half, 0.0))
    return ObjectParts(whole, inner, mark, pose)


def _body_shape(
    run: SlotGroup, slots: slice, bodies: BodyGeometry, scale: Array, radius: Array
) -> tuple[Array | None, Array, Array]:
    """Corners [k, I, V, 2] of the core in the body frame with y down (None for a disc), distance of the farthest point
    from the centre, and distance of the rim along x; px."""
    if run.shape == "circle":
        return None, radius, radius
    if run.shape == "polygon":
        assert bodies.vertices is not None, "a layout with polygons needs objects.vertices"
        # Flipping y reverses the orientation; the reversed order restores it.
        corners = bodies.vertices[slots, None, ::-1] * jnp.asarray([1.0, -1.0]) * scale[:, None, None]
        square = (corners**2).sum(-1).max(-1)
        reach = jnp.sqrt(jnp.maximum(square, 1e-12)) + radius  # finite derivative in empty slots
        return corners, reach, _rim_along_x(corners) + radius
    half = bodies.half_length[slots, None] * scale
    zero = jnp.zeros_like(half)
    corners = jnp.stack([jnp.stack([-half, zero], -1), jnp.stack([half, zero], -1)], -2)
    return corners, half + radius, half + radius


def side_normals(corners: Array) -> tuple[Array, Array]:
    """Outward normals [..., V, 2] of the sides, and their distances from the centre [..., V]; infinite for a side of
    length 0."""
    side = jnp.roll(corners, -1, axis=-2) - corners
    square = (side**2).sum(-1)
    normal = jnp.stack([side[..., 1], -side[..., 0]], -1) / jnp.sqrt(jnp.where(square > 0, square, 1.0))[..., None]
    return normal, jnp.where(square > 1e-12, (normal * corners).sum(-1), jnp.inf)


def _rim_along_x(corners: Array) -> Array:
    """Distance of a polygon's rim from its centre along its own x axis."""
    normal, distance = side_normals(corners)
    facing = normal[..., 0] > 1e-6
    return jnp.where(facing, distance / jnp.where(facing, normal[..., 0], 1.0), jnp.inf).min(-1)


def _inradius(run: SlotGroup, corners: Array | None, radius: Array) -> Array:
    """Distance of the nearest point of the rim from the centre."""
    return radius if run.shape != "polygon" or corners is None else side_normals(corners)[1].min(-1) + radius


def _inset_corners(run: SlotGroup, corners: Array | None, rim: Array, radius: Array) -> Array | None:
    """Corners of a polygon inset by the part of the rim line that exceeds the radius, at most to the centre."""
    if run.shape != "polygon" or corners is None:
        return corners
    normal, distance = side_normals(corners)
    inset = jnp.clip(rim - radius, 0.0, 0.999 * distance.min(-1))[..., None, None]
    # Corners may be repeated: take the normals of the nearest sides that have a length.
    outgoing = normal
    for _ in range(corners.shape[-2] - 1):
        outgoing = jnp.where(jnp.isfinite(distance)[..., None], outgoing, jnp.roll(outgoing, -1, axis=-2))
    incoming = jnp.roll(normal, 1, axis=-2)
    valid = jnp.roll(jnp.isfinite(distance), 1, axis=-1)
    for _ in range(corners.shape[-2] - 1):
        incoming = jnp.where(valid[..., None], incoming, jnp.roll(incoming, 1, axis=-2))
    denominator = 1 + (outgoing * incoming).sum(-1, keepdims=True)
    return corners - inset * (outgoing + incoming) / jnp.maximum(denominator, 1e-3)


def _to_image(corners: Array, pose: ImagePose) -> Array:
    cos, sin = pose.cos[..., None], pose.sin[..., None]
    x, y = corners[..., 0], corners[..., 1]
    return jnp.stack([pose.column[..., None] + x * cos - y * sin, pose.row[..., None] + x * sin + y * cos], -1)


def _primitive(run: SlotGroup, pose: ImagePose, corners: Array | None, radius: Array, drawn: Array) -> Primitive:
    """Primitive of some slots, with an area of 0 where `drawn` is false."""
    radius = jnp.where(drawn, radius, 0.0)
    if corners is None:
        return Primitive(jnp.stack([pose.column, pose.row], -1), radius)
    placed = _to_image(jnp.where(drawn[..., None, None], corners, 0.0), pose)
    return Primitive(placed, None if run.shape == "polygon" and not run.rounded else radius)


class PixelWindow(NamedTuple):
    """Windows of rows x columns pixels, by their top left pixels."""

    top: Any  # [...] first row
    left: Any  # [...] first column
    rows: int
    columns: int
