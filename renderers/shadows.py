"""Shadows of bodies on what lies behind them: their outlines moved along the light, with a soft edge.

The edge goes from 1 to 0 over twice the blur: over the squared distance from a disc's centre or a capsule's core, so
that no root is needed, and across each side of a polygon, whose sum also fades its corners. A shadow smaller than its
blur is fainter, so that about as much light is lacking as without the blur.
"""

from typing import NamedTuple

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.records.layout import SlotGroup
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.renderers.primitives import Instants, PixelWindow, object_parts
from gen2d.renderers.relief import outline_of

SLAB = 24 / 35  # mean of the soft edge's profile over its width


class ShadowTerms(NamedTuple):
    """Shadows of some slots [k, I, ...], relative to their windows; px, y down."""

    column: Array  # of the centre
    row: Array
    cos: Array
    sin: Array
    radius: Array
    half: Array | None
    normal: Array | None  # [k, I, V, 2]
    distance: Array | None  # [k, I, V]
    blur: Array
    opacity: Array


def shadow_terms(
    scene: RenderScene, plan: FramePlan, at: Instants, run: SlotGroup, first: int, window: PixelWindow
) -> ShadowTerms:
    """Terms of the shadows of a run's slots in their windows at the instants `at`."""
    shadow = scene.paint.shadow
    assert shadow is not None
    moved = at._replace(position=at.position + shadow.offset)
    pose = object_parts(run, first, scene.bodies, moved, scene.paint, plan.height, plan.width).pose
    radius, half, normal, distance = outline_of(run, first, scene.bodies, at, scene.paint)
    blur = jnp.maximum(shadow.blur * pose.scale, 0.5)
    drawn = scene.paint.drawn[first : first + run.count, None]
    opacity = jnp.where(drawn, shadow.opacity, 0.0) + jnp.zeros_like(radius)
    if run.shape == "circle":
        lacking = radius**2 / jnp.where(radius > blur, radius**2 + blur**2, (radius + blur) ** 2 / 2)
        opacity = opacity * lacking
    elif run.shape != "polygon":
        opacity = opacity * jnp.minimum(radius / (SLAB * (radius + blur)), 1.0)
    return ShadowTerms(
        pose.column - window.left, pose.row - window.top, pose.cos, pose.sin, radius, half, normal, distance, blur,
        opacity,
    )  # fmt: skip


def shadow_cover(terms: ShadowTerms, window: PixelWindow) -> Array:
    """Opacity [..., rows, columns] of shadows, at pixel centres."""
    x = (jnp.arange(window.columns) + 0.5 - terms.column[..., None])[..., None, :]
    y = (jnp.arange(window.rows) + 0.5 - terms.row[..., None])[..., :, None]
    radius, blur, opacity = (a[..., None, None] for a in (terms.radius, terms.blur, terms.opacity))
    if terms.normal is not None and terms.distance is not None:
        cover = jnp.ones_like(x + y)
        for side in range(terms.normal.shape[-2]):
            a, b = (terms.normal[..., side, axis][..., None, None] for axis in (0, 1))
            distance = (terms.distance[..., side] + terms.radius)[..., None, None]
            cover = cover - _smooth((x * a + (y * b - distance) + blur) * (0.5 / blur))
        return opacity * jnp.maximum(cover, 0.0)
    if terms.half is not None:
        cos, sin, half = (a[..., None, None] for a in (terms.cos, terms.sin, terms.half))
        along = jnp.clip(x * cos + y * sin, -half, half)
        x, y = x - along * cos, y - along * sin
    inner, outer = jnp.maximum(radius - blur, 0.0), radius + blur
    return opacity * _smooth((outer**2 - (x * x + y * y)) * (1 / (outer**2 - inner**2)))


def _smooth(value: Array) -> Array:
    value = jnp.clip(value, 0.0, 1.0)
    return value * value * (3 - 2 * value)
