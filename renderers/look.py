"""What looks have in common: options of backgrounds, colours and lines, and a paint of plain shapes to begin with."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.config.options import option
from gen2d.core.enums import SHAPES, STATIC
from gen2d.records.axes import Array
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene
from gen2d.renderers.color import palette, to_linear
from gen2d.renderers.paint import Background, Paint, Texture


@dataclasses.dataclass(frozen=True)
class LineOptions:
    """How segments are drawn."""

    wall_width: float = option(1.5, float, "px", "of a segment's line, beyond its own radius; 0: not drawn", low=0)


@dataclasses.dataclass(frozen=True)
class PlainOptions(LineOptions):
    """Background, colours and lines of plain shapes."""

    background_kind: str = option("plain", str, "", "what is behind everything", choices=("plain", "gradient", "noise"))
    background: tuple = option(
        [20, 20, 20], int, "sRGB", "behind everything; where a gradient or noise begins", parts=3, low=0, high=255
    )
    background_to: tuple = option([80, 80, 110], int, "sRGB", "where it ends", parts=3, low=0, high=255)
    background_cell: float = option(
        0.2, float, "1", "size of the noise's spots, over the scene's shorter side", above=0
    )
    palette: str = option("scene", str, "", "whose colours objects have", choices=("scene", "random"))
    contrast: float = option(
        120.0, float, "1", "least difference of random colours and of the background, 0 to 765", low=0, high=765
    )


def line_margin(options: LineOptions) -> float:
    """How far an object may be drawn beyond its rim, px: half a segment's line."""
    return options.wall_width / 2


def plain(scene: Scene, layout: Layout, options: PlainOptions, key: Array) -> Paint:
    """Every slot in one colour on the background. One key gives the same colours in all looks."""
    background = background_of(options, layout, jax.random.fold_in(key, 1))
    colors = colors_of(scene, layout, options, key, background)
    return Paint(background, colors, *line_fields(scene, options))


def background_of(options: PlainOptions, layout: Layout, key: Array) -> Background:
    """The background that is asked for: plain, a gradient in a random direction, or noise."""
    color, to_color = (jnp.asarray(c, jnp.float32) for c in (options.background, options.background_to))
    if options.background_kind == "plain":
        return Background(color)
    if options.background_kind == "gradient":
        return Background(color, to_color, jax.random.uniform(key, maxval=2 * np.pi))
    left, bottom, right, top = layout.bounds
    cell = jnp.float32(options.background_cell * min(right - left, top - bottom))
    return Background(color, texture=Texture(jax.random.bits(key, (), jnp.uint32), cell, to_color))


def shades(background: Background) -> Array:
    """The colours [B, 3] of a background: its own, or both that it goes between and what is halfway."""
    color, other = background.color, background.to_color if background.texture is None else background.texture.color
    return color[None] if other is None else jnp.stack([color, (color + other) / 2, other])


def mean_color(background: Background) -> Array:
    """The colour [3] halfway between the two of a background."""
    return shades(background).mean(0)


def colors_of(scene: Scene, layout: Layout, options: PlainOptions, key: Array, background: Background) -> Array:
    """The colours [K, 3] of the slots: the scene's, or random ones for all that moves, which differ from one another
    and from the background's."""
    colors, moving = scene.objects.color.astype(jnp.float32), np.flatnonzero(are_moving(layout))
    if options.palette == "scene" or not len(moving):
        return colors
    return colors.at[moving].set(palette(key, len(moving), options.contrast, shades(background)))


def line_fields(scene: Scene, options: LineOptions) -> tuple[Array, Array]:
    """Which slots are drawn [K], and what is added to their rims [K] px: segments are lines of a width beyond their own
    radius, and are not drawn if they have neither."""
    line, objects = are_lines(scene), scene.objects
    drawn = objects.present & ~(line & (objects.radius + options.wall_width <= 0))
    return drawn, jnp.where(line, line_margin(options), 0.0)


def are_lines(scene: Scene) -> Array:
    """Which slots are segments [K], in whatever runs they are."""
    return scene.objects.shape == SHAPES.index("segment")


def are_moving(layout: Layout) -> np.ndarray:
    """Which slots are not static [K]."""
    return np.repeat([run.kind != STATIC for run in layout.runs], [run.count for run in layout.runs])


def contrasting(colors: Array) -> Array:
    """Nearly black or nearly white [..., 3], whichever differs more in lightness from the colours [..., 3]."""
    luminance = to_linear(colors) @ jnp.asarray([0.2126, 0.7152, 0.0722])
    # At 0.175 the ratios of luminances, both with 0.05 added, are equal (WCAG 2.2, 'contrast ratio').
    return jnp.where((luminance > 0.175)[..., None], 16.0, 240.0) + jnp.zeros_like(colors)
