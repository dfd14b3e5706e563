"""Shapes with spots of random noise that turn with them, by default on a noise background."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from gen2d.plugin import (
    LINES,
    Array,
    Layout,
    Look,
    Paint,
    PlainOptions,
    Scene,
    Texture,
    contrasting,
    line_margin,
    mean_color,
    option,
    plain,
)


@dataclasses.dataclass(frozen=True)
class Options(PlainOptions):
    """Options of the spots, in addition to those of plain shapes."""

    background_kind: str = option("noise", str, "", "kind of the background", choices=("plain", "gradient", "noise"))
    texture_contrast: float = option(0.8, float, "1", "contrast of the spots; 1: black or white", low=0, high=1)
    cell_size: float = option(0.6, float, "1", "size of the spots, over the reach of the largest object", above=0)
    dark: ClassVar[tuple[tuple[int, ...], tuple[int, ...]]] = (20, 20, 20), (64, 64, 84)


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """Paint of one video: each slot has its own spots."""
    base = plain(scene, layout, options, key)
    extreme = contrasting(mean_color(base.background))
    texture = Texture(
        seed=jax.random.bits(jax.random.fold_in(key, 2), (layout.slots,), jnp.uint32),
        cell=jnp.full(layout.slots, options.cell_size * layout.reach),
        color=base.color + options.texture_contrast * (extreme - base.color),
    )
    return base._replace(texture=texture)


LOOK = Look(options=Options, paint=paint, margin=line_margin, grown=LINES)
