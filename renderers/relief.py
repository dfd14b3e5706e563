"""Relief of bodies in pixels: the tilt of their surfaces at each pixel.

Discs, capsules and segments are domes: the surface tilts outwards in proportion to the distance from the core. Polygons
are flat with a bevel, which tilts towards the nearest side.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.records.layout import SlotGroup
from gen2d.renderers.camera import CameraView
from gen2d.renderers.paint import Paint
from gen2d.renderers.primitives import BodyGeometry, ImagePose, Instants, side_normals

MITRE = 0.7  # of a pixel's width, over the difference of the distances of two perpendicular sides
SHARP = 1e6  # the same where each point has the tilt of its nearest side


class Relief(NamedTuple):
    """Shape of some slots, relative to their centres; px, y down."""

    radius: Array  # [...] of a dome, or of a polygon's corners
    half: Array | None  # [...] half the length of the core of a capsule or segment
    normal: Array | None  # [..., V, 2] outward normals of a polygon's sides
    distance: Array | None  # [..., V] of the sides of its core from the centre
    light: Array  # [..., 2] direction towards the light

    @property
    def is_disc(self) -> bool:
        """Whether the slots hold discs."""
        return self.half is None and self.normal is None


def relief_of(run: SlotGroup, first: int, bodies: BodyGeometry, at: Instants, paint: Paint) -> Relief:
    """Relief of a run's slots at I instants; arrays [k, I, ...]."""
    assert paint.light is not None, "surfaces need a light"
    outline = outline_of(run, first, bodies, at, paint)
    toward = in_image(paint.light.direction[:2], at.view)
    return Relief(*outline, jnp.broadcast_to(toward, (*outline[0].shape, 2)))


def in_image(direction: Array, view: CameraView) -> Array:
    """A direction [2] of the world as the camera sees it at I instants [I, 2], y down."""
    cos, sin = jnp.cos(view.angle), jnp.sin(view.angle)
    right, up = direction[0], direction[1]
    return jnp.stack([right * cos + up * sin, right * sin - up * cos], -1)


def outline_of(
    run: SlotGroup, first: int, bodies: BodyGeometry, at: Instants, paint: Paint
) -> tuple[Array, Array | None, Array | None, Array | None]:
    """Radius [k, I], half length [k, I], normals [k, I, V, 2] and distances [k, I, V] of the sides of a run's slots, as
    in `Relief`."""
    slots, scale = slice(first, first + run.count), at.view.scale
    radius = bodies.radius[slots, None] * scale + (0.0 if paint.grow is None else paint.grow[slots, None])
    if run.shape == "circle":
        return radius, None, None, None
    if run.shape != "polygon":
        return radius, bodies.half_length[slots, None] * scale, None, None
    assert bodies.vertices is not None, "a layout with polygons needs objects.vertices"
    corners = bodies.vertices[slots, None, ::-1] * jnp.asarray([1.0, -1.0]) * scale[:, None, None]
    normal, distance = side_normals(corners)
    angle = at.view.angle - at.angle[:, slots].T
    cos, sin = jnp.cos(angle)[..., None], jnp.sin(angle)[..., None]
    turned = jnp.stack([normal[..., 0] * cos - normal[..., 1] * sin, normal[..., 0] * sin + normal[..., 1] * cos], -1)
    return radius, None, turned, distance


def tilt(
    relief: Relief, pose: ImagePose, x: Array, y: Array, inverse: Array, cover: Array, mitre: float = MITRE
) -> tuple[Array, Array, Array | float]:
    """Tilt towards x and towards y [..., rows, columns], from 0 to 1 at the rim, and the part [..., rows, columns] of a
    highlight that shows: half of it where a pixel averages two sides of a polygon.

    `x` [..., 1, columns] and `y` [..., rows, 1] are relative to the centre, in px; `inverse` [..., 1, 1] is 1 over the
    width that slopes. Where the coverage is c, the tilt is that at the centroid of the covered part, (1 - c) / 2 from
    the pixel's centre. `mitre` is how sharp the edges between the sides of a polygon are.
    """
    inwards = (1 - cover) / 2
    if relief.normal is not None and relief.distance is not None:
        nx, ny, even = jnp.zeros_like(cover), jnp.zeros_like(cover), jnp.ones_like(cover)
        farthest = jnp.full_like(cover, -jnp.inf)
        for side in range(relief.normal.shape[-2]):
            a, b = (relief.normal[..., side, axis][..., None, None] for axis in (0, 1))
            distance = jnp.minimum(relief.distance[..., side] + relief.radius, 1e6)  # infinite for a side of length 0
            beyond = x * a + (y * b - distance[..., None, None])
            nearer = jnp.clip((beyond - farthest) * mitre + 0.5, 0.0, 1.0)  # an edge between sides, a pixel wide
            nx, ny = nx + nearer * (a - nx), ny + nearer * (b - ny)
            even = jnp.where(nearer < 0.5, even, 1.0) * (2 * nearer - 1) ** 2
            farthest = jnp.maximum(farthest, beyond)
        amount = jnp.clip(1 + (farthest - inwards) * inverse, 0.0, 1.0)
        return nx * amount, ny * amount, (1 + even) / 2
    if relief.half is not None:
        cos, sin, half = (a[..., None, None] for a in (pose.cos, pose.sin, relief.half))
        along = jnp.clip(x * cos + y * sin, -half, half)
        x, y = x - along * cos, y - along * sin
    part = (1 - inwards * inverse) * inverse
    return x * part, y * part, 1.0


def sloping_width(relief: Relief, pose: ImagePose, bevel: Array) -> Array:
    """Width [...] px of the part of a surface that slopes: the radius of a dome, or a polygon's bevel."""
    return jnp.maximum(relief.radius, 0.5) if relief.normal is None else jnp.maximum(bevel * pose.scale, 1.0)


class SurfacePoints(NamedTuple):
    """Surfaces at the centres of pixels [..., rows, columns]."""

    normal_x: Array  # of the unit normal: right
    normal_y: Array  # down
    height: Array  # m, above the rim


def surface_points(relief: Relief, pose: ImagePose, slope: Array, bevel: Array, x: Array, y: Array) -> SurfacePoints:
    """Surfaces at points `x` [..., 1, columns] and `y` [..., rows, 1] px from the centre; beyond the rim as at the rim.

    A tilt t from 0 to 1 at the rim is the sine s t of the steepest tilt s. So a dome, of which t is the distance from
    the core over the radius w, is the cap of a sphere of radius w / s; a bevel of width w has the same profile.
    """
    inverse = (1 / sloping_width(relief, pose, bevel))[..., None, None]
    tilt_x, tilt_y, _ = tilt(relief, pose, x, y, inverse, jnp.ones_like(x + y), SHARP)
    square = tilt_x * tilt_x + tilt_y * tilt_y
    inside = jax.lax.rsqrt(jnp.maximum(square, 1.0))
    slope, square = slope[..., None, None], jnp.minimum(square, 1.0)
    width = (sloping_width(relief, pose, bevel) / pose.scale)[..., None, None]
    steepest = slope * slope
    roots = jnp.sqrt(jnp.maximum(1 - steepest * square, 0.0)) + jnp.sqrt(jnp.maximum(1 - steepest, 0.0))
    height = width * slope * (1 - square) / jnp.maximum(roots, 1e-6)
    return SurfacePoints(slope * inside * tilt_x, slope * inside * tilt_y, height)
