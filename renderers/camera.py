"""Camera: conversion between metres and pixels, and camera motion.

Pixels are (row, column) from the top left with centres at j + 0.5; the world is in metres with y up. A positive camera
angle turns the camera counter-clockwise, so the image turns clockwise.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array
from gen2d.records.keys import key_for
from gen2d.records.layout import Layout
from gen2d.records.parameter import maximum, minimum
from gen2d.records.scene import State

TREMOR = (1.0, 1.37, 2.11)  # frequencies of hand shake, relative to the lowest


class CameraView(NamedTuple):
    """View of the camera in each frame of a video."""

    center: Array  # [..., T, 2] m, world point at the centre of the frame
    scale: Array  # [..., T] px/m
    angle: Array  # [..., T] rad


def to_pixels(view: CameraView, points: Array, height: int, width: int) -> Array:
    """Columns and rows [..., T, P, 2] in px of world points [..., T, P, 2] in m."""
    cos, sin = jnp.cos(view.angle)[..., None], jnp.sin(view.angle)[..., None]
    scale = view.scale[..., None]
    x, y = (points[..., i] - view.center[..., None, i] for i in range(2))
    return jnp.stack([width / 2 + scale * (x * cos + y * sin), height / 2 - scale * (y * cos - x * sin)], -1)


def to_world(view: CameraView, columns: Array, rows: Array, height: int, width: int) -> tuple[Array, Array]:
    """World coordinates x and y [..., T, P] in m of columns and rows [..., T, P] in px."""
    cos, sin = jnp.cos(view.angle)[..., None], jnp.sin(view.angle)[..., None]
    right, up = (columns - width / 2) / view.scale[..., None], (height / 2 - rows) / view.scale[..., None]
    return (view.center[..., None, 0] + right * cos - up * sin, view.center[..., None, 1] + right * sin + up * cos)


def pixel_at(column: Array, row: Array, height: int, width: int) -> tuple[Array, Array]:
    """Row-major index of the pixel that contains each point, and whether the point lies in the frame.

    A point outside of the frame gets the index of the nearest pixel.
    """
    j, i = (jnp.floor(a).astype(jnp.int32) for a in (column, row))
    inside = (j >= 0) & (j < width) & (i >= 0) & (i < height)
    return jnp.clip(i, 0, height - 1) * width + jnp.clip(j, 0, width - 1), inside


def fit_bounds(bounds: tuple[float, ...], height: int, width: int, margin: float) -> tuple[tuple[float, float], float]:
    """Centre (m) and scale (px/m) that fit `bounds` (left, bottom, right, top) and `margin` in m into a frame."""
    left, bottom, right, top = bounds
    scale = minimum(width / (right - left + 2 * margin), height / (top - bottom + 2 * margin))
    return ((left + right) / 2, (bottom + top) / 2), scale


def may_move(options: Any) -> bool:
    """Whether the view may change during a video."""
    still = (0.0, 0.0)
    motions = (*options.pan, options.zoom, options.turn, options.shake)
    return options.follow is not None or any(motion.support != still for motion in motions)


def initial_view(options: Any, layout: Layout, height: int, width: int) -> tuple[tuple[float, float], float]:
    """Centre (m) and scale (px/m) of the camera at the start of a video."""
    center, scale = fit_bounds(layout.bounds, height, width, options.margin)
    if options.center is not None:
        center = options.center[0], options.center[1]
    return center, options.scale or scale


def largest_scale(options: Any, layout: Layout, height: int, width: int, seconds: float) -> float:
    """Upper bound of the scale (px/m) over a video of `seconds`; infinite if zoom may reach a factor of exp(50)."""
    rate = maximum(options.zoom.support[1], 0.0) * seconds
    return initial_view(options, layout, height, width)[1] * np.exp(rate) if rate < 50 else math.inf


def sample_view(
    key: Array, options: Any, layout: Layout, states: State, fps: float, height: int, width: int
) -> CameraView:
    """View of one video: motion sampled from the options, relative to the followed object if there is one."""
    frames = states.position.shape[0]
    time = jnp.arange(frames, dtype=jnp.float32) / fps

    def sample(name: str, source: Any) -> Array:
        return source.sample(key_for(key, name), ())

    start, scale = initial_view(options, layout, height, width)
    pan = jnp.stack([sample(f"pan {axis}", speed) for axis, speed in zip("xy", options.pan, strict=True)])
    center = jnp.asarray(start, jnp.float32) + time[:, None] * pan
    if options.follow is not None:
        center = center - jnp.asarray(start, jnp.float32) + states.position[:, options.follow]
    if options.shake.support != (0.0, 0.0):
        center = center + sample("shake", options.shake) * _tremor(
            jax.random.fold_in(key, 1), time, options.shake_hertz
        )
    zoom, turn, angle = sample("zoom", options.zoom), sample("turn", options.turn), sample("angle", options.angle)
    return CameraView(center, scale * jnp.exp(zoom * time), angle + turn * time)


def _tremor(key: Array, time: Array, hertz: float) -> Array:
    """Displacement [T, 2] of hand shake with a root mean square of 1 per axis: a sum of sines whose frequencies are not
    multiples of one another."""
    phase = jax.random.uniform(key, (len(TREMOR), 2), maxval=2 * math.pi)
    rates = 2 * math.pi * hertz * jnp.asarray(TREMOR)
    waves = jnp.sin(time[:, None, None] * rates[:, None] + phase)
    return waves.sum(1) * math.sqrt(2 / len(TREMOR))
