"""A stored dataset against its recipe: some of its videos made again and compared, its bad shards made again."""

import contextlib
import dataclasses
import functools
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.config.config import Config
from gen2d.core.errors import DamagedError, FolderError
from gen2d.dataset import folder, hdf5
from gen2d.dataset.block import Block
from gen2d.dataset.hdf5_check import faults
from gen2d.dataset.manifest import MANIFEST, Manifest, identity_of, read_manifest
from gen2d.dataset.records import Records, read_records, read_tables, tables_by_name
from gen2d.dataset.rows import shard_type
from gen2d.dataset.spec import (
    MARK,
    RECORDS,
    STAGED,
    DatasetSpec,
    Shard,
    mark_path,
    plan,
    shard_name,
    shard_path,
)
from gen2d.generation.complete import publication
from gen2d.generation.encoder import Encoder, threads_for
from gen2d.generation.run import dataset_of, make, rollouts_of
from gen2d.loading import dataset as loader
from gen2d.programs import devices
from gen2d.programs.batches import ShardSlice
from gen2d.programs.fingerprint import fingerprint, machine, sources
from gen2d.programs.recipe import Trust, config_from
from gen2d.programs.rollout import Rollout
from gen2d.storage.atomic import publish_changed, sync
from gen2d.storage.codecs import decode_into
from gen2d.storage.leases import LOCK, leased, temporary_name
from gen2d.storage.paths import Network, Place, Url, place, upload
from gen2d.storage.sealed import file_sha256

Identity = Mapping[str, Any]  # of a dataset; its manifest has the same keys
# What decides the bytes of a shard, when its values are the same.
CODECS = ("h5py", "hdf5", "isal", "zstandard", "numpy")


def rollout_of(root: Place, identity: Identity, trust: Trust = ()) -> Rollout:
    """The programs that made the dataset in the folder. Raises ConfigError where its config cannot be used here, and
    UntrustedError where that would run code that came with it."""
    return _rollout(
        config_from(root, identity, trust), str(identity["fingerprint"].get("device", "")).startswith("cpu")
    )


@functools.lru_cache(maxsize=1)  # a check, a repair and the check that follows compile once
def _rollout(config: Config, on_cpu: bool) -> Rollout:
    return Rollout(config, devices.prepare("cpu" if on_cpu else "auto"))


def check_fingerprint(root: Place, rollout: Rollout, identity: Identity) -> None:
    """Raises FolderError where this machine and these versions would make other bits."""
    there = dict(identity["fingerprint"])
    programs = there.pop("programs", {})
    _compare(root, there, machine(rollout))  # at once: tracing the programs takes long
    _compare(root, {"programs": programs}, {"programs": fingerprint(rollout)["programs"]})


def _compare(root: Place, there: Identity, here: Identity) -> None:
    both = {"fingerprint": there}, {"fingerprint": here}
    told = folder.told_differences(*both, folder.sources_of(root), sources())
    if told:
        raise FolderError(f"{root}: its videos can be neither judged nor repaired here, as bits would differ: {told}")


def changed_videos(
    rollout: Rollout, root: Place, manifest: Manifest, chosen: Sequence[tuple[str, int]]
) -> Iterator[tuple[str, str]]:
    """For each field of the videos (split, number) that is another when made again: its shard and a sentence.

    Videos that cannot be read are passed over: the level "full" names them.
    """
    dataset = dataset_of(rollout, root, manifest.splits, manifest.identity["fingerprint"])
    for name, values in dataset.constants.items():
        if name not in manifest.constants or not np.array_equal(values, manifest.constants[name]):
            raise FolderError(f"{root}: its constant {name} is not the one that its recipe gives")
    stored = {split: loader.open(root, split, fields=("*",)) for split in manifest.splits}
    for own, splits in rollouts_of(rollout, [split for split, _ in chosen]):
        encoder = Encoder(own, dataset, threads_for(devices.cores()))
        try:
            for shard, block in encoder.blocks(_work(dataset, own.batch_size, [c for c in chosen if c[0] in splits])):
                number = int(block.arrays["index"][0])
                for name in _changed_fields(stored[shard.split], number, _values(block, dataset)):
                    yield shard.name, f"{name} of {shard.split} video {number} is not what its recipe makes"
        finally:
            encoder.close()


def _work(
    dataset: DatasetSpec, batch_size: int, chosen: Sequence[tuple[str, int]]
) -> list[tuple[str, int, list[ShardSlice]]]:
    """The batches that hold the chosen videos, each video a piece of its own."""
    owner = {(shard.split, shard.place): shard for shard in plan(dataset.splits, dataset.videos_per_shard)}
    found: dict[tuple[str, int], list[ShardSlice]] = {}
    for split, number in sorted(chosen):
        shard, lane = owner[split, number // dataset.videos_per_shard], number % batch_size
        found.setdefault((split, number - lane), []).append((shard, lane, lane + 1))
    return [(split, first, pieces) for (split, first), pieces in found.items()]


def _values(block: Block, dataset: DatasetSpec) -> dict[str, np.ndarray]:
    """The fields of the block's only video."""
    found = {name: values[0] for name, values in block.arrays.items()}
    for name, chunks in block.chunks.items():
        field = dataset.fields[name]
        found[name] = np.empty(field.shape(dataset.sizes), field.dtype)
        for piece, chunk in zip(np.split(found[name], len(chunks)), chunks, strict=True):
            decode_into(dataset.codec, chunk, piece)
    return found


def _changed_fields(stored: loader.Dataset, number: int, made: Mapping[str, np.ndarray]) -> list[str]:
    """The names of the fields that are stored otherwise, to the bit."""
    try:
        video = stored[number]
    except DamagedError:
        return []
    return [name for name, values in made.items() if name not in video or video[name].tobytes() != values.tobytes()]


# ---- Repair


def repair(
    root: str | Place,
    bad: Sequence[str] = (),
    say: Callable[[str], None] | None = None,
    *,
    trust: Trust = (),
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> list[str]:
    """The names of the shards that were made again: those called `bad`, and all whose row or file is not whole.

    They are made beside the dataset and verified there. Then they take their places, and tables, cards, config and
    manifest follow, each if it is not what it should be. At no moment is the dataset worse than it was. Where the
    manifest is damaged, the tables say what it held.

    Raises FolderError, before anything is changed, where a shard cannot be made again here, and UntrustedError where
    that would run code that came with the dataset.
    """
    root = place(root, Network(timeout, deadline))
    folder.check_links(root)
    manifest, identity = _what_it_held(root)
    rollout = rollout_of(root, identity, trust)
    spec = _as_made(rollout, root, identity, manifest)
    counts, kept = (manifest.splits, read_tables(root, manifest)) if manifest else _found_tables(root, spec)
    spec = dataclasses.replace(spec, splits=counts)
    records = Records(spec.videos_per_shard, kept)
    shards = plan(counts, spec.videos_per_shard)
    todo = _to_make(root, shards, records, bad, every_byte=manifest is None)
    staged = Records(spec.videos_per_shard, {})
    with folder.explained(root), _staging(root) as stage:
        if todo:
            check_fingerprint(root, rollout, identity)
            staged = _made_again(rollout, spec, stage, todo, records, manifest, say or (lambda line: None))
        try:
            with folder.alone(root):
                folder.check_current(root, manifest)
                for shard in todo:
                    _put(stage / shard_name(shard.name), shard_path(root, shard.name))
                records = _together(spec, shards, records, staged, todo)
                publish_changed(mark_path(root), folder.mark_content(spec))
                folder.publish_snapshot(spec, publication(spec, shards, records, manifest), records, manifest)
        except folder.SupersededError:
            raise FolderError(f"{root} has changed during the repair: run it again") from None
    return [shard.name for shard in todo]


def _found_tables(root: Place, spec: DatasetSpec) -> tuple[dict[str, int], dict[str, np.ndarray]]:
    """How many videos each split has, and the rows that are what was written, where no manifest says which."""
    counts, rows = tables_by_name(root, shard_type(spec.fields), spec.identity_sha256, spec.videos_per_shard)
    if not counts:
        raise FolderError(
            f"{root}: {MANIFEST} and the tables in index/ are both damaged, so nothing says how many videos there "
            "were: run the command that made the dataset again"
        )
    return counts, rows


def _what_it_held(root: Place) -> tuple[Manifest | None, Identity]:
    """The manifest, if it is whole, and what the dataset was made from."""
    try:
        manifest = read_manifest(root)
    except DamagedError:
        identity = identity_of(root)
        if identity is None:
            raise FolderError(
                f"{root}: {MANIFEST} and {mark_path(root)} are both damaged, so nothing says what it held"
            ) from None
        return None, identity
    return manifest, manifest.identity


def _as_made(rollout: Rollout, root: Place, identity: Identity, manifest: Manifest | None) -> DatasetSpec:
    """What the folder is to hold, by the versions that its manifest names, if that is whole.

    Raises FolderError where its config gives another dataset here.
    """
    spec = dataset_of(rollout, root, {}, identity["fingerprint"])
    told = folder.told_differences(identity, spec.identity, {}, {})
    if told or (manifest and manifest.fields != spec.fields):
        raise FolderError(f"{root}: its config gives other videos here than it holds: {told or 'their fields differ'}")
    producer = {**manifest.producer, "fingerprint": identity["fingerprint"]} if manifest else spec.producer
    return dataclasses.replace(spec, producer=producer)


def _to_make(
    root: Place, shards: Sequence[Shard], records: Records, bad: Sequence[str], every_byte: bool
) -> list[Shard]:
    """The shards that must be made again; where `every_byte` matters, each file is compared with its row."""
    sizes, missing = folder.Sizes(root), set(bad)
    for shard in shards:
        row = records.of(shard)
        if row is None or not folder.is_done(shard, records, sizes):
            missing.add(shard.name)
        elif every_byte and isinstance(root, Path):
            path = root / shard_name(shard.name)
            with contextlib.suppress(OSError):
                if file_sha256(path) == row["sha256"].tobytes().hex():
                    continue
            missing.add(shard.name)
    return [shard for shard in shards if shard.name in missing]


@contextlib.contextmanager
def _staging(root: Place) -> Iterator[Path]:
    """A folder in which shards are made again, on the disk of the dataset where that is one."""
    if isinstance(root, Url):
        with tempfile.TemporaryDirectory(prefix="gen2d-") as home:
            yield Path(home)
        return
    (root / MARK).mkdir(exist_ok=True)
    stage = root / MARK / temporary_name(STAGED.name)
    lock = stage.with_name(stage.name + LOCK)
    with leased(lock), contextlib.ExitStack() as stack:
        stack.callback(lock.unlink, missing_ok=True)
        stage.mkdir()
        stack.callback(folder.remove_tree, stage)
        yield stage


def _made_again(
    rollout: Rollout,
    spec: DatasetSpec,
    stage: Path,
    todo: Sequence[Shard],
    records: Records,
    manifest: Manifest | None,
    say: Callable[[str], None],
) -> Records:
    """The rows of the shards, which lie in the folder `stage` then, each verified."""
    for name in ("shards", f"{RECORDS}"):
        (stage / name).mkdir(parents=True)
    staged_spec = dataclasses.replace(spec, root=stage)
    make(rollout, staged_spec, list(todo), say)
    staged = read_records(staged_spec, stage)
    versions = devices.versions()
    same_codecs = manifest is None or all(manifest.producer.get(key) == versions[key] for key in CODECS)
    for shard in todo:
        path, row, before = stage / shard_name(shard.name), staged.of(shard), records.of(shard)
        assert row is not None
        wrong = _faults(path, shard, row, manifest)
        other = before is not None and before["sha256"].tobytes() != row["sha256"].tobytes()
        if not wrong and same_codecs and other and not _reproduces(spec.root, shard, path, manifest):
            wrong = ["its bytes are not those that were written, in any video"]
        if wrong:
            raise FolderError(
                f"{spec.root}: {shard.name}, made again, is not right, so nothing was changed: {wrong[0]}"
            )
    return staged


def _faults(path: Path, shard: Shard, row: np.void, manifest: Manifest | None) -> list[str]:
    """What is wrong with a shard that was made again, as the disk now has it."""
    if file_sha256(path) != row["sha256"].tobytes().hex():
        return ["the disk does not have what was written"]
    values = hdf5.read(path)
    if values["index"].tolist() != list(range(shard.first, shard.first + shard.count)):
        return ["its videos have other numbers"]
    return faults(path, shard, manifest) if manifest else []


def _reproduces(root: Place, shard: Shard, path: Path, manifest: Manifest | None) -> bool:
    """Whether some video of a shard is what it was, to the bit, when made again in the file `path`; the others were
    then stored otherwise than their recipe makes them."""
    if manifest is None:
        return False
    made, numbers = hdf5.read(path), range(shard.first, shard.first + shard.count)
    stored = loader.open(root, shard.split, "*")
    own = [{name: made[name][row] for name in stored.fields} for row in range(shard.count)]
    return any(_is_stored(stored, number, video) for number, video in zip(numbers, own, strict=True))


def _is_stored(stored: loader.Dataset, number: int, made: Mapping[str, np.ndarray]) -> bool:
    try:
        video = stored[number]
    except DamagedError:
        return False
    return all(video[name].tobytes() == values.tobytes() for name, values in made.items())


def _put(source: Path, target: Place) -> None:
    """Returns when the file is at its place, instead of what was there."""
    if isinstance(target, Url):
        upload(source, target)
        return
    target.parent.mkdir(exist_ok=True)
    source.replace(target)
    sync(target.parent)


def _together(
    spec: DatasetSpec, shards: Sequence[Shard], records: Records, staged: Records, todo: Sequence[Shard]
) -> Records:
    """The rows of all shards: of those made again the new ones."""
    again = {shard.name for shard in todo}
    rows: dict[str, list[Any]] = {}
    for shard in shards:
        row = (staged if shard.name in again else records).of(shard)
        assert row is not None
        rows.setdefault(shard.split, []).append(row)
    kind = shard_type(spec.fields)
    return Records(spec.videos_per_shard, {split: np.array(own, kind) for split, own in rows.items()})
