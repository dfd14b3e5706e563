"""Several datasets as one, in exact proportions: which source each position takes follows from the position alone.

Among the first p positions each source has its share of p within 1, for any number of sources and any weights
(Tijdeman, Discrete Mathematics 32, 1980). Shuffling takes each source's videos in another order and leaves the
positions of the sources as they are, so that every batch holds its shares, too.
"""

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.permutation import hashed
from gen2d.loading.concat import ConcatDataset, at_snapshots, groups_of
from gen2d.loading.epochs import SOURCES
from gen2d.loading.protocols import Batch, Key, Numbers, Snapshot, VideoReader, checked_numbers, item, unbatch

FINEST = 1000  # a weight is taken as the nearest fraction with a denominator up to this
Weights = Mapping[str, float] | Sequence[float]


def mix(datasets: Mapping[str, VideoReader], weights: Weights | None = None) -> "Mixture":
    """The datasets as one, for DataLoader, torch and grain; `weights` are their shares, equal unless told otherwise.

    An epoch is as long as no dataset has to give a video twice, and the next goes on with the videos that follow, so
    that a large dataset is read through in several epochs. Raises ConfigError where the datasets' fields, shapes or
    types differ, and where weights are not positive or not of these datasets.
    """
    if not datasets:
        raise ConfigError("datasets is empty, but must name one dataset or more")
    first = next(iter(datasets))
    for name, other in datasets.items():
        _compare(first, datasets[first], name, other)
    return Mixture(datasets, _shares(list(datasets), weights))


class Mixture:
    """Videos of several datasets by position, as dictionaries of NumPy arrays; a map-style dataset itself.

    A position's video has a number, which `fill` takes: the datasets' own, counted on from one dataset to the next.
    """

    def __init__(self, datasets: Mapping[str, VideoReader], shares: Sequence[int]) -> None:
        self.datasets, self.shares = dict(datasets), list(shares)
        self.fields = next(iter(datasets.values())).fields
        self._joined = ConcatDataset(list(datasets.values()))
        sizes = self._joined.sizes
        self._turns = turns(self.shares, sizes.tolist())
        taken = np.cumsum(self._turns[:, None] == np.arange(len(shares)), axis=0)
        self._taken = np.concatenate([np.zeros_like(taken[:1]), taken])  # of each dataset before each turn
        whole = len(self._turns) == sum(shares)
        periods = min(size // share for size, share in zip(sizes.tolist(), shares, strict=True)) if whole else 0
        rest = (self._taken <= sizes - periods * self._taken[-1]).all(axis=1).sum() - 1
        self._count = periods * len(self._turns) + int(rest)
        self._each = periods * self._taken[-1] + self._taken[rest]  # of each dataset in an epoch

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, key: Key) -> Batch:
        """The video at a position, or for a slice or a sequence of positions several, stacked."""
        return item(self, key)

    def __getitems__(self, positions: Numbers) -> list[Batch]:
        """The videos one by one; torch's DataLoader asks for a whole batch so."""
        return unbatch(self.batch(positions))

    def __repr__(self) -> str:
        parts = (f"{share} of {name}" for name, share in zip(self.datasets, self.shares, strict=True))
        return f"<{len(self)} videos, in every {sum(self.shares)} {', '.join(parts)}>"

    @property
    def snapshot(self) -> Snapshot:
        """The snapshot of each dataset, in their order."""
        return self._joined.snapshot

    def at(self, snapshot: Snapshot) -> "Mixture":
        """The mixture of the same datasets at earlier snapshots, while these are there."""
        if snapshot == self.snapshot:
            return self
        datasets = at_snapshots(list(self.datasets.values()), snapshot)
        return Mixture(dict(zip(self.datasets, datasets, strict=True)), self.shares)

    def batch(self, positions: Numbers) -> Batch:
        """The videos at these positions of the first epoch, not shuffled, stacked."""
        places = checked_numbers(positions, len(self), "the mixture")
        out = self.empty(len(places))
        self.fill(out, range(len(places)), self.numbers_at(places))
        return out

    def empty(self, count: int) -> Batch:
        """A batch of `count` videos that is yet to be filled."""
        return self._joined.empty(count)

    def fill(self, out: Batch, rows: Numbers, indices: Numbers, starts: Numbers | None = None) -> None:
        """Returns nothing; puts the videos with these numbers into these rows of `out`, windows from `starts` on."""
        self._joined.fill(out, rows, indices, starts)

    def numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray:
        """The numbers of the videos at these positions of an epoch: each dataset's one after the other, or as the seed
        shuffles them; what an epoch leaves of a dataset comes in the next."""
        periods, turn = np.divmod(positions, len(self._turns))
        owners, numbers = self._turns[turn], np.empty(len(positions), np.int64)
        for owner, own in groups_of(owners):
            place = epoch * self._each[owner] + periods[own] * self._taken[-1, owner] + self._taken[turn[own], owner]
            source, rounds = self._joined.datasets[owner], place // self._joined.sizes[owner]
            own_seed = None if seed is None else int(hashed(SOURCES, seed, owner)[0])
            for number in np.unique(rounds):
                now = own[rounds == number]
                found = source.numbers_at(place[rounds == number] % len(source), int(number), own_seed)
                numbers[now] = self._joined.firsts[owner] + found
        return numbers

    def starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
        """Where the windows of these videos begin, drawn by random bits; None if that is not random."""
        return self._joined.starts(numbers, bits)

    def source_of(self, positions: Numbers) -> list[str]:
        """The names of the datasets that the videos at these positions are of, the same in every epoch."""
        names = list(self.datasets)
        return [names[owner] for owner in self._turns[np.asarray(positions) % len(self._turns)]]


def turns(shares: Sequence[int], sizes: Sequence[int]) -> np.ndarray:
    """Whose turn it is at each position of a period of sum(shares); shorter where one of these sizes is used up.

    After p positions each of K has had its share within 1 - 1 / (2K - 2): of those that are that far behind, the one
    goes first that will be too late first (Tijdeman 1980). In whole numbers, so that it is the same everywhere.
    """
    period, scale, unit = sum(shares), max(2 * len(shares) - 2, 1), math.lcm(*shares)
    taken, found = [0] * len(shares), []
    for place in range(1, period + 1):
        behind = [k for k, share in enumerate(shares) if scale * (share * place - period * taken[k]) >= period]
        owner = min(behind, key=lambda k: (scale - 1 + scale * taken[k]) * (unit // shares[k]))
        if taken[owner] == sizes[owner]:
            break
        taken[owner] += 1
        found.append(owner)
    return np.array(found)


def _shares(names: list[str], weights: Weights | None) -> list[int]:
    """The weights as the smallest whole numbers in the same proportions."""
    if isinstance(weights, Mapping):
        if weights.keys() != set(names):
            raise ConfigError(f"weights has the names {', '.join(weights)}, but must have {', '.join(names)}")
        weights = [weights[name] for name in names]
    given = [1.0] * len(names) if weights is None else list(weights)
    if len(given) != len(names):
        raise ConfigError(f"weights has {len(given)} numbers, but there are {len(names)} datasets")
    fractions = [_fraction(name, weight) for name, weight in zip(names, given, strict=True)]
    unit = math.lcm(*(fraction.denominator for fraction in fractions))
    shares = [int(fraction * unit) for fraction in fractions]
    return [share // math.gcd(*shares) for share in shares]


def _fraction(name: str, weight: float) -> Fraction:
    try:
        fraction = Fraction(float(weight)).limit_denominator(FINEST)
    except (TypeError, ValueError, OverflowError):
        fraction = Fraction(0)
    if fraction <= 0:
        raise ConfigError(f"weights of {name} is {weight!r}, but must be a number of {1 / FINEST} or more")
    return fraction


def _compare(first: str, one: VideoReader, name: str, other: VideoReader) -> None:
    """Raises ConfigError where videos of two datasets cannot stand in one batch."""
    here, there = one.empty(1), other.empty(1)
    for field in sorted(here.keys() ^ there.keys()):
        has, lacks = (first, name) if field in here else (name, first)
        raise ConfigError(f"dataset {lacks} has no field {field!r}, but {has} has: open both with the same fields")
    for field, values in here.items():
        kinds = [f"{array.dtype} {array.shape[1:]}" for array in (values, there[field])]
        if kinds[0] != kinds[1]:
            raise ConfigError(f"{field} of dataset {name} is {kinds[1]}, but of {first} {kinds[0]}")
