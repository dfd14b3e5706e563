"""Optical flow: where what each pixel shows goes to in the next frame, and where it came from.

A pixel moves with the object that owns it, as a rigid body; the background with the camera; an occluder not at all. A
flow is valid where its end lies in the picture and in a pixel that shows the same object.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.camera import pixel_at, to_pixels
from gen2d.fields import Field
from gen2d.figures import Instants, Window
from gen2d.layers import OCCLUDER
from gen2d.picture import Plan, Stage, on_cpu, patch_of
from gen2d.types import STATIC, Array

OWNERS = True
IN_TURN = True  # video by video on a CPU
_VALID = "1 where the flow ends in the frame, at a pixel of the same object"
FIELDS = {
    "flow/forward": Field("float16", "n T H W 2", "px/frame", "dx right, dy down, to frame t + 1; 0 in the last"),
    "flow/backward": Field("float16", "n T H W 2", "px/frame", "dx right, dy down, to frame t - 1; 0 in the first"),
    "flow/forward_valid": Field("uint8", "n T H W", "1", _VALID),
    "flow/backward_valid": Field("uint8", "n T H W", "1", _VALID),
}


def annotate(stage: Stage, owners: Array, plan: Plan, options: object) -> dict[str, Array]:
    """Both flows and where they are valid."""
    count = len(owners)
    others = jnp.stack([jnp.arange(count) + 1, jnp.arange(count) - 1], axis=1)  # [T, 2]
    moves, others = (others >= 0) & (others < count), jnp.clip(others, 0, count - 1)
    tables = jnp.stack([_tables(stage.instants, others[:, i], plan) for i in range(2)], axis=1)  # [T, 2, K + 1, 6]
    tables = jnp.where(moves[..., None, None], tables, 0.0)
    flow_of = _by_patches(stage, plan) if on_cpu() else _by_pixels
    now = Now(owners, owners[others], tables, moves, jnp.arange(count))
    flow, valid = jax.lax.map(lambda now: flow_of(now, plan), now)
    return {
        "flow/forward": flow[:, 0],
        "flow/backward": flow[:, 1],
        "flow/forward_valid": valid[:, 0],
        "flow/backward_valid": valid[:, 1],
    }


class Now(NamedTuple):
    """What the flow of a frame depends on; then comes next, then before."""

    owner: Array  # [H, W]
    then: Array  # [2, H, W]
    table: Array  # [2, K + 1, 6]
    moves: Array  # [2] whether there is such a frame
    number: Array


def _tables(at: Instants, other: Array, plan: Plan) -> Array:
    """For each frame and id, 0 the background's, the motion of a pixel at (x, y): dx = a x + b y + c,
    dy = d x + e y + f, as [T, K + 1, 6]."""
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


def _ends(number: Array, x: Array, y: Array, then: Array) -> tuple[Array, Array, Array]:
    """The flow [..., 2] of pixels at x and y, whom the frame there shows where it ends, and whether it ends inside."""
    dx = number[..., 0] * x + number[..., 1] * y + number[..., 2]
    dy = number[..., 3] * x + number[..., 4] * y + number[..., 5]
    place, inside = pixel_at(x + dx, y + dy, *then.shape)
    return jnp.stack([dx, dy], -1).astype(jnp.float16), then.reshape(-1)[place], inside


def _by_pixels(now: Now, plan: Plan) -> tuple[Array, Array]:
    """The flows [2, H, W, 2] of a frame and where they are valid [2, H, W]: every pixel looks its motion up."""
    x, y = jnp.arange(plan.width) + 0.5, (jnp.arange(plan.height) + 0.5)[:, None]
    known = now.owner < OCCLUDER
    place = jnp.where(known, now.owner, 0).astype(jnp.int32)

    def one(table: Array, then: Array, moves: Array) -> tuple[Array, Array]:
        flow, shown, inside = _ends(jnp.where(known[..., None], table[place], 0.0), x, y, then)
        return flow, (moves & inside & (shown == now.owner)).astype(jnp.uint8)

    return jax.vmap(one)(now.table, now.then, now.moves)


def _by_patches(stage: Stage, plan: Plan) -> Callable[[Now, Plan], tuple[Array, Array]]:
    """The same for a CPU: the background's motion everywhere, then each object's in its patch."""
    moving = [(group, run, first) for group in plan.groups for run, first in group.runs if run.kind != STATIC]
    patches = [(patch_of(plan, group, stage.instants, run, first), run, first) for group, run, first in moving]

    def frame(now: Now, plan: Plan) -> tuple[Array, Array]:
        flows = _background(now, plan)
        for window, run, first in patches:
            top, left = (jax.lax.dynamic_index_in_dim(a, now.number, 1, keepdims=False) for a in window[:2])
            stroke = functools.partial(_stroke, now=now, window=window._replace(top=top, left=left), first=first)
            flows = jax.lax.fori_loop(0, run.count, stroke, flows)
        return flows

    return frame


def _background(now: Now, plan: Plan) -> tuple[Array, Array]:
    """The flows of a frame as if only the camera moved."""
    if plan.still:
        same = (now.then == now.owner) & now.moves[:, None, None]
        return jnp.zeros((2, plan.height, plan.width, 2), jnp.float16), same.astype(jnp.uint8)
    ground = jnp.broadcast_to(now.table[:, :1], now.table.shape)
    return _by_pixels(now._replace(table=ground), plan)


def _stroke(k: Array, flows: tuple[Array, Array], now: Now, window: Window, first: int) -> tuple[Array, Array]:
    """The flows after those of one object were put where it is seen."""
    size, top, left = (window.rows, window.columns), window.top[k], window.left[k]
    name = (first + k + 1).astype(jnp.uint8)
    mine = jax.lax.dynamic_slice(now.owner, (top, left), size) == name
    x, y = jnp.arange(size[1]) + (left + 0.5), (jnp.arange(size[0]) + (top + 0.5))[:, None]
    ends = [_ends(now.table[i, first + k + 1], x, y, now.then[i]) for i in range(2)]
    new = jnp.stack([flow for flow, *_ in ends])
    seen = [now.moves[i] & inside & (shown == name) for i, (_, shown, inside) in enumerate(ends)]
    flow, valid = flows
    old = jax.lax.dynamic_slice(flow, (0, top, left, 0), new.shape)
    was = jax.lax.dynamic_slice(valid, (0, top, left), new.shape[:-1])
    flow = jax.lax.dynamic_update_slice(flow, jnp.where(mine[..., None], new, old), (0, top, left, 0))
    valid = jax.lax.dynamic_update_slice(valid, jnp.where(mine, jnp.stack(seen).astype(jnp.uint8), was), (0, top, left))
    return flow, valid
