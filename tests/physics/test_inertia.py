"""Laws of mass and moment: they are integrals over the shape, so a shape may be cut up, moved and padded.

The reference is exact: over a triangle, the integral of a polynomial of degree two is the mean of its values at the
middles of the sides times the area; a capsule is a polygon of very many corners.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from gen2d.physics.inertia import (
    box_vertices,
    disc_mass,
    disc_moment,
    polygon_centroid,
    polygon_mass,
    polygon_moment,
    stadium_mass,
    stadium_moment,
)

LENGTH = st.floats(0.01, 10)
SEED = st.integers(0, 2**32 - 1)


@pytest.fixture(autouse=True)
def exact():
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        yield


def integrated(vertices: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Area, centroid and moment about it per kg: sums over a fan of triangles from a point that is none of its own."""
    apex = vertices.mean(0) + np.array([0.3, -0.2])  # near them, as far triangles cancel
    p, q = vertices - apex, np.roll(vertices, -1, 0) - apex
    area = (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]) / 2
    middles = apex + np.stack([p, q, p + q]) / 2
    whole = area.sum()
    centre = (area[:, None] * middles.mean(0)).sum(0) / whole
    return whole, centre, (area * ((middles - centre) ** 2).sum(-1).mean(0)).sum() / whole


def capsule(half_length: float, radius: float, corners: int = 200_000) -> np.ndarray:
    turn = (np.arange(corners) + 0.5) * 2 * np.pi / corners
    return radius * np.stack([np.cos(turn), np.sin(turn)], -1) + half_length * np.sign(np.cos(turn))[:, None] * [1, 0]


def convex(seed: int) -> np.ndarray:
    """Five corners somewhere, counter-clockwise, the last of them twice more."""
    rng = np.random.default_rng(seed)
    turn = (np.arange(5) + rng.uniform(0, 0.8, 5)) * 2 * np.pi / 5
    corners = rng.normal(size=2) * 5 + rng.uniform(0.1, 2) * np.stack([np.cos(turn), np.sin(turn)], -1)
    return corners[[0, 1, 2, 3, 4, 4, 4]]


@settings(max_examples=30, deadline=None)
@given(seed=SEED, density=LENGTH)
def test_a_polygon_weighs_what_its_triangles_weigh(seed: int, density: float):
    corners = convex(seed)
    area, centre, moment = integrated(corners)
    mass = polygon_mass(jnp.asarray(corners), jnp.asarray(density))
    assert_allclose(mass, density * area, rtol=1e-9)
    assert_allclose(polygon_centroid(jnp.asarray(corners)), centre, rtol=1e-9, atol=1e-9)
    assert_allclose(polygon_moment(jnp.asarray(corners - centre), mass), density * area * moment, rtol=1e-9)


@settings(max_examples=30, deadline=None)
@given(half_length=st.floats(0, 10), radius=LENGTH, density=LENGTH)
def test_a_capsule_weighs_what_a_polygon_of_many_corners_weighs(half_length: float, radius: float, density: float):
    area, _, moment = integrated(capsule(half_length, radius))
    mass = stadium_mass(jnp.asarray(half_length), jnp.asarray(radius), jnp.asarray(density))
    assert_allclose(mass, density * area, rtol=1e-7)
    assert_allclose(stadium_moment(jnp.asarray(half_length), jnp.asarray(radius), mass), mass * moment, rtol=1e-7)


@settings(max_examples=30, deadline=None)
@given(length=LENGTH, mass=LENGTH)
def test_a_capsule_is_a_disc_or_a_rod_at_its_limits(length: float, mass: float):
    zero, x, m = jnp.asarray(0.0), jnp.asarray(length), jnp.asarray(mass)
    assert_allclose(stadium_mass(zero, x, m), disc_mass(x, m), rtol=1e-12)
    assert_allclose(stadium_moment(zero, x, m), disc_moment(x, m), rtol=1e-12)
    assert_allclose(stadium_moment(x, zero, m), mass * (2 * length) ** 2 / 12, rtol=1e-12)


@settings(max_examples=30, deadline=None)
@given(width=LENGTH, height=LENGTH, density=LENGTH)
def test_a_box_is_its_formula(width: float, height: float, density: float):
    corners = box_vertices(jnp.asarray(width), jnp.asarray(height))
    mass = polygon_mass(corners, jnp.asarray(density))
    assert_allclose(mass, width * height * density, rtol=1e-12)
    assert_allclose(polygon_centroid(corners), [0, 0], atol=1e-12)
    assert_allclose(polygon_moment(corners, mass), mass * (width**2 + height**2) / 12, rtol=1e-12)


def test_arrays_are_done_at_once():
    many = jnp.stack([jnp.asarray(convex(seed)) for seed in range(6)]).reshape(2, 3, 7, 2)
    density = jnp.arange(1.0, 7).reshape(2, 3)
    assert polygon_centroid(many).shape == (2, 3, 2)
    assert_allclose(polygon_mass(many, density)[1, 2], polygon_mass(many[1, 2], density[1, 2]))
    assert_allclose(polygon_moment(many, density)[1, 2], polygon_moment(many[1, 2], density[1, 2]))
    assert box_vertices(density, density).shape == (2, 3, 4, 2)


def test_an_empty_slot_has_no_moment_and_no_nan():
    zero, corners = jnp.asarray(0.0), jnp.zeros((5, 2))
    moments = (stadium_moment(zero, zero, zero), polygon_mass(corners, zero), polygon_moment(corners, zero))
    assert_allclose(jnp.stack(moments), 0)
    assert_allclose(polygon_centroid(corners), 0)
    slopes = jax.grad(lambda r: stadium_moment(r, r, r) + polygon_moment(corners * r, r))(zero)
    assert np.isfinite(slopes)
