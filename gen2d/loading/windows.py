"""Reading of whole videos or windows by epoch and index, for the loaders of other libraries.

A random window is computed from the seed, the epoch and the index or position of its video. It does not depend on the
order of reading, so any number of workers reads the same windows.
"""

import sys

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.permutation import hashed
from gen2d.loading.epochs import INDEX_WINDOWS, WINDOWS, check_one_of, whole_number
from gen2d.loading.mixture import Mixture
from gen2d.loading.protocols import Batch, Numbers, VideoReader, checked_numbers


def checked_source(ds: object, name: str = "ds") -> VideoReader | Mixture:
    """The dataset itself, which error messages call `name`.

    Raises ConfigError for anything that `gen2d.open` and `gen2d.mix` do not return.
    """
    if not all(hasattr(ds, name) for name in ("_numbers_at", "_starts", "_fill", "empty")):
        raise ConfigError(f"{name} is {ds!r:.80}, but must be a dataset from gen2d.open or gen2d.mix")
    return ds  # pyright: ignore[reportReturnType]


def batch_of_epoch(source: VideoReader | Mixture, indices: Numbers, epoch: int, seed: int) -> Batch:
    """Batch of the videos with these indices; random windows follow from the seed, the epoch and the index.

    A mixture continues in each dataset where the previous epoch stopped.
    """
    positions = checked_numbers(indices, len(source), "the dataset")
    bits = hashed(INDEX_WINDOWS, seed, epoch, positions)
    return _read(source, source._numbers_at(positions, epoch), bits)


def batch_at(
    source: VideoReader | Mixture, positions: np.ndarray, epoch: int, seed: int, shuffled_by: int | None
) -> Batch:
    """Batch of the videos at these positions of an epoch: those, with their windows, that `DataLoader` gives."""
    numbers = source._numbers_at(positions, epoch, shuffled_by)
    return _read(source, numbers, hashed(WINDOWS, seed, epoch, positions))


def _read(source: VideoReader | Mixture, numbers: np.ndarray, bits: np.ndarray) -> Batch:
    out = source.empty(len(numbers))
    source._fill(out, range(len(numbers)), numbers, source._starts(numbers, bits))
    return out


class EpochSource:
    """Videos in the order of successive epochs, with a length and random access, as `gen2d.grain.source` returns it.

    Parameters are those of `gen2d.grain.source`.
    """

    def __init__(self, ds: VideoReader | Mixture, seed: int, shuffle: bool | str, epochs: int | None) -> None:
        check_one_of("shuffle", shuffle, ("global", True, False))
        self._source, self._seed = checked_source(ds), whole_number("seed", seed, None)
        self._shuffle, self._epochs = bool(shuffle), epochs if epochs is None else whole_number("epochs", epochs, 1)

    def __len__(self) -> int:
        """Number of videos in all epochs; `sys.maxsize` if they never end."""
        return sys.maxsize if self._epochs is None else len(self._source) * self._epochs

    def __getitem__(self, index: int) -> Batch:
        """The video at position `index % n` of epoch `index // n`, if an epoch has n videos."""
        position = whole_number("index", index, None)
        position += len(self) if position < 0 else 0
        if not 0 <= position < len(self):
            raise IndexError(f"index {index} is not there: {self._epochs} epochs have {len(self)} videos")
        epoch, position = divmod(position, len(self._source))
        batch = batch_at(self._source, np.array([position]), epoch, self._seed, self._seed if self._shuffle else None)
        return {name: values[0] for name, values in batch.items()}

    def __repr__(self) -> str:
        """What the source is, which Grain stores beside its states."""
        epochs = "endless" if self._epochs is None else self._epochs
        return f"<{epochs} epochs of {self._source!r}, seed {self._seed}, {'' if self._shuffle else 'not '}shuffled>"
