"""Pixel coverage of discs, in closed form."""

from typing import NamedTuple

import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.renderers.coverage.arc import LARGE_RADIUS, QUARTER, under_arc


def pixel_edges(edges: Array) -> tuple[Array, Array]:
    """Both edges, 1 px apart, of pixels given by their left or top edges."""
    return edges, edges + 1


class DiscEdge(NamedTuple):
    """Terms of the corner areas that depend on one edge, a column's or a row's, alone."""

    at: Array  # px from the centre
    sign: Array  # of `at`
    area: Array  # U(at); for a row less a signed quarter of the disc
    square: Array  # at^2; for a column less radius^2


class PixelDisc(NamedTuple):
    """Discs with the edge terms of the columns and rows of a pixel grid."""

    left: DiscEdge  # [..., columns]
    right: DiscEdge
    top: DiscEdge  # [..., rows]
    bottom: DiscEdge
    radius: Array  # [..., 1]


def disc_edge_terms(x: Array, y: Array, radius: Array) -> PixelDisc:
    """Edge terms of discs of `radius` [...] px.

    The pixels have left edges x [..., columns] and top edges y [..., rows], relative to the centre of the disc.
    """
    radius = jnp.maximum(radius, 1e-6)[..., None]
    square = radius * radius

    def of_column(at: Array) -> DiscEdge:
        return DiscEdge(at, jnp.copysign(1.0, at), under_arc(at, radius), at * at - square)

    def of_row(at: Array) -> DiscEdge:
        sign = jnp.copysign(1.0, at)
        return DiscEdge(at, sign, under_arc(at, radius) - sign * (QUARTER * square), at * at)

    (left, right), (top, bottom) = map(pixel_edges, (x, y))
    return PixelDisc(of_column(left), of_column(right), of_row(top), of_row(bottom), radius)


def _corner(x: DiscEdge, y: DiscEdge) -> Array:
    """Signed area of the disc in the rectangle between its centre and a pixel corner, odd in both coordinates."""
    x, y = DiscEdge(*(a[..., None, :] for a in x)), DiscEdge(*(a[..., :, None] for a in y))
    return jnp.where(x.square + y.square < 0, x.at * y.at, y.sign * x.area + x.sign * y.area)


def disc_coverage(disc: PixelDisc, largest: float) -> Array:
    """Coverage [..., rows, columns] of discs whose radius is at most `largest` px."""
    upper = _corner(disc.right, disc.top) - _corner(disc.left, disc.top)
    area = (_corner(disc.right, disc.bottom) - _corner(disc.left, disc.bottom)) - upper
    if largest < LARGE_RADIUS:
        return area
    radius = disc.radius[..., None]
    return jnp.where(radius < LARGE_RADIUS, area, _large_disc(disc.left.at + 0.5, disc.top.at + 0.5, radius))


def _large_disc(x: Array, y: Array, radius: Array) -> Array:
    """Coverage of large discs, whose rim is nearly straight in each pixel, from pixel centres x and y.

    In coordinates (xi, eta) around a pixel's centre (x, y) the rim is f = (r^2 - x^2 - y^2) / 2 - (x xi + y eta)
    - (xi^2 + eta^2) / 2 = 0. Replacing the last term by its mean over the chord of the rim leaves a line that cuts the
    pixel.
    """
    x, y = jnp.abs(x)[..., None, :], jnp.abs(y)[..., :, None]
    small = jnp.maximum(jnp.minimum(x, y), 1e-3)
    large = jnp.maximum(jnp.maximum(x, y), small)
    inside = ((radius - x) * (radius + x) - y * y) / 2
    slope = small / large
    bend = jnp.minimum(jnp.square(inside / large), 0.7 * jnp.square((1 + slope) / 2)) / 2 + (1 + slope * slope) / 24
    depth = inside - bend
    reach = jnp.minimum(jnp.abs(depth), (large + small) / 2)
    corner = jnp.maximum(reach - (large - small) / 2, 0.0)
    part = (2 * small * reach - corner * corner) / (2 * small * large)
    return 0.5 + jnp.copysign(part, depth)
