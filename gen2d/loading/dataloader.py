"""Data loader: shuffled batches for training, read ahead by threads, with a state that can be resumed.

jax and torch are imported only for batches of their arrays.
"""

import importlib
import itertools
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Generic, Literal, Self, TypeVar, cast, overload

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.loading.epochs import EpochSampler, GlobalBatch, check_one_of
from gen2d.loading.mixture import Mixture
from gen2d.loading.protocols import Batch, LoaderState, Snapshot, VideoReader
from gen2d.loading.windows import checked_source

if TYPE_CHECKING:
    import jax
    import torch


A = TypeVar("A")  # array type of numpy, torch or jax


class DataLoader(Generic[A]):
    """Iterable of batches for training, which are dictionaries of arrays [n, ...] by field name.

    Each rank receives its slice of every global batch of `batch_size * world_size` videos. The video and window at each
    position follow from (seed, epoch, position) alone, so a state is a few numbers and is valid for any world size. An
    iteration ends after `epochs` epochs, and the next iteration continues with the following epochs. After `break` or
    `load_state_dict`, the next iteration continues with the batch after the last one delivered.
    Iterating raises the errors of `Dataset.batch` when videos cannot be read.

    Parameters
    ----------
    dataset : Dataset, ConcatDataset or Mixture
        A dataset from `gen2d.open` or `gen2d.mix`.
    batch_size : int
        Number of videos in a batch of one rank.
    seed : int
        Seed of the shuffling and of random windows.
    shuffle : "global" or bool
        "global" and True permute all videos of the dataset anew in each epoch; False keeps their order.
    epochs : int, optional
        Number of epochs in an iteration. By default an iteration never ends.
    rank, world_size : int, optional
        Number of this process, and of all processes. If both are omitted, they are those of torch.distributed, if it is
        initialized, else RANK and WORLD_SIZE of the environment, which torchrun sets, else 0 and 1.
    drop_last : bool
        Whether the videos at the end of an epoch that do not fill a global batch are skipped. With False they form a
        smaller one, of which the ranks' slices differ by at most one video and may be empty. An evaluation of all
        videos needs False.
    num_threads : int, optional
        Number of reading threads. The default is the number of CPUs, at most 8.
    prefetch : int
        Number of batches to read ahead.
    transform : callable, optional
        Function from a NumPy batch to a batch of new arrays. It runs in the reading threads, so several calls may run
        at once.
    to : "numpy", "torch" or "jax"
        Type of the arrays. With "jax", numbers of 64 bits are rounded to 32, unless jax is in its 64-bit mode. Text
        fields stay NumPy bytes.
    device : torch.device, str or jax.Device, optional
        Device of the batches, with `to="torch"` or `to="jax"`. The default is the CPU for torch, jax's default device
        for jax.
    sharding : jax.sharding.Sharding, optional
        Placement of the batches on several devices, instead of `device`, with `to="jax"`.

    Raises
    ------
    ConfigError
        If an argument is invalid, or if the dataset has fewer videos than a batch needs.

    Examples
    --------
    >>> ds = gen2d.open("datasets/bouncing", window=16, dtype="float32", layout="TCHW")
    >>> with gen2d.DataLoader(ds, batch_size=32, epochs=10, to="torch", device="cuda") as loader:
    ...     for batch in loader:
    ...         loss = train_step(batch["frames"])  # [32, 16, 3, H, W]
    ...         checkpoint = loader.state_dict()
    """

    @overload
    def __init__(
        self: "DataLoader[np.ndarray]",
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
        transform: Callable[[Batch], dict[str, np.ndarray]] | None = None,
        to: Literal["numpy"] = "numpy",
        device: None = None,
        sharding: None = None,
    ) -> None: ...
    @overload
    def __init__(
        self: "DataLoader[torch.Tensor]",
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
        *,
        transform: Callable[[Batch], dict[str, np.ndarray]] | None = None,
        to: Literal["torch"],
        device: "torch.device | str | None" = None,
        sharding: None = None,
    ) -> None: ...
    @overload
    def __init__(
        self: "DataLoader[jax.Array]",
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
        *,
        transform: Callable[[Batch], dict[str, np.ndarray]] | None = None,
        to: Literal["jax"],
        device: object = None,
        sharding: "jax.sharding.Sharding | None" = None,
    ) -> None: ...
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
        transform: Callable[[Batch], dict[str, np.ndarray]] | None = None,
        to: str = "numpy",
        device: object = None,
        sharding: "jax.sharding.Sharding | None" = None,
    ) -> None:
        self.threads, self.prefetch = num_threads or min(os.cpu_count() or 1, 8), prefetch
        check_one_of("to", to, tuple(_CONVERTERS))
        _check_device(to, device, sharding)
        if min(self.prefetch, self.threads) < 1:
            raise ConfigError("prefetch and num_threads must be 1 or more")
        checked_source(dataset, "dataset")
        self.epoch_sampler = EpochSampler(len(dataset), batch_size, seed, shuffle, epochs, rank, world_size, drop_last)
        self.dataset, self.transform, self.to = dataset, transform, to
        self.device, self.sharding = device, sharding
        self._running: Generator[Any, None, None] | None = None
        self._pool: ThreadPoolExecutor | None = None

    def __len__(self) -> int:
        """The number of batches in one epoch."""
        return len(self.epoch_sampler)

    def __iter__(self) -> Iterator[dict[str, A]]:
        self.close()
        self._running = self._batches()
        return self._running

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the iteration in progress and wait for its threads."""
        if self._running is not None:
            self._running.close()
        if self._pool is not None:
            self._pool.shutdown()

    def state_dict(self) -> LoaderState:
        """State after the last batch delivered, as values that JSON can store; batches read ahead do not count.

        It holds the epoch, the position, the values that determine the order, and the snapshot of the dataset. A state
        that the loop takes at the last batch resumes to an iteration that ends at once; one that is taken after the
        loop resumes with the next `epochs` epochs.
        """
        shares = {"shares": self.dataset.shares} if isinstance(self.dataset, Mixture) else {}
        return self.epoch_sampler.state_dict() | {"snapshot": self.dataset.snapshot} | shares

    def load_state_dict(self, state: LoaderState) -> None:
        """Let the next iteration continue from `state`, which may come from another number of ranks.

        If the dataset has grown since, the loader opens the snapshot of the state again. `gen2d.stream` has states of
        the same form, without a snapshot.

        Parameters
        ----------
        state : mapping
            A result of `state_dict`.

        Raises
        ------
        ConfigError
            If the state has another seed, shuffle, number of videos, number of datasets or shares of a mixture.
        FolderError
            If the folder does not have the snapshot, because it was removed or belongs to another dataset.
        """
        self.close()
        values = state if isinstance(state, Mapping) else {}
        snapshot = values.get("snapshot")  # None in a stream's state
        shares = self.dataset.shares if isinstance(self.dataset, Mixture) else None
        if values.get("shares", shares) != shares:
            raise ConfigError(f"the state has shares {values['shares']}, but the dataset {shares}: their orders differ")
        dataset = self.dataset if snapshot is None else self.dataset.at(cast(Snapshot, snapshot))
        epoch_sampler = self.epoch_sampler.with_videos(len(dataset))
        epoch_sampler.load_state_dict(state)
        self.dataset, self.epoch_sampler = dataset, epoch_sampler

    def _batches(self) -> Generator[Any, None, None]:
        steps = self.epoch_sampler.steps()
        self._pool = pool = ThreadPoolExecutor(self.threads, "gen2d")
        try:
            ahead = deque((step, self._submit(pool, step)) for step in itertools.islice(steps, self.prefetch))
            while ahead:
                step, future = ahead.popleft()
                batch = _CONVERTERS[self.to](future.result(), self.device, self.sharding)
                # The next batch is requested before this one is delivered: threads read while the caller trains.
                ahead.extend((next_step, self._submit(pool, next_step)) for next_step in itertools.islice(steps, 1))
                self.epoch_sampler.advance(step)
                yield batch
            self.epoch_sampler.finish()
        finally:
            # An abandoned iterator ends in the garbage collector, which may run while a thread starts and holds the
            # lock that joining a thread needs. `close` waits.
            pool.shutdown(wait=False, cancel_futures=True)

    def _submit(self, pool: ThreadPoolExecutor, step: GlobalBatch) -> Future[Any]:
        """Future of this rank's slice of a global batch, which all threads fill together."""
        positions = self.epoch_sampler.rank_positions(step)
        indices = self.dataset._numbers_at(positions, step.epoch, self.epoch_sampler.shuffled_by)
        starts = self.dataset._starts(indices, self.epoch_sampler.window_bits(step, positions))
        # A new batch each time, because jax may keep the memory of the arrays that it receives.
        out = self.dataset.empty(len(indices))
        slices = -(-len(indices) // self.dataset._slice_size)
        parts = [
            pool.submit(self.dataset._fill, out, part, indices[part], None if starts is None else starts[part])
            for part in np.array_split(np.arange(len(indices)), min(self.threads, slices or 1))
            if len(part)
        ]
        # No deadlock: this task is queued after its parts, so all of them have started when a thread waits for them.
        return pool.submit(self._finish_batch, out, parts)

    def _finish_batch(self, out: Batch, parts: list[Future[None]]) -> Any:
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
    arrays = importlib.import_module("jax").device_put(numbers, device if sharding is None else sharding)
    return arrays | text if text else arrays


def without_text(batch: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Numeric fields and text fields of a batch."""
    text = {
        name: values for name, values in batch.items() if isinstance(values, np.ndarray) and values.dtype.kind == "S"
    }
    return {name: values for name, values in batch.items() if name not in text}, text


# Conversion of a batch (batch, device, sharding), by the value of `to`.
_CONVERTERS: dict[str, Callable[[Any, Any, Any], Any]] = {
    "numpy": lambda batch, device, sharding: batch,
    "torch": _to_torch,
    "jax": _to_jax,
}


def _check_device(to: str, device: Any, sharding: Any) -> None:
    """Raise ConfigError for a device or sharding that does not fit `to`."""
    if device is not None and to == "numpy":
        raise ConfigError(f"device is {device!r}, but must be None with to='numpy'")
    if sharding is not None and (to != "jax" or device is not None):
        raise ConfigError(f"sharding is {sharding!r}, but must be None unless to is 'jax' and device None")
