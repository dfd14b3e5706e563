"""Regeneration of a dataset from its recipe: videos for comparison, and shards that replace damaged ones."""

import contextlib
import dataclasses
import functools
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.config.config import Config
from gen2d.core.errors import DamagedError, FolderError, argument
from gen2d.core.progress import Log, inform, waiting
from gen2d.dataset import folder, hdf5
from gen2d.dataset.hdf5_check import faults
from gen2d.dataset.manifest import Manifest, folder_schema, identity_of, read_manifest
from gen2d.dataset.records import Records, read_records, read_tables, tables_by_name
from gen2d.dataset.rows import shard_type
from gen2d.dataset.snapshots import SupersededError, check_current, publish_snapshot
from gen2d.dataset.spec import (
    MANIFEST,
    MARK,
    RECORDS,
    STAGED,
    DatasetSpec,
    Shard,
    mark_path,
    plan,
    shard_name,
    shard_of,
    shard_path,
)
from gen2d.engines.protocol import Engine
from gen2d.generation.complete import publication
from gen2d.generation.worker import GenerationJob, dataset_of, generate_shards
from gen2d.loading import dataset as loader
from gen2d.programs import devices
from gen2d.programs.environment import sources
from gen2d.programs.fingerprint import fingerprint, machine
from gen2d.programs.recipe import Trust, config_from
from gen2d.programs.source import VideoRange, VideoSource
from gen2d.storage.atomic import publish_changed, remove_tree, sync
from gen2d.storage.leases import LOCK, lease, temporary_name
from gen2d.storage.paths import Place, Url, place, upload
from gen2d.storage.retries import Network
from gen2d.storage.sealed import file_sha256

Identity = Mapping[str, Any]  # of a dataset; its manifest has the same keys
# The packages that decide the bytes of a shard with the same values, besides that of its codec.
WRITERS = ("h5py", "hdf5", "isal", "numpy")


def source_of(root: Place, identity: Identity, trust: Trust = (), on_cpu: bool = False) -> VideoSource:
    """Source of the videos of the dataset in this folder, on the kind of device that made it unless `on_cpu`.

    Raises ConfigError if its config cannot be used here, and UntrustedError if it needs code that is not trusted.
    """
    on_cpu = on_cpu or str(identity["fingerprint"].get("device", "")).startswith("cpu")
    return _source(config_from(root, identity, trust), on_cpu)


@functools.lru_cache(maxsize=1)  # so that check, repair and second check compile once
def _source(config: Config, on_cpu: bool) -> VideoSource:
    return VideoSource(config, devices.prepare("cpu" if on_cpu else "auto"))


def check_fingerprint(root: Place, source: VideoSource, identity: Identity) -> None:
    """Raise FolderError unless this machine and these versions generate the same bits."""
    stored = dict(identity["fingerprint"])
    programs = stored.pop("programs", {})
    _check_equal(root, stored, machine(source.rollout))  # first, because tracing the programs is slow
    with waiting("Tracing the programs (kept for later runs)"):
        traced = fingerprint(source.rollout)["programs"]
    _check_equal(root, {"programs": programs}, {"programs": traced})


def _check_equal(root: Place, expected: Identity, actual: Identity) -> None:
    fingerprints = {"fingerprint": expected}, {"fingerprint": actual}
    difference = folder.describe_differences(*fingerprints, folder.sources_of(root), sources())
    if difference:
        raise FolderError(
            f"{root}: its videos can be neither compared nor repaired here, as bits would differ: {difference}"
        )


def changed_videos(
    source: VideoSource, root: Place, manifest: Manifest, selection: Sequence[tuple[str, int]]
) -> Iterator[tuple[str, str]]:
    """Shard and a sentence for each stored field of these videos (split, number) that differs when regenerated.

    Videos that cannot be read are skipped: the level "full" reports them. Raises FolderError if a constant differs.
    """
    for name, values in source.schema.constants.items():
        if name not in manifest.constants or not np.array_equal(values, manifest.constants[name]):
            raise FolderError(f"{root}: its constant {name} differs from the one that its recipe makes")
    stored = {split: loader.open(root, split, fields=("*",)) for split in manifest.splits}
    for split_source, splits in source.of_splits(split for split, _ in selection):
        ranges = [
            VideoRange(split, number, number + 1, _shard_name(manifest, split, number))
            for split, number in sorted(selection)
            if split in splits
        ]
        for videos in split_source.slices(ranges):
            split, number, _, shard = videos.part.range
            fields = {name: column[0] for name, column in videos.fields().items() if name in split_source.schema.fields}
            for name in _changed_fields(stored[split], number, fields) or ():
                yield shard, f"{name} of {split} video {number} is not what its recipe makes"


def _shard_name(manifest: Manifest, split: str, number: int) -> str:
    """The name of the shard that holds a video."""
    size = manifest.videos_per_shard
    first = number // size * size
    return shard_of(split, first, min(size, manifest.splits[split] - first), size).name


def _changed_fields(stored: loader.Dataset, number: int, fields: Mapping[str, np.ndarray]) -> list[str] | None:
    """The names of the fields whose stored bits differ from these; None if the stored video cannot be read."""
    try:
        video = stored[number]
    except DamagedError:
        return None
    return [name for name, values in fields.items() if name not in video or video[name].tobytes() != values.tobytes()]


# ---- Repair


def repair(
    root: str | Place,
    bad: Sequence[str] = (),
    log: Callable[[str], None] | None = None,
    *,
    trust: Trust = (),
    engine: Engine | None = None,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> list[str]:
    """Regenerate damaged shards of a dataset.

    These are the shards in `bad` and all others without an intact row and file. The new shards are generated and
    verified beside the dataset. Then they replace the old ones, and tables, cards, config and manifest are rewritten
    where they differ. At no moment is the dataset worse than before. If the manifest is damaged, the tables determine
    what the dataset holds.

    Parameters
    ----------
    root : str or path
        The dataset's folder or URL.
    bad : sequence of str
        Names of shards to regenerate, as `verify` passes them.
    log : callable, optional
        Receives lines of progress for a person.
    trust : str or sequence of str
        sha256 of code in the dataset that may run.
    engine : gen2d.engines.Ray, optional
        Where shards are generated, if the dataset is on a disk that all machines share; by default in this process.
    timeout : float
        Limit in s of a server's silence, as in `open`.
    deadline : float
        Limit in s of a whole request, as in `open`.

    Returns
    -------
    list of str
        Names of the regenerated shards.

    Raises
    ------
    FolderError
        If a shard cannot be regenerated here, before anything changes, or if the dataset changed during the repair.
    UntrustedError
        If that needs code of the dataset that is not trusted.
    """
    root = place(root, Network(timeout, deadline))
    folder.check_links(root)
    manifest, identity = _manifest_and_identity(root)
    source = source_of(root, identity, trust, on_cpu=engine is not None)  # a worker may need this machine's GPU
    spec = _original_spec(source, root, identity, manifest)
    counts, tables = (manifest.splits, read_tables(root, manifest)) if manifest else _tables_by_name(root, spec)
    spec = dataclasses.replace(spec, splits=counts)
    records = Records(spec.videos_per_shard, tables)
    shards = plan(counts, spec.videos_per_shard)
    todo = _damaged_shards(root, shards, records, bad, every_byte=manifest is None)
    staged = Records(spec.videos_per_shard, {})
    with folder.translate_errors(root), _staging(root) as stage:
        if todo:
            if engine is None:
                check_fingerprint(root, source, identity)
            generate = functools.partial(_generate, source, root, identity, engine)
            staged = _regenerate_shards(generate, spec, stage, todo, records, manifest, log or inform)
        try:
            with folder.folder_lock(root):
                check_current(root, manifest)
                for shard in todo:
                    _replace(stage / shard_name(shard.name), shard_path(root, shard.name))
                records = _merge(spec, shards, records, staged, todo)
                publish_changed(mark_path(root), folder.mark_content(spec))
                publish_snapshot(spec, publication(spec, shards, records, manifest), records, manifest)
        except SupersededError:
            raise FolderError(f"{root} has changed during the repair: run it again") from None
    return [shard.name for shard in todo]


def _tables_by_name(root: Place, spec: DatasetSpec) -> tuple[dict[str, int], dict[str, np.ndarray]]:
    """Number of videos and intact rows of each split, from the tables alone; raises FolderError if none is intact."""
    counts, rows = tables_by_name(root, shard_type(spec.fields), spec.identity_sha256, spec.videos_per_shard)
    if not counts:
        raise FolderError(
            f"{root}: {MANIFEST} and the tables in index/ are both damaged, so nothing says how many videos there "
            "were: run the command that made the dataset again"
        )
    return counts, rows


def _manifest_and_identity(root: Place) -> tuple[Manifest | None, Identity]:
    """Manifest, if it is intact, and identity of the dataset; raises FolderError if neither can be read."""
    try:
        manifest = read_manifest(root)
    except DamagedError:
        identity = identity_of(root)
        if identity is None:
            raise FolderError(
                f"{root}: {MANIFEST} and {mark_path(root)} are both damaged, so nothing says what the dataset held"
            ) from None
        return None, identity
    return manifest, manifest.identity


def _original_spec(source: VideoSource, root: Place, identity: Identity, manifest: Manifest | None) -> DatasetSpec:
    """Spec of the dataset without its splits, with the versions in its manifest if that is intact.

    Raises FolderError if the dataset's config describes another dataset here.
    """
    spec = dataset_of(source, root, {}, identity["fingerprint"])
    difference = folder.describe_differences(identity, spec.identity, {}, {})
    if difference or (manifest and manifest.fields != spec.fields):
        difference = difference or "their fields differ"
        raise FolderError(f"{root}: its config makes other videos here than the dataset holds: {difference}")
    producer = {**manifest.producer, "fingerprint": identity["fingerprint"]} if manifest else spec.producer
    return dataclasses.replace(spec, producer=producer, schema=folder_schema(root, spec.schema))


def _damaged_shards(
    root: Place, shards: Sequence[Shard], records: Records, bad: Sequence[str], every_byte: bool
) -> list[Shard]:
    """Shards to regenerate; with `every_byte`, the sha256 of every file is compared with its row."""
    sizes, damaged = folder.Sizes(root), set(bad)
    for shard in shards:
        row = records.row_of(shard)
        if row is None or not folder.is_done(shard, records, sizes):
            damaged.add(shard.name)
        elif every_byte and isinstance(root, Path):
            path = root / shard_name(shard.name)
            with contextlib.suppress(OSError):
                if file_sha256(path) == row["sha256"].tobytes().hex():
                    continue
            damaged.add(shard.name)
    return [shard for shard in shards if shard.name in damaged]


@contextlib.contextmanager
def _staging(root: Place) -> Iterator[Path]:
    """Temporary folder for new shards, on the dataset's disk unless the dataset is at a URL."""
    if isinstance(root, Url):
        with tempfile.TemporaryDirectory(prefix="gen2d-") as temporary:
            yield Path(temporary)
        return
    (root / MARK).mkdir(exist_ok=True)
    stage = root / MARK / temporary_name(STAGED.name)
    lock = stage.with_name(stage.name + LOCK)
    with lease(lock), contextlib.ExitStack() as stack:
        stack.callback(lock.unlink, missing_ok=True)
        stage.mkdir()
        stack.callback(remove_tree, stage)
        yield stage


def _generate(
    source: VideoSource,
    root: Place,
    identity: Identity,
    engine: Engine | None,
    dataset: DatasetSpec,
    todo: list[Shard],
    log: Log,
) -> None:
    """Generate these shards in this process or by an engine whose workers make the same bits."""
    if engine is None:
        generate_shards(source, dataset, todo, log)
        return
    if isinstance(root, Url):
        raise FolderError(
            f"{root} is repaired on one machine, as the new shards are checked there: leave out {argument('engine')}"
        )
    job = GenerationJob(source.config, dataset.root, dataset.splits, "auto", identity)
    workers = engine.start(job, log)
    try:
        if job.dataset is None or job.dataset.identity != identity:
            actual = job.dataset.identity["fingerprint"] if job.dataset else {}
            _check_equal(root, identity["fingerprint"], actual)
        folder.open_folder(dataset)
        for shard in todo:
            workers.submit(shard)
        for _ in workers.done():
            pass
    finally:
        workers.stop()


def _regenerate_shards(
    generate: Callable[[DatasetSpec, list[Shard], Log], None],
    spec: DatasetSpec,
    stage: Path,
    todo: Sequence[Shard],
    records: Records,
    manifest: Manifest | None,
    log: Callable[[str], None],
) -> Records:
    """Generate these shards in the folder `stage`; return their rows, or raise FolderError if one is not right."""
    for name in ("shards", f"{RECORDS}"):
        (stage / name).mkdir(parents=True)
    staged_spec = dataclasses.replace(spec, root=stage)
    generate(staged_spec, list(todo), log)
    staged = read_records(staged_spec, stage)
    versions = devices.versions()
    writers = (*WRITERS, "zstandard") if spec.codec == "zstd" else WRITERS
    same_writers = manifest is None or all(manifest.producer.get(key) == versions.get(key) for key in writers)
    for shard in todo:
        path, row, before = stage / shard_name(shard.name), staged.row_of(shard), records.row_of(shard)
        assert row is not None
        problems = _faults(path, shard, row, manifest)
        differs = before is not None and before["sha256"].tobytes() != row["sha256"].tobytes()
        if not problems and same_writers and differs and not _reproduces(spec.root, shard, path, manifest):
            problems = ["none of its videos has the bits that were written"]
        if problems:
            raise FolderError(
                f"{spec.root}: {shard.name}, made again, is not right, so nothing was changed: {problems[0]}"
            )
    return staged


def _faults(path: Path, shard: Shard, row: np.void, manifest: Manifest | None) -> list[str]:
    """Faults of a new shard on disk, a sentence each."""
    if file_sha256(path) != row["sha256"].tobytes().hex():
        return ["the disk does not hold what was written"]
    values = hdf5.read(path)
    if values["index"].tolist() != list(range(shard.first, shard.first + shard.count)):
        return ["its videos have other numbers"]
    return faults(path, shard, manifest) if manifest else []


def _reproduces(root: Place, shard: Shard, path: Path, manifest: Manifest | None) -> bool:
    """Whether some video in the new file `path` equals the stored one to the bit.

    If so, this machine generates the right bits, and the stored videos that differ were damaged.
    """
    if manifest is None:
        return False
    values, stored = hdf5.read(path), loader.open(root, shard.split, "*")
    return any(
        _changed_fields(stored, shard.first + row, {name: values[name][row] for name in stored.fields}) == []
        for row in range(shard.count)
    )


def _replace(source: Path, target: Place) -> None:
    """Move a file to `target`, which may exist."""
    if isinstance(target, Url):
        upload(source, target)
        return
    target.parent.mkdir(exist_ok=True)
    source.replace(target)
    sync(target.parent)


def _merge(
    spec: DatasetSpec, shards: Sequence[Shard], records: Records, staged: Records, todo: Sequence[Shard]
) -> Records:
    """Rows of all shards: from `staged` for those in `todo`, from `records` for the others."""
    remade = {shard.name for shard in todo}
    rows: dict[str, list[Any]] = {}
    for shard in shards:
        row = (staged if shard.name in remade else records).row_of(shard)
        assert row is not None
        rows.setdefault(shard.split, []).append(row)
    kind = shard_type(spec.fields)
    return Records(spec.videos_per_shard, {split: np.array(split_rows, kind) for split, split_rows in rows.items()})
