"""Softly shaded shapes, as if lit from the upper left, on a plain background or a gradient."""

import dataclasses

import jax
import jax.numpy as jnp

from gen2d.config import option
from gen2d.paint import Paint, are_lines, background_of, colors_of, lines_of, mean_color
from gen2d.types import Array, Layout, Scene


@dataclasses.dataclass(frozen=True)
class Options:
    """Shade, colours and line widths."""

    shade: float = option(0.6, float, "1", "how much darker an object is opposite the light; 0: not", low=0, high=1)
    background_kind: str = option("plain", str, "", "what is behind everything", choices=("plain", "gradient"))
    background: tuple = option(
        [20, 20, 20], int, "sRGB", "of the background, where a gradient begins", parts=3, low=0, high=255
    )
    background_to: tuple = option([80, 80, 110], int, "sRGB", "where a gradient ends", parts=3, low=0, high=255)
    wall_width: float = option(1.5, float, "px", "of a segment's line, beyond its own radius; 0: not drawn", low=0)
    palette: str = option("scene", str, "", "whose colours objects have", choices=("scene", "random"))
    contrast: float = option(
        120.0, float, "1", "least difference of random colours and of the background, 0 to 765", low=0, high=765
    )


def margin(options: Options) -> float:
    """How far an object may be drawn beyond its rim, px."""
    return options.wall_width / 2


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """What one video's slots are painted with; lines have no shade."""
    background = background_of(options, layout, jax.random.fold_in(key, 1))
    drawn, grow = lines_of(scene, options.wall_width)
    colors = colors_of(scene, layout, options, key, mean_color(background))
    return Paint(background, colors, drawn, grow, shade=jnp.where(are_lines(scene), 0.0, options.shade))
