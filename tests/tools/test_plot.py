"""Plots show what a dataset holds."""

import sys
from pathlib import Path

import cv2
import pytest
import synthetic
import tiny
from packages import require

from gen2d.tools.plot import plot


def test_plots_are_pictures_that_are_the_same_each_time(tmp_path: Path) -> None:
    require("matplotlib")
    root = tmp_path / "some folder"
    fields = synthetic.FIELDS | {"factors/x": synthetic.Field("float32", "n", "m", "a factor")}
    synthetic.make(synthetic.dataset(root, fields=fields))
    paths = plot(root, tmp_path / "a", video=3)
    assert [path.name for path in paths] == [
        *("some folder-train-3.png", "some folder-train-3.svg", "some folder-factors.png", "some folder-factors.svg")
    ]
    for path, again in zip(paths, plot(root, tmp_path / "b", video=3), strict=True):
        assert path.read_bytes() == again.read_bytes()
        if path.suffix == ".png":
            image = cv2.imread(str(path))
            assert image is not None
            assert image.std() > 10
    other = plot(root, tmp_path / "c", video=4)
    assert other[0].read_bytes() != paths[0].read_bytes()


def test_what_cannot_be_plotted_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    require("matplotlib")
    synthetic.make(synthetic.dataset(tmp_path / "toy"))
    done = tiny.run_main("plot", tmp_path / "toy", "--video", 20)
    assert (done.returncode, done.stderr) == (2, "gen2d: --video is 20, but must be from 0 to 19 for train\n")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    done = tiny.run_main("plot", tmp_path / "toy")
    assert (done.returncode, done.stderr) == (2, "gen2d: plots need matplotlib: pip install 'gen2d[plot]'\n")
