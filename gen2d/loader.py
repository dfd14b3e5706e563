"""Videos by number: what `open` gives of a complete dataset, one by one or as batches.

Pieces are read by offset straight from the shards, without h5py and its one lock per process, and decoded where they
are wanted. Neither jax nor h5py is imported, and no open file outlives a fork, so fork and spawn are both safe. Of a
remote dataset the pieces of all videos wanted at once are asked for at once, or whole shards are kept in a cache.
"""

import contextlib
import dataclasses
import difflib
import fnmatch
import functools
import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from gen2d import codecs
from gen2d.cache import Cache
from gen2d.errors import ConfigError, DamagedError, FolderError
from gen2d.fields import Field
from gen2d.files import file_sha256, sha256
from gen2d.formats import stored_bytes
from gen2d.manifest import field_of, read_manifest
from gen2d.order import shuffled
from gen2d.plan import shard_path
from gen2d.remote import Place, Range, Url, place, read_ranges

Batch = dict[str, np.ndarray]
Numbers = Sequence[int] | np.ndarray

LAYOUTS = {"THWC": (0, 1, 2, 3), "TCHW": (0, 3, 1, 2), "CTHW": (3, 0, 1, 2)}


def open(
    path: str | Place,
    split: str | None = None,
    fields: Sequence[str] | None = None,
    window: int | None = None,
    stride: int = 1,
    start: str | int = "random",
    layout: str = "THWC",
    dtype: str = "uint8",
    verify: str = "checksum",
    cache_dir: str | Path | None = None,
    cache_bytes: int | None = None,
) -> "Dataset":
    """The videos of one split of a complete dataset.

    `split` may be left out if there is only one, or one called train. `fields` are names or patterns: frames and
    "states/*" unless told otherwise. `window` takes so many frames, `stride` apart, beginning at frame `start`: a
    number, "first", or "random", which DataLoader draws anew for each video and epoch; the Dataset alone then begins at
    the first. `layout` is of images with channels, `dtype`
    of frames ("float32" is 0 to 1). With verify="checksum" nothing damaged is ever returned.

    `path` is a folder or a URL that fsspec knows. Of a URL `cache_dir` keeps whole shards in a folder, `cache_bytes` at
    most besides those on their way, the ones used longest ago going first; several processes and datasets may share it.

    Raises FolderError, ConfigError, and DamagedError, then and whenever videos are read.
    """
    root = place(path)
    manifest = read_manifest(root)
    split = _chosen_split(root, manifest, split)
    described = {name: field_of(about) for name, about in manifest["fields"].items()}
    names = chosen_fields(f"{root}", described, fields)
    options = Options(split, names, window, stride, start, layout, dtype, verify, cache_dir, cache_bytes)
    options.check(manifest["sizes"].get("T", 0))
    _check_cache(options, max(shard["bytes"] for shard in manifest["shards"]))
    return Dataset(root, manifest, options)


@dataclasses.dataclass(frozen=True)
class Options:
    """How a dataset was opened."""

    split: str
    fields: tuple[str, ...]
    window: int | None
    stride: int
    start: str | int
    layout: str
    dtype: str
    verify: str
    cache_dir: str | Path | None = None
    cache_bytes: int | None = None

    @property
    def first(self) -> int:
        """The frame at which windows begin unless told otherwise."""
        return self.start if isinstance(self.start, int) else 0

    def starts(self, bits: np.ndarray, frames: int) -> np.ndarray | None:
        """Where windows in so many frames begin, drawn by random bits; None if that is not random."""
        if self.window is None or self.start != "random":
            return None
        return (bits % np.uint64(frames - self.span + 1)).astype(np.int64)

    @property
    def span(self) -> int:
        """How many frames a window reaches over."""
        return 0 if self.window is None else (self.window - 1) * self.stride + 1

    def check(self, frames: int) -> None:
        """Returns nothing; raises ConfigError for what cannot be of videos with so many frames."""
        allowed = {"layout": tuple(LAYOUTS), "dtype": ("uint8", "float32"), "verify": ("checksum", "none")}
        for name, values in allowed.items():
            if getattr(self, name) not in values:
                raise ConfigError(f"{name} is {getattr(self, name)!r}, but must be one of {', '.join(values)}")
        if isinstance(self.start, str) and self.start not in ("random", "first"):
            raise ConfigError(f"start is {self.start!r}, but must be 'random', 'first' or a frame's number")
        if isinstance(self.start, int) and self.window is None:
            raise ConfigError(f"start is {self.start}, but without a window all frames are given: say window=")
        if self.window is not None and (self.window < 1 or self.stride < 1 or self.first < 0):
            raise ConfigError("window and stride must be 1 or more, and start 0 or more")
        if self.window is not None and self.first + self.span > frames:
            need = f"window {self.window}, stride {self.stride} and start {self.start} need"
            raise ConfigError(f"{need} {self.first + self.span} frames, but the videos have {frames}")


class Dataset:
    """Videos by number, as dictionaries of NumPy arrays; also a map-style dataset for torch and grain."""

    def __init__(self, root: Place, manifest: Mapping[str, Any], options: Options) -> None:
        self.root, self.manifest, self.options = root, manifest, options
        self.fields = {name: field_of(manifest["fields"][name]) for name in options.fields}
        self.stats = {name: values for name, values in manifest["stats"][options.split].items() if name in self.fields}
        self._columns = [_Column(name, field, manifest, options) for name, field in self.fields.items()]
        self._cache = None
        if isinstance(root, Url) and options.cache_dir is not None:
            self._cache = Cache(Path(options.cache_dir), options.cache_bytes)
        self._count = manifest["splits"][options.split]
        sizes = {split: count for split, count in sorted(manifest["splits"].items()) if split < options.split}
        self._base = sum(sizes.values())  # the index holds one split after the other
        self._videos = self._table("videos")
        self._rows = self._table("shards")
        self._chunks = {
            column.name: self._table(column.name).reshape(-1, column.pieces)
            for column in self._columns
            if column.is_image
        }

    def __reduce__(self) -> tuple[Any, ...]:
        values = vars(self.options)
        return open, (self.root, *values.values())

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, key: Any) -> Batch:
        """One video, or for a slice or a sequence of numbers several, stacked."""
        return item(self, key)

    def __getitems__(self, indices: Numbers) -> list[Batch]:
        """The videos one by one; torch's DataLoader asks for a whole batch so."""
        return taken_apart(self.batch(indices))

    def __repr__(self) -> str:
        return f"<{len(self)} {self.options.split} videos of {self.root}: {', '.join(self.fields)}>"

    @property
    def time(self) -> np.ndarray:
        """The time of every frame of a whole video, s, float64 [T]."""
        return np.array(self.manifest["constants"]["time"])

    def batch(self, indices: Numbers, starts: Numbers | None = None, out: Batch | None = None) -> Batch:
        """The videos with these numbers, stacked; windows begin at `starts`; `out` is filled if given."""
        numbers = self.numbers(indices)
        out = self.empty(len(numbers)) if out is None else self._fitting(out, len(numbers))
        self.fill(out, 0, numbers, starts)
        return out

    def empty(self, count: int) -> Batch:
        """A batch of `count` videos that is yet to be filled."""
        return {column.name: np.empty((count, *column.shape), column.dtype) for column in self._columns}

    def fill(self, out: Batch, row: int, indices: Numbers, starts: Numbers | None = None) -> None:
        """Returns nothing; puts the videos into `out` from `row` on. Threads may fill one batch together."""
        numbers = self.numbers(indices)
        first = np.full(len(numbers), self.options.first) if starts is None else np.asarray(starts)
        last = self.manifest["sizes"].get("T", 0) - self.options.span
        if first.shape != numbers.shape or ((first < 0) | (first > last)).any():
            raise ConfigError(f"starts must be a frame from 0 to {last} for each video, but are {first.tolist()}")
        videos = self._videos[self._base + numbers]
        begins = first.tolist()
        places = [self._places(column, numbers, videos, begins) for column in self._columns]
        read = self._reader(places)
        for column, own in zip(self._columns, places, strict=True):
            whole = None if column.is_direct else np.empty((1, *column.stored), column.field.dtype)
            for step, pieces in enumerate(own):
                target = out[column.name][row + step : row + step + 1]
                into, begin = target if whole is None else whole, begins[step]
                for number, piece in zip(column.needed(begin), pieces, strict=True):
                    self._read(read, column, piece, int(numbers[step]), column.part(into, number))
                if whole is not None:
                    column.convert(whole, begin, target)

    def _places(
        self, column: "_Column", numbers: np.ndarray, videos: np.ndarray, begins: list[int]
    ) -> "list[list[_Place]]":
        """Where the pieces lie that are needed of each video."""
        if column.is_image:
            known = self._chunks[column.name][self._base + numbers].tolist()
            pairs = zip(known, begins, strict=True)
            return [[_Place._make(pieces[i]) for i in column.needed(begin)] for pieces, begin in pairs]
        offset = self._rows[column.name][videos["shard"]] + videos["row"].astype(np.uint64) * np.uint64(column.size)
        parts = videos["shard"], offset, np.full(len(numbers), column.size), videos[column.name]
        return [[_Place._make(piece)] for piece in zip(*(part.tolist() for part in parts), strict=True)]

    def _read(self, read: "_Reader", column: "_Column", piece: "_Place", video: int, target: np.ndarray) -> None:
        try:
            data = read(column, piece, target)
            if self.options.verify == "checksum" and codecs.crc32(data) != piece.crc32:
                raise DamagedError("its checksum differs")
            if isinstance(data, bytes):
                codecs.decode_into(column.codec, data, target)
        except (DamagedError, OSError) as error:
            _opened.cache_clear()  # a shard that is made again is another file under the same name
            where = f"{self._shard_path(piece.shard)}: {column.name} of {self.options.split} video {video}"
            raise DamagedError(f"{where} cannot be read ({_why(error)}): gen2d verify finds all such damage") from error

    def _reader(self, places: "list[list[list[_Place]]]") -> "_Reader":
        """What gives the bytes of these pieces, by what the shards lie on."""
        if isinstance(self.root, Path):
            return lambda column, piece, target: _piece(self._open(piece.shard), column, piece, target)
        if self._cache:
            opened = functools.lru_cache(maxsize=16)(self._open_cached)
            return lambda column, piece, target: _piece(opened(piece.shard), column, piece, target)
        pieces = {piece for own in places for video in own for piece in video}
        return functools.partial(_received, dict(zip(pieces, read_ranges(list(map(self._range, pieces))), strict=True)))

    def _shard_path(self, number: int) -> Place:
        return shard_path(self.root, self.manifest["shards"][number]["name"])

    def _range(self, piece: "_Place") -> Range:
        url = self._shard_path(piece.shard)
        assert isinstance(url, Url)
        return Range(url, piece.offset, piece.offset + piece.size)

    def _open(self, number: int) -> "_File":
        path = self._shard_path(number)
        assert isinstance(path, Path)
        return _opened(path, self.manifest["shards"][number]["sha256"], os.getpid())

    def _open_cached(self, number: int) -> "_File":
        shard = self.manifest["shards"][number]
        while True:
            path = self._cached(self._shard_path(number), shard["sha256"], shard["bytes"])
            with contextlib.suppress(FileNotFoundError):  # another process made room just now
                return _File(path)

    def _cached(self, url: Place, sha256: str, size: int | None = None) -> Path:
        assert self._cache is not None
        assert isinstance(url, Url)
        return self._cache.path(url, sha256, size)

    def numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray:
        """The numbers of the videos at these positions of an epoch: in order, or as the seed shuffles them."""
        return shuffled(seed, epoch, positions, len(self))

    def starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
        """Where the windows of these videos begin, drawn by random bits; None if that is not random."""
        return self.options.starts(bits, self.manifest["sizes"].get("T", 0))

    def numbers(self, indices: Numbers) -> np.ndarray:
        """Indices as the numbers of videos, int64: negative ones count from the end."""
        return checked_numbers(indices, len(self), self.options.split)

    def _fitting(self, out: Batch, count: int) -> Batch:
        for column in self._columns:
            given, shape = out[column.name], (count, *column.shape)
            if given.shape != shape or given.dtype != column.dtype or not given.flags.c_contiguous:
                raise ConfigError(f"out[{column.name!r}] must be a contiguous {column.dtype} array of shape {shape}")
        return out

    def _table(self, name: str) -> np.ndarray:
        """An index file, mapped, not read into memory, unless it is remote and there is no cache.

        Checked first, as wrong places would lead anywhere.
        """
        name = f"index/{name}.npy"
        path, right = self.root / name, self.manifest["files"][name]
        try:
            if self._cache:
                path = self._cached(path, right)
            if isinstance(path, Path):
                intact = self.options.verify == "none" or file_sha256(path) == right
                table = np.load(path, mmap_mode="r") if intact else None
            else:
                content = path.read_bytes()
                intact = self.options.verify == "none" or sha256(content) == right
                table = np.load(io.BytesIO(content)) if intact else None
        except FileNotFoundError:
            raise DamagedError(f"{path} is missing") from None
        except OSError as error:
            raise FolderError(f"{path} cannot be read ({_why(error)})") from error
        if table is None:
            raise DamagedError(f"{path} is not what was written")
        return table


class Videos(Protocol):
    """What gives batches by number."""

    def __len__(self) -> int: ...

    def batch(self, indices: Numbers, /) -> Batch: ...


def item(videos: Videos, key: Any) -> Batch:
    """What `videos[key]` is: one video, or for a slice or a sequence of numbers several, stacked."""
    if isinstance(key, slice):
        return videos.batch(range(*key.indices(len(videos))))
    if np.ndim(key) == 1:
        return videos.batch(key)
    return {name: values[0] for name, values in videos.batch([key]).items()}


def taken_apart(batch: Batch) -> list[Batch]:
    """The videos of a batch one by one."""
    return [dict(zip(batch, values, strict=True)) for values in zip(*batch.values(), strict=True)]


def checked_numbers(indices: Numbers, count: int, whose: str) -> np.ndarray:
    """Indices as numbers from 0 to count - 1, int64: negative ones count from the end."""
    numbers = np.asarray(indices)
    if not np.issubdtype(numbers.dtype, np.integer) and len(numbers):
        raise TypeError(f"a video's number must be an integer, not {numbers.dtype}")
    wrong = numbers[(numbers < -count) | (numbers >= count)]
    if len(wrong):
        raise IndexError(f"video {wrong[0]} is not there: {whose} has {count} videos")
    return np.where(numbers < 0, numbers + count, numbers).astype(np.int64)


class _Column:
    """One field on its way from file to batch."""

    def __init__(self, name: str, field: Field, manifest: Mapping[str, Any], options: Options) -> None:
        self.name, self.field, self.is_image = name, field, field.is_image
        self.codec = manifest["fields"][name]["codec"]
        self.stored = field.shape(manifest["sizes"])
        self.size = stored_bytes(field, manifest["sizes"])
        self.frames = manifest["chunk_frames"] if field.is_image else None  # of a piece
        self.pieces = manifest["sizes"]["T"] // self.frames if self.frames else 1
        axes = field.axes.split()[1:]
        self.order = LAYOUTS[options.layout] if self.is_image and len(axes) == 4 else tuple(range(len(axes)))
        self.window, self.stride = (options.window if axes[:1] == ["T"] else None), options.stride
        self.to_float = name == "frames" and options.dtype == "float32"
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


class _Place(NamedTuple):
    """Where a piece lies, and the checksum of its bytes; in the order of the index."""

    shard: int
    offset: int
    size: int
    crc32: int


_Reader = Callable[[_Column, _Place, np.ndarray], bytes | memoryview]


class _File:
    """A file that is open for reading, closed when nobody uses it any more."""

    def __init__(self, path: Path) -> None:
        self.process = os.getpid()
        self.descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))

    def __del__(self) -> None:
        # A forked process has its own copies, and may have given the number to another file since.
        if hasattr(self, "descriptor") and self.process == os.getpid():
            os.close(self.descriptor)


def _piece(file: _File, column: _Column, place: _Place, target: np.ndarray) -> bytes | memoryview:
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
    found: Mapping[_Place, bytes | OSError], column: _Column, piece: _Place, target: np.ndarray
) -> bytes | memoryview:
    """The bytes of a piece that has been asked for already."""
    data = found[piece]
    if isinstance(data, OSError):
        raise data
    return data


def _why(error: Exception) -> str:
    """What is wrong, without the file's name."""
    return str(getattr(error, "strerror", None) or error)


@functools.lru_cache(maxsize=128)
def _opened(path: Path, sha256: str, process: int) -> _File:
    """The open file; one that was made again since, or opened before a fork, is another."""
    return _File(path)


def _chosen_split(root: Place, manifest: Mapping[str, Any], split: str | None) -> str:
    splits = manifest["splits"]
    if split is None and len(splits) != 1 and "train" not in splits:
        raise ConfigError(f"{root} has the splits {', '.join(splits)}: say which, as split=")
    chosen = split if split is not None else "train" if "train" in splits else next(iter(splits))
    if chosen not in splits:
        raise ConfigError(f"{root} has no split {chosen!r}{_nearest(chosen, splits)}")
    return chosen


def chosen_fields(source: str, fields: Mapping[str, Field], patterns: Sequence[str] | str | None) -> tuple[str, ...]:
    """The names of the fields of each video that patterns ask for; without any, frames and states."""
    names = [name for name, field in fields.items() if field.per_video]
    if patterns is None:
        patterns = [*({"frames"} & fields.keys()), "states/*"]
    chosen: dict[str, None] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        found = fnmatch.filter(names, pattern)
        if not found:
            raise ConfigError(f"{source} has no field {pattern!r}{_nearest(pattern, names)}")
        chosen |= dict.fromkeys(found)
    return tuple(chosen)


def _nearest(name: str, names: Sequence[str] | Mapping[str, Any]) -> str:
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.4)
    return f": did you mean {near[0]!r}?" if near else f": it has {', '.join(names)}"


def _check_cache(options: Options, largest: int) -> None:
    if options.cache_bytes is None:
        return
    if options.cache_dir is None:
        raise ConfigError(f"cache_bytes is {options.cache_bytes}, but there is no cache: say cache_dir=")
    if options.cache_bytes < largest:
        raise ConfigError(f"cache_bytes is {options.cache_bytes}, but must be {largest} or more, for the largest shard")
