"""Consecutive videos, ready to store.

Host threads encode a Block while the device computes the next one: they compress images, and compute the checksum of
every chunk and the moments for the statistics. `hdf5.py` lists the files that decide the bytes of a shard.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gen2d.core.schema import Field
from gen2d.dataset.statistics import moments_of
from gen2d.storage import codecs


@dataclasses.dataclass(frozen=True)
class Block:
    """m consecutive videos, ready to store."""

    arrays: Mapping[str, np.ndarray]  # uncompressed fields, [m, ...]
    chunks: Mapping[str, list[bytes]]  # compressed images, the same number for every video
    crc: Mapping[str, np.ndarray]  # uint32 of every field: over each chunk, or [m] over the bytes of each row
    moments: Mapping[str, np.ndarray]  # float64 [m, 5, components]: count, sum, sum of squares, least, largest

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))

    @property
    def nbytes(self) -> int:
        """The size on disk in bytes."""
        chunks = sum(len(chunk) for chunks in self.chunks.values() for chunk in chunks)
        return chunks + sum(values.nbytes for values in self.arrays.values())


def image_names(fields: Mapping[str, Field]) -> list[str]:
    """The names of the compressed fields, sorted."""
    return sorted(name for name, field in fields.items() if field.is_image)


def row_names(fields: Mapping[str, Field]) -> list[str]:
    """The names of the uncompressed fields of each video, sorted."""
    return sorted(name for name, field in fields.items() if field.per_video and not field.is_image)


def stored_bytes(field: Field, sizes: Mapping[str, int]) -> int:
    """The size of one video's value before compression, in bytes."""
    return math.prod(field.shape(sizes)) * np.dtype(field.dtype).itemsize


def encode(
    columns: Mapping[str, np.ndarray], fields: Mapping[str, Field], codec: str, chunk_frames: int | None = None
) -> Block:
    """A Block of m videos from columns [m, ...].

    An image's chunk holds `chunk_frames` frames, or the whole video. Nearly all the time is spent without the GIL.
    Raises ValueError for a column of another dtype.
    """
    columns = {name: _contiguous(name, columns[name], field) for name, field in fields.items() if field.per_video}
    chunks = {
        name: [codecs.encode(codec, piece) for video in column for piece in _split(video, chunk_frames)]
        for name, column in columns.items()
        if fields[name].is_image
    }
    arrays = {name: column for name, column in columns.items() if name not in chunks}
    crc = {name: _crc(video_chunks) for name, video_chunks in chunks.items()}
    crc |= {name: _crc(_rows(column)) for name, column in arrays.items()}
    return Block(arrays, chunks, crc, moments_of(columns, fields))


def head(block: Block, count: int) -> Block:
    """The block's first `count` videos."""
    videos = len(block)
    parts = vars(block).values()
    return Block(*({name: part[name][: len(part[name]) // videos * count] for name in part} for part in parts))


def _split(video: np.ndarray, frames: int | None) -> Iterable[np.ndarray]:
    """The video in parts of so many frames, or as one part."""
    return (video,) if frames is None else video.reshape(-1, frames, *video.shape[1:])


def _contiguous(name: str, column: np.ndarray, field: Field) -> np.ndarray:
    if column.dtype != np.dtype(field.dtype):
        raise ValueError(f"{name} is {column.dtype}, but must be {field.dtype}")
    return np.ascontiguousarray(column)


def _rows(column: np.ndarray) -> np.ndarray:
    """The bytes of each video, uint8 [m, size]."""
    return column.view(np.uint8).reshape(len(column), -1)


def _crc(pieces: Iterable[Any]) -> np.ndarray:
    return np.array([codecs.crc32(piece) for piece in pieces], np.uint32)
