"""Objects as outlines: a line along the inside of each rim in the object's colour, and less of that colour within."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
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
    """Outlines, and what plain shapes have."""

    width: float = option(1.5, float, "px", "of the line along the inside of a rim", above=0)
    fill: float = option(
        0.25, float, "1", "how much of an object's colour is within its line; 0: the background's mean", low=0, high=1
    )


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """What one video's slots are painted with; segments are lines anyway, in their own colour."""
    begun, line = plain(scene, layout, options, key), are_lines(scene)
    behind = mean_color(begun.background)
    within = jnp.where(line[:, None], begun.color, behind + options.fill * (begun.color - behind))
    return begun._replace(fill=within, rim=jnp.where(line, 0.0, options.width), rim_color=begun.color)


LOOK = Look(options=Options, paint=paint, margin=line_margin)
