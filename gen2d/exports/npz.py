"""A NumPy archive per video, KEY.npz, with every field under its name: `numpy.load(path)["states/position"]`."""

from pathlib import Path

import numpy as np

from gen2d.exports import Source

LOSS = ""
FIELDS, FIXED = ("frames", "*"), False
SUFFIX = ""


def check(source: Source) -> None:
    """Returns nothing: every dataset can be held."""


def write(target: Path, source: Source) -> None:
    """Fills the folder with KEY.npz; `time`, which is one for all videos, is in each."""

    def one(key: str, video: dict) -> None:
        np.savez_compressed(target / f"{key}.npz", **video, time=source.ds.time)

    source.each(one)
