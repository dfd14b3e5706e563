"""Objects as outlines: a line along the inside of the rim, and a fainter fill of the same colour."""

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
    line_margin,
    mean_color,
    option,
    plain,
)


@dataclasses.dataclass(frozen=True)
class Options(PlainOptions):
    """Options of the outlines, in addition to those of plain shapes."""

    width: float = option(1.5, float, "px", "width of the line along the inside of the rim", above=0)
    fill: float = option(
        0.25, float, "1", "fraction of the object's color in its fill; 0: mean color of the background", low=0, high=1
    )


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """Paint of one video. Segments are lines in their own colour, without an outline."""
    base, lines = plain(scene, layout, options, key), are_lines(scene)
    backdrop = mean_color(base.background)
    fill = jnp.where(lines[:, None], base.color, backdrop + options.fill * (base.color - backdrop))
    return base._replace(fill=fill, rim=jnp.where(lines, 0.0, options.width), rim_color=base.color)


LOOK = Look(options=Options, paint=paint, margin=line_margin, grown=LINES)
