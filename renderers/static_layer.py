"""The static layer on CPUs: each static object is painted into the blocks of the frame that it touches.

Walls are long and thin, so most pixels of a frame, and of a tile as large as the frame, are far from any wall. The
terms of rows and columns are those of the whole frame, so the pixels are those of `compositing.static_layer`.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.records.layout import SlotGroup
from gen2d.renderers.compositing import (
    LayerCanvas,
    background_layer,
    paint_tile,
    quantize_color,
    quantize_cover,
    run_edge_terms,
)
from gen2d.renderers.coverage import disc, polygon
from gen2d.renderers.extents import bounds_of
from gen2d.renderers.lighting import ShadedColor
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.renderers.primitives import Instants, PixelWindow, object_parts
from gen2d.renderers.shading import EdgeTerms, covered_color, fills_of
from gen2d.renderers.shadows import ShadowTerms, shadow_cover, shadow_terms
from gen2d.xla import materialize

SIDE = 16  # px, of a block

Layer = Callable[[Array, PixelWindow], tuple[Array, Any]]  # of a slot in a window: coverage and colour


class StaticRun(NamedTuple):
    """A static run at the first instant, and the bounds of its objects."""

    run: SlotGroup
    first: int
    bounds: Array  # [k, 4] px: left, top, right, bottom


def static_layer_by_blocks(scene: RenderScene, plan: FramePlan) -> LayerCanvas:
    """Canvas [1, ...] of the background and of static slots behind all moving ones, without occluders."""
    at = jax.tree.map(lambda a: a[:1], scene.instants)
    canvas, whole = background_layer(scene, at, plan), PixelWindow(0, 0, plan.height, plan.width)
    runs = [StaticRun(run, first, _bounds(scene, plan, at, run, first)) for run, first in plan.static_runs]
    shadow = scene.paint.shadow
    for run, first, bounds in runs if shadow is not None and plan.frames else []:
        assert shadow is not None
        terms = shadow_terms(scene, plan, at, run, first, whole)
        color = quantize_color(shadow.color)

        def shade(k: Array, window: PixelWindow, terms: ShadowTerms = terms, color: Array = color) -> Any:
            one = jax.tree.map(lambda a: a[k], terms)
            one = one._replace(column=one.column - window.left, row=one.row - window.top)
            return shadow_cover(one, window), color

        centers = object_parts(run, first, scene.bodies, at, scene.paint, plan.height, plan.width).pose
        moved = jnp.stack([terms.column - centers.column, terms.row - centers.row], -1)[:, 0]
        wide = jnp.concatenate([bounds[:, :2] + moved - terms.blur, bounds[:, 2:] + moved + terms.blur], -1)
        image = _paint_blocks(
            canvas._replace(owner=None), scene, plan, StaticRun(run, first, wide), shade, jnp.int32(-1)
        )
        canvas = canvas._replace(image=image.image)
    for run, first, bounds in runs:
        edges = run_edge_terms(scene, plan, at, run, first, whole)
        layer = functools.partial(_body, scene, plan, run, first, edges)
        canvas = _paint_blocks(canvas, scene, plan, StaticRun(run, first, bounds), layer, jnp.int32(first))
    return canvas


def _bounds(scene: RenderScene, plan: FramePlan, at: Instants, run: SlotGroup, first: int) -> Array:
    """Bounds [k, 4] px of a run's objects at the first instant."""
    parts = object_parts(run, first, scene.bodies, at, scene.paint, plan.height, plan.width)
    return bounds_of(parts.whole, run.shape == "circle")[:, 0]


def _body(
    scene: RenderScene, plan: FramePlan, run: SlotGroup, first: int, edges: EdgeTerms, k: Array, window: PixelWindow
) -> Any:
    """Coverage and colour of slot k of a run in a window."""
    fills = fills_of(scene.paint, slice(first, first + run.count))
    edges, fills = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, k, keepdims=False), (edges, fills))
    cover, color = covered_color(_part_of(edges, window), fills, window, plan.largest(run))
    if isinstance(color, ShadedColor):
        color = color._replace(share=materialize(color.share), accent_share=materialize(color.accent_share))
    return materialize(cover), quantize_color(color)


def _part_of(edges: EdgeTerms, window: PixelWindow) -> EdgeTerms:
    """Edge terms of the whole frame in a window."""

    def rows(tree: Any) -> Any:
        return jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, window.top, window.rows, -1), tree)

    def columns(tree: Any) -> Any:
        return jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, window.left, window.columns, -1), tree)

    def part(terms: Any) -> Any:
        if isinstance(terms, disc.PixelDisc):
            left, right, top, bottom, radius = terms
            return disc.PixelDisc(columns(left), columns(right), rows(top), rows(bottom), radius)
        if isinstance(terms, polygon.RoundedPolygon):
            arcs = [[polygon.CornerArc(*rows(arc[:4]), *columns(arc[4:])) for arc in arcs] for arcs in terms[2:]]
            return polygon.RoundedPolygon(columns(terms.x), rows(terms.lines), *arcs)
        return terms

    pose = edges.pose
    if pose is not None:
        pose = pose._replace(column=pose.column - window.left, row=pose.row - window.top)
    return edges._replace(whole=part(edges.whole), inner=part(edges.inner), mark=part(edges.mark), pose=pose)


def _paint_blocks(
    canvas: LayerCanvas, scene: RenderScene, plan: FramePlan, run: StaticRun, layer: Layer, first: Array
) -> LayerCanvas:
    """Canvas with the slots of a run painted, with ids from `first` + 1 on, into the blocks that their bounds touch."""
    sizes = plan.height, plan.width
    rows, columns = (min(SIDE, size) for size in sizes)
    blocks = jnp.asarray([-(-plan.width // columns), -(-plan.height // rows)])
    sides = jnp.asarray([columns, rows])
    begin = jnp.clip(jnp.floor(run.bounds[:, :2] / sides).astype(jnp.int32), 0, blocks)
    count = jnp.maximum(jnp.clip(jnp.floor(run.bounds[:, 2:] / sides).astype(jnp.int32) + 1, 0, blocks) - begin, 0)
    drawn = scene.paint.drawn[run.first : run.first + run.run.count]

    def paint_slot(k: Array, canvas: LayerCanvas) -> LayerCanvas:
        def paint_block(number: Array, canvas: LayerCanvas) -> LayerCanvas:
            block = begin[k] + jnp.stack([number % count[k, 0], number // count[k, 0]])
            left, top = block * sides
            # The last blocks of a frame that is no multiple of their size overlap those before them.
            corner = jnp.minimum(top, plan.height - rows), jnp.minimum(left, plan.width - columns)
            cover, color = layer(k, PixelWindow(*corner, rows, columns))
            new = (jnp.arange(rows)[:, None] >= top - corner[0]) & (jnp.arange(columns) >= left - corner[1])
            cover = quantize_cover(jnp.where(new, cover, 0.0))
            return paint_tile(canvas, cover, color, first + k + 1, (jnp.int32(0), *corner), plan.linear)

        return jax.lax.fori_loop(0, jnp.where(drawn[k], count[k].prod(), 0), paint_block, canvas)

    return jax.lax.fori_loop(0, run.run.count, paint_slot, canvas)
