"""One NumPy archive per video, KEY.npz, with each field under its name: `numpy.load(path)["states/position"]`."""

from pathlib import Path

from gen2d.plugin import Batch, Export, Source, arrays


def write(target: Path, source: Source) -> None:
    """Write KEY.npz for each video to the folder; each also contains `time`, which all videos share."""

    def write_archive(key: str, video: Batch) -> None:
        (target / f"{key}.npz").write_bytes(arrays.archive({**video, "time": source.ds.time}))

    source.each(write_archive)


EXPORT = Export(fields=("frames", "*"), write=write, separate=True)
