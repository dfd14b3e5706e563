"""A dataset's folder while it is made: who may write into it, what is left to do, and how it becomes the next snapshot.

    plan -> open_folder -> (encode -> write) for each shard -> complete

A shard is done if there is a row of it and its file has the size that the row says, so whatever a crash leaves is made
again. Workers share nothing: each takes its shards by their place, and whoever finds all of them done publishes the
tables and, last, the manifest. Until then readers have the manifest before it, and all that it names. Whoever looks
what is left to do, publishes, repairs or cleans holds the lock of the folder meanwhile. Where there are no locks, as at
a URL, a manifest is replaced only if it is still the one that the new one was made after.
"""

import contextlib
import dataclasses
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gen2d.core.errors import ConfigError, DamagedError, FolderError, UnreachableError
from gen2d.dataset.manifest import (
    CONFIG,
    MANIFEST,
    MARK_SEAL,
    SHARDS,
    SHEET,
    Manifest,
    as_bytes,
    identity_of,
    parse,
    read_manifest,
    schema_of,
)
from gen2d.dataset.records import Records, read_records, remove_logs
from gen2d.dataset.shard_writer import AGAIN
from gen2d.dataset.spec import (
    FILE_NAME,
    LOCK,
    MARK,
    NEXT,
    RECORDS,
    SCHEMA,
    SNAPSHOTS,
    TABLE_NAME,
    DatasetSpec,
    Shard,
    mark_path,
    plan,
    shard_name,
    shard_of,
    snapshot_path,
)
from gen2d.storage.atomic import is_temporary, link_or_copy, publish, publish_changed, remove_tree, sweep
from gen2d.storage.explain import reading_error, writing_error
from gen2d.storage.leases import exclusive
from gen2d.storage.paths import Place, Url
from gen2d.storage.sealed import JSON_BYTES, as_json, read_bytes, read_sealed, sealed

# What each program of a fingerprint does.
PROGRAMS = {"simulate": "samples and simulates", "draw": "draws", "captions": "writes captions"}
PROGRAMS |= {"grids": "orders the combinations on grids"}

FOLDERS = ("", "shards", "index", f"{MARK}", f"{RECORDS}")  # where temporary files are written
LOCK_SECONDS = 300.0  # that another process may take to publish


def open_folder(spec: DatasetSpec, overwrite: bool = False) -> list[Shard]:
    """The shards that remain to be made, in a folder that is ready for them.

    Videos that are there already stay, also those beyond what was asked. Raises FolderError for a folder that is not
    this dataset's, or cannot be written.
    """
    root = spec.root
    check_count(spec)
    with explained(root):
        check_links(root)
        _check_kind(root)
        with alone(root):
            if overwrite and _is_dataset(root):
                _clear(root)
            _claim(spec)
            sweep(root, FOLDERS)
            records, sizes = read_records(spec, root), Sizes(root)
            shards = whole_plan(spec, records)
            remaining = [shard for shard in shards if not is_done(shard, records, sizes)]
            if remaining and _grows(root, shards):
                _drop_snapshots(root)
            return remaining


def _grows(root: Place, shards: Sequence[Shard]) -> bool:
    """Whether the dataset is complete without some of these shards."""
    manifest = current(root)
    return manifest is not None and any(s.first + s.count > manifest.splits.get(s.split, 0) for s in shards)


@contextlib.contextmanager
def alone(root: Place) -> Iterator[None]:
    """A block in which no other process looks what is left to do, publishes, repairs or cleans, where there are locks.

    Raises FolderError where another one is not done with that in time.
    """
    if isinstance(root, Url):
        yield
        return
    (root / MARK).mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(exclusive(root / LOCK, LOCK_SECONDS))
        except TimeoutError:
            raise FolderError(f"{root} is being changed by another process: try again when that has ended") from None
        yield


def check_count(spec: DatasetSpec) -> None:
    """Raises ConfigError for more shards than a dataset may have."""
    shards = sum(-(-count // spec.videos_per_shard) for count in spec.splits.values())
    if shards > SHARDS:
        raise ConfigError(
            f"storage.videos_per_shard is {spec.videos_per_shard}, so that there would be {shards:,} shards, but "
            f"{SHARDS:,} are the most"
        )


def whole_plan(spec: DatasetSpec, records: Records) -> list[Shard]:
    """The plan for what was asked and for all that is there."""
    counts = dict(spec.splits)
    for split, count in records.counts().items():
        counts[split] = max(counts.get(split, 0), count)
    return plan(counts, spec.videos_per_shard)


class Sizes:
    """The sizes of the shards' files, asked for all at once; at a URL, where none goes missing, those of the rows."""

    def __init__(self, root: Place) -> None:
        self.known: dict[str, int] | None = None
        if isinstance(root, Path):
            with contextlib.suppress(FileNotFoundError), os.scandir(root / "shards") as entries:
                self.known = {entry.name: size for entry in entries if (size := _size(entry)) is not None}
            self.known = self.known or {}

    def fits(self, shard: Shard, size: int) -> bool:
        """Whether the shard's file has this size."""
        return self.known is None or self.known.get(f"{shard.name}.h5") == size


def _size(entry: os.DirEntry[str]) -> int | None:
    try:
        return entry.stat().st_size if entry.is_file() else None
    except FileNotFoundError:  # a temporary file, which just got its name
        return None


def is_done(shard: Shard, records: Records, sizes: Sizes) -> bool:
    """Whether the shard is recorded, and its file there."""
    row = records.of(shard)
    return row is not None and sizes.fits(shard, int(row["bytes"]))


def free_bytes(root: Place) -> float:
    """How much the disk that holds `root`, or will, can take; of a Url no limit is known."""
    if isinstance(root, Url):
        return math.inf
    path = root.absolute()
    return shutil.disk_usage(next(place for place in (path, *path.parents) if place.exists())).free


def log(root: Place, entry: Mapping[str, Any]) -> None:
    """Adds a line to the folder's run log, which is where times and hosts belong."""
    path, line = root / MARK / "run.jsonl", json.dumps(dict(entry), sort_keys=True) + "\n"
    with explained(root):
        if isinstance(path, Path):
            with path.open("a") as file:
                file.write(line)
        else:  # an object is written anew, so of two workers that end at once one may go unnoted
            publish(path, (path.read_bytes(JSON_BYTES) if path.exists() else b"") + line.encode())


# ---- Whose folder it is


def _is_dataset(root: Place) -> bool:
    if isinstance(root, Url):
        return mark_path(root).exists() or schema_of(root) is not None
    return (root / MARK).is_dir() or (schema_of(root) or "").startswith("gen2d.dataset/")


def _check_kind(root: Place) -> None:
    """Raises FolderError for a folder of something else, before anything is written into it."""
    if root.is_dir() and not _is_dataset(root) and any(root.iterdir()):
        raise FolderError(f"{root} holds something else than a gen2d dataset: choose another --out")


def check_links(root: Place) -> None:
    """Raises FolderError where what is written would land outside the folder."""
    if isinstance(root, Path):
        for name in ("shards", "index", "plugins", f"{MARK}", f"{RECORDS}", f"{SNAPSHOTS}"):
            if (root / name).is_symlink():
                raise FolderError(f"{root / name} is a link, but gen2d writes only into the dataset's own folders")


def _clear(root: Place) -> None:
    """Removes what is written here and no more; what says that it is a dataset's folder goes last."""
    for name in (MANIFEST, "croissant.json", "README.md", SHEET, CONFIG, NEXT):
        (root / name).unlink(missing_ok=True)
    for name in ("shards", "index", "plugins", MARK / "done", RECORDS, SNAPSHOTS):
        remove_tree(root / name)
    mark_path(root).unlink(missing_ok=True)


def _claim(spec: DatasetSpec) -> None:
    root = spec.root
    schema = schema_of(root)
    if schema is not None and schema != SCHEMA:
        raise FolderError(
            f"{root} holds a dataset with the schema {schema}, but this gen2d writes {SCHEMA}: choose another --out, "
            "or --overwrite to make the dataset anew"
        )
    for folder in (RECORDS, "shards", "index"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    mark = mark_path(root)
    try:
        there = identity_of(root)
    except DamagedError:
        there = None
    if there is not None:
        _compare(spec, there)
    elif mark.exists():
        raise FolderError(f"{mark} is damaged: choose another --out, or --overwrite to make the dataset anew")
    publish_changed(mark, mark_content(spec))


def mark_content(spec: DatasetSpec) -> bytes:
    """What stands in the file that says whose folder it is."""
    return as_json(sealed({**spec.identity, "sources": spec.producer.get("sources", {})}, MARK_SEAL))


def sources_of(root: Place) -> Mapping[str, str]:
    """The hashes of gen2d's source files that the dataset was made with, as far as it says."""
    manifest = current(root)
    found = manifest.producer if manifest else read_sealed(mark_path(root), MARK_SEAL) or {}
    known = found.get("sources")
    return {str(name): str(digest) for name, digest in known.items()} if isinstance(known, dict) else {}


def _compare(spec: DatasetSpec, there: Mapping[str, Any]) -> None:
    told = told_differences(there, spec.identity, sources_of(spec.root), spec.producer.get("sources", {}))
    if told:
        raise FolderError(
            f"{spec.root} holds another dataset ({told}): choose another --out, or --overwrite to replace it"
        )


def told_differences(
    there: Mapping[str, Any], here: Mapping[str, Any], sources_there: Mapping[str, str], sources_here: Mapping[str, str]
) -> str:
    """In what two identities differ, for a sentence; empty if in nothing. Sources tell why a program is another."""
    programs, others = [], []
    for name, one, other in differences(there, here):
        kind = name.removeprefix("fingerprint.programs.")
        if kind == name:
            others.append(f"{name} is {one!s:.60} there and {other!s:.60} here")
        else:
            programs.append(PROGRAMS.get(kind.rpartition(".")[2], kind))
    if not programs:
        return " and ".join(others[:3])
    edited = sorted(
        name for name in sources_there.keys() | sources_here.keys() if sources_there.get(name) != sources_here.get(name)
    )
    which = " and ".join(dict.fromkeys(programs))
    why = f", as these files differ: {', '.join(edited[:5])}{' ...' if len(edited) > 5 else ''}" if edited else ""
    return " and ".join([*others[:2], f"the program that {which} is another{why}"])


def differences(there: Any, here: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The entries in which two values as JSON has them differ: name, and both values."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in sorted(there.keys() | here.keys()):
            yield from differences(there.get(key), here.get(key), f"{name}.{key}".lstrip("."))
    elif there != here:
        yield name, there, here


@contextlib.contextmanager
def explained(root: Place) -> Iterator[None]:
    """A block that writes into a dataset's folder; what goes wrong becomes one sentence."""
    try:
        yield
    except UnreachableError as error:
        raise error if AGAIN in str(error) else UnreachableError(f"{error}: once it can, {AGAIN}") from None
    except OSError as error:
        if isinstance(root, Url):
            told = "permission was denied" if isinstance(error, PermissionError) else error.strerror or str(error)
            raise FolderError(f"{error.filename or root} cannot be read or written ({told}): {AGAIN}") from None
        raise writing_error(root, error, AGAIN) from error


# ---- The next snapshot


@dataclasses.dataclass(frozen=True)
class Publication:
    """Everything that a snapshot consists of beside its shards and tables."""

    manifest: Manifest
    files: Mapping[str, bytes]  # config, plug-ins, sheet, cards: by name in the folder; of the others those there stay


class SupersededError(Exception):
    """Another process has published a snapshot meanwhile."""


def publish_snapshot(spec: DatasetSpec, publication: Publication, records: Records, old: Manifest | None) -> None:
    """Returns when readers have this snapshot, which comes after `old`.

    The manifest before goes to `.gen2d/snapshots`, and so does, once the new manifest is there, what that alone names.
    Killed at any moment, the folder has the one manifest or the other, whole. Raises SupersededError, and readers have
    what they had, if the folder has another manifest than `old`.
    """
    root, new = spec.root, publication.manifest
    content = as_bytes(new)
    if old is not None and old.splits != new.splits:
        kept = snapshot_path(root, old.sha256)
        kept.mkdir(parents=True, exist_ok=True)
        publish_changed(kept / MANIFEST, as_bytes(old))
    if old is None or old.sha256 != new.sha256:
        publish(root / NEXT, content)
    for name, own in publication.files.items():
        if name == "README.md" and old is not None and old.sha256 == new.sha256 and (root / name).is_file():
            continue  # people may write in it
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        publish_changed(root / name, own)
    check_current(root, old)
    publish_changed(root / MANIFEST, content)
    (root / NEXT).unlink(missing_ok=True)
    _retire(root, new)
    _remove_replaced(root, new, records)
    remove_logs(spec, records)


def current(root: Place) -> Manifest | None:
    """The folder's manifest; None if there is none that is whole."""
    return _parsed(root / MANIFEST)


def check_current(root: Place, expected: Manifest | None) -> None:
    """Raises SupersededError if the folder has another manifest than this one."""
    found = current(root)
    if (found and found.sha256) != (expected and expected.sha256):
        raise SupersededError


def _parsed(path: Place) -> Manifest | None:
    """The manifest in the file; None if there is none that is whole."""
    try:
        return parse(read_bytes(path, JSON_BYTES), f"{path}")
    except (FolderError, DamagedError):
        return None
    except OSError as error:
        failure = reading_error(path, error)
        if isinstance(failure, DamagedError):  # missing, or no regular file
            return None
        raise failure from error


def next_manifest(root: Place) -> Manifest | None:
    """The manifest that is about to replace the present one, or was when its process was killed."""
    return _parsed(root / NEXT)


def _entries(folder: Place) -> list[Place]:
    try:
        return list(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []


def _retire(root: Place, new: Manifest) -> None:
    """Moves what only earlier manifests name to where the snapshot of each of them lies."""
    snapshots: dict[str, list[Place]] = {}
    for folder in _entries(root / SNAPSHOTS):
        earlier = _parsed(folder / MANIFEST)
        if earlier is not None:
            for name in _growing_files(earlier) - _growing_files(new):
                snapshots.setdefault(name, []).append(snapshot_path(root, earlier.sha256))
    for name, folders in snapshots.items():
        for folder in folders:
            _copy(root / name, folder / name)
        (root / name).unlink(missing_ok=True)


def _growing_files(manifest: Manifest) -> set[str]:
    """The names of the files that others replace when a split grows: its table, and a last shard that is a part."""
    names = {table.file for table in manifest.tables.values()}
    for split, count in manifest.splits.items():
        rest = count % manifest.videos_per_shard
        if rest:
            names.add(shard_name(shard_of(split, count - rest, rest, manifest.videos_per_shard).name))
    return names


def _copy(source: Place, target: Place) -> None:
    """Returns when the file is also at `target`; one that is no longer there has been moved already."""
    if target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        if isinstance(source, Url) and isinstance(target, Url):
            source.copy(target)
        elif isinstance(source, Path) and isinstance(target, Path):
            link_or_copy(source, target)
    except FileNotFoundError:
        return


def _remove_replaced(root: Place, new: Manifest, records: Records) -> list[Place]:
    """Removes what runs left that were stopped before they had ended: shards that are part of a larger one in the
    manifest, and tables of splits that are larger now."""
    old: list[Place] = []
    for path in _entries(root / "index"):
        match = TABLE_NAME.fullmatch(path.name)
        if match and int(match["count"]) < new.splits.get(match["split"], 0):
            old.append(path)
    for path in _partial_shards(root, records):
        match = FILE_NAME.fullmatch(path.name)
        if match and match["count"]:
            end = int(match["place"]) * new.videos_per_shard + int(match["count"])
            if end < new.splits.get(match["split"], 0):
                old.append(path)
    for path in old:
        path.unlink(missing_ok=True)
    return old


def _partial_shards(root: Place, records: Records) -> list[Place]:
    """Shards that may be part of larger ones; at a URL, where listing is slow, those that are recorded."""
    if isinstance(root, Path):
        return _entries(root / "shards")
    return [root / shard_name(shard.name) for shard in records.shards() if shard.count < records.size]


def _drop_snapshots(root: Place) -> list[Place]:
    """Removes what earlier growth left."""
    folders = _entries(root / SNAPSHOTS)
    for folder in folders:
        remove_tree(folder)
    return folders


def clean(root: Place) -> list[str]:
    """Removes what nobody needs: earlier snapshots, and temporary files that nobody writes any more.

    Returns their names. Where the file system has no locks nobody knows whether a temporary file is written, so call
    this only while nothing is.
    """
    with explained(root):
        check_links(root)
        manifest = read_manifest(root)  # says if it is no complete dataset
        with alone(root):
            manifest, records = read_manifest(root), read_records(manifest, root)
            removed = _remove_replaced(root, manifest, records)
            removed += _remove_unrecorded(root, records)
            removed += _drop_snapshots(root)
            removed += sweep(root, FOLDERS, force=True)
        return sorted(str(path).removeprefix(f"{root}/") for path in removed)


def _remove_unrecorded(root: Place, records: Records) -> list[Place]:
    """Removes shards of which no row is there: their process was killed before it wrote one."""
    known = {f"{shard.name}.h5" for shard in records.shards()}
    left = [path for path in _entries(root / "shards") if FILE_NAME.fullmatch(path.name) and path.name not in known]
    for path in left:
        path.unlink(missing_ok=True)
    return left


def is_foreign(name: str) -> bool:
    """Whether a file in shards/ or index/ is none that a run writes, be it done or under way."""
    return not (is_temporary(name) or FILE_NAME.fullmatch(name) or TABLE_NAME.fullmatch(name))
