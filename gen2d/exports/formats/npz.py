"""A NumPy archive per video, KEY.npz, with every field under its name: `numpy.load(path)["states/position"]`."""

import zipfile
from pathlib import Path

import numpy as np

from gen2d.plugin import Export, Source


def write(target: Path, source: Source) -> None:
    """Fills the folder with KEY.npz; `time`, which is one for all videos, is in each."""

    def one(key: str, video: dict) -> None:
        with zipfile.ZipFile(target / f"{key}.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, values in {**video, "time": source.ds.time}.items():
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)

    source.each(one)


EXPORT = Export(fields=("frames", "*"), write=write)
