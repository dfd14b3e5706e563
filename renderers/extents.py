"""How large figures are in the picture, in closed form: the boxes around them and their areas."""

from collections.abc import Callable

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.renderers.primitives import Primitive, object_parts


def bounding_boxes(stage: RenderScene, plan: FramePlan) -> Array:
    """The boxes [T, K, 4] px (x0 y0 x1 y1) around all of each object as it is drawn; 0 where nothing is drawn."""

    def box(figure: Primitive, disc: bool) -> Array:
        corners = figure.corners[..., None, :] if disc else figure.corners
        radius = 0.0 if figure.radius is None else figure.radius[..., None]
        around = jnp.concatenate([corners.min(-2) - radius, corners.max(-2) + radius], -1)
        return jnp.where(area_of(figure, disc)[..., None] > 0, around, 0.0)

    return _of_slots(stage, plan, box)


def areas(stage: RenderScene, plan: FramePlan) -> Array:
    """The area [T, K] px^2 of each object as it is drawn."""
    return _of_slots(stage, plan, area_of)


def area_of(figure: Primitive, disc: bool) -> Array:
    """The area [...] px^2 of figures: core, sides times radius, and a disc."""
    radius = jnp.zeros(()) if figure.radius is None else figure.radius
    round_part = jnp.pi * radius**2
    if disc:
        return round_part
    corners, following = figure.corners, jnp.roll(figure.corners, -1, axis=-2)
    core = (corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]).sum(-1) / 2
    return core + radius * jnp.sqrt(((following - corners) ** 2).sum(-1)).sum(-1) + round_part


def _of_slots(stage: RenderScene, plan: FramePlan, measure: Callable[[Primitive, bool], Array]) -> Array:
    found = []
    for run, first in plan.layout.spans:
        parts = object_parts(run, first, stage.bodies, stage.instants, stage.paint, plan.height, plan.width)
        found.append(measure(parts.whole, run.shape == "circle"))
    return jnp.moveaxis(jnp.concatenate(found), 0, 1)
