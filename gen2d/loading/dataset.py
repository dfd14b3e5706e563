"""Datasets for reading: `open`, and `Dataset` with videos by index and batches.

Neither jax nor h5py is imported, and no file descriptor is shared across a fork, so fork and spawn are both safe. Only
frames that must be rendered need jax, and a process that was not forked.
"""

import contextlib
import dataclasses
import fnmatch
import math
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, TypeVar, overload

import numpy as np

from gen2d.core.errors import ConfigError, DamagedError, FolderError, UnreachableError, UserError
from gen2d.core.humanize import in_bytes
from gen2d.core.schema import Field
from gen2d.dataset.manifest import Manifest, read_manifest
from gen2d.dataset.spec import shard_name
from gen2d.loading.chunks import Chunk, Reader, SplitFiles
from gen2d.loading.column import LAYOUTS, Column
from gen2d.loading.concat import ConcatDataset
from gen2d.loading.epochs import check_one_of, epoch_indices
from gen2d.loading.fields import suggestion
from gen2d.loading.protocols import Batch, Key, Numbers, Snapshot, checked_numbers, item, read_batch, unbatch
from gen2d.loading.selection import Selectable
from gen2d.storage import codecs
from gen2d.storage.cache import Cache
from gen2d.storage.explain import reason
from gen2d.storage.paths import Place, Url, place
from gen2d.storage.retries import Network

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
    render: "RenderOptions | None" = None,
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
    render: "RenderOptions | None" = None,
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
    render: "RenderOptions | None" = None,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> "Dataset | ConcatDataset":
    """Open one split of a complete dataset for reading.

    A dataset may grow while it is read; the opened `Dataset` keeps the videos that it had when it was opened. Files are
    opened when videos are read, which raises the errors of `Dataset.batch`.

    Parameters
    ----------
    path : str, Path, or list or tuple of these
        Folder, or URL of a protocol of fsspec. Several paths open as one concatenated dataset; the datasets must agree
        in split, fields, sizes and frame rate, and may differ in their seeds.
    split : str, optional
        Name of the split. The default is "train", or the only split.
    fields : sequence of str, optional
        Names or patterns of fields, such as "states/*". The default is the frames, where stored, and all states. If
        "frames" is named but not stored, frames are rendered when they are read.
    window : int, optional
        Number of frames in a window. By default a video is returned whole. Batches of windows also hold
        `window/start`, the first frame of each window, int64 [n], and `window/time`, the times of its frames in s,
        float64 [n, window].
    stride : int
        Distance between the frames of a window, in frames of the video.
    start : "random", "first" or int
        First frame of a window. With "random", `DataLoader`, `gen2d.torch` and `gen2d.grain` sample it for each video
        and epoch, and reading by index needs `Dataset.batch(indices, starts)`. 0 and "first" are the same.
    layout : "THWC", "TCHW" or "CTHW"
        Order of the axes of images with channels.
    dtype : "uint8" or "float32"
        Type of the frames; float32 values are from 0 to 1. Other fields keep their stored type.
    verify : "checksum" or "none"
        With "checksum", every chunk is verified when it is read, so damaged data is never returned.
    cache_dir : str or Path, optional
        Folder that keeps whole shards of a dataset at a URL. Several processes and datasets may share it.
    cache_bytes : int, optional
        Maximum size of the cache in bytes, without downloads in progress. The least recently used shards are removed
        first. By default the size is not limited.
    snapshot : str, optional
        An earlier `Dataset.snapshot`, to open the dataset as it was before it grew last. Only for a single path.
    render : RenderOptions, optional
        Arguments of `gen2d.render`, such as `{"height": 128, "width": 128, "look": "shaded"}`, with which frames and
        pixel annotations are rendered even if they are stored. With `{}`, only those that are not stored are rendered.
        `Dataset.exact` says whether they are those of the dataset to the bit. Rendering imports jax and compiles a
        program when the first video is read; it does not work in processes that are forked afterwards.
    timeout : float
        Maximum time, in s, to wait for a server to connect or to send the next part of an answer.
    deadline : float
        Maximum time, in s, of a request with all its attempts. Large downloads may take longer.

    Returns
    -------
    Dataset or ConcatDataset
        A `Dataset` for one path, a `ConcatDataset` for a list or tuple of paths.

    Raises
    ------
    ConfigError
        If an argument is invalid, or if the datasets of several paths do not agree.
    UntrustedError
        If rendering needs code of the dataset that is not in `render["trust"]`.
    FolderError
        If the folder cannot be read, holds no complete dataset (IncompleteError), or no longer has the snapshot.
    DamagedError
        If the manifest is damaged.
    UnreachableError
        If a server or disk does not answer.

    Examples
    --------
    >>> ds = gen2d.open("datasets/bouncing", fields=["frames", "states/position"], window=16, start=0, dtype="float32")
    >>> ds[0]["frames"].shape  # [T, H, W, C]
    (16, 64, 64, 3)
    >>> ds[:32]["states/position"].shape  # m, [n, T, slot, (x, y)]
    (32, 16, 12, 2)
    """
    if isinstance(path, list | tuple):
        view = split, fields, window, stride, start, layout, dtype, verify, cache_dir, cache_bytes
        if snapshot is not None:
            raise ConfigError("snapshot must be None for a list of datasets")
        return _concatenate([open(one, *view, render=render, timeout=timeout, deadline=deadline) for one in path])
    root = place(path, Network(timeout, deadline))
    manifest = read_manifest(root, snapshot)
    split = _select_split(root, manifest, split)
    if fields is None and render is not None:
        fields = "frames", "states/*"
    named = (fields,) if isinstance(fields, str) else tuple(fields or ())
    renders = render is not None or ("frames" in named and "frames" not in manifest.fields)
    names = named if renders else select_fields(f"{root}", manifest.fields, fields)
    options = ViewOptions(split, names, window, stride, start, layout, dtype, verify, cache_dir, cache_bytes)
    options = options.within(manifest.frames[split], manifest.sizes.get("T", 0))
    _check_cache(options, max(table.largest for table in manifest.tables.values()))
    if not renders:
        return Dataset(root, manifest, options)
    from gen2d.programs.rendered_dataset import RenderedDataset  # imports jax

    return RenderedDataset(root, manifest, options, render)


class RenderOptions(TypedDict, total=False):
    """Options with which frames are rendered; `gen2d.render` describes them."""

    height: int  # px
    width: int
    look: str | Mapping[str, object]
    overrides: Sequence[str]
    trust: str | Sequence[str]


@dataclasses.dataclass(frozen=True)
class ViewOptions:
    """Options with which a dataset was opened; `open` describes them."""

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
    window_fields: bool = True  # whether batches of windows say where the windows lie

    @property
    def first(self) -> int:
        """First frame of windows that are not random."""
        return self.start if isinstance(self.start, int) else 0

    @property
    def is_random(self) -> bool:
        """Whether the first frames of windows are sampled."""
        return self.window is not None and self.start == "random"

    def starts(self, bits: np.ndarray, frames: int) -> np.ndarray | None:
        """First frame of each window, int64 [n], sampled from random bits; None if windows are not random."""
        if not self.is_random:
            return None
        return (bits % np.uint64(frames - self.span + 1)).astype(np.int64)

    @property
    def span(self) -> int:
        """Number of frames from the first to the last of a window, both included; 0 without a window."""
        return 0 if self.window is None else (self.window - 1) * self.stride + 1

    def within(self, frames: int, stored_frames: int) -> "ViewOptions":
        """Options for a split that has the first `frames` of the stored frames.

        Without a window, a shorter split is read through a window of all its frames. Raises ConfigError for invalid
        options, and for windows that are longer than the videos.
        """
        self._check(frames)
        if self.window is not None or frames == stored_frames:
            return self
        return dataclasses.replace(self, window=frames, stride=1, start="first", window_fields=False)

    def _check(self, frames: int) -> None:
        check_one_of("layout", self.layout, tuple(LAYOUTS))
        check_one_of("dtype", self.dtype, ("uint8", "float32"))
        check_one_of("verify", self.verify, ("checksum", "none"))
        if isinstance(self.start, str) and self.start not in ("random", "first"):
            raise ConfigError(f"start is {self.start!r}, but must be 'random', 'first' or a frame's number")
        if isinstance(self.start, int) and self.window is None:
            raise ConfigError(f"start is {self.start}, but without a window all frames are given: say window=")
        for name, low in (("window", 1), ("stride", 1), ("start", 0)):
            value = getattr(self, name)
            if isinstance(value, int) and value < low:
                raise ConfigError(f"{name} is {value}, but must be {low} or more")
        if self.window is not None and self.first + self.span > frames:
            need = f"window {self.window}, stride {self.stride} and start {self.start} need"
            raise ConfigError(f"{need} {self.first + self.span} frames, but the videos have {frames}")


def window_fields(begins: np.ndarray, options: ViewOptions, frame_times: np.ndarray) -> Batch | None:
    """Fields that say where windows lie, from their first frames [n] and the times of all frames, s; None without.

    They are `window/start`, int64 [n], and `window/time`, s, float64 [n, window].
    """
    if options.window is None or not options.window_fields:
        return None
    begins = begins.astype(np.int64)
    return {
        "window/start": begins,
        "window/time": frame_times[begins[:, None] + options.stride * np.arange(options.window)],
    }


_HINT = "gen2d verify finds all such damage"


class Dataset(Selectable):
    """One split of a dataset, as `gen2d.open` returns it; also a map-style dataset for torch and grain.

    `ds[i]` is a video, a dictionary of NumPy arrays by field name; `ds[2:5]` and `ds[[2, 7]]` are batches, whose arrays
    have a leading axis of videos. `info` lists the axes and the unit of each field. A `Dataset` can be pickled, and can
    be read from several threads at once. `select` and `filter` give datasets of some of the videos, `to_pandas` and
    `to_arrow` tables of their values.

    Attributes
    ----------
    fields : dict of str to Field
        dtype, axes, unit and meaning of each field as stored, before window, layout and dtype are applied; `codes` are
        the names of its codes, if it has some.
    splits : dict of str to int
        Number of videos of each split of the dataset.
    config : mapping
        The resolved config of the dataset, as plain values.
    fps : float
        Frames per second.
    stats : dict
        Mean, std, min and max of each component of the frames and states, by field, over the sample that
        `manifest.stats_sampled` describes. Units are those of the stored values: frames are from 0 to 255 even with
        `dtype="float32"`.
    time : ndarray, float64 [T]
        Times of the frames, s.
    sizes : dict of str to int
        Sizes of the axes of the fields, before the window is applied.
    exact : bool
        Whether all fields are those of the dataset to the bit. False only for rendered frames: of another size or look,
        or rendered by other versions or another kind of device, which changes values by a grey level.
    snapshot : str
        sha256 of the manifest, which identifies the current state of a growing dataset.
    root : Path or Url
        Folder or URL of the dataset.
    manifest : Manifest
        Contents of manifest.json: sizes, fps, config, splits, checksums and more.
    options : ViewOptions
        Options with which the dataset was opened.

    Examples
    --------
    >>> ds = gen2d.open("datasets/bouncing")
    >>> video = ds[0]
    >>> video["frames"].shape, video["frames"].dtype
    ((64, 64, 64, 3), dtype('uint8'))
    """

    def __init__(self, root: Place, manifest: Manifest, options: ViewOptions) -> None:
        self.root, self.manifest, self.options = root, manifest, options
        self.fields, self.sizes = {name: manifest.fields[name] for name in options.fields}, dict(manifest.sizes)
        self.stats = {name: values for name, values in manifest.stats[options.split].items() if name in self.fields}
        view = options.layout, options.window, options.stride, options.dtype
        self._slice_size = 1  # videos that are best filled together
        self._columns = self._stored_columns = [Column(name, manifest, *view) for name in self.fields]
        cache = None
        if isinstance(root, Url) and options.cache_dir is not None:
            cache = Cache(Path(options.cache_dir), options.cache_bytes)
        self._files = SplitFiles(root, manifest, options.split, cache, options.verify == "checksum")
        self._count, self._frames = manifest.splits[options.split], manifest.frames[options.split]
        self._frame_times = manifest.constants.get("time", np.arange(self._frames) / manifest.fps)

    def __reduce__(self) -> tuple[Any, ...]:
        return Dataset, (self.root, self.manifest, self.options)

    @property
    def snapshot(self) -> str:
        """sha256 of the manifest, which identifies this state of a growing dataset."""
        return self.manifest.sha256

    def at(self, snapshot: Snapshot) -> "Dataset":
        """The dataset at an earlier snapshot, with the same options.

        Raises FolderError if the folder does not have the snapshot, ConfigError for the snapshots of several datasets.
        """
        if snapshot == self.snapshot:
            return self
        if not isinstance(snapshot, str):
            raise ConfigError(f"the state is of several datasets, but {self.root} is one")
        manifest = read_manifest(self.root, snapshot)
        if manifest.identity != self.manifest.identity or self.options.split not in manifest.splits:
            raise ConfigError(f"the state is of another dataset than {self.root}")
        return self._at(manifest)

    def _at(self, manifest: Manifest) -> "Dataset":
        return Dataset(self.root, manifest, self.options)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, key: Key) -> Batch:
        """One video for an integer, or a batch of videos for a slice or a sequence of integers."""
        return item(self, key)

    def __getitems__(self, indices: Numbers) -> list[Batch]:
        """List of videos; torch's DataLoader calls this method once per batch."""
        return unbatch(self.batch(indices))

    @property
    def splits(self) -> dict[str, int]:
        """Number of videos of each split of the dataset."""
        return dict(self.manifest.splits)

    @property
    def config(self) -> Mapping[str, Any]:
        """The resolved config of the dataset, as plain values."""
        return self.manifest.config

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.manifest.fps

    @property
    def _stored_fields(self) -> Mapping[str, Field]:
        """All stored fields of the dataset, by name, whichever were opened."""
        return self.manifest.fields

    @property
    def _stored_sizes(self) -> Mapping[str, int]:
        """Sizes of the axes of the stored fields."""
        return self.manifest.sizes

    @property
    def _short_name(self) -> str:
        """Name of the dataset for error messages."""
        return f"{self.root}"

    @property
    def _title(self) -> str:
        """First line of the description."""
        return f"{len(self):,} {self.options.split} videos of {self.root}"

    @property
    def _details(self) -> list[str]:
        """Further lines of the description."""
        options, others = self.options, [name for name in self.manifest.splits if name != self.options.split]
        size = f" of {self.sizes['W']} x {self.sizes['H']} px" if {"W", "H"} <= self.sizes.keys() else ""
        lines = [f"{self._frames} frames{size}, {self.fps:g} per second"]
        if options.window is not None and options.window_fields:
            start = "at random" if options.is_random else f"at frame {options.first}"
            lines.append(f"windows of {options.window} frames, {start}, stride {options.stride}")
        lines += [f"layout {options.layout}, frames {options.dtype}"] if "frames" in self.fields else []
        return lines + ([f"other splits: {', '.join(others)}"] if others else [])

    @property
    def exact(self) -> bool:
        """Whether all fields are those of the dataset to the bit."""
        return True

    @property
    def time(self) -> np.ndarray:
        """Times of all frames of a video, s, float64 [T]."""
        return self.manifest.constants["time"][: self._frames]

    def batch(self, indices: Numbers, starts: Numbers | None = None, out: Batch | None = None) -> Batch:
        """Batch of the videos with these indices.

        Parameters
        ----------
        indices : sequence of int [n]
            Indices of the videos; negative ones count from the end.
        starts : sequence of int [n], optional
            First frame of each video's window. The default is the `start` of `open`; "random" has none.
        out : dict of str to ndarray, optional
            Batch to fill, as `empty(n)` returns it. By default a new one is made.

        Returns
        -------
        dict of str to ndarray
            Arrays [n, ...] by field name; `out` if given.

        Raises
        ------
        IndexError, TypeError
            If an index is out of range, or not an integer.
        ConfigError
            If `starts` or `out` do not fit, or if windows are random and `starts` is not given.
        DamagedError
            If stored data differs from what was written.
        FolderError, UnreachableError
            If a file has been moved or removed, or if the disk or server fails.

        Examples
        --------
        >>> batch = ds.batch([3, 1, 4])
        >>> ds.batch([5, 9, 2], out=batch)  # reuses the arrays
        """
        return read_batch(self, self._numbers(indices), starts, out)

    def empty(self, count: int) -> Batch:
        """Uninitialised batch of `count` videos. Raises UserError if it does not fit in memory."""
        try:
            batch = {column.name: np.empty((count, *column.shape), column.dtype) for column in self._columns}
            return batch | (window_fields(np.zeros(count, np.int64), self.options, self._frame_times) or {})
        except (MemoryError, ValueError):  # too large for the memory, too large for NumPy
            size = sum(math.prod((count, *column.shape)) * column.dtype.itemsize for column in self._columns)
            raise UserError(f"{self.root}: {count} videos take {in_bytes(size)}, more than there is memory") from None

    def _fill(self, out: Batch, rows: Numbers, indices: Numbers, starts: Numbers | None = None) -> None:
        """Read the videos with these indices into `out`; raises the errors of `batch`.

        Several threads may fill different rows of one batch.

        Parameters
        ----------
        out : dict of str to ndarray
            Batch from `empty`; its shapes are not checked.
        rows : sequence of int [n]
            Row of `out`, 0 or more, for each video.
        indices : sequence of int [n]
            Indices of the videos; negative ones count from the end.
        starts : sequence of int [n], optional
            First frame of each video's window, as in `batch`.
        """
        numbers = self._numbers(indices)
        first_frames, targets = self._begins(numbers, starts), np.asarray(rows).tolist()
        begins = first_frames.tolist()
        self._fill_window(out, targets, first_frames)
        with self._lookup_errors(numbers):
            videos = self._files.videos(numbers)
            chunks = [self._files.chunks_of(column, numbers, videos, begins) for column in self._stored_columns]
            read = self._files.reader(chunks)
        for column, column_chunks in zip(self._stored_columns, chunks, strict=True):
            scratch = None if column.is_direct else np.empty((1, *column.stored_shape), column.field.dtype)
            for step, video_chunks in enumerate(column_chunks):
                target = out[column.name][targets[step] : targets[step] + 1]
                buffer, begin = target if scratch is None else scratch, begins[step]
                for number, chunk in zip(column.chunk_range(begin), video_chunks, strict=True):
                    self._read(read, column, chunk, int(numbers[step]), column.chunk_view(buffer, number))
                if scratch is not None:
                    column.convert(scratch, begin, target)

    def _stored(self, names: Sequence[str], indices: Numbers) -> Batch:
        """Stored values of whole videos, [n, ...] by field name, whatever was opened; raises the errors of `batch`.

        Parameters
        ----------
        names : sequence of str
            Names of stored fields.
        indices : sequence of int [n]
            Indices of the videos.
        """
        whole = {"window": None, "stride": 1, "start": "first", "layout": "THWC", "dtype": "uint8"}
        options = dataclasses.replace(self.options, fields=tuple(names), **whole)
        return Dataset(self.root, self.manifest, options).batch(indices)

    def _begins(self, numbers: np.ndarray, starts: Numbers | None) -> np.ndarray:
        """First frame of the window of each of these videos. Raises ConfigError if `starts` do not fit."""
        last = self._frames - self.options.span
        if starts is None and self.options.is_random and last > 0 and len(numbers):
            raise ConfigError(
                f"{self.root}: start is 'random', so a window that is read by index has no first frame: use "
                "gen2d.torch.dataset(ds) in torch's DataLoader, gen2d.grain.source(ds) in Grain, or gen2d.DataLoader; "
                "or say ds.batch(indices, starts), or start=0 in gen2d.open"
            )
        first = np.full(len(numbers), self.options.first) if starts is None else np.asarray(starts)
        if first.shape != numbers.shape or ((first < 0) | (first > last)).any():
            raise ConfigError(f"starts must be a frame from 0 to {last} for each video, but are {first.tolist()}")
        return first

    def _fill_window(self, out: Batch, rows: Numbers, begins: np.ndarray) -> None:
        """Write where these windows lie into these rows of a batch."""
        for name, values in (window_fields(begins, self.options, self._frame_times) or {}).items():
            out[name][rows] = values

    @contextlib.contextmanager
    def _lookup_errors(self, numbers: np.ndarray) -> Generator[None]:
        """Context that adds the indices of the videos that are looked up to the message of a DamagedError."""
        try:
            yield
        except DamagedError as error:
            which = f"video {numbers[0]}" if len(numbers) == 1 else f"videos {numbers.min()} to {numbers.max()}"
            raise DamagedError(f"{error} (looking up {self.options.split} {which}): {_HINT}") from None

    def _read(self, read: Reader, column: Column, chunk: Chunk, video: int, target: np.ndarray) -> None:
        try:
            data = read(column, chunk, target)
            if self.options.verify == "checksum" and codecs.crc32(data) != chunk.crc32:
                raise DamagedError("its checksum differs")
            if isinstance(data, bytes):
                codecs.decode_into(column.codec, data, target)
        except (DamagedError, UserError, UnreachableError, OSError) as error:
            path = self._files.path(shard_name(self._files.shard(chunk.shard).shard.name))
            where = f"{path}: {column.name} of {self.options.split} video {video} cannot be read ({reason(error)})"
            if isinstance(error, DamagedError):
                raise DamagedError(f"{where}: {_HINT}") from error
            if isinstance(error, UserError | UnreachableError):
                raise type(error)(where) from error
            raise (FolderError if isinstance(error, FileNotFoundError) else UnreachableError)(where) from error

    def _numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray:
        """Indices of the videos at these positions of an epoch: shuffled by the seed, or in order if it is None."""
        return epoch_indices(seed, epoch, positions, len(self))

    def _starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
        """First frames of the windows of the videos `numbers` [n], int64 [n], sampled from random `bits`, uint64 [n].

        None if windows are not random.
        """
        return self.options.starts(bits, self._frames)

    def _numbers(self, indices: Numbers) -> np.ndarray:
        """Indices from 0 to `len(self) - 1`, int64 [n]; negative indices count from the end.

        Raises TypeError for indices that are not integers, IndexError for indices out of range.
        """
        return checked_numbers(indices, len(self), self.options.split)


def _concatenate(datasets: Sequence[Dataset]) -> ConcatDataset:
    """Concatenation of the datasets. Raises ConfigError if they do not agree in the values of `_required_equal`."""
    if not datasets:
        raise ConfigError("path is an empty list, but must name one dataset or more")
    first_values = dict(_required_equal(datasets[0]))
    for ds in datasets:
        values = dict(_required_equal(ds))
        for name in sorted(first_values.keys() | values.keys()):
            value, first = values.get(name, "missing"), first_values.get(name, "missing")
            if value != first:
                difference = f"{ds.root}: {name} is {value}, but in {datasets[0].root} {first}"
                raise ConfigError(
                    f"{difference}: what is opened as one dataset must agree in split, fields, sizes and fps"
                )
    return ConcatDataset(datasets)


def _required_equal(ds: Dataset) -> Iterator[tuple[str, Any]]:
    """Names and values in which concatenated datasets must agree."""
    yield "split", ds.options.split
    yield "fps", ds.manifest.fps
    yield from ((f"size {axis}", size) for axis, size in ds.sizes.items())
    for name, field in ds.fields.items():
        yield f"field {name}", f"{field.dtype} {field.axes}, {field.unit or 'no unit'}"


def _select_split(root: Place, manifest: Manifest, split: str | None) -> str:
    splits = manifest.splits
    if split is None and len(splits) != 1 and "train" not in splits:
        raise ConfigError(f"{root} has the splits {', '.join(splits)}: say which, as split=")
    if split is None:
        return "train" if "train" in splits else next(iter(splits))
    if split not in splits:
        raise ConfigError(f"{root} has no split {split!r}{suggestion(split, splits)}")
    return split


def select_fields(
    source: str,
    fields: Mapping[str, Field],
    patterns: Sequence[str] | str | None,
    rendered: Collection[str] = (),
) -> tuple[str, ...]:
    """Names of the per-video fields that match the patterns; frames and states if `patterns` is None.

    Fields that can be rendered must be named in full. Raises ConfigError if a pattern matches no field.
    """
    names = [name for name, field in fields.items() if field.per_video]
    if patterns is None:
        patterns = [*({"frames"} & fields.keys()), "states/*"]
    selected: dict[str, None] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        matches = [pattern] if pattern in rendered else fnmatch.filter(names, pattern)
        if not matches:
            known = dict.fromkeys([*names, *rendered])
            raise ConfigError(f"{source} has no field {pattern!r}{suggestion(pattern, known)}")
        selected |= dict.fromkeys(matches)
    return tuple(selected)


def _check_cache(options: ViewOptions, largest: int) -> None:
    if options.cache_bytes is None:
        return
    if options.cache_dir is None:
        raise ConfigError(f"cache_bytes is {options.cache_bytes}, but there is no cache: say cache_dir=")
    if options.cache_bytes < largest:
        raise ConfigError(f"cache_bytes is {options.cache_bytes}, but must be {largest} or more, for the largest shard")
