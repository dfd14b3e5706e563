"""Pictures of the README's front: every family has its tile, bands cross all tiles, and bytes are the same again."""

import io

import front
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image, ImageSequence

from gen2d.config import plugins


def frames_of(content: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(content)) as file:
        return np.stack([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(file)])


def test_every_family_has_a_view_and_a_tile_of_its_own() -> None:
    places = front.tiles()
    assert set(front.VIEWS) == set(places) == set(plugins.names("scene"))
    area = np.zeros((600, 900), int)
    for tile in places.values():
        area[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width] += 1
    assert area.max() == 1
    widths = {sum(width for _, width in columns) + front.GAP * (len(columns) - 1) for _, columns in front.ROWS}
    assert len(widths) == 1
    assert area[:, : widths.pop()][area.any(1)].mean() > 0.95


def test_bands_of_masks_and_flow_cross_every_tile() -> None:
    places = {"one": front.Tile(0, 0, 30, 40), "other": front.Tile(34, 0, 50, 40)}
    parts = [np.full((16, 40, 84, 3), shade, np.uint8) for shade in (50, 100, 150, 200)]
    parts[3][..., 1:] = 0  # saturated
    films = {name: front.Film(*(part[:, :, : tile.width] for part in parts)) for name, tile in places.items()}
    film = front.front(films, places)
    assert film.shape == (32, 40, 84, 3)
    assert_array_equal(film[:, :, 30:34], np.broadcast_to(front.GROUND, (32, 40, 4, 3)))
    drawn = np.delete(film[..., 0], range(30, 34), axis=2)
    assert set(np.unique(drawn[:16])) == {50, 100}
    assert set(np.unique(drawn[16:])) == {150, 200}
    for look in (drawn[:16], drawn[16:]):
        covered = look == look.max()
        assert covered.any(0).all()
        assert covered.mean() < 0.5
        assert not covered[0].any()  # the band comes from outside


def test_masks_and_flow_lie_over_dimmed_frames() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (2, 8, 9, 3), np.uint8)
    black, white = np.zeros_like(frames), np.full_like(frames, 255)
    black[:, :4], white[:, :4] = (9, 200, 70), (0, 255, 128)
    film = front.Film(frames, black, frames, white)
    for drawn, color in ((front.with_masks(film), (9, 200, 70)), (front.with_flow(film), (0, 255, 128))):
        assert_array_equal(drawn[:, :4], np.broadcast_to(color, (2, 4, 9, 3)))
        assert_array_equal(drawn[:, 4:], front.dimmed(frames)[:, 4:])
    assert front.dimmed(frames).max() < 128


def test_a_film_has_the_best_quality_that_fits_and_the_same_bytes_again() -> None:
    rng = np.random.default_rng(0)
    frames = np.repeat(np.repeat(rng.integers(0, 256, (6, 12, 12, 1), np.uint8), 4, 1), 4, 2)
    frames = np.broadcast_to(frames, (6, 48, 48, 3))
    best = front.webp(frames, 16, 10**9)
    assert best == front.webp(frames, 16, len(best))
    assert abs(frames_of(best).astype(int) - frames).mean() < 12
    smaller = front.webp(frames, 16, len(best) - 1)
    assert len(smaller) < len(best)
    assert abs(frames_of(best).astype(int) - frames).mean() < abs(frames_of(smaller).astype(int) - frames).mean()
    assert len(frames_of(smaller)) == 6


@pytest.mark.full
def test_a_family_is_rendered_in_both_looks_with_masks_and_flow() -> None:
    film = front.film("uniform_motion", front.Tile(0, 0, 48, 40), frames=4)
    assert {part.shape for part in film} == {(4, 40, 48, 3)}
    ball, background = film.masks.max(-1) > 0, film.masks[0, 0, 0]
    assert_array_equal(background, 0)
    assert_array_equal((film.flow[:3] < 255).any(-1), ball[:3])  # only the ball moves
    first, second = (np.asarray(np.ptp(look[[0, 3]], 0).max(-1) > 30) for look in (film.first, film.second))
    there = ball[0] | ball[3]
    assert second.sum() > 20
    assert there[second].mean() > 0.7  # the others are on its rim
    assert (first & ~there).sum() > (second & ~there).sum()  # its shadow
