"""What it costs to write videos and to read them again: gen2d, a plain h5py loop and a plain copy.

    python tests/bench/bench.py --only storage     # about 2 minutes

The videos are those of synthetic.discs, about 50 MB of frames, with a state beside each. They are read in one thread,
from files that the system still has in memory, into a batch that is there already. Times are of this process's CPU.
"""

import time
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
from gen2d.dataset.rows import origin, sealed_rows
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
    """A size of video, how many are 50 MB, and the least that is promised."""

    pixels: int
    frames: int
    videos: int
    against_gzip4: float
    against_same: float
    against_copy: float
    mapped: float  # without a codec, against a copy

    @property
    def name(self) -> str:
        """As it stands in the tables."""
        return f"{self.pixels} px, {self.frames} frames"


CASES = {
    case.name: case
    for case in (
        Case(64, 64, 64, 3, 1.5, 0.12, 0.35),
        Case(128, 64, 16, 4.5, 2.3, 0.23, 0.45),
        Case(256, 32, 8, 5, 2.8, 0.28, 0.45),
    )
}
WRITTEN = 0.8  # of the speed of the codec alone
ROUNDS = 8  # how often a shard holds the videos when writing is measured: shards are large


class Stored(NamedTuple):
    """A line of the table: MB of frames a second of CPU time."""

    name: str
    rates: Mapping[str, float]


def works(case: Case, folder: Path) -> dict[str, Callable[[], float]]:
    """By name what reads, copies, compresses or writes all videos of a case and returns the CPU seconds.

    In a process of its own: where hdf5plugin is imported, HDF5 writes the filter's name into new zstd files.
    """
    import hdf5plugin  # noqa: F401 (h5py reads zstd with it)

    frames = synthetic.discs(case.videos, case.frames, case.pixels)
    columns = {"frames": frames, "states/position": np.zeros((case.videos, case.frames, 8, 2), np.float32)}
    out = {name: np.empty_like(values) for name, values in columns.items()}
    with h5py.File(folder / "gzip-4.h5", "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), compression="gzip")
    found: dict[str, Callable[[], Any]] = {
        "copy": lambda: np.copyto(out["frames"], frames),
        "h5py gzip-4": lambda: _looped(folder / "gzip-4.h5", out),
    }
    for codec in codecs.CODECS:
        made = _dataset(case, folder / codec, codec)
        _write(made, columns)
        assert complete(made)
        ds = loader.open(made.root, fields=tuple(columns))
        shard = folder / codec / "shards" / "train-00000.h5"
        found[f"loader {codec}"] = lambda ds=ds: ds.batch(range(case.videos), out=out)
        found[f"h5py {codec}"] = lambda shard=shard: _looped(shard, out)
        if codec != "none":
            large = _dataset(case, folder / f"{codec} again", codec, ROUNDS)
            found[f"codec {codec}"] = lambda codec=codec: [codecs.encode(codec, video) for video in frames]
            found[f"write {codec}"] = lambda large=large: _write(large, columns)
    return {name: timed(work, ROUNDS if name.startswith("write") else 1) for name, work in found.items()}


def _dataset(case: Case, root: Path, codec: str, rounds: int = 1) -> DatasetSpec:
    sizes, count = {"T": case.frames, "H": case.pixels, "W": case.pixels, "K": 8}, rounds * case.videos
    plan = {"splits": {"train": count}, "videos_per_shard": count}
    made = synthetic.dataset(root, codec=codec, fields=FIELDS, sizes=sizes, **plan)
    open_folder(made)
    return made


def _write(made: DatasetSpec, columns: Mapping[str, np.ndarray]) -> None:
    """Writes the dataset's one shard, which holds the videos once or more."""
    (shard,) = plan(made.splits, made.videos_per_shard)
    starts = [*range(0, len(columns["frames"]), 4)] * (shard.count // len(columns["frames"]))
    numbers = np.arange(shard.count)
    blocks = (
        encode(
            {name: values[i : i + 4] for name, values in columns.items()} | {"index": numbers[4 * k : 4 * k + 4]},
            made.fields,
            made.codec,
        )
        for k, i in enumerate(starts)
    )
    ShardWriter(made).write(shard, blocks)


def of_many_shards(root: Path, count: int) -> dict[str, float]:
    """CPU seconds to find out what is left to do in a folder of so many shards, and to complete it.

    Most files hold nothing and have the size of a shard; the last shards are still to be made.
    """
    made = synthetic.dataset(root, splits={"train": count}, videos_per_shard=1)
    todo = open_folder(made)
    with ShardWriter(made) as writer:
        row = [writer.write(shard, synthetic.blocks(made, shard)) for shard in todo[:8]][-1]
    rows = np.repeat(row, count - 16)
    rows["first"] = np.arange(8, count - 8)
    sealed_rows(rows, origin(made.identity_sha256, "train"), rows["first"].tolist())
    (root / RECORDS / "train.0123456789abcdef.1").write_bytes(rows.tobytes())
    for shard in todo[8:-8]:
        with (root / "shards" / f"{shard.name}.h5").open("wb") as file:
            file.truncate(int(row["bytes"][0]))
    seconds = {"resuming": _cpu_seconds(lambda: open_folder(made))}
    with ShardWriter(made) as writer:
        for shard in open_folder(made):
            writer.write(shard, synthetic.blocks(made, shard))
    seconds["finishing"] = _cpu_seconds(lambda: complete(made))
    seconds["resuming when all is done"] = _cpu_seconds(lambda: open_folder(made))
    seconds["opening and reading a video"] = _cpu_seconds(lambda: loader.open(root)[0])
    return seconds | {"all of it": sum(seconds.values())}


def _cpu_seconds(work: Callable[[], Any]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def _looped(path: Path, out: Mapping[str, np.ndarray]) -> None:
    """Reads every video of a file as people do."""
    with h5py.File(path) as file:
        for name, target in out.items():
            dataset: Any = file[name]
            for i in range(len(target)):
                target[i] = dataset[i]


def stored_of(case: Case, seconds: Mapping[str, float]) -> Stored:
    """The line, from the seconds of all videos."""
    size = case.videos * case.frames * case.pixels**2 * 3 / 1e6
    return Stored(case.name, {name: size / value for name, value in seconds.items()})


def table(lines: Sequence[Stored]) -> list[str]:
    """Lines of text."""
    names = list(lines[0].rates)
    head = ["one core, MB of frames a second of CPU time", f"{'':16} " + " ".join(f"{line.name:>17}" for line in lines)]
    return [*head, *(f"{name:16} " + " ".join(f"{line.rates[name]:17,.0f}" for line in lines) for name in names)]
