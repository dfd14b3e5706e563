"""Which shards are done: rows of many shards in one file, those of a run that goes on and those of the last manifest.

A worker adds a row to a log of its own (`.gen2d/records/SPLIT.TOKEN.NUMBER`) when a shard is on the disk. When all
shards are there, the rows go into the table of their split, which the manifest names, and the logs go. A row is
checked by itself, so a log that a crash cut is worth all the rows that it has.
"""

import contextlib
import os
import re
import secrets
import threading
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from gen2d.core.errors import DamagedError, IncompleteError
from gen2d.dataset.manifest import Manifest, read_manifest
from gen2d.dataset.rows import intact, npy_header, origin, salvaged, shard_type
from gen2d.dataset.spec import RECORDS, TABLE_NAME, DatasetSpec, Shard, shard_of
from gen2d.storage.atomic import publish, sync
from gen2d.storage.leases import has_locks, is_at, leased, try_lock
from gen2d.storage.paths import Place, Url
from gen2d.storage.sealed import open_regular, read_bytes

ROWS = 1024  # of a log at a URL; then another is begun
LOG_BYTES = 2**32  # of a file of rows, at most
_NAME = re.compile(r"(?P<split>.+)\.[0-9a-f]{16}\.\d+")


class Records:
    """The rows of the shards that are done, by split."""

    def __init__(
        self, videos_per_shard: int, rows: Mapping[str, np.ndarray], videos: Mapping[str, int] | None = None
    ) -> None:
        """`rows` are what was written; one that no plan has is passed over. `videos` are how many each split is known
        to have, whether or not their rows are whole."""
        self.size, self.rows, self.videos = videos_per_shard, {}, dict(videos or {})
        self.manifest: Manifest | None = None  # of the folder, when the rows were read
        self.places: dict[str, dict[tuple[int, int], int]] = {}  # of (first video, count) among the rows
        for split, own in rows.items():
            fits = (own["first"] % self.size == 0) & (own["count"] >= 1) & (own["count"] <= self.size)
            self.rows[split] = own[fits]
            self.places[split] = {key: place for place, key in enumerate(keys(self.rows[split]))}

    def of(self, shard: Shard) -> np.void | None:
        """The row of a shard; None if it is not done."""
        place = self.places.get(shard.split, {}).get((shard.first, shard.count))
        return None if place is None else self.rows[shard.split][place]

    def table(self, split: str, shards: Iterable[Shard]) -> np.ndarray:
        """The rows of these shards of a split, all of which are done."""
        own = self.places[split]
        return self.rows[split][[own[shard.first, shard.count] for shard in shards]]

    def counts(self) -> dict[str, int]:
        """How many videos of each split there are, if those before the last are."""
        counts = {split: int((rows["first"] + rows["count"]).max()) for split, rows in self.rows.items() if len(rows)}
        return {split: max(counts.get(split, 0), self.videos.get(split, 0)) for split in counts | self.videos}

    def shards(self) -> Iterator[Shard]:
        """Every shard that is done, also those that larger ones have replaced."""
        for split, own in self.places.items():
            yield from (shard_of(split, first, count, self.size) for first, count in own)


def read_records(source: DatasetSpec | Manifest, root: Place) -> Records:
    """What is done of the dataset in the folder: first the logs, then the tables, so that none is missed that another
    worker is just moving from there to here."""
    kind, identity, per_shard = shard_type(source.fields), source.identity_sha256, source.videos_per_shard
    found: dict[str, list[np.ndarray]] = {}
    for split, content in _logs(root):
        found.setdefault(split, []).append(_intact_rows(content, kind, origin(identity, split)))
    manifest = None
    try:
        manifest = read_manifest(root)
    except (IncompleteError, DamagedError):
        videos, tables = tables_by_name(root, kind, identity, per_shard)
    else:
        same = manifest.identity_sha256 == identity
        videos, tables = (manifest.splits, read_tables(root, manifest)) if same else ({}, {})
    for split, rows in tables.items():
        found.setdefault(split, []).append(rows)
    records = Records(per_shard, {split: np.concatenate(parts) for split, parts in found.items()}, videos)
    records.manifest = manifest
    return records


def keys(rows: np.ndarray) -> list[tuple[int, int]]:
    """The first video and the number of videos of each row's shard."""
    return list(zip(rows["first"].tolist(), rows["count"].tolist(), strict=True))


def _intact_rows(content: bytes, kind: np.dtype, begin: int) -> np.ndarray:
    """The rows of a log that are what was written."""
    rows = np.frombuffer(content, kind, count=len(content) // kind.itemsize)
    return rows[intact(rows, begin, rows["first"].tolist())]


def read_tables(root: Place, manifest: Manifest) -> dict[str, np.ndarray]:
    """The rows of each split's table that are what was written."""
    kind, found = manifest.shard_type, {}
    for split, table in manifest.tables.items():
        begin = origin(manifest.identity_sha256, split)
        limit = len(npy_header(kind, table.shards)) + table.shards * kind.itemsize
        try:
            content = read_bytes(root / table.file, limit)
        except OSError:
            content = b""
        found[split] = salvaged(content, kind, table.shards, begin, manifest.videos_per_shard)
    return found


def tables_by_name(
    root: Place, kind: np.dtype, identity: str, videos_per_shard: int
) -> tuple[dict[str, int], dict[str, np.ndarray]]:
    """What the tables in the folder say where no manifest does: how many videos each split has, by the name of its
    largest table, and the rows that are what was written."""
    videos: dict[str, int] = {}
    tables: dict[str, np.ndarray] = {}
    for path in _listed(root / "index"):
        match = TABLE_NAME.fullmatch(path.name)
        if not match or int(match["count"]) <= videos.get(match["split"], 0):
            continue
        split, count = match["split"], int(match["count"])
        shards = -(-count // videos_per_shard)
        size = len(npy_header(kind, shards)) + shards * kind.itemsize
        try:
            content = read_bytes(path, size)
        except OSError:
            continue
        rows = salvaged(content, kind, shards, origin(identity, split), videos_per_shard)
        if len(content) == size and len(rows):  # else its name may be anything
            videos[split], tables[split] = count, rows
    return videos, tables


def _logs(root: Place) -> list[tuple[str, bytes]]:
    """The split and content of every log."""
    named = [(path, _NAME.fullmatch(path.name)) for path in _listed(root / RECORDS)]
    paths = [(path, match["split"]) for path, match in named if match]

    def content(path: Place) -> bytes:
        try:
            return read_bytes(path, LOG_BYTES)
        except FileNotFoundError:
            return b""  # just moved into a table

    with ThreadPoolExecutor(16) as pool:  # a server answers many questions at once
        return list(zip((split for _, split in paths), pool.map(content, (path for path, _ in paths)), strict=True))


def _listed(folder: Place) -> list[Place]:
    try:
        return sorted(folder.iterdir(), key=str)
    except (FileNotFoundError, NotADirectoryError):
        return []


def remove_logs(spec: DatasetSpec, known: Records) -> None:
    """Removes the logs of which every row is known; those of workers that still write stay."""
    kind, identity = shard_type(spec.fields), spec.identity_sha256
    for path in _listed(spec.root / RECORDS):
        match = _NAME.fullmatch(path.name)
        with contextlib.suppress(FileNotFoundError), _unused(path) as unused:
            if match and unused:
                rows = _intact_rows(read_bytes(path, LOG_BYTES), kind, origin(identity, match["split"]))
                if known.places.get(match["split"], {}).keys() >= set(keys(rows)):
                    path.unlink(missing_ok=True)


@contextlib.contextmanager
def _unused(path: Place) -> Iterator[bool]:
    """Whether nobody writes this log; of one at a URL the writer writes all of it anew each time."""
    if isinstance(path, Url):
        yield True
        return
    descriptor = open_regular(path)
    try:
        yield has_locks(path.parent) and try_lock(descriptor) is True
    finally:
        os.close(descriptor)


class RecordLog:
    """The logs that one worker writes, a file for each split; several threads may add rows."""

    def __init__(self, root: Place) -> None:
        self.root, self.token = root, secrets.token_hex(8)
        self._files: dict[str, _LocalLog | _RemoteLog] = {}
        self._lock = threading.Lock()

    def add(self, split: str, row: np.ndarray) -> None:
        """Returns when the row [1] is on the disk, or the server. Raises OSError, and nothing of it is there then."""
        with self._lock:
            if split not in self._files:
                path = self.root / RECORDS / f"{split}.{self.token}"
                self._files[split] = _RemoteLog(path) if isinstance(path, Url) else _LocalLog(path)
            self._files[split].add(row.tobytes())

    def close(self) -> None:
        """Ends the logs; their rows stay. Raises UnreachableError."""
        files, self._files = self._files, {}
        for log in files.values():
            log.close()


class _LocalLog:
    """Rows at the end of one file, which is locked as long as it is written."""

    def __init__(self, path: Path) -> None:
        self.path, self.number, self.rows = path, 0, b""
        self._open: contextlib.ExitStack | None = None
        self._descriptor = -1

    def add(self, row: bytes) -> None:
        self.rows += row
        try:
            if self._open is None:
                self._begin()
            self._append(row)
            if not is_at(self._descriptor, self._name()):  # removed by hand
                self.close()
                self._begin()
                self._append(self.rows)
        except OSError:
            self.rows = self.rows.removesuffix(row)
            raise

    def _name(self) -> Path:
        return self.path.with_name(f"{self.path.name}.{self.number}")

    def _begin(self) -> None:
        self.number += 1
        self._open = contextlib.ExitStack()
        self._descriptor = self._open.enter_context(leased(self._name()))
        sync(self.path.parent)

    def _append(self, rows: bytes) -> None:
        end = os.lseek(self._descriptor, 0, os.SEEK_END)
        try:
            written = 0
            while written < len(rows):
                written += os.write(self._descriptor, rows[written:])
            os.fsync(self._descriptor)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, end)  # else the next row would be cut in two by what is there
            raise

    def close(self) -> None:
        if self._open is not None:
            self._open.close()
            self._open = None


class _RemoteLog:
    """Rows in objects, of which the last is written anew for each row: nothing can be added to an object."""

    def __init__(self, path: Url) -> None:
        self.path, self.number, self.rows, self.count = path, 1, b"", 0

    def _object(self) -> Url:
        return self.path.parent / f"{self.path.name}.{self.number}"

    def add(self, row: bytes) -> None:
        publish(self._object(), self.rows + row)
        self.rows, self.count = self.rows + row, self.count + 1
        if self.count == ROWS:
            self.number, self.rows, self.count = self.number + 1, b"", 0

    def close(self) -> None:
        """Returns when the last rows are there: another worker, which knew fewer, may have removed them."""
        if self.rows and not self._object().exists():
            publish(self._object(), self.rows)
