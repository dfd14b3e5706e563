"""Surfaces that pixels show, at their centres: heights and normals of the objects that own them.

As the rasterizer, it has two forms: on a CPU each object is written into a tile of its own size, on a GPU each pixel
evaluates every object.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array
from gen2d.records.layout import SlotGroup
from gen2d.renderers.compositing import OCCLUDER, static_layer
from gen2d.renderers.occluders import over_occluders
from gen2d.renderers.plan import FramePlan, RenderScene, tile_windows
from gen2d.renderers.primitives import ImagePose, Instants, PixelWindow, object_parts
from gen2d.renderers.relief import Relief, SurfacePoints, relief_of, surface_points
from gen2d.xla import on_cpu

Measure = Callable[[SurfacePoints], Any]  # arrays of the same shape from surfaces, elementwise
_ZERO: Any = np.float32(0)  # of NumPy: jax would choose its devices here
FLAT = SurfacePoints(_ZERO, _ZERO, _ZERO)


class SurfaceTerms(NamedTuple):
    """Surfaces of some slots; arrays [k, I, ...]."""

    relief: Relief
    pose: ImagePose  # relative to the window
    slope: Array
    bevel: Array


def visible_surfaces(scenes: RenderScene, owners: Array, plan: FramePlan, measure: Measure) -> Any:
    """Results [n, T, H, W] of `measure` on the surface that each pixel shows, by owners [n, T, H, W].

    The background is flat, with a height of 0. Raises AssertionError for paint without a surface.
    """
    values = (_by_tiles if on_cpu() else _by_pixels)(scenes, owners, plan, measure)

    def video(scene: RenderScene, shown: Array, values: Any) -> Any:
        return over_occluders(scene, plan, shown, values, measure)

    return jax.vmap(video)(scenes, owners == OCCLUDER, values)


def _by_pixels(scenes: RenderScene, owners: Array, plan: FramePlan, measure: Measure) -> Any:
    """The form for GPUs."""

    def video(scene: RenderScene, owner: Array) -> Any:
        return _over_slots(scene, owner, plan, scene.instants, [*plan.layout.spans], measure)

    return jax.vmap(video)(scenes, owners)


def _by_tiles(scenes: RenderScene, owners: Array, plan: FramePlan, measure: Measure) -> Any:
    """The form for CPUs: the static layer's surfaces, then those of each object in its tile."""
    (count, frames), shown = owners.shape[:2], owners.reshape(-1, *owners.shape[2:])
    static, static_owners = jax.lax.map(functools.partial(_static_surfaces, plan=plan, measure=measure), scenes)

    def spread(flat: Array, values: Array) -> Array:
        seen = (owners == static_owners[:, None]) & (owners > 0)
        return jnp.where(seen, values[:, None], flat).reshape(shown.shape)

    def video(v: Array, values: Any) -> Any:
        scene = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, v, keepdims=False), scenes)
        for group in plan.groups:
            for run, first in group.runs:
                window = tile_windows(plan, group, scene.instants, run, first)
                terms = _terms(scene, plan, scene.instants, run, first, window)
                write = functools.partial(_write_tile, shown=shown, terms=terms, window=window, measure=measure)

                def frame(t: Array, values: Any, run: SlotGroup = run, first: int = first, write: Any = write) -> Any:
                    def write_slot(k: Array, values: Any) -> Any:
                        return write(values, v * frames + t, k, t, first + k + 1)

                    return jax.lax.fori_loop(0, run.count, write_slot, values)

                values = jax.lax.fori_loop(0, frames, frame, values)
        return values

    values = jax.lax.fori_loop(0, count, video, jax.tree.map(spread, measure(FLAT), static))
    return jax.tree.map(lambda a: a.reshape(owners.shape), values)


def _write_tile(
    values: Any, image: Array, k: Array, t: Array, owner: Array, *,
    shown: Array, terms: SurfaceTerms, window: PixelWindow, measure: Measure,
) -> Any:  # fmt: skip
    """`values` with the surface of slot k of a run written at the pixels of an image that show it, at instant t."""
    one = jax.tree.map(lambda a: a[k, t], terms)
    start = (image, window.top[k, t], window.left[k, t])
    tile = measure(_points(one, window))
    owned = jax.lax.dynamic_slice(shown, start, (1, window.rows, window.columns)) == owner.astype(jnp.uint8)

    def write(old: Array, new: Array) -> Array:
        under = jax.lax.dynamic_slice(old, start, owned.shape)
        return jax.lax.dynamic_update_slice(old, jnp.where(owned, new[None], under), start)

    return jax.tree.map(write, values, tile)


def _static_surfaces(scene: RenderScene, plan: FramePlan, measure: Measure) -> tuple[Any, Array]:
    """Surfaces [H, W] of the static layer, and its owners [H, W]."""
    owner = static_layer(scene, dataclasses.replace(plan, frames=False, owners=True)).owner
    assert owner is not None
    owner, first = (owner & 255).astype(jnp.uint8), jax.tree.map(lambda a: a[:1], scene.instants)
    values = _over_slots(scene, owner, plan, first, plan.static_runs, measure)
    return jax.tree.map(lambda a: a[0], values), owner[0]


def _over_slots(
    scene: RenderScene, owner: Array, plan: FramePlan, at: Instants, runs: list[tuple[SlotGroup, int]], measure: Measure
) -> Any:
    """Surfaces [I, H, W] of the slots of `runs` where they own the pixel [I, H, W], each evaluated at every pixel."""
    window = PixelWindow(0, 0, plan.height, plan.width)
    values = jax.tree.map(lambda flat: jnp.broadcast_to(flat, owner.shape), measure(FLAT))

    def over(values: Any, entry: tuple[SurfaceTerms, Array]) -> tuple[Any, None]:
        terms, number = entry
        tile = measure(_points(terms, window))
        return jax.tree.map(lambda old, new: jnp.where(owner == number, new, old), values, tile), None

    for run, first in runs:
        numbers = jnp.arange(first + 1, first + run.count + 1, dtype=jnp.int32)
        values = jax.lax.scan(over, values, (_terms(scene, plan, at, run, first, window), numbers))[0]
    return values


def _terms(
    scene: RenderScene, plan: FramePlan, at: Instants, run: SlotGroup, first: int, window: PixelWindow
) -> SurfaceTerms:
    """Terms of a run's slots in their windows at the instants `at`."""
    surface, slots = scene.paint.surface, slice(first, first + run.count)
    assert surface is not None, "the look paints no surface"
    pose = object_parts(run, first, scene.bodies, at, scene.paint, plan.height, plan.width).pose
    pose = pose._replace(column=pose.column - window.left, row=pose.row - window.top)
    each = [jnp.broadcast_to(a[slots, None], pose.column.shape) for a in (surface.slope, surface.bevel)]
    return SurfaceTerms(relief_of(run, first, scene.bodies, at, scene.paint), pose, *each)


def _points(terms: SurfaceTerms, window: PixelWindow) -> SurfacePoints:
    """Surfaces at the pixels of windows [..., rows, columns]."""
    relief, pose, slope, bevel = terms
    x = (jnp.arange(window.columns) + 0.5 - pose.column[..., None])[..., None, :]
    y = (jnp.arange(window.rows) + 0.5 - pose.row[..., None])[..., :, None]
    return surface_points(relief, pose, slope, bevel, x, y)
