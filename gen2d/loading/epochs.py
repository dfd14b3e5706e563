"""Epoch sampler: the order of videos in an epoch, each rank's slice of it, and a state that can be resumed.

There is no random generator with a state. The video and window at each position are computed from the seed, the epoch
and the position, so iteration resumes anywhere without replay.
"""

import copy
import operator
import os
import sys
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.permutation import feistel, hashed


class GlobalBatch(NamedTuple):
    """Batch of all ranks together: consecutive positions of an epoch."""

    epoch: int
    position: int  # the first one
    size: int  # videos


class EpochSampler:
    """Global batches of successive epochs, the slice of this rank in each, and the current position.

    Parameters are those of `DataLoader`; `videos` is the number of videos in the dataset. An iteration ends after
    `epochs` epochs, and the next one continues with the following epochs. Raises ConfigError for values out of range,
    and if there are too few videos for one global batch.
    """

    def __init__(
        self,
        videos: int,
        batch_size: int,
        seed: int,
        shuffle: bool | str,
        epochs: int | None,
        rank: int | None,
        world_size: int | None,
        drop_last: bool,
    ) -> None:
        rank, world_size = _rank_and_world_size(rank, world_size)
        check_one_of("shuffle", shuffle, ("global", True, False))
        check_one_of("drop_last", drop_last, (True, False))
        batch_size, world_size = whole_number("batch_size", batch_size, 1), whole_number("world_size", world_size, 1)
        seed, epochs = whole_number("seed", seed, None), epochs if epochs is None else whole_number("epochs", epochs, 1)
        if not 0 <= whole_number("rank", rank) < world_size:
            raise ConfigError(f"rank is {rank}, but must be from 0 to world_size - 1, which is {world_size - 1}")
        self.videos, self.seed, self.shuffle, self.epochs = videos, seed, bool(shuffle), epochs
        self.rank, self.world_size, self.global_size = rank, world_size, batch_size * world_size
        self.min_videos = self.global_size if drop_last else 1  # in a global batch
        self.epoch = self.position = 0
        self._is_loaded = False  # whether the next iteration continues the one of a state
        self._check_size()

    def _check_size(self) -> None:
        if self.videos < self.min_videos:
            raise ConfigError(f"{self.global_size} videos make a global batch, but there are only {self.videos}")

    def __len__(self) -> int:
        """The number of global batches in one epoch."""
        full, remainder = divmod(self.videos, self.global_size)
        return full + (remainder >= self.min_videos)

    def state_dict(self) -> dict[str, int | bool | None]:
        """Current epoch and position, and the values that determine the order."""
        fixed = {"seed": self.seed, "shuffle": self.shuffle, "videos": self.videos}
        return fixed | {"epoch": self.epoch, "position": self.position}

    def load_state_dict(self, state: Mapping[str, object]) -> None:
        """Continue from `state`, which may come from another number of ranks.

        Raises ConfigError if `state` is not a state of a sampler, or has another seed, shuffle or number of videos.
        """
        current = self.state_dict()
        if not isinstance(state, Mapping) or not current.keys() <= state.keys():
            raise ConfigError(f"the state must be one that state_dict gave, with {', '.join(current)}")
        for name, value in current.items():
            if name not in ("epoch", "position") and state[name] != value:
                raise ConfigError(
                    f"the state has {name} {state[name]}, but this loader has {value}: orders would differ"
                )
        epoch, position = state["epoch"], state["position"]
        if not (isinstance(epoch, int) and isinstance(position, int) and min(epoch, position) >= 0):
            raise ConfigError(f"the state has epoch and position {(epoch, position)}, but must have whole numbers")
        self.epoch, self.position, self._is_loaded = epoch, position, True

    def with_videos(self, videos: int) -> "EpochSampler":
        """Sampler at its beginning with the same options for another number of videos."""
        other = copy.copy(self)
        other.videos, other.epoch, other.position = videos, 0, 0
        other._check_size()
        return other

    def steps(self) -> Iterator[GlobalBatch]:
        """Global batches from the current position on, until `epochs` epochs are complete.

        After a state that was taken behind the last batch of an iteration, but before its end, there are none.
        """
        if not self._is_loaded:
            self.finish()
        self._is_loaded = False
        end = None if self.epochs is None else (self.epoch // self.epochs + 1) * self.epochs
        epoch, position = self._wrap(self.epoch, self.position)
        while end is None or epoch < end:
            size = min(self.global_size, self.videos - position)
            yield GlobalBatch(epoch, position, size)
            epoch, position = self._wrap(epoch, position + size)

    def advance(self, step: GlobalBatch) -> None:
        """Move the current position behind a global batch; behind the last of an iteration, to the end of its epoch."""
        self.epoch, self.position = self._wrap(step.epoch, step.position + step.size)
        if self.epochs is not None and self.position == 0 and self.epoch % self.epochs == 0:
            self.epoch, self.position = step.epoch, self.videos

    def finish(self) -> None:
        """Move the current position from the end of an epoch to the beginning of the next one."""
        self.epoch, self.position = self._wrap(self.epoch, self.position)

    def _wrap(self, epoch: int, position: int) -> tuple[int, int]:
        """Epoch and position of the next global batch; a position near the end of an epoch wraps to the next epoch."""
        return (epoch, position) if self.videos - position >= self.min_videos else (epoch + 1, 0)

    def rank_positions(self, step: GlobalBatch) -> np.ndarray:
        """Positions of this rank's slice of a global batch, int64 [n]."""
        begin, end = (step.size * rank // self.world_size for rank in (self.rank, self.rank + 1))
        return step.position + np.arange(begin, end)

    @property
    def shuffled_by(self) -> int | None:
        """Seed of the shuffling; None without shuffling."""
        return self.seed if self.shuffle else None

    def window_bits(self, step: GlobalBatch, positions: np.ndarray) -> np.ndarray:
        """Random bits for the window at each position, uint64."""
        return hashed(WINDOWS, self.seed, step.epoch, positions)


def _rank_and_world_size(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """Rank and world size: the arguments, else those of torch.distributed or of the environment, else 0 and 1.

    `torch.multiprocessing.spawn` sets no RANK, so without the process group each process would read the same videos.
    """
    if rank is not None or world_size is not None:
        return 0 if rank is None else rank, 1 if world_size is None else world_size
    distributed = sys.modules.get("torch.distributed")  # a process that has not imported it has no group
    if distributed is not None and distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    if {"RANK", "WORLD_SIZE"} <= os.environ.keys():
        values = os.environ["RANK"], os.environ["WORLD_SIZE"]
        if not all(word.isdecimal() for word in values):
            raise ConfigError(f"RANK and WORLD_SIZE are {values[0]!r} and {values[1]!r}, but must be whole numbers")
        return int(values[0]), int(values[1])
    return 0, 1


def whole_number(name: str, value: object, low: int | None = 0) -> int:
    """The value as an int. Raises ConfigError unless it is a whole number, `low` or more."""
    try:
        number = operator.index(value)  # pyright: ignore[reportArgumentType]
    except TypeError:
        number = None
    if number is None or isinstance(value, bool) or (low is not None and number < low):
        raise ConfigError(f"{name} is {value!r}, but must be a whole number{'' if low is None else f', {low} or more'}")
    return number


def check_one_of(name: str, value: Any, allowed: tuple[object, ...]) -> None:
    """Raise ConfigError unless the value is one of the allowed ones."""
    if value not in allowed:
        raise ConfigError(f"{name} is {value!r}, but must be one of {', '.join(map(str, allowed))}")


# Streams of random numbers, so that no two uses share any.
ORDER, WINDOWS, SOURCES, INDEX_WINDOWS = 0, 1, 2, 3


def epoch_indices(seed: int | None, epoch: int, positions: np.ndarray, count: int) -> np.ndarray:
    """Indices of the videos at these positions of an epoch: shuffled by the seed, or in order if it is None."""
    return positions if seed is None else order(seed, epoch, positions, count)


def order(seed: int, epoch: int, positions: np.ndarray, count: int) -> np.ndarray:
    """Random permutation of 0 to `count - 1`, evaluated at these positions without storing it, int64 [n].

    A Feistel network permutes the integers below the smallest power of four that is at least `count`. A value of
    `count` or more is permuted again until it is below `count` (cycle walking; Black and Rogaway, CT-RSA 2002).
    """
    half = np.uint64(max(1, ((count - 1).bit_length() + 1) // 2))
    keys = [hashed(ORDER, seed, epoch, step) for step in range(8)]
    values = positions.astype(np.uint64)
    outside = np.ones(values.shape, bool)
    while outside.any():
        values[outside] = feistel(values[outside], keys, half)
        outside = values >= count
    return values.astype(np.int64)
