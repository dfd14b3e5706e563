"""Which videos come when: the order of an epoch, each rank's share of it, and where a reader stands.

Nothing is drawn from a generator that has a state: video and window at each position are computed from seed, epoch and
position, so going on anywhere takes no replay.
"""

import copy
import os
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.permutation import feistel, hashed


class GlobalBatch(NamedTuple):
    """A global batch: positions from one on in an epoch."""

    epoch: int
    position: int
    size: int


class EpochSampler:
    """The way through a number of videos, and the place on it: each rank has its slice of every global batch.

    The way ends when `epochs` epochs are through, and begins again with those that follow. The last videos of an epoch
    that fill no global batch are left out, unless `drop_last` is False: then they make a smaller one.
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
        rank, world_size = _ranks(rank, world_size)
        one_of("shuffle", shuffle, ("global", True, False))
        one_of("drop_last", drop_last, (True, False))
        if min(batch_size, world_size) < 1 or not 0 <= rank < world_size:
            raise ConfigError("batch_size and world_size must be 1 or more, and rank from 0 to world_size - 1")
        self.videos, self.seed, self.shuffle, self.epochs = videos, seed, bool(shuffle), epochs
        self.rank, self.world_size, self.global_size = rank, world_size, batch_size * world_size
        self.least = self.global_size if drop_last else 1  # how many videos still make a global batch
        self.epoch = self.position = 0
        self._check_size()

    def _check_size(self) -> None:
        if self.videos < self.least:
            raise ConfigError(f"{self.global_size} videos make a global batch, but there are only {self.videos}")

    def __len__(self) -> int:
        """The number of global batches in one epoch."""
        whole, rest = divmod(self.videos, self.global_size)
        return whole + (rest >= self.least)

    def state_dict(self) -> dict[str, Any]:
        """Where it stands, and what decides the order."""
        fixed = {"seed": self.seed, "shuffle": self.shuffle, "videos": self.videos}
        return fixed | {"epoch": self.epoch, "position": self.position}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes to where `state` was taken, on whatever number of ranks. Raises ConfigError for what is no state."""
        here = self.state_dict()
        if not isinstance(state, Mapping) or not here.keys() <= state.keys():
            raise ConfigError(f"the state must be one that state_dict gave, with {', '.join(here)}")
        for name, value in here.items():
            if name not in ("epoch", "position") and state[name] != value:
                raise ConfigError(
                    f"the state has {name} {state[name]}, but this loader has {value}: orders would differ"
                )
        place = state["epoch"], state["position"]
        if not all(isinstance(number, int) and number >= 0 for number in place):
            raise ConfigError(f"the state has epoch and position {place}, but must have whole numbers")
        self.epoch, self.position = self._resolved(*place)

    def over(self, videos: int) -> "EpochSampler":
        """The same way through another number of videos, from its beginning."""
        other = copy.copy(self)
        other.videos, other.epoch, other.position = videos, 0, 0
        other._check_size()
        return other

    def steps(self) -> Iterator[GlobalBatch]:
        """The global batches to come."""
        epoch, position = self.epoch, self.position
        end = None if self.epochs is None else (epoch // self.epochs + 1) * self.epochs
        while end is None or epoch < end:
            size = min(self.global_size, self.videos - position)
            yield GlobalBatch(epoch, position, size)
            epoch, position = self._resolved(epoch, position + size)

    def passed(self, step: GlobalBatch) -> None:
        """Returns nothing; the place is then after that global batch."""
        self.epoch, self.position = self._resolved(step.epoch, step.position + step.size)

    def _resolved(self, epoch: int, position: int) -> tuple[int, int]:
        """Where the next global batch begins."""
        return (epoch, position) if self.videos - position >= self.least else (epoch + 1, 0)

    def share(self, step: GlobalBatch) -> np.ndarray:
        """The positions of this rank's slice of a global batch."""
        begin, end = (step.size * rank // self.world_size for rank in (self.rank, self.rank + 1))
        return step.position + np.arange(begin, end)

    @property
    def shuffled_by(self) -> int | None:
        """The seed that shuffles; None where nothing does."""
        return self.seed if self.shuffle else None

    def bits(self, step: GlobalBatch, positions: np.ndarray) -> np.ndarray:
        """Random bits for the window at each position."""
        return hashed(WINDOWS, self.seed, step.epoch, positions)


def _ranks(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """Which of how many processes this is: as told, else as torchrun says in RANK and WORLD_SIZE, else the only one."""
    if rank is None and world_size is None and {"RANK", "WORLD_SIZE"} <= os.environ.keys():
        told = os.environ["RANK"], os.environ["WORLD_SIZE"]
        if not all(word.isdecimal() for word in told):
            raise ConfigError(f"RANK and WORLD_SIZE are {told[0]!r} and {told[1]!r}, but must be whole numbers")
        return int(told[0]), int(told[1])
    return 0 if rank is None else rank, 1 if world_size is None else world_size


def one_of(name: str, value: Any, allowed: tuple) -> None:
    """Returns nothing; raises ConfigError for a value that is none of those allowed."""
    if value not in allowed:
        raise ConfigError(f"{name} is {value!r}, but must be one of {', '.join(map(str, allowed))}")


# What a random number is for, so that no two uses share one.
ORDER, WINDOWS, SOURCES = 0, 1, 2


def shuffled(seed: int | None, epoch: int, positions: np.ndarray, count: int) -> np.ndarray:
    """The numbers of the videos at these positions of an epoch, as the seed shuffles them; in order without one."""
    return positions if seed is None else order(seed, epoch, positions, count)


def order(seed: int, epoch: int, positions: np.ndarray, count: int) -> np.ndarray:
    """The numbers of the videos at these positions of an epoch: a permutation of 0 to count - 1, nowhere stored.

    A Feistel network permutes the smallest square power of two that holds `count`; what falls outside goes through
    again until it falls inside (Black and Rogaway, CT-RSA 2002).
    """
    half = np.uint64(max(1, ((count - 1).bit_length() + 1) // 2))
    keys = [hashed(ORDER, seed, epoch, step) for step in range(8)]
    values = positions.astype(np.uint64)
    outside = np.ones(values.shape, bool)
    while outside.any():
        values[outside] = feistel(values[outside], keys, half)
        outside = values >= count
    return values.astype(np.int64)
