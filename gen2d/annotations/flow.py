"""Optical flow: displacement of the content of each pixel to the next frame and to the previous one.

A pixel moves rigidly with the object that owns it; background moves with the camera; occluders do not move. A flow is
valid where it ends inside the frame at a pixel that shows the same object.
"""

import jax
import jax.numpy as jnp

from gen2d.plugin import (
    OCCLUDER,
    STATIC,
    Annotation,
    Array,
    Field,
    FramePlan,
    Instants,
    PixelWindow,
    RenderScene,
    SlotGroup,
    on_cpu,
    option,
    pixel_at,
    tile_windows,
    to_pixels,
)

_VALID = "validity; 1 where the flow ends inside the frame at a pixel of the same object"


def annotate(scenes: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Forward and backward flow and their validity."""
    arrays, flow_of = {}, _flow_by_tiles if on_cpu() else _flow_by_pixels
    for name, step in (("forward", 1), ("backward", -1)):
        arrays[f"flow/{name}"], arrays[f"flow/{name}_valid"] = flow_of(scenes, owners, plan, step)
    return arrays


def _affine_motions(at: Instants, step: int, plan: FramePlan) -> Array:
    """Affine motions [T, K + 1, 6] to the frame `step` later, by frame and id; id 0 is the background.

    A pixel at (x, y) moves by dx = a x + b y + c, dy = d x + e y + f. Past the ends of the video nothing moves.
    """
    target_frames = jnp.clip(jnp.arange(len(at.angle)) + step, 0, len(at.angle) - 1)
    target = jax.tree.map(lambda a: a[target_frames], at)
    start, end = (to_pixels(i.view, i.position, plan.height, plan.width) for i in (at, target))
    zoom = target.view.scale / at.view.scale
    turn = (at.angle - target.angle) - (at.view.angle - target.view.angle)[:, None]  # clockwise as seen
    bodies = _affine_motion(start, end, turn, zoom[:, None])
    origin = jnp.broadcast_to(at.view.center[:, None], (*at.view.scale.shape, 1, 2))
    origin_start, origin_end = (to_pixels(view, origin, plan.height, plan.width) for view in (at.view, target.view))
    ground = _affine_motion(origin_start, origin_end, (target.view.angle - at.view.angle)[:, None], zoom[:, None])
    return jnp.concatenate([ground, bodies], axis=1)


def _affine_motion(start: Array, end: Array, angle: Array, scale: Array) -> Array:
    """Affine motion [..., 6] that moves `start` [..., 2] to `end`, rotates by `angle` (rad) and scales by `scale`."""
    a, b = scale * jnp.cos(angle) - 1, scale * jnp.sin(angle)
    x, y = start[..., 0], start[..., 1]
    shift = end - start
    return jnp.stack([a, -b, shift[..., 0] - a * x + b * y, b, a, shift[..., 1] - b * x - a * y], -1)


def _flow_at(motion: Array, x: Array, y: Array, height: int, width: int) -> tuple[Array, Array, Array]:
    """Flow [..., 2] of pixels at x and y by affine motions [..., 6]; index of the pixel where it ends, and whether
    it ends inside the frame."""
    dx = motion[..., 0] * x + motion[..., 1] * y + motion[..., 2]
    dy = motion[..., 3] * x + motion[..., 4] * y + motion[..., 5]
    return jnp.stack([dx, dy], -1).astype(jnp.float16), *pixel_at(x + dx, y + dy, height, width)


def _frame_range(frames: int, step: int) -> tuple[int, int]:
    """First frame, and the one after the last, from which a step stays in the video."""
    return max(0, -step), frames - max(0, step)


# ---- On a GPU: each pixel looks up its motion


def _flow_by_pixels(
    scenes: RenderScene, owners: Array, plan: FramePlan, step: int, ground: bool = False
) -> tuple[Array, Array]:
    """Flow [n, T, H, W, 2] px and its validity [n, T, H, W] uint8, by lookup at every pixel; the form for GPUs.

    With `ground` all pixels move with the background.
    """
    x, y = jnp.arange(plan.width) + 0.5, (jnp.arange(plan.height) + 0.5)[:, None]
    begin, end = _frame_range(owners.shape[1], step)

    def video(scene: RenderScene, owners: Array) -> tuple[Array, Array]:
        table = _affine_motions(scene.instants, step, plan)
        table = jnp.broadcast_to(table[:, :1], table.shape) if ground else table

        def frame(t: Array) -> tuple[Array, Array]:
            owner, target_owners = owners[t], owners[t + step].reshape(-1)
            known = owner < OCCLUDER
            motion = table[t, jnp.where(known, owner, 0).astype(jnp.int32)]
            flow, end_pixel, inside = _flow_at(jnp.where(known[..., None], motion, 0.0), x, y, *owner.shape)
            return flow, (inside & (target_owners[end_pixel] == owner)).astype(jnp.uint8)

        padding = (begin, owners.shape[0] - end)
        return jax.tree.map(
            lambda a: jnp.pad(a, [padding, *[(0, 0)] * (a.ndim - 1)]), jax.lax.map(frame, jnp.arange(begin, end))
        )

    return jax.vmap(video)(scenes, owners)


# ---- On a CPU: each object's motion is written into its tile


def _flow_by_tiles(scenes: RenderScene, owners: Array, plan: FramePlan, step: int) -> tuple[Array, Array]:
    """Flow and validity as in `_flow_by_pixels`: background motion, then that of each object in its tile; for CPUs."""
    count, frames = owners.shape[:2]
    begin, end = _frame_range(frames, step)
    runs = [(group, *span) for group in plan.groups for span in group.runs if span[0].kind != STATIC]
    all_owners = owners.reshape(-1, *owners.shape[2:])
    flow, valid = _background_flow(scenes, owners, plan, step)
    # Interleave dx and dy in one axis: the compiler does not vectorize writes to a last axis of length 2.
    start = flow.reshape(-1, plan.height, 2 * plan.width), valid.reshape(all_owners.shape)

    def video(v: Array, flows: tuple[Array, Array]) -> tuple[Array, Array]:
        at = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, v, keepdims=False), scenes.instants)
        table = _affine_motions(at, step, plan)
        for group, run, first in runs:
            window = tile_windows(plan, group, at, run, first)

            def frame(
                t: Array, flows: tuple, window: PixelWindow = window, run: SlotGroup = run, first: int = first
            ) -> tuple:
                def write_object(k: Array, flows: tuple) -> tuple:
                    tile = window._replace(top=window.top[k, t], left=window.left[k, t])
                    return _write_object_flow(
                        flows, all_owners, v * frames + t, step, first + k + 1, table[t, first + k + 1], tile
                    )

                return jax.lax.fori_loop(0, run.count, write_object, flows)

            flows = jax.lax.fori_loop(begin, end, frame, flows)
        return flows

    flow, valid = jax.lax.fori_loop(0, count, video, start)
    return flow.reshape(*owners.shape, 2), valid.reshape(owners.shape)


def _background_flow(scenes: RenderScene, owners: Array, plan: FramePlan, step: int) -> tuple[Array, Array]:
    """Flow and validity as if all pixels moved with the background."""
    if not plan.still:
        return _flow_by_pixels(scenes, owners, plan, step, ground=True)
    same = (owners[:, 1:] == owners[:, :-1]).astype(jnp.uint8)
    valid = jax.lax.dynamic_update_slice(jnp.zeros_like(owners), same, (0, max(0, -step), 0, 0))
    return jnp.zeros((*owners.shape, 2), jnp.float16), valid


def _write_object_flow(
    flows: tuple[Array, Array], owners: Array, frame: Array, step: int, owner: Array, motion: Array, window: PixelWindow
) -> tuple[Array, Array]:
    """Flow and validity with the motion of one object written at the pixels that show it in a frame."""
    (flow, valid), (_, height, width) = flows, owners.shape
    start, size = (frame, window.top, window.left), (1, window.rows, window.columns)
    pair_start, pair_size = (frame, window.top, 2 * window.left), (1, window.rows, 2 * window.columns)
    x, y = jnp.arange(window.columns) + (window.left + 0.5), (jnp.arange(window.rows) + (window.top + 0.5))[:, None]
    owned = jax.lax.dynamic_slice(owners, start, size) == owner.astype(jnp.uint8)
    _, end, inside = _flow_at(motion, x, y, height, width)
    end_owner = owners.reshape(-1)[(frame + step) * height * width + end]
    new_valid = (inside & (end_owner == owner.astype(jnp.uint8))).astype(jnp.uint8)
    index = jnp.arange(pair_size[-1])
    a, b, c = (jnp.where(index % 2 == 0, motion[i], motion[i + 3]) for i in range(3))
    new_flow = (a * (index // 2 + (window.left + 0.5)) + b * y + c).astype(jnp.float16)[None]
    old_flow, old_valid = jax.lax.dynamic_slice(flow, pair_start, pair_size), jax.lax.dynamic_slice(valid, start, size)
    merged = jnp.where(jnp.broadcast_to(owned[..., None], (*size, 2)).reshape(pair_size), new_flow, old_flow)
    flow = jax.lax.dynamic_update_slice(flow, merged, pair_start)
    return flow, jax.lax.dynamic_update_slice(valid, jnp.where(owned, new_valid, old_valid), start)


ANNOTATION = Annotation(
    options=option(False, bool, "", "optical flow to the next and to the previous frame"),
    fields={
        "flow/forward": Field("float16", "n T H W 2", "px/frame", "flow right and down to frame t + 1; 0 in the last"),
        "flow/backward": Field(
            "float16", "n T H W 2", "px/frame", "flow right and down to frame t - 1; 0 in the first"
        ),
        "flow/forward_valid": Field("uint8", "n T H W", "1", _VALID),
        "flow/backward_valid": Field("uint8", "n T H W", "1", _VALID),
    },
    annotate=annotate,
    owners=True,
)
