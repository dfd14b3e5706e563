"""Mass and moment of inertia of the shapes, for one object or arrays of them.

Polygons are vertices [..., V, 2], counter-clockwise. Repeated vertices have no effect, and a polygon without area, as
in an empty slot, has neither mass nor moment. Formulas: the shoelace formula and its second moments (R. Soerjadi, 1968;
C. Steger, 'On the calculation of arbitrary moments of polygons', 1996).
"""

import jax.numpy as jnp

from gen2d.records.axes import Array


def disc_mass(radius: Array, density: Array) -> Array:
    """Mass in kg of a solid disc; density in kg/m^2."""
    return jnp.pi * radius**2 * density


def disc_moment(radius: Array, mass: Array) -> Array:
    """Moment of inertia in kg m^2 of a solid disc about its centre: m r^2 / 2."""
    return 0.5 * mass * radius**2


def stadium_mass(half_length: Array, radius: Array, density: Array) -> Array:
    """Mass in kg of a solid capsule, a rectangle and two half discs: (4 l r + pi r^2) density, in kg/m^2."""
    return (4 * half_length + jnp.pi * radius) * radius * density


def stadium_moment(half_length: Array, radius: Array, mass: Array) -> Array:
    """Moment of inertia in kg m^2 of a solid capsule about its centre; of a rod, m l^2 / 3, without a radius.

    The rectangle's is m (l^2 + r^2) / 3; the half discs' m (r^2 / 2 + l^2 + 2 l c), with their centroids c = 4 r / 3 pi
    beyond the ends of the core line (parallel axes).
    """
    # Areas divided by r, so that they are positive for a rod.
    rectangle, discs = 4 * half_length, jnp.pi * radius
    area = rectangle + discs
    beyond = 4 * radius / (3 * jnp.pi)
    rectangle_moment = (half_length**2 + radius**2) / 3
    discs_moment = radius**2 / 2 + half_length**2 + 2 * half_length * beyond
    return mass * (rectangle * rectangle_moment + discs * discs_moment) / jnp.where(area > 0, area, 1.0)


def box_vertices(width: Array, height: Array) -> Array:
    """Corners [..., 4, 2] in m of a rectangle about its centre, counter-clockwise from the lower left."""
    x, y = width / 2, height / 2
    return jnp.stack([jnp.stack(corner, axis=-1) for corner in ((-x, -y), (x, -y), (x, y), (-x, y))], axis=-2)


def polygon_mass(vertices: Array, density: Array) -> Array:
    """Mass in kg of a solid polygon; density in kg/m^2."""
    return _crosses(vertices - vertices[..., :1, :]).sum(-1) / 2 * density


def polygon_centroid(vertices: Array) -> Array:
    """Centre of mass [..., 2] in m of a solid polygon; its first vertex if it has no area."""
    first = vertices[..., :1, :]
    corners = vertices - first  # small numbers, as the terms below cancel far from the origin
    crosses = _crosses(corners)
    moments = (crosses[..., None] * (corners + _next(corners))).sum(-2)
    return first[..., 0, :] + moments / _divisor(3 * crosses.sum(-1))[..., None]


def polygon_moment(vertices: Array, mass: Array) -> Array:
    """Moment of inertia in kg m^2 of a solid polygon about the origin, its centre of mass."""
    crosses, after = _crosses(vertices), _next(vertices)
    squares = (vertices**2 + vertices * after + after**2).sum(-1)
    return mass * (crosses * squares).sum(-1) / _divisor(6 * crosses.sum(-1))


def _next(vertices: Array) -> Array:
    return jnp.roll(vertices, -1, axis=-2)


def _crosses(vertices: Array) -> Array:
    """Twice the area [..., V] in m^2 of the triangle of the origin and each edge."""
    after = _next(vertices)
    return vertices[..., 0] * after[..., 1] - vertices[..., 1] * after[..., 0]


def _divisor(area: Array) -> Array:
    """Area to divide by: 1 where it is zero."""
    return jnp.where(area > 0, area, 1.0)
