"""Rows that are checked one by one: of a shard in the table of its split, and of a video in its shard's index.

A table may be read a row at a time, by range, also over a network, so every row ends with its own CRC-32. The sum
begins from who the row belongs to (the dataset's identity, the split, the row's number), so that a row of another
dataset, or in another's place, is as wrong as one with a flipped bit.

    table of a split    index/SPLIT-COUNT.npy, a row per shard: its videos, bytes, sha256, where in the file its index
                        and each field that is not compressed begin, and the moments of its statistics
    index of a shard    the dataset `chunk_index` in its file, a row per video: offset, bytes and CRC-32 of each chunk,
                        and the CRC-32 of each field that is not compressed
"""

import io
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gen2d.core.errors import DamagedError
from gen2d.core.schema import Field
from gen2d.dataset.block import image_names, row_names
from gen2d.dataset.statistics import MOMENTS, measured

CHECK = "check"
OVERHEAD = 2**26  # bytes of a shard beside its values, at most
CHUNK = np.dtype([("offset", "<u8"), ("size", "<u8"), ("crc32", "<u4")])


def shard_type(fields: Mapping[str, Field]) -> np.dtype:
    """The row of a shard."""
    return np.dtype(
        [
            ("first", "<u8"),  # video
            ("count", "<u4"),
            ("bytes", "<u8"),  # of the file
            ("data_bytes", "<u8"),  # of it, compressed values
            ("sha256", "u1", (32,)),
            ("index", "<u8"),  # where the shard's index begins
            ("offsets", "<u8", (len(row_names(fields)),)),  # where each field begins, in the order of the names
            ("moments", "<f8", (MOMENTS * sum(measured(fields).values()),)),
            (CHECK, "<u4"),
        ]
    )


def video_type(fields: Mapping[str, Field], chunks: int) -> np.dtype:
    """The row of a video whose images have so many chunks each."""
    images = [(name, CHUNK, (chunks,)) for name in image_names(fields)]
    return np.dtype([*images, *((name, "<u4") for name in row_names(fields)), (CHECK, "<u4")])


def origin(identity_sha256: str, split: str) -> int:
    """What the checks of a split's rows begin from."""
    return zlib.crc32(f"{identity_sha256}/{split}".encode())


def checks(rows: np.ndarray, begin: int, numbers: Sequence[int] | range) -> np.ndarray:
    """The CRC-32 of each row but for its own, uint32; `numbers` are the rows' (of shards: the first video's)."""
    size = rows.dtype.itemsize - 4
    data = memoryview(np.ascontiguousarray(rows).tobytes())
    places = range(0, len(data), rows.dtype.itemsize)
    return np.array(
        [
            zlib.crc32(data[place : place + size], zlib.crc32(int(number).to_bytes(8, "little"), begin))
            for place, number in zip(places, numbers, strict=True)
        ],
        np.uint32,
    )


def sealed_rows(rows: np.ndarray, begin: int, numbers: Sequence[int] | range) -> np.ndarray:
    """The rows with their checks."""
    rows[CHECK] = checks(rows, begin, numbers)
    return rows


def intact(rows: np.ndarray, begin: int, numbers: Sequence[int] | range) -> np.ndarray:
    """Whether each row is what was written."""
    return rows[CHECK] == checks(rows, begin, numbers)


def npy_header(kind: np.dtype, count: int) -> bytes:
    """What stands before the rows of a table in its file; it is compared, and never parsed."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": kind.descr, "fortran_order": False, "shape": (count,)})
    return head.getvalue()


def npy(rows: np.ndarray) -> bytes:
    """The rows as the bytes of an npy file."""
    return npy_header(rows.dtype, len(rows)) + np.ascontiguousarray(rows).tobytes()


def salvaged(content: bytes, kind: np.dtype, count: int, begin: int, videos_per_shard: int) -> np.ndarray:
    """Those of the `count` rows of a table's file that are what was written, whatever its header says."""
    body = content[len(npy_header(kind, count)) :]
    rows = np.frombuffer(body, kind, count=min(count, len(body) // kind.itemsize))
    return rows[intact(rows, begin, range(0, len(rows) * videos_per_shard, videos_per_shard))]


def check_shard(row: Any, first: int, count: int, row_bytes: int, sizes: Sequence[int], raw: int) -> None:
    """Raises DamagedError for a row that cannot be of the shard with these videos.

    `row_bytes` is the size of a video's row, `sizes` are the bytes of a video in each field that is not compressed,
    `raw` those in all fields before compression.
    """
    total = int(row["bytes"])
    if (int(row["first"]), int(row["count"])) != (first, count):
        raise DamagedError(f"it begins with video {row['first']} and has {row['count']}")
    ends = [int(row["index"]) + count * row_bytes]
    ends += [int(offset) + count * size for offset, size in zip(row["offsets"], sizes, strict=True)]
    if max(ends) > total:
        raise DamagedError(f"a field ends at byte {max(ends)} of a file of {total}")
    if total > count * 2 * raw + OVERHEAD:
        raise DamagedError(f"its file has {total} bytes, more than {count} such videos can take")
