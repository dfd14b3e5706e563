"""A dataset's folder while it is made: who may write into it, what is left to do, and how it becomes the next snapshot.

    plan -> open_folder -> (encode -> write) for each shard -> complete

A shard is done if there is a row of it and its file has the size that the row says, so whatever a crash leaves is made
again. Workers share nothing: each takes its shards by their place, and whoever finds all of them done publishes the
tables and, last, the manifest. Until then readers have the manifest before it, and all that it names.
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

from gen2d.core.errors import DamagedError, FolderError, UnreachableError
from gen2d.dataset.manifest import (
    CONFIG,
    MANIFEST,
    MARK_SEAL,
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
from gen2d.storage.atomic import is_temporary, publish, publish_changed, remove_tree, sweep
from gen2d.storage.explain import reading_error, writing_error
from gen2d.storage.paths import Place, Url
from gen2d.storage.sealed import JSON_BYTES, as_json, read_bytes, read_sealed, sealed

# What each program of a fingerprint does.
PROGRAMS = {"simulate": "samples and simulates", "draw": "draws", "captions": "writes captions"}
PROGRAMS |= {"grids": "orders the combinations on grids"}

FOLDERS = ("", "shards", "index", f"{MARK}", f"{RECORDS}")  # where temporary files are written


def open_folder(spec: DatasetSpec, overwrite: bool = False) -> list[Shard]:
    """The shards that remain to be made, in a folder that is ready for them.

    Videos that are there already stay, also those beyond what was asked. Raises FolderError for a folder that is not
    this dataset's, or cannot be written.
    """
    root = spec.root
    with explained(root):
        check_links(root)
        if overwrite and _is_dataset(root):
            _clear(root)
        _claim(spec)
        sweep(root, FOLDERS)
        records, sizes = read_records(spec), Sizes(root)
        remaining = [shard for shard in whole_plan(spec, records) if not is_done(shard, records, sizes)]
        if remaining:
            _drop_snapshots(root)
        return remaining


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
                self.known = {e.name: e.stat().st_size for e in entries if e.is_file()}
            self.known = self.known or {}

    def fits(self, shard: Shard, size: int) -> bool:
        """Whether the shard's file has this size."""
        return self.known is None or self.known.get(f"{shard.name}.h5") == size


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


def check_links(root: Place) -> None:
    """Raises FolderError where what is written would land outside the folder."""
    if isinstance(root, Path):
        for name in ("shards", "index", "plugins", f"{MARK}", f"{RECORDS}", f"{SNAPSHOTS}"):
            if (root / name).is_symlink():
                raise FolderError(f"{root / name} is a link, but gen2d writes only into the dataset's own folders")


def _clear(root: Place) -> None:
    """Removes what is written here and no more; the mark's folder stays, so that a crash here leaves a dataset's."""
    (root / MARK).mkdir(exist_ok=True)
    for name in (MANIFEST, "croissant.json", "README.md", SHEET, CONFIG, NEXT, MARK / "dataset.json"):
        (root / name).unlink(missing_ok=True)
    for name in ("shards", "index", "plugins", MARK / "done", RECORDS, SNAPSHOTS):
        remove_tree(root / name)


def _claim(spec: DatasetSpec) -> None:
    root = spec.root
    if root.is_dir() and not _is_dataset(root) and any(root.iterdir()):
        raise FolderError(f"{root} holds something else than a gen2d dataset: choose another --out")
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
    manifest = _current(root)
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
            others.append(f"{name} is {one} there and {other} here")
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
    files: Mapping[str, bytes]  # config, plug-ins, sheet, cards: by name in the folder


def publish_snapshot(spec: DatasetSpec, publication: Publication, records: Records) -> None:
    """Returns when readers have this snapshot.

    The manifest of the one before goes to `.gen2d/snapshots`, and so does, once the new manifest is there, what that
    alone names. Killed at any moment, the folder has the one manifest or the other, whole.
    """
    root, new = spec.root, publication.manifest
    content, old = as_bytes(new), _current(root)
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
    publish_changed(root / MANIFEST, content)
    (root / NEXT).unlink(missing_ok=True)
    for folder in _entries(root / SNAPSHOTS):
        earlier = _parsed(folder / MANIFEST)
        if earlier is not None and earlier.sha256 != new.sha256:
            _retire(root, earlier, new)
    _remove_replaced(spec, records, new)
    remove_logs(spec, records)


def _current(root: Place) -> Manifest | None:
    return _parsed(root / MANIFEST)


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


def _retire(root: Place, old: Manifest, new: Manifest) -> None:
    """Moves what only the manifest before names to where its snapshot lies."""
    target = snapshot_path(root, old.sha256)
    for split, table in old.tables.items():
        names = [table.file] if new.tables[split].file != table.file else []
        last = shard_of(split, (table.shards - 1) * old.videos_per_shard, _rest(old, split), old.videos_per_shard)
        if names and last.count < old.videos_per_shard:
            names.append(shard_name(last.name))
        for name in names:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):  # another worker did it just now
                _move(root / name, target / name)


def _move(source: Place, target: Place) -> None:
    if isinstance(source, Url):
        assert isinstance(target, Url)
        source.rename(target)
    else:
        assert isinstance(target, Path)
        source.rename(target)


def _rest(manifest: Manifest, split: str) -> int:
    """How many videos the last shard of a split has."""
    return (manifest.splits[split] - 1) % manifest.videos_per_shard + 1


def _remove_replaced(spec: DatasetSpec, records: Records, new: Manifest) -> None:
    """Removes what runs left that were stopped before they had ended: shards that are part of a larger one which is
    done, and tables of splits that are larger now."""
    for path in _entries(spec.root / "index"):
        match = TABLE_NAME.fullmatch(path.name)
        if match and int(match["count"]) < new.splits.get(match["split"], 0):
            path.unlink(missing_ok=True)
    full = {(shard.split, shard.first): shard.count for shard in sorted(records.shards(), key=lambda s: s.count)}
    for shard in records.shards():
        if shard.count < full[shard.split, shard.first]:
            (spec.root / shard_name(shard.name)).unlink(missing_ok=True)


def _drop_snapshots(root: Place, force: bool = False) -> list[Place]:
    """Removes what earlier growth left, but for the snapshot that present readers may still be led to."""
    current = _current(root)
    keep = "" if force or current is None else current.sha256[:16]
    folders = [path for path in _entries(root / SNAPSHOTS) if path.name != keep]
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
        read_manifest(root)  # says if it is no complete dataset
        removed = _drop_snapshots(root, force=True)
        removed += sweep(root, FOLDERS, force=True)
        return sorted(str(path).removeprefix(f"{root}/") for path in removed)


def is_foreign(name: str) -> bool:
    """Whether a file in shards/ or index/ is none that a run writes, be it done or under way."""
    return not (is_temporary(name) or FILE_NAME.fullmatch(name) or TABLE_NAME.fullmatch(name))
