"""The one loop: which videos are missing, made batch by batch, written shard by shard."""

import contextlib
import dataclasses
import numbers
import os
import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gen2d import devices
from gen2d.complete import complete
from gen2d.config import Config, checked_seed, load_config, own_files
from gen2d.core.errors import ConfigError, FolderError, UserError
from gen2d.core.humanize import in_bytes, in_time
from gen2d.core.progress import progress, stopping_on_sigterm
from gen2d.dataset import folder as shards
from gen2d.dataset.block import Block
from gen2d.dataset.spec import SPLIT, DatasetSpec, Shard, mine
from gen2d.fingerprint import fingerprint, sources
from gen2d.pipeline import Encoder, Job, Writers, batches, jobs_of, threads_for
from gen2d.rollout import Batch, Rollout, divisor
from gen2d.storage.paths import Network, Place, place, shown
from gen2d.trust import remember

MAX_VIDEOS = 2**32 - 1
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


class DeviceMemoryError(UserError):
    """A batch that does not fit the device."""


def generate(
    config: Config | Mapping | str | Path,
    n: int,
    out: str | Place | None = None,
    *,
    seed: int | None = None,
    split: str | None = None,
    sets: Sequence[str] = (),
    device: str = "auto",
    worker: tuple[int, int] = (0, 1),
    overwrite: bool = False,
    say: Callable[[str], None] | None = None,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> Summary:
    """Makes what is missing of a dataset of `n` videos in a split, and returns what it did.

    `config` is a file's name or path, a mapping or a Config; `sets` overrides single options ('physics.substeps=8').
    Without `split` it is "train", or each that the config has: `n` videos, or as many as it says there.
    Video i depends on the config, the seed, the split and i alone, so a run may be stopped and repeated, extended to a
    larger `n`, or shared by workers (`worker=(r, W)`: this one is number r of W). `out` is datasets/NAME by default,
    and may be a URL that fsspec can write to, with `timeout` and `deadline` as in `open`.
    `say` takes lines for a person. Raises ConfigError, FolderError or DeviceError (all UserError), or
    UnreachableError, with one sentence.
    """
    say = say or (lambda line: None)
    config = load_config(config, sets)
    if seed is not None:
        config = dataclasses.replace(config, seed=checked_seed(seed))
    counts = _counts(config, _check_run(n, split, worker, overwrite), split)
    network = Network(timeout, deadline)
    out = place(out, network) if out is not None else Path("datasets") / config.name
    remember(config.copies.values())
    on = devices.prepare(device)
    with contextlib.closing(Rollout(config, on)) as rollout:
        dataset = dataset_of(rollout, out, counts)
        remaining = [shard for shard in shards.open_folder(dataset, overwrite) if shard.split in counts]
        todo = mine(remaining, *worker)
        began, made = time.perf_counter(), sum(shard.count for shard in todo)
        size = make(rollout, dataset, todo, say)
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


def rollouts_of(rollout: Rollout, splits: Iterable[str]) -> Iterator[tuple[Rollout, set[str]]]:
    """The programs that make these splits, each with its splits: one may have a look of its own, whose programs last
    until the next."""
    lots: dict[Config, set[str]] = {}
    for split in splits:
        lots.setdefault(rollout.config.of_split(split), set()).add(split)
    for own, lot in lots.items():
        if own == rollout.config:
            yield rollout, lot
        else:
            with contextlib.closing(Rollout(own, rollout.devices)) as other:
                yield other, lot


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


def dataset_of(rollout: Rollout, out: Place, counts: Mapping[str, int]) -> DatasetSpec:
    """What the folder `out` is to hold."""
    config = rollout.config
    return DatasetSpec(
        root=out,
        name=config.name,
        fields=rollout.fields,
        sizes=rollout.sizes,
        seed=config.seed,
        config=config.recipe(),
        config_text=config.recipe_text(),
        producer={**devices.versions(), "sources": sources(), "fingerprint": fingerprint(rollout)},
        splits=counts,
        videos_per_shard=rollout.videos_per_shard,
        codec=config.storage.codec,
        chunk_frames=config.storage.chunk_frames,
        fps=config.video.fps,
        constants=rollout.constants,
        conventions=CONVENTIONS,
        command="python -m gen2d --config config.yaml",
        copies={place: config.copies[name] for place, name in own_files(config.plain()).items()},
    )


def make(rollout: Rollout, dataset: DatasetSpec, todo: list[Shard], say: Callable[[str], None]) -> int:
    """The bytes written for these shards, which are done then."""
    lots = rollouts_of(rollout, [shard.split for shard in todo])
    return sum(_make(own, dataset, [shard for shard in todo if shard.split in lot], say) for own, lot in lots)


def _make(rollout: Rollout, dataset: DatasetSpec, todo: list[Shard], say: Callable[[str], None]) -> int:
    encoder, writers = Encoder(rollout, dataset, threads_for(devices.cores())), Writers(dataset)
    work = batches(todo, rollout.lanes)
    size = 0
    with stopping_on_sigterm(say):  # also while it cleans up: then a second signal ends the process
        try:
            count = sum(shard.count for shard in todo)
            _prepare(rollout, encoder, work, count, say)
            with progress(count, say) as advance:
                for shard, block in encoder.blocks(work):
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


def _prepare(rollout: Rollout, encoder: Encoder, work: list, count: int, say: Callable[[str], None]) -> None:
    """Compiles, measures a slice, says how much and how long it will be, and refuses what the disk cannot hold."""
    name = f"{len(rollout.devices)} {rollout.devices[0].platform} device{'s' if len(rollout.devices) > 1 else ''}"
    say(f"Compiling for {name} (seconds; up to a minute for dozens of objects; kept for the next run) ...")
    began = time.perf_counter()
    split, first, pieces = work[0]
    firsts = [first] * len(rollout.devices)
    batch = _fitted(lambda: jax.block_until_ready(rollout.begin(split, firsts)))
    _fit_slice(rollout, batch)
    compiled = time.perf_counter() - began
    job = jobs_of(firsts, [pieces, *([] for _ in firsts[1:])], rollout.lanes, rollout.slice)[0]
    block, seconds = _measured(rollout, encoder, batch, split, firsts, job)
    size, duration = block.nbytes / len(block) * count, seconds * count
    say(f"Compiled in {compiled:.1f} s. {count:,} videos will take about {in_bytes(size)} and {in_time(duration)}.")
    _warn_of_ratio(encoder.dataset, block, say)
    free = shards.free_bytes(encoder.dataset.root)
    if size > free:
        raise FolderError(
            f"{encoder.dataset.root} would need about {in_bytes(size)}, but its disk has {in_bytes(free)} free; "
            "ask for fewer videos, or name another disk with --out"
        )


def _fit_slice(rollout: Rollout, batch: Batch) -> None:
    """Returns nothing; compiles the drawing, of fewer videos at once where the device has no memory for more."""
    while True:
        try:
            jax.block_until_ready(rollout.draw(batch, 0, rollout.slice))
            return
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or rollout.slice == 1:
                raise _explained(error) from None
            rollout.slice = divisor(rollout.lanes, rollout.slice // 2)


def _measured(
    rollout: Rollout, encoder: Encoder, batch: Batch, split: str, firsts: list[int], job: Job
) -> tuple[Block, float]:
    """The first block, and about how many seconds a video takes."""
    marks = [time.perf_counter()]
    jax.block_until_ready(rollout.begin(split, firsts))
    marks.append(time.perf_counter())
    drawn = jax.block_until_ready(rollout.draw(batch, job.start, rollout.slice))
    marks.append(time.perf_counter())
    block = encoder.encode(job, rollout.host_columns(batch)[0], drawn[0])
    marks.append(time.perf_counter())
    count, threads = len(rollout.devices), threads_for(devices.cores())
    videos = rollout.lanes * count, rollout.slice * count, len(block) * threads
    return block, sum((b - a) / n for a, b, n in zip(marks, marks[1:], videos, strict=False))


def _warn_of_ratio(dataset: DatasetSpec, block: Block, say: Callable[[str], None]) -> None:
    """Says so, once, where gzip does not suit the frames."""
    if "frames" not in dataset.fields:
        return
    raw = len(block) * int(np.prod(dataset.fields["frames"].shape(dataset.sizes)))
    ratio = raw / sum(map(len, block.chunks["frames"]))
    if dataset.codec == "gzip" and ratio < 3:
        say(f"gzip makes these frames only {ratio:.1f} times smaller; --set storage.codec=zstd may do better.")


def _fitted(call: Callable[[], Any]) -> Any:
    try:
        return call()
    except jax.errors.JaxRuntimeError as error:
        raise _explained(error) from None


def _explained(error: Exception) -> Exception:
    if "RESOURCE_EXHAUSTED" in str(error):
        return DeviceMemoryError(
            "the device has too little memory for a batch: lower storage.lanes, or use --device cpu"
        )
    return error


def command(arguments: Sequence[str]) -> str:
    """The shell command that runs gen2d with these arguments."""
    return " ".join(["python -m gen2d", *(shlex.quote(shown(word)) for word in arguments)])
