"""Several datasets as one."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.loading.epochs import shuffled
from gen2d.loading.protocols import (
    Batch,
    FieldStats,
    Key,
    Numbers,
    Snapshot,
    VideoReader,
    checked_numbers,
    filled,
    item,
    unbatch,
)


class ConcatDataset:
    """Several datasets as one, one after the other: numbers are counted on from each to the next.

    Also a map-style dataset for torch and grain. The `datasets` must be alike.
    """

    def __init__(self, datasets: Sequence[VideoReader]) -> None:
        self.datasets = list(datasets)
        self.sizes = np.array([len(source) for source in self.datasets])
        self.firsts = np.cumsum(self.sizes) - self.sizes  # the number of each dataset's first video

    def __len__(self) -> int:
        return int(self.sizes.sum())

    def __getitem__(self, key: Key) -> Batch:
        """One video, or for a slice or a sequence of numbers several, stacked."""
        return item(self, key)

    def __getitems__(self, indices: Numbers) -> list[Batch]:
        """The videos one by one; torch's DataLoader asks for a whole batch so."""
        return unbatch(self.batch(indices))

    def __repr__(self) -> str:
        return f"<{len(self)} videos, one after the other of {', '.join(map(repr, self.datasets))}>"

    @property
    def fields(self) -> dict[str, Field]:
        """What each video has, by name."""
        return self.datasets[0].fields

    @property
    def time(self) -> np.ndarray:
        """The time of every frame of a whole video, s, float64 [T]."""
        return self.datasets[0].time

    @property
    def stats(self) -> FieldStats:
        """Those of all datasets together, each of which counts by its number of videos."""
        parts = [source.stats for source in self.datasets]
        return {name: _together([part[name] for part in parts], self.sizes) for name in parts[0]}

    @property
    def snapshot(self) -> Snapshot:
        """The snapshot of each dataset, in their order."""
        return [source.snapshot for source in self.datasets]

    def at(self, snapshot: Snapshot) -> "ConcatDataset":
        """The same datasets at earlier snapshots, while these are there."""
        return self if snapshot == self.snapshot else ConcatDataset(at_snapshots(self.datasets, snapshot))

    def batch(self, indices: Numbers, starts: Numbers | None = None, out: Batch | None = None) -> Batch:
        """The videos with these numbers, stacked; windows begin at `starts`; `out` is filled if given."""
        return filled(self, checked_numbers(indices, len(self), "the whole"), starts, out)

    def empty(self, count: int) -> Batch:
        """A batch of `count` videos that is yet to be filled."""
        return self.datasets[0].empty(count)

    def fill(self, out: Batch, rows: Numbers, indices: Numbers, starts: Numbers | None = None) -> None:
        """Returns nothing; puts the videos with these numbers into these rows of `out`, windows from `starts` on."""
        numbers, places = np.asarray(indices), np.asarray(rows)
        for owner, own in self._shared(numbers):
            begins = None if starts is None else np.asarray(starts)[own]
            self.datasets[owner].fill(out, places[own], numbers[own] - self.firsts[owner], begins)

    def numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray:
        """The numbers of the videos at these positions of an epoch: in order, or as the seed shuffles all of them."""
        return shuffled(seed, epoch, positions, len(self))

    def starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
        """Where the windows of these videos begin, drawn by random bits; None if that is not random."""
        starts = np.zeros(len(numbers), np.int64)
        for owner, own in self._shared(numbers):
            found = self.datasets[owner].starts(numbers[own], bits[own])
            if found is None:
                return None
            starts[own] = found
        return starts

    def _shared(self, numbers: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Each dataset that has some of these videos, and which of them."""
        return groups_of(np.searchsorted(self.firsts, numbers, side="right") - 1)


def at_snapshots(datasets: Sequence[VideoReader], snapshots: Snapshot) -> list[VideoReader]:
    """Each dataset at its own of these snapshots. Raises ConfigError where they are not of so many datasets."""
    if not isinstance(snapshots, list) or len(snapshots) != len(datasets):
        count = len(snapshots) if isinstance(snapshots, list) else 1
        raise ConfigError(f"the state is of {count} datasets, but there are {len(datasets)}")
    return [source.at(snapshot) for source, snapshot in zip(datasets, snapshots, strict=True)]


def groups_of(owners: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Each owner that occurs, and where."""
    return ((int(owner), np.flatnonzero(owners == owner)) for owner in np.unique(owners))


def _together(parts: Sequence[Mapping[str, list[float] | None]], sizes: np.ndarray) -> dict[str, list[float] | None]:
    """The statistics of a field in several datasets of these sizes; None where one of them has none."""
    if any(values is None for part in parts for values in part.values()):
        return dict.fromkeys(parts[0])
    mean, std, low, high = (np.array([part[key] for part in parts]) for key in ("mean", "std", "min", "max"))
    share = (sizes / sizes.sum())[:, None]
    middle = (share * mean).sum(0)
    spread = np.sqrt((share * (std**2 + (mean - middle) ** 2)).sum(0))
    values = {"mean": middle, "std": spread, "min": low.min(0), "max": high.max(0)}
    return {key: value.tolist() for key, value in values.items()}
