"""One NumPy archive per video, KEY.npz, with each field under its name: `numpy.load(path)["states/position"]`."""

import zipfile
from pathlib import Path

import numpy as np

from gen2d.plugin import Export, Source


def write(target: Path, source: Source) -> None:
    """Write KEY.npz for each video to the folder; each also contains `time`, which all videos share."""

    def write_archive(key: str, video: dict) -> None:
        with zipfile.ZipFile(target / f"{key}.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, values in {**video, "time": source.ds.time}.items():
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)

    source.each(write_archive)


EXPORT = Export(fields=("frames", "*"), write=write, separate=True)
