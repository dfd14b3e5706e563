"""Protocols of datasets and concatenations, and the indexing that they share with mixtures."""

from collections.abc import Mapping, Sequence
from typing import Protocol, SupportsIndex, TypeAlias

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field

Batch = dict[str, np.ndarray]
Numbers = Sequence[int] | np.ndarray
Key = SupportsIndex | slice | Numbers  # index of one video, or of several
Snapshot: TypeAlias = "str | list[Snapshot]"  # of one dataset, or of each of several
# Values that JSON can store.
LoaderState: TypeAlias = "Mapping[str, int | bool | str | list[Snapshot] | list[int] | None]"
FieldStats = dict[str, dict[str, list[float] | None]]  # mean, std, min and max of each component, by field


class VideoSequence(Protocol):
    """Source of batches by index."""

    def __len__(self) -> int: ...

    def batch(self, indices: Numbers, /) -> Batch: ...


class VideoReader(Protocol):
    """Source of videos for `DataLoader`: a Dataset, a ConcatDataset or a Subset. `Dataset` describes the methods.

    Names with an underscore are for gen2d's own loaders.
    """

    def __len__(self) -> int: ...

    @property
    def fields(self) -> dict[str, Field]: ...

    @property
    def _stored_fields(self) -> Mapping[str, Field]: ...

    @property
    def _stored_sizes(self) -> Mapping[str, int]: ...

    @property
    def _short_name(self) -> str: ...  # for error messages

    @property
    def _title(self) -> str: ...  # first line of the description

    @property
    def _details(self) -> list[str]: ...  # further lines

    @property
    def fps(self) -> float: ...

    @property
    def _slice_size(self) -> int: ...  # number of videos that are best filled together

    @property
    def exact(self) -> bool: ...

    @property
    def stats(self) -> FieldStats: ...

    @property
    def time(self) -> np.ndarray: ...

    @property
    def snapshot(self) -> Snapshot: ...

    def at(self, snapshot: Snapshot) -> "VideoReader": ...

    def empty(self, count: int) -> Batch: ...

    def batch(self, indices: Numbers, /) -> Batch: ...

    def _stored(self, names: Sequence[str], indices: Numbers) -> Batch: ...

    def _fill(self, out: Batch, rows: Numbers, indices: Numbers, starts: Numbers | None = None) -> None: ...

    def _numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray: ...

    def _starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None: ...


def item(videos: VideoSequence, key: Key) -> Batch:
    """One video for an integer key, or a batch of videos for a slice or a sequence of integers."""
    if isinstance(key, slice):
        return videos.batch(range(*key.indices(len(videos))))
    numbers = np.asarray(key)
    batch = videos.batch(np.atleast_1d(numbers))
    return batch if numbers.ndim else {name: values[0] for name, values in batch.items()}


def unbatch(batch: Batch) -> list[Batch]:
    """List of the videos in a batch."""
    return [dict(zip(batch, values, strict=True)) for values in zip(*batch.values(), strict=True)]


def checked_numbers(indices: Numbers, count: int, whose: str) -> np.ndarray:
    """Indices from 0 to count - 1, int64 [n]; negative indices count from the end.

    Raises TypeError for indices that are not integers, IndexError for indices out of range.
    """
    numbers = np.asarray(indices)
    if not np.issubdtype(numbers.dtype, np.integer) and len(numbers):
        raise TypeError(f"a video's number must be an integer, not {numbers.dtype}")
    wrong = numbers[(numbers < -count) | (numbers >= count)]
    if len(wrong):
        raise IndexError(f"video {wrong[0]} is not there: {whose} has {count} videos")
    return np.where(numbers < 0, numbers + count, numbers).astype(np.int64)


def read_batch(source: VideoReader, numbers: np.ndarray, starts: Numbers | None, out: Batch | None) -> Batch:
    """Batch of the source's videos with these indices, in `out` if given. Raises ConfigError if `out` does not fit."""
    if out is None:
        out = source.empty(len(numbers))
    else:
        _check_out(out, source.empty(0), len(numbers))
    source._fill(out, range(len(numbers)), numbers, starts)  # pyright: ignore[reportPrivateUsage]
    return out


def _check_out(out: Batch, like: Batch, count: int) -> None:
    """Raise ConfigError unless `out` has the fields of the batch `like`, with room for `count` videos."""
    for name, values in like.items():
        array, shape = out.get(name), (count, *values.shape[1:])
        if array is None or array.shape != shape or array.dtype != values.dtype or not array.flags.c_contiguous:
            raise ConfigError(f"out[{name!r}] must be a contiguous {values.dtype} array of shape {shape}")
