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
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.core.sizes import divisor
from gen2d.records.axes import Array
from gen2d.renderers.color import light_of, scaled_values, values_of
from gen2d.renderers.jpeg import round_trip
from gen2d.renderers.noise import hashed
from gen2d.xla import on_cpu

CHUNK = 2**15  # px that are recorded at once on a CPU, in whole frames
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
    if owners is not None and sensors.distortion is not None:
        owners = jax.lax.map(lambda entry: _distorted_owners(*entry), (owners, sensors.distortion))
    if frames is None:
        return frames, owners
    shape, chunk = frames.shape, frames.shape[1]
    if on_cpu():
        chunk = divisor(chunk, max(1, CHUNK // (height * width)))
    # Values of a frame come last, so that each operation runs over many of them.
    frames = frames.reshape(-1, chunk, height * width * 3)
    if any(stage is not None for stage in sensors[: Sensor._fields.index("jpeg_quality")]):
        frames = _record_frames(sensors, seeds, frames, height, width)
    if sensors.jpeg_quality is not None:
        # In a loop of its own, or the compiler would compute all other stages again for each product of the codec.
        qualities = jnp.repeat(sensors.jpeg_quality, len(frames) // len(seeds))
        coded = jax.lax.map(lambda part: round_trip(*part), (frames.reshape(-1, chunk, height, width, 3), qualities))
        return coded.reshape(shape), owners
    return frames.reshape(shape), owners


class _Grid(NamedTuple):
    """What is known of the values of t frames before they are rendered: arrays that broadcast to those values.

    The values are [t, H * W * 3], or [H * W, t * 3] if there are taps, each of which then is a whole row of values.
    """

    number: Array  # of a value in its frame
    lens: Array | None  # gains of the light before shot noise; None: 1
    balance: Array | None  # and after it
    taps: "Taps | None"


def _record_frames(sensors: Sensor, seeds: Array, frames: Array, height: int, width: int) -> Array:
    """Frames of n videos, in chunks [n * C, t, H * W * 3] uint8, as their sensors record them, before the codec."""
    count, chunk, size = frames.shape
    each = count // len(seeds)  # chunks of a video
    grids = jax.lax.map(lambda sensor: _grid(sensor, chunk, height, width), sensors)
    numbers = jnp.arange(each * chunk)
    states = [hashed(seeds[:, None], *stage, numbers).reshape(count, chunk) for stage in ((SHOT,), ())]

    def some(entry: tuple[Array, Array, list[Array]]) -> Array:
        i, values, states = entry
        sensor, grid = jax.tree.map(lambda a: a[i // each], (sensors, grids))
        states = [state[:, None] if grid.taps is None else jnp.repeat(state, 3) for state in states]
        values = _developed(sensor, grid, values.astype(jnp.int32).astype(jnp.float32), states[0])
        if sensor.noise is not None:
            values = values + _gaussian(sensor.noise, states[1], grid.number)
        return (jnp.clip(values, 0.0, 255.0) + 0.5).astype(jnp.int32).astype(jnp.uint8)

    if grids.taps is None:
        return jax.lax.map(some, (jnp.arange(count), frames, states))
    # In loops of their own, or the compiler would compute values in the order of the transposed ones.
    rows = jax.lax.map(lambda part: part.reshape(chunk, -1, 3).swapaxes(0, 1).reshape(-1, chunk * 3), frames)
    rows = jax.lax.map(some, (jnp.arange(count), rows, states))
    return jax.lax.map(lambda part: part.reshape(-1, chunk, 3).swapaxes(0, 1).reshape(chunk, size), rows)


def _grid(sensor: Sensor, chunk: int, height: int, width: int) -> _Grid:
    """Grid of a video in chunks of so many frames. Gains that scale display values are those of all stages."""
    power = 1.0 if _in_light(sensor) else 1 / 2.4
    taps = None if sensor.distortion is None else _taps(sensor.distortion, height, width)

    def spread(pixels: Array) -> Array:
        pixels = jnp.broadcast_to(pixels, (height, width, 3)).reshape(-1, 3)
        return pixels.reshape(-1) if taps is None else jnp.tile(pixels, (1, chunk))

    factors, balance = [], None
    if sensor.vignette is not None:
        x, y = _from_middle(height, width)
        factors.append(jnp.maximum(1 - sensor.vignette * (x * x + y * y), 0.0)[..., None] ** power)
    if sensor.exposure_gain is not None:
        factors.append(jnp.exp2(sensor.exposure_gain * power))
    if sensor.white_balance is not None:
        balance = jnp.exp2(sensor.white_balance * power * jnp.asarray([0.5, 0.0, -0.5]))
    if balance is not None and not _in_light(sensor):
        factors.append(balance)
        balance = None
    lens = spread(functools.reduce(jnp.multiply, factors)) if factors else None
    number = jnp.arange(height * width * 3, dtype=jnp.uint32).reshape(height, width, 3)
    return _Grid(spread(number), lens, None if balance is None else spread(balance), taps)


def _in_light(sensor: Sensor) -> bool:
    """Whether a stage is more than a factor of the light."""
    return sensor.distortion is not None or sensor.shot_noise is not None


def _developed(sensor: Sensor, grid: _Grid, values: Array, state: Array) -> Array:
    """sRGB values, at most 255, of sRGB values after stages 1 and 2; `state` is that of the shot noise."""
    if not _in_light(sensor):
        return values if grid.lens is None else jnp.minimum(scaled_values(values, grid.lens), 255.0)
    light = light_of(values)
    if grid.taps is not None:
        rows = [light.at[pixel].get(mode="promise_in_bounds") for pixel in grid.taps.pixel]
        light = functools.reduce(jnp.add, [row * w[:, None] for row, w in zip(rows, grid.taps.weight, strict=True)])
    if grid.lens is not None:
        light = light * grid.lens
    if sensor.shot_noise is not None:
        light = light + jnp.sqrt(light) * _gaussian(sensor.shot_noise, state, grid.number)
    if grid.balance is not None:
        light = light * grid.balance
    return values_of(jnp.clip(light, 0.0, 1.0))


def _gaussian(deviation: Array, state: Array, number: Array) -> Array:
    """Approximately Gaussian noise of standard deviation `deviation`, seeded by a state and the number of a value.

    The noise of a value is the sum of four random bytes, which has a variance of (256^2 - 1) / 3.
    """
    words = hashed(number, state=state)
    pairs = (words & 0x00FF00FF) + ((words >> 8) & 0x00FF00FF)
    sums = ((pairs + (pairs >> 16)) & 0xFFFF).astype(jnp.int32)
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


class Taps(NamedTuple):
    """Pixels [4, H * W] between whose centres the centres of distorted pixels lie, and their weights."""

    pixel: Array
    weight: Array


def _taps(distortion: Array, height: int, width: int) -> Taps:
    """Taps of bilinear interpolation between centres of pixels."""
    column, row = undistorted_centers(distortion, height, width)
    column, row = (jnp.clip(a - 0.5, 0.0, size - 1.0) for a, size in ((column, width), (row, height)))
    left, top = (jnp.floor(a).astype(jnp.int32) for a in (column, row))
    right, bottom = jnp.minimum(left + 1, width - 1), jnp.minimum(top + 1, height - 1)
    across, down = column - left, row - top
    pixels = [y * width + x for y in (top, bottom) for x in (left, right)]
    weights = [v * u for v in (1 - down, down) for u in (1 - across, across)]
    return Taps(jnp.stack(pixels).reshape(4, -1), jnp.stack(weights).reshape(4, -1))


def _distorted_owners(owners: Array, distortion: Array) -> Array:
    """Owners [T, H, W] at the centres of distorted pixels."""
    column, row = undistorted_centers(distortion, *owners.shape[1:])
    pixel = jnp.floor(row).astype(jnp.int32) * owners.shape[2] + jnp.floor(column).astype(jnp.int32)
    return owners.reshape(len(owners), -1)[:, pixel.ravel()].reshape(owners.shape)


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
