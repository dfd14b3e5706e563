"""Pieces of files: where each piece of a video lies, how its bytes are read, and what of it goes into a batch.

They are read by offset straight from the shards, without h5py and its one lock per process, and decoded where they are
wanted. No open file outlives a fork. Of a remote dataset the pieces of all videos wanted at once are asked for at once,
or whole shards are kept in a cache.
"""

import contextlib
import functools
import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gen2d.core.errors import DamagedError, FolderError
from gen2d.dataset.block import stored_bytes
from gen2d.dataset.manifest import field_of
from gen2d.dataset.spec import shard_path
from gen2d.storage.atomic import file_sha256, sha256
from gen2d.storage.cache import Cache
from gen2d.storage.paths import Place, Range, Url, read_ranges

LAYOUTS = {"THWC": (0, 1, 2, 3), "TCHW": (0, 3, 1, 2), "CTHW": (3, 0, 1, 2)}


class Piece(NamedTuple):
    """Where a piece lies, and the checksum of its bytes; in the order of the index."""

    shard: int
    offset: int
    size: int
    crc32: int


class Column:
    """One field on its way from file to batch."""

    def __init__(
        self, name: str, manifest: Mapping[str, Any], layout: str, window: int | None, stride: int, dtype: str
    ) -> None:
        field = field_of(manifest["fields"][name])
        self.name, self.field, self.is_image = name, field, field.is_image
        self.codec = manifest["fields"][name]["codec"]
        self.stored = field.shape(manifest["sizes"])
        self.size = stored_bytes(field, manifest["sizes"])
        self.frames = manifest["chunk_frames"] if field.is_image else None  # of a piece
        self.pieces = manifest["sizes"]["T"] // self.frames if self.frames else 1
        axes = field.axes.split()[1:]
        self.order = LAYOUTS[layout] if self.is_image and len(axes) == 4 else tuple(range(len(axes)))
        self.window, self.stride = (window if axes[:1] == ["T"] else None), stride
        self.to_float = name == "frames" and dtype == "float32"
        self.dtype = np.dtype("float32" if self.to_float else field.dtype)
        shape = self.stored if self.window is None else (self.window, *self.stored[1:])
        self.shape = tuple(shape[axis] for axis in self.order)
        # Then a piece is read or decoded right where it is wanted.
        self.is_direct = not self.to_float and self.window is None and self.order == tuple(range(len(axes)))

    def needed(self, first: int) -> range:
        """The pieces that the window which begins at frame `first` lies in."""
        if self.window is None or self.frames is None:
            return range(self.pieces)
        return range(first // self.frames, (first + (self.window - 1) * self.stride) // self.frames + 1)

    def part(self, whole: np.ndarray, piece: int) -> np.ndarray:
        """Where in a whole video a piece belongs, both with a leading 1."""
        return whole if self.frames is None else whole[:, piece * self.frames : (piece + 1) * self.frames]

    def convert(self, whole: np.ndarray, first: int, target: np.ndarray) -> None:
        """Returns nothing; puts the window that begins at frame `first` into `target`, both with a leading 1."""
        if self.window is not None:
            whole = whole[:, first : first + (self.window - 1) * self.stride + 1 : self.stride]
        whole = whole.transpose(0, *(1 + axis for axis in self.order))
        if self.to_float:
            np.divide(whole, np.float32(255), out=target)
        else:
            target[...] = whole


Reader = Callable[[Column, Piece, np.ndarray], bytes | memoryview]


class Files:
    """The files of a dataset: the tables of its index, and its shards, read piece by piece."""

    def __init__(self, root: Place, manifest: Mapping[str, Any], cache: Cache | None, checks: bool) -> None:
        self.root, self.manifest, self.cache, self.checks = root, manifest, cache, checks

    def table(self, name: str) -> np.ndarray:
        """An index file, mapped, not read into memory, unless it is remote and there is no cache.

        Checked first, as wrong places would lead anywhere.
        """
        name = f"index/{name}.npy"
        path, right = self.root / name, self.manifest["files"][name]
        try:
            if self.cache:
                path = self._cached(path, right)
            if isinstance(path, Path):
                intact = not self.checks or file_sha256(path) == right
                table = np.load(path, mmap_mode="r") if intact else None
            else:
                content = path.read_bytes()
                intact = not self.checks or sha256(content) == right
                table = np.load(io.BytesIO(content)) if intact else None
        except FileNotFoundError:
            raise DamagedError(f"{path} is missing") from None
        except OSError as error:
            raise FolderError(f"{path} cannot be read ({why(error)})") from error
        if table is None:
            raise DamagedError(f"{path} is not what was written")
        return table

    def reader(self, places: list[list[list[Piece]]]) -> Reader:
        """What gives the bytes of these pieces, by what the shards lie on."""
        if isinstance(self.root, Path):
            return lambda column, piece, target: _piece(self._open(piece.shard), column, piece, target)
        if self.cache:
            cached = functools.lru_cache(maxsize=16)(self._open_cached)
            return lambda column, piece, target: _piece(cached(piece.shard), column, piece, target)
        pieces = {piece for own in places for video in own for piece in video}
        return functools.partial(_received, dict(zip(pieces, read_ranges(list(map(self._range, pieces))), strict=True)))

    def shard(self, number: int) -> Place:
        """The file of the shard with this number."""
        return shard_path(self.root, self.manifest["shards"][number]["name"])

    def _range(self, piece: Piece) -> Range:
        url = self.shard(piece.shard)
        assert isinstance(url, Url)
        return Range(url, piece.offset, piece.offset + piece.size)

    def _open(self, number: int) -> "_File":
        path = self.shard(number)
        assert isinstance(path, Path)
        return _opened(path, self.manifest["shards"][number]["sha256"], os.getpid())

    def _open_cached(self, number: int) -> "_File":
        shard = self.manifest["shards"][number]
        while True:
            path = self._cached(self.shard(number), shard["sha256"], shard["bytes"])
            with contextlib.suppress(FileNotFoundError):  # another process made room just now
                return _File(path)

    def _cached(self, url: Place, sha256: str, size: int | None = None) -> Path:
        assert self.cache is not None
        assert isinstance(url, Url)
        return self.cache.path(url, sha256, size)


class _File:
    """A file that is open for reading, closed when nobody uses it any more."""

    def __init__(self, path: Path) -> None:
        self.process = os.getpid()
        self.descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))

    def __del__(self) -> None:
        # A forked process has its own copies, and may have given the number to another file since.
        if hasattr(self, "descriptor") and self.process == os.getpid():
            os.close(self.descriptor)


def _piece(file: _File, column: Column, place: Piece, target: np.ndarray) -> bytes | memoryview:
    """The bytes of a piece; one that is not compressed is read right into `target`."""
    if column.codec == "none":
        data = target.data
        got = os.preadv(file.descriptor, [data], place.offset) if place.size else 0
    else:
        data = os.pread(file.descriptor, place.size, place.offset)
        got = len(data)
    if got != place.size:
        raise DamagedError("the file ends too early")
    return data


def _received(
    found: Mapping[Piece, bytes | OSError], column: Column, piece: Piece, target: np.ndarray
) -> bytes | memoryview:
    """The bytes of a piece that has been asked for already."""
    data = found[piece]
    if isinstance(data, OSError):
        raise data
    return data


def why(error: Exception) -> str:
    """What is wrong, without the file's name."""
    return str(getattr(error, "strerror", None) or error)


def forget() -> None:
    """Returns nothing; every file is opened anew: a shard that is made again is another under the same name."""
    _opened.cache_clear()


# At the interpreter's end names with an underscore go first: so these files are closed while there still is an `os`.
@functools.lru_cache(maxsize=128)
def _opened(path: Path, sha256: str, process: int) -> _File:
    """The open file; one that was made again since, or opened before a fork, is another."""
    return _File(path)
