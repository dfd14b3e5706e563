"""Alternating red and blue shapes on white, without walls: the look of PhyWorld (Kang et al., arXiv 2411.02385).

PhyWorld's rims are soft over 1.5 % of the radius; here they are sharp.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from gen2d.plugin import (
    LINES,
    Array,
    Background,
    Layout,
    LineOptions,
    Look,
    Paint,
    Scene,
    are_moving,
    line_fields,
    line_margin,
    option,
)

WHITE, RED, BLUE = (255.0, 255.0, 255.0), (255.0, 0.0, 0.0), (0.0, 0.0, 255.0)


@dataclasses.dataclass(frozen=True)
class Options(LineOptions):
    """Options of segments."""

    wall_width: float = option(0.0, float, "px", "line width of segments beyond their radius; 0: not drawn", low=0)


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """Paint of one video: moving slots are red and blue in turn, static slots have the scene's colours."""
    moving = are_moving(layout)
    alternating = jnp.asarray([RED, BLUE])[(np.cumsum(moving) - 1) % 2]
    colors = jnp.where(moving[:, None], alternating, scene.objects.color.astype(jnp.float32))
    return Paint(Background(jnp.asarray(WHITE)), colors, *line_fields(scene, options))


LOOK = Look(options=Options, paint=paint, margin=line_margin, grown=LINES)
