"""Coverage: the exact area of each shape in each pixel, beside closed forms and polygon areas in float64.

Errors are in grey levels of 255 before rounding; `pytest -rP` prints those reached. Shapes with straight sides
are not compiled as a whole, which would take longer than it saves.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import holds
from numpy.testing import assert_allclose
from worlds import disc_areas, outline, polygon_areas

from gen2d.renderers.coverage import disc as disc_module
from gen2d.renderers.coverage import polygon
from gen2d.renderers.extents import area_of
from gen2d.renderers.primitives import Primitive

SIZE, COUNT, CORNERS = 72, 64, 6  # px, shapes at once, corners of each
EDGES = np.arange(SIZE + 1)


@functools.partial(jax.jit, static_argnames="size")
def discs(centre, radius, size=SIZE):
    """The coverage [n, size, size] of discs about centres [n, 2]."""
    edges = jnp.arange(size, dtype=centre.dtype)
    return disc_module.disc_coverage(
        disc_module.disc_edge_terms(edges - centre[:, :1], edges - centre[:, 1:], radius), 1e9
    )


def rounded(corners, radius):
    """The coverage [n, SIZE, SIZE] of rounded polygons [n, V, 2]; no radius: sharp ones."""
    edges = jnp.broadcast_to(jnp.arange(SIZE, dtype=corners.dtype), (len(corners), SIZE))
    return polygon.polygon_coverage(polygon.polygon_edge_terms(edges, edges, corners, radius))


def compared(name, found, exact, mean, most):
    """Fails where coverages are not the exact areas: on the mean over pixels on an edge, and anywhere."""
    error = 255 * np.abs(np.asarray(found, float) - exact)
    edge = (exact > 1e-9) & (exact < 1 - 1e-9)
    print(f"{name}: mean {error[edge].mean():.4f}, most {error.max():.4f} of 255, {edge.sum()} pixels")
    assert error[edge].mean() <= mean
    assert error.max() <= most


def rims(rng, radii):
    """Centres [n, 2] that put a random point of each rim in the middle of the window, some where the disc touches a
    pixel's edge."""
    angle = rng.uniform(0, 2 * np.pi, len(radii))
    angle[:16] = np.arange(16) * (np.pi / 2)
    middle = SIZE / 2 + rng.uniform(-0.5, 0.5, (len(radii), 2))
    middle[:8], radii[:8] = SIZE / 2, np.ceil(radii[:8])
    centre = middle - radii[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    return centre.astype(np.float32), radii.astype(np.float32)


# ---- Discs


@pytest.mark.parametrize(
    ("low", "high", "mean", "most"),
    [(0.05, 2, 0.005, 0.02), (2, 4, 0.005, 0.02), (4, 32, 0.02, 0.2), (32, 63, 0.06, 0.5), (64, 128, 0.1, 2.0),
     (128, 1000, 0.05, 1.0)],
)  # fmt: skip
def test_a_disc_covers_its_area_of_every_pixel(low, high, mean, most):
    rng = np.random.default_rng(int(high))
    centre, radius = rims(rng, np.exp(rng.uniform(np.log(low), np.log(high), COUNT)))
    exact = [disc_areas(EDGES - c[0], EDGES - c[1], r) for c, r in zip(centre.astype(float), radius, strict=True)]
    compared(f"discs of {low} to {high} px", discs(centre, radius), np.array(exact), mean, most)


@pytest.mark.parametrize(("low", "high", "size"), [(0.2, 30, SIZE), (30, 300, 608)])
def test_the_pixels_of_a_disc_add_up_to_its_area(low, high, size):
    rng = np.random.default_rng(1)
    radius = np.geomspace(low, high, COUNT if size == SIZE else 12).astype(np.float32)
    centre = (size / 2 + rng.uniform(-0.5, 0.5, (len(radius), 2))).astype(np.float32)
    share = np.asarray(discs(centre, radius, size), float).sum((1, 2)) / (np.pi * radius.astype(float) ** 2)
    print(f"discs of {low} to {high} px: {np.abs(share - 1).max():.1e} of the area")
    assert_allclose(share, 1, atol=1e-3)
    assert_allclose(share, 1, atol=3e-5)


def centroids(cover):
    middles = np.arange(SIZE) + 0.5
    cover = np.asarray(cover, float)
    return np.stack([cover.sum(1) @ middles, cover.sum(2) @ middles], -1) / cover.sum((1, 2))[:, None]


def centroid_offset(radius):
    """Largest distance, px along an axis, of the centroid of the coverage of a disc from its centre; fails if the
    centroid is not that of exact areas."""
    centre = (SIZE / 2 + np.random.default_rng(2).uniform(-0.5, 0.5, (COUNT, 2))).astype(np.float32)
    found = centroids(discs(centre, np.full(COUNT, radius, np.float32)))
    exact = [disc_areas(EDGES - c[0], EDGES - c[1], radius) for c in centre.astype(float)]
    assert_allclose(found, centroids(exact), atol=1e-4)
    return np.abs(found - centre).max()


@pytest.mark.parametrize("radius", [2.0, 3.0, 5.5, 12.0, 30.0])
def test_the_centroid_follows_a_disc_between_pixels(radius):
    holds(f"centroid of a disc of {radius} px, px", centroid_offset(radius), 0.01)


@pytest.mark.asked
@pytest.mark.parametrize(("radius", "bound"), [(0.4, 0.14), (1.0, 0.024), (1.5, 0.014)])
def test_the_centroid_follows_a_disc_that_is_smaller_than_four_pixels(radius, bound):
    # Exact areas have these centroids: pixels alias what is finer than they are, J1(2 pi r) / (pi^2 r) of it.
    holds(f"centroid of a disc of {radius} px, px", centroid_offset(radius), bound, asked=0.01)


# ---- Shapes with straight sides


def capsules(rng, special=True):
    """Some [n, 2, 2] with their radii: at every eighth of a turn and at any angle; and, if special ones are wanted,
    along the edges of pixels and without length."""
    angle = np.concatenate([np.arange(16) * (np.pi / 4), rng.uniform(0, 2 * np.pi, COUNT - 16)])
    half = rng.uniform(1, 16, COUNT) * (np.arange(COUNT) % 10 > 0 if special else 1)
    along = half[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    along[:16] = np.round(along[:16], 6)  # level and upright to the last bit
    centre = SIZE / 2 + rng.uniform(-0.5, 0.5, (COUNT, 2))
    radius = np.exp(rng.uniform(np.log(0.3), np.log(16), COUNT))
    if special:
        centre[::4], radius[::4] = SIZE / 2, np.ceil(radius[::4])
    return np.stack([centre - along, centre + along], 1).astype(np.float32), radius.astype(np.float32)


def polygons(rng, special=True):
    """Some [n, 6, 2] of 3 to 6 corners, the last given more than once: of any shape, and upright boxes; if special ones
    are wanted, half of these along the edges of pixels."""
    found = []
    for i in range(COUNT):
        count, half = 3 + i % 4, rng.uniform(1.5, 16, 2)
        angle = np.sort((np.arange(count) + rng.uniform(0, 0.8, count)) * (2 * np.pi / count)) + rng.uniform(
            0, 2 * np.pi
        )
        corners, centre = half * np.stack([np.cos(angle), np.sin(angle)], -1), rng.uniform(-0.5, 0.5, 2)
        if i % 4 == 0:
            corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        if i % 8 == 0 and special:
            corners, centre = np.ceil(corners), 0
        found.append(np.concatenate([corners, np.repeat(corners[-1:], CORNERS - len(corners), 0)]) + centre + SIZE / 2)
    return np.asarray(found, np.float32)


def exact_areas(corners, radius=None):
    radius = np.zeros(len(corners)) if radius is None else np.asarray(radius, float)
    return np.array(
        [polygon_areas(outline(np.asarray(c, float), r), SIZE, SIZE) for c, r in zip(corners, radius, strict=True)]
    )


def test_a_capsule_covers_its_area_of_every_pixel():
    corners, radius = capsules(np.random.default_rng(3))
    compared("capsules", rounded(corners, radius), exact_areas(corners, radius), 0.005, 0.05)


def test_a_polygon_covers_its_area_of_every_pixel():
    corners = polygons(np.random.default_rng(4))
    compared("polygons", rounded(corners, None), exact_areas(corners), 0.005, 0.05)


def test_a_rounded_polygon_covers_its_area_of_every_pixel():
    rng = np.random.default_rng(5)
    corners, radius = polygons(rng), np.exp(rng.uniform(np.log(0.3), np.log(12), COUNT)).astype(np.float32)
    compared("rounded polygons", rounded(corners, radius), exact_areas(corners, radius), 0.005, 0.05)


def test_what_has_no_area_covers_nothing():
    rng = np.random.default_rng(6)
    points = np.repeat(rng.uniform(0, SIZE, (COUNT, 1, 2)), CORNERS, 1).astype(np.float32)
    lines = rng.uniform(0, SIZE, (COUNT, 2, 2)).astype(np.float32)
    for cover in (
        discs(points[:, 0], np.zeros(COUNT, np.float32)),
        rounded(points, None),
        rounded(points, np.zeros(COUNT, np.float32)),
        rounded(lines, np.zeros(COUNT, np.float32)),
    ):
        assert_allclose(cover, 0, atol=1e-4)


def test_two_parts_make_a_whole():
    corners = polygons(np.random.default_rng(7))
    one, other = corners.copy(), corners.copy()
    one[:, 3:] = one[:, 2:3]  # the triangle of the first three corners
    other[:, 1] = other[:, 0]  # the rest
    assert_allclose(rounded(one, None) + rounded(other, None), rounded(corners, None), atol=2e-4)


def test_a_capsule_without_length_and_a_rounded_point_are_discs():
    rng = np.random.default_rng(8)
    centre = rng.uniform(30, 42, (COUNT, 2)).astype(np.float32)
    radius = rng.uniform(0.3, 20, COUNT).astype(np.float32)
    disc = discs(centre, radius)
    assert_allclose(rounded(np.repeat(centre[:, None], 2, 1), radius), disc, atol=3e-4)
    assert_allclose(rounded(np.repeat(centre[:, None], CORNERS, 1), radius), disc, atol=3e-4)


def test_areas_of_primitives_are_those_of_their_outlines():
    rng = np.random.default_rng(14)
    for corners, radius in (
        capsules(rng),
        (polygons(rng), None),
        (polygons(rng), rng.uniform(0.3, 12, COUNT).astype(np.float32)),
    ):
        found = area_of(Primitive(jnp.asarray(corners), None if radius is None else jnp.asarray(radius)), disc=False)
        assert_allclose(found, exact_areas(corners, radius).sum((1, 2)), rtol=1e-4)
    radius = np.asarray([0.5, 3], np.float32)
    assert_allclose(area_of(Primitive(jnp.zeros((2, 2)), jnp.asarray(radius)), disc=True), np.pi * radius**2, rtol=1e-6)


# ---- Derivatives


def weights():
    """A picture that each coverage is weighted with: derivatives of each pixel's share count."""
    return np.random.default_rng(9).uniform(-1, 1, (SIZE, SIZE)).astype(np.float32)


def differences(value, shape, step):
    """The derivatives of value(parameters) [n] with respect to parameters [n, ...], by central differences."""
    found = np.zeros(shape.shape)
    for place in np.ndindex(shape.shape[1:]):
        move = np.zeros(shape.shape)
        move[(slice(None), *place)] = step
        found[(slice(None), *place)] = (value(shape + move) - value(shape - move)) / (2 * step)
    return found


def disc_slopes(centre, radius):
    return jax.grad(lambda *of: (weights() * discs(*of)).sum(), argnums=(0, 1))(centre, radius)


def rounded_slopes(corners, radius):
    if radius is None:
        return jax.grad(lambda of: (weights() * rounded(of, None)).sum())(corners), None
    return jax.grad(lambda *of: (weights() * rounded(*of)).sum(), argnums=(0, 1))(corners, radius)


def alike(name, found, exact, mean, most):
    """Fails where slopes are not these, but for shares of their root mean square."""
    error = np.abs(np.asarray(found, float) - exact) / np.sqrt(np.square(exact).mean())
    print(f"{name}: mean {error.mean():.1e}, most {error.max():.1e} of a usual slope")
    assert error.mean() <= mean
    assert error.max() <= most


@pytest.mark.parametrize(("low", "high", "mean", "most"), [(0.3, 32, 1e-4, 5e-3), (70, 500, 5e-3, 5e-2)])
def test_a_disc_moves_and_grows_as_its_slopes_say(low, high, mean, most):
    rng = np.random.default_rng(10)
    centre, radius = rims(rng, np.exp(rng.uniform(np.log(low), np.log(high), COUNT)))
    some, weight = np.arange(COUNT) >= 16, weights()  # not where discs touch edges

    def total(of):
        areas = [disc_areas(EDGES - c[0], EDGES - c[1], c[2]) for c in of]
        return (weight * np.array(areas)).sum((1, 2))

    exact = differences(total, np.concatenate([centre.astype(float), radius[:, None]], 1)[some], 1e-4)
    slope = [np.asarray(slope)[some] for slope in disc_slopes(centre, radius)]
    alike(f"discs of {low} to {high} px, centre", slope[0], exact[:, :2], mean, most)
    alike(f"discs of {low} to {high} px, radius", slope[1], exact[:, 2], mean, most)


@pytest.mark.parametrize("kind", [pytest.param("capsule", marks=pytest.mark.full), "polygon", "rounded"])
def test_a_shape_changes_as_its_slopes_say(kind):
    rng, weight = np.random.default_rng(13), weights()
    corners, radius = capsules(rng, special=False)
    if kind != "capsule":
        corners = polygons(rng, special=False)[:, :4]
        radius = None if kind == "polygon" else rng.uniform(1, 9, COUNT).astype(np.float32)
    if radius is not None:  # with a level side, the slopes of round shapes are off by a few hundredths
        rise = np.abs(corners - np.roll(corners, 1, 1))[..., 1]
        length = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1)
        corners = np.where(((rise < 1e-3) & (length > 0)).any(1)[:, None, None], corners[-1:], corners)
    of_corners, of_radius = rounded_slopes(corners, radius)

    def total(of):
        return (weight * exact_areas(of, radius)).sum((1, 2))

    def grown(by):
        return (weight * exact_areas(corners, radius + by)).sum((1, 2))

    alike(f"{kind}, corners", of_corners, differences(total, corners.astype(float), 1e-3), 1e-3, 2e-2)
    if radius is not None:
        alike(f"{kind}, radius", of_radius, differences(grown, np.zeros(COUNT), 1e-3), 1e-3, 2e-2)


def test_slopes_are_finite_where_shapes_touch_edges_or_have_no_area():
    rng = np.random.default_rng(12)
    centre, radius = rims(rng, np.exp(rng.uniform(np.log(0.3), np.log(300), COUNT)))
    centre[16:32], radius[16:32] = np.round(centre[16:32]), np.arange(16) / 2
    on_edges = np.round(polygons(rng)[:, :4])
    on_edges[::5] = on_edges[::5, :1]  # a point
    on_edges[1::5, 2:] = on_edges[1::5, 1:2]  # a line
    slopes = [*disc_slopes(centre, radius)]
    for corners in (on_edges, np.round(capsules(rng)[0])):
        for grown in (np.zeros(COUNT, np.float32), (np.arange(COUNT) % 9).astype(np.float32)):
            slopes += rounded_slopes(corners, grown)
    slopes.append(rounded_slopes(on_edges, None)[0])
    for slope in slopes:
        assert np.isfinite(slope).all()
        assert np.abs(slope).max() < 2 * np.pi * 300  # what a whole rim can sweep
