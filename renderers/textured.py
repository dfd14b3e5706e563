"""Shapes with spots of random noise that turn with them, on a plain background, a gradient, or noise again."""

import dataclasses

import jax
import jax.numpy as jnp

from gen2d.config import option
from gen2d.paint import Paint, Texture, background_of, colors_of, contrasting, lines_of, mean_color
from gen2d.types import Array, Layout, Scene


@dataclasses.dataclass(frozen=True)
class Options:
    """Spots, colours and line widths."""

    spots: float = option(
        0.8, float, "1", "how far spots go to black or white, whichever differs more from the background", low=0, high=1
    )
    cell: float = option(0.6, float, "1", "size of a spot, over the largest object's reach", above=0)
    background_kind: str = option("noise", str, "", "what is behind everything", choices=("plain", "gradient", "noise"))
    background: tuple = option(
        [20, 20, 20], int, "sRGB", "of the background, where a gradient or noise begins", parts=3, low=0, high=255
    )
    background_to: tuple = option([64, 64, 84], int, "sRGB", "where a gradient or noise ends", parts=3, low=0, high=255)
    background_cell: float = option(
        0.2, float, "1", "size of the noise's spots, over the scene's shorter side", above=0
    )
    wall_width: float = option(1.5, float, "px", "of a segment's line, beyond its own radius; 0: not drawn", low=0)
    palette: str = option("scene", str, "", "whose colours objects have", choices=("scene", "random"))
    contrast: float = option(
        120.0, float, "1", "least difference of random colours and of the background, 0 to 765", low=0, high=765
    )


def margin(options: Options) -> float:
    """How far an object may be drawn beyond its rim, px."""
    return options.wall_width / 2


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """What one video's slots are painted with, each with spots of its own."""
    k_background, k_spots = (jax.random.fold_in(key, i) for i in (1, 2))
    background = background_of(options, layout, k_background)
    drawn, grow = lines_of(scene, options.wall_width)
    mean = mean_color(background)
    colors = colors_of(scene, layout, options, key, mean)
    texture = Texture(
        seed=jax.random.bits(k_spots, (layout.slots,), jnp.uint32),
        cell=jnp.full(layout.slots, options.cell * layout.reach),
        color=colors + options.spots * (contrasting(mean) - colors),
    )
    return Paint(background, colors, drawn, grow, texture=texture)
