"""Centres: where the centre of each object lies in the image, and whether it is seen there."""

import jax.numpy as jnp

from gen2d.plugin import Annotation, Array, Field, FramePlan, RenderScene, option, pixel_at, to_pixels


def annotate(scenes: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Centres of all slots."""
    at, drawn = scenes.instants, scenes.paint.drawn[:, None]
    points = jnp.where(drawn[..., None], to_pixels(at.view, at.position, plan.height, plan.width), 0.0)
    pixel, inside = pixel_at(points[..., 0], points[..., 1], plan.height, plan.width)
    shown = jnp.take_along_axis(owners.reshape(*owners.shape[:2], -1), pixel, axis=-1)
    return {"centers/points": points, "centers/visible": drawn & inside & (shown == jnp.arange(points.shape[2]) + 1)}


ANNOTATION = Annotation(
    options=option(False, bool, "", "position of each object's centre in the image", later=True),
    fields={
        "centers/points": Field(
            "float32", "n T K 2", "px", "position of the object's centre, x right, y down; 0 where none is rendered"
        ),
        "centers/visible": Field("bool", "n T K", "1", "whether the centre lies in a pixel that shows the object"),
    },
    annotate=annotate,
    owners=True,
)
