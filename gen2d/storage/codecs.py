"""Compression of images: gzip (every HDF5 program reads it), zstd (smaller) or none. All codecs release the GIL.

gzip is ordinary deflate in a zlib envelope, which HDF5's own filter reads. isal writes it several times faster than
zlib. Its level 0 compresses too, unlike zlib's: as fast as its level 1, into 15-20 % more bytes. Levels 1 and 2
returned different, valid streams for the same input in one of some hundreds of calls, which would give a regenerated
shard other bytes. Levels 0 and 3 never did so; level 3 is three times slower.

Each zstd frame contains its size and a checksum, because HDF5's zstd filter checks nothing by itself.
"""

import threading
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from isal import isal_zlib

from gen2d.core.errors import DamagedError, UserError

CODECS = ("gzip", "zstd", "none")

# The number of each HDF5 filter and its options: the level, which no reader needs. For gzip it is 1 although isal's is
# 0, as HDF5's level 0 means no compression.
HDF5_FILTERS: dict[str, tuple[int, tuple[int, ...]]] = {"gzip": (1, (1,)), "zstd": (32015, (3,))}

_ISAL_LEVEL = 0

crc32: Callable[[Any], int] = isal_zlib.crc32

# isal's stub declares its exception class as an instance.
_ERRORS: tuple[type[Exception], ...] = (isal_zlib.error, MemoryError)  # pyright: ignore

# A zstd context is costly to create and serves one thread at a time.
_contexts = threading.local()


def check_installed(codec: str) -> None:
    """Raise UserError unless what the codec needs is installed."""
    if codec == "zstd":
        _zstandard()


def encode(codec: str, array: np.ndarray) -> bytes:
    """Compressed bytes of an array in C order; raises UserError if what the codec needs is not installed."""
    data = np.ascontiguousarray(array).data
    if codec == "gzip":
        return isal_zlib.compress(data, _ISAL_LEVEL)
    if codec == "zstd":
        return _compressor().compress(data)
    return data.tobytes()


def decode_into(codec: str, data: bytes | memoryview, out: np.ndarray) -> None:
    """Decompress `data`, a result of `encode`, into the contiguous array `out`.

    Raises DamagedError unless `data` is intact, ends where it should and fills `out` exactly, and UserError if what the
    codec needs is not installed.
    """
    if codec == "zstd":
        _decompress_zstd(data, out)
        return
    try:
        plain = _inflate(data, out.nbytes) if codec == "gzip" else memoryview(data).cast("B")
    except _ERRORS as error:
        raise DamagedError(f"compressed data is damaged ({error})") from error
    if len(plain) != out.nbytes:
        raise DamagedError(f"compressed data holds {len(plain)} bytes, but must hold {out.nbytes}")
    if out.nbytes:
        out.reshape(-1)[...] = np.frombuffer(plain, out.dtype)


def _inflate(data: bytes | memoryview, size: int) -> bytes:
    stream = isal_zlib.decompressobj()
    # One byte more than expected reveals a longer stream, and the buffer need not grow to reach the end.
    plain = stream.decompress(data, size + 1)
    if not stream.eof or stream.unused_data:
        raise DamagedError("compressed data does not end where it should")
    return plain


def _decompress_zstd(data: bytes | memoryview, out: np.ndarray) -> None:
    zstandard = _zstandard()
    try:
        # Checked before decompressing, so that a damaged size cannot exhaust the memory.
        if zstandard.frame_content_size(data) != out.nbytes:
            raise DamagedError(f"compressed data does not hold {out.nbytes} bytes, as it must")
        if _frame_end(data, zstandard.frame_header_size(data)) != len(data):
            raise DamagedError("compressed data does not end where it should")
        # With the whole input and the whole buffer at once, zstd decompresses right into the buffer.
        buffer = out.reshape(-1).view(np.uint8)
        size = _decompressor().stream_reader(data).readinto(buffer.data) if out.nbytes else 0
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamagedError(f"compressed data is damaged ({error})") from error
    if size != out.nbytes:
        raise DamagedError(f"compressed data holds {size} bytes, but must hold {out.nbytes}")


def _frame_end(data: bytes | memoryview, position: int) -> int:
    """The end of a zstd frame, from the headers of its blocks (RFC 8878, 3.1.1.2), one per 128 kB, from `position`."""
    last = False
    while not last:
        header = int.from_bytes(data[position : position + 3], "little")
        last, repeats, size = bool(header & 1), header >> 1 & 3 == 1, header >> 3
        position += 3 + (1 if repeats else size)
        if position > len(data):
            break
    return position + 4  # the checksum


def _zstandard() -> ModuleType:
    """The module; raises UserError if it is not installed."""
    try:
        import zstandard
    except ImportError:
        raise UserError("the codec zstd needs zstandard: pip install 'gen2d[zstd]'") from None
    return zstandard


def _compressor() -> Any:
    if not hasattr(_contexts, "compressor"):
        options = {"level": 3, "write_checksum": True, "write_content_size": True}
        _contexts.compressor = _zstandard().ZstdCompressor(**options)
    return _contexts.compressor


def _decompressor() -> Any:
    if not hasattr(_contexts, "decompressor"):
        _contexts.decompressor = _zstandard().ZstdDecompressor()
    return _contexts.decompressor
