"""Bounding boxes and areas of rendered objects, in closed form."""

from collections.abc import Callable

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.renderers.primitives import Primitive, object_parts


def bounding_boxes(scene: RenderScene, plan: FramePlan) -> Array:
    """Bounding boxes [T, K, 4] px (x0 y0 x1 y1) of whole objects as rendered; 0 for slots that are not rendered."""

    def box(primitive: Primitive, disc: bool) -> Array:
        return jnp.where(area_of(primitive, disc)[..., None] > 0, bounds_of(primitive, disc), 0.0)

    return _measure_slots(scene, plan, box)


def bounds_of(primitive: Primitive, disc: bool) -> Array:
    """Bounds [..., 4] px of primitives: left, top, right, bottom."""
    corners = primitive.corners[..., None, :] if disc else primitive.corners
    radius = 0.0 if primitive.radius is None else primitive.radius[..., None]
    return jnp.concatenate([corners.min(-2) - radius, corners.max(-2) + radius], -1)


def areas(scene: RenderScene, plan: FramePlan) -> Array:
    """Areas [T, K] px^2 of whole objects as rendered."""
    return _measure_slots(scene, plan, area_of)


def area_of(primitive: Primitive, disc: bool) -> Array:
    """Areas [...] px^2 of primitives: core, perimeter times radius, and a disc (Steiner's formula)."""
    radius = jnp.zeros(()) if primitive.radius is None else primitive.radius
    round_part = jnp.pi * radius**2
    if disc:
        return round_part
    # From the first corner: far from the origin, rounding gives an area to a point, and a wrong one to a small shape.
    corners = primitive.corners - primitive.corners[..., :1, :]
    following = jnp.roll(corners, -1, axis=-2)
    core = (corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]).sum(-1) / 2
    return core + radius * jnp.sqrt(((following - corners) ** 2).sum(-1)).sum(-1) + round_part


def _measure_slots(scene: RenderScene, plan: FramePlan, measure: Callable[[Primitive, bool], Array]) -> Array:
    measures = []
    for run, first in plan.layout.spans:
        parts = object_parts(run, first, scene.bodies, scene.instants, scene.paint, plan.height, plan.width)
        measures.append(measure(parts.whole, run.shape == "circle"))
    return jnp.moveaxis(jnp.concatenate(measures), 0, 1)
