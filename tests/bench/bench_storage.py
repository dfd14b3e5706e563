"""Cost of writing and reading videos: gen2d, a plain h5py loop and a plain copy.

    python tests/bench/bench.py --only storage     # about 2 minutes

The videos are those of synthetic.discs, about 50 MB of frames, with states. They are read in one thread, from files in
the system's page cache, into preallocated arrays. Times are CPU times of this process.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import synthetic
from timing import timed

from gen2d.core.schema import Field
from gen2d.dataset.block import encode
from gen2d.dataset.folder import open_folder
from gen2d.dataset.rows import origin, seal_rows
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.dataset.spec import RECORDS, DatasetSpec, plan
from gen2d.generation.complete import complete
from gen2d.loading import dataset as loader
from gen2d.storage import codecs

FIELDS = {
    "frames": Field("uint8", "n T H W 3", "sRGB", "what is seen"),
    "states/position": Field("float32", "n T K 2", "m", "of the centre of mass"),
    "index": synthetic.FIELDS["index"],
    "time": synthetic.FIELDS["time"],
}


class Case(NamedTuple):
    """A size of videos, their number (50 MB of frames), and the targets as ratios of speeds."""

    pixels: int
    frames: int
    videos: int
    against_gzip4: float
    against_same: float
    against_copy: float
    mapped: float  # target without a codec, against a copy

    @property
    def name(self) -> str:
        """Name in the tables."""
        return f"{self.pixels} px, {self.frames} frames"


CASES = {
    case.name: case
    for case in (
        Case(64, 64, 64, 3, 1.5, 0.12, 0.35),
        Case(128, 64, 16, 4.5, 2.3, 0.23, 0.45),
        Case(256, 32, 8, 5, 2.8, 0.28, 0.45),
    )
}
WRITTEN = 0.8  # target of writing, against the codec alone
ROUNDS = 8  # copies of the videos in a shard where writing is measured, as shards are large


class Stored(NamedTuple):
    """A row of the table: MB of frames per second of CPU time, by method."""

    name: str
    rates: Mapping[str, float]


def works(case: Case, folder: Path) -> dict[str, Callable[[], float]]:
    """Functions by name that read, copy, compress or write all videos of a case and return the CPU seconds.

    Run this in a separate process: once hdf5plugin is imported, HDF5 writes the filter's name into new zstd files.
    """
    import hdf5plugin  # noqa: F401 (h5py reads zstd with it)

    frames = synthetic.discs(case.videos, case.frames, case.pixels)
    columns = {"frames": frames, "states/position": np.zeros((case.videos, case.frames, 8, 2), np.float32)}
    out = {name: np.empty_like(values) for name, values in columns.items()}
    with h5py.File(folder / "gzip-4.h5", "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), compression="gzip")
    measurements: dict[str, Callable[[], Any]] = {
        "copy": lambda: np.copyto(out["frames"], frames),
        "h5py gzip-4": lambda: _read_by_h5py(folder / "gzip-4.h5", out),
    }
    for codec in codecs.CODECS:
        spec = _dataset(case, folder / codec, codec)
        _write(spec, columns)
        assert complete(spec)
        ds = loader.open(spec.root, fields=tuple(columns))
        shard = folder / codec / "shards" / "train-00000.h5"
        measurements[f"loader {codec}"] = lambda ds=ds: ds.batch(range(case.videos), out=out)
        measurements[f"h5py {codec}"] = lambda shard=shard: _read_by_h5py(shard, out)
        if codec != "none":
            large = _dataset(case, folder / f"{codec} again", codec, ROUNDS)
            measurements[f"codec {codec}"] = lambda codec=codec: [codecs.encode(codec, video) for video in frames]
            measurements[f"write {codec}"] = lambda large=large: _write(large, columns)
    return {name: timed(work, ROUNDS if name.startswith("write") else 1) for name, work in measurements.items()}


def _dataset(case: Case, root: Path, codec: str, rounds: int = 1) -> DatasetSpec:
    sizes, count = {"T": case.frames, "H": case.pixels, "W": case.pixels, "K": 8}, rounds * case.videos
    counts = {"splits": {"train": count}, "videos_per_shard": count}
    spec = synthetic.dataset(root, codec=codec, fields=FIELDS, sizes=sizes, **counts)
    open_folder(spec)
    return spec


def _write(spec: DatasetSpec, columns: Mapping[str, np.ndarray]) -> None:
    """Write the only shard of the dataset, which holds the videos once or more often."""
    (shard,) = plan(spec.splits, spec.videos_per_shard)
    starts = [*range(0, len(columns["frames"]), 4)] * (shard.count // len(columns["frames"]))
    numbers = np.arange(shard.count)
    blocks = (
        encode(
            {name: values[i : i + 4] for name, values in columns.items()} | {"index": numbers[4 * k : 4 * k + 4]},
            spec.fields,
            spec.codec,
        )
        for k, i in enumerate(starts)
    )
    ShardWriter(spec).write(shard, blocks)


def many_shards(root: Path, count: int) -> dict[str, float]:
    """CPU seconds to find the remaining shards in a folder of `count` shards, and to complete the dataset.

    Most files are empty files of a shard's size; the last shards are still missing.
    """
    spec = synthetic.dataset(root, splits={"train": count}, videos_per_shard=1)
    remaining = open_folder(spec)
    with ShardWriter(spec) as writer:
        row = [writer.write(shard, synthetic.blocks(spec, shard)) for shard in remaining[:8]][-1]
    rows = np.repeat(row, count - 16)
    rows["first"] = np.arange(8, count - 8)
    seal_rows(rows, origin(spec.identity_sha256, "train"), rows["first"].tolist())
    (root / RECORDS / "train.0123456789abcdef.1").write_bytes(rows.tobytes())
    for shard in remaining[8:-8]:
        with (root / "shards" / f"{shard.name}.h5").open("wb") as file:
            file.truncate(int(row["bytes"][0]))
    seconds = {"resuming": timed(lambda: open_folder(spec), 1)()}
    with ShardWriter(spec) as writer:
        for shard in open_folder(spec):
            writer.write(shard, synthetic.blocks(spec, shard))
    seconds["finishing"] = timed(lambda: complete(spec), 1)()
    seconds["resuming when all is done"] = timed(lambda: open_folder(spec), 1)()
    seconds["opening and reading a video"] = timed(lambda: loader.open(root)[0], 1)()
    return seconds | {"all of it": sum(seconds.values())}


def _read_by_h5py(path: Path, out: Mapping[str, np.ndarray]) -> None:
    """Read every video of a file in a plain loop."""
    with h5py.File(path) as file:
        for name, target in out.items():
            dataset: Any = file[name]
            for i in range(len(target)):
                target[i] = dataset[i]


def stored_of(case: Case, seconds: Mapping[str, float]) -> Stored:
    """Row of the table, from the seconds for all videos."""
    size = case.videos * case.frames * case.pixels**2 * 3 / 1e6
    return Stored(case.name, {name: size / value for name, value in seconds.items()})


def table(lines: Sequence[Stored]) -> list[str]:
    """Lines of the table."""
    names = list(lines[0].rates)
    head = ["one core, MB of frames a second of CPU time", f"{'':16} " + " ".join(f"{line.name:>17}" for line in lines)]
    return [*head, *(f"{name:16} " + " ".join(f"{line.rates[name]:17,.0f}" for line in lines) for name in names)]
