"""Compositing: layers painted over full-size images, back to front.

A `Painter` is a function `paint(canvas, cover, color, object_id)` that paints one layer: its coverage [I, H, W] from 0
to 1, its sRGB colour, and its id; None for a shadow, which owns no pixel. The canvas is a `LayerCanvas` of frames and
owners, or a float image. The owner of a pixel is the object that the pixel shows most of.
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
from gen2d.renderers.lighting import ShadedColor, as_color
from gen2d.renderers.lit_terms import lit_terms
from gen2d.renderers.noise import textured
from gen2d.renderers.occluders import OccluderLayer, occluder_layers
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.renderers.primitives import Instants, PixelWindow, object_parts
from gen2d.renderers.relief import relief_of
from gen2d.renderers.shading import EdgeTerms, covered_color, edge_terms, fills_of
from gen2d.renderers.shadows import ShadowTerms, shadow_cover, shadow_terms

FULL_COVER = 2**15 - 1  # a quantised coverage of 1
SHARE_BITS, SHARE_WORD = 13, 16
FULL_SHARE = 2**SHARE_BITS  # a quantised share of 1 of a `ShadedColor`, whose shares are from 0 to 4
NO_OWNER = FULL_COVER << 8  # owner of a pixel that shows only background
OCCLUDER = 255  # id of all occluders

Painter = Callable[[Any, Array, Any, Any], Any]


class LayerCanvas(NamedTuple):
    """Frames, uint8 [I, H, W, 3], and owners, int32 [I, H, W] as in `ownership`; None where they are not wanted."""

    image: Array | None
    owner: Array | None


# ---- One layer


def quantize_cover(cover: Array) -> Array:
    """Coverage from 0 to 1 as int16 from 0 to FULL_COVER."""
    return (cover * FULL_COVER + 0.5).astype(jnp.int32).astype(jnp.int16)


class PackedColor(NamedTuple):
    """A quantised `ShadedColor`. Both shares are in one array, so that the compiler computes them together."""

    color: Array  # [..., 1, 1, 3] int16
    accent: Array  # [..., 1, 1, 3] int16
    shares: Array  # [..., rows, columns] int32: of the color below, of the accent above SHARE_WORD bits


def quantize_color(color: Array | ShadedColor) -> Any:
    """Colour rounded to int16, or a `PackedColor`."""
    if isinstance(color, ShadedColor):
        share, accent_share = ((part * FULL_SHARE + 0.5).astype(jnp.int32) for part in color[2:])
        shares = share | (accent_share << SHARE_WORD)
        return PackedColor(quantize_color(color.color), quantize_color(color.accent), shares)
    return (color + 0.5).astype(jnp.int32).astype(jnp.int16)


def _unpacked(packed: PackedColor) -> Array:
    """Colours [..., rows, columns, 3] int16 of a `PackedColor`."""
    color, accent, shares = packed.color.astype(jnp.int32), packed.accent.astype(jnp.int32), packed.shares[..., None]
    share, accent_share = shares & (2**SHARE_WORD - 1), shares >> SHARE_WORD
    value = (color * share + (accent * accent_share + FULL_SHARE // 2)) >> SHARE_BITS
    return jnp.minimum(value, 255).astype(jnp.int16)


def over(under: Array, cover: Array, color: Array | PackedColor, linear: bool) -> Array:
    """Composite of a layer over a uint8 image [..., 3], from its quantised coverage [...] and colour."""
    cover, color = cover[..., None], _unpacked(color) if isinstance(color, PackedColor) else color
    if linear:
        light = jnp.asarray(LINEAR)[under.astype(jnp.int32)]
        alpha = cover.astype(jnp.float32) * (1 / FULL_COVER)
        mixed = light + alpha * (to_linear(color.astype(jnp.float32)) - light)
        return (to_srgb(mixed) + 0.5).astype(jnp.uint8)
    # Fixed point, so that tiles and dense rendering round alike: 5 fractional bits, in 16-bit integers, of which a
    # SIMD vector holds many.
    under = under.astype(jnp.int16)
    difference = (color - under) << 6
    product = ((difference.astype(jnp.int32) * cover.astype(jnp.int32)) >> 16).astype(jnp.int16)
    return (under + ((product + 16) >> 5)).astype(jnp.uint8)


def paint_tile(
    canvas: LayerCanvas, cover: Array, color: Any, object_id: Array | int, corner: tuple[Array, ...], linear: bool
) -> LayerCanvas:
    """Canvas with a quantised layer [1, rows, columns] painted at a corner (image, top, left), owners in one image."""
    image, owner = canvas
    if image is not None:
        start = (*corner, 0)
        under = jax.lax.dynamic_slice(image, start, (*cover.shape, 3))
        image = jax.lax.dynamic_update_slice(image, over(under, cover, color, linear), start)
    if owner is not None:
        start = (0, *corner[1:])
        under = jax.lax.dynamic_slice(owner, start, cover.shape)
        owner = jax.lax.dynamic_update_slice(owner, ownership(under, cover, object_id), start)
    return LayerCanvas(image, owner)


def ownership(owner: Array, cover: Array, object_id: Array | int) -> Array:
    """Owner of each pixel after a layer of coverage by `quantize_cover` is painted over the current owners.

    An owner packs the id of an object into its low 8 bits, and the visible share of the pixel, up to FULL_COVER,
    above them. A layer scales the visible shares of everything below it by the same factor, so only the largest share
    is kept.
    """
    cover = cover.astype(jnp.int32)
    best = ((owner >> 8) * (FULL_COVER - cover) + FULL_COVER // 2) // FULL_COVER
    return jnp.where(cover > best, (cover << 8) | object_id, (best << 8) | (owner & 255))


def quantized_painter(linear: bool) -> Painter:
    """Painter of a `LayerCanvas`, which rounds each layer to integers."""

    def paint(canvas: LayerCanvas, cover: Array, color: Array | ShadedColor, object_id: Any) -> LayerCanvas:
        image, owner = canvas
        return LayerCanvas(
            None if image is None else over(image, quantize_cover(cover), quantize_color(color), linear),
            owner if owner is None or object_id is None else ownership(owner, quantize_cover(cover), object_id),
        )

    return paint


def float_painter(linear: bool, sigma: float = 0.0) -> Painter:
    """Painter of a float image in sRGB or linear light, without rounding; `sigma` (px) blurs each layer's coverage."""

    def paint(image: Array, cover: Array, color: Array | ShadedColor, object_id: Any) -> Array:
        cover, color = gaussian_blur(cover, sigma) if sigma else cover, as_color(color)
        return image + cover[..., None] * ((to_linear(color) if linear else color) - image)

    return paint


def gaussian_blur(cover: Array, sigma: float) -> Array:
    """Coverage [I, H, W] blurred by a Gaussian of standard deviation `sigma` (px), cut off at 4 sigma; edges repeat."""
    reach = math.ceil(4 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = jnp.asarray(kernel / kernel.sum(), cover.dtype)
    images = jnp.pad(cover, [(0, 0), (reach, reach), (reach, reach)], mode="edge")[:, None]
    for shape in ((1, 1, -1, 1), (1, 1, 1, -1)):
        images = jax.lax.conv(images, kernel.reshape(shape), (1, 1), "VALID")
    return images[:, 0]


# ---- Full-size layers


def background_image(scene: RenderScene, at: Instants, plan: FramePlan) -> Array:
    """Background [I, H, W, 3] in floats at the instants `at`; [1, H, W, 3] if it does not change."""
    background, first = scene.paint.background, scene.instants.view
    color, height, width = background.color, plan.height, plan.width
    if background.picture is not None and background.picture.pixels is not None:
        return background.picture.pixels.astype(jnp.float32)[None]
    if background.to_color is None and background.texture is None and background.corners is None:
        return jnp.broadcast_to(color, (1, height, width, 3))
    rows, columns = (jnp.arange(n, dtype=jnp.float32) + 0.5 for n in (height, width))
    rows, columns = (a.reshape(-1) for a in jnp.meshgrid(rows, columns, indexing="ij"))
    x, y = (a.reshape(-1, height, width) for a in to_world(at.view, columns, rows, height, width))
    if background.to_color is not None and background.direction is not None:
        # The gradient spans the view of the first frame.
        cos, sin = jnp.cos(background.direction), jnp.sin(background.direction)
        center, scale = first.center[0], first.scale[0]
        reach = (jnp.abs(cos) * width + jnp.abs(sin) * height) / (2 * scale)
        along = ((x - center[0]) * cos + (y - center[1]) * sin) / reach
        color = color + jnp.clip((along[..., None] + 1) / 2, 0, 1) * (background.to_color - color)
    if background.texture is not None:
        color = textured(color, background.texture, x, y, at.view.scale[:, None, None])
    if background.corners is not None:
        center, scale = first.center[0], first.scale[0]
        square = ((x - center[0]) * 2 * scale / width) ** 2 + ((y - center[1]) * 2 * scale / height) ** 2
        color = color + jnp.clip(square / 2, 0, 1)[..., None] * (background.corners - color)
    return jnp.broadcast_to(color, (*x.shape, 3))


def background_layer(scene: RenderScene, at: Instants, plan: FramePlan) -> LayerCanvas:
    """Canvas of the background alone at the instants `at`; its arrays are [1, ...] if they do not change."""
    return LayerCanvas(
        (background_image(scene, at, plan) + 0.5).astype(jnp.uint8) if plan.frames else None,
        jnp.full((1, plan.height, plan.width), NO_OWNER, jnp.int32) if plan.owners else None,
    )


def static_layer(scene: RenderScene, plan: FramePlan) -> LayerCanvas:
    """Canvas [1, ...] of the background and of static slots behind all moving ones, without occluders."""
    first = jax.tree.map(lambda a: a[:1], scene.instants)
    return paint_static(background_layer(scene, first, plan), scene, plan, first, quantized_painter(plan.linear))


def paint_static(canvas: Any, scene: RenderScene, plan: FramePlan, at: Instants, paint: Painter) -> Any:
    """Canvas with the static slots behind all moving ones painted over its full size, all over their shadows."""
    runs = plan.static_runs
    return _paint_runs(canvas, scene, plan, at, runs, paint, shaded=len(runs), layers=[])


def paint_moving(canvas: Any, scene: RenderScene, plan: FramePlan, at: Instants, paint: Painter) -> Any:
    """Canvas with all moving slots, their shadows and all occluders painted over its full size."""
    runs, layers = [span for group in plan.groups for span in group.runs], occluder_layers(scene, plan)
    canvas = _paint_runs(canvas, scene, plan, at, runs, paint, plan.shaded_first, layers)
    return paint_occluders(canvas, scene, layers, lambda rank: rank >= plan.moving, paint)


def _paint_runs(
    canvas: Any, scene: RenderScene, plan: FramePlan, at: Instants, runs: list[tuple[SlotGroup, int]], paint: Painter,
    shaded: int, layers: list[OccluderLayer],
) -> Any:  # fmt: skip
    """Canvas with the slots of `runs`, and the occluders between them, painted over its full size.

    The shadows of the first `shaded` runs lie below all slots, that of a later slot lies right below it. The loop over
    slots keeps the compiler from fusing terms that depend on a row or a column alone into the computation of each
    pixel: they are computed once, before the loop.
    """
    window, shadow = PixelWindow(0, 0, plan.height, plan.width), scene.paint.shadow

    def paint_shadow(canvas: Any, terms: ShadowTerms | None) -> tuple[Any, None]:
        if terms is None or shadow is None:
            return canvas, None
        return paint(canvas, shadow_cover(terms, window), shadow.color, None), None

    for run, first in runs[:shaded] if shadow is not None else []:
        canvas = jax.lax.scan(paint_shadow, canvas, shadow_terms(scene, plan, at, run, first, window))[0]
    rank = 0
    for number, (run, first) in enumerate(runs):
        slots = slice(first, first + run.count)

        def paint_run(
            canvas: Any, number: int = number, run: SlotGroup = run, first: int = first, slots: slice = slots,
            rank: int = rank,
        ) -> Any:  # fmt: skip
            def paint_slot(canvas: Any, entry: tuple[Any, ...]) -> tuple[Any, None]:
                terms, edges, fills, slot, rank = entry
                canvas = paint_occluders(canvas, scene, layers, lambda of: of == rank, paint)
                canvas, _ = paint_shadow(canvas, terms)
                return paint(canvas, *covered_color(edges, fills, window, plan.largest(run)), slot + 1), None

            terms, offsets = None, jnp.arange(run.count)
            if shadow is not None and number >= shaded:
                terms = shadow_terms(scene, plan, at, run, first, window)
            entries = run_edge_terms(scene, plan, at, run, first, window), fills_of(scene.paint, slots)
            return jax.lax.scan(paint_slot, canvas, (terms, *entries, first + offsets, rank + offsets))[0]

        needed = bool(layers) or scene.paint.drawn[slots].any()
        canvas = jax.lax.cond(needed, paint_run, lambda same: same, canvas)
        rank += run.count
    return canvas


def paint_occluders(
    canvas: Any, scene: RenderScene, layers: list[OccluderLayer], here: Callable[[Array], Array], paint: Painter
) -> Any:
    """Canvas with the occluders painted whose rank satisfies `here`, each over its shadow."""
    for i, layer in enumerate(layers):
        assert scene.occluders is not None
        shown = here(scene.occluders.rank[i])
        if layer.shadow is not None and scene.paint.shadow is not None:
            canvas = paint(canvas, jnp.where(shown, layer.shadow, 0.0), scene.paint.shadow.color, None)
        canvas = paint(canvas, jnp.where(shown, layer.cover, 0.0), layer.color, OCCLUDER)
    return canvas


def run_edge_terms(
    scene: RenderScene, plan: FramePlan, at: Instants, run: SlotGroup, first: int, window: PixelWindow
) -> EdgeTerms:
    """Edge terms of a run's slots in their windows at the instants `at`; arrays [k, I, ...].

    The loop over slots keeps the compiler from computing the parts again for each row and column.
    """
    parts = object_parts(run, first, scene.bodies, at, scene.paint, plan.height, plan.width)
    paint = scene.paint
    varied = any(part is not None for part in (paint.shade, paint.texture, paint.surface))
    corners = [jnp.broadcast_to(jnp.asarray(edge), parts.pose.column.shape) for edge in (window.top, window.left)]

    def sample(entry: tuple[Any, ...]) -> EdgeTerms:
        part, top, left = entry
        return edge_terms(part, PixelWindow(top, left, window.rows, window.columns), run.shape == "circle", varied)

    edges = jax.lax.map(sample, (parts, *corners))
    if paint.surface is None or paint.light is None:
        return edges
    surface = jax.tree.map(lambda a: a[first : first + run.count], paint.surface)
    relief = relief_of(run, first, scene.bodies, at, paint)
    return edges._replace(relief=relief, lit=lit_terms(paint.light, surface, relief, parts.pose))
