"""A dataset's folder while it is generated: who may write into it, and which shards remain to be made.

    plan -> open_folder -> (encode -> write) for each shard -> complete

A shard is done if its row is recorded and its file has the recorded size; anything else that a crash leaves is made
again. Workers share nothing: each takes its shards by their numbers, and the first that finds all of them done
publishes the tables and, last, the manifest. Until then readers see the previous manifest and all the files that it
names. A process holds the lock of the folder while it looks for remaining shards, publishes, repairs or cleans. Where
there are no locks, as at a URL, a manifest is replaced only if it has not changed since the process read it.
"""

import contextlib
import dataclasses
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gen2d.core.errors import ConfigError, DamagedError, FolderError, UnreachableError, argument
from gen2d.dataset.manifest import MARK_SEAL, folder_schema, identity_of, read_manifest, schema_of
from gen2d.dataset.manifest_parser import SHARDS
from gen2d.dataset.records import Records, read_records
from gen2d.dataset.shard_writer import AGAIN
from gen2d.dataset.snapshots import current_manifest, remove_replaced, remove_snapshots
from gen2d.dataset.spec import (
    CONFIG,
    EARLIER_SCHEMA,
    FILE_NAME,
    LOCK,
    MANIFEST,
    MARK,
    NEXT,
    PAGE,
    RECORDS,
    SCHEMA,
    SCHEMAS,
    SHEET,
    SNAPSHOTS,
    TABLE_NAME,
    DatasetSpec,
    Shard,
    mark_path,
    plan,
    shard_count,
)
from gen2d.storage.atomic import is_temporary, list_folder, publish, publish_changed, remove_tree, size_of, sweep
from gen2d.storage.explain import writing_error
from gen2d.storage.leases import exclusive_lock
from gen2d.storage.paths import Place, Url
from gen2d.storage.sealed import JSON_BYTES, as_json, read_sealed, seal

# What each program of a fingerprint does.
PROGRAMS = {
    "sample": "samples scenes",
    "simulate": "simulates",
    "members": "samples and simulates matched sets",
    "stage": "prepares rendering",
    "draw": "draws",
    "captions": "writes captions",
    "grids": "orders the combinations on grids",
}

FOLDERS = ("", "shards", "index", f"{MARK}", f"{RECORDS}")  # those that may hold temporary files
LOCK_SECONDS = 300.0  # how long to wait for another process that changes the folder


def open_folder(spec: DatasetSpec, overwrite: bool = False) -> list[Shard]:
    """The shards that remain to be made, in a folder that is ready for them.

    Existing videos stay, even beyond the numbers in `spec`. Raises ConfigError for too many shards, and FolderError
    for a folder that holds anything else or cannot be written.
    """
    root = spec.root
    count = sum(shard_count(videos, spec.videos_per_shard) for videos in spec.splits.values())
    if count > SHARDS:
        raise ConfigError(
            f"storage.videos_per_shard is {spec.videos_per_shard}, which gives {count:,} shards, but must be large "
            f"enough for at most {SHARDS:,}"
        )
    with translate_errors(root):
        check_links(root)
        if root.is_dir() and not _is_dataset(root) and any(root.iterdir()):
            raise FolderError(f"{root} holds something other than a gen2d dataset: choose another {argument('out')}")
        with folder_lock(root):
            if overwrite and _is_dataset(root):
                _clear(root)
            _claim(spec)
            sweep(root, FOLDERS)
            records, sizes = read_records(spec, root), Sizes(root)
            shards = whole_plan(spec, records)
            remaining = [shard for shard in shards if not is_done(shard, records, sizes)]
            manifest = current_manifest(root) if remaining else None  # read again: another process may have grown it
            if manifest and any(s.first + s.count > manifest.splits.get(s.split, 0) for s in shards):
                remove_snapshots(root)  # the dataset grows
            return remaining


@contextlib.contextmanager
def folder_lock(root: Place) -> Iterator[None]:
    """A block that holds the folder's lock; at a URL there is none.

    Raises FolderError if another process does not release the lock in time.
    """
    if isinstance(root, Url):
        yield
        return
    (root / MARK).mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(exclusive_lock(root / LOCK, LOCK_SECONDS))
        except TimeoutError:
            raise FolderError(f"{root} is being changed by another process: try again when that has ended") from None
        yield


def whole_plan(spec: DatasetSpec, records: Records) -> list[Shard]:
    """All shards of the dataset: those of `spec` and those that are recorded."""
    counts = dict(spec.splits)
    for split, count in records.counts().items():
        counts[split] = max(counts.get(split, 0), count)
    return plan(counts, spec.videos_per_shard)


class Sizes:
    """The sizes of all shards' files, from one listing; at a URL, where no file goes missing, none are checked."""

    def __init__(self, root: Place) -> None:
        self.known: dict[str, int] | None = None
        if isinstance(root, Path):
            with contextlib.suppress(FileNotFoundError), os.scandir(root / "shards") as entries:
                self.known = {entry.name: size for entry in entries if (size := size_of(entry)) is not None}
            self.known = self.known or {}

    def fits(self, shard: Shard, size: int) -> bool:
        """Whether the shard's file has this size."""
        return self.known is None or self.known.get(f"{shard.name}.h5") == size


def is_done(shard: Shard, records: Records, sizes: Sizes) -> bool:
    """Whether the shard is recorded and its file has the recorded size."""
    row = records.row_of(shard)
    return row is not None and sizes.fits(shard, int(row["bytes"]))


def free_bytes(root: Place) -> float:
    """The free space on the disk that holds `root`, or will; infinite for a URL."""
    if isinstance(root, Url):
        return math.inf
    path = root.absolute()
    return shutil.disk_usage(next(place for place in (path, *path.parents) if place.exists())).free


def log(root: Place, *entries: Mapping[str, Any]) -> None:
    """Append lines to the folder's run log, the only file that contains times and hosts."""
    path = root / MARK / "run.jsonl"
    line = "".join(json.dumps(dict(entry), sort_keys=True) + "\n" for entry in entries)
    if not line:
        return
    with translate_errors(root):
        if isinstance(path, Path):
            with path.open("a") as file:
                file.write(line)
        else:  # the object is written anew, so of two workers that end at once one may lose its line
            publish(path, (path.read_bytes(JSON_BYTES) if path.exists() else b"") + line.encode())


# ---- The identity of the folder


def _is_dataset(root: Place) -> bool:
    if isinstance(root, Url):
        return mark_path(root).exists() or schema_of(root) is not None
    return (root / MARK).is_dir() or (schema_of(root) or "").startswith("gen2d.dataset/")


def check_links(root: Place) -> None:
    """Check that none of the dataset's subfolders is a link to elsewhere; raises FolderError."""
    if isinstance(root, Path):
        for name in ("shards", "index", "plugins", f"{MARK}", f"{RECORDS}", f"{SNAPSHOTS}"):
            if (root / name).is_symlink():
                raise FolderError(f"{root / name} is a link, but gen2d writes only into the dataset's own folders")


def _clear(root: Place) -> None:
    """Remove the files that gen2d writes and no others; the mark, which claims the folder, goes last."""
    for name in (MANIFEST, "croissant.json", "README.md", SHEET, PAGE, CONFIG, NEXT):
        (root / name).unlink(missing_ok=True)
    for name in ("shards", "index", "plugins", MARK / "done", RECORDS, SNAPSHOTS):
        remove_tree(root / name)
    mark_path(root).unlink(missing_ok=True)


def _claim(spec: DatasetSpec) -> None:
    """Write the mark of this dataset into the folder; raises FolderError for a folder of another dataset."""
    root = spec.root
    schema = schema_of(root)
    if schema is not None and schema not in SCHEMAS:
        raise FolderError(
            f"{root} holds a dataset with the schema {schema}, but this gen2d writes {SCHEMA}: choose another "
            f"{argument('out')}, or {argument('overwrite', True)} to make the dataset anew"
        )
    for folder in (RECORDS, "shards", "index"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    mark = mark_path(root)
    try:
        there = identity_of(root)
    except DamagedError:
        there = None
    if there is None and mark.exists():
        raise FolderError(
            f"{mark} is damaged: choose another {argument('out')}, or {argument('overwrite', True)} to make the "
            "dataset anew"
        )
    if there is not None and there != spec.identity:
        sources = sources_of(root), spec.producer.get("sources", {})
        difference = describe_differences(there, spec.identity, *sources)
        if difference:
            raise FolderError(
                f"{root} holds another dataset ({difference}): choose another {argument('out')}, or "
                f"{argument('overwrite', True)} to replace it"
            )
    publish_changed(mark, mark_content(dataclasses.replace(spec, schema=folder_schema(root, spec.schema))))


def mark_content(spec: DatasetSpec) -> bytes:
    """The content of the mark, the file that holds the dataset's identity."""
    schema = {} if spec.schema == EARLIER_SCHEMA else {"schema": spec.schema}  # earlier versions named none
    return as_json(seal({**spec.identity, **schema, "sources": spec.producer.get("sources", {})}, MARK_SEAL))


def sources_of(root: Place) -> Mapping[str, str]:
    """The sha256 of the gen2d source files that made the dataset, as far as the folder names them."""
    manifest = current_manifest(root)
    producer = manifest.producer if manifest else read_sealed(mark_path(root), MARK_SEAL) or {}
    known = producer.get("sources")
    return {str(name): str(digest) for name, digest in known.items()} if isinstance(known, dict) else {}


def describe_differences(
    there: Mapping[str, Any], here: Mapping[str, Any], sources_there: Mapping[str, str], sources_here: Mapping[str, str]
) -> str:
    """A description of the differences of two identities; empty if they are equal.

    The hashes of the source files explain why a compiled program differs.
    """
    programs, others = [], []
    for name, one, other in differences(there, here):
        program = name.removeprefix("fingerprint.programs.")
        if program == name:
            others.append(f"{name} is {one!s:.60} there and {other!s:.60} here")
        else:
            programs.append(PROGRAMS.get(program.rpartition(".")[2], program))
    if not programs:
        return " and ".join(others[:3])
    edited = sorted(
        name for name in sources_there.keys() | sources_here.keys() if sources_there.get(name) != sources_here.get(name)
    )
    which = " and ".join(dict.fromkeys(programs))
    cause = f", as these files differ: {', '.join(edited[:5])}{' ...' if len(edited) > 5 else ''}" if edited else ""
    return " and ".join([*others[:2], f"the program that {which} is another{cause}"])


def differences(there: Any, here: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The name and both values of each entry in which two JSON values differ."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in sorted(there.keys() | here.keys()):
            yield from differences(there.get(key), here.get(key), f"{name}.{key}".lstrip("."))
    elif there != here:
        yield name, there, here


@contextlib.contextmanager
def translate_errors(root: Place) -> Iterator[None]:
    """A block that writes into a dataset's folder; its OSError becomes one of ours, with one sentence."""
    try:
        yield
    except UnreachableError as error:
        raise error if AGAIN in str(error) else UnreachableError(f"{error}: once it can, {AGAIN}") from None
    except OSError as error:
        if isinstance(root, Url):
            cause = "permission denied" if isinstance(error, PermissionError) else error.strerror or str(error)
            raise FolderError(f"{error.filename or root} cannot be read or written ({cause}): {AGAIN}") from None
        raise writing_error(root, error, AGAIN) from error


# ---- Leftovers


def clean(root: Place) -> list[str]:
    """Remove earlier snapshots, unrecorded shards and abandoned temporary files; returns their names.

    Where the file system has no locks, gen2d cannot know whether a temporary file is still being written: clean only
    while nothing else writes into the folder.
    """
    with translate_errors(root):
        check_links(root)
        read_manifest(root)  # raises IncompleteError before anything is written
        with folder_lock(root):
            manifest = read_manifest(root)
            records = read_records(manifest, root)
            removed = remove_replaced(root, manifest, records)
            recorded = {f"{shard.name}.h5" for shard in records.shards()}
            for path in list_folder(root / "shards"):
                if FILE_NAME.fullmatch(path.name) and path.name not in recorded:
                    path.unlink(missing_ok=True)
                    removed.append(path)
            removed += remove_snapshots(root)
            removed += sweep(root, FOLDERS, force=True)
        return sorted(str(path).removeprefix(f"{root}/") for path in removed)


def is_foreign(name: str) -> bool:
    """Whether no run writes a file with this name into shards/ or index/."""
    return not (is_temporary(name) or FILE_NAME.fullmatch(name) or TABLE_NAME.fullmatch(name))
