"""Rendering on CPUs: each object is painted into a tile of its own size, one after the other.

Each step of the loops over videos, frames and objects touches little memory; `vmap` would turn them into scatters.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.compositing import (
    OCCLUDER,
    LayerCanvas,
    background_layer,
    cut_of,
    occluder,
    over,
    ownership,
    static_layer,
    to_ink,
    to_levels,
)
from gen2d.renderers.plan import FramePlan, RenderScene, TileGroup, tile_windows
from gen2d.renderers.postprocessing import add_noise, exposure_average
from gen2d.renderers.primitives import Instants, PixelWindow
from gen2d.renderers.shading import EdgeSamples, covered_color, fills_of


def draw_tiles(stages: RenderScene, plan: FramePlan) -> tuple[Array | None, Array | None]:
    """Frames [n, T, H, W, 3] uint8 and owners [n, T, H, W] uint8, None if `plan` does not want them."""
    videos, frames = stages.instants.angle.shape[:2]
    layers = jax.lax.map(functools.partial(static_layer, plan=plan), stages)
    shape = videos, frames, plan.height, plan.width
    image = None if layers.image is None else jnp.broadcast_to(layers.image, (*shape, 3)).reshape(-1, *shape[2:], 3)
    owner = jnp.zeros((videos * frames, *shape[2:]), jnp.uint8) if plan.owners else None

    def video(v: Array, canvas: LayerCanvas) -> LayerCanvas:
        stage, layer = (
            jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, v, keepdims=False), tree)
            for tree in (stages, layers)
        )
        renderer = _Video(stage, plan, layer, v * frames)
        if plan.still and not plan.exposed and stages.noise is None:
            return renderer.straight(canvas)
        canvas = renderer.apart(canvas) if plan.frames else canvas
        return renderer.owners(canvas) if plan.owners else canvas

    canvas = jax.lax.fori_loop(0, videos, video, LayerCanvas(image, owner))
    return tuple(jax.tree.map(lambda a: a.reshape(videos, frames, *a.shape[1:]), canvas))


class TileEdges(NamedTuple):
    """Edge samples of a group's slots in their tiles at all instants; arrays [k, I, ...]."""

    group: TileGroup
    window: PixelWindow
    of_runs: list[EdgeSamples]


class TileCoverage(NamedTuple):
    """Quantised tiles of a group's k slots at one instant."""

    cover: Array  # [k, rows, columns] int16
    color: Array  # [k, rows or 1, columns or 1, 3] int16
    name: Array  # [k] slot + 1
    top: Array  # [k] first row
    left: Array  # [k] first column


class _Video:
    """Renders one video, frame by frame, from frame `first` of a canvas on."""

    def __init__(self, stage: RenderScene, plan: FramePlan, back: LayerCanvas, first: Array) -> None:
        self.stage, self.plan, self.back, self.first = stage, plan, back, first
        self.frames = stage.instants.angle.shape[0]

    def straight(self, canvas: LayerCanvas) -> LayerCanvas:
        """Frames, and owners if wanted, painted in place: the canvas already holds the static layer of its frames."""
        edges = self._cuts(self.stage.instants)

        def frame(t: Array, canvas: LayerCanvas) -> LayerCanvas:
            image, owner = self._painted(LayerCanvas(canvas.image, self.back.owner), self.first + t, edges, t)
            return LayerCanvas(image, self._kept(canvas.owner, owner, t))

        return jax.lax.fori_loop(0, self.frames, frame, canvas)

    def owners(self, canvas: LayerCanvas) -> LayerCanvas:
        """Owners alone, without frames."""
        edges = self._cuts(self.stage.instants)

        def frame(t: Array, canvas: LayerCanvas) -> LayerCanvas:
            start = self._behind(self.stage.instants, t)._replace(image=None)
            owner = self._painted(start, jnp.int32(0), edges, t).owner
            return LayerCanvas(canvas.image, self._kept(canvas.owner, owner, t))

        return jax.lax.fori_loop(0, self.frames, frame, canvas)

    def _kept(self, owners: Array | None, owner: Array | None, t: Array) -> Array | None:
        if owners is None or owner is None:
            return owners
        return jax.lax.dynamic_update_slice(owners, (owner & 255).astype(jnp.uint8), (self.first + t, 0, 0))

    def apart(self, canvas: LayerCanvas) -> LayerCanvas:
        """Frames painted on a separate image: for motion blur, a moving camera, or noise."""
        stage, plan = self.stage, self.plan
        instants = stage.instants if stage.exposed is None else jax.tree.map(_flat, stage.exposed)
        samples, edges = max(plan.exposed, 1), self._cuts(instants)

        def render_instant(i: Array) -> Array:
            image = self._painted(self._behind(instants, i)._replace(owner=None), jnp.int32(0), edges, i).image
            assert image is not None
            return image

        def average_exposure(t: Array) -> Array:
            def add(s: Array, total: Array) -> Array:
                return total + render_instant(t * samples + s).astype(jnp.uint16)

            total = jnp.zeros((1, plan.height, plan.width, 3), jnp.uint16)
            return exposure_average(jax.lax.fori_loop(0, samples, add, total), samples)

        def frame(t: Array, canvas: LayerCanvas) -> LayerCanvas:
            image = average_exposure(t) if plan.exposed else render_instant(t)
            if stage.noise is not None:
                image = add_noise(image, stage.noise, stage.seed, t[None])
            assert canvas.image is not None
            return LayerCanvas(
                jax.lax.dynamic_update_slice(canvas.image, image, (self.first + t, 0, 0, 0)), canvas.owner
            )

        return jax.lax.fori_loop(0, self.frames, frame, canvas)

    def _behind(self, at: Instants, i: Array) -> LayerCanvas:
        """Canvas behind the moving slots at instant i."""
        if self.plan.still:
            return self.back
        return background_layer(
            self.stage, jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, i, 1), at), self.plan
        )

    def _cuts(self, at: Instants) -> list[TileEdges]:
        """Edge samples of each group at all instants."""
        edges = []
        for group in self.plan.groups:
            windows = [tile_windows(self.plan, group, at, run, first) for run, first in group.runs]
            pairs = zip(group.runs, windows, strict=True)
            samples = [cut_of(self.stage, self.plan, at, run, first, window) for (run, first), window in pairs]
            top, left = (_joined([getattr(w, edge) for w in windows]) for edge in ("top", "left"))
            edges.append(TileEdges(group, PixelWindow(top, left, windows[0].rows, windows[0].columns), samples))
        return edges

    def _painted(self, canvas: LayerCanvas, frame: Array, cuts: list[TileEdges], i: Array) -> LayerCanvas:
        """Canvas with all moving slots at instant i painted into image `frame`; owners hold a single frame."""
        rank = 0
        for group_edges in cuts:
            count = len(group_edges.group.slots)
            stroke = functools.partial(self._stroke, strokes=self._strokes(group_edges, i), frame=frame)
            canvas = self._interleaved(canvas, stroke, rank, count, frame)
            rank += count
        return canvas

    def _strokes(self, cuts: TileEdges, i: Array) -> TileCoverage:
        def pick(a: Array) -> Array:
            return jax.lax.dynamic_index_in_dim(a, i, 1, keepdims=False)

        covers, colors = [], []
        for (run, first), samples in zip(cuts.group.runs, cuts.of_runs, strict=True):
            fills = fills_of(self.stage.paint, slice(first, first + run.count))
            cover, color = covered_color(jax.tree.map(pick, samples), fills, cuts.window, self.plan.largest(run))
            covers.append(to_levels(cover))
            colors.append(to_ink(color))
        shape = jnp.broadcast_shapes(*(color.shape[1:] for color in colors))
        colors = [jnp.broadcast_to(color, (color.shape[0], *shape)) for color in colors]
        names = jnp.asarray(cuts.group.slots, jnp.int32) + 1
        return TileCoverage(_joined(covers), _joined(colors), names, pick(cuts.window.top), pick(cuts.window.left))

    def _stroke(self, k: Array, canvas: LayerCanvas, strokes: TileCoverage, frame: Array) -> LayerCanvas:
        cover, color = (jax.lax.dynamic_index_in_dim(a, k) for a in (strokes.cover, strokes.color))
        return self._put(canvas, cover, color, strokes.name[k], frame, strokes.top[k], strokes.left[k])

    def _put(
        self, canvas: LayerCanvas, cover: Array, color: Array, name: Array | int, frame: Array, top: Array, left: Array
    ) -> LayerCanvas:
        """Canvas with a quantised layer [1, rows, columns] painted at (frame, top, left)."""
        image, owner = canvas
        if image is not None:
            start = (frame, top, left, 0)
            under = jax.lax.dynamic_slice(image, start, (*cover.shape, 3))
            image = jax.lax.dynamic_update_slice(image, over(under, cover, color, self.plan.linear), start)
        if owner is not None:
            start = (0, top, left)
            under = jax.lax.dynamic_slice(owner, start, cover.shape)
            owner = jax.lax.dynamic_update_slice(owner, ownership(under, cover, name), start)
        return LayerCanvas(image, owner)

    def _interleaved(
        self,
        canvas: LayerCanvas,
        stroke: Callable[[Array, LayerCanvas], LayerCanvas],
        rank: int,
        count: int,
        frame: Array,
    ) -> LayerCanvas:
        """Canvas after `count` strokes of ranks from `rank` on, and the occluders between them."""
        occluders = self.stage.occluders
        done: Array | int = 0
        if occluders is not None:
            is_last = rank + count == self.plan.moving  # also paints the occluders before all slots
            for i, below in enumerate(occluders.rank):
                until = jnp.clip(below - rank, 0, count)
                canvas = jax.lax.fori_loop(done, until, stroke, canvas)
                done = until
                shown = (below >= rank) & ((below < rank + count) | is_last)
                cover, color = occluder(self.stage, self.plan, i, shown)
                canvas = self._put(canvas, to_levels(cover), to_ink(color), OCCLUDER, frame, jnp.int32(0), jnp.int32(0))
        return jax.lax.fori_loop(done, count, stroke, canvas)


def _flat(a: Array) -> Array:
    return a.reshape(-1, *a.shape[2:])


def _joined(arrays: list[Array]) -> Array:
    return arrays[0] if len(arrays) == 1 else jnp.concatenate(arrays)
