"""Mixture of datasets in exact proportions; the dataset of each position is a function of the position alone.

Among the first p positions, the count of each dataset differs from its share of p by less than 1, for any number of
datasets and any weights (Tijdeman, Discrete Mathematics 32, 1980). Shuffling permutes the videos inside each dataset
and keeps the dataset of each position, so every batch has the proportions of the mixture, up to rounding.
"""

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.permutation import hashed
from gen2d.core.schema import Field
from gen2d.loading.concat import ConcatDataset, at_snapshots, groups_of
from gen2d.loading.epochs import SOURCES
from gen2d.loading.protocols import Batch, Key, Numbers, Snapshot, VideoReader, checked_numbers, item, unbatch
from gen2d.loading.selection import Subset, matching
from gen2d.loading.tables import describe_html, describe_text

FINEST = 1000  # largest denominator of a weight; weights are rounded to such a fraction
Weights = Mapping[str, float] | Sequence[float]


def mix(datasets: Mapping[str, VideoReader], weights: Weights | None = None) -> "Mixture":
    """Mixture of datasets in exact proportions.

    An epoch ends before any dataset would repeat a video. The next epoch continues with the following videos of each
    dataset, so a large dataset is read completely over several epochs.

    Parameters
    ----------
    datasets : mapping of str to Dataset or ConcatDataset
        The datasets by name. Their fields, shapes and dtypes must be equal.
    weights : mapping of str to float, sequence of float, or None
        Relative share of each dataset: by name, or in the order of `datasets`. Weights need not sum to 1; they are
        rounded to fractions with denominators up to 1000. None means equal shares.

    Returns
    -------
    Mixture
        A map-style dataset for `DataLoader`, torch and grain.

    Raises
    ------
    ConfigError
        If the fields, shapes or dtypes of the datasets differ, or if `weights` are not positive numbers, one for each
        dataset.

    Examples
    --------
    >>> easy, hard = gen2d.open("datasets/easy"), gen2d.open("datasets/hard")
    >>> mixture = gen2d.mix({"easy": easy, "hard": hard}, {"easy": 3, "hard": 1})
    >>> loader = gen2d.DataLoader(mixture, batch_size=32)  # 24 videos of easy and 8 of hard in each batch
    """
    if not isinstance(datasets, Mapping):
        raise ConfigError(f"datasets is {datasets!r:.80}, but must be a mapping of names to datasets")
    if not datasets:
        raise ConfigError("datasets is empty, but must name one dataset or more")
    first = next(iter(datasets))
    for name, other in datasets.items():
        if isinstance(other, Mixture):
            raise ConfigError(f"dataset {name} is a mixture, but must be a dataset: mix those that it consists of")
        _check_equal_fields(first, datasets[first], name, other)
    return Mixture(datasets, _shares(list(datasets), weights))


class Mixture:
    """Mixture of datasets, as `gen2d.mix` returns it; also a map-style dataset for torch and grain.

    `mixture[i]` is the video at position i of the first epoch, without shuffling. `fill` takes indices into the
    concatenation of the datasets instead; `numbers_at` converts positions to these indices.

    Parameters
    ----------
    datasets : mapping of str to VideoReader
        The datasets by name. `gen2d.mix` checks that they match; the constructor does not.
    shares : sequence of int
        Number of positions that each dataset has in one period of `sum(shares)` positions.
    """

    def __init__(self, datasets: Mapping[str, VideoReader], shares: Sequence[int]) -> None:
        self.datasets, self.shares = dict(datasets), list(shares)
        self.fields = next(iter(datasets.values())).fields
        self._concatenation = ConcatDataset(list(datasets.values()))
        sizes = self._concatenation._sizes
        self._schedule = tijdeman_schedule(self.shares, sizes.tolist())
        counts = np.cumsum(self._schedule[:, None] == np.arange(len(shares)), axis=0)
        # Videos of each dataset before each position of the period, and in a whole epoch.
        self._counts_before = np.concatenate([np.zeros_like(counts[:1]), counts])
        is_full = len(self._schedule) == sum(shares)
        periods = min(size // share for size, share in zip(sizes.tolist(), shares, strict=True)) if is_full else 0
        remainder = (self._counts_before <= sizes - periods * self._counts_before[-1]).all(axis=1).sum() - 1
        self._length = periods * len(self._schedule) + int(remainder)
        self._epoch_counts = periods * self._counts_before[-1] + self._counts_before[remainder]

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, key: Key) -> Batch:
        """One video for an integer, or a batch of videos for a slice or a sequence of integers."""
        return item(self, key)

    def __getitems__(self, positions: Numbers) -> list[Batch]:
        """List of videos; torch's DataLoader calls this method once per batch."""
        return unbatch(self.batch(positions))

    def __getattr__(self, name: str) -> Any:
        if name in ("select", "to_pandas", "to_arrow"):
            raise AttributeError(
                f"a mixture has other videos in each epoch: call {name} of its datasets, then gen2d.mix"
            )
        if name in ("config", "splits"):
            raise AttributeError(f"each dataset of a mixture has its own {name}: mixture.datasets[NAME].{name}")
        raise AttributeError(f"'Mixture' object has no attribute {name!r}")

    def filter(self, condition: str) -> "Mixture":
        """Mixture of the same datasets in the same proportions, each with the videos of which a condition is true.

        Parameters
        ----------
        condition : str
            As that of `Dataset.filter`; every dataset must store the fields in it.

        Returns
        -------
        Mixture
            Its epoch ends when one of the datasets has no further video, so it may be much shorter.

        Raises
        ------
        ConfigError
            If the condition is invalid, names a field that a dataset does not store, or is true of no video of a
            dataset. Reading raises the errors of `Dataset.batch`.

        Examples
        --------
        >>> heavy = mixture.filter("factors/gravity_y < -5")
        """
        datasets = {name: Subset(source, matching(source, condition)) for name, source in self.datasets.items()}
        for name, source in datasets.items():
            if not len(source):
                raise ConfigError(f"filter is {condition!r}, which is true of no video of dataset {name}")
        return Mixture(datasets, self.shares)

    def __repr__(self) -> str:
        return describe_text(*self._description)

    def _repr_html_(self) -> str:
        return describe_html(*self._description)

    @property
    def _description(self) -> tuple[str, list[str], Mapping[str, Field]]:
        """Title, lines and fields of the description."""
        title = f"{len(self):,} videos, mixed from {len(self.datasets)} datasets"
        parts = (
            f"{share} in {sum(self.shares)}: {name}, {source._title}"
            for (name, source), share in zip(self.datasets.items(), self.shares, strict=True)
        )
        return title, list(parts), self.fields

    @property
    def fps(self) -> float:
        """Frames per second of the first dataset."""
        return self._concatenation.fps

    @property
    def exact(self) -> bool:
        """Whether all fields are those of the datasets to the bit, as `Dataset.exact`."""
        return self._concatenation.exact

    @property
    def _slice_size(self) -> int:
        """Number of videos that are best filled together."""
        return self._concatenation._slice_size

    @property
    def snapshot(self) -> Snapshot:
        """Snapshots of the datasets, in their order."""
        return self._concatenation.snapshot

    def at(self, snapshot: Snapshot) -> "Mixture":
        """Mixture of the same datasets at earlier snapshots.

        Raises ConfigError if the number of snapshots differs, FolderError if a folder does not have its snapshot.
        """
        if snapshot == self.snapshot:
            return self
        datasets = at_snapshots(list(self.datasets.values()), snapshot)
        return Mixture(dict(zip(self.datasets, datasets, strict=True)), self.shares)

    def batch(self, positions: Numbers) -> Batch:
        """Batch of the videos at these positions of the first epoch, without shuffling.

        Raises IndexError for positions beyond the epoch, and the errors of reading of `Dataset.batch`.
        """
        checked = checked_numbers(positions, len(self), "the mixture")
        out = self.empty(len(checked))
        self._fill(out, range(len(checked)), self._numbers_at(checked))
        return out

    def empty(self, count: int) -> Batch:
        """Uninitialised batch of `count` videos."""
        return self._concatenation.empty(count)

    def _fill(self, out: Batch, rows: Numbers, indices: Numbers, starts: Numbers | None = None) -> None:
        """Read videos of the concatenation into these rows of `out`. Parameters are those of `Dataset._fill`."""
        self._concatenation._fill(out, rows, indices, starts)

    def _numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray:
        """Indices into the concatenated datasets, int64 [n], of the videos at these positions of an epoch.

        Each dataset is shuffled by a seed of its own, or read in order if `seed` is None. An epoch continues in each
        dataset where the previous epoch stopped.
        """
        periods, steps = np.divmod(positions, len(self._schedule))
        owners, numbers = self._schedule[steps], np.empty(len(positions), np.int64)
        for owner, rows in groups_of(owners):
            counts = self._counts_before[:, owner]
            offset = epoch * self._epoch_counts[owner] + periods[rows] * counts[-1] + counts[steps[rows]]
            source, cycles = self._concatenation.datasets[owner], offset // self._concatenation._sizes[owner]
            source_seed = None if seed is None else int(hashed(SOURCES, seed, owner)[0])
            for cycle in np.unique(cycles):
                selected = rows[cycles == cycle]
                indices = source._numbers_at(offset[cycles == cycle] % len(source), int(cycle), source_seed)
                numbers[selected] = self._concatenation._firsts[owner] + indices
        return numbers

    def _starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
        """First frame of each video's window, sampled from random bits; None if windows are not random."""
        return self._concatenation._starts(numbers, bits)

    def source_of(self, positions: Numbers) -> list[str]:
        """Name of the dataset at each of these positions, which is the same in every epoch."""
        names = list(self.datasets)
        return [names[owner] for owner in self._schedule[np.asarray(positions) % len(self._schedule)]]


def tijdeman_schedule(shares: Sequence[int], sizes: Sequence[int]) -> np.ndarray:
    """Position of the dataset at each step of a period of sum(shares) steps, shorter if a dataset runs out of videos.

    Of the datasets that are due, the one with the earliest deadline comes next (Tijdeman 1980). This keeps the count of
    each of K datasets within 1 - 1 / (2K - 2) of its share. Integer arithmetic makes the result the same everywhere.
    """
    period, scale, unit = sum(shares), max(2 * len(shares) - 2, 1), math.lcm(*shares)
    counts = [0] * len(shares)
    schedule: list[int] = []
    for length in range(1, period + 1):
        due = [k for k, share in enumerate(shares) if scale * (share * length - period * counts[k]) >= period]
        owner = min(due, key=lambda k: (scale - 1 + scale * counts[k]) * (unit // shares[k]))
        if counts[owner] == sizes[owner]:
            break
        counts[owner] += 1
        schedule.append(owner)
    return np.array(schedule)


def _shares(names: list[str], weights: Weights | None) -> list[int]:
    """Smallest integers in the same proportions as the weights."""
    if isinstance(weights, Mapping):
        if set(weights) != set(names):
            raise ConfigError(f"weights has the names {', '.join(weights)}, but must have {', '.join(names)}")
        weights = [weights[name] for name in names]
    values = [1.0] * len(names) if weights is None else list(weights)
    if len(values) != len(names):
        raise ConfigError(f"weights has {len(values)} numbers, but there are {len(names)} datasets")
    fractions = [_fraction(name, weight) for name, weight in zip(names, values, strict=True)]
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


def _check_equal_fields(first: str, one: VideoReader, name: str, other: VideoReader) -> None:
    """Raise ConfigError if videos of two datasets do not fit in one batch."""
    one_batch, other_batch = one.empty(1), other.empty(1)
    for field in sorted(one_batch.keys() ^ other_batch.keys()):
        has, lacks = (first, name) if field in one_batch else (name, first)
        raise ConfigError(f"dataset {lacks} has no field {field!r}, but {has} has: open both with the same fields")
    for field, values in one_batch.items():
        types = [f"{array.dtype} {array.shape[1:]}" for array in (values, other_batch[field])]
        if types[0] != types[1]:
            raise ConfigError(f"{field} of dataset {name} is {types[1]}, but of {first} {types[0]}")
