"""Optical flow: where what each pixel shows goes to in the next frame, and where it came from.

A pixel moves with the object that owns it, as a rigid body; the background with the camera; an occluder not at all. A
flow is valid where its end lies in the picture and in a pixel that shows the same object.
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

_VALID = "1 where the flow ends in the frame, at a pixel of the same object"


def annotate(stages: RenderScene, owners: Array, plan: FramePlan, on: bool) -> dict[str, Array]:
    """Both flows and where they are valid."""
    found, flow_of = {}, _by_patches if on_cpu() else _by_pixels
    for name, step in (("forward", 1), ("backward", -1)):
        found[f"flow/{name}"], found[f"flow/{name}_valid"] = flow_of(stages, owners, plan, step)
    return found


def _tables(at: Instants, step: int, plan: FramePlan) -> Array:
    """For each frame and id, 0 the background's, the motion of a pixel at (x, y) in so many frames: dx = a x + b y + c,
    dy = d x + e y + f, as [T, K + 1, 6]; beyond the ends nothing moves."""
    other = jnp.clip(jnp.arange(len(at.angle)) + step, 0, len(at.angle) - 1)
    then = jax.tree.map(lambda a: a[other], at)
    here, there = (to_pixels(i.view, i.position, plan.height, plan.width) for i in (at, then))
    grown = then.view.scale / at.view.scale
    turned = (at.angle - then.angle) - (at.view.angle - then.view.angle)[:, None]  # clockwise as seen
    bodies = _motion(here, there, turned, grown[:, None])
    origin = jnp.broadcast_to(at.view.center[:, None], (*at.view.scale.shape, 1, 2))
    middle, moved = (to_pixels(view, origin, plan.height, plan.width) for view in (at.view, then.view))
    ground = _motion(middle, moved, (then.view.angle - at.view.angle)[:, None], grown[:, None])
    return jnp.concatenate([ground, bodies], axis=1)


def _motion(here: Array, there: Array, turned: Array, grown: Array) -> Array:
    """The six numbers [..., 6] of points that move from `here` to `there` [..., 2] and turn about them."""
    a, b = grown * jnp.cos(turned) - 1, grown * jnp.sin(turned)
    x, y = here[..., 0], here[..., 1]
    shift = there - here
    return jnp.stack([a, -b, shift[..., 0] - a * x + b * y, b, a, shift[..., 1] - b * x - a * y], -1)


def _ends(number: Array, x: Array, y: Array, height: int, width: int) -> tuple[Array, Array, Array]:
    """The flow [..., 2] of pixels at x and y, the number of the pixel where it ends, and whether it ends inside."""
    dx = number[..., 0] * x + number[..., 1] * y + number[..., 2]
    dy = number[..., 3] * x + number[..., 4] * y + number[..., 5]
    return jnp.stack([dx, dy], -1).astype(jnp.float16), *pixel_at(x + dx, y + dy, height, width)


def _ends_of(frames: int, step: int) -> tuple[int, int]:
    """The first frame from which such a step stays in the video, and the one after the last."""
    return max(0, -step), frames - max(0, step)


# ---- Every pixel looks its motion up


def _by_pixels(
    stages: RenderScene, owners: Array, plan: FramePlan, step: int, ground: bool = False
) -> tuple[Array, Array]:
    """The flows [n, T, H, W, 2] and where they are valid [n, T, H, W]; with `ground` as if only the camera moved. The
    form for GPUs."""
    x, y = jnp.arange(plan.width) + 0.5, (jnp.arange(plan.height) + 0.5)[:, None]
    begin, end = _ends_of(owners.shape[1], step)

    def video(stage: RenderScene, owners: Array) -> tuple[Array, Array]:
        table = _tables(stage.instants, step, plan)
        table = jnp.broadcast_to(table[:, :1], table.shape) if ground else table

        def frame(t: Array) -> tuple[Array, Array]:
            owner, then = owners[t], owners[t + step].reshape(-1)
            known = owner < OCCLUDER
            number = table[t, jnp.where(known, owner, 0).astype(jnp.int32)]
            flow, place, inside = _ends(jnp.where(known[..., None], number, 0.0), x, y, *owner.shape)
            return flow, (inside & (then[place] == owner)).astype(jnp.uint8)

        rest = (begin, owners.shape[0] - end)
        return jax.tree.map(
            lambda a: jnp.pad(a, [rest, *[(0, 0)] * (a.ndim - 1)]), jax.lax.map(frame, jnp.arange(begin, end))
        )

    return jax.vmap(video)(stages, owners)


# ---- Each object's motion goes into a patch of its own


def _by_patches(stages: RenderScene, owners: Array, plan: FramePlan, step: int) -> tuple[Array, Array]:
    """The same for a CPU: the background's motion everywhere, then each object's where it is seen in its patch."""
    count, frames = owners.shape[:2]
    begin, end = _ends_of(frames, step)
    spans = [(group, *span) for group in plan.groups for span in group.runs if span[0].kind != STATIC]
    everyone = owners.reshape(-1, *owners.shape[2:])
    flow, valid = _behind(stages, owners, plan, step)
    # Both numbers of a pixel beside one another: rows of pairs are not written as vectors.
    start = flow.reshape(-1, plan.height, 2 * plan.width), valid.reshape(everyone.shape)

    def video(v: Array, flows: tuple[Array, Array]) -> tuple[Array, Array]:
        at = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, v, keepdims=False), stages.instants)
        table = _tables(at, step, plan)
        for group, run, first in spans:
            window = tile_windows(plan, group, at, run, first)

            def frame(
                t: Array, flows: tuple, window: PixelWindow = window, run: SlotGroup = run, first: int = first
            ) -> tuple:
                def stroke(k: Array, flows: tuple) -> tuple:
                    here = window._replace(top=window.top[k, t], left=window.left[k, t])
                    return _stroke(flows, everyone, v * frames + t, step, first + k + 1, table[t, first + k + 1], here)

                return jax.lax.fori_loop(0, run.count, stroke, flows)

            flows = jax.lax.fori_loop(begin, end, frame, flows)
        return flows

    flow, valid = jax.lax.fori_loop(0, count, video, start)
    return flow.reshape(*owners.shape, 2), valid.reshape(owners.shape)


def _behind(stages: RenderScene, owners: Array, plan: FramePlan, step: int) -> tuple[Array, Array]:
    """The flows and where they are valid as if only the camera moved."""
    if not plan.still:
        return _by_pixels(stages, owners, plan, step, ground=True)
    same = (owners[:, 1:] == owners[:, :-1]).astype(jnp.uint8)
    valid = jax.lax.dynamic_update_slice(jnp.zeros_like(owners), same, (0, max(0, -step), 0, 0))
    return jnp.zeros((*owners.shape, 2), jnp.float16), valid


def _stroke(
    flows: tuple[Array, Array], owners: Array, frame: Array, step: int, name: Array, number: Array, window: PixelWindow
) -> tuple[Array, Array]:
    """The flows after those of one object were put where a frame shows it."""
    (flow, valid), (_, height, width) = flows, owners.shape
    place, size = (frame, window.top, window.left), (1, window.rows, window.columns)
    beside, twice = (frame, window.top, 2 * window.left), (1, window.rows, 2 * window.columns)
    x, y = jnp.arange(window.columns) + (window.left + 0.5), (jnp.arange(window.rows) + (window.top + 0.5))[:, None]
    mine = jax.lax.dynamic_slice(owners, place, size) == name.astype(jnp.uint8)
    _, end, inside = _ends(number, x, y, height, width)
    shown = owners.reshape(-1)[(frame + step) * height * width + end]
    seen = (inside & (shown == name.astype(jnp.uint8))).astype(jnp.uint8)
    entry = jnp.arange(twice[-1])
    a, b, c = (jnp.where(entry % 2 == 0, number[i], number[i + 3]) for i in range(3))
    new = (a * (entry // 2 + (window.left + 0.5)) + b * y + c).astype(jnp.float16)[None]
    old, was = jax.lax.dynamic_slice(flow, beside, twice), jax.lax.dynamic_slice(valid, place, size)
    both = jnp.where(jnp.broadcast_to(mine[..., None], (*size, 2)).reshape(twice), new, old)
    flow = jax.lax.dynamic_update_slice(flow, both, beside)
    return flow, jax.lax.dynamic_update_slice(valid, jnp.where(mine, seen, was), place)


ANNOTATION = Annotation(
    options=option(False, bool, "", "where each pixel goes to in the next frame, and came from"),
    fields={
        "flow/forward": Field("float16", "n T H W 2", "px/frame", "dx right, dy down, to frame t + 1; 0 in the last"),
        "flow/backward": Field("float16", "n T H W 2", "px/frame", "dx right, dy down, to frame t - 1; 0 in the first"),
        "flow/forward_valid": Field("uint8", "n T H W", "1", _VALID),
        "flow/backward_valid": Field("uint8", "n T H W", "1", _VALID),
    },
    annotate=annotate,
    owners=True,
)
