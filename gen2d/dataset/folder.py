"""A dataset folder: how a shard is written so that a crash cannot hurt it, what is left to do, and what completes it.

    plan -> open_folder -> (encode -> write) for each shard -> finish

A shard is written under a temporary name, hashed, and renamed, or uploaded where the folder is a Url; its record under
``.gen2d/done`` follows. A shard is done if its record fits and its file has the recorded size, so whatever a crash
leaves is made again. Workers share nothing: each takes its shards by their number, and whoever finds all records writes
the index, the cards and, last, the manifest.
"""

import contextlib
import dataclasses
import errno
import io
import json
import math
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gen2d.core.errors import FolderError
from gen2d.dataset import cards, hdf5
from gen2d.dataset.block import Block, Places, encode, head, merged, stored_bytes
from gen2d.dataset.cards import SHEET
from gen2d.dataset.manifest import (
    MARK_SEAL,
    RECORD_SEAL,
    SEAL,
    describe,
    identity_of,
    read_manifest,
    read_record,
    write_index,
)
from gen2d.dataset.spec import MARK, SCHEMA, Dataset, Shard, mark_path, mine, plan, record_path, shard_path, table_path
from gen2d.storage.atomic import (
    as_json,
    file_sha256,
    publish,
    publishing,
    read_json,
    read_sealed,
    remove_tree,
    sealed,
    sha256,
    size_of,
    sweep,
    work_folder,
)
from gen2d.storage.paths import Place, Url

__all__ = [
    "Block", "Dataset", "Shard", "differences", "encode", "finish", "forget", "free_bytes", "head", "log", "lost",
    "mine", "open_folder", "plan", "read_manifest", "write",
]  # fmt: skip


# ---- The folder


def open_folder(dataset: Dataset, overwrite: bool = False) -> list[Shard]:
    """The shards that remain to be made, in a folder that is ready for them.

    Videos that are there already stay, also those beyond what was asked. While shards remain, the folder has no
    manifest. Raises FolderError for a folder that is not this dataset's, or cannot be written.
    """
    root = dataset.root
    with _explained(root):
        if overwrite and _is_dataset(root):
            _clear(root)
        _claim(dataset)
        sweep(root)
        records = _records(dataset)
        planned = _whole_plan(dataset, records)
        done = _at_once(lambda shard: _is_done(dataset, shard, records), planned)
        remaining = [shard for shard, is_done in zip(planned, done, strict=True) if not is_done]
        if remaining:
            (root / "manifest.json").unlink(missing_ok=True)
        return remaining


def lost(dataset: Dataset, bad: Iterable[str]) -> tuple[Dataset, list[str]]:
    """The dataset with as many videos as it held, and which shards must be made again: those called `bad`, and all
    whose record or file is not whole.

    Where the manifest is damaged, the records say how many videos there were and what is in each shard, and every
    shard is compared. Raises FolderError where they cannot say.
    """
    root, records = dataset.root, _records(dataset)
    known = read_sealed(root / "manifest.json", SEAL)
    planned = _whole_plan(dataset if known is None else _with_counts(dataset, known["splits"]), records)
    missing = {shard.name for shard in planned if not _is_done(dataset, shard, records)}
    if known is None:
        _check_planned(root, planned)
        missing |= {name for name in records.keys() - missing if not _has_bytes(shard_path(root, name), records[name])}
    counts = {shard.split: shard.first + shard.count for shard in planned}
    return _with_counts(dataset, counts), sorted(missing | set(bad))


def _with_counts(dataset: Dataset, counts: Mapping[str, int]) -> Dataset:
    return dataclasses.replace(dataset, splits=counts)


def _has_bytes(path: Place, record: Mapping[str, Any]) -> bool:
    return path.is_file() and file_sha256(path) == record["sha256"]


def _check_planned(root: Place, planned: Iterable[Shard]) -> None:
    """Raises FolderError for what a lost record may have been of: the dataset might have been larger."""
    kinds = (root / "shards").glob("*.h5"), (root / MARK / "done").glob("*.json")
    there = {path.name.rpartition(".")[0] for paths in kinds for path in paths}
    for name in sorted(there - {shard.name for shard in planned}):
        raise FolderError(
            f"{root / 'manifest.json'} and the record of {name} are both not what was written, so nothing says how "
            "many videos there were: run the command that made the dataset again"
        )


def forget(root: Place, name: str) -> None:
    """Returns nothing; the shard called `name` counts as not made, so that the next run makes it again."""
    record_path(root, name).unlink(missing_ok=True)


def free_bytes(root: Place) -> float:
    """How much the disk that holds `root`, or will, can take; of a Url no limit is known."""
    if isinstance(root, Url):
        return math.inf
    path = root.absolute()
    return shutil.disk_usage(next(place for place in (path, *path.parents) if place.exists())).free


def log(root: Place, entry: Mapping[str, Any]) -> None:
    """Returns nothing; adds a line to the folder's run log, which is where times and hosts belong."""
    path, line = root / MARK / "run.jsonl", json.dumps(dict(entry), sort_keys=True) + "\n"
    with _explained(root):
        if isinstance(path, Path):
            with path.open("a") as file:
                file.write(line)
        else:  # an object is written anew, so of two workers that end at once one may go unnoted
            publish(path, (path.read_bytes() if path.exists() else b"") + line.encode())


def _is_dataset(root: Place) -> bool:
    return (root / MARK).is_dir() or (read_json(root / "manifest.json") or {}).get("schema") == SCHEMA


def _clear(root: Place) -> None:
    """Removes what is written here and no more; the mark stays, so that a crash here leaves a dataset's folder."""
    (root / MARK).mkdir(exist_ok=True)
    for name in ("manifest.json", "croissant.json", "README.md", SHEET, "config.yaml", MARK / "dataset.json"):
        (root / name).unlink(missing_ok=True)
    for name in ("shards", "index", "plugins", MARK / "done"):
        remove_tree(root / name)


def _claim(dataset: Dataset) -> None:
    root = dataset.root
    if root.is_dir() and not _is_dataset(root) and any(root.iterdir()):
        raise FolderError(f"{root} holds something else than a gen2d dataset: choose another --out")
    for folder in (MARK / "done", "shards", "index"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    mark, there = mark_path(root), identity_of(root)
    if there is not None:
        _compare(root, there, dataset.identity)
    elif mark.exists():
        raise FolderError(f"{mark} is damaged: choose another --out, or --overwrite to make the dataset anew")
    content = as_json(sealed(dataset.identity, MARK_SEAL))
    if not mark.is_file() or mark.read_bytes() != content:
        publish(mark, content)


def _compare(root: Place, there: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    differing = list(differences(there, here))
    if differing:
        told = " and ".join(differing[:3])
        raise FolderError(f"{root} holds another dataset ({told}): choose another --out, or --overwrite to replace it")


def differences(there: Any, here: Any, name: str = "") -> Iterator[str]:
    """In which entries two values as JSON has them differ."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in sorted(there.keys() | here.keys()):
            yield from differences(there.get(key), here.get(key), f"{name}.{key}".lstrip("."))
    elif there != here:
        yield f"{name} is {there} there and {here} here"


@contextlib.contextmanager
def _explained(root: Place) -> Iterator[None]:
    try:
        yield
    except (FileExistsError, NotADirectoryError) as error:
        raise FolderError(f"{error.filename} is a file, not a folder: choose another --out") from error
    except PermissionError as error:
        raise FolderError(f"you have no permission to write in {error.filename}: choose another --out") from error
    except OSError as error:
        if isinstance(root, Url):
            raise _unreached(root, error) from error
        why = (
            "is on a disk that is read-only" if error.errno == errno.EROFS else f"cannot be written ({error.strerror})"
        )
        raise FolderError(f"{root} {why}: choose another --out") from error


def _unreached(root: Url, error: OSError) -> FolderError:
    told = "permission was denied" if isinstance(error, PermissionError) else error.strerror or str(error)
    again = "run the same command again, and it goes on where it stopped"
    return FolderError(f"{error.filename or root} cannot be read or written ({told}): once it can, {again}")


# ---- One shard


def write(dataset: Dataset, shard: Shard, blocks: Iterable[Block]) -> dict[str, Any]:
    """The record of the shard that `blocks` became; afterwards it is done, whatever happens to the machine.

    Raises FolderError when the disk is full or a server keeps failing. Whatever is raised, here or by `blocks`, nothing
    half-written stays.
    """
    seen = _Seen()
    try:
        return _write(dataset, shard, seen.passing(blocks), seen)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise _full(dataset, shard, seen) from error
        if isinstance(dataset.root, Url):
            raise _unreached(dataset.root, error) from error
        raise


class _Seen:
    """What is kept of the blocks that pass on their way into a file."""

    def __init__(self) -> None:
        self.crc: dict[str, list[np.ndarray]] = {}
        self.moments: dict[str, list[np.ndarray]] = {}
        self.videos = self.bytes = 0

    def passing(self, blocks: Iterable[Block]) -> Iterator[Block]:
        for block in blocks:
            for name, values in block.crc.items():
                self.crc.setdefault(name, []).append(values)
            for name, values in block.moments.items():
                self.moments.setdefault(name, []).append(values)
            self.videos += len(block)
            self.bytes += block.nbytes
            yield block


def _write(dataset: Dataset, shard: Shard, blocks: Iterable[Block], seen: _Seen) -> dict[str, Any]:
    about = {"schema": SCHEMA, "name": dataset.name, "split": shard.split, "first": shard.first}
    about |= {"fps": dataset.fps, "seed": dataset.seed, "conventions": dataset.conventions}
    layout = dataset.fields, dataset.sizes, shard.count
    with publishing(shard_path(dataset.root, shard.name)) as temporary:
        places = hdf5.write(temporary, *layout, blocks, dataset.codec, dataset.chunk_frames, about, dataset.constants)
        file = {"bytes": temporary.stat().st_size, "sha256": file_sha256(temporary)}
    tables = _packed(seen, places)
    publish(table_path(dataset.root, shard.name), tables)
    own = {key: getattr(shard, key) for key in ("name", "split", "first", "count")}  # its number changes as splits grow
    record = _origin(dataset) | own | file | _contents(seen, places)
    record = sealed(record | {"tables_sha256": sha256(tables)}, RECORD_SEAL)
    publish(record_path(dataset.root, shard.name), as_json(record))
    return record


def _packed(seen: _Seen, places: Places) -> bytes:
    """The shard's part of the index, as the bytes of an npz file."""
    tables = {f"crc/{name}": np.concatenate(values) for name, values in seen.crc.items()}
    tables |= {f"chunks/{name}": values for name, values in places.chunks.items()}
    packed = io.BytesIO()
    np.savez(packed, **tables)  # pyright: ignore[reportArgumentType]
    return packed.getvalue()


def _origin(dataset: Dataset) -> dict[str, Any]:
    return {
        "identity": sha256(as_json(dataset.identity)),
        "config_sha256": sha256(as_json(dataset.config)),
        "seed": dataset.seed,
        "fingerprint": dict(dataset.producer["fingerprint"]),
    }


def _contents(seen: _Seen, places: Places) -> dict[str, Any]:
    moments = {name: merged(np.concatenate(parts)).tolist() for name, parts in seen.moments.items()}
    return {"data_bytes": seen.bytes, "rows": dict(places.rows), "moments": moments}


def _full(dataset: Dataset, shard: Shard, seen: _Seen) -> FolderError:
    raw = sum(stored_bytes(field, dataset.sizes) for field in dataset.fields.values())
    need = shard.count * (seen.bytes / seen.videos if seen.videos else raw)
    disk = work_folder(dataset.root)
    free = free_bytes(disk)
    error = FolderError(
        f"no space left for {disk}: {shard.name} needs about {need / 1e6:.1f} MB and {free / 1e6:.1f} MB are "
        f"free, so at least {max(need - free, 0) / 1e6:.1f} MB are missing: make room and run the same command again"
    )
    error.exit_code = 1
    return error


def _records(dataset: Dataset) -> dict[str, dict[str, Any]]:
    """The records in the folder that are of this dataset, by shard."""
    identity = sha256(as_json(dataset.identity))
    names = [path.name.removesuffix(".json") for path in sorted((dataset.root / MARK / "done").glob("*.json"))]
    found = zip(names, _at_once(lambda name: read_record(dataset.root, name), names), strict=True)
    # A record under another's name would be taken for that one.
    return {name: r for name, r in found if r is not None and (r["name"], r["identity"]) == (name, identity)}


T = TypeVar("T")
R = TypeVar("R")


def _at_once(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """The function's value for each item; servers take long to answer, but answer many questions at once."""
    with ThreadPoolExecutor(16) as pool:
        return list(pool.map(function, items))


def _whole_plan(dataset: Dataset, records: Mapping[str, Mapping[str, Any]]) -> list[Shard]:
    """The plan for what was asked and for all that is there."""
    counts = dict(dataset.splits)
    for record in records.values():
        counts[record["split"]] = max(counts.get(record["split"], 0), record["first"] + record["count"])
    return plan(counts, dataset.videos_per_shard)


def _is_done(dataset: Dataset, shard: Shard, records: Mapping[str, Mapping[str, Any]]) -> bool:
    record = records.get(shard.name, {})
    file, tables = shard_path(dataset.root, shard.name), table_path(dataset.root, shard.name)
    return (
        all(record.get(key) == getattr(shard, key) for key in ("split", "first", "count"))
        and size_of(file) == record["bytes"]
        and size_of(tables) is not None
        and file_sha256(tables) == record["tables_sha256"]
    )


# ---- The whole


def finish(dataset: Dataset) -> bool:
    """Whether the dataset is complete; if it is, its index, cards and manifest are written.

    False while shards are missing that other workers still make.
    """
    with _explained(dataset.root):
        records = _records(dataset)
        shards = _whole_plan(dataset, records)
        if not all(_at_once(lambda shard: _is_done(dataset, shard, records), shards)):
            return False
        _complete(dataset, shards, [records[shard.name] for shard in shards])
    return True


def _complete(dataset: Dataset, shards: list[Shard], records: list[Mapping[str, Any]]) -> None:
    root, recipe = dataset.root, dataset.config_text.encode()
    copies = {"config.yaml": recipe, **dataset.copies}
    for name, content in copies.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        publish(root / name, content)
    hashes = {name: sha256(content) for name, content in copies.items()}
    files = write_index(dataset, shards, records) | hashes
    manifest = describe(dataset, shards, records, files)
    if "frames" in dataset.fields:
        publish(root / SHEET, cards.picture(root, manifest))
        manifest = describe(dataset, shards, records, files | {SHEET: file_sha256(root / SHEET)})
    publish(root / "README.md", cards.readme(manifest, dataset.command).encode())
    publish(root / "croissant.json", as_json(cards.croissant(manifest)))
    publish(root / "manifest.json", as_json(manifest))  # last: it says that all is there
