"""Plain shapes with a bar from the centre to the rim, which makes their rotation visible."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    LINES,
    Array,
    Layout,
    Look,
    Paint,
    PlainOptions,
    Scene,
    are_lines,
    are_moving,
    contrasting,
    line_margin,
    option,
    plain,
)


@dataclasses.dataclass(frozen=True)
class Options(PlainOptions):
    """Options of the marks, in addition to those of plain shapes."""

    mark_width: float = option(0.3, float, "1", "width of the bar, over the object's radius", above=0, high=1)
    rim_width: float = option(0.0, float, "px", "width of a line along the inside of the rim; 0: none", low=0)
    rim_color: tuple = option([16, 16, 16], int, "sRGB", "color of the line along the rim", parts=3, low=0, high=255)


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """Paint of one video: moving slots have a light or dark bar, whichever contrasts with their colour."""
    base = plain(scene, layout, options, key)
    mark = jnp.where(are_moving(layout), options.mark_width / 2, 0.0)
    marked = base._replace(mark=mark, mark_color=contrasting(base.color))
    if not options.rim_width:
        return marked
    rim_color = jnp.broadcast_to(jnp.asarray(options.rim_color, jnp.float32), base.color.shape)
    return marked._replace(rim=jnp.where(are_lines(scene), 0.0, options.rim_width), rim_color=rim_color)


LOOK = Look(options=Options, paint=paint, margin=line_margin, grown=LINES)
