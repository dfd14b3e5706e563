"""Shadow mask: opacity of the shadow that each pixel shows.

It is rendered as a frame is, of a white shadow on black objects and a black background, at the instant of the frame.
"""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import Annotation, Array, Background, Field, FramePlan, Paint, RenderScene, draw, option


def annotate(scenes: RenderScene, owners: Array | None, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Opacities of shadows, 0 to 255."""
    bare = dataclasses.replace(plan, frames=True, owners=False, exposed=0, linear=False)
    masked = scenes._replace(paint=_white_shadow(scenes.paint), exposed=None, sensor=None)
    if masked.occluders is not None:
        masked = masked._replace(occluders=masked.occluders._replace(color=jnp.zeros_like(masked.occluders.color)))
    image, _ = draw(masked, bare)
    assert image is not None
    return {"surface/shadow": image[..., 0]}


def _white_shadow(paint: Paint) -> Paint:
    """Paint of black objects and background, and of white shadows."""
    assert paint.shadow is not None, "the look paints no shadow"
    black = jnp.zeros_like(paint.color)
    shadow = paint.shadow._replace(color=jnp.full_like(paint.shadow.color, 255.0))
    return Paint(Background(jnp.zeros_like(paint.background.color)), black, paint.drawn, paint.grow, shadow=shadow)


ANNOTATION = Annotation(
    options=option(False, bool, "", "opacity of the shadow that each pixel shows", later=True),
    fields={
        "surface/shadow": Field(
            "uint8",
            "n T H W",
            "1/255",
            "part of the pixel's color that is the color of shadows, at the frame's instant",
        )
    },
    annotate=annotate,
    needs="shadow",
)
