"""Batches for training, in an order that can be resumed: threads read ahead and fill each batch together.

Nothing is drawn from a generator that has a state: the video and window at each position are computed from seed, epoch
and position, so going on anywhere takes no replay. jax and torch are imported only if batches are wanted in them.
"""

import importlib
import itertools
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from gen2d.errors import ConfigError
from gen2d.loader import Batch, Dataset


class DataLoader:
    """Batches as dictionaries of arrays, each rank its slice of every global batch of `batch_size * world_size`.

    Video and window at each position follow from (seed, epoch, position) alone, so a state is a few numbers and fits
    another world size. An iteration ends when `epochs` epochs are through, and the next goes on with the epochs that
    follow; after `break` or `load_state_dict` it goes on with the batch after the last one delivered.

    `shuffle` is "global" (or True) or False. `remainder` says what happens to the last videos of an epoch that fill no
    global batch: "drop" or "keep" (then the ranks' shares may differ by one, or be empty). `transform` gets each batch
    in a thread, and returns new arrays each time. `to` is "numpy", "torch" or "jax", which has no 64-bit numbers unless
    told to.
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
        _check(to, shuffle, remainder)
        if min(batch_size, world_size, prefetch, threads) < 1 or not 0 <= rank < world_size:
            told = "batch_size, world_size, prefetch and num_threads must be 1 or more, and rank from 0 to"
            raise ConfigError(f"{told} world_size - 1")
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


# How batches are handed out, by the value of `to`.
_DELIVER: dict[str, Callable[[Any], Any]] = {"numpy": lambda batch: batch, "torch": _to_torch, "jax": _to_jax}


def _check(to: str, shuffle: bool | str, remainder: str) -> None:
    """Raises ConfigError for a word that is none of the options."""
    allowed = {"to": (to, tuple(_DELIVER)), "shuffle": (shuffle, ("global", True, False))}
    for name, (value, values) in (allowed | {"remainder": (remainder, ("drop", "keep"))}).items():
        if value not in values:
            raise ConfigError(f"{name} is {value!r}, but must be one of {', '.join(map(str, values))}")


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
