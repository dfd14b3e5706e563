"""Rendering on CPUs: each object is painted into a tile of its own size, one after the other.

Each step of the loops over videos, frames and objects touches little memory; `vmap` would turn them into scatters.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.compositing import (
    OCCLUDER,
    LayerCanvas,
    PackedColor,
    background_layer,
    occluder_layer,
    over,
    ownership,
    quantize_color,
    quantize_cover,
    run_edge_terms,
    static_layer,
)
from gen2d.renderers.plan import FramePlan, RenderScene, TileGroup, tile_windows
from gen2d.renderers.postprocessing import expose, exposure_average, exposure_start
from gen2d.renderers.primitives import Instants, PixelWindow
from gen2d.renderers.sensor import record
from gen2d.renderers.shading import EdgeTerms, covered_color, fills_of
from gen2d.renderers.shadows import ShadowTerms, shadow_cover, shadow_terms
from gen2d.xla import runtime_one


def draw_tiles(scenes: RenderScene, plan: FramePlan) -> tuple[Array | None, Array | None]:
    """Frames [n, T, H, W, 3] uint8 and owners [n, T, H, W] uint8, None if `plan` does not want them."""
    videos, frames = scenes.instants.angle.shape[:2]
    layers = jax.lax.map(functools.partial(static_layer, plan=plan), scenes)
    shape = videos, frames, plan.height, plan.width
    image = None if layers.image is None else jnp.broadcast_to(layers.image, (*shape, 3)).reshape(-1, *shape[2:], 3)
    owner = jnp.zeros((videos * frames, *shape[2:]), jnp.uint8) if plan.owners else None

    def video(v: Array, canvas: LayerCanvas) -> LayerCanvas:
        scene, layer = (
            jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, v, keepdims=False), tree)
            for tree in (scenes, layers)
        )
        renderer = _VideoRenderer(scene, plan, layer, v * frames)
        if plan.still and not plan.exposed:
            return renderer.paint_in_place(canvas)
        canvas = renderer.paint_separately(canvas) if plan.frames else canvas
        return renderer.paint_owners(canvas) if plan.owners else canvas

    with runtime_one((scenes.instants.view.scale[0, 0] > 0).astype(jnp.float32)):
        canvas = jax.lax.fori_loop(0, videos, video, LayerCanvas(image, owner))
    canvas = jax.tree.map(lambda a: a.reshape(videos, frames, *a.shape[1:]), canvas)
    return record(scenes.sensor, scenes.seed, canvas.image, canvas.owner, plan.height, plan.width)


class TileEdges(NamedTuple):
    """Edge terms of a group's slots in their tiles at all instants; arrays [k, I, ...]."""

    group: TileGroup
    window: PixelWindow
    of_runs: list[EdgeTerms]


class ShadowTiles(NamedTuple):
    """Shadows of a group's slots in their tiles at all instants; arrays [k, I, ...]."""

    group: TileGroup
    window: PixelWindow
    of_runs: list[ShadowTerms]


class TileCoverage(NamedTuple):
    """Quantised tiles of a group's k slots at one instant."""

    cover: Array  # [k, rows, columns] int16
    color: Any  # [k, rows or 1, columns or 1, 3] int16, or a PackedColor
    object_id: Array  # [k] slot + 1
    top: Array  # [k] first row
    left: Array  # [k] first column


class _VideoRenderer:
    """Renders one video, frame by frame, from frame `first` of a canvas on."""

    def __init__(self, scene: RenderScene, plan: FramePlan, back: LayerCanvas, first: Array) -> None:
        self.scene, self.plan, self.back, self.first = scene, plan, back, first
        self.frames = scene.instants.angle.shape[0]

    def paint_in_place(self, canvas: LayerCanvas) -> LayerCanvas:
        """Frames, and owners if wanted, painted in place: the canvas already holds the static layer of its frames."""
        edges = self._tile_edges(self.scene.instants)
        shadows = self._shadow_tiles(self.scene.instants)

        def frame(t: Array, canvas: LayerCanvas) -> LayerCanvas:
            image = self._paint_shadows(canvas.image, self.first + t, shadows, t)
            image, owner = self._paint_instant(LayerCanvas(image, self.back.owner), self.first + t, edges, t)
            return LayerCanvas(image, self._store_owner(canvas.owner, owner, t))

        return jax.lax.fori_loop(0, self.frames, frame, canvas)

    def paint_owners(self, canvas: LayerCanvas) -> LayerCanvas:
        """Owners alone, without frames."""
        edges = self._tile_edges(self.scene.instants)

        def frame(t: Array, canvas: LayerCanvas) -> LayerCanvas:
            start = self._background(self.scene.instants, t)._replace(image=None)
            owner = self._paint_instant(start, jnp.int32(0), edges, t).owner
            return LayerCanvas(canvas.image, self._store_owner(canvas.owner, owner, t))

        return jax.lax.fori_loop(0, self.frames, frame, canvas)

    def _store_owner(self, owners: Array | None, owner: Array | None, t: Array) -> Array | None:
        if owners is None or owner is None:
            return owners
        return jax.lax.dynamic_update_slice(owners, (owner & 255).astype(jnp.uint8), (self.first + t, 0, 0))

    def paint_separately(self, canvas: LayerCanvas) -> LayerCanvas:
        """Frames painted on a separate image: for motion blur or a moving camera."""
        scene, plan = self.scene, self.plan
        instants = scene.instants
        if scene.exposed is not None:
            instants = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), scene.exposed)
        samples, edges = max(plan.exposed, 1), self._tile_edges(instants)
        shadows = self._shadow_tiles(instants)

        def render_instant(i: Array) -> Array:
            start = self._paint_shadows(self._background(instants, i).image, jnp.int32(0), shadows, i)
            image = self._paint_instant(LayerCanvas(start, None), jnp.int32(0), edges, i).image
            assert image is not None
            return image

        def average_exposure(t: Array) -> Array:
            def add(s: Array, total: Array) -> Array:
                return expose(total, render_instant(t * samples + s), plan.linear)

            start = exposure_start((1, plan.height, plan.width, 3), plan.linear)
            return exposure_average(jax.lax.fori_loop(0, samples, add, start), samples, plan.linear)

        def frame(t: Array, canvas: LayerCanvas) -> LayerCanvas:
            image = average_exposure(t) if plan.exposed else render_instant(t)
            assert canvas.image is not None
            return LayerCanvas(
                jax.lax.dynamic_update_slice(canvas.image, image, (self.first + t, 0, 0, 0)), canvas.owner
            )

        return jax.lax.fori_loop(0, self.frames, frame, canvas)

    def _background(self, at: Instants, i: Array) -> LayerCanvas:
        """Canvas behind the moving slots at instant i."""
        if self.plan.still:
            return self.back
        return background_layer(
            self.scene, jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, i, 1), at), self.plan
        )

    def _tile_edges(self, at: Instants) -> list[TileEdges]:
        """Edge terms of each group at all instants."""
        edges = []
        for group in self.plan.groups:
            windows = [tile_windows(self.plan, group, at, run, first) for run, first in group.runs]
            pairs = zip(group.runs, windows, strict=True)
            samples = [run_edge_terms(self.scene, self.plan, at, run, first, window) for (run, first), window in pairs]
            top, left = (_concatenate([getattr(w, edge) for w in windows]) for edge in ("top", "left"))
            edges.append(TileEdges(group, PixelWindow(top, left, windows[0].rows, windows[0].columns), samples))
        return edges

    def _shadow_tiles(self, at: Instants) -> list[ShadowTiles]:
        """Shadows of each group at all instants."""
        tiles, shadow = [], self.scene.paint.shadow
        for group in self.plan.groups if shadow is not None else []:
            assert shadow is not None
            wider = group._replace(reach=group.reach + self.plan.blur)
            windows = [tile_windows(self.plan, wider, at, run, first, shadow.offset) for run, first in group.runs]
            pairs = zip(group.runs, windows, strict=True)
            terms = [shadow_terms(self.scene, self.plan, at, run, first, window) for (run, first), window in pairs]
            top, left = (_concatenate([getattr(w, edge) for w in windows]) for edge in ("top", "left"))
            tiles.append(ShadowTiles(wider, PixelWindow(top, left, windows[0].rows, windows[0].columns), terms))
        return tiles

    def _paint_shadows(self, image: Array | None, frame: Array, tiles: list[ShadowTiles], i: Array) -> Array | None:
        """Image with all shadows of moving slots at instant i painted into image `frame`."""
        shadow = self.scene.paint.shadow
        if shadow is None or image is None:
            return image
        color = quantize_color(shadow.color)

        def pick(a: Array) -> Array:
            return jax.lax.dynamic_index_in_dim(a, i, 1, keepdims=False)

        for group, window, of_runs in tiles:
            covers = [quantize_cover(shadow_cover(jax.tree.map(pick, terms), window)) for terms in of_runs]
            cover, top, left = _concatenate(covers), pick(window.top), pick(window.left)

            def paint(
                k: Array, canvas: LayerCanvas, cover: Array = cover, top: Array = top, left: Array = left
            ) -> LayerCanvas:
                corner = (frame, top[k], left[k])
                return self._paint_layer(canvas, jax.lax.dynamic_index_in_dim(cover, k), color, 0, corner)

            image = jax.lax.fori_loop(0, len(group.slots), paint, LayerCanvas(image, None)).image
        return image

    def _paint_instant(self, canvas: LayerCanvas, frame: Array, edges: list[TileEdges], i: Array) -> LayerCanvas:
        """Canvas with all moving slots at instant i painted into image `frame`; owners hold a single frame."""
        rank = 0
        for group_edges in edges:
            count = len(group_edges.group.slots)
            paint_slot = functools.partial(self._paint_slot, tiles=self._tile_coverage(group_edges, i), frame=frame)
            canvas = self._paint_slots(canvas, paint_slot, rank, count, frame)
            rank += count
        return canvas

    def _tile_coverage(self, edges: TileEdges, i: Array) -> TileCoverage:
        def pick(a: Array) -> Array:
            return jax.lax.dynamic_index_in_dim(a, i, 1, keepdims=False)

        covers, colors = [], []
        for (run, first), samples in zip(edges.group.runs, edges.of_runs, strict=True):
            fills = fills_of(self.scene.paint, slice(first, first + run.count))
            cover, color = covered_color(jax.tree.map(pick, samples), fills, edges.window, self.plan.largest(run))
            covers.append(quantize_cover(cover))
            colors.append(quantize_color(color))
        if not isinstance(colors[0], PackedColor):
            shape = jnp.broadcast_shapes(*(color.shape[1:] for color in colors))
            colors = [jnp.broadcast_to(color, (color.shape[0], *shape)) for color in colors]
        color = jax.tree.map(lambda *parts: _concatenate(list(parts)), *colors)
        ids = jnp.asarray(edges.group.slots, jnp.int32) + 1
        return TileCoverage(_concatenate(covers), color, ids, pick(edges.window.top), pick(edges.window.left))

    def _paint_slot(self, k: Array, canvas: LayerCanvas, tiles: TileCoverage, frame: Array) -> LayerCanvas:
        cover, color = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, k), (tiles.cover, tiles.color))
        return self._paint_layer(canvas, cover, color, tiles.object_id[k], (frame, tiles.top[k], tiles.left[k]))

    def _paint_layer(
        self, canvas: LayerCanvas, cover: Array, color: Any, object_id: Array | int, corner: tuple[Array, ...]
    ) -> LayerCanvas:
        """Canvas with a quantised layer [1, rows, columns] painted at a corner (frame, top, left)."""
        image, owner = canvas
        if image is not None:
            start = (*corner, 0)
            under = jax.lax.dynamic_slice(image, start, (*cover.shape, 3))
            image = jax.lax.dynamic_update_slice(image, over(under, cover, color, self.plan.linear), start)
        if owner is not None:
            start = (0, *corner[1:])
            under = jax.lax.dynamic_slice(owner, start, cover.shape)
            owner = jax.lax.dynamic_update_slice(owner, ownership(under, cover, object_id), start)
        return LayerCanvas(image, owner)

    def _paint_slots(
        self,
        canvas: LayerCanvas,
        paint_slot: Callable[[Array, LayerCanvas], LayerCanvas],
        rank: int,
        count: int,
        frame: Array,
    ) -> LayerCanvas:
        """Canvas after `count` tiles of ranks from `rank` on, and the occluders between them."""
        occluders = self.scene.occluders
        done: Array | int = 0
        if occluders is not None:
            is_last = rank + count == self.plan.moving  # also paints the occluders before all slots
            for i, below in enumerate(occluders.rank):
                until = jnp.clip(below - rank, 0, count)
                canvas = jax.lax.fori_loop(done, until, paint_slot, canvas)
                done = until
                shown = (below >= rank) & ((below < rank + count) | is_last)
                cover, color = occluder_layer(self.scene, self.plan, i, shown)
                cover, color, corner = quantize_cover(cover), quantize_color(color), (frame, jnp.int32(0), jnp.int32(0))
                canvas = self._paint_layer(canvas, cover, color, OCCLUDER, corner)
        return jax.lax.fori_loop(done, count, paint_slot, canvas)


def _concatenate(arrays: list[Array]) -> Array:
    return arrays[0] if len(arrays) == 1 else jnp.concatenate(arrays)
