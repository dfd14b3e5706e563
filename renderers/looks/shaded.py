"""Plain shapes with soft shading, lit from the upper left."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import LINES, Array, Layout, Look, Paint, PlainOptions, Scene, are_lines, line_margin, option, plain


@dataclasses.dataclass(frozen=True)
class Options(PlainOptions):
    """Options of the shading, in addition to those of plain shapes."""

    shade: float = option(0.6, float, "1", "relative darkening of the side opposite the light; 0: none", low=0, high=1)


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """Paint of one video: all slots but segments are shaded."""
    shade = jnp.where(are_lines(scene), 0.0, options.shade)
    return plain(scene, layout, options, key)._replace(shade=shade)


LOOK = Look(options=Options, paint=paint, margin=line_margin, grown=LINES)
