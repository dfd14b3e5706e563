"""Hashes, JSON whose equal values have equal bytes, and JSON that carries the hash of all else in it."""

import errno
import hashlib
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from gen2d.storage.paths import Place, Url

JSON_BYTES = 2**24  # of a file of JSON, at most


def as_json(value: Any) -> bytes:
    """The one way JSON is written here, so that equal values have equal bytes."""
    return json.dumps(value, sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False).encode()


def parsed(content: bytes) -> dict[str, Any] | None:
    """The JSON object that these bytes are; None if they are none."""
    try:
        value = json.loads(content, parse_constant=_refused)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def _refused(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")


def sealed(values: Mapping[str, Any], key: str) -> dict[str, Any]:
    """The values, and under `key` the sha256 of all the others."""
    rest = {name: value for name, value in values.items() if name != key}
    return rest | {key: sha256(as_json(rest))}


def unsealed(content: bytes, key: str) -> dict[str, Any] | None:
    """What `sealed` gave, from its bytes; None if any of them changed."""
    values = parsed(content)
    try:
        return values if values is not None and content == as_json(sealed(values, key)) else None
    except (ValueError, RecursionError):  # half a surrogate pair, or too deep
        return None


def read_sealed(path: Place, key: str) -> dict[str, Any] | None:
    """What `sealed` gave and the file holds; None if there is no such file, or any byte changed.

    Raises UnreachableError where a server does not say.
    """
    try:
        content = read_bytes(path, JSON_BYTES)
    except FileNotFoundError:
        return None
    except OSError:
        if isinstance(path, Url):
            raise
        return None
    return unsealed(content, key)


def sha256(content: bytes) -> str:
    """The content's sha256, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def file_sha256(path: Path) -> str:
    """The sha256 of a regular file, read piece by piece. Raises OSError, also for what is no regular file."""
    with os.fdopen(open_regular(path), "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def has_sha256(path: Place, expected: str, limit: int) -> bool:
    """Whether the file has at most `limit` bytes and this sha256. Raises OSError."""
    try:
        return sha256(read_bytes(path, limit)) == expected
    except OSError as error:
        if error.errno == errno.EFBIG:
            return False
        raise


def open_regular(path: Path) -> int:
    """A descriptor of a regular file, to read from; nothing else is ever opened so that it blocks.

    Raises OSError, IsADirectoryError among them; a pipe, a socket or a device is OSError(ENXIO).
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    kind = os.fstat(descriptor).st_mode
    if stat.S_ISREG(kind):
        return descriptor
    os.close(descriptor)
    number = errno.EISDIR if stat.S_ISDIR(kind) else errno.ENXIO
    raise OSError(number, os.strerror(number), str(path))


def read_bytes(path: Place, limit: int) -> bytes:
    """The content of a regular file of at most `limit` bytes. Raises OSError, OSError(EFBIG) for a larger one."""
    if isinstance(path, Url):
        return path.read_bytes(limit)
    with os.fdopen(open_regular(path), "rb") as file:
        # As much as there is, and not as `limit` says: that much memory may not be there.
        content = file.read(min(os.fstat(file.fileno()).st_size, limit) + 1)
    if len(content) > limit:
        raise OSError(errno.EFBIG, f"it has more than {limit} bytes", str(path))
    return content
