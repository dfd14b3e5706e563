"""Datasets for training: `open` gives videos by number, `DataLoader` gives batches in an order that can be resumed.

Pieces are read by offset straight from the shards, without h5py and its one lock per process, and decoded into the
batch by threads. No jax is imported, and nothing here depends on the process, so fork and spawn are both safe.
"""

import dataclasses
import difflib
import fnmatch
import functools
import importlib
import itertools
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from gen2d import codecs, shards
from gen2d.errors import ConfigError, DamagedError
from gen2d.fields import Field

Batch = dict[str, np.ndarray]
Numbers = Sequence[int] | np.ndarray

LAYOUTS = {"THWC": (0, 1, 2, 3), "TCHW": (0, 3, 1, 2), "CTHW": (3, 0, 1, 2)}


def open(
    path: str | Path,
    split: str | None = None,
    fields: Sequence[str] = ("frames", "states/*"),
    window: int | None = None,
    stride: int = 1,
    start: str | int = "random",
    layout: str = "THWC",
    dtype: str = "uint8",
    verify: str = "checksum",
) -> "Dataset":
    """The videos of one split of a complete dataset.

    `split` may be left out if there is only one, or one called train. `fields` are names or patterns. `window` takes so
    many frames, `stride` apart, beginning at frame `start`: a number, "first", or "random", which DataLoader draws anew
    for each video and epoch; the Dataset alone then begins at the first. `layout` is of images with channels, `dtype`
    of frames ("float32" is 0 to 1). With verify="checksum" nothing damaged is ever returned.

    Raises FolderError, ConfigError, and DamagedError, then and whenever videos are read.
    """
    root = Path(path)
    manifest = shards.read_manifest(root)
    split = _chosen_split(root, manifest, split)
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
        self.fields = {name: _field(manifest["fields"][name]) for name in options.fields}
        self.stats = {name: values for name, values in manifest["stats"][options.split].items() if name in self.fields}
        self._columns = [_Column(name, field, manifest, options) for name, field in self.fields.items()]
        self._count = manifest["splits"][options.split]
        sizes = {split: count for split, count in sorted(manifest["splits"].items()) if split < options.split}
        self._base = sum(sizes.values())  # the index holds one split after the other
        self._videos = self._table("videos")
        self._places = self._table("shards")
        self._chunks = {column.name: self._table(column.name) for column in self._columns if column.is_image}

    def __reduce__(self) -> tuple[Any, ...]:
        values = vars(self.options)
        return open, (self.root, *values.values())

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, key: Any) -> Batch:
        """One video, or for a slice or a sequence of numbers several, stacked."""
        if isinstance(key, slice):
            return self.batch(range(*key.indices(len(self))))
        if np.ndim(key) == 1:
            return self.batch(key)
        return {name: values[0] for name, values in self.batch([key]).items()}

    def __getitems__(self, indices: Numbers) -> list[Batch]:
        """The videos one by one; torch's DataLoader asks for a whole batch so."""
        batch = self.batch(indices)
        return [{name: values[row] for name, values in batch.items()} for row in range(len(indices))]

    def __repr__(self) -> str:
        return f"<{len(self)} {self.options.split} videos of {self.root}: {', '.join(self.fields)}>"

    @property
    def time(self) -> np.ndarray:
        """The time of every frame of a whole video, s, float64 [T]."""
        return np.array(self.manifest["constants"]["time"])

    def batch(self, indices: Numbers, starts: Numbers | None = None, out: Batch | None = None) -> Batch:
        """The videos with these numbers, stacked; windows begin at `starts`; `out` is filled if given."""
        numbers = self._numbers(indices)
        out = self.empty(len(numbers)) if out is None else self._fitting(out, len(numbers))
        self.fill(out, 0, numbers, starts)
        return out

    def empty(self, count: int) -> Batch:
        """A batch of `count` videos that is yet to be filled."""
        return {column.name: np.empty((count, *column.shape), column.dtype) for column in self._columns}

    def fill(self, out: Batch, row: int, indices: Numbers, starts: Numbers | None = None) -> None:
        """Returns nothing; puts the videos into `out` from `row` on. Threads may fill one batch together."""
        numbers = self._numbers(indices)
        first = np.full(len(numbers), self.options.first) if starts is None else np.asarray(starts)
        last = self.manifest["sizes"].get("T", 0) - self.options.span
        if first.shape != numbers.shape or ((first < 0) | (first > last)).any():
            raise ConfigError(f"starts must be a frame from 0 to {last} for each video, but are {first.tolist()}")
        videos = self._videos[self._base + numbers]
        for column in self._columns:
            whole = None if column.is_direct else np.empty((1, *column.stored), column.field.dtype)
            for step, place in enumerate(self._pieces(column, numbers, videos)):
                target = out[column.name][row + step : row + step + 1]
                self._read(column, place, int(numbers[step]), target if whole is None else whole)
                if whole is not None:
                    column.convert(whole, int(first[step]), target)

    def _pieces(
        self, column: "_Column", numbers: np.ndarray, videos: np.ndarray
    ) -> Iterator[tuple[int, int, int, int]]:
        """Shard, offset, size and checksum of the videos' pieces."""
        if column.is_image:
            return iter(self._chunks[column.name][self._base + numbers].tolist())
        shard, size = videos["shard"], column.size
        offset = self._places[column.name][shard] + videos["row"].astype(np.uint64) * np.uint64(size)
        crc = videos[column.name].tolist()
        return zip(shard.tolist(), offset.tolist(), [size] * len(numbers), crc, strict=True)

    def _read(self, column: "_Column", place: tuple[int, int, int, int], video: int, target: np.ndarray) -> None:
        shard, offset, size, crc = place
        path = self.root / "shards" / f"{self.manifest['shards'][shard]['name']}.h5"
        try:
            file = _opened(path, self.manifest["shards"][shard]["sha256"], os.getpid())
            if column.codec == "none":
                data = target.data
                got = os.preadv(file.descriptor, [data], offset) if size else 0
            else:
                data = os.pread(file.descriptor, size, offset)
                got = len(data)
            if got != size:
                raise DamagedError("the file ends too early")
            if self.options.verify == "checksum" and codecs.crc32(data) != crc:
                raise DamagedError("its checksum differs")
            if column.codec != "none":
                codecs.decode_into(column.codec, data, target)
        except (DamagedError, OSError) as error:
            where = f"{path}: {column.name} of {self.options.split} video {video}"
            raise DamagedError(f"{where} cannot be read ({error}): gen2d verify finds all such damage") from error

    def _numbers(self, indices: Numbers) -> np.ndarray:
        numbers = np.asarray(indices)
        if not np.issubdtype(numbers.dtype, np.integer) and len(numbers):
            raise TypeError(f"a video's number must be an integer, not {numbers.dtype}")
        wrong = numbers[(numbers < -len(self)) | (numbers >= len(self))]
        if len(wrong):
            raise IndexError(f"video {wrong[0]} is not there: {self.options.split} has {len(self)} videos")
        return np.where(numbers < 0, numbers + len(self), numbers).astype(np.int64)

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
        if self.options.verify == "checksum" and shards.file_sha256(self.root / path) != self.manifest["files"][path]:
            raise DamagedError(f"{self.root / path} is not what was written")
        return np.load(self.root / path, mmap_mode="r")


class _Column:
    """One field on its way from file to batch."""

    def __init__(self, name: str, field: Field, manifest: Mapping[str, Any], options: Options) -> None:
        self.name, self.field, self.is_image = name, field, field.is_image
        self.codec = manifest["fields"][name]["codec"]
        self.stored = field.shape(manifest["sizes"])
        self.size = int(np.prod(self.stored)) * np.dtype(field.dtype).itemsize
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


class _File:
    """A file that is open for reading, closed when nobody uses it any more."""

    def __init__(self, path: Path) -> None:
        self.process = os.getpid()
        self.descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))

    def __del__(self) -> None:
        # A forked process has its own copies, and may have given the number to another file since.
        if hasattr(self, "descriptor") and self.process == os.getpid():
            os.close(self.descriptor)


@functools.lru_cache(maxsize=128)
def _opened(path: Path, sha256: str, process: int) -> _File:
    """The open file; one that was made again since, or opened before a fork, is another."""
    return _File(path)


def _field(about: Mapping[str, Any]) -> Field:
    return Field(*(about[part.name] for part in dataclasses.fields(Field)))


def _chosen_split(root: Path, manifest: Mapping[str, Any], split: str | None) -> str:
    splits = manifest["splits"]
    if split is None and len(splits) != 1 and "train" not in splits:
        raise ConfigError(f"{root} has the splits {', '.join(splits)}: say which, as split=")
    chosen = split if split is not None else "train" if "train" in splits else next(iter(splits))
    if chosen not in splits:
        raise ConfigError(f"{root} has no split {chosen!r}{_nearest(chosen, splits)}")
    return chosen


def _chosen_fields(root: Path, manifest: Mapping[str, Any], patterns: Sequence[str]) -> list[str]:
    names = [name for name, about in manifest["fields"].items() if _field(about).per_video]
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


# ---- Batches in an order that can be resumed


class DataLoader:
    """Batches as dictionaries of arrays, each rank its slice of every global batch of `batch_size * world_size`.

    Video and window at each position follow from (seed, epoch, position) alone, so a state is a few numbers and fits
    another world size. An iteration ends when `epochs` epochs are through, and the next goes on with the epochs that
    follow; after `break` or `load_state_dict` it goes on with the batch after the last one delivered.

    `shuffle` is "global" (or True) or False. `remainder` says what happens to the last videos of an epoch that fill no
    global batch: "drop" or "keep" (then the ranks' shares may differ by one, or be empty). `transform` gets each batch
    in a thread. `to` is "numpy", "torch" or "jax".
    """

    def __init__(
        self,
        dataset: Dataset,
        batch_size: int,
        seed: int = 0,
        shuffle: bool | str = "global",
        epochs: int | None = None,
        rank: int = 0,
        world_size: int = 1,
        remainder: str = "drop",
        num_threads: int | None = None,
        prefetch: int = 2,
        transform: Callable[[Batch], Any] | None = None,
        to: str = "numpy",
    ) -> None:
        threads = num_threads or min(os.cpu_count() or 1, 8)
        if to not in _DELIVER or shuffle not in ("global", True, False) or remainder not in ("drop", "keep"):
            raise ConfigError("to must be numpy, torch or jax, shuffle global or False, and remainder drop or keep")
        if min(batch_size, world_size, prefetch, threads) < 1 or not 0 <= rank < world_size:
            raise ConfigError(
                "batch_size, world_size, prefetch and num_threads must be positive, rank under world_size"
            )
        self.dataset, self.seed, self.shuffle, self.epochs = dataset, seed, bool(shuffle), epochs
        self.rank, self.world_size, self.global_size = rank, world_size, batch_size * world_size
        self.least = 1 if remainder == "keep" else self.global_size  # how many videos still make a global batch
        self.threads, self.prefetch, self.transform, self.to = threads, prefetch, transform, to
        self._epoch = self._position = 0
        self._running: Generator[Any, None, None] | None = None
        if len(dataset) < self.least:
            raise ConfigError(f"{self.global_size} videos make a global batch, but there are only {len(dataset)}")

    def __len__(self) -> int:
        """The number of batches in one epoch."""
        whole, rest = divmod(len(self.dataset), self.global_size)
        return whole + (rest >= self.least)

    def __iter__(self) -> Iterator[Any]:
        self.close()
        self._running = self._batches()
        return self._running

    def __enter__(self) -> "DataLoader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Returns when the threads of the iteration in progress have ended."""
        if self._running is not None:
            self._running.close()

    def state_dict(self) -> dict[str, Any]:
        """Where the iteration stands: what has been delivered, not what was read ahead."""
        fixed = {"seed": self.seed, "shuffle": self.shuffle, "videos": len(self.dataset)}
        return fixed | {"epoch": self._epoch, "position": self._position}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Returns nothing; the next iteration goes on where `state` was taken, on whatever number of ranks."""
        for name, here in self.state_dict().items():
            if name not in ("epoch", "position") and state[name] != here:
                raise ConfigError(
                    f"the state has {name} {state[name]}, but this loader has {here}: orders would differ"
                )
        self.close()
        self._epoch, self._position = self._settled(state["epoch"], state["position"])

    def _settled(self, epoch: int, position: int) -> tuple[int, int]:
        """Where the next global batch begins."""
        return (epoch, position) if len(self.dataset) - position >= self.least else (epoch + 1, 0)

    def _steps(self) -> Iterator[tuple[int, int, int]]:
        """Epoch, position and size of the global batches to come."""
        epoch, position = self._epoch, self._position
        end = None if self.epochs is None else (epoch // self.epochs + 1) * self.epochs
        while end is None or epoch < end:
            size = min(self.global_size, len(self.dataset) - position)
            yield epoch, position, size
            epoch, position = self._settled(epoch, position + size)

    def _batches(self) -> Generator[Any, None, None]:
        steps = self._steps()
        pool = ThreadPoolExecutor(self.threads, "gen2d")
        try:
            ahead = deque((step, self._submit(pool, *step)) for step in itertools.islice(steps, self.prefetch))
            while ahead:
                (epoch, position, size), coming = ahead.popleft()
                batch = _DELIVER[self.to](coming.result())
                # Asked for before this one is handed out, so that threads read while the caller trains.
                ahead.extend((step, self._submit(pool, *step)) for step in itertools.islice(steps, 1))
                self._epoch, self._position = self._settled(epoch, position + size)
                yield batch
        finally:
            pool.shutdown(cancel_futures=True)

    def _submit(self, pool: ThreadPoolExecutor, epoch: int, position: int, size: int) -> Future[Any]:
        """This rank's slice of a global batch, being filled by all threads."""
        share = (size * rank // self.world_size for rank in (self.rank, self.rank + 1))
        positions = position + np.arange(*share)
        indices = order(self.seed, epoch, positions, len(self.dataset)) if self.shuffle else positions
        starts = self._starts(epoch, positions)
        # A new batch each time, never one used before: jax may keep the very memory that it is given.
        out = self.dataset.empty(len(indices))
        parts = [
            pool.submit(self.dataset.fill, out, part[0], indices[part], None if starts is None else starts[part])
            for part in np.array_split(np.arange(len(indices)), min(self.threads, len(indices) or 1))
            if len(part)
        ]
        # Queued behind its parts, so they have all begun when a thread takes this up: it waits, but never for ever.
        return pool.submit(self._whole, out, parts)

    def _whole(self, out: Batch, parts: list[Future[None]]) -> Any:
        for part in parts:
            part.result()
        return out if self.transform is None else self.transform(out)

    def _starts(self, epoch: int, positions: np.ndarray) -> np.ndarray | None:
        options = self.dataset.options
        if options.window is None or options.start != "random":
            return None
        choices = self.dataset.manifest["sizes"]["T"] - options.span + 1
        return (_hashed(_WINDOWS, self.seed, epoch, positions) % np.uint64(choices)).astype(np.int64)


def _to_torch(batch: Batch) -> dict[str, Any]:
    torch = importlib.import_module("torch")
    return {name: torch.from_numpy(values) for name, values in batch.items()}


def _to_jax(batch: Batch) -> dict[str, Any]:
    return importlib.import_module("jax").device_put(batch)


_DELIVER: dict[str, Callable[[Any], Any]] = {"numpy": lambda batch: batch, "torch": _to_torch, "jax": _to_jax}

# What a random number is for, so that no two uses share one.
_ORDER, _WINDOWS = 0, 1


def order(seed: int, epoch: int, positions: np.ndarray, count: int) -> np.ndarray:
    """The numbers of the videos at these positions of an epoch: a permutation of 0 to count - 1, nowhere stored.

    A Feistel network permutes the smallest square power of two that holds `count`; what falls outside goes through
    again until it falls inside (Black and Rogaway, CT-RSA 2002).
    """
    half = np.uint64(max(1, ((count - 1).bit_length() + 1) // 2))
    keys = [_hashed(_ORDER, seed, epoch, step) for step in range(8)]
    values = positions.astype(np.uint64)
    outside = np.ones(values.shape, bool)
    while outside.any():
        values[outside] = _feistel(values[outside], keys, half)
        outside = values >= count
    return values.astype(np.int64)


def _feistel(values: np.ndarray, keys: list[np.ndarray], half: np.uint64) -> np.ndarray:
    mask = (np.uint64(1) << half) - np.uint64(1)
    left, right = values >> half, values & mask
    for key in keys:
        left, right = right, left ^ (_mixed(right ^ key) & mask)
    return (left << half) | right


def _hashed(*parts: int | np.ndarray) -> np.ndarray:
    """64 random bits that the parts decide, uint64, for each element of the parts."""
    bits = np.zeros(1, np.uint64)
    for part in parts:
        bits = _mixed(bits ^ np.asarray(part).astype(np.uint64))
    return bits


def _mixed(bits: np.ndarray) -> np.ndarray:
    """The next output of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), for each element."""
    bits = bits + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))
