"""The rows of the shards that are done: those in the last manifest's tables and those in the logs of running workers.

A worker appends a row to a log of its own (`.gen2d/records/SPLIT.TOKEN.NUMBER`) when a shard is on the disk. Once all
shards are there, the rows move into the table of their split, which the manifest names, and the logs are removed. Every
row has its own checksum, so all whole rows of a log that a crash cut still count.
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
from gen2d.dataset.rows import intact, intact_rows, npy_size, origin, shard_type
from gen2d.dataset.spec import RECORDS, TABLE_NAME, DatasetSpec, Shard, shard_count, shard_of
from gen2d.storage.atomic import list_folder, publish, sync
from gen2d.storage.leases import has_locks, is_at, lease, try_lock
from gen2d.storage.paths import Place, Url
from gen2d.storage.sealed import open_regular, read_bytes

ROWS = 1024  # of a log at a URL; then another is begun
LOG_BYTES = 2**32  # maximum size of a log
_NAME = re.compile(r"(?P<split>.+)\.[0-9a-f]{16}\.\d+")


class Records:
    """The rows of the shards that are done, by split."""

    def __init__(
        self,
        videos_per_shard: int,
        rows: Mapping[str, np.ndarray],
        videos: Mapping[str, int] | None = None,
        manifest: Manifest | None = None,
    ) -> None:
        """`rows` are intact rows by split; rows that belong to no possible shard are skipped.

        `videos` is the known number of videos of each split, whether or not their rows are intact. `manifest` is the
        folder's manifest when the rows were read.
        """
        self.size, self.rows, self.videos, self.manifest = videos_per_shard, {}, dict(videos or {}), manifest
        # Index of the row of each (first video, count), by split.
        self.indices: dict[str, dict[tuple[int, int], int]] = {}
        for split, own in rows.items():
            possible = (own["first"] % self.size == 0) & (own["count"] >= 1) & (own["count"] <= self.size)
            self.rows[split] = own[possible]
            self.indices[split] = {key: index for index, key in enumerate(_keys(self.rows[split]))}

    def row_of(self, shard: Shard) -> np.void | None:
        """The row of a shard; None if it is not done."""
        index = self.indices.get(shard.split, {}).get((shard.first, shard.count))
        return None if index is None else self.rows[shard.split][index]

    def table(self, split: str, shards: Iterable[Shard]) -> np.ndarray:
        """The rows of these shards of a split, all of which must be done."""
        own = self.indices[split]
        return self.rows[split][[own[shard.first, shard.count] for shard in shards]]

    def counts(self) -> dict[str, int]:
        """The number of videos of each split, up to the last one that is recorded."""
        counts = {split: int((rows["first"] + rows["count"]).max()) for split, rows in self.rows.items() if len(rows)}
        return {split: max(counts.get(split, 0), self.videos.get(split, 0)) for split in counts | self.videos}

    def shards(self) -> Iterator[Shard]:
        """Every shard that is done, including those that larger ones have replaced."""
        for split, own in self.indices.items():
            yield from (shard_of(split, first, count, self.size) for first, count in own)


def read_records(source: DatasetSpec | Manifest, root: Place) -> Records:
    """The records of the dataset in the folder.

    The logs are read before the tables, so that no row is missed that another worker is moving into a table.
    """
    dtype, identity, per_shard = shard_type(source.fields), source.identity_sha256, source.videos_per_shard
    parts: dict[str, list[np.ndarray]] = {}
    for split, content in _logs(root):
        parts.setdefault(split, []).append(_intact_log_rows(content, dtype, origin(identity, split)))
    try:
        manifest = read_manifest(root)
    except (IncompleteError, DamagedError):
        manifest = None
        videos, tables = tables_by_name(root, dtype, identity, per_shard)
    else:
        same = manifest.identity_sha256 == identity
        videos, tables = (manifest.splits, read_tables(root, manifest)) if same else ({}, {})
    for split, rows in tables.items():
        parts.setdefault(split, []).append(rows)
    return Records(per_shard, {split: np.concatenate(own) for split, own in parts.items()}, videos, manifest)


def _keys(rows: np.ndarray) -> list[tuple[int, int]]:
    """The first video and the number of videos of each row's shard."""
    return list(zip(rows["first"].tolist(), rows["count"].tolist(), strict=True))


def _intact_log_rows(content: bytes, dtype: np.dtype, begin: int) -> np.ndarray:
    """The rows of a log that have the right checksum."""
    rows = np.frombuffer(content, dtype, count=len(content) // dtype.itemsize)
    return rows[intact(rows, begin, rows["first"].tolist())]


def read_tables(root: Place, manifest: Manifest) -> dict[str, np.ndarray]:
    """The rows with the right checksum in each split's table."""
    dtype, tables = manifest.shard_type, {}
    for split, table in manifest.tables.items():
        begin = origin(manifest.identity_sha256, split)
        try:
            content = read_bytes(root / table.file, npy_size(dtype, table.shards))
        except OSError:
            content = b""
        tables[split] = intact_rows(content, dtype, table.shards, begin, manifest.videos_per_shard)
    return tables


def tables_by_name(
    root: Place, dtype: np.dtype, identity: str, videos_per_shard: int
) -> tuple[dict[str, int], dict[str, np.ndarray]]:
    """The contents of the tables in a folder without a manifest: the number of videos of each split, from the name of
    its largest table, and that table's rows with the right checksum."""
    videos: dict[str, int] = {}
    tables: dict[str, np.ndarray] = {}
    for path in list_folder(root / "index"):
        match = TABLE_NAME.fullmatch(path.name)
        if not match or int(match["count"]) <= videos.get(match["split"], 0):
            continue
        split, count = match["split"], int(match["count"])
        shards = shard_count(count, videos_per_shard)
        size = npy_size(dtype, shards)
        try:
            content = read_bytes(path, size)
        except OSError:
            continue
        rows = intact_rows(content, dtype, shards, origin(identity, split), videos_per_shard)
        if len(content) == size and len(rows):  # otherwise the number in its name may be wrong
            videos[split], tables[split] = count, rows
    return videos, tables


def _logs(root: Place) -> list[tuple[str, bytes]]:
    """The split and content of every log."""
    matches = [(path, _NAME.fullmatch(path.name)) for path in list_folder(root / RECORDS)]
    paths = [(path, match["split"]) for path, match in matches if match]

    def content(path: Place) -> bytes:
        try:
            return read_bytes(path, LOG_BYTES)
        except FileNotFoundError:
            return b""  # its rows have just moved into a table

    with ThreadPoolExecutor(16) as pool:  # a server answers many requests at once
        return list(zip((split for _, split in paths), pool.map(content, (path for path, _ in paths)), strict=True))


def remove_logs(spec: DatasetSpec, known: Records) -> None:
    """Remove the logs whose rows are all known; logs that a worker still writes stay."""
    dtype, identity = shard_type(spec.fields), spec.identity_sha256
    for path in list_folder(spec.root / RECORDS):
        match = _NAME.fullmatch(path.name)
        with contextlib.suppress(FileNotFoundError), _unused(path) as unused:
            if match and unused:
                rows = _intact_log_rows(read_bytes(path, LOG_BYTES), dtype, origin(identity, match["split"]))
                if known.indices.get(match["split"], {}).keys() >= set(_keys(rows)):
                    path.unlink(missing_ok=True)


@contextlib.contextmanager
def _unused(path: Place) -> Iterator[bool]:
    """Whether no process writes this log; always true at a URL, where the writer writes the whole log each time."""
    if isinstance(path, Url):
        yield True
        return
    descriptor = open_regular(path)
    try:
        yield has_locks(path.parent) and try_lock(descriptor) is True
    finally:
        os.close(descriptor)


class RecordLog:
    """The logs that one worker writes, one per split; several threads may add rows."""

    def __init__(self, root: Place) -> None:
        self.root, self.token = root, secrets.token_hex(8)
        self._files: dict[str, _LocalLog | _RemoteLog] = {}
        self._lock = threading.Lock()

    def add(self, split: str, row: np.ndarray) -> None:
        """Write the row [1] through to the disk or server; an OSError leaves nothing of it behind."""
        with self._lock:
            if split not in self._files:
                path = self.root / RECORDS / f"{split}.{self.token}"
                self._files[split] = _RemoteLog(path) if isinstance(path, Url) else _LocalLog(path)
            self._files[split].add(row.tobytes())

    def close(self) -> None:
        """Close the logs; their rows stay. Raises UnreachableError."""
        files, self._files = self._files, {}
        for log in files.values():
            log.close()


class _LocalLog:
    """A log on disk, to which rows are appended; it is locked while it is open."""

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
        self._descriptor = self._open.enter_context(lease(self._name()))
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
                os.ftruncate(self._descriptor, end)  # otherwise the next row would follow half a row
            raise

    def close(self) -> None:
        if self._open is not None:
            self._open.close()
            self._open = None


class _RemoteLog:
    """A log at a URL, in objects of `ROWS` rows; nothing can be appended to an object, so the last is written anew."""

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
        """Write the last rows again if another worker, which knew fewer rows, has removed them."""
        if self.rows and not self._object().exists():
            publish(self._object(), self.rows)
