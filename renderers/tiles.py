"""Rendering on CPUs: each object is painted into a tile of its own size, one after the other.

Each step of the loops over videos, frames and objects touches little memory; `vmap` would turn them into scatters.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.records.layout import SlotGroup
from gen2d.renderers.compositing import (
    OCCLUDER,
    LayerCanvas,
    PackedColor,
    background_layer,
    paint_tile,
    quantize_color,
    quantize_cover,
    run_edge_terms,
)
from gen2d.renderers.lighting import ShadedColor
from gen2d.renderers.occluders import occluder_layers
from gen2d.renderers.plan import FramePlan, RenderScene, tile_windows
from gen2d.renderers.postprocessing import expose, exposure_average, exposure_start
from gen2d.renderers.primitives import Instants, PixelWindow
from gen2d.renderers.sensor import record
from gen2d.renderers.shading import covered_color, fills_of
from gen2d.renderers.shadows import ShadowTerms, shadow_cover, shadow_terms
from gen2d.renderers.static_layer import static_layer_by_blocks
from gen2d.xla import runtime_one

BLOCK = 16  # instants whose tiles are computed at once
BLOCK_PIXELS = 2**16  # largest number of pixels of all their tiles


def draw_tiles(scenes: RenderScene, plan: FramePlan) -> tuple[Array | None, Array | None]:
    """Frames [n, T, H, W, 3] uint8 and owners [n, T, H, W] uint8, None if `plan` does not want them."""
    videos, frames = scenes.instants.angle.shape[:2]
    one = (scenes.instants.view.scale[0, 0] > 0).astype(jnp.float32)
    with runtime_one(one):
        layers = jax.lax.map(functools.partial(static_layer_by_blocks, plan=plan), scenes)
    shape = videos, frames, plan.height, plan.width
    image = None if layers.image is None else jnp.broadcast_to(layers.image, (*shape, 3)).reshape(-1, *shape[2:], 3)
    owner = jnp.zeros((videos * frames, *shape[2:]), jnp.uint8) if plan.owners else None

    def video(v: Array, canvas: LayerCanvas) -> LayerCanvas:
        scene, layer = (
            jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, v, keepdims=False), tree)
            for tree in (scenes, layers)
        )
        start = v * frames
        if plan.still and not plan.exposed:
            return _VideoRenderer(scene, plan, layer, start, scene.instants).paint_in_place(canvas)
        if plan.frames:
            instants = scene.instants
            if scene.exposed is not None:
                instants = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), scene.exposed)
            canvas = _VideoRenderer(scene, plan, layer, start, instants).paint_separately(canvas)
        if plan.owners:
            alone = dataclasses.replace(plan, frames=False)
            canvas = _VideoRenderer(scene, alone, layer, start, scene.instants).paint_owners(canvas)
        return canvas

    with runtime_one(one):
        canvas = jax.lax.fori_loop(0, videos, video, LayerCanvas(image, owner))
    canvas = jax.tree.map(lambda a: a.reshape(videos, frames, *a.shape[1:]), canvas)
    return record(scenes.sensor, scenes.seed, canvas.image, canvas.owner, plan.height, plan.width)


class RunTiles(NamedTuple):
    """Terms of a run's slots in their tiles at all instants; arrays [k, I, ...]."""

    run: SlotGroup
    first: int  # slot
    window: PixelWindow
    terms: Any  # EdgeTerms or ShadowTerms
    color: Any  # [k, 1, 1, 3] int16, of slots and of their highlights if they have any


class TileLayers(NamedTuple):
    """Quantised tiles of a run's k slots at the B instants of a block."""

    cover: Array  # [k, B, rows, columns] int16
    color: (
        Array | None
    )  # [k, B, rows, columns, 3] int16, or [k, B, rows, columns] shares of a PackedColor; None: constant


class _VideoRenderer:
    """Renders one video, frame by frame, from frame `first` of a canvas on; `at` are the instants of its images."""

    def __init__(self, scene: RenderScene, plan: FramePlan, back: LayerCanvas, first: Array, at: Instants) -> None:
        self.scene, self.plan, self.back, self.first, self.at = scene, plan, back, first, at
        self.frames = scene.instants.angle.shape[0]
        self.tiles, self.shadows = self._edge_tiles(), self._shadow_tiles()
        self.occluders = occluder_layers(scene, plan)

    def paint_in_place(self, canvas: LayerCanvas) -> LayerCanvas:
        """Frames, and owners if wanted, painted in place: the canvas already holds the static layer of its frames."""

        def frame(t: Array, canvas: LayerCanvas, layers: list[TileLayers], place: Array) -> LayerCanvas:
            start = LayerCanvas(canvas.image, self.back.owner)
            image, owner = self._paint_slots(start, self.first + t, layers, t, place)
            return LayerCanvas(image, self._store_owner(canvas.owner, owner, t))

        return self._each_instant(jnp.int32(0), self.frames, frame, canvas)

    def paint_owners(self, canvas: LayerCanvas) -> LayerCanvas:
        """Owners alone, without frames."""

        def frame(t: Array, canvas: LayerCanvas, layers: list[TileLayers], place: Array) -> LayerCanvas:
            start = self._background(t)._replace(image=None)
            owner = self._paint_slots(start, jnp.int32(0), layers, t, place).owner
            return LayerCanvas(canvas.image, self._store_owner(canvas.owner, owner, t))

        return self._each_instant(jnp.int32(0), self.frames, frame, canvas)

    def _store_owner(self, owners: Array | None, owner: Array | None, t: Array) -> Array | None:
        if owners is None or owner is None:
            return owners
        return jax.lax.dynamic_update_slice(owners, (owner & 255).astype(jnp.uint8), (self.first + t, 0, 0))

    def paint_separately(self, canvas: LayerCanvas) -> LayerCanvas:
        """Frames painted on a separate image: for motion blur or a moving camera."""
        plan, samples = self.plan, max(self.plan.exposed, 1)

        def render_instant(i: Array, layers: list[TileLayers], place: Array) -> Array:
            start = self._background(i)._replace(owner=None)
            image = self._paint_slots(start, jnp.int32(0), layers, i, place).image
            assert image is not None
            return image

        def store(t: Array, canvas: LayerCanvas, image: Array) -> LayerCanvas:
            assert canvas.image is not None
            return LayerCanvas(
                jax.lax.dynamic_update_slice(canvas.image, image, (self.first + t, 0, 0, 0)), canvas.owner
            )

        def frame(t: Array, canvas: LayerCanvas, layers: list[TileLayers], place: Array) -> LayerCanvas:
            return store(t, canvas, render_instant(t, layers, place))

        def exposed_frame(t: Array, canvas: LayerCanvas) -> LayerCanvas:
            def add(i: Array, total: Array, layers: list[TileLayers], place: Array) -> Array:
                return expose(total, render_instant(i, layers, place), plan.linear)

            start = exposure_start((1, plan.height, plan.width, 3), plan.linear)
            total = self._each_instant(t * samples, samples, add, start)
            return store(t, canvas, exposure_average(total, samples, plan.linear))

        if plan.exposed:
            return jax.lax.fori_loop(0, self.frames, exposed_frame, canvas)
        return self._each_instant(jnp.int32(0), self.frames, frame, canvas)

    def _background(self, i: Array) -> LayerCanvas:
        """Canvas behind the moving slots at instant i."""
        if self.plan.still:
            return self.back
        now = jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, i, 1), self.at)
        return background_layer(self.scene, now, self.plan)

    def _edge_tiles(self) -> list[RunTiles]:
        """Edge terms of each run at all instants."""
        tiles = []
        for group in self.plan.groups:
            for run, first in group.runs:
                window = tile_windows(self.plan, group, self.at, run, first)
                terms = run_edge_terms(self.scene, self.plan, self.at, run, first, window)
                fills = fills_of(self.scene.paint, slice(first, first + run.count))
                colors = [
                    quantize_color(part[:, None, None]) for part in (fills.color, fills.accent) if part is not None
                ]
                tiles.append(RunTiles(run, first, window, terms, colors))
        return tiles

    def _shadow_tiles(self) -> list[RunTiles]:
        """Shadows of each run at all instants; none without frames."""
        tiles, shadow = [], self.scene.paint.shadow
        for group in self.plan.groups if shadow is not None and self.plan.frames else []:
            assert shadow is not None
            wider = group._replace(reach=group.reach + self.plan.blur)
            for run, first in group.runs:
                window = tile_windows(self.plan, wider, self.at, run, first, shadow.offset)
                terms = shadow_terms(self.scene, self.plan, self.at, run, first, window)
                color = quantize_color(jnp.broadcast_to(shadow.color, (run.count, 1, 1, 3)))
                tiles.append(RunTiles(run, first, window, terms, [color]))
        return tiles

    def _each_instant(self, begin: Array, count: int, paint: Callable[..., Any], canvas: Any) -> Any:
        """Canvas after `paint(i, canvas, layers, place)` at `count` instants i from `begin` on, one after the other.

        The layers of a block of instants are computed at once, as long loops are faster; `place` is that in the block.
        """
        tiles = [*self.tiles, *self.shadows]
        pixels = sum(each.run.count * each.window.rows * each.window.columns for each in tiles)
        size = min(max(BLOCK_PIXELS // max(pixels, 1), 1), BLOCK, count)

        def empty(each: RunTiles) -> TileLayers:
            layer = jax.eval_shape(lambda: self._layer(each, jnp.int32(0), begin, size))
            return jax.tree.map(lambda a: jnp.zeros((each.run.count, *a.shape), a.dtype), layer)

        def block(number: Array, carry: tuple[Any, list[TileLayers]]) -> tuple[Any, list[TileLayers]]:
            canvas, layers = carry
            done = jnp.minimum(number * size, count - size)  # the last block overlaps the one before it
            layers = [self._filled(old, each, begin + done, size) for old, each in zip(layers, tiles, strict=True)]

            def paint_one(i: Array, canvas: Any) -> Any:
                return paint(begin + i, canvas, layers, i - done)

            until = jnp.minimum((number + 1) * size, count)
            return jax.lax.fori_loop(number * size, until, paint_one, canvas), layers

        return jax.lax.fori_loop(0, -(-count // size), block, (canvas, [empty(each) for each in tiles]))[0]

    def _filled(self, layers: TileLayers, tiles: RunTiles, begin: Array, size: int) -> TileLayers:
        """`layers` with those of the slots that are rendered, at `size` instants from `begin` on."""

        def fill(k: Array, layers: TileLayers) -> TileLayers:
            layer = self._layer(tiles, k, begin, size)
            return jax.tree.map(lambda old, new: jax.lax.dynamic_update_index_in_dim(old, new, k, 0), layers, layer)

        return jax.lax.fori_loop(0, self._drawn(tiles), fill, layers)

    def _layer(self, tiles: RunTiles, k: Array, begin: Array, size: int) -> TileLayers:
        """Tiles [B, ...] of slot k of a run."""

        def of_slot(a: Array) -> Array:
            return jax.lax.dynamic_index_in_dim(a, k, keepdims=False)

        terms = jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(of_slot(a), begin, size), tiles.terms)
        if isinstance(terms, ShadowTerms):
            return TileLayers(quantize_cover(shadow_cover(terms, tiles.window)), None)
        fills = fills_of(self.scene.paint, slice(tiles.first, tiles.first + tiles.run.count))
        cover, color = covered_color(terms, jax.tree.map(of_slot, fills), tiles.window, self.plan.largest(tiles.run))
        if isinstance(color, ShadedColor):
            return TileLayers(quantize_cover(cover), quantize_color(color).shares)
        return TileLayers(quantize_cover(cover), None if color.ndim == 3 else quantize_color(color))

    def _drawn(self, tiles: RunTiles) -> Array:
        """Number of slots of a run up to the last one that is rendered: absent objects are at its end."""
        drawn = self.scene.paint.drawn[tiles.first : tiles.first + tiles.run.count]
        return jnp.max(jnp.where(drawn, jnp.arange(1, tiles.run.count + 1), 0))

    def _paint_slots(
        self, canvas: LayerCanvas, frame: Array, layers: list[TileLayers], i: Array, place: Array
    ) -> LayerCanvas:
        """Canvas with all moving slots at instant i, each over its shadow, painted into image `frame`; owners hold a
        single frame."""
        paint_slot = functools.partial(self._paint_slot, i=i, place=place, frame=frame)
        shadows = [
            functools.partial(self._paint_shadow, paint_slot, *of)
            for of in zip(self.shadows, layers[len(self.tiles) :], strict=True)
        ]
        shaded = self.plan.shaded_first
        for tiles, paint_shadow in zip(self.tiles, shadows[:shaded], strict=False):
            canvas = jax.lax.fori_loop(0, self._drawn(tiles), paint_shadow, canvas)
        rank = 0
        for number, (tiles, of_run) in enumerate(zip(self.tiles, layers, strict=False)):  # those of shadows follow
            shadow = shadows[number] if shadows and number >= shaded else None

            def paint(
                k: Array, canvas: LayerCanvas, tiles: Any = tiles, layers: Any = of_run, shadow: Any = shadow
            ) -> LayerCanvas:
                canvas = canvas if shadow is None else shadow(k, canvas)
                return paint_slot(k, canvas, tiles=tiles, layers=layers)

            canvas = self._paint_run(canvas, paint, rank, tiles, frame)
            rank += tiles.run.count
        return canvas

    @staticmethod
    def _paint_shadow(
        paint_slot: Callable[..., LayerCanvas], tiles: RunTiles, layers: TileLayers, k: Array, canvas: LayerCanvas
    ) -> LayerCanvas:
        """Canvas with the shadow of slot k of a run, which owns no pixel."""

        def paint(_: Any, image: Array) -> Array:
            painted = paint_slot(k, LayerCanvas(image, None), tiles=tiles, layers=layers).image
            assert painted is not None
            return painted

        if canvas.image is None:
            return canvas
        if canvas.owner is None:
            return canvas._replace(image=paint(0, canvas.image))
        # In a loop of its own: of two updates in a row, XLA copies the whole canvas if it also has owners.
        return canvas._replace(image=jax.lax.fori_loop(0, jnp.minimum(k + 1, 1), paint, canvas.image))

    def _paint_slot(
        self, k: Array, canvas: LayerCanvas, tiles: RunTiles, layers: TileLayers, i: Array, place: Array, frame: Array
    ) -> LayerCanvas:
        def pick(a: Array) -> Array:
            return jax.lax.dynamic_slice(a, (k, place, *[0] * (a.ndim - 2)), (1, 1, *a.shape[2:]))[0]

        cover, color = pick(layers.cover), None if layers.color is None else pick(layers.color)
        constant = [jax.lax.dynamic_index_in_dim(part, k) for part in tiles.color]
        if color is None:
            color = constant[0]
        elif color.ndim == 3:
            color = PackedColor(constant[0], constant[1], color)
        corner = (frame, tiles.window.top[k, i], tiles.window.left[k, i])
        return paint_tile(canvas, cover, color, tiles.first + k + 1, corner, self.plan.linear)

    def _paint_run(
        self,
        canvas: LayerCanvas,
        paint_slot: Callable[[Array, LayerCanvas], LayerCanvas],
        rank: int,
        tiles: RunTiles,
        frame: Array,
    ) -> LayerCanvas:
        """Canvas after the tiles of a run, of ranks from `rank` on, and the occluders between them."""
        count, drawn = tiles.run.count, self._drawn(tiles)
        occluders = self.scene.occluders
        done = jnp.int32(0)
        if occluders is not None:
            is_last = rank + count == self.plan.moving  # also paints the occluders before all slots
            for i, below in enumerate(occluders.rank):
                until = jnp.clip(below - rank, 0, count)
                canvas = jax.lax.fori_loop(done, jnp.minimum(until, drawn), paint_slot, canvas)
                done = until
                shown = (below >= rank) & ((below < rank + count) | is_last)
                paint_occluder = functools.partial(self._paint_occluder, i, frame)
                canvas = jax.lax.fori_loop(0, shown.astype(jnp.int32), paint_occluder, canvas)
        return jax.lax.fori_loop(done, drawn, paint_slot, canvas)

    def _paint_occluder(self, i: int, frame: Array, _: Array, canvas: LayerCanvas) -> LayerCanvas:
        """Canvas with an occluder painted over its shadow into image `frame`."""
        (cover, color, opacity), shadow, image = self.occluders[i], self.scene.paint.shadow, canvas.image
        corner = jnp.int32(0), jnp.int32(0), jnp.int32(0)
        if image is not None:
            # Both layers in one piece: of two updates of the same place in a row, XLA copies the whole canvas.
            start = (frame, *corner)
            under = LayerCanvas(jax.lax.dynamic_slice(image, start, (*cover.shape, 3)), None)
            for layer, fill in ((opacity, None if shadow is None else shadow.color), (cover, color)):
                if layer is not None and fill is not None:
                    tile = quantize_cover(layer), quantize_color(fill)
                    under = paint_tile(under, *tile, OCCLUDER, corner, self.plan.linear)
            assert under.image is not None
            image = jax.lax.dynamic_update_slice(image, under.image, start)
        owner = LayerCanvas(None, canvas.owner)
        owner = paint_tile(owner, quantize_cover(cover), color, OCCLUDER, corner, self.plan.linear).owner
        return LayerCanvas(image, owner)
