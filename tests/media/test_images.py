"""Animations hold the pixels that they were given, at their rate, or are refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from gen2d.core.errors import FolderError
from gen2d.media.contact_sheet import add_border
from gen2d.media.images import WEBP_SIDE, animate, writing


@pytest.mark.parametrize(("fps", "duration"), [(10, 100), (60, 17), (500, 11)])
def test_an_animation_holds_every_pixel_of_every_video(tmp_path: Path, fps: float, duration: int) -> None:
    videos = np.random.default_rng(0).integers(0, 256, (3, 4, 16, 24, 3), np.uint8)
    animate(tmp_path / "three.webp", videos, fps)
    with Image.open(tmp_path / "three.webp") as file:
        frames = [(np.asarray(frame.convert("RGB")), frame.info["duration"]) for frame in ImageSequence.Iterator(file)]
        assert file.info["loop"] == 0
    assert [shown for _, shown in frames] == [duration] * 4
    for t, (image, _) in enumerate(frames):
        first, second, third = (add_border(video[t]) for video in videos)
        expected = [[first, second], [third, np.zeros_like(third)]]
        np.testing.assert_array_equal(image, np.concatenate([np.concatenate(row, axis=1) for row in expected]))


def test_an_animation_larger_than_the_format_is_one_sentence(tmp_path: Path) -> None:
    wide = np.zeros((1, 1, 96, WEBP_SIDE, 3), np.uint8)  # and a border
    with pytest.raises(FolderError, match=f"at most {WEBP_SIDE} px"), writing(tmp_path):
        animate(tmp_path / "wide.webp", wide, 10)
    assert not list(tmp_path.iterdir())
