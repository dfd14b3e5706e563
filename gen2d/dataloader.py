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
from gen2d.mixing import Mixture
from gen2d.ordering import WINDOWS, hashed


class DataLoader:
    """Batches as dictionaries of arrays, each rank its slice of every global batch of `batch_size * world_size`.

    Video and window at each position follow from (seed, epoch, position) alone, so a state is a few numbers and fits
    another world size. An iteration ends when `epochs` epochs are through, and the next goes on with the epochs that
    follow; after `break` or `load_state_dict` it goes on with the batch after the last one delivered.

    `shuffle` is "global" (or True) or False. `remainder` says what happens to the last videos of an epoch that fill no
    global batch: "drop" or "keep" (then the ranks' shares may differ by one, or be empty). `transform` gets each batch
    in a thread, and returns new arrays each time. `to` is "numpy", "torch" or "jax", which has no 64-bit numbers unless
    told to. `device` is where batches are put, a torch device or its name or a jax device, and `sharding` how jax lays
    them out on several. `dataset` is of `gen2d.open` or `gen2d.mix`.
    """

    def __init__(
        self,
        dataset: Dataset | Mixture,
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
        device: Any = None,
        sharding: Any = None,
    ) -> None:
        threads = num_threads or min(os.cpu_count() or 1, 8)
        _check(to, shuffle, remainder)
        _check_place(to, device, sharding)
        if min(batch_size, world_size, prefetch, threads) < 1 or not 0 <= rank < world_size:
            told = "batch_size, world_size, prefetch and num_threads must be 1 or more, and rank from 0 to"
            raise ConfigError(f"{told} world_size - 1")
        self.dataset, self.seed, self.shuffle, self.epochs = dataset, seed, bool(shuffle), epochs
        self.rank, self.world_size, self.global_size = rank, world_size, batch_size * world_size
        self.least = 1 if remainder == "keep" else self.global_size  # how many videos still make a global batch
        self.threads, self.prefetch, self.transform, self.to = threads, prefetch, transform, to
        self.device, self.sharding = device, sharding
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
                batch = _DELIVER[self.to](coming.result(), self.device, self.sharding)
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
        indices = self.dataset.numbers_at(positions, epoch, self.seed if self.shuffle else None)
        starts = self.dataset.starts(indices, hashed(WINDOWS, self.seed, epoch, positions))
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


def _to_torch(batch: Batch, device: Any, sharding: Any) -> dict[str, Any]:
    torch = importlib.import_module("torch")
    tensors = {name: torch.from_numpy(values) for name, values in batch.items()}
    return tensors if device is None else {name: tensor.to(device) for name, tensor in tensors.items()}


def _to_jax(batch: Batch, device: Any, sharding: Any) -> dict[str, Any]:
    return importlib.import_module("jax").device_put(batch, device if sharding is None else sharding)


# How batches are handed out, by the value of `to`.
_DELIVER: dict[str, Callable[[Any, Any, Any], Any]] = {
    "numpy": lambda batch, device, sharding: batch,
    "torch": _to_torch,
    "jax": _to_jax,
}


def _check_place(to: str, device: Any, sharding: Any) -> None:
    """Raises ConfigError for a place that such batches cannot have."""
    if device is not None and to == "numpy":
        raise ConfigError(f"device is {device!r}, but must be None with to='numpy'")
    if sharding is not None and (to != "jax" or device is not None):
        raise ConfigError(f"sharding is {sharding!r}, but must be None unless to is 'jax' and device None")


def _check(to: str, shuffle: bool | str, remainder: str) -> None:
    """Raises ConfigError for a word that is none of the options."""
    allowed = {"to": (to, tuple(_DELIVER)), "shuffle": (shuffle, ("global", True, False))}
    for name, (value, values) in (allowed | {"remainder": (remainder, ("drop", "keep"))}).items():
        if value not in values:
            raise ConfigError(f"{name} is {value!r}, but must be one of {', '.join(map(str, values))}")
