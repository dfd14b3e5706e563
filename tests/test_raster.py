"""Frames: both forms the same image, discs where and as large as they are, walls where they stand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import box, world

from gen2d import raster
from gen2d.raster import Moving, Paint, View, backdrop, draw_dense, draw_patches, fitted


def one_disc(column: float, row: float, radius: float, size: int = 64) -> np.ndarray:
    """A white disc on black, [H, W] in grey levels."""
    discs = Moving(*(jnp.asarray(x, jnp.float32) for x in ([[[column]]], [[[row]]], [[radius]], [[[255.0] * 3]])))
    return np.asarray(draw_patches(jnp.zeros((1, size, size, 3), jnp.uint8), discs, radius))[0, 0, :, :, 0].astype(
        float
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("height", "width"), [(32, 32), (24, 40), (6, 50)])
def test_patches_and_dense_are_one_image(seed, height, width):
    rng = np.random.default_rng(seed)
    column, row = rng.uniform(-6, width + 6, (3, 5, 7)), rng.uniform(-6, height + 6, (3, 5, 7))
    radius = np.where(rng.random((3, 7)) < 0.2, raster.ABSENT, rng.uniform(0.3, 6, (3, 7)))
    discs = Moving(*(jnp.asarray(x, jnp.float32) for x in (column, row, radius, rng.integers(0, 256, (3, 7, 3)))))
    under = jnp.asarray(rng.integers(0, 256, (3, height, width, 3)), jnp.uint8)
    one = np.asarray(jax.jit(draw_patches, static_argnums=2)(under, discs, 6.0)).astype(int)
    other = np.asarray(jax.jit(draw_dense)(under, discs)).astype(int)
    assert np.abs(one - other).max() <= 1


@pytest.mark.parametrize("radius", [1.0, 2.5, 4.0, 8.0, 20.0])
def test_a_disc_has_its_area_and_its_centre(radius):
    rng = np.random.default_rng(1)
    grid = np.arange(64) + 0.5
    for column, row in rng.uniform(24, 40, (8, 2)):
        image = one_disc(column, row, radius)
        assert_allclose(image.sum() / 255, np.pi * radius**2, rtol=2e-3, atol=0.15)  # px^2
        assert_allclose((image.sum(0) @ grid) / image.sum(), column, atol=0.05)
        assert_allclose((image.sum(1) @ grid) / image.sum(), row, atol=0.05)


def test_a_pixel_on_the_rim_is_half_covered():
    assert_allclose(one_disc(32.5, 32.5, 8.0)[32, [32, 40, 41]], [255, 127, 0], atol=2)


def test_discs_are_drawn_back_to_front():
    discs = Moving(
        *(jnp.asarray(x, jnp.float32) for x in ([[[8.0, 10]]], [[[8.0, 8]]], [[4.0, 4]], [[[200.0] * 3, [90.0] * 3]]))
    )
    image = np.asarray(draw_patches(jnp.zeros((1, 16, 16, 3), jnp.uint8), discs, 4.0))[0, 0, :, :, 0]
    assert (image[8, 5], image[8, 9]) == (200, 90)


def test_the_camera_puts_up_up_and_the_middle_in_the_middle():
    view = fitted((0, 0, 10, 5), height=50, width=100, margin=0)
    assert (view.column(5.0), view.row(2.5), view.scale) == (50, 25, 10)
    assert (view.column(0.0), view.row(0.0), view.row(5.0)) == (0, 50, 0)
    wide = fitted((0, 0, 10, 5), height=100, width=100, margin=1)
    assert wide.scale == pytest.approx(100 / 12)


def test_walls_stand_where_they_are():
    scene, state, layout = world([{"x": (5, 5)}], box(8))
    view = View(50, 50, (5.0, 5.0), 5.0)
    paint = Paint(jnp.asarray([10.0, 20.0, 30.0]), jnp.full((5, 3), 200.0), jnp.full(4, 1.0))
    image = np.asarray(backdrop(scene, state, paint, layout, view))
    assert_array_equal(image[25, 25], [10, 20, 30])  # inside
    assert_array_equal(image[0, 0], [10, 20, 30])  # outside: the box is 1 to 9 m, 5 to 45 px
    for row, column in ((4, 25), (5, 25), (44, 25), (45, 25), (25, 4), (25, 5), (25, 44), (25, 45)):
        assert_array_equal(image[row, column], [200, 200, 200])
    hidden = np.asarray(backdrop(scene, state, paint._replace(line=jnp.full(4, -jnp.inf)), layout, view))
    assert (hidden == [10, 20, 30]).all()
