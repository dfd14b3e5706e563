"""Depth: height of the surface that each pixel shows."""

import jax.numpy as jnp

from gen2d.plugin import Annotation, Array, Field, FramePlan, RenderScene, option, visible_surfaces


def annotate(scenes: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Heights at the centres of pixels."""
    return {"surface/height": visible_surfaces(scenes, owners, plan, lambda point: point.height.astype(jnp.float16))}


ANNOTATION = Annotation(
    options=option(False, bool, "", "height of the surface that each pixel shows", later=True),
    fields={
        "surface/height": Field(
            "float16",
            "n T H W",
            "m",
            "height, towards the viewer, of the surface of the object of the instance mask at the pixel's centre; of "
            "an occluder within its box; 0 at rims and of the background",
        )
    },
    annotate=annotate,
    owners=True,
    needs="surface",
)
