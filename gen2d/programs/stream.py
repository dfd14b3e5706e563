"""Batches of videos that are simulated and rendered on the device on demand, without a dataset.

    for batch in gen2d.stream("bouncing.yaml", seed=0, batch_size=32): ...

Videos are simulated by the program that also generates datasets, in batches of the same size. They are rendered in
cells (micro-batches), one or several per delivered batch.
"""

import dataclasses
import functools
import importlib
import itertools
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.config.config import Config, checked_seed, load_config
from gen2d.core.errors import ConfigError
from gen2d.core.progress import waiting
from gen2d.core.schema import Field
from gen2d.core.sizes import divisor
from gen2d.loading.column import LAYOUTS
from gen2d.loading.dataloader import without_text
from gen2d.loading.dataset import ViewOptions, select_fields, window_fields
from gen2d.loading.epochs import EpochSampler, GlobalBatch, check_one_of, epoch_indices
from gen2d.programs import devices
from gen2d.programs.rollout import DeviceBatch
from gen2d.programs.source import Request, VideoSource
from gen2d.records.axes import Array
from gen2d.records.keys import MAX_VIDEOS

Arrays = dict[str, Any]
# A table, because XLA would multiply by 1 / 255, which rounds differently.
UINT8_TO_FLOAT = np.arange(256, dtype=np.float32) / np.float32(255)


def stream(
    config: Config | Mapping[str, object] | str | Path,
    seed: int | None = None,
    batch_size: int = 32,
    *,
    n: int | None = None,
    split: str = "train",
    overrides: Sequence[str] = (),
    fields: Sequence[str] | None = None,
    window: int | None = None,
    stride: int = 1,
    start: str | int = "random",
    layout: str = "THWC",
    dtype: str = "uint8",
    shuffle: bool | str = False,
    order_seed: int = 0,
    epochs: int | None = None,
    rank: int | None = None,
    world_size: int | None = None,
    drop_last: bool = True,
    to: str = "jax",
    device: str = "auto",
) -> "Stream":
    """Batches of videos that are simulated and rendered on the device, inside the training loop.

    The batches equal, frame for frame, those of `DataLoader(open(folder, split, fields, window, ...), batch_size,
    order_seed, shuffle, ...)` for the dataset that `generate(config, n, folder, seed=seed, split=split)` writes, and
    have the same `state_dict`.

    Parameters
    ----------
    config : Config, mapping, str or Path
        A config, or the name or path of its file.
    seed : int, optional
        Seed of the videos; by default that of the config.
    batch_size : int
        Number of videos in a batch of this rank.
    n : int, optional
        Number of videos, from 1 to 2**32 - 1; by default new videos never end.
    split : str
        Name of the split.
    overrides : sequence of str
        Options of the config to change, such as 'physics.substeps=8'.
    fields : sequence of str, optional
        Names or patterns of fields; by default "frames" and "states/*".
    window : int, optional
        Number of frames of each video in a batch; by default all. Batches of windows also hold `window/start` and
        `window/time`, as those of `open`.
    stride : int
        Distance of the window's frames, in frames.
    start : int or str
        First frame of the window: a number, "first", or "random", which is sampled for each video and epoch.
    layout : str
        Order of the axes of images, such as "THWC" or "TCHW".
    dtype : str
        Type of the frames: "uint8", or "float32" from 0 to 1.
    shuffle : bool or str
        "global" (or True) to shuffle the videos in each epoch.
    order_seed : int
        Seed of the order and of random windows.
    epochs : int, optional
        Number of epochs of an iteration; by default without end.
    rank, world_size : int, optional
        Rank of this process and number of processes; by default those that torchrun sets, or a single process.
    drop_last : bool
        Whether to drop the last videos of an epoch that fill no batch of all ranks.
    to : str
        "jax", or "torch" for tensors that share the same memory by DLPack. With "jax", numbers of 64 bits are rounded
        to 32, unless jax is in its 64-bit mode. Text is an array of bytes in NumPy.
    device : str
        "auto", "cpu" or "gpu".

    Returns
    -------
    Stream
        An iterable of dictionaries of arrays [batch_size, ...] by field, whose position can be saved and restored.

    Raises
    ------
    ConfigError
        If the config or an argument is invalid.
    DeviceError
        If there is no such device.
    NoPlaceError
        If the objects of a video do not fit; raised during iteration, as is NoVideoError.

    Examples
    --------
    >>> videos = gen2d.stream("bouncing.yaml", seed=0, batch_size=32, window=16)  # without an end
    >>> batch = next(iter(videos))
    >>> batch["frames"].shape  # a jax array
    (32, 16, 64, 64, 3)
    """
    config = load_config(config, overrides)
    if seed is not None:
        config = dataclasses.replace(config, seed=checked_seed(seed))
    check_one_of("to", to, tuple(_CONVERTERS))
    source = _source(config.of_split(split), device)
    names = select_fields(config.name, source.schema.fields, fields)
    frames = config.frames_of(split)
    options = ViewOptions(split, names, window, stride, start, layout, dtype, "none").within(
        frames, config.video.frames
    )
    if n is not None and not 1 <= n <= MAX_VIDEOS:
        raise ConfigError(f"n is {n}, but must be from 1 to 2**32 - 1, or None")
    count = MAX_VIDEOS if n is None else n
    epoch_sampler = EpochSampler(count, batch_size, order_seed, shuffle, epochs, rank, world_size, drop_last)
    return Stream(source, options, epoch_sampler, batch_size, to, frames)


@functools.lru_cache(maxsize=4)
def _source(config: Config, device: str) -> VideoSource:
    """Video source of a config; its programs are compiled when they first run."""
    return VideoSource(config, devices.prepare(device)[:1])


class _Cell(NamedTuple):
    """A micro-batch: videos that are rendered together, padded with copies of the last."""

    step: GlobalBatch
    videos: int  # without padding
    numbers: np.ndarray  # uint32
    starts: np.ndarray  # first frame of each video's window
    is_last: bool  # whether it is the last of its batch


class Stream:
    """Resumable iterable of batches, which `stream` returns."""

    def __init__(
        self,
        source: VideoSource,
        options: ViewOptions,
        epoch_sampler: EpochSampler,
        batch_size: int,
        to: str,
        frames: int,
    ) -> None:
        self.source, self.options, self.epoch_sampler = source, options, epoch_sampler
        self.to, self._frames = to, frames
        self.fields = {name: source.schema.fields[name] for name in options.fields}
        self.cell = cell_size(batch_size, source.rollout.batch_size)
        self._jitted_cell_views = jax.jit(self._cell_views)

    def __len__(self) -> int:
        """Number of batches in one epoch."""
        return len(self.epoch_sampler)

    def __iter__(self) -> Iterator[Arrays]:
        batches = self._batches()
        with waiting(f"Compiling, and simulating the first batch of {self.source.config.name}"):
            first = next(batches, None)
        if first is not None:
            yield first
            yield from batches

    def state_dict(self) -> dict[str, Any]:
        """State of the iteration, after the last batch that was delivered."""
        return self.epoch_sampler.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue the next iteration from this state of a stream or a DataLoader."""
        self.epoch_sampler.load_state_dict(state)

    def _batches(self) -> Generator[Arrays, None, None]:
        parts: list[Arrays] = []
        cells: deque[_Cell] = deque()
        for _, (batch,) in self.source.batches(self._requests(cells), ahead=1):  # the next is simulated meanwhile
            for index in range(min(len(cells), self.source.rollout.batch_size // self.cell)):
                cell = cells.popleft()
                parts.append(self._cell_fields(batch, index * self.cell, cell))
                if cell.is_last:
                    fields = parts[0] if len(parts) == 1 else {k: _concatenate([p[k] for p in parts]) for k in parts[0]}
                    parts = []
                    self.epoch_sampler.advance(cell.step)
                    yield _CONVERTERS[self.to](fields)
        self.epoch_sampler.finish()

    def _cells(self) -> Iterator[_Cell]:
        for step in self.epoch_sampler.steps():
            positions = self.epoch_sampler.rank_positions(step)
            numbers = epoch_indices(self.epoch_sampler.shuffled_by, step.epoch, positions, self.epoch_sampler.videos)
            starts = self.options.starts(self.epoch_sampler.window_bits(step, positions), self._frames)
            starts = np.full(len(numbers), self.options.first) if starts is None else starts
            count = len(numbers)  # a rank's share may be empty
            for begin in range(0, max(count, 1), self.cell):
                end, rows = min(begin + self.cell, count), np.arange(begin, begin + self.cell)
                numbers, starts = (a if count else np.zeros(1, np.int64) for a in (numbers, starts))
                rows = np.minimum(rows, len(numbers) - 1)
                yield _Cell(step, end - begin, numbers[rows].astype(np.uint32), starts[rows], end == count)

    def _requests(self, requested: deque[_Cell]) -> Iterator[Request]:
        """Requests for groups of cells that are simulated together; their cells are appended to `requested`."""
        cells, number = self._cells(), self.source.rollout.batch_size // self.cell
        while group := list(itertools.islice(cells, number)):
            requested.extend(group)
            numbers = np.concatenate([group[min(i, len(group) - 1)].numbers for i in range(number)])
            yield Request(self.options.split, numbers, np.ones(len(numbers), bool))

    def _cell_fields(self, batch: DeviceBatch, row: int, cell: _Cell) -> Arrays:
        """Fields of a cell's videos, ready for delivery."""
        columns = {name: batch.columns[name] for name in self.fields if name in batch.columns}
        host_fields = self.fields.keys() & self.source.schema.host_fields.keys()
        if self.fields.keys() - batch.columns.keys() - host_fields - {"index"}:
            columns |= self._render_cell(batch, row)
        numbers, starts = jnp.asarray(cell.numbers.astype(np.int32)), jnp.asarray(cell.starts, jnp.int32)
        with jax.enable_x64(self.source.config.physics.x64):
            fields = self._jitted_cell_views(columns, numbers, starts, np.int32(row))
        windows = window_fields(cell.starts, self.options, self.source.schema.constants["time"])
        with jax.enable_x64(True):  # each array type rounds 64 bits as it does those of a DataLoader
            fields |= {name: jnp.asarray(values) for name, values in (windows or {}).items()}
        fields |= self._host_fields(batch, row, host_fields) if host_fields else {}
        return fields if cell.videos == self.cell else {name: array[: cell.videos] for name, array in fields.items()}

    def _host_fields(self, batch: DeviceBatch, row: int, names: Set[str]) -> Arrays:
        """Host-computed fields of a cell; text stays on the host."""
        columns = self.source.rollout.host_columns([batch])[0]
        cell_columns = {name: column[row : row + self.cell] for name, column in columns.items()}
        fields = self.source.schema.host_columns(cell_columns, self.options.split)
        return {name: v if self.fields[name].is_text else jnp.asarray(v) for name, v in fields.items() if name in names}

    def _render_cell(self, batch: DeviceBatch, row: int) -> Arrays:
        """Rendered fields of a cell, computed in slices that fit the cache."""
        size = divisor(self.cell, self.source.rollout.slice)
        parts = [self.source.rollout.draw([batch], start, size)[0] for start in range(row, row + self.cell, size)]
        names = self.fields.keys() & parts[0].keys()
        return {name: jnp.concatenate([part[name] for part in parts]) for name in names}

    def _cell_views(self, columns: Arrays, numbers: Array, starts: Array, row: Array) -> Arrays:
        """Fields of a cell with the requested windows, layout and type; `columns` may hold the whole batch."""
        views = {}
        for name, field in self.fields.items():
            if name not in columns and name != "index":
                continue  # computed on the host
            values = numbers if name == "index" else columns[name]
            if len(values) != self.cell:
                values = jax.lax.dynamic_slice_in_dim(values, row, self.cell)
            views[name] = _apply_view(name, field, values, starts, self.options)
        return views


def cell_size(batch_size: int, simulated: int) -> int:
    """Largest number of videos in a cell that divides the simulated batch and wastes at most an eighth of them."""
    sizes = [size for size in range(1, min(batch_size, simulated) * 2) if simulated % size == 0]
    return max(size for size in sizes if -(-batch_size // size) * size <= batch_size * 9 / 8)


def _concatenate(parts: list[Any]) -> Any:
    return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else jnp.concatenate(parts)


def _apply_view(name: str, field: Field, values: Array, starts: Array, options: ViewOptions) -> Array:
    """Values of videos [m, ...] with the requested windows, layout and type."""
    axes = field.axes.split()[1:]
    if options.window is not None and axes[:1] == ["T"]:
        frames = starts[:, None] + options.stride * jnp.arange(options.window)
        values = jax.vmap(lambda video, frames: video[frames])(values, frames)
    if field.is_image and len(axes) == 4:
        values = values.transpose(0, *(1 + axis for axis in LAYOUTS[options.layout]))
    if name == "frames" and options.dtype == "float32":
        values = jnp.asarray(UINT8_TO_FLOAT)[values.astype(jnp.int32)]
    return values


def _to_jax(batch: Arrays) -> Arrays:
    """The batch in the types that jax has in its present mode, as from a `DataLoader`."""
    numbers, text = without_text(batch)
    return {name: values.astype(jax.dtypes.canonicalize_dtype(values.dtype)) for name, values in numbers.items()} | text


def _to_torch(batch: Arrays) -> Arrays:
    torch = importlib.import_module("torch")
    numbers, text = without_text(batch)
    return {name: torch.from_dlpack(values) for name, values in numbers.items()} | text


# Conversions of a batch, by the value of `to`.
_CONVERTERS = {"jax": _to_jax, "torch": _to_torch}
