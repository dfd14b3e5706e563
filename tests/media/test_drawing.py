"""Drawing for people: colours are those of HSV, shapes cover their areas, and text is in its strip."""

import colorsys

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from gen2d.media.drawing import Canvas, label, rgb_of
from gen2d.media.images import png

BLACK = (0, 0, 0)


def test_colours_are_those_of_hsv() -> None:
    hue, saturation = np.meshgrid(np.linspace(0, 720, 49), np.linspace(0, 1, 9))
    for value in (0.0, 0.4, 1.0):
        expected = [
            colorsys.hsv_to_rgb(h / 360 % 1, s, value) for h, s in zip(hue.ravel(), saturation.ravel(), strict=True)
        ]
        found = rgb_of(hue, saturation, value)
        assert (found.dtype, found.shape) == (np.uint8, (*hue.shape, 3))
        assert np.abs(found.reshape(-1, 3) - 255 * np.array(expected)).max() <= 0.5 + 1e-6


def darkness(canvas: Canvas) -> tuple[float, np.ndarray]:
    """Area that is drawn black, px^2, and its centre (x, y), px."""
    cover = 1 - canvas.image[..., 0] / 255
    y, x = np.mgrid[: cover.shape[0], : cover.shape[1]] + 0.5
    return cover.sum(), np.array([(cover * x).sum(), (cover * y).sum()]) / cover.sum()


@pytest.mark.parametrize("at", [(20.0, 15.0), (20.3, 15.6), (19.9, 14.2)])
def test_shapes_cover_their_areas_at_their_places(at: tuple[float, float]) -> None:
    def drawn(name: str, *arguments: object) -> tuple[float, np.ndarray]:
        canvas = Canvas(30, 40)
        getattr(canvas, name)(*arguments, BLACK)
        return darkness(canvas)

    center = np.array(at)
    box = center + np.array([(-6, -4), (6, -4), (6, 4), (-6, 4)])
    half = np.array((5, 3))
    disc, square = drawn("disc", center, 7.0), drawn("polygon", box)
    line = drawn("line", center - half, center + half, 3.0)
    length = np.hypot(10, 6)
    for (area, _), exact, perimeter in (
        (disc, 49 * np.pi, 14 * np.pi),
        (square, 96, 40),
        (line, 3 * length + 2.25 * np.pi, 2 * length + 3 * np.pi),
    ):
        assert -0.01 * exact < area - exact < perimeter / 5  # Pillow adds a part of a sample at the edges
    assert_allclose([disc[1], square[1], line[1]], [at] * 3, atol=0.15)  # half a sample
    assert drawn("outline", box, 1.0)[0] == pytest.approx(40 + 80 / 8, rel=0.1)


def test_shapes_may_reach_beyond_the_picture() -> None:
    canvas = Canvas(20, 20)
    canvas.disc(np.array([0.0, 0.0]), 1e9, BLACK)
    assert not canvas.image.any()
    canvas.polygon(np.array([(100, 100), (110, 100), (110, 110)]), (255, 0, 0))
    assert not canvas.image.any()


def test_lines_of_a_label_stand_below_each_other() -> None:
    dark = [(label(lines, 60, 110) < 128).any((1, 2)) for lines in ([], ["one"], ["one", "two"])]
    assert not dark[0].any()
    assert 0 < np.flatnonzero(dark[1])[0] < np.flatnonzero(dark[1])[-1] < np.flatnonzero(dark[2])[-1] < 60


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_opencv_reads_the_same_pixels(dtype: type) -> None:
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (7, 12, 3), dtype, endpoint=True)
    found = np.asarray(cv2.imdecode(np.frombuffer(png(image), np.uint8), cv2.IMREAD_UNCHANGED))
    assert found.dtype == dtype
    assert (found[..., ::-1] == image).all()
