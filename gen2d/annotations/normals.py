"""Normals: direction that the surface of each pixel faces."""

import jax.numpy as jnp

from gen2d.plugin import Annotation, Array, Field, FramePlan, RenderScene, SurfacePoints, option, visible_surfaces

ONE = 127  # of a component of a unit normal


def annotate(scenes: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Unit normals at the centres of pixels."""
    planes = visible_surfaces(scenes, owners, plan, _planes)
    return {"surface/normal": jnp.stack(planes, -1)}


def _planes(point: SurfacePoints) -> tuple[Array, Array, Array]:
    """Components to the right, up and towards the viewer of unit normals, int8."""
    x, y = point.normal_x, -point.normal_y
    z = jnp.sqrt(jnp.maximum(1 - x * x - y * y, 0.0))
    right, up, towards = (jnp.round(ONE * part).astype(jnp.int8) for part in (x, y, z))
    return right, up, towards


ANNOTATION = Annotation(
    options=option(False, bool, "", "unit normals of the surface that each pixel shows", later=True),
    fields={
        "surface/normal": Field(
            "int8",
            "n T H W 3",
            "1/127",
            "unit normal, right, up and towards the viewer in the image, of the surface of the object of the instance "
            "mask at the pixel's centre, of an occluder within its box; 0 0 127 of the background",
        )
    },
    annotate=annotate,
    owners=True,
    needs="surface",
)
