"""Layers: how one is painted over an image, and those that cover all of it, back to front.

Images are uint8 frames, owners (which object each pixel shows most of), or floats; what paints one is a function
`paint(image, cover, color, name)`: coverage [I, H, W] from 0 to 1, sRGB colour, and the id of what is painted.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array
from gen2d.records.layout import SlotGroup
from gen2d.renderers.camera import to_world
from gen2d.renderers.color import LINEAR, to_linear, to_srgb
from gen2d.renderers.noise import textured
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.renderers.primitives import Instants, PixelWindow, object_parts
from gen2d.renderers.shading import EdgeSamples, covered_color, edge_samples, fills_of

FULL = 2**15 - 1  # a pixel's coverage is a whole number up to this
NOBODY = FULL << 8  # owner of the background
OCCLUDER = 255  # what a mask says of a pixel that shows an occluder

Painter = Callable[[Any, Array, Array, Any], Any]


class LayerCanvas(NamedTuple):
    """Images that are painted on, uint8 [I, H, W, 3] and int32 [I, H, W], if they are wanted."""

    image: Array | None
    owner: Array | None


# ---- One layer


def to_levels(cover: Array) -> Array:
    """A coverage from 0 to 1 as whole numbers up to FULL, int16."""
    return (cover * FULL + 0.5).astype(jnp.int32).astype(jnp.int16)


def to_ink(color: Array) -> Array:
    """A colour as whole numbers, int16."""
    return (color + 0.5).astype(jnp.int32).astype(jnp.int16)


def over(under: Array, cover: Array, color: Array, linear: bool) -> Array:
    """The uint8 image [..., 3] after a layer of `to_levels` coverage [...] and of an `to_ink` that fits it."""
    cover = cover[..., None]
    if linear:
        light = jnp.asarray(LINEAR)[under.astype(jnp.int32)]
        share = cover.astype(jnp.float32) * (1 / FULL)
        mixed = light + share * (to_linear(color.astype(jnp.float32)) - light)
        return (to_srgb(mixed) + 0.5).astype(jnp.uint8)
    # Fixed point, so that both forms round alike: 5 bits below one, products of 16 bits, of which a vector has many.
    under = under.astype(jnp.int16)
    apart = (color - under) << 6
    product = ((apart.astype(jnp.int32) * cover.astype(jnp.int32)) >> 16).astype(jnp.int16)
    return (under + ((product + 16) >> 5)).astype(jnp.uint8)


def ownership(owner: Array, cover: Array, name: Array | int) -> Array:
    """Who is seen most of in each pixel, after a layer of `to_levels` coverage.

    An owner is an id and, above its 8 bits, how much of the pixel its object shows, up to FULL; what comes on top
    leaves the same share of all that was there, so only the best so far has to be known.
    """
    cover = cover.astype(jnp.int32)
    best = ((owner >> 8) * (FULL - cover) + FULL // 2) // FULL
    return jnp.where(cover > best, (cover << 8) | name, (best << 8) | (owner & 255))


def hard(linear: bool) -> Painter:
    """What paints on a canvas, in whole numbers."""

    def paint(canvas: LayerCanvas, cover: Array, color: Array, name: Any) -> LayerCanvas:
        image, owner = canvas
        return LayerCanvas(
            None if image is None else over(image, to_levels(cover), to_ink(color), linear),
            None if owner is None else ownership(owner, to_levels(cover), name),
        )

    return paint


def soft(linear: bool, sigma: float = 0.0) -> Painter:
    """What paints on an image of floats, sRGB or linear light; `sigma` (px) blurs every coverage."""

    def paint(image: Array, cover: Array, color: Array, name: Any) -> Array:
        cover = blurred(cover, sigma) if sigma else cover
        return image + cover[..., None] * ((to_linear(color) if linear else color) - image)

    return paint


def blurred(cover: Array, sigma: float) -> Array:
    """Coverage [I, H, W] under a Gaussian of standard deviation `sigma` (px), to 4 sigma; the edge goes on outside."""
    reach = math.ceil(4 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = jnp.asarray(kernel / kernel.sum(), cover.dtype)
    images = jnp.pad(cover, [(0, 0), (reach, reach), (reach, reach)], mode="edge")[:, None]
    for shape in ((1, 1, -1, 1), (1, 1, 1, -1)):
        images = jax.lax.conv(images, kernel.reshape(shape), (1, 1), "VALID")
    return images[:, 0]


# ---- What covers all of an image


def background_image(stage: RenderScene, at: Instants, plan: FramePlan) -> Array:
    """The background [I, H, W, 3] at some instants, as floats; [1, H, W, 3] where it is the same at all."""
    background, first = stage.paint.background, stage.instants.view
    color, height, width = background.color, plan.height, plan.width
    if background.to_color is None and background.texture is None:
        return jnp.broadcast_to(color, (1, height, width, 3))
    rows, columns = (jnp.arange(n, dtype=jnp.float32) + 0.5 for n in (height, width))
    rows, columns = (a.reshape(-1) for a in jnp.meshgrid(rows, columns, indexing="ij"))
    x, y = (a.reshape(-1, height, width) for a in to_world(at.view, columns, rows, height, width))
    if background.to_color is not None and background.direction is not None:
        # From one end of what the first frame shows to the other.
        cos, sin = jnp.cos(background.direction), jnp.sin(background.direction)
        center, scale = first.center[0], first.scale[0]
        reach = (jnp.abs(cos) * width + jnp.abs(sin) * height) / (2 * scale)
        along = ((x - center[0]) * cos + (y - center[1]) * sin) / reach
        color = color + jnp.clip((along[..., None] + 1) / 2, 0, 1) * (background.to_color - color)
    if background.texture is not None:
        color = textured(color, background.texture, x, y)
    return jnp.broadcast_to(color, (*x.shape, 3))


def background_layer(stage: RenderScene, at: Instants, plan: FramePlan) -> LayerCanvas:
    """The background alone at some instants, if its image and owners are wanted; [1, ...] where it is always the
    same."""
    return LayerCanvas(
        (background_image(stage, at, plan) + 0.5).astype(jnp.uint8) if plan.frames else None,
        jnp.full((1, plan.height, plan.width), NOBODY, jnp.int32) if plan.owners else None,
    )


def static_layer(stage: RenderScene, plan: FramePlan) -> LayerCanvas:
    """What never moves, [1, ...], without the occluders: these stand before what moves."""
    first = jax.tree.map(lambda a: a[:1], stage.instants)
    alone = stage._replace(occluders=None)
    return all_over(background_layer(stage, first, plan), alone, plan, first, plan.behind, hard(plan.linear))


def all_over(
    canvas: Any, stage: RenderScene, plan: FramePlan, at: Instants, runs: list[tuple[SlotGroup, int]], paint: Painter
) -> Any:
    """The canvas after some runs' slots and what stands before them were painted over all of it.

    A loop over the slots: what depends on rows or columns alone is then computed before it, once, and not again for
    every pixel, as it would be where the compiler fused all.
    """
    window = PixelWindow(0, 0, plan.height, plan.width)
    rank = 0
    for run, first in runs:
        slots = slice(first, first + run.count)

        def all_of(
            canvas: Any, run: SlotGroup = run, first: int = first, slots: slice = slots, rank: int = rank
        ) -> Any:
            def one(canvas: Any, entry: tuple) -> tuple[Any, None]:
                cuts, inks, slot, rank = entry
                canvas = static_objects(canvas, stage, plan, lambda of: of == rank, paint)
                return paint(canvas, *covered_color(cuts, inks, window, plan.largest(run)), slot + 1), None

            numbers = jnp.arange(run.count)
            entries = cut_of(stage, plan, at, run, first, window), fills_of(stage.paint, slots)
            return jax.lax.scan(one, canvas, (*entries, first + numbers, rank + numbers))[0]

        some = stage.occluders is not None or stage.paint.drawn[slots].any()
        canvas = jax.lax.cond(some, all_of, lambda same: same, canvas)
        rank += run.count
    return canvas


def moving_objects(canvas: Any, stage: RenderScene, plan: FramePlan, at: Instants, paint: Painter) -> Any:
    """The canvas after what moves and the occluders between were painted over all of it."""
    canvas = all_over(canvas, stage, plan, at, [span for group in plan.groups for span in group.runs], paint)
    return static_objects(canvas, stage, plan, lambda rank: rank >= plan.moving, paint)


def static_objects(
    canvas: Any, stage: RenderScene, plan: FramePlan, here: Callable[[Array], Array], paint: Painter
) -> Any:
    """The canvas after those occluders whose rank is `here`."""
    if stage.occluders is None:
        return canvas
    for i, rank in enumerate(stage.occluders.rank):
        cover, color = occluder(stage, plan, i, here(rank))
        canvas = paint(canvas, cover, color, OCCLUDER)
    return canvas


def occluder(stage: RenderScene, plan: FramePlan, i: int, here: Array) -> tuple[Array, Array]:
    """Coverage [1, H, W], none unless it is `here`, and colour [3] of an occluder."""
    assert stage.occluders is not None
    left, top, right, bottom = stage.occluders.box[i]

    def part(count: int, low: Array, high: Array) -> Array:
        edge = jnp.arange(count, dtype=jnp.float32)
        return jnp.clip(jnp.minimum(high, edge + 1) - jnp.maximum(low, edge), 0.0, 1.0)

    cover = part(plan.height, top, bottom)[:, None] * part(plan.width, left, right)
    return jnp.where(here, cover, 0.0)[None], stage.occluders.color[i]


def cut_of(
    stage: RenderScene, plan: FramePlan, at: Instants, run: SlotGroup, first: int, window: PixelWindow
) -> EdgeSamples:
    """The parts of a run's slots at some instants, cut by their windows; arrays [k, I, ...].

    In a loop of its own, for what is the same for all rows and columns to be there before it.
    """
    parts = object_parts(run, first, stage.bodies, at, stage.paint, plan.height, plan.width)
    toned = stage.paint.shade is not None or stage.paint.texture is not None
    begin = [jnp.broadcast_to(jnp.asarray(edge), parts.turn.column.shape) for edge in (window.top, window.left)]

    def one(entry: tuple) -> EdgeSamples:
        of, top, left = entry
        return edge_samples(of, PixelWindow(top, left, window.rows, window.columns), run.shape == "circle", toned)

    return jax.lax.map(one, (parts, *begin))
