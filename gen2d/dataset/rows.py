"""Tables of rows that each carry a checksum: a row per shard in a split's table, a row per video in a shard's index.

A reader may fetch single rows by byte range, also over a network, so every row ends with its own CRC-32. The checksum
starts from the dataset's identity, the split and the row's number: a row of another dataset, or at another place, fails
the check like one with a flipped bit.

    table of a split    index/SPLIT-COUNT.npy, a row per shard: its videos, bytes and sha256, the offsets in the file of
                        its index and of each uncompressed field, and the moments of its statistics
    index of a shard    the HDF5 dataset `chunk_index`, a row per video: offset, bytes and CRC-32 of each chunk, and the
                        CRC-32 of each uncompressed field
"""

import io
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gen2d.core.errors import DamagedError
from gen2d.core.schema import Field
from gen2d.dataset.block import image_names, row_names
from gen2d.dataset.statistics import MOMENTS, component_counts

CHECK = "check"
OVERHEAD = 2**26  # maximum bytes of a shard beside its values
CHUNK = np.dtype([("offset", "<u8"), ("size", "<u8"), ("crc32", "<u4")])


def shard_type(fields: Mapping[str, Field]) -> np.dtype:
    """The dtype of a shard's row."""
    return np.dtype(
        [
            ("first", "<u8"),  # video
            ("count", "<u4"),
            ("bytes", "<u8"),  # of the file
            ("data_bytes", "<u8"),  # of the file's values, compressed
            ("sha256", "u1", (32,)),
            ("index", "<u8"),  # offset of the shard's index
            ("offsets", "<u8", (len(row_names(fields)),)),  # of each uncompressed field, in the order of the names
            ("moments", "<f8", (MOMENTS * sum(component_counts(fields).values()),)),
            (CHECK, "<u4"),
        ]
    )


def video_type(fields: Mapping[str, Field], chunks: int) -> np.dtype:
    """The dtype of a video's row; its images have `chunks` chunks each."""
    images = [(name, CHUNK, (chunks,)) for name in image_names(fields)]
    return np.dtype([*images, *((name, "<u4") for name in row_names(fields)), (CHECK, "<u4")])


def origin(identity_sha256: str, split: str) -> int:
    """The start value of the checksums of a split's rows."""
    return zlib.crc32(f"{identity_sha256}/{split}".encode())


def row_checksums(rows: np.ndarray, begin: int, numbers: Sequence[int] | range) -> np.ndarray:
    """The CRC-32 of each row without its last field, uint32 [rows].

    `begin` is the start value from `origin`; `numbers` are the videos of the rows, or the first videos of the shards.
    """
    size = rows.dtype.itemsize - 4
    data = memoryview(np.ascontiguousarray(rows).tobytes())
    starts = range(0, len(data), rows.dtype.itemsize)
    return np.array(
        [
            zlib.crc32(data[start : start + size], zlib.crc32(int(number).to_bytes(8, "little"), begin))
            for start, number in zip(starts, numbers, strict=True)
        ],
        np.uint32,
    )


def seal_rows(rows: np.ndarray, begin: int, numbers: Sequence[int] | range) -> np.ndarray:
    """The rows, with their checksums filled in."""
    rows[CHECK] = row_checksums(rows, begin, numbers)
    return rows


def intact(rows: np.ndarray, begin: int, numbers: Sequence[int] | range) -> np.ndarray:
    """Whether each row has the right checksum, bool [rows]."""
    return rows[CHECK] == row_checksums(rows, begin, numbers)


def npy_header(dtype: np.dtype, count: int) -> bytes:
    """The header of the npy file of a table; readers compare it and never parse it."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": dtype.descr, "fortran_order": False, "shape": (count,)})
    return head.getvalue()


def npy(rows: np.ndarray) -> bytes:
    """The content of the npy file of a table."""
    return npy_header(rows.dtype, len(rows)) + np.ascontiguousarray(rows).tobytes()


def npy_size(dtype: np.dtype, count: int) -> int:
    """The size in bytes of the npy file of a table with `count` rows."""
    return len(npy_header(dtype, count)) + count * dtype.itemsize


def intact_rows(content: bytes, dtype: np.dtype, count: int, begin: int, videos_per_shard: int) -> np.ndarray:
    """The rows with the right checksum in the npy file of a table of `count` rows; the header is ignored."""
    body = content[len(npy_header(dtype, count)) :]
    rows = np.frombuffer(body, dtype, count=min(count, len(body) // dtype.itemsize))
    return rows[intact(rows, begin, range(0, len(rows) * videos_per_shard, videos_per_shard))]


def check_shard(row: Any, first: int, count: int, row_bytes: int, sizes: Sequence[int], raw: int) -> None:
    """Check that a row can belong to the shard with these videos; raises DamagedError.

    `row_bytes` is the size of a video's row in the index, `sizes` are the bytes of a video in each uncompressed field,
    `raw` those in all fields before compression.
    """
    total = int(row["bytes"])
    if (int(row["first"]), int(row["count"])) != (first, count):
        raise DamagedError(
            f"it begins with video {row['first']} and has {row['count']} videos, but must begin with video {first} and "
            f"have {count}"
        )
    ends = [int(row["index"]) + count * row_bytes]
    ends += [int(offset) + count * size for offset, size in zip(row["offsets"], sizes, strict=True)]
    if max(ends) > total:
        raise DamagedError(f"a field ends at byte {max(ends)}, but the file has {total} bytes")
    if total > count * 2 * raw + OVERHEAD:
        raise DamagedError(f"its file has {total} bytes, more than {count} such videos can take")
