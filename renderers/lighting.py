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
from gen2d.renderers.lit_terms import LitTerms, PatternTerms, StripeTerms, lambert
from gen2d.renderers.noise import noise
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
    color: Array, accent: Array, lit: LitTerms, relief: Relief, pose: ImagePose, x: Array, y: Array, cover: Array
) -> ShadedColor:
    """Colours of lit bodies of `color`, with highlights of `accent`, both [..., 1, 1, 3]; means of the covered part of
    each pixel.

    `x` [..., 1, columns] and `y` [..., rows, 1] are pixel centres relative to the body's centre, in px; `cover`
    [..., rows, columns] is the coverage.
    """
    tilt_x, tilt_y, shown = tilt(relief, pose, x, y, lit.inverse, cover)
    nx, ny = lit.slope * tilt_x, lit.slope * tilt_y
    square = nx * nx + ny * ny
    nz = jnp.sqrt(1 - jnp.minimum(square, STEEPEST))
    along = nx * lit.toward + ny * lit.down
    irradiance = lit.strength * lambert(along + nz * lit.height, lit.soft)
    irradiance = irradiance + lit.ambient * (0.5 + 0.5 * nz - FROM_ABOVE * ny)
    toward = along * lit.azimuth
    # The largest change of the tilt towards the light over that of the tilt: 1 on a disc, less where surfaces tilt in
    # one direction only, which is across the core of a capsule or the nearest side of a polygon.
    across = jnp.abs(toward) / jnp.maximum(jnp.sqrt(square), 1e-6) if lit.across is None else lit.across
    grain = None if lit.pattern is None else 1 + _pattern(lit.pattern, pose, x, y)
    if grain is not None:
        irradiance = irradiance * grain
    irradiance = jnp.maximum(irradiance, 0.01)  # beyond the rim, where the tilt is larger than any
    # The average over a pixel widens the lobe, whose variance is 1 / sharpness in the plane of tilts, and lowers it: in
    # two directions on a disc, across the core of a capsule, and across the bevel of a polygon.
    steeper = 4 * lit.half * lit.half
    spread = (1 + steeper) / 2 if relief.is_disc else 1 + (steeper - 1) * across * across
    width = 1 / (lit.width + lit.spread * spread)
    part = lit.width * width
    gloss = lit.gloss * (part if relief.is_disc else jnp.sqrt(part) * shown)
    # The half vector of the light and the viewer.
    lobe = jnp.maximum(1 - (1 - (along + nz * (lit.height + 1)) * lit.half) * (0.25 * width), 0.0)
    lobe, grazing = lobe * lobe, 1 - nz
    shine = gloss * (lobe * lobe) + RIM * (grazing * grazing * grazing)
    shine, value = jnp.minimum(shine, 1.0), display(irradiance)
    if lit.mirror is not None:
        shine = shine + SHEEN * lit.mirror * jnp.maximum(toward, 0.0) ** 2 * (1 - shine)
        room = _room(toward, jnp.sqrt(12 * lit.spread) * across) * (1.0 if grain is None else display(grain))
        value = value + lit.mirror * (room - value)
    share = tone(value) * (1 - shine)
    if lit.stripe is None:
        return ShadedColor(color, accent, share, shine)
    band = _stripe(lit.stripe, pose, x, y) * share
    return ShadedColor(color, accent, share - lit.stripe.dark * band, shine + lit.stripe.bright * band)


def _room(toward: Array, change: Array) -> Array:
    """Display value of a room as reflected where the normal has the part `toward` towards the light.

    `toward` changes by `change` in a pixel, over which the dark band is averaged: widened and lowered.
    """
    width = jnp.sqrt(HORIZON * HORIZON + 7 / 12 * change * change)
    band = jnp.maximum(1 - ((toward + HORIZON) / width) ** 2, 0.0)
    return 1 + SKY * toward - DARKEST * HORIZON / width * (band * band)


def _stripe(stripe: StripeTerms, pose: ImagePose, x: Array, y: Array) -> Array:
    """Part of each pixel [..., rows, columns] within the stripes."""
    away = jnp.abs(y * pose.cos[..., None, None] - x * pose.sin[..., None, None])
    reach = jnp.clip(stripe.reach - away, 0.0, stripe.wide + stripe.narrow)
    beyond = jnp.maximum(reach - stripe.wide, 0.0) ** 2 + jnp.maximum(reach - stripe.narrow, 0.0) ** 2
    return (reach**2 - beyond) * stripe.area


def display(light: Array) -> Array:
    """Display values of light from 0.12 to 2, relative to those of 1: the power 1 / 2.2, with a shoulder above 1."""
    root = jnp.sqrt(light)
    return 0.02592 + root * (1.06405 + root * (-0.11431 + root * 0.02434))  # within 4e-4 of the power


def tone(value: Array) -> Array:
    """Display values with a shoulder above 1."""
    value = jnp.minimum(value, 1 + SHOULDER)
    over = jnp.maximum(value - 1, 0.0)
    return value - over * over * (0.5 / SHOULDER)


def _pattern(pattern: PatternTerms, pose: ImagePose, x: Array, y: Array) -> Array:
    """Relative change of the light [..., rows, columns] by a pattern."""
    cos, sin = pose.cos[..., None, None], pose.sin[..., None, None]
    along, across = (x * cos + y * sin) * pattern.along, (y * cos - x * sin) * pattern.across
    return pattern.contrast * (2 * noise(along, across, pattern.seed, pattern.across) - 1)
