"""Lens and sensor: frames as a camera records them.

The stages follow each other as light does; a stage that is None is left out:

1. the lens: radial distortion, then a vignette;
2. the exposure gain, the shot noise of the light, and the white balance, which amplifies its noise;
3. display values from 0 to 255, to which sensor noise is added, rounded to 8 bits;
4. a JPEG round trip (renderers/jpeg.py).

Stages 1 and 2 work in linear light, where 1 is white. Distances from the middle of the frame are over half of its
diagonal, so corners are at 1. At a distance r, a distorted frame shows what lies at

    r (1 + k r^2) / (1 + max(k, k b^2))

without distortion, where b is the distance of the nearest border: the view is scaled so that it shows nothing from
beyond the frame. With k > 0 the distortion is that of a barrel, with k < 0 that of a pincushion (D. Brown, 'Decentering
distortion of lenses', 1966, whose first radial coefficient is k).
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array
from gen2d.renderers.color import LINEAR, to_srgb
from gen2d.renderers.jpeg import round_trip
from gen2d.renderers.noise import hashed

SHOT = 1  # word that tells the hashes of shot noise from those of sensor noise
FAR, STEPS = 2.0, 8  # largest distance of a distorted point, and steps of Newton's method


class Sensor(NamedTuple):
    """Numbers of a video's lens and sensor [], named like the options of `image`; None: the stage is left out."""

    distortion: Array | None = None  # k
    vignette: Array | None = None  # part of the light that is missing in the corners
    exposure_gain: Array | None = None  # stops
    shot_noise: Array | None = None  # standard deviation where the light is 1
    white_balance: Array | None = None  # stops, of red over blue
    noise: Array | None = None  # sRGB, standard deviation
    jpeg_quality: Array | None = None  # 1 to 100


def record(
    sensors: Sensor | None, seeds: Array, frames: Array | None, owners: Array | None, height: int, width: int
) -> tuple[Array | None, Array | None]:
    """Frames [n, T, H, W, 3] and owners [n, T, H, W] uint8 as sensors [n] record them, with seeds [n] of noise.

    An owner is that of the pixel's centre, without distortion. Either may be None.
    """
    if sensors is None:
        return frames, owners

    def video(entry: tuple[Any, ...]) -> tuple[Array | None, Array | None]:
        sensor, seed, frames, owners = entry
        if owners is not None and sensor.distortion is not None:
            column, row = undistorted_centers(sensor.distortion, height, width)
            pixel = jnp.floor(row).astype(jnp.int32) * width + jnp.floor(column).astype(jnp.int32)
            owners = owners.reshape(len(owners), -1)[:, pixel.ravel()].reshape(owners.shape)
        return None if frames is None else _record_frames(sensor, seed, frames), owners

    frames, owners = jax.lax.map(video, (sensors, seeds, frames, owners))
    if frames is not None and sensors.jpeg_quality is not None:
        # In a loop of its own, or the compiler would compute all other stages again for each product of the codec.
        frames = jax.lax.map(lambda entry: round_trip(*entry), (frames, sensors.jpeg_quality))
    return frames, owners


def _record_frames(sensor: Sensor, seed: Array, frames: Array) -> Array:
    """Frames [T, H, W, 3] uint8 of one video as its sensor records them, before the codec."""
    numbers, values = jnp.arange(len(frames)), frames
    if any(stage is not None for stage in sensor[: Sensor._fields.index("noise")]):
        values = to_srgb(jnp.clip(_light(sensor, seed, numbers, frames), 0.0, 1.0))
    if sensor.noise is not None:
        values = values.astype(jnp.float32) + _gaussian(sensor.noise, values.shape, seed, numbers)
    if values is not frames:
        values = jnp.clip(jnp.floor(values + 0.5), 0, 255).astype(jnp.uint8)
    return values


def _light(sensor: Sensor, seed: Array, numbers: Array, frames: Array) -> Array:
    """Light [T, H, W, 3] after stages 1 and 2."""
    height, width = frames.shape[1:3]
    light = jnp.asarray(LINEAR)[frames.astype(jnp.int32)]
    if sensor.distortion is not None:
        light = _distorted(light, sensor.distortion)
    if sensor.vignette is not None:
        x, y = _from_middle(height, width)
        light = light * (1 - sensor.vignette * (x * x + y * y))[..., None]
    if sensor.exposure_gain is not None:
        light = light * jnp.exp2(sensor.exposure_gain)
    if sensor.shot_noise is not None:
        light = light + jnp.sqrt(light) * _gaussian(sensor.shot_noise, frames.shape, seed, numbers, SHOT)
    if sensor.white_balance is not None:
        light = light * jnp.exp2(sensor.white_balance * jnp.asarray([0.5, 0.0, -0.5]))
    return light


def _gaussian(deviation: Array, shape: tuple[int, ...], seed: Array, numbers: Array, *stage: int) -> Array:
    """Approximately Gaussian noise [T, H, W, 3] of standard deviation `deviation`, seeded by frame number.

    The noise of a value is the sum of four random bytes, which has a variance of (256^2 - 1) / 3.
    """
    pixels = jnp.arange(math.prod(shape[1:]), dtype=jnp.uint32).reshape(shape[1:])
    words = hashed(seed, numbers[:, None, None, None], pixels, *stage)
    sums = functools.reduce(jnp.add, [((words >> shift) & 255).astype(jnp.int32) for shift in (0, 8, 16, 24)])
    return (sums - 510).astype(jnp.float32) * (deviation / math.sqrt((256**2 - 1) / 3))


# ---- Distortion


def _from_middle(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns [1, W] and rows [H, 1] of pixel centres from the middle of the frame, over half of its diagonal."""
    half = math.hypot(height, width) / 2
    x, y = ((np.arange(size) + 0.5 - size / 2) / half for size in (width, height))
    return x[None].astype(np.float32), y[:, None].astype(np.float32)


def _widening(distortion: Array, height: int, width: int) -> Array:
    """The divisor by which the view is scaled so that it shows nothing from beyond the frame."""
    border = min(height, width) / math.hypot(height, width)
    return 1 + jnp.maximum(distortion, distortion * border**2)


def undistorted_centers(distortion: Array, height: int, width: int) -> tuple[Array, Array]:
    """Columns and rows [H, W] in px, without distortion, of what the centres of pixels show; within the frame."""
    x, y = _from_middle(height, width)
    factor = (1 + distortion * (x * x + y * y)) / _widening(distortion, height, width)
    half = math.hypot(height, width) / 2
    column, row = (size / 2 + half * part * factor for size, part in ((width, x), (height, y)))
    return jnp.clip(column, 0.0, width - 1e-3), jnp.clip(row, 0.0, height - 1e-3)


def _distorted(light: Array, distortion: Array) -> Array:
    """Images [T, H, W, 3] of light, distorted, by bilinear interpolation between centres of pixels."""
    frames, height, width, _ = light.shape
    column, row = undistorted_centers(distortion, height, width)
    column, row = (jnp.clip(a - 0.5, 0.0, size - 1.0) for a, size in ((column, width), (row, height)))
    left, top = (jnp.floor(a).astype(jnp.int32) for a in (column, row))
    right, bottom = jnp.minimum(left + 1, width - 1), jnp.minimum(top + 1, height - 1)
    across, down = (column - left)[..., None], (row - top)[..., None]
    flat = light.reshape(frames, -1, 3)

    def at(rows: Array, columns: Array) -> Array:
        return flat[:, (rows * width + columns).ravel()].reshape(light.shape)

    upper = at(top, left) * (1 - across) + at(top, right) * across
    lower = at(bottom, left) * (1 - across) + at(bottom, right) * across
    return upper * (1 - down) + lower * down


def distorted_points(points: Array, distortion: Array, height: int, width: int) -> Array:
    """Places [..., 2] in px (column, row) in the distorted frame, of places without distortion.

    Points far beyond the frame, which a pincushion would fold back, are at twice the distance of a corner.
    """
    half, middle = math.hypot(height, width) / 2, jnp.asarray([width / 2, height / 2], jnp.float32)
    away = (points - middle) / half
    length = jnp.sqrt((away * away).sum(-1))
    target = length * _widening(distortion, height, width)
    radius = jnp.minimum(target, FAR)
    for _ in range(STEPS):  # Newton's method for r (1 + k r^2) = target
        slope = jnp.maximum(1 + 3 * distortion * radius * radius, 0.05)
        radius = jnp.clip(radius - (radius * (1 + distortion * radius * radius) - target) / slope, 0.0, FAR)
    scale = jnp.where(length > 0, radius / jnp.where(length > 0, length, 1.0), 1.0)
    return middle + half * away * scale[..., None]
