"""The one loop: which videos are missing, made batch by batch, written shard by shard."""

import contextlib
import dataclasses
import numbers
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gen2d.config.config import Config, checked_seed, load_config, own_files
from gen2d.config.trust import remember
from gen2d.core.errors import ConfigError
from gen2d.core.progress import progress, stopping_on_sigterm
from gen2d.dataset import folder as shards
from gen2d.dataset.spec import SPLIT, DatasetSpec, Shard, shards_of_worker
from gen2d.generation.complete import complete
from gen2d.generation.encoder import Encoder, shard_ranges, threads_for
from gen2d.generation.warm_up import warm_up
from gen2d.generation.writers import ShardWriters
from gen2d.programs import devices
from gen2d.programs.fingerprint import fingerprint, sources
from gen2d.programs.source import VideoSource
from gen2d.records.keys import MAX_VIDEOS
from gen2d.storage.paths import Network, Place, place

CONVENTIONS = (
    "World: metres, y up, radians counter-clockwise, seconds. Pixels: (row, column) from the top left, pixel centres "
    "at j + 0.5. Frame 0 is the initial state, frame t the state at t / fps. An empty slot is zero everywhere."
)


@dataclasses.dataclass(frozen=True)
class Summary:
    """What a run did."""

    out: Place
    made: int  # videos
    total: int  # videos in the folder's plan
    seconds: float
    bytes: int  # written
    complete: bool  # False while other workers' shards are missing

    @property
    def videos_per_second(self) -> float:
        return self.made / self.seconds if self.seconds else 0.0


def generate(
    config: Config | Mapping | str | Path,
    n: int,
    out: str | Place | None = None,
    *,
    seed: int | None = None,
    split: str | None = None,
    overrides: Sequence[str] = (),
    device: str = "auto",
    worker: tuple[int, int] = (0, 1),
    overwrite: bool = False,
    say: Callable[[str], None] | None = None,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> Summary:
    """Makes what is missing of a dataset of `n` videos in a split, and returns what it did.

    `config` is a file's name or path, a mapping or a Config; `overrides` change single options ('physics.substeps=8').
    Without `split` it is "train", or each that the config has: `n` videos, or as many as it says there.
    Video i depends on the config, the seed, the split and i alone, so a run may be stopped and repeated, extended to a
    larger `n`, or shared by workers (`worker=(r, W)`: this one is number r of W). `out` is datasets/NAME by default,
    and may be a URL that fsspec can write to, with `timeout` and `deadline` as in `open`.
    `say` takes lines for a person. Raises ConfigError, FolderError or DeviceError (all UserError), or
    UnreachableError, with one sentence.
    """
    say = say or (lambda line: None)
    config = load_config(config, overrides)
    if seed is not None:
        config = dataclasses.replace(config, seed=checked_seed(seed))
    counts = _counts(config, _check_run(n, split, worker, overwrite), split)
    network = Network(timeout, deadline)
    out = place(out, network) if out is not None else Path("datasets") / config.name
    remember(config.copies.values())
    on = devices.prepare(device)
    with contextlib.closing(VideoSource(config, on)) as source:
        dataset = dataset_of(source, out, counts, fingerprint(source.rollout))
        remaining = [shard for shard in shards.open_folder(dataset, overwrite) if shard.split in counts]
        todo = shards_of_worker(remaining, *worker)
        began, made = time.perf_counter(), sum(shard.count for shard in todo)
        size = make(source, dataset, todo, say)
    is_complete = complete(dataset)
    seconds = time.perf_counter() - began
    if todo:
        entry = {"time": time.time(), "host": os.uname().nodename, "videos": made, "seconds": seconds, "bytes": size}
        shards.log(out, entry | {"devices": len(on), "platform": on[0].platform})
    return Summary(out, made, sum(counts.values()), seconds, size, is_complete)


def _counts(config: Config, n: int, split: str | None) -> dict[str, int]:
    """How many videos of each split are wanted."""
    if split is not None:
        config.row(split)  # says if there is no such split
        return {split: n}
    return {own.name: own.videos or n for own in config.splits} or {"train": n}


def _check_run(n: Any, split: str | None, worker: tuple[int, int], overwrite: bool) -> int:
    """n as an int, if all of it is possible."""
    if isinstance(n, bool) or not isinstance(n, numbers.Integral) or not 1 <= int(n) <= MAX_VIDEOS:
        raise ConfigError(f"--n is {n!r}, but must be a whole number from 1 to 2**32 - 1")
    if split is not None and not SPLIT.fullmatch(split):
        raise ConfigError(f"--split is {split!r}, but must be letters, digits, '.', '_' and '-', 64 at most")
    if overwrite and worker[1] > 1:
        raise ConfigError("--overwrite and --worker cannot go together: a worker would remove what others have made")
    if not 0 <= worker[0] < worker[1]:
        raise ConfigError(f"--worker is {worker[0]}/{worker[1]}, but must be r/W with r from 0 to W - 1")
    return int(n)


def dataset_of(
    source: VideoSource, out: Place, counts: Mapping[str, int], fingerprint: Mapping[str, Any]
) -> DatasetSpec:
    """What the folder `out` is to hold, of videos that programs with this fingerprint make."""
    config, schema = source.config, source.schema
    return DatasetSpec(
        root=out,
        name=config.name,
        fields=schema.fields,
        sizes=schema.sizes,
        seed=config.seed,
        config=config.recipe(),
        config_text=config.recipe_text(),
        producer={**devices.versions(), "sources": sources(), "fingerprint": fingerprint},
        splits=counts,
        videos_per_shard=source.rollout.videos_per_shard,
        codec=config.storage.codec,
        chunk_frames=config.storage.chunk_frames,
        fps=config.video.fps,
        constants=schema.constants,
        conventions=CONVENTIONS,
        command="python -m gen2d --config config.yaml",
        copies={place: config.copies[name] for place, name in own_files(config.plain()).items()},
    )


def make(source: VideoSource, dataset: DatasetSpec, todo: list[Shard], say: Callable[[str], None]) -> int:
    """The bytes written for these shards, which are done then."""
    sources = source.of_splits(shard.split for shard in todo)
    return sum(_make(own, dataset, [shard for shard in todo if shard.split in splits], say) for own, splits in sources)


def _make(source: VideoSource, dataset: DatasetSpec, todo: list[Shard], say: Callable[[str], None]) -> int:
    encoder, writers = Encoder(source, dataset, threads_for(devices.cores())), ShardWriters(dataset)
    ranges, size = shard_ranges(todo), 0
    with stopping_on_sigterm(say):  # also while it cleans up: then a second signal ends the process
        try:
            count = sum(shard.count for shard in todo)
            warm_up(source, encoder, ranges, count, say)
            with progress(count, say) as advance:
                for shard, block in encoder.blocks(ranges):
                    writers.put(shard, block)
                    size += block.nbytes
                    advance(len(block))
            writers.finish()
        except BaseException:
            writers.drop()
            raise
        finally:
            encoder.close()
    return size
