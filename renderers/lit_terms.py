"""Terms of the light on bodies that are the same at all pixels of a body, computed before those of each pixel."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.paint import Light, Pattern, Surface
from gen2d.renderers.primitives import ImagePose
from gen2d.renderers.relief import Relief, sloping_width


class LitTerms(NamedTuple):
    """Terms of the light on some slots that are the same at all their pixels; arrays [..., 1, 1]."""

    slope: Array  # sine of the steepest tilt
    inverse: Array  # 1 / px, of the width of the part that slopes
    toward: Array  # right, of the light, in the image
    down: Array
    height: Array  # towards the viewer
    soft: Array
    strength: Array  # of direct light, over `lambert`
    ambient: Array
    azimuth: Array  # 1 over the length of the light's direction in the plane
    half: Array  # 1 over the length of the sum of the directions of the light and the viewer
    width: Array  # 1 / the highlight's exponent
    spread: Array  # of the highlight, that a pixel adds across the light
    gloss: Array
    across: Array | None  # as in `_part_across`, unless it varies
    stripe: "StripeTerms | None"
    pattern: "PatternTerms | None"
    mirror: Array | None


class StripeTerms(NamedTuple):
    """Terms of the stripes of some discs; arrays [..., 1, 1]."""

    wide: Array  # px, extents of a pixel across the stripe
    narrow: Array
    reach: Array  # px, half width of the stripe and of a pixel
    area: Array  # 1 / (2 px^2), over the area of the pixel; 0 without a stripe
    dark: Array  # part of the object's own light that is lacking
    bright: Array  # part of it in the colour of highlights


class PatternTerms(NamedTuple):
    """Terms of the patterns of some slots; arrays [..., 1, 1]."""

    seed: Array
    along: Array  # cells in a pixel, along the x axis of the body
    across: Array
    contrast: Array


def lit_terms(light: Light, surface: Surface, relief: Relief, pose: ImagePose) -> LitTerms:
    """Terms of the slots [k] of a surface at I instants; arrays [k, I, 1, 1]."""

    def spread_out(values: Array) -> Array:
        return jnp.broadcast_to(values[:, None] if values.ndim else values, pose.cos.shape)

    lx, ly, lz = relief.light[..., 0], relief.light[..., 1], spread_out(light.direction[2])
    soft, ambient = spread_out(light.softness), spread_out(light.ambient)
    slope, bevel = spread_out(surface.slope), spread_out(surface.bevel)
    flat = 1 / jnp.maximum(jnp.sqrt(lx * lx + ly * ly), 1e-6)
    half = 1 / jnp.sqrt(2 + 2 * lz)
    # In pixels: the length over which the surface tilts, for averages over a pixel.
    radius = jnp.maximum(relief.radius if relief.normal is None else bevel * pose.scale, 0.5)
    across = None
    if relief.is_disc:
        across = jnp.ones_like(lx)
    elif relief.normal is None:
        across = jnp.abs((ly * pose.cos - lx * pose.sin) * flat)
    terms = LitTerms(
        slope,
        1 / sloping_width(relief, pose, bevel),
        lx,
        ly,
        lz,
        soft,
        (1 - ambient) / lambert(lz, soft),
        ambient,
        flat,
        half,
        1 / spread_out(surface.sharpness),
        (slope / radius) ** 2 / 12,
        spread_out(surface.gloss),
        across,
        _stripe_terms(surface, relief, pose, spread_out),
        None if surface.pattern is None else _pattern_terms(surface.pattern, pose, spread_out),
        None if surface.mirror is None else spread_out(surface.mirror),
    )
    return jax.tree.map(lambda a: a[..., None, None], terms)


def _stripe_terms(
    surface: Surface, relief: Relief, pose: ImagePose, spread_out: Callable[[Array], Array]
) -> StripeTerms | None:
    """Terms [k, I] of stripes; None on other shapes than discs."""
    if surface.stripe is None or surface.stripe_light is None or not relief.is_disc:
        return None
    half = spread_out(surface.stripe) * jnp.maximum(relief.radius, 0.5)
    wide, narrow = (jnp.maximum(jnp.abs(part), 0.02) for part in (pose.cos, pose.sin))
    # A stripe of 1 has the colour of highlights; one below 0 is a part of the object's own colour.
    light = spread_out(surface.stripe_light)
    area = jnp.where(half > 0, 0.5 / (wide * narrow), 0.0)
    return StripeTerms(wide, narrow, half + (wide + narrow) / 2, area, jnp.abs(light), jnp.maximum(light, 0.0))


def _pattern_terms(pattern: Pattern, pose: ImagePose, spread_out: Callable[[Array], Array]) -> PatternTerms:
    """Terms [k, I] of patterns."""
    seed, cell, stretch, contrast = map(spread_out, pattern)
    across = 1 / (cell * pose.scale)
    return PatternTerms(seed, across / stretch, across, contrast)


def lambert(cosine: Array, soft: Array) -> Array:
    """Light of a source of this softness on a surface, by the cosine of the angle between its normal and the light."""
    lit, whole = jnp.maximum(cosine + soft, 0.0), jnp.maximum(cosine - soft, 0.0)
    return (lit * lit - whole * whole) * (0.25 / soft)
