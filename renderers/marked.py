"""Plain shapes with a bar from the centre to the rim, so that it can be seen how each has turned."""

import dataclasses

import jax.numpy as jnp

from gen2d.config import option
from gen2d.paint import Background, Paint, are_lines, are_moving, colors_of, contrasting, lines_of
from gen2d.types import Array, Layout, Scene


@dataclasses.dataclass(frozen=True)
class Options:
    """Colours, marks and line widths."""

    mark_width: float = option(0.3, float, "1", "of an object's bar, over its radius", above=0, high=1)
    rim_width: float = option(0.0, float, "px", "of a dark line along the inside of a rim; 0: none", low=0)
    rim_color: tuple = option([16, 16, 16], int, "sRGB", "of that line", parts=3, low=0, high=255)
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
    """What one video's slots are painted with: bars, light or dark, on all that moves."""
    background = jnp.asarray(options.background, jnp.float32)
    drawn, grow = lines_of(scene, options.wall_width)
    colors = colors_of(scene, layout, options, key, background)
    mark = jnp.where(are_moving(layout), options.mark_width / 2, 0.0)
    painted = Paint(Background(background), colors, drawn, grow, mark=mark, mark_color=contrasting(colors))
    if not options.rim_width:
        return painted
    rim_color = jnp.broadcast_to(jnp.asarray(options.rim_color, jnp.float32), colors.shape)
    return painted._replace(rim=jnp.where(are_lines(scene), 0.0, options.rim_width), rim_color=rim_color)
