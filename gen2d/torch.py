"""Datasets for PyTorch's own DataLoader: map-style and iterable, with random windows and exact resume.

    train = gen2d.torch.dataset(gen2d.open("datasets/bouncing", window=16, layout="TCHW"), seed=0)
    loader = torch.utils.data.DataLoader(train, batch_size=32, shuffle=True, num_workers=4)
    for epoch in range(10):
        train.set_epoch(epoch)  # other windows in each epoch, in the workers, too
        for batch in loader: ...

`import gen2d` does not import torch; this module does.
"""

import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.loading.dataloader import without_text
from gen2d.loading.epochs import EpochSampler, GlobalBatch, check_one_of, epoch_indices, whole_number
from gen2d.loading.mixture import Mixture
from gen2d.loading.protocols import Batch, Numbers, VideoReader
from gen2d.loading.windows import batch_at, batch_of_epoch, checked_source

try:
    import torch
except ModuleNotFoundError as error:
    message = "gen2d.torch needs PyTorch, which is not installed: pip install torch"
    raise ModuleNotFoundError(message, name=error.name) from None

__all__ = ["IterableVideoDataset", "VideoDataset", "VideoSampler", "dataset", "iterable", "sampler"]

Sample = dict[str, Any]  # tensors by field name; text fields are bytes
_NEVER = -(2**62)  # a count that does not reach a limit


def dataset(ds: VideoReader | Mixture, seed: int = 0) -> "VideoDataset":
    """Map-style dataset for torch's DataLoader, of whole videos or of windows.

    A random window follows from the seed, the epoch and the index of its video alone. So samplers, batch sizes and any
    number of workers, forked or spawned, give the same windows. Call `set_epoch` before each epoch, or let `sampler`
    do so; otherwise each video keeps its window, and there is a UserWarning once more than two epochs have been read.

    Parameters
    ----------
    ds : Dataset, ConcatDataset or Mixture
        A dataset from `gen2d.open` or `gen2d.mix`.
    seed : int
        Seed of random windows.

    Returns
    -------
    VideoDataset
        A `torch.utils.data.Dataset`, whose items are dictionaries of tensors by field name. Items of windows also hold
        `window/start`, the first frame, int64 [], and `window/time`, the times of the frames in s, float64 [window].

    Raises
    ------
    ConfigError
        If an argument is invalid. Reading raises the errors of `Dataset.batch`.

    Examples
    --------
    >>> train = gen2d.torch.dataset(gen2d.open("datasets/bouncing", window=16, layout="TCHW"), seed=0)
    >>> train[0]["frames"].shape
    torch.Size([16, 3, 64, 64])
    """
    return VideoDataset(ds, seed)


def iterable(
    ds: VideoReader | Mixture,
    batch_size: int | None = None,
    seed: int = 0,
    *,
    shuffle: bool | str = True,
    epochs: int | None = 1,
    rank: int | None = None,
    world_size: int | None = None,
    drop_last: bool = True,
) -> "IterableVideoDataset":
    """Iterable dataset for torch's DataLoader, or for torchdata's StatefulDataLoader, which resumes it exactly.

    Its batches are those of `gen2d.DataLoader` with the same seed, in the same order, for any number of workers. Each
    rank gets its slice of every global batch, and the workers of a rank take its batches in turns. An iteration begins
    with the epoch of `set_epoch`.

    Parameters
    ----------
    ds : Dataset, ConcatDataset or Mixture
        A dataset from `gen2d.open` or `gen2d.mix`.
    batch_size : int, optional
        Number of videos in a batch of one rank; say `batch_size=None` to the DataLoader then. By default single videos
        are given, which the DataLoader collates: this is slower, and the videos of a batch depend on the number of
        workers.
    seed : int
        Seed of the shuffling and of random windows.
    shuffle : bool or "global"
        Whether the videos are permuted anew in each epoch; False keeps their order.
    epochs : int, optional
        Number of epochs in an iteration. With None an iteration never ends.
    rank, world_size : int, optional
        Number of this process, and of all processes. By default those of `torch.distributed` if it is initialised, else
        RANK and WORLD_SIZE of the environment, which torchrun sets, else 0 and 1.
    drop_last : bool
        Whether the videos at the end of an epoch that do not fill a global batch are skipped.

    Returns
    -------
    IterableVideoDataset
        A `torch.utils.data.IterableDataset` with `set_epoch`, `state_dict` and `load_state_dict`.

    Raises
    ------
    ConfigError
        If an argument is invalid, or if there are fewer videos than a global batch needs. Reading raises the errors of
        `Dataset.batch`.

    Examples
    --------
    >>> videos = gen2d.torch.iterable(gen2d.open("datasets/bouncing", window=16), batch_size=8)
    >>> next(iter(videos))["frames"].shape
    torch.Size([8, 16, 64, 64, 3])
    """
    return IterableVideoDataset(ds, batch_size, seed, shuffle, epochs, rank, world_size, drop_last)


def sampler(videos: "VideoDataset", shuffle: bool | str = True) -> "VideoSampler":
    """Sampler of a dataset from `gen2d.torch.dataset`, whose `set_epoch` also sets that of the dataset.

    Lightning and Accelerate call `set_epoch` of samplers before each epoch. The order of an epoch follows from the
    dataset's seed and the epoch. In several processes, wrap it as Lightning does, or use
    `torch.utils.data.DistributedSampler` and `VideoDataset.set_epoch`.

    Parameters
    ----------
    videos : VideoDataset
        A dataset from `gen2d.torch.dataset`.
    shuffle : bool or "global"
        Whether the videos are permuted anew in each epoch; False keeps their order.

    Returns
    -------
    VideoSampler
        A `torch.utils.data.Sampler`.

    Raises
    ------
    ConfigError
        If an argument is invalid.

    Examples
    --------
    >>> train = gen2d.torch.dataset(gen2d.open("datasets/bouncing", window=16), seed=0)
    >>> order = gen2d.torch.sampler(train)
    >>> order.set_epoch(3)
    >>> train.epoch
    3
    """
    return VideoSampler(videos, shuffle)


class _Epochs:
    """Epoch that the copies of a dataset in worker processes share, so that persistent workers follow `set_epoch`."""

    def __init__(self) -> None:
        self._shared_epoch = torch.zeros(1, dtype=torch.int64).share_memory_()
        self._unset_reads = torch.zeros(1, dtype=torch.int64).share_memory_()  # videos read before `set_epoch`

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for shared in (self._shared_epoch, self._unset_reads):
            shared.share_memory_()  # a copy by pickle alone is of its own

    @property
    def epoch(self) -> int:
        """The epoch that is read."""
        return int(self._shared_epoch)

    def set_epoch(self, epoch: int) -> None:
        """Read this epoch, 0 or more, from the next iteration on; raises ConfigError for anything else.

        Call it between iterations, as that of `torch.utils.data.DistributedSampler`.
        """
        self._shared_epoch.fill_(whole_number("epoch", epoch))
        self._unset_reads.fill_(_NEVER)

    def _count(self, videos: int, epoch_videos: int) -> None:
        """Count videos that are read, and warn once if more than two epochs of them were read without `set_epoch`.

        Processes may miss some of each other's counts, which makes the warning come a little later.
        """
        self._unset_reads += videos
        if self._unset_reads > 2 * epoch_videos:
            self._unset_reads.fill_(_NEVER)
            warnings.warn(
                "set_epoch was not called, so each epoch is the same: call set_epoch(epoch) of the dataset or its "
                "sampler before each epoch, or set_epoch(0) once if this is meant",
                stacklevel=3,
            )


class VideoDataset(_Epochs, torch.utils.data.Dataset[Sample]):
    """Map-style dataset of videos or windows, as `gen2d.torch.dataset` returns it.

    Attributes
    ----------
    epoch : int
        The epoch that is read.
    seed : int
        Seed of random windows.
    """

    def __init__(self, ds: VideoReader | Mixture, seed: int) -> None:
        super().__init__()
        self._source, self.seed = checked_source(ds), whole_number("seed", seed, None)
        self._differs = isinstance(ds, Mixture) or _has_random_windows(self._source)

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: int) -> Sample:
        """The video or window with this index; negative ones count from the end."""
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Numbers) -> list[Sample]:
        """List of videos or windows; torch's DataLoader calls this method once per batch."""
        if self._differs:
            self._count(len(indices), len(self))
        batch = _tensors(batch_of_epoch(self._source, np.asarray(indices), self.epoch, self.seed))
        return [{name: values[row] for name, values in batch.items()} for row in range(len(indices))]

    def __repr__(self) -> str:
        return f"<epoch {self.epoch} of {self._source!r}, seed {self.seed}>"


class VideoSampler(torch.utils.data.Sampler[int]):
    """Indices of one epoch, as `gen2d.torch.sampler` returns it."""

    def __init__(self, videos: VideoDataset, shuffle: bool | str) -> None:
        if not isinstance(videos, VideoDataset):
            raise ConfigError(f"videos is {videos!r:.80}, but must be a dataset from gen2d.torch.dataset")
        check_one_of("shuffle", shuffle, ("global", True, False))
        self._videos, self._shuffle = videos, bool(shuffle)

    def __len__(self) -> int:
        return len(self._videos)

    def __iter__(self) -> Iterator[int]:
        seed = self._videos.seed if self._shuffle else None
        return iter(epoch_indices(seed, self._videos.epoch, np.arange(len(self)), len(self)).tolist())

    def set_epoch(self, epoch: int) -> None:
        """Give the order of this epoch, 0 or more, and let the dataset read it. Raises ConfigError for other values."""
        self._videos.set_epoch(epoch)


class IterableVideoDataset(_Epochs, torch.utils.data.IterableDataset[Sample]):
    """Iterable dataset of videos, windows or batches, as `gen2d.torch.iterable` returns it.

    Attributes
    ----------
    epoch : int
        The epoch with which the next iteration begins.
    """

    def __init__(
        self,
        ds: VideoReader | Mixture,
        batch_size: int | None,
        seed: int,
        shuffle: bool | str,
        epochs: int | None,
        rank: int | None,
        world_size: int | None,
        drop_last: bool,
    ) -> None:
        super().__init__()
        size = 1 if batch_size is None else whole_number("batch_size", batch_size, 1)
        self._epochs = epochs if epochs is None else whole_number("epochs", epochs, 1)
        self._source, self._is_single = checked_source(ds), batch_size is None
        seed = whole_number("seed", seed, None)
        self._sampler = EpochSampler(len(ds), size, seed, shuffle, epochs, rank, world_size, drop_last)
        self._differs = bool(shuffle) or isinstance(ds, Mixture) or _has_random_windows(self._source)
        self._position = 0, 0  # first epoch, and the step of worker 0 that comes next
        self._next: tuple[int, int] | None = None  # position of a state that has been loaded

    def __len__(self) -> int:
        """Number of batches (of videos, without `batch_size`) in an iteration, by all workers of this rank."""
        if self._epochs is None:
            raise TypeError("an iteration with epochs=None never ends, so it has no length")
        return len(self._sampler) * self._epochs

    def __iter__(self) -> Iterator[Sample]:
        self._position, self._next = self._next or (self.epoch, 0), None
        return self._samples()

    def _samples(self) -> Iterator[Sample]:
        worker, workers = _worker()
        steps, (first, begin) = len(self._sampler), self._position
        step, sampler = begin + worker, self._sampler
        while self._epochs is None or step < steps * self._epochs:
            epoch, position = first + step // steps, step % steps * sampler.global_size
            size = min(sampler.global_size, len(self._source) - position)
            positions = sampler.rank_positions(GlobalBatch(epoch, position, size))
            step += workers
            self._position = first, step - worker
            if self._is_single and not len(positions):
                continue  # of the last videos of an epoch, there is none for this rank
            if self._differs and self._epochs is not None:
                self._count(len(positions), len(self._source) * self._epochs // sampler.world_size)
            batch = _tensors(batch_at(self._source, positions, epoch, sampler.seed, sampler.shuffled_by))
            yield {name: values[0] for name, values in batch.items()} if self._is_single else batch

    def state_dict(self) -> dict[str, Any]:
        """State after the last item given by this process, as values that JSON can store.

        torchdata's StatefulDataLoader collects those of its workers.
        """
        epoch, step = self._next or self._position
        shares = {"shares": self._source.shares} if isinstance(self._source, Mixture) else {}
        fixed = {"snapshot": self._source.snapshot} | shares | self._sampler.state_dict()
        sizes = {"global_batch_size": self._sampler.global_size, "workers": _worker()[1]}
        return fixed | sizes | {"epoch": epoch, "position": step}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Let the next iteration continue from `state`, whatever epoch was set.

        Parameters
        ----------
        state : mapping
            A result of `state_dict`.

        Raises
        ------
        ConfigError
            If the state is of another dataset, seed, order, global batch size or number of workers. A state of an
            iteration without workers fits any number.
        """
        current = self.state_dict()
        if not isinstance(state, Mapping) or state.keys() != current.keys():
            raise ConfigError(f"the state must be one that state_dict gave, with {', '.join(current)}")
        if state["snapshot"] != current["snapshot"]:
            raise ConfigError(
                f"the state is of snapshot {state['snapshot']}, but the dataset has {current['snapshot']}: if it has "
                "grown since, open it with the snapshot of the state, as gen2d.open(..., snapshot=)"
            )
        for name, value in current.items():
            fits = name in ("epoch", "position") or state[name] == value or (name == "workers" and state[name] == 1)
            if not fits:
                raise ConfigError(
                    f"the state has {name} {state[name]}, but this dataset has {value}: its order would differ"
                )
        self._next = whole_number("epoch", state["epoch"]), whole_number("position", state["position"])
        self._unset_reads.fill_(min(int(self._unset_reads), 0))

    def __repr__(self) -> str:
        return f"<iterable of {self._source!r}, rank {self._sampler.rank} of {self._sampler.world_size}>"


def _has_random_windows(source: VideoReader | Mixture) -> bool:
    """Whether windows differ between epochs."""
    first = np.zeros(min(len(source), 1), np.int64)
    return source._starts(first, first.astype(np.uint64)) is not None


def _worker() -> tuple[int, int]:
    """Number of this worker process of a DataLoader, and of all; 0 and 1 in the main process."""
    info = torch.utils.data.get_worker_info()
    return (0, 1) if info is None else (info.id, info.num_workers)


def _tensors(batch: Batch) -> Sample:
    """The batch as tensors; text fields stay bytes."""
    numbers, text = without_text(batch)
    return {name: torch.from_numpy(values) for name, values in numbers.items()} | text
