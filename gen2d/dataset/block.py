"""How shards are stored: one file per format, each with `write` and `read`, and the Block that they all store.

A Block is made in host threads, while the device computes what follows: images are compressed, every piece gets its
checksum, and what the statistics need is summed.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gen2d.core.schema import Field
from gen2d.storage import codecs

# What `Block.moments` are of, told in the manifest.
MOMENTS_OF = "frames: every 8th frame, of it every 4th row and column; states: every frame, objects that are present"


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


@dataclasses.dataclass(frozen=True)
class Places:
    """Where in the file each field's bytes lie."""

    chunks: Mapping[str, np.ndarray]  # images: uint64 [chunks, 2], offset and size of each
    rows: Mapping[str, int]  # the others: offset of the first video, the rest follow without gaps


def image_names(fields: Mapping[str, Field]) -> list[str]:
    """The fields that are stored compressed, sorted."""
    return sorted(name for name, field in fields.items() if field.is_image)


def row_names(fields: Mapping[str, Field]) -> list[str]:
    """The fields of each video that are stored as they are, sorted."""
    return sorted(name for name, field in fields.items() if field.per_video and not field.is_image)


def stored_bytes(field: Field, sizes: Mapping[str, int]) -> int:
    """What one video's value takes before compression."""
    return int(np.prod(field.shape(sizes))) * np.dtype(field.dtype).itemsize


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
    present = columns.get("objects/present")
    moments = {name: _moments(columns[name], fields[name], present) for name in columns if _is_measured(name)}
    return Block(arrays, chunks, crc, moments)


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


def _is_measured(name: str) -> bool:
    return name == "frames" or name.startswith("states/")


def _moments(column: np.ndarray, field: Field, present: np.ndarray | None) -> np.ndarray:
    """Count, sum, sum of squares, least and largest of each channel or component, float64 [m, 5, components].

    Sums of uint8 are exact. Each video is summed by itself, so that no grouping of videos changes a bit.
    """
    axes = field.axes.split()
    components = column.shape[-1] if axes[-1].isdigit() else 1
    if field.is_image:
        return _image_moments(column, components)
    # Components before values, so that each is summed in one piece of memory.
    values = column.reshape(len(column), -1, components).transpose(0, 2, 1).astype(np.float64, order="C")
    count, low, high = np.full(values.shape[:2], values.shape[2], np.float64), values, values
    if "K" in axes and present is not None:
        there = _spread(present, axes, column.shape)
        count = np.broadcast_to(there, values.shape).sum(-1, dtype=np.float64)
        low, high = np.where(there, values, np.inf), np.where(there, values, -np.inf)
        values = np.where(there, values, 0.0)
    sums = count, values.sum(-1), (values * values).sum(-1)
    return np.stack([*sums, low.min(-1, initial=np.inf), high.max(-1, initial=-np.inf)], axis=1)


def _image_moments(images: np.ndarray, components: int) -> np.ndarray:
    """The moments of uint8 images [m, T, H, W, ...], in whole numbers, which takes half as long."""
    some = images[:, ::8, ::4, ::4]  # all pixels would cost more than the rest of `encode` together
    values = np.ascontiguousarray(some.reshape(len(images), -1, components).transpose(0, 2, 1))
    wide = values.astype(np.uint32)
    count = np.full(values.shape[:2], values.shape[2], np.float64)
    return np.stack([count, wide.sum(-1), (wide * wide).sum(-1), values.min(-1), values.max(-1)], axis=1)


def _spread(present: np.ndarray, axes: list[str], shape: tuple[int, ...]) -> np.ndarray:
    """Whether the object that each value belongs to is there, bool [m, 1, values]; `present` is [m, K]."""
    steps = [size if axis in "nK" else 1 for axis, size in zip(axes, shape, strict=True) if not axis.isdigit()]
    return np.broadcast_to(present.reshape(steps), shape[: len(steps)]).reshape(shape[0], 1, -1)


def merged(moments: np.ndarray) -> np.ndarray:
    """The moments of all together, [5, components], from [m, 5, components]."""
    return np.concatenate([moments[:, :3].sum(0), moments[:, 3:4].min(0), moments[:, 4:].max(0)])
