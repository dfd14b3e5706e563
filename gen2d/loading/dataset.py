"""A dataset: what `open` gives of a complete one, or of several as one, its videos one by one or as batches.

Neither jax nor h5py is imported, and no open file outlives a fork, so fork and spawn are both safe.
"""

import contextlib
import dataclasses
import difflib
import fnmatch
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np

from gen2d.core.errors import ConfigError, DamagedError, FolderError, UnreachableError, UserError
from gen2d.core.humanize import in_bytes
from gen2d.core.schema import Field
from gen2d.dataset.manifest import Manifest, read_manifest
from gen2d.dataset.spec import shard_name
from gen2d.loading.chunks import Chunk, Reader, SplitFiles
from gen2d.loading.column import LAYOUTS, Column
from gen2d.loading.concat import ConcatDataset
from gen2d.loading.epochs import shuffled
from gen2d.loading.protocols import Batch, Key, Numbers, Snapshot, checked_numbers, filled, item, unbatch
from gen2d.storage import codecs
from gen2d.storage.cache import Cache
from gen2d.storage.explain import reason
from gen2d.storage.paths import Network, Place, Url, place

Root = TypeVar("Root", bound=str | Place)


@overload
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
    *,
    snapshot: str | None = None,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> "Dataset": ...
@overload
def open(
    path: list[Root] | tuple[Root, ...],
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
    *,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> ConcatDataset: ...
def open(
    path: str | Place | list[Root] | tuple[Root, ...],
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
    *,
    snapshot: str | None = None,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> "Dataset | ConcatDataset":
    """The videos of one split of a complete dataset.

    `split` may be left out if there is only one, or one called train. `fields` are names or patterns: frames and
    "states/*" unless told otherwise. `window` takes so many frames, `stride` apart, beginning at frame `start`: a
    number, "first", or "random", which DataLoader draws anew for each video and epoch; the Dataset alone then begins at
    the first. `layout` is of images with channels, `dtype`
    of frames ("float32" is 0 to 1). With verify="checksum" nothing damaged is ever returned.

    `path` is a folder or a URL that fsspec knows, or a list of them: datasets of one recipe, whose seeds may differ, as
    one dataset, their videos one after the other. Of a URL `cache_dir` keeps whole shards in a folder, `cache_bytes` at
    most besides those on their way, the ones used longest ago going first; several processes and datasets may share it.

    A dataset may grow while it is read: what was opened stays as it was. `snapshot` opens it as it was before it grew
    the last time (`Dataset.snapshot`, as a loader's state has it). Of a URL, `timeout` is how many seconds a server is
    waited for at a time, and `deadline` how many a request may take in all.

    Raises FolderError, ConfigError, DamagedError, and UnreachableError where a server does not answer, then and
    whenever videos are read.
    """
    if isinstance(path, list | tuple):
        how = split, fields, window, stride, start, layout, dtype, verify, cache_dir, cache_bytes
        if snapshot is not None:
            raise ConfigError("snapshot must be None for a list of datasets")
        return _joined([open(one, *how, timeout=timeout, deadline=deadline) for one in path])
    root = place(path, Network(timeout, deadline))
    manifest = read_manifest(root, snapshot)
    split = _chosen_split(root, manifest, split)
    names = chosen_fields(f"{root}", manifest.fields, fields)
    options = ViewOptions(split, names, window, stride, start, layout, dtype, verify, cache_dir, cache_bytes)
    options = options.within(manifest.frames[split], manifest.sizes.get("T", 0))
    _check_cache(options, max(table.largest for table in manifest.tables.values()))
    return Dataset(root, manifest, options)


@dataclasses.dataclass(frozen=True)
class ViewOptions:
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

    def within(self, frames: int, whole: int) -> "ViewOptions":
        """The same for the first so many frames of whole videos, without a window a window of all of them. Raises
        ConfigError for what cannot be."""
        self._check(frames)
        if self.window is not None or frames == whole:
            return self
        return dataclasses.replace(self, window=frames, stride=1, start="first")

    def _check(self, frames: int) -> None:
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


_HINT = "gen2d verify finds all such damage"


class Dataset:
    """Videos by number, as dictionaries of NumPy arrays; also a map-style dataset for torch and grain."""

    def __init__(self, root: Place, manifest: Manifest, options: ViewOptions) -> None:
        self.root, self.manifest, self.options = root, manifest, options
        self.fields = {name: manifest.fields[name] for name in options.fields}
        self.stats = {name: values for name, values in manifest.stats[options.split].items() if name in self.fields}
        view = options.layout, options.window, options.stride, options.dtype
        self._columns = [Column(name, manifest, *view) for name in self.fields]
        cache = None
        if isinstance(root, Url) and options.cache_dir is not None:
            cache = Cache(Path(options.cache_dir), options.cache_bytes)
        self._files = SplitFiles(root, manifest, options.split, cache, options.verify == "checksum")
        self._count, self._frames = manifest.splits[options.split], manifest.frames[options.split]

    def __reduce__(self) -> tuple[Any, ...]:
        return Dataset, (self.root, self.manifest, self.options)

    @property
    def snapshot(self) -> str:
        """Which of the states of a dataset that grows this is: the manifest's sha256."""
        return self.manifest.sha256

    def at(self, snapshot: Snapshot) -> "Dataset":
        """The dataset as it was at an earlier snapshot, while that is there.

        Raises FolderError where it is not, and ConfigError where the snapshot is of another dataset.
        """
        if snapshot == self.snapshot:
            return self
        if not isinstance(snapshot, str):
            raise ConfigError(f"the state is of several datasets, but {self.root} is one")
        manifest = read_manifest(self.root, snapshot)
        if manifest.identity != self.manifest.identity or self.options.split not in manifest.splits:
            raise ConfigError(f"the state is of another dataset than {self.root}")
        return Dataset(self.root, manifest, self.options)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, key: Key) -> Batch:
        """One video, or for a slice or a sequence of numbers several, stacked."""
        return item(self, key)

    def __getitems__(self, indices: Numbers) -> list[Batch]:
        """The videos one by one; torch's DataLoader asks for a whole batch so."""
        return unbatch(self.batch(indices))

    def __repr__(self) -> str:
        return f"<{len(self)} {self.options.split} videos of {self.root}: {', '.join(self.fields)}>"

    @property
    def time(self) -> np.ndarray:
        """The time of every frame of a whole video, s, float64 [T]."""
        return self.manifest.constants["time"][: self._frames]

    def batch(self, indices: Numbers, starts: Numbers | None = None, out: Batch | None = None) -> Batch:
        """The videos with these numbers, stacked; windows begin at `starts`; `out` is filled if given."""
        return filled(self, self.numbers(indices), starts, out)

    def empty(self, count: int) -> Batch:
        """A batch of `count` videos that is yet to be filled."""
        try:
            return {column.name: np.empty((count, *column.shape), column.dtype) for column in self._columns}
        except (MemoryError, ValueError):  # NumPy's words for more than there is, and for more than can be
            size = sum(math.prod((count, *column.shape)) * column.dtype.itemsize for column in self._columns)
            raise UserError(f"{self.root}: {count} videos take {in_bytes(size)}, more than there is memory") from None

    def fill(self, out: Batch, rows: Numbers, indices: Numbers, starts: Numbers | None = None) -> None:
        """Returns nothing; puts the videos into these rows of `out`. Threads may fill one batch together."""
        numbers = self.numbers(indices)
        first = np.full(len(numbers), self.options.first) if starts is None else np.asarray(starts)
        last = self._frames - self.options.span
        if first.shape != numbers.shape or ((first < 0) | (first > last)).any():
            raise ConfigError(f"starts must be a frame from 0 to {last} for each video, but are {first.tolist()}")
        begins, targets = first.tolist(), np.asarray(rows).tolist()
        with self._named(numbers):
            videos = self._files.videos(numbers)
            places = [self._files.pieces(column, numbers, videos, begins) for column in self._columns]
            read = self._files.reader(places)
        for column, own in zip(self._columns, places, strict=True):
            whole = None if column.is_direct else np.empty((1, *column.stored), column.field.dtype)
            for step, pieces in enumerate(own):
                target = out[column.name][targets[step] : targets[step] + 1]
                into, begin = target if whole is None else whole, begins[step]
                for number, piece in zip(column.needed(begin), pieces, strict=True):
                    self._read(read, column, piece, int(numbers[step]), column.part(into, number))
                if whole is not None:
                    column.convert(whole, begin, target)

    @contextlib.contextmanager
    def _named(self, numbers: np.ndarray) -> Iterator[None]:
        """A block that looks up videos; what goes wrong says of which."""
        try:
            yield
        except DamagedError as error:
            which = f"video {numbers[0]}" if len(numbers) == 1 else f"videos {numbers.min()} to {numbers.max()}"
            raise DamagedError(f"{error} (looking up {self.options.split} {which}): {_HINT}") from None

    def _read(self, read: Reader, column: Column, piece: Chunk, video: int, target: np.ndarray) -> None:
        try:
            data = read(column, piece, target)
            if self.options.verify == "checksum" and codecs.crc32(data) != piece.crc32:
                raise DamagedError("its checksum differs")
            if isinstance(data, bytes):
                codecs.decode_into(column.codec, data, target)
        except (DamagedError, UserError, UnreachableError, OSError) as error:
            path = self._files.path(shard_name(self._files.shard(piece.shard).shard.name))
            where = f"{path}: {column.name} of {self.options.split} video {video} cannot be read ({reason(error)})"
            if isinstance(error, DamagedError):
                raise DamagedError(f"{where}: {_HINT}") from error
            if isinstance(error, UserError | UnreachableError):
                raise type(error)(where) from error
            raise (FolderError if isinstance(error, FileNotFoundError) else UnreachableError)(where) from error

    def numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray:
        """The numbers of the videos at these positions of an epoch: in order, or as the seed shuffles them."""
        return shuffled(seed, epoch, positions, len(self))

    def starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
        """Where the windows of these videos begin, drawn by random bits; None if that is not random."""
        return self.options.starts(bits, self._frames)

    def numbers(self, indices: Numbers) -> np.ndarray:
        """Indices as the numbers of videos, int64: negative ones count from the end."""
        return checked_numbers(indices, len(self), self.options.split)


def _joined(datasets: Sequence[Dataset]) -> ConcatDataset:
    """The datasets as one. Raises ConfigError where they are not of one recipe."""
    if not datasets:
        raise ConfigError("path is an empty list, but must name one dataset or more")
    facts = [dict(_facts(ds)) for ds in datasets]
    for ds, own in zip(datasets, facts, strict=True):
        for name in sorted(facts[0].keys() | own.keys()):
            here, first = own.get(name, "missing"), facts[0].get(name, "missing")
            if here != first:
                told = f"{ds.root}: {name} is {here}, but in {datasets[0].root} {first}"
                raise ConfigError(f"{told}: what is opened as one dataset must agree in split, fields, sizes and fps")
    return ConcatDataset(datasets)


def _facts(ds: Dataset) -> Iterator[tuple[str, Any]]:
    """What datasets that are opened as one must agree in, by name."""
    yield "split", ds.options.split
    yield "fps", ds.manifest.fps
    yield from ((f"size {axis}", size) for axis, size in ds.manifest.sizes.items())
    for name, field in ds.fields.items():
        yield f"field {name}", f"{field.dtype} {field.axes}, {field.unit or 'no unit'}"


def _chosen_split(root: Place, manifest: Manifest, split: str | None) -> str:
    splits = manifest.splits
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


def _check_cache(options: ViewOptions, largest: int) -> None:
    if options.cache_bytes is None:
        return
    if options.cache_dir is None:
        raise ConfigError(f"cache_bytes is {options.cache_bytes}, but there is no cache: say cache_dir=")
    if options.cache_bytes < largest:
        raise ConfigError(f"cache_bytes is {options.cache_bytes}, but must be {largest} or more, for the largest shard")
