"""Plain discs on a plain background, walls as lines: each object in its own colour."""

import dataclasses

import jax.numpy as jnp

from gen2d.config import option
from gen2d.raster import Paint
from gen2d.types import Layout, Scene


@dataclasses.dataclass(frozen=True)
class Options:
    """Colours and line widths."""

    background: tuple = option([20, 20, 20], int, "sRGB", "behind everything", parts=3, low=0, high=255)
    wall_width: float = option(1.5, float, "px", "of a segment's line, beyond its own radius; 0: not drawn", low=0)


def paint(scene: Scene, layout: Layout, options: Options) -> Paint:
    """What one video's slots are drawn as."""
    objects = scene.objects
    walls = slice(layout.discs, layout.slots)
    drawn = objects.present[walls] & ((options.wall_width > 0) | (objects.radius[walls] > 0))
    return Paint(
        background=jnp.asarray(options.background, jnp.float32),
        color=objects.color.astype(jnp.float32),
        line=jnp.where(drawn, options.wall_width / 2, -jnp.inf),
    )
