"""Rasterizer: render scenes to uint8 frames and owners, back to front, on the device.

An object's colour contributes to a pixel in proportion to the exact area that the object covers (coverage/). Blending
uses sRGB values, as most tools do, or linear light. Each layer is rounded, as in a frame buffer. The same pass finds
the owner of each pixel, the object that it shows most of.

The static layer is rendered once per video. Moving slots are rendered in one of two forms, whose frames differ by at
most one grey level. On a CPU (tiles.py) each object is painted into a tile of its own size, one after the other. On a
GPU (`draw_dense`) each pixel evaluates every object, which fuses. `draw_soft` is the dense form without rounding, for
gradients.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from gen2d.core.enums import STATIC
from gen2d.records.axes import Array, assert_shape
from gen2d.renderers.color import to_linear, to_srgb
from gen2d.renderers.compositing import (
    LayerCanvas,
    background_image,
    background_layer,
    float_painter,
    paint_moving,
    paint_static,
    quantized_painter,
    run_edge_terms,
    static_layer,
)
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.renderers.postprocessing import expose, exposure_average, exposure_start
from gen2d.renderers.primitives import Instants, PixelWindow
from gen2d.renderers.sensor import record
from gen2d.renderers.shading import covered_color, fills_of
from gen2d.renderers.tiles import draw_tiles
from gen2d.xla import on_cpu


def draw(scenes: RenderScene, plan: FramePlan) -> tuple[Array | None, Array | None]:
    """Frames [n, T, H, W, 3] uint8 and owners [n, T, H, W] uint8, None if `plan` does not want them.

    Uses tiles on a CPU, and `draw_dense` elsewhere. Raises AssertionError for scenes of another layout.
    """
    assert_shape(scenes.instants.position, (None, None, plan.layout.slots, 2), "states/position")
    return (draw_tiles if on_cpu() else draw_dense)(scenes, plan)


def draw_dense(scenes: RenderScene, plan: FramePlan) -> tuple[Array | None, Array | None]:
    """Frames and owners as from `draw`, with each object evaluated at every pixel. The form for GPUs."""
    frames, owners = jax.vmap(functools.partial(_draw_video, plan=plan))(scenes)
    return record(scenes.sensor, scenes.seed, frames, owners, plan.height, plan.width)


def _draw_video(scene: RenderScene, plan: FramePlan) -> tuple[Array | None, Array | None]:
    now = dataclasses.replace(plan, frames=plan.frames and not plan.exposed)
    frames, owners = _paint_instants(scene, now, scene.instants)
    if plan.frames and scene.exposed is not None:
        alone = dataclasses.replace(plan, owners=False)

        def add(total: Array, at: Instants) -> tuple[Array, None]:
            image = _paint_instants(scene, alone, at).image
            assert image is not None
            return expose(total, image, plan.linear), None

        exposed = jax.tree.map(lambda a: jnp.moveaxis(a, 1, 0), scene.exposed)
        start = exposure_start((scene.instants.angle.shape[0], plan.height, plan.width, 3), plan.linear)
        frames = exposure_average(jax.lax.scan(add, start, exposed)[0], plan.exposed, plan.linear)
    return frames, None if owners is None else (owners & 255).astype(jnp.uint8)


def _paint_instants(scene: RenderScene, plan: FramePlan, at: Instants) -> LayerCanvas:
    """Canvas of all layers at the instants `at`."""
    start = static_layer(scene, plan) if plan.still else background_layer(scene, at, plan)
    canvas = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(at.angle), *a.shape[1:])), start)
    return paint_moving(canvas, scene, plan, at, quantized_painter(plan.linear))


def draw_soft(scene: RenderScene, plan: FramePlan, sigma: float = 0.0) -> Array:
    """Frames [T, H, W, 3] of one video as floats from 0 to 255, without rounding, motion blur, lens and sensor.

    They are differentiable in positions, angles, sizes, colours and the camera. `sigma` (px) blurs the coverage of each
    object; with 0 the frames are those of `draw` up to rounding. Raises AssertionError for a scene of another layout.
    """
    assert_shape(scene.instants.position, (None, plan.layout.slots, 2), "states/position")
    at, paint = scene.instants, float_painter(plan.linear, sigma)
    image = background_image(scene, at, plan)
    image = jnp.broadcast_to(to_linear(image) if plan.linear else image, (len(at.angle), *image.shape[1:]))
    image = paint_moving(paint_static(image, scene, plan, at, paint), scene, plan, at, paint)
    return to_srgb(image) if plan.linear else image


def alone(scene: RenderScene, plan: FramePlan, measure: Callable[[Array], Array]) -> Array:
    """Results [T, K, ...] of `measure` on the coverage [T, H, W] of each slot, rendered without any other slot."""
    window, results = PixelWindow(0, 0, plan.height, plan.width), []
    for run, first in plan.layout.spans:
        stands = plan.still and run.kind == STATIC
        at = jax.tree.map(lambda a, stands=stands: a[:1] if stands else a, scene.instants)
        edges = run_edge_terms(scene, plan, at, run, first, window)
        fills = fills_of(scene.paint, slice(first, first + run.count))
        largest = plan.largest(run)
        values = jax.lax.map(
            lambda one, most=largest: measure(covered_color(one[0], one[1], window, most)[0]), (edges, fills)
        )
        results.append(jnp.broadcast_to(values, (run.count, len(scene.instants.angle), *values.shape[2:])))
    return jnp.moveaxis(jnp.concatenate(results), 0, 1)
