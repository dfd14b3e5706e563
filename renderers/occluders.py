"""Occluders: rectangles that are fixed in the image, lit as boards with a bevel where the look has surfaces.

They are the same in all frames of a video: light, shadows and the size of the bevel are those of the first frame.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.lighting import lit_color
from gen2d.renderers.lit_terms import lit_terms
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.renderers.primitives import ImagePose, PixelWindow
from gen2d.renderers.relief import Relief, SurfacePoints, in_image, surface_points
from gen2d.renderers.shadows import ShadowTerms, shadow_cover

SIDES = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))  # outward normals


class OccluderLayer(NamedTuple):
    """One occluder in a frame."""

    cover: Array  # [1, H, W]
    color: Any  # [3], or a ShadedColor [1, H, W]
    shadow: Array | None  # [1, H, W] opacity


def occluder_layers(scene: RenderScene, plan: FramePlan) -> list[OccluderLayer]:
    """Layers of a video's occluders, back to front."""
    occluders, paint, window = scene.occluders, scene.paint, PixelWindow(0, 0, plan.height, plan.width)
    if occluders is None:
        return []
    left, top, right, bottom = (occluders.box[:, side, None, None] for side in range(4))
    columns, rows = (jnp.arange(count, dtype=jnp.float32) for count in (plan.width, plan.height))

    def part(edge: Array, low: Array, high: Array) -> Array:
        return jnp.clip(jnp.minimum(high, edge + 1) - jnp.maximum(low, edge), 0.0, 1.0)

    cover = part(rows[:, None], top, bottom) * part(columns, left, right)
    color, shadow, (relief, pose) = occluders.color, None, _board(scene)
    if paint.light is not None and paint.screen is not None:
        terms = lit_terms(paint.light, paint.screen, relief, pose)
        x, y = _from_center(pose, plan)
        accent = jnp.broadcast_to(paint.light.highlight, color.shape)
        color = lit_color(color[:, None, None], accent[:, None, None], terms, relief, pose, x, y, cover)
    if paint.shadow is not None:
        right, down = in_image(paint.shadow.offset, scene.instants.view)[0] * pose.scale[0]
        blur = jnp.maximum(paint.shadow.blur * pose.scale, 0.5)
        opacity = jnp.broadcast_to(paint.shadow.opacity, blur.shape)
        terms = ShadowTerms(
            pose.column + right, pose.row + down, pose.cos, pose.sin, relief.radius, None, relief.normal,
            relief.distance, blur, opacity,
        )  # fmt: skip
        shadow = shadow_cover(terms, window)
    every = OccluderLayer(cover, color, shadow)
    layers = [jax.tree.map(lambda a, i=i: a[i : i + 1], every) for i in range(len(occluders.rank))]
    return [layer._replace(color=layer.color[0]) if color is occluders.color else layer for layer in layers]


def over_occluders(scene: RenderScene, plan: FramePlan, shown: Array, values: Any, measure: Any) -> Any:
    """`values` [T, H, W] with those of `measure` on the surfaces of occluders where they are `shown` [T, H, W]."""
    if scene.occluders is None or scene.paint.screen is None:
        return values
    relief, pose = _board(scene)
    x, y = _from_center(pose, plan)
    slope, bevel = (jnp.broadcast_to(a, pose.scale.shape) for a in (scene.paint.screen.slope, scene.paint.screen.bevel))
    points: SurfacePoints = surface_points(relief, pose, slope, bevel, x, y)
    left, top, right, bottom = (scene.occluders.box[:, side, None, None] for side in range(4))
    boards, inside = measure(points), (jnp.abs(x) <= (right - left) / 2) & (jnp.abs(y) <= (bottom - top) / 2)
    for i in range(len(scene.occluders.rank)):
        values = jax.tree.map(lambda old, new, i=i: jnp.where(shown & inside[i], new[i], old), values, boards)
    return values


def _board(scene: RenderScene) -> tuple[Relief, ImagePose]:
    """Reliefs and poses of the occluders [O] as flat boards with a bevel, in the first frame."""
    assert scene.occluders is not None
    left, top, right, bottom = scene.occluders.box.T
    zero, view = jnp.zeros_like(left), scene.instants.view
    half = jnp.stack([right - left, bottom - top], -1) / 2
    normal = jnp.broadcast_to(jnp.asarray(SIDES), (len(left), 4, 2))
    light = jnp.zeros(2) if scene.paint.light is None else scene.paint.light.direction[:2]
    toward = jnp.broadcast_to(in_image(light, view)[0], half.shape)
    relief = Relief(zero, None, normal, jnp.concatenate([half, half], -1), toward)
    scale, reach = view.scale[0] + zero, jnp.sqrt((half**2).sum(-1))
    return relief, ImagePose((left + right) / 2, (top + bottom) / 2, 1 + zero, zero, scale, reach)


def _from_center(pose: ImagePose, plan: FramePlan) -> tuple[Array, Array]:
    """Pixel centres relative to those of the occluders: columns [O, 1, W] and rows [O, H, 1]."""
    x = jnp.arange(plan.width) + 0.5 - pose.column[:, None]
    return x[:, None, :], (jnp.arange(plan.height) + 0.5 - pose.row[:, None])[..., None]
