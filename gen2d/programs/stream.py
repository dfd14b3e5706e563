"""The batches that a dataset would give, without the dataset: simulated and drawn on the device as they are asked for.

    for batch in gen2d.stream("bouncing.yaml", seed=0, batch_size=32): ...

Videos are simulated by the program that also makes datasets, as many at a time as there, and rendered in parts: a
cell, which holds all videos of a batch, or some.
"""

import dataclasses
import functools
import importlib
import itertools
from collections.abc import Generator, Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.config.config import Config, checked_seed, load_config
from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.loading.column import LAYOUTS
from gen2d.loading.dataloader import without_text
from gen2d.loading.dataset import ViewOptions, chosen_fields
from gen2d.loading.epochs import EpochSampler, GlobalBatch, one_of, shuffled
from gen2d.programs import devices
from gen2d.programs.batches import check_placed
from gen2d.programs.rollout import DeviceBatch, Rollout, divisor
from gen2d.records.axes import Array
from gen2d.records.keys import MAX_VIDEOS

Arrays = dict[str, Any]
SHARES = np.arange(256, dtype=np.float32) / np.float32(255)  # XLA would multiply, which rounds otherwise


def stream(
    config: Config | Mapping | str | Path,
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
    """Batches as dictionaries of arrays on the device, made inside the training loop.

    Those that `DataLoader(open(folder, split, fields, window, ...), batch_size, order_seed, shuffle, ...)` gives of the
    dataset that `generate(config, n, folder, seed=seed, split=split)` makes, frame for frame, with the same
    `state_dict`. Without `n` there is no end of new videos. `to` is "jax" or "torch" (the same memory, by DLPack); text
    is NumPy's bytes in both.
    Raises ConfigError and, where a scene does not fit, NoPlaceError (all UserError).
    """
    config = load_config(config, overrides)
    if seed is not None:
        config = dataclasses.replace(config, seed=checked_seed(seed))
    one_of("to", to, tuple(_DELIVER))
    rollout = _rollout(config.of_split(split), device)
    names = chosen_fields(config.name, rollout.fields, fields)
    frames = config.frames_of(split)
    options = ViewOptions(split, names, window, stride, start, layout, dtype, "none").within(
        frames, config.video.frames
    )
    if n is not None and not 1 <= n <= MAX_VIDEOS:
        raise ConfigError(f"n is {n}, but must be from 1 to 2**32 - 1, or None")
    count = MAX_VIDEOS if n is None else n
    walk = EpochSampler(count, batch_size, order_seed, shuffle, epochs, rank, world_size, drop_last)
    return Stream(rollout, options, walk, batch_size, to, frames)


@functools.lru_cache(maxsize=4)
def _rollout(config: Config, device: str) -> Rollout:
    """The programs of a config, which are compiled when they first run."""
    return Rollout(config, devices.prepare(device)[:1])


class _Cell(NamedTuple):
    """Videos that are drawn together; if they are fewer than fit, the last is repeated."""

    step: GlobalBatch
    videos: int
    numbers: np.ndarray  # uint32
    starts: np.ndarray  # frame at which each video's window begins
    ends: bool  # its batch


class Stream:
    """Batches without end, or of some epochs, from wherever the state says."""

    def __init__(
        self, rollout: Rollout, options: ViewOptions, walk: EpochSampler, batch_size: int, to: str, frames: int
    ) -> None:
        self.rollout, self.options, self.walk, self.to, self._frames = rollout, options, walk, to, frames
        self.fields = {name: rollout.fields[name] for name in options.fields}
        self.cell = cell_size(batch_size, rollout.batch_size)
        self._view = jax.jit(self._viewed)

    def __len__(self) -> int:
        """The number of batches in one epoch."""
        return len(self.walk)

    def __iter__(self) -> Iterator[Arrays]:
        return self._batches()

    def state_dict(self) -> dict[str, Any]:
        """Where the iteration stands: what has been delivered."""
        return self.walk.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Returns nothing; the next iteration goes on where `state` was taken, of a stream or of a DataLoader."""
        self.walk.load_state_dict(state)

    def _batches(self) -> Generator[Arrays, None, None]:
        parts: list[Arrays] = []
        for cells, batch in self._simulated():
            for place, cell in enumerate(cells):
                parts.append(self._drawn(batch, place * self.cell, cell))
                if cell.ends:
                    made = parts[0] if len(parts) == 1 else {k: _joined([p[k] for p in parts]) for k in parts[0]}
                    parts = []
                    self.walk.passed(cell.step)
                    yield _DELIVER[self.to](made)

    def _cells(self) -> Iterator[_Cell]:
        for step in self.walk.steps():
            positions = self.walk.share(step)
            numbers = shuffled(self.walk.shuffled_by, step.epoch, positions, self.walk.videos)
            first = self.options.starts(self.walk.bits(step, positions), self._frames)
            first = np.full(len(numbers), self.options.first) if first is None else first
            real = len(numbers)  # a rank's share may be empty
            for begin in range(0, max(real, 1), self.cell):
                end, held = min(begin + self.cell, real), np.arange(begin, begin + self.cell)
                numbers, first = (a if real else np.zeros(1, np.int64) for a in (numbers, first))
                held = np.minimum(held, len(numbers) - 1)
                yield _Cell(step, end - begin, numbers[held].astype(np.uint32), first[held], end == real)

    def _simulated(self) -> Iterator[tuple[list[_Cell], DeviceBatch]]:
        """The cells in groups that are simulated together; the next is begun before one is drawn."""
        cells, number = self._cells(), self.rollout.batch_size // self.cell
        before = None
        while group := list(itertools.islice(cells, number)):
            held = [group[min(i, len(group) - 1)].numbers for i in range(number)]
            numbers = np.concatenate(held)
            after = group, numbers, self.rollout.begin_with(self.options.split, numbers)
            if before is not None:
                yield self._checked(*before)
            before = after
        if before is not None:
            yield self._checked(*before)

    def _checked(self, cells: list[_Cell], numbers: np.ndarray, batch: DeviceBatch) -> tuple[list[_Cell], DeviceBatch]:
        check_placed(self.rollout.config.scene, np.asarray(batch.placed), numbers)
        return cells, batch

    def _drawn(self, batch: DeviceBatch, lane: int, cell: _Cell) -> Arrays:
        """A cell's videos as they are delivered."""
        found = {name: batch.columns[name] for name in self.fields if name in batch.columns}
        told = self.fields.keys() & self.rollout.word_fields.keys()
        if self.fields.keys() - batch.columns.keys() - told - {"index"}:
            found |= self._pictures(batch, lane)
        numbers, starts = jnp.asarray(cell.numbers.astype(np.int32)), jnp.asarray(cell.starts, jnp.int32)
        made = self._view(found, numbers, starts, np.int32(lane))
        made |= self._words(batch, lane, told) if told else {}
        return made if cell.videos == self.cell else {name: array[: cell.videos] for name, array in made.items()}

    def _words(self, batch: DeviceBatch, lane: int, wanted: Set[str]) -> Arrays:
        """What is told of a cell, on the host; text stays there."""
        columns = self.rollout.host_columns(batch)[0]
        own = {name: column[lane : lane + self.cell] for name, column in columns.items()}
        told = self.rollout.host_fields(own, self.options.split)
        return {name: v if self.fields[name].is_text else jnp.asarray(v) for name, v in told.items() if name in wanted}

    def _pictures(self, batch: DeviceBatch, lane: int) -> Arrays:
        """What is drawn of a cell, in slices that fit the cache."""
        size = divisor(self.cell, self.rollout.slice)
        parts = [self.rollout.draw(batch, start, size)[0] for start in range(lane, lane + self.cell, size)]
        wanted = self.fields.keys() & parts[0].keys()
        return {name: jnp.concatenate([part[name] for part in parts]) for name in wanted}

    def _viewed(self, found: Arrays, numbers: Array, starts: Array, lane: Array) -> Arrays:
        """The fields of a cell with windows, layout and type as asked for; columns are of the whole batch."""
        made = {}
        for name, field in self.fields.items():
            if name not in found and name != "index":
                continue  # it is made on the host
            values = numbers if name == "index" else found[name]
            if len(values) != self.cell:
                values = jax.lax.dynamic_slice_in_dim(values, lane, self.cell)
            made[name] = _as_asked(name, field, values, starts, self.options)
        return made


def cell_size(batch_size: int, simulated: int) -> int:
    """How many videos a cell holds: as many as possible, so that at most an eighth of what is made is left over."""
    sizes = [size for size in range(1, min(batch_size, simulated) * 2) if simulated % size == 0]
    return max(size for size in sizes if -(-batch_size // size) * size <= batch_size * 9 / 8)


def _joined(parts: list[Any]) -> Any:
    return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else jnp.concatenate(parts)


def _as_asked(name: str, field: Field, values: Array, starts: Array, options: ViewOptions) -> Array:
    """Videos [m, ...] with windows, layout and type as asked for."""
    axes = field.axes.split()[1:]
    if options.window is not None and axes[:1] == ["T"]:
        frames = starts[:, None] + options.stride * jnp.arange(options.window)
        values = jax.vmap(lambda video, frames: video[frames])(values, frames)
    if field.is_image and len(axes) == 4:
        values = values.transpose(0, *(1 + axis for axis in LAYOUTS[options.layout]))
    if name == "frames" and options.dtype == "float32":
        values = jnp.asarray(SHARES)[values.astype(jnp.int32)]
    return values


def _to_torch(batch: Arrays) -> Arrays:
    torch = importlib.import_module("torch")
    numbers, text = without_text(batch)
    return {name: torch.from_dlpack(values) for name, values in numbers.items()} | text


# How batches are handed out, by the value of `to`.
_DELIVER = {"jax": lambda batch: batch, "torch": _to_torch}
