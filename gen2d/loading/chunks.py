"""The files of a dataset, read by offset, without h5py and its one lock per process.

Every row of a table or an index is checked when it is read, and every offset against the file that it is in, so that
nothing is mapped and no damage can do more than raise an error. No open file outlives a fork, nor the file that had its
name. What growth has moved to a snapshot is found there. Of a remote dataset the pieces of all videos wanted at once
are asked for at once, or whole shards are kept in a cache.
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
INDEX_BLOCK = 1024  # rows of a remote index
SHARDS = 65536  # rows of shards, of each dataset
KEPT = 256  # blocks of tables and indices, of each dataset
OPEN = 128  # files, of a process


class Chunk(NamedTuple):
    """Where a piece lies, and the checksum of its bytes."""

    shard: int  # its place in the split
    offset: int
    size: int
    crc32: int


class ShardRow(NamedTuple):
    """A shard as its split's table has it."""

    shard: Shard
    bytes: int
    sha256: str
    rows: int  # where its index begins
    offsets: np.ndarray


Reader = Callable[[Column, Chunk, np.ndarray], bytes | memoryview]


class SplitFiles:
    """The table of one split of a snapshot, and its shards, read piece by piece."""

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

    def shard(self, place: int) -> ShardRow:
        """The shard at this place of the split. Raises DamagedError."""
        row = self._shards.get(place)
        if row is None:
            if len(self._shards) >= SHARDS:
                self._shards = {}
            row = self._shards[place] = self._checked_shard(place)
        return row

    def _checked_shard(self, place: int) -> ShardRow:
        per_shard, count = self.manifest.videos_per_shard, self.manifest.splits[self.split]
        first = place * per_shard
        wanted = shard_of(self.split, first, min(per_shard, count - first), per_shard)
        row = self._table_block(place // BLOCK)[place % BLOCK]
        path = f"{self.root / self.manifest.tables[self.split].file}"
        if self.checks and not intact(row.reshape(1), self._origin, [first]).all():
            raise DamagedError(f"{path} is not what was written, in row {place}")
        try:
            check_shard(row, first, wanted.count, self._video_type.itemsize, self._row_bytes, self._raw_bytes)
        except DamagedError as error:
            raise DamagedError(f"{path} cannot be right in row {place}: {error}") from None
        return ShardRow(wanted, int(row["bytes"]), row["sha256"].tobytes().hex(), int(row["index"]), row["offsets"])

    def _table_block(self, number: int) -> np.ndarray:
        table, size = self.manifest.tables[self.split], self._shard_type.itemsize
        first = number * BLOCK
        count = min(BLOCK, table.shards - first)

        def read() -> np.ndarray:
            begin = self._header + first * size
            return np.frombuffer(self._read_table(begin, begin + count * size), self._shard_type)

        return self._kept((-1, number), read)

    def _kept(self, key: tuple[int, int], read: Callable[[], np.ndarray]) -> np.ndarray:
        """A block of rows; those used longest ago are forgotten."""
        with _lock:
            if key in self._blocks:
                self._blocks.move_to_end(key)
                return self._blocks[key]
        rows = read()
        with _lock:
            self._blocks[key] = rows
            while len(self._blocks) > KEPT:
                self._blocks.popitem(last=False)
        return rows

    # ---- The index of each shard

    def videos(self, numbers: np.ndarray) -> np.ndarray:
        """The rows of the videos with these numbers. Raises DamagedError."""
        places, rows = np.divmod(numbers, self.manifest.videos_per_shard)
        found = np.empty(len(numbers), self._video_type)
        if isinstance(self.root, Url) and self.cache is None:
            wanted = list(zip(places.tolist(), (rows // INDEX_BLOCK).tolist(), strict=True))
            blocks = self._fetched_blocks(set(wanted))
            for step, key in enumerate(wanted):
                found[step] = blocks[key][rows[step] % INDEX_BLOCK]
        else:
            for place in np.unique(places):
                own = np.flatnonzero(places == place)
                found[own] = self._index_rows(int(place), rows[own])
        if self.checks:
            right = intact(found, self._origin, numbers.tolist())
            if not right.all():
                wrong = int(np.argmin(right))
                raise self._bad_index(int(places[wrong]), int(numbers[wrong]))
        return found

    def _bad_index(self, place: int, number: int) -> DamagedError:
        path = self.path(shard_name(self.shard(place).shard.name))
        return DamagedError(f"{path}: the index of {self.split} video {number} is not what was written")

    def _index_rows(self, place: int, rows: np.ndarray) -> np.ndarray:
        about, size = self.shard(place), self._video_type.itemsize
        file = self._open(about)
        parts = [file.read(about.rows + row * size, size) for row in rows.tolist()]
        return np.frombuffer(b"".join(parts), self._video_type)

    def _fetched_blocks(self, wanted: set[tuple[int, int]]) -> dict[tuple[int, int], np.ndarray]:
        """Blocks of the indices of remote shards; those that are not known are asked for all at once."""
        with _lock:
            found = {key: self._blocks[key] for key in wanted & self._blocks.keys()}
        missing, size, ranges = sorted(wanted - found.keys()), self._video_type.itemsize, []
        for place, block in missing:
            about = self.shard(place)
            first, last = block * INDEX_BLOCK, min((block + 1) * INDEX_BLOCK, about.shard.count)
            ranges.append((shard_name(about.shard.name), about.rows + first * size, about.rows + last * size))
        for key, (name, *_), content in zip(missing, ranges, self._fetched(ranges), strict=True):
            if isinstance(content, Exception):
                raise _reading_error(self.path(name), content)
            found[key] = self._kept(key, functools.partial(np.frombuffer, content, self._video_type))
        return found

    # ---- Pieces

    def pieces(
        self, column: Column, numbers: np.ndarray, videos: np.ndarray, begins: Sequence[int]
    ) -> list[list[Chunk]]:
        """Where the pieces lie that are needed of each video; `begins` are the first frames of their windows."""
        places, rows = np.divmod(numbers, self.manifest.videos_per_shard)
        if column.is_image:
            found = zip(places.tolist(), videos[column.name].tolist(), begins, strict=True)
            return [[self._piece(column, place, chunks[i]) for i in column.needed(b)] for place, chunks, b in found]
        names = self._names
        offsets = {place: int(self.shard(place).offsets[names[column.name]]) for place in np.unique(places).tolist()}
        found = zip(places.tolist(), rows.tolist(), videos[column.name].tolist(), strict=True)
        return [[Chunk(place, offsets[place] + row * column.size, column.size, crc)] for place, row, crc in found]

    @functools.cached_property
    def _names(self) -> dict[str, int]:
        """The place of each field among those that are not compressed."""
        names = sorted(n for n, field in self.manifest.fields.items() if field.per_video and not field.is_image)
        return {name: place for place, name in enumerate(names)}

    def _piece(self, column: Column, place: int, chunk: tuple[int, int, int]) -> Chunk:
        offset, size, crc = chunk
        whole = column.size // column.pieces
        if size > 2 * whole + 1024 or offset + size > self.shard(place).bytes:
            raise DamagedError(f"{column.name} lies outside the file, by its index")
        return Chunk(place, offset, size, crc)

    def reader(self, places: Iterable[Iterable[Iterable[Chunk]]]) -> Reader:
        """What gives the bytes of these pieces, by what the shards lie on."""
        if isinstance(self.root, Path) or self.cache:
            opened = functools.lru_cache(maxsize=16)(lambda place: self._open(self.shard(place)))
            return lambda column, piece, target: _piece_of(opened(piece.shard), column, piece, target)
        pieces = list({piece for own in places for video in own for piece in video})
        names = {place: shard_name(self.shard(place).shard.name) for place in {piece.shard for piece in pieces}}
        data = self._fetched([(names[p.shard], p.offset, p.offset + p.size) for p in pieces])
        return functools.partial(_received, dict(zip(pieces, data, strict=True)))

    # ---- Files

    def path(self, name: str) -> Place:
        """Where a file lies, or lay when this snapshot was the last."""
        return self.root / name

    def _places(self, name: str) -> tuple[Place, Place]:
        """Where a file may lie: growth moves what only an earlier manifest names."""
        return self.root / name, snapshot_path(self.root, self.manifest.sha256) / name

    def _read_table(self, begin: int, end: int) -> bytes:
        """A range of the table's file."""
        table = self.manifest.tables[self.split]
        name = table.file
        if isinstance(self.root, Path):
            file = self._opened(name)
        elif self.cache:
            file = self._cached(name, table.sha256, self._header + table.shards * self._shard_type.itemsize)
        else:
            (content,) = self._fetched([(name, begin, end)])
            if isinstance(content, Exception):
                raise _reading_error(self.path(name), content)
            return content
        return file.read(begin, end - begin)

    def _fetched(self, wanted: Sequence[tuple[str, int, int]]) -> list[bytes | Exception]:
        """The bytes of ranges of remote files, or why there are none."""
        found: list[bytes | Exception] = []
        for step in (0, 1):
            missing = [i for i in range(len(wanted)) if not step or isinstance(found[i], FileNotFoundError)]
            urls = [self._places(wanted[i][0])[step] for i in missing]
            ranges = [Range(url, *wanted[i][1:]) for url, i in zip(urls, missing, strict=True) if isinstance(url, Url)]
            read = read_ranges(ranges) if ranges else []
            if not step:
                found = list(read)
            for i, content in zip(missing, read, strict=True):
                found[i] = content if not isinstance(content, FileNotFoundError) or not step else found[i]
        return found

    def _opened(self, name: str) -> "_File":
        for path in self._places(name):
            assert isinstance(path, Path)
            with contextlib.suppress(FileNotFoundError):
                return open_file(path)
        raise DamagedError(f"{self.path(name)} is missing")

    def _open(self, about: ShardRow) -> "_File":
        name = shard_name(about.shard.name)
        return self._opened(name) if self.cache is None else self._cached(name, about.sha256, about.bytes)

    def _cached(self, name: str, sha256: str, size: int) -> "_File":
        """A remote file, as the cache has it."""
        assert self.cache
        for url in self._places(name):
            assert isinstance(url, Url)
            try:
                while True:
                    path = self.cache.path(url, sha256, size)
                    with contextlib.suppress(FileNotFoundError):  # another process made room just now
                        return _File(path)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise _reading_error(url, error) from error
        raise _reading_error(self.path(name), FileNotFoundError(errno.ENOENT, "it is not there"))


class _File:
    """A file that is open for reading, closed when nobody uses it any more."""

    def __init__(self, path: Path) -> None:
        self.process, self.path = os.getpid(), path
        try:
            self.descriptor = open_regular(path)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise reading_error(path, error) from error
        self.about = _about(os.fstat(self.descriptor))

    def read(self, offset: int, size: int) -> bytes:
        """The bytes from an offset on. Raises DamagedError where the file ends too early."""
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
        """What one call did not give: 2 GiB are the most, and a signal may come between."""
        parts = []
        while size and (part := os.pread(self.descriptor, size, offset)):
            parts.append(part)
            offset, size = offset + len(part), size - len(part)
        return b"".join(parts)

    def read_into(self, target: memoryview, offset: int) -> None:
        """Fills `target` with the bytes from an offset on."""
        try:
            got = os.preadv(self.descriptor, [target], offset) if target.nbytes else 0
        except OSError as error:
            raise reading_error(self.path, error) from error
        if got != target.nbytes:
            target.cast("B")[got:] = self.read(offset + got, target.nbytes - got)

    def __del__(self) -> None:
        # A forked process has its own copies, and may have given the number to another file since.
        if hasattr(self, "descriptor") and self.process == os.getpid():
            os.close(self.descriptor)


def _about(status: os.stat_result) -> tuple[int, ...]:
    """What tells a file from another that has taken its name."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


# The files that this process has open, those used longest ago first.
_files: OrderedDict[Path, _File] = OrderedDict()
_lock = threading.Lock()  # of these, and of the blocks of every dataset; held for moments only


def open_file(path: Path) -> _File:
    """The file that now has this name, open; it stays so for others. Raises FileNotFoundError, and ours."""
    try:
        about = _about(path.stat())
    except FileNotFoundError:
        raise
    except OSError as error:
        raise reading_error(path, error) from error
    with _lock:
        known = _files.get(path)
        if known is not None and known.about == about and known.process == os.getpid():
            _files.move_to_end(path)
            return known
    try:
        file = _File(path)
    except UserError:
        with _lock:
            _files.clear()  # too many are open: ours need not be
        file = _File(path)
    with _lock:
        _files[path] = file
        while len(_files) > OPEN:
            _files.popitem(last=False)
    return file


def _after_fork() -> None:
    global _lock
    _lock = threading.Lock()  # another thread may have held it


os.register_at_fork(after_in_child=_after_fork)


def _piece_of(file: _File, column: Column, piece: Chunk, target: np.ndarray) -> bytes | memoryview:
    """The bytes of a piece; one that is not compressed is read right into `target`."""
    if column.codec != "none":
        return file.read(piece.offset, piece.size)
    data = target.data
    if data.nbytes != piece.size:
        raise DamagedError(f"it has {piece.size} bytes, but must have {data.nbytes}")
    file.read_into(data, piece.offset)
    return data


def _received(
    found: Mapping[Chunk, bytes | Exception], column: Column, piece: Chunk, target: np.ndarray
) -> bytes | memoryview:
    """The bytes of a piece that has been asked for already."""
    data = found[piece]
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
