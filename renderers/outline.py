"""Objects as outlines: a line along the inside of each rim in the object's colour, and less of that colour within."""

import dataclasses

import jax.numpy as jnp

from gen2d.config import option
from gen2d.paint import Background, Paint, are_lines, colors_of, lines_of
from gen2d.types import Array, Layout, Scene


@dataclasses.dataclass(frozen=True)
class Options:
    """Colours and line widths."""

    width: float = option(1.5, float, "px", "of the line along the inside of a rim", above=0)
    fill: float = option(
        0.25, float, "1", "how much of an object's colour is within its line; 0: the background's", low=0, high=1
    )
    background: tuple = option([20, 20, 20], int, "sRGB", "behind everything", parts=3, low=0, high=255)
    wall_width: float = option(1.5, float, "px", "of a segment's line, beyond its own radius; 0: not drawn", low=0)
    palette: str = option("scene", str, "", "whose colours objects have", choices=("scene", "random"))
    contrast: float = option(
        120.0, float, "1", "least difference of random colours and of the background, 0 to 765", low=0, high=765
    )


def margin(options: Options) -> float:
    """How far an object may be drawn beyond its rim, px."""
    return options.wall_width / 2


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """What one video's slots are painted with; segments are lines anyway, in their own colour."""
    background = jnp.asarray(options.background, jnp.float32)
    drawn, grow = lines_of(scene, options.wall_width)
    colors, line = colors_of(scene, layout, options, key, background), are_lines(scene)
    within = jnp.where(line[:, None], colors, background + options.fill * (colors - background))
    rim = jnp.where(line, 0.0, options.width)
    return Paint(Background(background), colors, drawn, grow, fill=within, rim=rim, rim_color=colors)
