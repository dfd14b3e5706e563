"""Optical flow: where what each pixel shows goes to in the next frame, and where it came from.

A pixel moves with the object that owns it, as a rigid body; the background with the camera; an occluder not at all. A
flow is valid where its end lies in the picture and in a pixel that shows the same object.
"""

import jax
import jax.numpy as jnp

from gen2d.camera import to_pixels
from gen2d.fields import Field
from gen2d.figures import Instants
from gen2d.raster import OCCLUDER, Plan, Stage
from gen2d.types import Array

OWNERS = True
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
    ahead = jnp.minimum(jnp.arange(count) + 1, count - 1)
    back = jnp.maximum(jnp.arange(count) - 1, 0)
    found = {}
    for name, other in (("forward", ahead), ("backward", back)):
        tables = _tables(stage.instants, other, plan)

        def of(entry: tuple) -> tuple[Array, Array]:
            owner, table, number, to = entry
            return _flow(owner, owners[to], table, (number != to), plan)

        flow, valid = jax.lax.map(of, (owners, tables, jnp.arange(count), other))
        found |= {f"flow/{name}": flow, f"flow/{name}_valid": valid}
    return found


def _tables(at: Instants, other: Array, plan: Plan) -> Array:
    """For each frame and id the motion of a pixel at (x, y): dx = a x + b y + c, dy = d x + e y + f, as
    [T, 256, 6]; what belongs to no slot rests."""
    then = jax.tree.map(lambda a: a[other], at)
    here, there = (to_pixels(i.view, i.position, plan.height, plan.width) for i in (at, then))
    grown = then.view.scale / at.view.scale
    turned = (at.angle - then.angle) - (at.view.angle - then.view.angle)[:, None]  # clockwise as seen
    bodies = _motion(here, there, turned, grown[:, None])
    origin = jnp.broadcast_to(at.view.center[:, None], (*at.view.scale.shape, 1, 2))
    middle, moved = (to_pixels(view, origin, plan.height, plan.width) for view in (at.view, then.view))
    ground = _motion(middle, moved, (then.view.angle - at.view.angle)[:, None], grown[:, None])
    rest = jnp.zeros((len(here), OCCLUDER - plan.layout.slots, 6))
    return jnp.concatenate([ground, bodies, rest], axis=1)


def _motion(here: Array, there: Array, turned: Array, grown: Array) -> Array:
    """The six numbers [..., 6] of points that move from `here` to `there` [..., 2] and turn about them."""
    a, b = grown * jnp.cos(turned) - 1, grown * jnp.sin(turned)
    x, y = here[..., 0], here[..., 1]
    shift = there - here
    return jnp.stack([a, -b, shift[..., 0] - a * x + b * y, b, a, shift[..., 1] - b * x - a * y], -1)


def _flow(owner: Array, owner_then: Array, table: Array, moves: Array, plan: Plan) -> tuple[Array, Array]:
    """The flow [H, W, 2] of one frame, and where it is valid [H, W]."""
    x, y = jnp.arange(plan.width) + 0.5, (jnp.arange(plan.height) + 0.5)[:, None]
    number = jnp.where(moves, table[owner.astype(jnp.int32)], 0.0)
    dx = number[..., 0] * x + number[..., 1] * y + number[..., 2]
    dy = number[..., 3] * x + number[..., 4] * y + number[..., 5]
    column, row = (jnp.floor(a).astype(jnp.int32) for a in (x + dx, y + dy))
    inside = (column >= 0) & (column < plan.width) & (row >= 0) & (row < plan.height)
    place = jnp.clip(row, 0, plan.height - 1) * plan.width + jnp.clip(column, 0, plan.width - 1)
    same = owner_then.reshape(-1)[place] == owner
    return jnp.stack([dx, dy], -1).astype(jnp.float16), (moves & inside & same).astype(jnp.uint8)
