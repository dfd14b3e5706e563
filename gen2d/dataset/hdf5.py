"""HDF5 shards: images in compressed chunks, by default one per video, everything else contiguous.

Any HDF5 program reads them. Four files decide the bytes of a shard: `block.py` divides images into chunks,
`storage/codecs.py` compresses each chunk, this file lays out chunks, values and attributes, and `rows.py` defines the
index, by which gen2d reads without h5py. Each HDF5 dataset has a row per video, also those of the values that all
videos share, and none has named columns, so that programs for tables read them. The bytes do not depend on times, hosts
or users, nor on how the videos were grouped into blocks. h5py serves one thread at a time, so compression happens in
other threads and chunks pass through h5py unchanged.
"""

import contextlib
import dataclasses
import errno
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gen2d.core.schema import Field
from gen2d.dataset.block import Block, image_names, row_names
from gen2d.dataset.rows import seal_rows, video_type
from gen2d.dataset.spec import EARLIER_SCHEMA, SCHEMA, stored_axes
from gen2d.storage import codecs

INDEX = "chunk_index"  # the HDF5 dataset of the videos' rows
_ZSTD = codecs.HDF5_FILTERS["zstd"][0]


@dataclasses.dataclass(frozen=True)
class Offsets:
    """The offsets in the file of the uncompressed data."""

    index: int
    rows: list[int]  # of each field, in the order of their names


def write(
    path: Path,
    fields: Mapping[str, Field],
    sizes: Mapping[str, int],
    videos: range,
    blocks: Iterable[Block],
    codec: str,
    chunk_frames: int | None,
    attributes: Mapping[str, str | int | float],
    constants: Mapping[str, np.ndarray],
    origin: int,
    schema: str = SCHEMA,
) -> Offsets:
    """Write a file of these videos of a split; returns the offsets of its uncompressed fields.

    `blocks` hold the videos in order; chunks are written as they arrive, so that memory holds one block and never the
    images of a shard. `constants` are the values of the fields that all videos share, `origin` is the start value of
    the index's checksums, `schema` one of SCHEMAS. Raises OSError, and ValueError for blocks that do not hold exactly
    these videos.
    """
    images, rows, count = image_names(fields), row_names(fields), len(videos)
    shared = {name: np.asarray(values) for name, values in constants.items()}
    if schema != EARLIER_SCHEMA:
        shared = {name: np.broadcast_to(values, (count, *values.shape)) for name, values in shared.items()}
    with _create(path) as file:
        file.attrs.update(attributes)
        shapes = {name: (count, *fields[name].shape(sizes)) for name in images + rows}
        chunked = {
            name: _create_chunked(file, name, fields[name], shapes[name], codec, chunk_frames) for name in images
        }
        table = {name: np.zeros(shapes[name], _stored_type(fields[name])) for name in rows}
        index = np.zeros(count, video_type(fields, sizes["T"] // chunk_frames if chunk_frames else 1))
        # More than HDF5 adds to the values: headers and attributes, and the places of the chunks.
        metadata = 4096 * (len(fields) + 4) + 64 * sum(index[name].size for name in images)
        for first, block in _number_blocks(blocks, count, path):
            _reserve(file, block.nbytes + metadata)
            _write_chunks(chunked, block, first, chunk_frames)
            own = index[first : first + len(block)]
            for name in rows:
                _fill(table[name], first, block.arrays[name], name)
                own[name] = block.crc[name]
            for name in images:
                own[name]["crc32"] = block.crc[name].reshape(len(block), -1)
        for name, dataset in chunked.items():
            _fill_offsets(dataset, index[name])
        tables = table | shared
        _reserve(file, metadata + index.nbytes + sum(values.nbytes for values in tables.values()))
        for name, values in sorted(tables.items()):
            file.create_dataset(name, data=np.asarray(values, _stored_type(fields[name])))
        for name, field in sorted(fields.items()):
            file[name].attrs.update(axes=stored_axes(field, schema), unit=field.unit, meaning=field.meaning)
        own = seal_rows(index, origin, videos)
        axes, meaning = "n", "where each video's chunks lie, and CRC-32 of all that is stored"
        if schema != EARLIER_SCHEMA:
            own, axes = own.view(np.uint8).reshape(count, -1), "n bytes"
        stored = file.create_dataset(INDEX, data=own)
        stored.attrs.update(axes=axes, unit="", meaning=meaning)
        return Offsets(_offset(stored), [_offset(file[name]) for name in rows])


def read(path: Path) -> dict[str, np.ndarray]:
    """Every field of the file as one array; zstd is decoded here, as h5py needs a plug-in for it."""
    fields: dict[str, np.ndarray] = {}
    with h5py.File(path, "r", locking=False) as file:

        def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
            if isinstance(item, h5py.Dataset) and name != INDEX:
                fields[name] = _read_zstd(item) if _has_zstd(item) else item[()]

        file.visititems(visit)
    return fields


@contextlib.contextmanager
def _create(path: Path) -> Iterator[h5py.File]:
    """A new file, closed at the end; an error while writing is raised before the error that closing then causes."""
    # HDF5's own lock would conflict with that of the temporary file.
    file = h5py.File(path, "w", libver=("v110", "v110"), locking=False)
    try:
        yield file
        file.flush()
    except BaseException as error:
        with contextlib.suppress(RuntimeError, OSError):
            file.close()
        if isinstance(error, RuntimeError) and "errno = " in str(error):
            raise _as_oserror(error) from error
        raise
    try:
        file.close()
    except RuntimeError as error:  # h5py turns its OSErrors into RuntimeErrors
        raise _as_oserror(error) from error
    with path.open("r+b") as written:  # what is reserved and unused is removed
        written.truncate(int.from_bytes(written.read(36)[28:], "little"))  # end of the file, as its superblock says


def _reserve(file: h5py.File, size: int) -> None:
    """Reserve room on the disk for so many more bytes. Raises OSError: where HDF5 meets a full disk, it may crash."""
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(file.id.get_vfd_handle(), 0, file.id.get_filesize() + size)
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):
                raise


def _as_oserror(error: RuntimeError) -> OSError:
    number = re.search(r"errno = (\d+)", str(error))
    return OSError(int(number[1]) if number else errno.EIO, str(error))


def _create_chunked(
    file: h5py.File, name: str, field: Field, shape: tuple[int, ...], codec: str, chunk_frames: int | None
) -> h5py.Dataset:
    """A new HDF5 dataset with a chunk per video, or per `chunk_frames` frames.

    It uses h5py's low-level functions, as the others refuse a filter without its plug-in. A process that has imported
    hdf5plugin writes zstd files with the filter's name in them: other bytes, same content.
    """
    settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    settings.set_chunk((1, chunk_frames or shape[1], *shape[2:]))
    settings.set_obj_track_times(False)
    if codec in codecs.HDF5_FILTERS:
        number, options = codecs.HDF5_FILTERS[codec]
        settings.set_filter(number, h5py.h5z.FLAG_OPTIONAL, options)
    space = h5py.h5s.create_simple(shape)
    dtype = h5py.h5t.py_create(np.dtype(field.dtype), logical=True)
    links = h5py.h5p.create(h5py.h5p.LINK_CREATE)
    links.set_create_intermediate_group(True)
    return h5py.Dataset(h5py.h5d.create(file.id, name.encode(), dtype, space, settings, links))


def _stored_type(field: Field) -> np.dtype:
    """The type of a field in the file; that of text declares UTF-8."""
    dtype = np.dtype(field.dtype)
    return h5py.string_dtype("utf-8", dtype.itemsize) if field.is_text else dtype


def _number_blocks(blocks: Iterable[Block], count: int, path: Path) -> Iterator[tuple[int, Block]]:
    """Each block with the row of its first video; raises ValueError unless there are `count` videos in all."""
    first = 0
    for block in blocks:
        if first + len(block) > count:
            raise ValueError(f"{path.name} takes {count} videos, but was given {first + len(block)} or more")
        yield first, block
        first += len(block)
    if first != count:
        raise ValueError(f"{path.name} takes {count} videos, but was given {first}")


def _write_chunks(chunked: Mapping[str, h5py.Dataset], block: Block, first: int, chunk_frames: int | None) -> None:
    # h5py reads a dataset's rank from the file each time, which takes longer than writing a small chunk.
    targets = {name: (dataset.id, (0,) * (dataset.ndim - 2)) for name, dataset in chunked.items()}
    # Video by video, so that the file does not depend on the size of a block.
    for row in range(len(block)):
        for name, (target, rest) in targets.items():
            pieces = len(block.chunks[name]) // len(block)
            for piece, data in enumerate(block.chunks[name][row * pieces : (row + 1) * pieces]):
                target.write_direct_chunk((first + row, piece * (chunk_frames or 0), *rest), data)


def _fill(table: np.ndarray, first: int, values: np.ndarray, name: str) -> None:
    # Assignment alone would silently broadcast a wrong shape.
    if values.shape[1:] != table.shape[1:]:
        raise ValueError(f"{name} has shape {values.shape[1:]} a video, but must have {table.shape[1:]}")
    table[first : first + len(values)] = values


def _chunk_frames(dataset: h5py.Dataset) -> int:
    """The number of frames of a chunk."""
    assert dataset.chunks is not None
    return dataset.chunks[1]


def _fill_offsets(dataset: h5py.Dataset, rows: np.ndarray) -> None:
    """Fill offset and size of every chunk into the videos' rows [videos, chunks]."""
    frames = _chunk_frames(dataset)

    def fill(chunk: h5py.h5d.StoreInfo) -> None:
        video, frame = chunk.chunk_offset[:2]
        row = rows[video, frame // frames]
        row["offset"], row["size"] = chunk.byte_offset, chunk.size

    dataset.id.chunk_iter(fill)


def _offset(dataset: Any) -> int:
    return dataset.id.get_offset() or 0  # an empty dataset has no offset


def _has_zstd(dataset: h5py.Dataset) -> bool:
    return dataset.id.get_create_plist().get_filter_by_id(_ZSTD) is not None


def _read_zstd(dataset: h5py.Dataset) -> np.ndarray:
    out = np.empty(dataset.shape, dataset.dtype)
    frames = _chunk_frames(dataset)
    for row in range(len(out)):
        for begin in range(0, dataset.shape[1], frames):
            _, data = dataset.id.read_direct_chunk((row, begin, *[0] * (out.ndim - 2)))
            codecs.decode_into("zstd", data, out[row, begin : begin + frames])
    return out
