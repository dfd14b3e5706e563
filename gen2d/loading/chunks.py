"""Chunks of shard files, read by offset. h5py is not used, because it has one lock per process.

Each row of a table or an index is verified when it is read, and each offset is checked against the size of its file.
Files are never memory-mapped, so damage can only raise an error. File descriptors are not shared across a fork, and are
not reused for another file of the same name. Files that growth moved into a snapshot folder are looked up there too.
For a remote dataset, the chunks of one batch are requested in parallel, or whole shards are kept in a cache.
"""

import contextlib
import errno
import functools
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gen2d.core.errors import DamagedError, FolderError, UnreachableError, UserError
from gen2d.dataset.block import row_names
from gen2d.dataset.manifest import Manifest
from gen2d.dataset.rows import check_shard, intact, npy_header, origin
from gen2d.dataset.spec import Shard, shard_name, shard_of, snapshot_path
from gen2d.loading.column import Column
from gen2d.storage.cache import Cache
from gen2d.storage.explain import reading_error
from gen2d.storage.paths import Place, Url
from gen2d.storage.ranges import Range, read_ranges
from gen2d.storage.sealed import open_regular

BLOCK = 256  # rows of a table that are read together
INDEX_BLOCK = 1024  # rows of a remote index that are read together
CACHED_SHARDS = 65536  # shard rows that each split keeps in memory
CACHED_BLOCKS = 256  # blocks of tables and indices that each split keeps in memory
OPEN_FILES = 128  # files that a process keeps open


class Chunk(NamedTuple):
    """Location of a chunk in a shard file, and the checksum of its bytes."""

    shard: int  # the shard's position in the split
    offset: int  # bytes from the start of the file
    size: int  # bytes
    crc32: int


class ShardRow(NamedTuple):
    """A shard and its row in the table of the split."""

    shard: Shard
    bytes: int  # of the file
    sha256: str
    rows: int  # offset of the shard's index
    offsets: np.ndarray  # of each uncompressed field, in the order of the names


Reader = Callable[[Column, Chunk, np.ndarray], bytes | memoryview]


class SplitFiles:
    """Table and shards of one split of a snapshot, read chunk by chunk."""

    def __init__(self, root: Place, manifest: Manifest, split: str, cache: Cache | None, checks: bool) -> None:
        self.root, self.manifest, self.split, self.cache, self.checks = root, manifest, split, cache, checks
        self._origin = origin(manifest.identity_sha256, split)
        self._shard_type, self._video_type = manifest.shard_type, manifest.video_type
        self._row_bytes, self._raw_bytes = manifest.row_bytes, manifest.raw_bytes
        self._header = len(npy_header(self._shard_type, manifest.tables[split].shards))
        self._blocks: OrderedDict[tuple[int, int], np.ndarray] = OrderedDict()
        self._shards: dict[int, ShardRow] = {}

    def __getstate__(self) -> dict[str, object]:
        raise TypeError("the files of a dataset are opened anew in another process")

    # ---- The table

    def shard(self, position: int) -> ShardRow:
        """Row of the shard at this position of the split. Raises DamagedError if the row is damaged."""
        row = self._shards.get(position)
        if row is None:
            if len(self._shards) >= CACHED_SHARDS:
                self._shards = {}
            row = self._shards[position] = self._read_shard_row(position)
        return row

    def _read_shard_row(self, position: int) -> ShardRow:
        per_shard, count = self.manifest.videos_per_shard, self.manifest.splits[self.split]
        first = position * per_shard
        expected = shard_of(self.split, first, min(per_shard, count - first), per_shard)
        row = self._table_block(position // BLOCK)[position % BLOCK]
        path = f"{self.root / self.manifest.tables[self.split].file}"
        if self.checks and not intact(row.reshape(1), self._origin, [first]).all():
            raise DamagedError(f"{path} is not what was written, in row {position}")
        try:
            check_shard(row, first, expected.count, self._video_type.itemsize, self._row_bytes, self._raw_bytes)
        except DamagedError as error:
            raise DamagedError(f"{path} cannot be right in row {position}: {error}") from None
        return ShardRow(expected, int(row["bytes"]), row["sha256"].tobytes().hex(), int(row["index"]), row["offsets"])

    def _table_block(self, number: int) -> np.ndarray:
        def read() -> np.ndarray:
            first, stop = number * BLOCK, min((number + 1) * BLOCK, self.manifest.tables[self.split].shards)
            begin, end = (self._header + row * self._shard_type.itemsize for row in (first, stop))
            return np.frombuffer(self._read_table(begin, end), self._shard_type)

        return self._cached_block((-1, number), read)

    def _cached_block(self, key: tuple[int, int], read: Callable[[], np.ndarray]) -> np.ndarray:
        """Block of rows from memory, or from `read`; the least recently used blocks are dropped."""
        with _lock:
            if key in self._blocks:
                self._blocks.move_to_end(key)
                return self._blocks[key]
        rows = read()
        with _lock:
            self._blocks[key] = rows
            while len(self._blocks) > CACHED_BLOCKS:
                self._blocks.popitem(last=False)
        return rows

    # ---- The index of each shard

    def videos(self, numbers: np.ndarray) -> np.ndarray:
        """Index rows of the videos with these indices. Raises DamagedError if a row is damaged."""
        shards, rows = np.divmod(numbers, self.manifest.videos_per_shard)
        entries = np.empty(len(numbers), self._video_type)
        if isinstance(self.root, Url) and self.cache is None:
            keys = list(zip(shards.tolist(), (rows // INDEX_BLOCK).tolist(), strict=True))
            blocks = self._fetch_blocks(set(keys))
            for step, key in enumerate(keys):
                entries[step] = blocks[key][rows[step] % INDEX_BLOCK]
        else:
            for shard in np.unique(shards):
                members = np.flatnonzero(shards == shard)
                entries[members] = self._index_rows(int(shard), rows[members])
        if self.checks:
            is_intact = intact(entries, self._origin, numbers.tolist())
            if not is_intact.all():
                wrong = int(np.argmin(is_intact))
                raise self._index_error(int(shards[wrong]), int(numbers[wrong]))
        return entries

    def _index_error(self, position: int, number: int) -> DamagedError:
        path = self.path(shard_name(self.shard(position).shard.name))
        return DamagedError(f"{path}: the index of {self.split} video {number} is not what was written")

    def _index_rows(self, position: int, rows: np.ndarray) -> np.ndarray:
        shard_row, size = self.shard(position), self._video_type.itemsize
        file = self._open_shard(shard_row)
        parts = [file.read(shard_row.rows + row * size, size) for row in rows.tolist()]
        return np.frombuffer(b"".join(parts), self._video_type)

    def _fetch_blocks(self, keys: set[tuple[int, int]]) -> dict[tuple[int, int], np.ndarray]:
        """Index blocks of remote shards, by shard and block number; the missing ones are requested in parallel."""
        with _lock:
            blocks = {key: self._blocks[key] for key in keys & self._blocks.keys()}
        missing, size, ranges = sorted(keys - blocks.keys()), self._video_type.itemsize, []
        for shard, block in missing:
            row = self.shard(shard)
            first, last = block * INDEX_BLOCK, min((block + 1) * INDEX_BLOCK, row.shard.count)
            ranges.append((shard_name(row.shard.name), row.rows + first * size, row.rows + last * size))
        for key, (name, *_), content in zip(missing, ranges, self._fetch(ranges), strict=True):
            if isinstance(content, Exception):
                raise _reading_error(self.path(name), content)
            blocks[key] = self._cached_block(key, functools.partial(np.frombuffer, content, self._video_type))
        return blocks

    # ---- Chunks

    def chunks_of(
        self, column: Column, numbers: np.ndarray, videos: np.ndarray, begins: Sequence[int]
    ) -> list[list[Chunk]]:
        """Chunks of `column` that each video needs. `videos` are index rows, `begins` the first frames of windows."""
        shards, rows = np.divmod(numbers, self.manifest.videos_per_shard)
        if column.is_image:
            entries = zip(shards.tolist(), videos[column.name].tolist(), begins, strict=True)
            return [
                [self._checked_chunk(column, shard, video_chunks[i]) for i in column.chunk_range(begin)]
                for shard, video_chunks, begin in entries
            ]
        names = self._names
        offsets = {shard: int(self.shard(shard).offsets[names[column.name]]) for shard in np.unique(shards).tolist()}
        entries = zip(shards.tolist(), rows.tolist(), videos[column.name].tolist(), strict=True)
        return [[Chunk(shard, offsets[shard] + row * column.size, column.size, crc)] for shard, row, crc in entries]

    @functools.cached_property
    def _names(self) -> dict[str, int]:
        """Position of each uncompressed field in the sorted list of them."""
        return {name: position for position, name in enumerate(row_names(self.manifest.fields))}

    def _checked_chunk(self, column: Column, shard: int, entry: tuple[int, int, int]) -> Chunk:
        offset, size, crc = entry
        if size > 2 * (column.size // column.chunk_count) + 1024 or offset + size > self.shard(shard).bytes:
            raise DamagedError(f"{column.name} lies outside the file, by its index")
        return Chunk(shard, offset, size, crc)

    def reader(self, chunks_by_column: Iterable[Iterable[Iterable[Chunk]]]) -> Reader:
        """Function that returns the bytes of these chunks, from the disk, the cache or one parallel download."""
        if isinstance(self.root, Path) or self.cache:
            file_of = functools.lru_cache(maxsize=16)(lambda shard: self._open_shard(self.shard(shard)))
            return lambda column, chunk, target: _read_chunk(file_of(chunk.shard), column, chunk, target)
        chunks = list({chunk for column_chunks in chunks_by_column for video in column_chunks for chunk in video})
        names = {shard: shard_name(self.shard(shard).shard.name) for shard in {chunk.shard for chunk in chunks}}
        data = self._fetch([(names[c.shard], c.offset, c.offset + c.size) for c in chunks])
        return functools.partial(_downloaded_chunk, dict(zip(chunks, data, strict=True)))

    # ---- Files

    def path(self, name: str) -> Place:
        """Path of a file of the latest snapshot; growth may have moved the file since."""
        return self.root / name

    def _candidate_paths(self, name: str) -> tuple[Place, Place]:
        """Both possible paths of a file: growth moves files that only an earlier manifest names."""
        return self.root / name, snapshot_path(self.root, self.manifest.sha256) / name

    def _read_table(self, begin: int, end: int) -> bytes:
        """Bytes `begin` to `end - 1` of the table's file."""
        table = self.manifest.tables[self.split]
        name = table.file
        if isinstance(self.root, Path):
            file = self._open_local(name)
        elif self.cache:
            file = self._open_cached(name, table.sha256, self._header + table.shards * self._shard_type.itemsize)
        else:
            (content,) = self._fetch([(name, begin, end)])
            if isinstance(content, Exception):
                raise _reading_error(self.path(name), content)
            return content
        return file.read(begin, end - begin)

    def _fetch(self, requests: Sequence[tuple[str, int, int]]) -> list[bytes | Exception]:
        """Bytes of each range (name, begin, end) of the remote files, or the error of reading it."""
        contents: list[bytes | Exception] = []
        for attempt in (0, 1):
            missing = [i for i in range(len(requests)) if not attempt or isinstance(contents[i], FileNotFoundError)]
            pending = [requests[i] for i in missing]
            urls = [self._candidate_paths(name)[attempt] for name, _, _ in pending]
            ranges = [Range(url, *r[1:]) for url, r in zip(urls, pending, strict=True) if isinstance(url, Url)]
            read = read_ranges(ranges) if ranges else []
            if not attempt:
                contents = list(read)
            for i, content in zip(missing, read, strict=True):
                contents[i] = content if not isinstance(content, FileNotFoundError) or not attempt else contents[i]
        return contents

    def _open_local(self, name: str) -> "_File":
        for path in self._candidate_paths(name):
            assert isinstance(path, Path)
            with contextlib.suppress(FileNotFoundError):
                return open_file(path)
        raise DamagedError(f"{self.path(name)} is missing")

    def _open_shard(self, shard_row: ShardRow) -> "_File":
        name = shard_name(shard_row.shard.name)
        if self.cache is None:
            return self._open_local(name)
        return self._open_cached(name, shard_row.sha256, shard_row.bytes)

    def _open_cached(self, name: str, sha256: str, size: int) -> "_File":
        """Remote file, opened in the cache."""
        assert self.cache
        for url in self._candidate_paths(name):
            assert isinstance(url, Url)
            try:
                while True:
                    path = self.cache.path(url, sha256, size)
                    with contextlib.suppress(FileNotFoundError):  # another process has just evicted it
                        return _File(path)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise _reading_error(url, error) from error
        raise _reading_error(self.path(name), FileNotFoundError(errno.ENOENT, "it is not there"))


class _File:
    """File that is open for reading and closes with its last reference."""

    def __init__(self, path: Path) -> None:
        self.process, self.path = os.getpid(), path
        try:
            self.descriptor = open_regular(path)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise reading_error(path, error) from error
        self.identity = _file_identity(os.fstat(self.descriptor))

    def read(self, offset: int, size: int) -> bytes:
        """`size` bytes from `offset` on. Raises DamagedError if the file ends too early."""
        try:
            data = os.pread(self.descriptor, size, offset) if size else b""
        except OSError as error:
            raise reading_error(self.path, error) from error
        if len(data) != size:
            data += self._rest(offset + len(data), size - len(data)) if data else b""
        if len(data) != size:
            raise DamagedError(f"{self.path} ends too early")
        return data

    def _rest(self, offset: int, size: int) -> bytes:
        """Remaining bytes after a short read: one call reads at most 2 GiB, and a signal may interrupt it."""
        parts = []
        while size and (part := os.pread(self.descriptor, size, offset)):
            parts.append(part)
            offset, size = offset + len(part), size - len(part)
        return b"".join(parts)

    def read_into(self, target: memoryview, offset: int) -> None:
        """Fill `target` with the bytes from `offset` on. Raises DamagedError if the file ends too early."""
        try:
            count = os.preadv(self.descriptor, [target], offset) if target.nbytes else 0
        except OSError as error:
            raise reading_error(self.path, error) from error
        if count != target.nbytes:
            target.cast("B")[count:] = self.read(offset + count, target.nbytes - count)

    def __del__(self) -> None:
        # A forked process has copies of the descriptors, and may have reused the number for another file since.
        if hasattr(self, "descriptor") and self.process == os.getpid():
            os.close(self.descriptor)


def _file_identity(status: os.stat_result) -> tuple[int, ...]:
    """Identity of a file, which differs from that of a later file with the same name."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


# Open files of this process, least recently used first.
_files: OrderedDict[Path, _File] = OrderedDict()
_lock = threading.Lock()  # guards `_files` and the blocks of every dataset; only held briefly


def open_file(path: Path) -> _File:
    """Open file at this path, kept open for later calls.

    Raises FileNotFoundError if there is no such file, and otherwise the errors of `reading_error`.
    """
    try:
        identity = _file_identity(path.stat())
    except FileNotFoundError:
        raise
    except OSError as error:
        raise reading_error(path, error) from error
    with _lock:
        cached = _files.get(path)
        if cached is not None and cached.identity == identity and cached.process == os.getpid():
            _files.move_to_end(path)
            return cached
    try:
        file = _File(path)
    except UserError:
        with _lock:
            _files.clear()  # there may be too many open files
        file = _File(path)
    with _lock:
        _files[path] = file
        while len(_files) > OPEN_FILES:
            _files.popitem(last=False)
    return file


def _after_fork() -> None:
    global _lock
    _lock = threading.Lock()  # another thread may have held the old one during the fork


os.register_at_fork(after_in_child=_after_fork)


def _read_chunk(file: _File, column: Column, chunk: Chunk, target: np.ndarray) -> bytes | memoryview:
    """Bytes of a chunk; an uncompressed chunk is read directly into `target`."""
    if column.codec != "none":
        return file.read(chunk.offset, chunk.size)
    data = target.data
    if data.nbytes != chunk.size:
        raise DamagedError(f"it has {chunk.size} bytes, but must have {data.nbytes}")
    file.read_into(data, chunk.offset)
    return data


def _downloaded_chunk(
    downloads: Mapping[Chunk, bytes | Exception], column: Column, chunk: Chunk, target: np.ndarray
) -> bytes | memoryview:
    """Bytes of a chunk that has been downloaded; raises the error of its download."""
    data = downloads[chunk]
    if isinstance(data, Exception):
        raise data
    return data


def _reading_error(path: Place, error: Exception) -> Exception:
    if isinstance(error, UnreachableError):
        return error
    if isinstance(error, OSError) and error.errno == errno.ENOENT:
        return FolderError(
            f"{path} is not there, though the manifest names it: was the dataset moved, or not copied whole?"
        )
    return reading_error(path, error) if isinstance(error, OSError) else error
