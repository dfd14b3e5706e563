"""The camera: the one place where metres become pixels, and how it moves while a video runs.

Pixels are (row, column) from the top left, pixel centres at (j + 0.5); the world is in metres, y up. The camera's angle
is counter-clockwise, so that the picture turns clockwise.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.records.keys import key_for
from gen2d.records.layout import Layout
from gen2d.records.scene import State

TREMOR = (1.0, 1.37, 2.11)  # frequencies of a shaking hand, over the lowest


class CameraView(NamedTuple):
    """What a camera shows in each frame of a video."""

    center: Array  # [..., T, 2] m, world point in the middle of the frame
    scale: Array  # [..., T] px/m
    angle: Array  # [..., T] rad


def to_pixels(view: CameraView, points: Array, height: int, width: int) -> Array:
    """The columns and rows [..., T, P, 2] in px of world points [..., T, P, 2] in m."""
    cos, sin = jnp.cos(view.angle)[..., None], jnp.sin(view.angle)[..., None]
    scale = view.scale[..., None]
    x, y = (points[..., i] - view.center[..., None, i] for i in range(2))
    return jnp.stack([width / 2 + scale * (x * cos + y * sin), height / 2 - scale * (y * cos - x * sin)], -1)


def to_world(view: CameraView, columns: Array, rows: Array, height: int, width: int) -> tuple[Array, Array]:
    """The world's x and y in m of pixels; columns and rows [..., T, P] in px."""
    cos, sin = jnp.cos(view.angle)[..., None], jnp.sin(view.angle)[..., None]
    across, up = (columns - width / 2) / view.scale[..., None], (height / 2 - rows) / view.scale[..., None]
    return (
        view.center[..., None, 0] + across * cos - up * sin,
        view.center[..., None, 1] + across * sin + up * cos,
    )


def pixel_at(column: Array, row: Array, height: int, width: int) -> tuple[Array, Array]:
    """The number of the pixel, counted along rows, that holds each point, the nearest where it lies outside, and
    whether it lies inside."""
    j, i = (jnp.floor(a).astype(jnp.int32) for a in (column, row))
    inside = (j >= 0) & (j < width) & (i >= 0) & (i < height)
    return jnp.clip(i, 0, height - 1) * width + jnp.clip(j, 0, width - 1), inside


def fitted(bounds: tuple[float, ...], height: int, width: int, margin: float) -> tuple[tuple[float, float], float]:
    """The centre (m) and the scale (px/m) that show all of `bounds` (left, bottom, right, top) with a margin, in m."""
    left, bottom, right, top = bounds
    scale = min(width / (right - left + 2 * margin), height / (top - bottom + 2 * margin))
    return ((left + right) / 2, (bottom + top) / 2), scale


def moves(options: Any) -> bool:
    """Whether the camera may show another part of the world, or show it otherwise, later in a video."""
    still = (0.0, 0.0)
    drawn = (*options.pan, options.zoom, options.turn, options.shake)
    return options.follow is not None or any(part.support != still for part in drawn)


def base(options: Any, layout: Layout, height: int, width: int) -> tuple[tuple[float, float], float]:
    """The centre (m) and the scale (px/m) that the camera begins with."""
    center, scale = fitted(layout.bounds, height, width, options.margin)
    if options.center is not None:
        center = options.center[0], options.center[1]
    return center, options.scale or scale


def largest_scale(options: Any, layout: Layout, height: int, width: int, seconds: float) -> float:
    """No frame has more pixels per metre; infinite if that cannot be said."""
    rate = max(options.zoom.support[1], 0.0) * seconds
    return base(options, layout, height, width)[1] * math.exp(rate) if rate < 50 else math.inf


def filmed(key: Array, options: Any, layout: Layout, states: State, fps: float, height: int, width: int) -> CameraView:
    """One video's view: what the options draw at random, and what is followed."""
    frames = states.position.shape[0]
    time = jnp.arange(frames, dtype=jnp.float32) / fps

    def drawn(name: str, source: Any) -> Array:
        return source.sample(key_for(key, name), ())

    middle, scale = base(options, layout, height, width)
    pan = jnp.stack([drawn(f"pan {axis}", part) for axis, part in zip("xy", options.pan, strict=True)])
    center = jnp.asarray(middle, jnp.float32) + time[:, None] * pan
    if options.follow is not None:
        center = center - jnp.asarray(middle, jnp.float32) + states.position[:, options.follow]
    if options.shake.support != (0.0, 0.0):
        center = center + drawn("shake", options.shake) * _tremor(jax.random.fold_in(key, 1), time, options.shake_hertz)
    zoom, turn, angle = drawn("zoom", options.zoom), drawn("turn", options.turn), drawn("angle", options.angle)
    return CameraView(center, scale * jnp.exp(zoom * time), angle + turn * time)


def _tremor(key: Array, time: Array, hertz: float) -> Array:
    """Displacements [T, 2] of a shaking hand, 1 in the root mean square: a few waves, none of them a multiple of
    another."""
    phase = jax.random.uniform(key, (len(TREMOR), 2), maxval=2 * math.pi)
    rates = 2 * math.pi * hertz * jnp.asarray(TREMOR)
    waves = jnp.sin(time[:, None, None] * rates[:, None] + phase)
    return waves.sum(1) * math.sqrt(2 / len(TREMOR))
