"""Videos by number: what `open` gives of a complete dataset, one by one or as batches.

Pieces are read by offset straight from the shards, without h5py and its one lock per process, and decoded where they
are wanted. Neither jax nor h5py is imported, and no open file outlives a fork, so fork and spawn are both safe.
"""

import dataclasses
import difflib
import fnmatch
import functools
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from gen2d import codecs
from gen2d.errors import ConfigError, DamagedError
from gen2d.fields import Field
from gen2d.files import file_sha256
from gen2d.formats import stored_bytes
from gen2d.manifest import field_of, read_manifest
from gen2d.ordering import order
from gen2d.plan import shard_path

Batch = dict[str, np.ndarray]
Numbers = Sequence[int] | np.ndarray

LAYOUTS = {"THWC": (0, 1, 2, 3), "TCHW": (0, 3, 1, 2), "CTHW": (3, 0, 1, 2)}


def open(
    path: str | Path,
    split: str | None = None,
    fields: Sequence[str] | None = None,
    window: int | None = None,
    stride: int = 1,
    start: str | int = "random",
    layout: str = "THWC",
    dtype: str = "uint8",
    verify: str = "checksum",
) -> "Dataset":
    """The videos of one split of a complete dataset.

    `split` may be left out if there is only one, or one called train. `fields` are names or patterns: frames and
    "states/*" unless told otherwise. `window` takes so many frames, `stride` apart, beginning at frame `start`: a
    number, "first", or "random", which DataLoader draws anew for each video and epoch; the Dataset alone then begins at
    the first. `layout` is of images with channels, `dtype`
    of frames ("float32" is 0 to 1). With verify="checksum" nothing damaged is ever returned.

    Raises FolderError, ConfigError, and DamagedError, then and whenever videos are read.
    """
    root = Path(path)
    manifest = read_manifest(root)
    split = _chosen_split(root, manifest, split)
    if fields is None:
        fields = [*({"frames"} & manifest["fields"].keys()), "states/*"]
    names = _chosen_fields(root, manifest, [fields] if isinstance(fields, str) else fields)
    options = Options(split, tuple(names), window, stride, start, layout, dtype, verify)
    _check(options, manifest["sizes"].get("T", 0))
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

    @property
    def first(self) -> int:
        """The frame at which windows begin unless told otherwise."""
        return self.start if isinstance(self.start, int) else 0

    @property
    def span(self) -> int:
        """How many frames a window reaches over."""
        return 0 if self.window is None else (self.window - 1) * self.stride + 1


class Dataset:
    """Videos by number, as dictionaries of NumPy arrays; also a map-style dataset for torch and grain."""

    def __init__(self, root: Path, manifest: Mapping[str, Any], options: Options) -> None:
        self.root, self.manifest, self.options = root, manifest, options
        self.fields = {name: field_of(manifest["fields"][name]) for name in options.fields}
        self.stats = {name: values for name, values in manifest["stats"][options.split].items() if name in self.fields}
        self._columns = [_Column(name, field, manifest, options) for name, field in self.fields.items()]
        self._count = manifest["splits"][options.split]
        sizes = {split: count for split, count in sorted(manifest["splits"].items()) if split < options.split}
        self._base = sum(sizes.values())  # the index holds one split after the other
        self._videos = self._table("videos")
        self._rows = self._table("shards")
        self._chunks = {column.name: self._table(column.name) for column in self._columns if column.is_image}

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
        for column in self._columns:
            whole = None if column.is_direct else np.empty((1, *column.stored), column.field.dtype)
            for step, place in enumerate(self._places(column, numbers, videos)):
                target = out[column.name][row + step : row + step + 1]
                self._read(column, place, int(numbers[step]), target if whole is None else whole)
                if whole is not None:
                    column.convert(whole, int(first[step]), target)

    def _places(self, column: "_Column", numbers: np.ndarray, videos: np.ndarray) -> "Iterable[_Place]":
        """Where the videos' pieces lie."""
        if column.is_image:
            return map(_Place._make, self._chunks[column.name][self._base + numbers].tolist())
        offset = self._rows[column.name][videos["shard"]] + videos["row"].astype(np.uint64) * np.uint64(column.size)
        parts = videos["shard"], offset, np.full(len(numbers), column.size), videos[column.name]
        return map(_Place, *(part.tolist() for part in parts))

    def _read(self, column: "_Column", place: "_Place", video: int, target: np.ndarray) -> None:
        shard = self.manifest["shards"][place.shard]
        path = shard_path(self.root, shard["name"])
        try:
            data = _piece(_opened(path, shard["sha256"], os.getpid()), column, place, target)
            if self.options.verify == "checksum" and codecs.crc32(data) != place.crc32:
                raise DamagedError("its checksum differs")
            if column.codec != "none":
                codecs.decode_into(column.codec, data, target)
        except (DamagedError, OSError) as error:
            _opened.cache_clear()  # a shard that is made again is another file under the same name
            where = f"{path}: {column.name} of {self.options.split} video {video}"
            raise DamagedError(f"{where} cannot be read ({error}): gen2d verify finds all such damage") from error

    def numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray:
        """The numbers of the videos at these positions of an epoch: in order, or as the seed shuffles them."""
        return positions if seed is None else order(seed, epoch, positions, len(self))

    def starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
        """Where the windows of these videos begin, drawn by random bits; None if that is not random."""
        if self.options.window is None or self.options.start != "random":
            return None
        return (bits % np.uint64(self.manifest["sizes"]["T"] - self.options.span + 1)).astype(np.int64)

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
        """An index file, mapped, not read into memory; checked first, as wrong places would lead anywhere."""
        path = f"index/{name}.npy"
        if not (self.root / path).is_file():
            raise DamagedError(f"{self.root / path} is missing")
        if self.options.verify == "checksum" and file_sha256(self.root / path) != self.manifest["files"][path]:
            raise DamagedError(f"{self.root / path} is not what was written")
        return np.load(self.root / path, mmap_mode="r")


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
        axes = field.axes.split()[1:]
        self.order = LAYOUTS[options.layout] if self.is_image and len(axes) == 4 else tuple(range(len(axes)))
        self.window, self.stride = (options.window if axes[:1] == ["T"] else None), options.stride
        self.to_float = name == "frames" and options.dtype == "float32"
        self.dtype = np.dtype("float32" if self.to_float else field.dtype)
        shape = self.stored if self.window is None else (self.window, *self.stored[1:])
        self.shape = tuple(shape[axis] for axis in self.order)
        # Then a piece is read or decoded right where it is wanted.
        self.is_direct = not self.to_float and self.window is None and self.order == tuple(range(len(axes)))

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


@functools.lru_cache(maxsize=128)
def _opened(path: Path, sha256: str, process: int) -> _File:
    """The open file; one that was made again since, or opened before a fork, is another."""
    return _File(path)


def _chosen_split(root: Path, manifest: Mapping[str, Any], split: str | None) -> str:
    splits = manifest["splits"]
    if split is None and len(splits) != 1 and "train" not in splits:
        raise ConfigError(f"{root} has the splits {', '.join(splits)}: say which, as split=")
    chosen = split if split is not None else "train" if "train" in splits else next(iter(splits))
    if chosen not in splits:
        raise ConfigError(f"{root} has no split {chosen!r}{_nearest(chosen, splits)}")
    return chosen


def _chosen_fields(root: Path, manifest: Mapping[str, Any], patterns: Sequence[str]) -> list[str]:
    names = [name for name, about in manifest["fields"].items() if field_of(about).per_video]
    chosen: dict[str, None] = {}
    for pattern in patterns:
        found = fnmatch.filter(names, pattern)
        if not found:
            raise ConfigError(f"{root} has no field {pattern!r}{_nearest(pattern, names)}")
        chosen |= dict.fromkeys(found)
    return list(chosen)


def _nearest(name: str, names: Sequence[str] | Mapping[str, Any]) -> str:
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.4)
    return f": did you mean {near[0]!r}?" if near else f": it has {', '.join(names)}"


def _check(options: Options, frames: int) -> None:
    allowed = {"layout": tuple(LAYOUTS), "dtype": ("uint8", "float32"), "verify": ("checksum", "none")}
    for name, values in allowed.items():
        if getattr(options, name) not in values:
            raise ConfigError(f"{name} is {getattr(options, name)!r}, but must be one of {', '.join(values)}")
    if isinstance(options.start, str) and options.start not in ("random", "first"):
        raise ConfigError(f"start is {options.start!r}, but must be 'random', 'first' or a frame's number")
    if isinstance(options.start, int) and options.window is None:
        raise ConfigError(f"start is {options.start}, but without a window all frames are given: say window=")
    if options.window is not None and (options.window < 1 or options.stride < 1 or options.first < 0):
        raise ConfigError("window and stride must be 1 or more, and start 0 or more")
    if options.window is not None and options.first + options.span > frames:
        need = f"window {options.window}, stride {options.stride} and start {options.start} need"
        raise ConfigError(f"{need} {options.first + options.span} frames, but the videos have {frames}")
