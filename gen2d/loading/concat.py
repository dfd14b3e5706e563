"""Concatenation of datasets."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.loading.epochs import epoch_indices
from gen2d.loading.protocols import (
    Batch,
    FieldStats,
    Key,
    Numbers,
    Snapshot,
    VideoReader,
    checked_numbers,
    item,
    read_batch,
    unbatch,
)
from gen2d.loading.selection import Selectable


class ConcatDataset(Selectable):
    """Concatenation of datasets, as `gen2d.open` returns it for a list of paths.

    Index i counts through the datasets in their order. It is a map-style dataset, so torch and grain accept it too.

    Parameters
    ----------
    datasets : sequence of VideoReader
        Datasets with equal fields, shapes, dtypes and frame rates. `gen2d.open` checks this; the constructor does not.
    """

    def __init__(self, datasets: Sequence[VideoReader]) -> None:
        self.datasets = list(datasets)
        self._sizes = np.array([len(source) for source in self.datasets])
        self._firsts = np.cumsum(self._sizes) - self._sizes  # index of each dataset's first video

    def __len__(self) -> int:
        return int(self._sizes.sum())

    def __getitem__(self, key: Key) -> Batch:
        """One video for an integer, or a batch of videos for a slice or a sequence of integers."""
        return item(self, key)

    def __getitems__(self, indices: Numbers) -> list[Batch]:
        """List of videos; torch's DataLoader calls this method once per batch."""
        return unbatch(self.batch(indices))

    def __getattr__(self, name: str) -> Any:
        if name in ("config", "splits"):
            raise AttributeError(f"each of the {len(self.datasets)} datasets has its own {name}: ds.datasets[0].{name}")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @property
    def _stored_fields(self) -> Mapping[str, Field]:
        """The stored fields that all datasets have, by name."""
        first, *others = (source._stored_fields for source in self.datasets)
        return {name: field for name, field in first.items() if all(name in fields for fields in others)}

    @property
    def _stored_sizes(self) -> Mapping[str, int]:
        """Sizes of the axes of the stored fields."""
        return self.datasets[0]._stored_sizes

    @property
    def _short_name(self) -> str:
        """Names of the datasets for error messages."""
        return ", ".join(source._short_name for source in self.datasets)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.datasets[0].fps

    @property
    def _title(self) -> str:
        """First line of the description."""
        return f"{len(self):,} videos of {len(self.datasets)} datasets, one after the other"

    @property
    def _details(self) -> list[str]:
        """Further lines of the description."""
        return [*(source._title for source in self.datasets), *self.datasets[0]._details[:1]]

    @property
    def fields(self) -> dict[str, Field]:
        """The fields of each video, by name."""
        return self.datasets[0].fields

    @property
    def exact(self) -> bool:
        """Whether all fields are those of the datasets to the bit, as `Dataset.exact`."""
        return all(source.exact for source in self.datasets)

    @property
    def _slice_size(self) -> int:
        """Number of videos that are best filled together."""
        return max(source._slice_size for source in self.datasets)

    @property
    def time(self) -> np.ndarray:
        """Times of all frames of a video, s, float64 [T]."""
        return self.datasets[0].time

    @property
    def stats(self) -> FieldStats:
        """Pooled statistics of each field; datasets are weighted by their numbers of videos."""
        parts = [source.stats for source in self.datasets]
        return {name: _pool_stats([part[name] for part in parts], self._sizes) for name in parts[0]}

    @property
    def snapshot(self) -> Snapshot:
        """Snapshots of the datasets, in their order."""
        return [source.snapshot for source in self.datasets]

    def at(self, snapshot: Snapshot) -> "ConcatDataset":
        """The same datasets at earlier snapshots.

        Raises ConfigError if the number of snapshots differs, FolderError if a folder does not have its snapshot.
        """
        return self if snapshot == self.snapshot else ConcatDataset(at_snapshots(self.datasets, snapshot))

    def batch(self, indices: Numbers, starts: Numbers | None = None, out: Batch | None = None) -> Batch:
        """Batch of the videos with these indices. Parameters and errors are those of `Dataset.batch`."""
        return read_batch(self, checked_numbers(indices, len(self), "the whole"), starts, out)

    def empty(self, count: int) -> Batch:
        """Uninitialised batch of `count` videos."""
        return self.datasets[0].empty(count)

    def _fill(self, out: Batch, rows: Numbers, indices: Numbers, starts: Numbers | None = None) -> None:
        """Read the videos with these indices into these rows of `out`. Parameters are those of `Dataset._fill`."""
        numbers, targets = np.asarray(indices), np.asarray(rows)
        for owner, members in self._group_by_dataset(numbers):
            own_starts = None if starts is None else np.asarray(starts)[members]
            self.datasets[owner]._fill(out, targets[members], numbers[members] - self._firsts[owner], own_starts)

    def _stored(self, names: Sequence[str], indices: Numbers) -> Batch:
        """Stored values of whole videos, as those of `Dataset._stored`."""
        numbers, found = np.asarray(indices), self.datasets[0]._stored(names, [])
        out = {name: np.empty((len(numbers), *values.shape[1:]), values.dtype) for name, values in found.items()}
        for owner, members in self._group_by_dataset(numbers):
            for name, values in self.datasets[owner]._stored(names, numbers[members] - self._firsts[owner]).items():
                out[name][members] = values
        return out

    def _numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray:
        """Indices of the videos at these positions of an epoch, shuffled over all datasets unless `seed` is None."""
        return epoch_indices(seed, epoch, positions, len(self))

    def _starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
        """First frame of each video's window, sampled from random bits; None if windows are not random."""
        starts = np.zeros(len(numbers), np.int64)
        for owner, members in self._group_by_dataset(numbers):
            own_starts = self.datasets[owner]._starts(numbers[members] - self._firsts[owner], bits[members])
            if own_starts is None:
                return None
            starts[members] = own_starts
        return starts

    def _group_by_dataset(self, numbers: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Position of each dataset that holds some of these videos, and their positions in `numbers`."""
        return groups_of(np.searchsorted(self._firsts, numbers, side="right") - 1)


def at_snapshots(datasets: Sequence[VideoReader], snapshots: Snapshot) -> list[VideoReader]:
    """Each dataset at its snapshot. Raises ConfigError if the number of snapshots differs from that of the datasets."""
    if not isinstance(snapshots, list) or len(snapshots) != len(datasets):
        count = len(snapshots) if isinstance(snapshots, list) else 1
        raise ConfigError(f"the state is of {count} datasets, but there are {len(datasets)}")
    return [source.at(snapshot) for source, snapshot in zip(datasets, snapshots, strict=True)]


def groups_of(owners: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Each value that occurs in `owners`, and its positions."""
    return ((int(owner), np.flatnonzero(owners == owner)) for owner in np.unique(owners))


def _pool_stats(parts: Sequence[Mapping[str, list[float] | None]], sizes: np.ndarray) -> dict[str, list[float] | None]:
    """Pooled statistics of a field over datasets of these sizes; None if any dataset has none."""
    if any(values is None for part in parts for values in part.values()):
        return dict.fromkeys(parts[0])
    mean, std, low, high = (np.array([part[key] for part in parts]) for key in ("mean", "std", "min", "max"))
    weights = (sizes / sizes.sum())[:, None]
    pooled_mean = (weights * mean).sum(0)
    pooled_std = np.sqrt((weights * (std**2 + (mean - pooled_mean) ** 2)).sum(0))
    values = {"mean": pooled_mean, "std": pooled_std, "min": low.min(0), "max": high.max(0)}
    return {key: value.tolist() for key, value in values.items()}
