"""Light on surfaces, computed in linear light, and the display values of lit bodies.

A surface with the normal n gets the light

    E(n) = (1 - a) D(n) / D(z) + a ((1 + n_z) / 2 + 0.25 u),    D(n) = ((c + s)_+^2 - (c - s)_+^2) / (4 s),    c = n l

from a source in the direction l of softness s, by Lambert's law with a parabola between cosines of -s and s, and of
ambient light a from the viewer's side, a part of which comes from above, where u is the upward part of n. A surface
that faces the viewer gets 1, and has its own colour. Display values are proportional to F = E^(1/2.2), so one factor
serves all channels; above 1, it bends until it is constant, so that few colours reach 255.

Of metal, a part m of F is instead the display value of a room that it reflects,

    R(v) = 1 + 0.12 v - 0.44 (1 - ((v + 0.4) / 0.4)^2)^2,

where v is the part of n towards the light's azimuth: bright on the side of the light, with a dark band, the horizon,
beyond the middle (the last term is 0 outside of it). Highlights mix in their own colour: that of J. Blinn,
'Models of light reflection' (1977), as the fourth power of a parabola instead of a power of the cosine, a faint one
at the rim, and on metal one towards the light.
"""

from typing import NamedTuple

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.noise import noise
from gen2d.renderers.paint import Light, Pattern, Surface
from gen2d.renderers.primitives import ImagePose
from gen2d.renderers.relief import Relief, tilt

FROM_ABOVE = 0.25  # part of the ambient light that comes from above
SHOULDER = 0.12  # display values beyond 1 at which the shoulder ends, half as high
RIM = 0.25  # part of the light of the rim, seen at a grazing angle
SKY = 0.12  # change of the display value of a room from its middle to its sides
HORIZON, DARKEST = 0.4, 0.44  # place and half width of the dark band, and what it lacks
SHEEN = 0.7  # of metal: part of the light of the highlights' colour where a surface is vertical, towards the light
STEEPEST = 0.98  # largest square of the tilt; beyond the rim, surfaces are as at the rim


class ShadedColor(NamedTuple):
    """Colours color * share + accent * accent_share, at most 255, with shares of all channels of a pixel."""

    color: Array  # [..., 1, 1, 3] sRGB
    accent: Array  # [..., 1, 1, 3] sRGB
    share: Array  # [..., rows, columns]
    accent_share: Array


def as_color(shaded: Array | ShadedColor) -> Array:
    """Colours [..., rows, columns, 3] in floats."""
    if not isinstance(shaded, ShadedColor):
        return shaded
    color = shaded.share[..., None] * shaded.color + shaded.accent_share[..., None] * shaded.accent
    return jnp.minimum(color, 255.0)


def lit_color(
    color: Array, light: Light, surface: Surface, relief: Relief, pose: ImagePose, x: Array, y: Array, cover: Array
) -> ShadedColor:
    """Colours of lit bodies of `color` [..., 1, 1, 3], means of the covered part of each pixel.

    `x` [..., 1, columns] and `y` [..., rows, 1] are pixel centres relative to the body's centre, in px; `cover`
    [..., rows, columns] is the coverage.
    """
    slope, gloss, sharpness, soft, ambient = (
        a[..., None, None] for a in (surface.slope, surface.gloss, surface.sharpness, light.softness, light.ambient)
    )
    tilt_x, tilt_y, shown = tilt(relief, pose, x, y, surface.bevel, cover)
    nx, ny = slope * tilt_x, slope * tilt_y
    nz = jnp.sqrt(1 - jnp.minimum(nx * nx + ny * ny, STEEPEST))
    lx, ly, lz = (a[..., None, None] for a in (relief.light[..., 0], relief.light[..., 1], light.direction[..., 2]))
    along = nx * lx + ny * ly
    strength = (1 - ambient) / lambert(lz, soft)
    irradiance = strength * lambert(along + nz * lz, soft) + ambient * (0.5 + 0.5 * nz - FROM_ABOVE * ny)
    # In pixels: the length over which the surface tilts, for averages over a pixel.
    radius = jnp.maximum(relief.radius if relief.normal is None else surface.bevel * pose.scale, 0.5)[..., None, None]
    toward = along * (1 / jnp.maximum(jnp.sqrt(lx * lx + ly * ly), 1e-6))
    across = _part_across(relief, pose, nx, ny, toward)
    mirror = None if surface.mirror is None else surface.mirror[..., None, None]
    grain = None if surface.pattern is None else 1 + _pattern(surface.pattern, pose, x, y)
    if grain is not None:
        irradiance = irradiance * grain
    irradiance = jnp.maximum(irradiance, 0.01)  # beyond the rim, where the tilt is larger than any
    # The half vector of the light and the viewer.
    norm = 1 / jnp.sqrt(2 + 2 * lz)
    half_cosine = (along + nz * (lz + 1)) * norm
    # The average over a pixel widens the lobe, whose variance is 1 / sharpness in the plane of tilts, and lowers it: in
    # two directions on a disc, across the core of a capsule, and across the bevel of a polygon.
    spread = (1 + 4 * norm * norm) / 2 if relief.is_disc else 1 + (4 * norm * norm - 1) * across * across
    width = 1 / sharpness + (slope / radius) ** 2 * (spread / 12)
    part = 1 / (sharpness * width)
    shown = shown * (part if relief.is_disc else jnp.sqrt(part))
    lobe = jnp.maximum(1 - (1 - half_cosine) * (0.25 / width), 0.0)
    lobe, grazing = lobe * lobe, 1 - nz
    shine = gloss * shown * (lobe * lobe) + RIM * (grazing * grazing * grazing)
    shine, value = jnp.minimum(shine, 1.0), display(irradiance)
    if mirror is not None:
        shine = shine + SHEEN * mirror * jnp.maximum(toward, 0.0) ** 2 * (1 - shine)
        room = _room(toward, slope / radius * across) * (1.0 if grain is None else display(grain))
        value = value + mirror * (room - value)
    share = tone(value) * (1 - shine)
    if surface.stripe is None or surface.stripe_light is None or not relief.is_disc:
        return ShadedColor(color, light.highlight[..., None, None, :], share, shine)
    half = surface.stripe[..., None, None] * radius
    cos, sin = pose.cos[..., None, None], pose.sin[..., None, None]
    band = jnp.where(half > 0, _beyond_edge(half - jnp.abs(y * cos - x * sin), cos, sin), 0.0) * share
    # A stripe of 1 has the colour of highlights; one below 0 is a part of the object's own colour.
    bright = surface.stripe_light[..., None, None]
    return ShadedColor(
        color,
        light.highlight[..., None, None, :],
        share - jnp.abs(bright) * band,
        shine + jnp.maximum(bright, 0.0) * band,
    )


def lambert(cosine: Array, soft: Array) -> Array:
    """Light of a source of this softness on a surface, by the cosine of the angle between its normal and the light."""
    lit, whole = jnp.maximum(cosine + soft, 0.0), jnp.maximum(cosine - soft, 0.0)
    return (lit * lit - whole * whole) * (0.25 / soft)


def _part_across(relief: Relief, pose: ImagePose, nx: Array, ny: Array, toward: Array) -> Array | float:
    """Largest change of the tilt towards the light over that of the tilt: 1 on a disc, less where surfaces tilt in one
    direction only, which is across the core of a capsule or the nearest side of a polygon."""
    if relief.is_disc:
        return 1.0
    if relief.normal is not None:
        return jnp.abs(toward) / jnp.maximum(jnp.sqrt(nx * nx + ny * ny), 1e-6)
    lx, ly = relief.light[..., 0], relief.light[..., 1]
    part = (ly * pose.cos - lx * pose.sin) / jnp.maximum(jnp.sqrt(lx * lx + ly * ly), 1e-6)
    return jnp.abs(part)[..., None, None]


def _room(toward: Array, change: Array) -> Array:
    """Display value of a room as reflected where the normal has the part `toward` towards the light.

    `toward` changes by `change` in a pixel, over which the dark band is averaged: widened and lowered.
    """
    width = jnp.sqrt(HORIZON * HORIZON + 7 / 12 * change * change)
    band = jnp.maximum(1 - ((toward + HORIZON) / width) ** 2, 0.0)
    return 1 + SKY * toward - DARKEST * HORIZON / width * (band * band)


def _beyond_edge(depth: Array, cos: Array, sin: Array) -> Array:
    """Part of a pixel within a straight edge at a distance `depth` from the pixel's centre, in this direction."""
    a, b = (jnp.maximum(jnp.abs(part), 0.02) for part in (cos, sin))
    reach = jnp.clip(depth + (a + b) / 2, 0.0, a + b)
    return (reach**2 - jnp.maximum(reach - a, 0.0) ** 2 - jnp.maximum(reach - b, 0.0) ** 2) * (0.5 / (a * b))


def display(light: Array) -> Array:
    """Display values of light from 0.12 to 2, relative to those of 1: the power 1 / 2.2, with a shoulder above 1."""
    root = jnp.sqrt(light)
    return 0.02592 + root * (1.06405 + root * (-0.11431 + root * 0.02434))  # within 4e-4 of the power


def tone(value: Array) -> Array:
    """Display values with a shoulder above 1."""
    value = jnp.minimum(value, 1 + SHOULDER)
    over = jnp.maximum(value - 1, 0.0)
    return value - over * over * (0.5 / SHOULDER)


def _pattern(pattern: Pattern, pose: ImagePose, x: Array, y: Array) -> Array:
    """Relative change of the light [..., rows, columns] by a pattern."""
    seed, cell, stretch, contrast = (a[..., None, None] for a in pattern)
    cos, sin, scale = (a[..., None, None] for a in (pose.cos, pose.sin, pose.scale))
    along, across = (x * cos + y * sin) / scale, (y * cos - x * sin) / scale
    pixel = 1 / (cell * scale)
    return contrast * (2 * noise(along / (cell * stretch), across / cell, seed, pixel) - 1)
