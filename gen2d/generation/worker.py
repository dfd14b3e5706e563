"""Worker that generates shards: one source, whose programs compile once, and the writers of its shards."""

import contextlib
import dataclasses
import os
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gen2d.config.config import Config, load_config, user_plugin_files
from gen2d.config.plugin_options import StoredCopies
from gen2d.core.errors import Error
from gen2d.core.progress import Log, progress, stopping_on_sigterm, waiting
from gen2d.dataset import folder
from gen2d.dataset.manifest import identity_of
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.dataset.spec import DatasetSpec, Shard
from gen2d.engines.protocol import Report
from gen2d.generation.encoder import Encoder, shard_ranges, threads_for
from gen2d.generation.warm_up import compile_for, warm_up
from gen2d.generation.writers import ShardWriters
from gen2d.programs import devices
from gen2d.programs.environment import sources
from gen2d.programs.fingerprint import fingerprint
from gen2d.programs.source import VideoSource
from gen2d.storage.atomic import sweep
from gen2d.storage.leases import exclusive_lock
from gen2d.storage.paths import Place, Url

CONVENTIONS = (
    "World: metres, y up, radians counter-clockwise, seconds. Pixels: (row, column) from the top left, pixel centres "
    "at j + 0.5. Frame 0 is the initial state, frame t the state at t / fps. An empty slot is zero everywhere."
)
SEEN = 30.0  # seconds within which a shared disk must show what another machine has written
COMPILING = 900.0  # longest wait, in s, for another worker on this machine that compiles the same programs


def dataset_of(
    source: VideoSource, out: Place, counts: Mapping[str, int], fingerprint: Mapping[str, Any]
) -> DatasetSpec:
    """Spec of a dataset in the folder `out` of videos from programs with this fingerprint."""
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
        licence=config.licence,
        copies={path: config.copies[name] for path, name in user_plugin_files(config.plain()).items()},
    )


class Written(NamedTuple):
    """Result of a shard."""

    bytes: int  # compressed
    compile_seconds: float  # before it


def generate_shards(source: VideoSource, dataset: DatasetSpec, todo: Sequence[Shard], log: Log) -> dict[Shard, Written]:
    """Generate and write these shards in this process, which shows the progress."""
    written = {}
    for split_source, splits in source.of_splits(shard.split for shard in todo):
        own = [shard for shard in todo if shard.split in splits]
        written |= _generate_from(split_source, dataset, own, log)
    return written


def _generate_from(source: VideoSource, dataset: DatasetSpec, todo: Sequence[Shard], log: Log) -> dict[Shard, Written]:
    encoder, ranges, sizes = _encoder(source, dataset), shard_ranges(todo), dict.fromkeys(todo, 0)
    # Also during clean-up, when a second signal ends the process.
    with stopping_on_sigterm(log), ShardWriter(dataset) as writer:
        writers = ShardWriters(writer)
        try:
            count = sum(shard.count for shard in todo)
            seconds = warm_up(source, encoder, ranges, count, log)
            with progress("Generating", count, log) as advance:
                for shard, block in encoder.blocks(ranges):
                    writers.put(shard, block)
                    sizes[shard] += block.nbytes
                    advance(len(block))
            writers.finish()
        except BaseException:
            writers.abort()
            raise
        finally:
            encoder.close()
    return {shard: Written(size, 0.0 if k else seconds) for k, (shard, size) in enumerate(sizes.items())}


def _encoder(source: VideoSource, dataset: DatasetSpec) -> Encoder:
    return Encoder(source, dataset, threads_for(devices.cores()))


class ShardWorker:
    """Source and writers of a dataset's shards, for any engine."""

    def __init__(self, config: Config, out: Place, counts: Mapping[str, int], device: str, log: Log) -> None:
        with waiting("Starting the devices", log):
            on = devices.prepare(device)
        with waiting("Tracing the programs (kept for later runs)", log):
            source = VideoSource(config, on)
            if sum(counts.values()) <= source.rollout.batch_size:  # one batch: one device, whose programs compile once
                on = on[:1]
                source = VideoSource(config, on)
            self.source, self.devices = source, on
            self.dataset = dataset_of(source, out, counts, fingerprint(source.rollout))
        self._encoders: dict[Config, Encoder] = {}  # by the config of their splits
        self._writer: ShardWriter | None = None
        self._rendering = threading.Lock()

    def report(self) -> Report:
        rollout, producer = self.source.rollout, self.dataset.producer
        group = -(-len(rollout.devices) * rollout.batch_size // rollout.videos_per_shard)
        versions = {name: value for name, value in producer.items() if isinstance(value, str) and name != "python"}
        hardware = {"platform": self.devices[0].platform, "devices": len(self.devices)}
        kind = producer["fingerprint"]["device"]
        return Report(kind, hardware, versions, self.dataset.identity, group, self.dataset)

    def check(self) -> str:
        """Why this process cannot write into the dataset, which the driver has opened."""
        root, end = self.dataset.root, time.monotonic() + SEEN
        if isinstance(root, Url):
            sweep(root, folder.FOLDERS)  # what killed workers left on this machine
        try:
            while (there := identity_of(root)) is None and isinstance(root, Path) and time.monotonic() < end:
                time.sleep(0.5)  # network disks show new files late
        except Error as error:
            return str(error)
        except OSError as error:
            return f"{root} cannot be read ({error.strerror or error})"
        if there != self.dataset.identity:
            return f"it does not see the dataset in {root}: name a folder that all machines share, or a URL"
        if isinstance(root, Path) and not os.access(root / "shards", os.W_OK):
            return f"it may not write into {root}"
        return ""

    def run_all(self, items: Sequence[Shard], log: Log) -> list[Written]:
        written = generate_shards(self.source, self.dataset, items, log)
        return [written[shard] for shard in items]

    def run(self, items: Sequence[Shard]) -> list[Written]:
        """Generate and write these shards.

        A second thread may call this at the same time: it renders while the first thread's last videos are compressed
        and its last shard is flushed to the disk.
        """
        written: dict[Shard, Written] = {}
        for source, splits in self.source.of_splits(shard.split for shard in items):
            own = [shard for shard in items if shard.split in splits]
            sizes = dict.fromkeys(own, 0)
            with contextlib.ExitStack() as lock:
                lock.enter_context(self._rendering)
                encoder, seconds = self._encoder(source, own)
                writers = ShardWriters(self._shard_writer())
                try:
                    for shard, block in encoder.blocks(shard_ranges(own), rendered=lock.close):
                        writers.put(shard, block)
                        sizes[shard] += block.nbytes
                    writers.finish()
                except BaseException:
                    encoder.running.clear()  # of failed videos
                    writers.abort()
                    raise
            written |= {shard: Written(size, 0.0 if k else seconds) for k, (shard, size) in enumerate(sizes.items())}
        return [written[shard] for shard in items]

    def _encoder(self, source: VideoSource, shards: Sequence[Shard]) -> tuple[Encoder, float]:
        """Encoder of the videos of these splits, and the seconds that it took to compile their programs."""
        if source.config in self._encoders:
            return self._encoders[source.config], 0.0
        began = time.perf_counter()
        with one_compiles():
            compile_for(source, shard_ranges(shards), lambda _: None)
        self._encoders[source.config] = _encoder(source, self.dataset)
        return self._encoders[source.config], time.perf_counter() - began

    def _shard_writer(self) -> ShardWriter:
        if self._writer is None:
            self._writer = ShardWriter(self.dataset)
        return self._writer

    def close(self) -> None:
        for encoder in self._encoders.values():
            encoder.close()
        if self._writer is not None:
            self._writer.close()


@contextlib.contextmanager
def one_compiles() -> Iterator[None]:
    """Context in which one process of this machine compiles; those that come meanwhile wait and find its programs."""
    path = Path(tempfile.gettempdir()) / f"gen2d-{os.getuid()}.compiling"
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            try:
                stack.enter_context(exclusive_lock(path, 0))
            except TimeoutError:
                with contextlib.suppress(TimeoutError), exclusive_lock(path, COMPILING):
                    pass
        yield


class Opening:
    """Opens a worker; it travels without compiled code, with the user's own plug-in files."""

    def __init__(self, config: Config, out: Place, counts: Mapping[str, int]) -> None:
        self.config, self.out, self.counts = config, out, dict(counts)

    def __call__(self, device: str, log: Log) -> ShardWorker:
        return ShardWorker(self.config, self.out, self.counts, device, log)

    def __reduce__(self) -> tuple:
        out = self.out.absolute() if isinstance(self.out, Path) else self.out
        return _opening, (self.config.plain(), dict(self.config.copies), out, self.counts)


def _opening(config: dict[str, Any], copies: dict[str, bytes], out: Place, counts: dict[str, int]) -> Opening:
    return Opening(load_config(config, copies=StoredCopies(copies)), out, counts)


class GenerationJob:
    """Shards of a dataset, for an engine."""

    title, unit, noun = "Generating", "videos", "shard"

    def __init__(
        self, config: Config, out: Place, counts: Mapping[str, int], device: str, identity: Any = None
    ) -> None:
        """`identity` is that of the dataset to which the shards belong, if it is begun."""
        self.open, self.device = Opening(config, out, counts), device
        self.out, self.identity = out, identity
        self.dataset: DatasetSpec | None = None  # that all workers make
        self.hardware: dict[str, Any] = {}  # of the chosen workers' kind, for the run log

    def size(self, item: Shard) -> int:
        return item.count

    def refusals(self, reports: Sequence[Report]) -> list[str]:
        """Why each worker cannot add to the dataset: it has other versions or files, or makes other bits.

        The bits are those of the begun dataset, if a worker makes them, else those that most workers make.
        """
        own = [_other_versions(report) for report in reports]
        if self.dataset is None:
            able = [report for report, difference in zip(reports, own, strict=True) if not difference]
            if not able:
                return own
            same = [report for report in able if report.identity == self.identity]
            counted = Counter(repr(report.identity) for report in same or able)
            most = counted.most_common(1)[0][0]
            chosen = next(report for report in able if repr(report.identity) == most)
            self.dataset, self.hardware = dataclasses.replace(chosen.details, root=self.out), dict(chosen.hardware)
        dataset: DatasetSpec = self.dataset  # pyright: ignore[reportAssignmentType]
        return [other or _other_bits(dataset, report) for report, other in zip(reports, own, strict=True)]


def _other_bits(dataset: DatasetSpec, report: Report) -> str:
    """How the worker's videos differ from those of the dataset, in a sentence, or ""."""
    files = dataset.producer["sources"], report.details.producer["sources"]
    difference = folder.describe_differences(dataset.identity, report.identity, *files)
    return f"it would make other bits: {difference}" if difference else ""


def _other_versions(report: Report) -> str:
    """How the worker's versions and source files differ from those here, in a sentence, or ""."""
    here = devices.versions()
    for name, version in report.versions.items():
        if here.get(name, version) != version:
            return f"it has {name} {version}, but here is {here[name]}"
    there, own = report.details.producer["sources"], sources()
    edited = sorted(name for name in there.keys() | own.keys() if there.get(name) != own.get(name))
    return f"its gen2d differs in {', '.join(edited[:3])}{' ...' if len(edited) > 3 else ''}" if edited else ""
