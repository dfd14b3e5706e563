"""Selections of videos, and tables of their values: methods that datasets, concatenations and selections share."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.loading.epochs import epoch_indices
from gen2d.loading.filters import parse_filter
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
from gen2d.loading.tables import columns, describe_html, describe_text, optional_package, table_fields

if TYPE_CHECKING:
    import pandas

SCANNED = 4096  # videos whose values are read at once


def matching(videos: VideoReader, condition: str, name: str = "filter") -> np.ndarray:
    """Numbers of the videos of which a condition is true, ascending, int64; only the fields in it are read.

    Error messages call the condition `name`. Raises ConfigError if it is invalid, or names a field that is not stored.
    """
    parsed = parse_filter(condition, videos._stored_fields, videos._stored_sizes, videos._short_name, name)
    mask = np.zeros(len(videos), bool)
    for first in range(0, len(videos), SCANNED):
        numbers = np.arange(first, min(first + SCANNED, len(videos)))
        mask[numbers] = parsed.evaluate(videos._stored(parsed.fields, numbers))
    return np.flatnonzero(mask)


class Selectable:
    """Methods of everything that has videos with stored fields."""

    def select(self: VideoReader, indices: Numbers) -> "Subset":
        """The videos with these indices, in this order, without reading them.

        Parameters
        ----------
        indices : sequence of int or of bool
            Indices; negative ones count from the end. A mask has a bool for each video.

        Returns
        -------
        Subset
            A dataset of these videos, for `DataLoader`, `gen2d.torch`, `gen2d.grain` and `gen2d.mix`.

        Raises
        ------
        IndexError, TypeError
            If an index is out of range, or not an integer.
        ConfigError
            If a mask has another length.

        Examples
        --------
        >>> few = ds.select(range(0, len(ds), 10))
        """
        numbers = np.asarray(indices)
        if numbers.dtype == bool:
            if numbers.shape != (len(self),):
                raise ConfigError(f"the mask has the shape {numbers.shape}, but there are {len(self)} videos")
            numbers = np.flatnonzero(numbers)
        if numbers.ndim != 1:
            raise ConfigError(f"indices have the shape {numbers.shape}, but must be a list of numbers")
        return Subset(self, checked_numbers(numbers, len(self), "the dataset"))

    def filter(self: VideoReader, condition: str) -> "Subset":
        """The videos of which a condition is true, in their order; only the fields in it are read.

        Parameters
        ----------
        condition : str
            Comparisons of stored fields with numbers, texts or other fields, joined by `and`, `or` and `not`, such as
            "factors/balls > 3 and factors/gravity_y < -5". A field of several values per video takes indices:
            "objects/radius[0] > 1". Fields with codes are compared with numbers or names.

        Returns
        -------
        Subset
            A dataset of these videos, which may be empty.

        Raises
        ------
        ConfigError
            If the condition is invalid, or names a field that is not stored. Reading raises the errors of `batch`.

        Examples
        --------
        >>> many = ds.filter("factors/balls >= 4 and index < 50")
        """
        return Subset(self, matching(self, condition))

    def to_pandas(self: VideoReader, fields: Sequence[str] | str | None = None) -> "pandas.DataFrame":
        """DataFrame with a row per video; needs pandas.

        Parameters
        ----------
        fields : str or sequence of str, optional
            Names of stored fields that are not images. The default is all that have neither frames nor object slots:
            the factors and other values per video.

        Returns
        -------
        pandas.DataFrame
            A column for each value of a field, in the unit of the field; several values are NAME[0], NAME[1] and so on.

        Raises
        ------
        ConfigError
            If there is no such field, or it is an image. Reading raises the errors of `batch`.
        ModuleNotFoundError
            If pandas is not installed.

        Examples
        --------
        >>> table = ds.to_pandas()
        >>> few = ds.select(table["factors/gravity[1]"] < -5)
        """
        package = optional_package("pandas", "to_pandas")
        return package.DataFrame(_columns_of(self, fields))

    def to_arrow(self: VideoReader, fields: Sequence[str] | str | None = None) -> Any:
        """Arrow table with a row per video; needs pyarrow.

        Parameters
        ----------
        fields : str or sequence of str, optional
            Names of stored fields, as in `to_pandas`.

        Returns
        -------
        pyarrow.Table
            The columns of `to_pandas`; the metadata of a column hold its unit and meaning.

        Raises
        ------
        ConfigError
            If there is no such field, or it is an image. Reading raises the errors of `batch`.
        ModuleNotFoundError
            If pyarrow is not installed.
        """
        package, known = optional_package("pyarrow", "to_arrow"), self._stored_fields
        found = {name: package.array(values) for name, values in _columns_of(self, fields).items()}
        about = {name: known[name.partition("[")[0]] for name in found}
        schema = [
            package.field(name, array.type, metadata={"unit": about[name].unit, "meaning": about[name].meaning})
            for name, array in found.items()
        ]
        return package.Table.from_arrays(list(found.values()), schema=package.schema(schema))

    def __iter__(self: VideoReader) -> Iterator[Batch]:
        """The videos one after the other, as those of integer indices."""
        return (item(self, index) for index in range(len(self)))

    def __repr__(self: VideoReader) -> str:
        return describe_text(self._title, self._details, self.fields)

    def _repr_html_(self: VideoReader) -> str:
        return describe_html(self._title, self._details, self.fields)


def _columns_of(source: VideoReader, names: Sequence[str] | str | None) -> dict[str, Any]:
    fields = source._stored_fields
    chosen = table_fields(fields, names, source._short_name)
    numbers = np.arange(len(source))
    parts = [
        source._stored(chosen, numbers[first : first + SCANNED]) for first in range(0, max(len(source), 1), SCANNED)
    ]
    return columns({name: np.concatenate([part[name] for part in parts]) for name in chosen}, fields)


class Subset(Selectable):
    """Some videos of a dataset, as `select` and `filter` return them; itself a map-style dataset.

    Index i of a subset is index `indices[i]` of its source. Fields, views and statistics are those of the source.

    Attributes
    ----------
    source : Dataset, ConcatDataset or Subset
        The dataset from which videos are selected.
    indices : ndarray, int64 [n]
        Indices of the videos in the source.
    """

    def __init__(self, source: VideoReader, indices: np.ndarray) -> None:
        self.source, self.indices = source, np.asarray(indices, np.int64)

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, key: Key) -> Batch:
        """One video for an integer, or a batch of videos for a slice or a sequence of integers."""
        return item(self, key)

    def __getitems__(self, indices: Numbers) -> list[Batch]:
        """List of videos; torch's DataLoader calls this method once per batch."""
        return unbatch(self.batch(indices))

    @property
    def fields(self) -> dict[str, Field]:
        """The fields of each video, by name."""
        return self.source.fields

    @property
    def _stored_fields(self) -> Mapping[str, Field]:
        """All stored fields, by name."""
        return self.source._stored_fields

    @property
    def _stored_sizes(self) -> Mapping[str, int]:
        """Sizes of the axes of the stored fields."""
        return self.source._stored_sizes

    @property
    def exact(self) -> bool:
        """Whether all fields are those of the dataset to the bit, as `Dataset.exact`."""
        return self.source.exact

    @property
    def _slice_size(self) -> int:
        """Number of videos that are best filled together."""
        return self.source._slice_size

    @property
    def time(self) -> np.ndarray:
        """Times of all frames of a video, s, float64 [T]."""
        return self.source.time

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.source.fps

    @property
    def stats(self) -> FieldStats:
        """Statistics of each field, over all videos of the source."""
        return self.source.stats

    @property
    def snapshot(self) -> Snapshot:
        """Snapshot of the source, and the sha256 of the indices."""
        return [self.source.snapshot, hashlib.sha256(self.indices.astype("<i8").tobytes()).hexdigest()]

    @property
    def _short_name(self) -> str:
        """Name of the source for error messages."""
        return self.source._short_name

    @property
    def _title(self) -> str:
        """First line of the description."""
        return f"{len(self):,} of the {self.source._title}"

    @property
    def _details(self) -> list[str]:
        """Further lines of the description."""
        return self.source._details

    def at(self, snapshot: Snapshot) -> "Subset":
        """The same videos of an earlier snapshot of the source.

        Raises ConfigError for a snapshot of another selection, and the errors of `at` of the source.
        """
        if snapshot == self.snapshot:
            return self
        if not isinstance(snapshot, list) or len(snapshot) != 2 or snapshot[1] != self.snapshot[1]:
            raise ConfigError("the state is of other videos than those that are selected here")
        return Subset(self.source.at(snapshot[0]), self.indices)

    def batch(self, indices: Numbers, starts: Numbers | None = None, out: Batch | None = None) -> Batch:
        """Batch of the videos with these indices. Parameters and errors are those of `Dataset.batch`."""
        return read_batch(self, checked_numbers(indices, len(self), "the selection"), starts, out)

    def empty(self, count: int) -> Batch:
        """Uninitialised batch of `count` videos."""
        return self.source.empty(count)

    def _fill(self, out: Batch, rows: Numbers, indices: Numbers, starts: Numbers | None = None) -> None:
        """Read the videos with these indices into these rows of `out`. Parameters are those of `Dataset._fill`."""
        self.source._fill(out, rows, self.indices[np.asarray(indices)], starts)

    def _stored(self, names: Sequence[str], indices: Numbers) -> Batch:
        """Stored values of whole videos, as those of `Dataset._stored`."""
        return self.source._stored(names, self.indices[np.asarray(indices)])

    def _numbers_at(self, positions: np.ndarray, epoch: int = 0, seed: int | None = None) -> np.ndarray:
        """Indices of the videos at these positions of an epoch, shuffled unless `seed` is None."""
        return epoch_indices(seed, epoch, positions, len(self))

    def _starts(self, numbers: np.ndarray, bits: np.ndarray) -> np.ndarray | None:
        """First frame of each video's window, sampled from random bits; None if windows are not random."""
        return self.source._starts(self.indices[numbers], bits)
