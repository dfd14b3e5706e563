"""Consecutive videos, ready to store.

A Block is made in host threads, while the device computes what follows: images are compressed, every piece gets its
checksum, and what the statistics need is summed.
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

    arrays: Mapping[str, np.ndarray]  # fields stored as they are, [m, ...]
    chunks: Mapping[str, list[bytes]]  # images, compressed, the same number for every video
    crc: Mapping[str, np.ndarray]  # uint32 of every field: over each chunk, or [m] over the bytes of each row
    moments: Mapping[str, np.ndarray]  # float64 [m, 5, components]: count, sum, sum of squares, least, largest

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))

    @property
    def nbytes(self) -> int:
        """What it takes on disk."""
        chunks = sum(len(chunk) for chunks in self.chunks.values() for chunk in chunks)
        return chunks + sum(values.nbytes for values in self.arrays.values())


def image_names(fields: Mapping[str, Field]) -> list[str]:
    """The fields that are stored compressed, sorted."""
    return sorted(name for name, field in fields.items() if field.is_image)


def row_names(fields: Mapping[str, Field]) -> list[str]:
    """The fields of each video that are stored as they are, sorted."""
    return sorted(name for name, field in fields.items() if field.per_video and not field.is_image)


def stored_bytes(field: Field, sizes: Mapping[str, int]) -> int:
    """What one video's value takes before compression."""
    return math.prod(field.shape(sizes)) * np.dtype(field.dtype).itemsize


def encode(
    columns: Mapping[str, np.ndarray], fields: Mapping[str, Field], codec: str, chunk_frames: int | None = None
) -> Block:
    """A Block of m videos from columns `[m, ...]` as stored, images in chunks of so many frames, or of all; spends its
    time in code that releases the GIL."""
    columns = {name: _checked(name, columns[name], field) for name, field in fields.items() if field.per_video}
    chunks = {
        name: [codecs.encode(codec, piece) for video in column for piece in _pieces(video, chunk_frames)]
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


def _pieces(video: np.ndarray, frames: int | None) -> Iterable[np.ndarray]:
    """The video, cut into pieces of so many frames, if any number is given."""
    return (video,) if frames is None else video.reshape(-1, frames, *video.shape[1:])


def _checked(name: str, column: np.ndarray, field: Field) -> np.ndarray:
    if column.dtype != np.dtype(field.dtype):
        raise ValueError(f"{name} is {column.dtype}, but must be {field.dtype}")
    return np.ascontiguousarray(column)


def _rows(column: np.ndarray) -> np.ndarray:
    """The bytes of each video, uint8 [m, size]."""
    return column.view(np.uint8).reshape(len(column), -1)


def _crc(pieces: Iterable[Any]) -> np.ndarray:
    return np.array([codecs.crc32(piece) for piece in pieces], np.uint32)
