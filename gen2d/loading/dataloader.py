"""Batches for training, in an order that can be resumed: threads read ahead and fill each batch together.

jax and torch are imported only if batches are wanted in them.
"""

import importlib
import itertools
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.loading.epochs import EpochSampler, GlobalBatch, one_of
from gen2d.loading.mixture import Mixture
from gen2d.loading.protocols import Batch, VideoReader


class DataLoader:
    """Batches as dictionaries of arrays, each rank its slice of every global batch of `batch_size * world_size`.

    Unless given, rank and world size are those that torchrun sets in the environment, or one process is all.

    Video and window at each position follow from (seed, epoch, position) alone, so a state is a few numbers and fits
    another world size. An iteration ends when `epochs` epochs are through, and the next goes on with the epochs that
    follow; after `break` or `load_state_dict` it goes on with the batch after the last one delivered.

    `shuffle` is "global" (or True) or False. `drop_last=False` keeps the last videos of an epoch, which fill no global
    batch: the ranks' shares of these may differ by one, or be empty. `transform` gets each batch
    in a thread, and returns new arrays each time. `to` is "numpy", "torch" or "jax", which has no 64-bit numbers unless
    told to; text stays NumPy's bytes in both. `device` is where batches are put, a torch device or its name or a jax
    device, and `sharding` how jax lays them out on several. `dataset` is of `gen2d.open` or `gen2d.mix`.
    """

    def __init__(
        self,
        dataset: VideoReader | Mixture,
        batch_size: int,
        seed: int = 0,
        shuffle: bool | str = "global",
        epochs: int | None = None,
        rank: int | None = None,
        world_size: int | None = None,
        drop_last: bool = True,
        num_threads: int | None = None,
        prefetch: int = 2,
        transform: Callable[[Batch], Any] | None = None,
        to: str = "numpy",
        device: Any = None,
        sharding: Any = None,
    ) -> None:
        self.threads, self.prefetch = num_threads or min(os.cpu_count() or 1, 8), prefetch
        one_of("to", to, tuple(_DELIVER))
        _check_place(to, device, sharding)
        if min(self.prefetch, self.threads) < 1:
            raise ConfigError("prefetch and num_threads must be 1 or more")
        self.walk = EpochSampler(len(dataset), batch_size, seed, shuffle, epochs, rank, world_size, drop_last)
        self.dataset, self.transform, self.to = dataset, transform, to
        self.device, self.sharding = device, sharding
        self._running: Generator[Any, None, None] | None = None

    def __len__(self) -> int:
        """The number of batches in one epoch."""
        return len(self.walk)

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
        """Where the iteration stands, and on which snapshot of the dataset: what has been delivered, not what was read
        ahead."""
        return self.walk.state_dict() | {"snapshot": self.dataset.snapshot}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """The next iteration goes on where `state` was taken, on whatever number of ranks.

        Where the dataset has grown since, that is the snapshot of the state, which is opened again. Raises FolderError
        where it is no longer there, and ConfigError for the state of another dataset, or in another order.
        """
        self.close()
        snapshot = state.get("snapshot") if isinstance(state, Mapping) else None  # None: of a stream
        dataset = self.dataset if snapshot is None else self.dataset.at(snapshot)
        walk = self.walk.over(len(dataset))
        walk.load_state_dict(state)
        self.dataset, self.walk = dataset, walk

    def _batches(self) -> Generator[Any, None, None]:
        steps = self.walk.steps()
        pool = ThreadPoolExecutor(self.threads, "gen2d")
        try:
            ahead = deque((step, self._submit(pool, step)) for step in itertools.islice(steps, self.prefetch))
            while ahead:
                step, coming = ahead.popleft()
                batch = _DELIVER[self.to](coming.result(), self.device, self.sharding)
                # Asked for before this one is handed out, so that threads read while the caller trains.
                ahead.extend((following, self._submit(pool, following)) for following in itertools.islice(steps, 1))
                self.walk.passed(step)
                yield batch
        finally:
            pool.shutdown(cancel_futures=True)

    def _submit(self, pool: ThreadPoolExecutor, step: GlobalBatch) -> Future[Any]:
        """This rank's slice of a global batch, being filled by all threads."""
        positions = self.walk.share(step)
        indices = self.dataset.numbers_at(positions, step.epoch, self.walk.shuffled_by)
        starts = self.dataset.starts(indices, self.walk.bits(step, positions))
        # A new batch each time, never one used before: jax may keep the very memory that it is given.
        out = self.dataset.empty(len(indices))
        parts = [
            pool.submit(self.dataset.fill, out, part, indices[part], None if starts is None else starts[part])
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
    numbers, text = without_text(batch)
    tensors = {name: torch.from_numpy(values) for name, values in numbers.items()}
    return (tensors if device is None else {name: tensor.to(device) for name, tensor in tensors.items()}) | text


def _to_jax(batch: Any, device: Any, sharding: Any) -> Any:
    numbers, text = without_text(batch) if isinstance(batch, dict) else (batch, {})
    placed = importlib.import_module("jax").device_put(numbers, device if sharding is None else sharding)
    return placed | text if text else placed


def without_text(batch: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The fields of a batch that are numbers, and those that are text, which stay in NumPy."""
    text = {
        name: values for name, values in batch.items() if isinstance(values, np.ndarray) and values.dtype.kind == "S"
    }
    return {name: values for name, values in batch.items() if name not in text}, text


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
