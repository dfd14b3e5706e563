"""Shared parts of looks: options of backgrounds, colours and lines, and the paint of plain shapes."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.config.options import drawn_options, option
from gen2d.core.enums import SHAPES, STATIC
from gen2d.core.palettes import PALETTES, Palette
from gen2d.records.axes import Array
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene
from gen2d.renderers.color import palette, to_linear
from gen2d.renderers.paint import Background, Paint, Picture, Texture

LINES = ("segment",)  # shapes that `line_fields` grows
CROP = 0.6  # least size of a crop of an image, over that of the largest


def palette_option(default: str) -> str:
    """The option `palette` with another default."""
    meaning = "object colors: of the scene, random, or of a named palette, which also colors walls and background"
    return option(default, str, "", meaning, choices=("scene", "random", *PALETTES))


@dataclasses.dataclass(frozen=True)
class LineOptions:
    """Options of segments, which are rendered as lines."""

    wall_width: float = option(1.5, float, "px", "line width of segments beyond their radius; 0: not drawn", low=0)


@dataclasses.dataclass(frozen=True)
class PlainOptions(LineOptions):
    """Options of the background, colours and lines of plain shapes."""

    background_kind: str = option(
        "plain",
        str,
        "",
        "kind of the background; backdrop: that of the palette; images: crops of the user's images",
        choices=("plain", "gradient", "noise", "backdrop", "images"),
    )
    background_images: tuple[str, ...] | None = option(
        None,
        str,
        "",
        "sha256 of the images; null: of all images of the folder that is named",
        several=True,
        optional=True,
        later=True,
    )
    background: tuple[int, ...] | None = option(
        None,
        int,
        "sRGB",
        "first color of the background; null: that of the palette, or [20, 20, 20]",
        parts=3,
        low=0,
        high=255,
        optional=True,
    )
    background_to: tuple[int, ...] | None = option(
        None,
        int,
        "sRGB",
        "second color of the background; null: that of the palette, or one of the look",
        parts=3,
        low=0,
        high=255,
        optional=True,
    )
    background_cell: float = option(
        0.2, float, "1", "cell size of the noise, over the shorter side of the scene", above=0
    )
    palette: str = palette_option("scene")
    contrast: float = option(
        120.0, float, "1", "smallest contrast of random colors and the background, 0 to 765", low=0, high=765
    )
    dark: ClassVar[tuple[tuple[int, ...], tuple[int, ...]]] = (20, 20, 20), (80, 80, 110)  # backgrounds by default

    @property
    def named_palette(self) -> Palette | None:
        """The palette of this name; None if the colours are those of the scene, or random."""
        return PALETTES.get(self.palette)

    @property
    def grounds(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """First and second colour of the background: as asked for, else of the palette, else dark ones."""
        named = self.named_palette
        first, second = (named.ground[1], named.ground[2]) if named else self.dark
        return self.background or first, self.background_to or second


def line_margin(options: LineOptions) -> float:
    """Largest distance (px) that an object is rendered beyond its own rim: half the line width of segments."""
    return options.wall_width / 2


def sampled_options(options: Any, key: Array) -> dict[str, Array]:
    """Values [] of the options with `draw=True` of one video, by name: `Paint.sampled`, which the dataset stores."""
    sources = {name: getattr(options, name) for name in drawn_options(options)}
    keys = jax.random.split(key, max(len(sources), 1))
    return {name: source.sample(k, ()) for (name, source), k in zip(sources.items(), keys, strict=False)}


def plain(scene: Scene, layout: Layout, options: PlainOptions, key: Array) -> Paint:
    """Paint with one colour per slot. The same key gives the same colours in all looks."""
    background = sample_background(options, layout, jax.random.fold_in(key, 1))
    colors = slot_colors(scene, layout, options, key, background)
    return Paint(background, colors, *line_fields(scene, options))


def sample_background(options: PlainOptions, layout: Layout, key: Array) -> Background:
    """Background by `background_kind`: plain, a gradient in a random direction, noise, the palette's backdrop, or a
    crop of an image, of at least `CROP` of the largest."""
    named = options.named_palette
    if options.background_kind == "images" and options.background_images is not None:
        index_key, corner_key, extent_key = jax.random.split(key, 3)
        index = jax.random.randint(index_key, (), 0, len(options.background_images))
        extent = jax.random.uniform(extent_key, minval=CROP)
        picture = Picture(index, jax.random.uniform(corner_key, (2,)), extent)
        return Background(jnp.asarray(options.grounds[0], jnp.float32), picture=picture)
    if options.background_kind == "backdrop" and named is not None:
        return backdrop(named, layout, key)
    color, to_color = (jnp.asarray(c, jnp.float32) for c in options.grounds)
    if options.background_kind == "plain":
        return Background(color)
    if options.background_kind == "gradient":
        return Background(color, to_color, jax.random.uniform(key, maxval=2 * np.pi))
    if options.background_kind == "backdrop":
        return Background(color, to_color, jnp.float32(np.pi / 2))
    cell = jnp.float32(options.background_cell * _shorter_side(layout))
    return Background(color, texture=Texture(jax.random.bits(key, (), jnp.uint32), cell, to_color))


def backdrop(named: Palette, layout: Layout, key: Array) -> Background:
    """The backdrop of a palette: a vertical gradient with other corners, and its grain."""
    top, bottom, corners = jnp.asarray(named.ground, jnp.float32)
    background = Background(bottom, top, jnp.float32(np.pi / 2), corners=corners)
    if named.grain is None:
        return background
    cell, stretch, color = named.grain
    seed = jax.random.bits(key, (), jnp.uint32)
    texture = Texture(
        seed, jnp.float32(cell * _shorter_side(layout)), jnp.asarray(color, jnp.float32), jnp.float32(stretch)
    )
    return background._replace(texture=texture)


def _shorter_side(layout: Layout) -> float:
    left, bottom, right, top = layout.bounds
    return min(right - left, top - bottom)


def background_colors(background: Background) -> Array:
    """Colours [B, 3] that represent a background: its only colour, or its two end colours and their mean."""
    color, end = background.color, background.to_color if background.texture is None else background.texture.color
    return color[None] if end is None else jnp.stack([color, (color + end) / 2, end])


def mean_color(background: Background) -> Array:
    """Mean colour [3] of a background."""
    return background_colors(background).mean(0)


def slot_colors(scene: Scene, layout: Layout, options: PlainOptions, key: Array, background: Background) -> Array:
    """Colours [K, 3] of the slots: of the scene, of a named palette, or for moving slots random ones that contrast with
    each other and with the background."""
    colors, moving = scene.objects.color.astype(jnp.float32), are_moving(layout)
    if options.named_palette is not None:
        return palette_colors(scene, layout, options.named_palette, jax.random.fold_in(key, 3))
    count = int(moving.sum())
    if options.palette == "scene" or not count:
        return colors
    return colors.at[np.flatnonzero(moving)].set(palette(key, count, options.contrast, background_colors(background)))


def palette_colors(scene: Scene, layout: Layout, named: Palette, key: Array) -> Array:
    """Colours [K, 3] of a named palette in a random order: distinct for the moving objects that are present, or each as
    often as any other, to one, if there are more objects than colours; a chain counts as one object. Static slots have
    the colour of walls."""
    colors, moving = jnp.asarray([*named.objects.values()], jnp.float32), are_moving(layout)
    order = jax.random.permutation(key, len(colors))
    place = jnp.cumsum(scene.objects.present & (moving & ~layout.later_links)) - 1
    wall = jnp.asarray(named.wall[1], jnp.float32)
    return jnp.where(jnp.asarray(moving)[:, None], colors[order[place % len(colors)]], wall)


def line_fields(scene: Scene, options: LineOptions) -> tuple[Array, Array]:
    """The fields `drawn` [K] and `grow` [K] px of a `Paint`: segments grow by half the line width, and are not rendered
    if both their radius and the line width are 0."""
    line, objects = are_lines(scene), scene.objects
    drawn = objects.present & ~(line & (objects.radius + options.wall_width <= 0))
    return drawn, jnp.where(line, line_margin(options), 0.0)


def are_lines(scene: Scene) -> Array:
    """Mask [K] of the slots that hold segments, by the shapes of the scene."""
    return scene.objects.shape == SHAPES.index("segment")


def are_moving(layout: Layout) -> np.ndarray:
    """Mask [K] of the slots that are not static."""
    return np.repeat([run.kind != STATIC for run in layout.groups], [run.count for run in layout.groups])


def contrasting(colors: Array) -> Array:
    """Near-black or near-white [..., 3], whichever has the higher contrast ratio to the colours [..., 3]."""
    luminance = to_linear(colors) @ jnp.asarray([0.2126, 0.7152, 0.0722])
    # At a luminance of 0.175 the contrast ratios to the two are equal (WCAG 2.2, 'contrast ratio').
    return jnp.where((luminance > 0.175)[..., None], 16.0, 240.0) + jnp.zeros_like(colors)
