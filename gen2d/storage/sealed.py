"""Canonical JSON, hashes, and sealed JSON: objects that carry the hash of all their other entries."""

import errno
import hashlib
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, cast

from gen2d.storage.paths import Place, Url

JSON_BYTES = 2**24  # maximum size of a JSON file


def as_json(value: Any) -> bytes:
    """The canonical JSON of a value: equal values have equal bytes."""
    return json.dumps(value, sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False).encode()


def parse_json(content: bytes) -> dict[str, Any] | None:
    """The JSON object in these bytes; None if they hold none."""
    try:
        value = json.loads(content, parse_constant=_refuse)
    except (ValueError, RecursionError):
        return None
    return cast(dict[str, Any], value) if isinstance(value, dict) else None


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def seal(values: Mapping[str, Any], key: str) -> dict[str, Any]:
    """The values, with the sha256 of all others under `key`."""
    others = {name: value for name, value in values.items() if name != key}
    return others | {key: sha256(as_json(others))}


def unseal(content: bytes, key: str) -> dict[str, Any] | None:
    """The object that `seal` returned, from its bytes; None if any of them changed."""
    values = parse_json(content)
    try:
        return values if values is not None and content == as_json(seal(values, key)) else None
    except (ValueError, RecursionError):  # half a surrogate pair, or nested too deep
        return None


def read_sealed(path: Place, key: str) -> dict[str, Any] | None:
    """The sealed object in a file; None if there is no such file or any byte changed.

    At a URL it raises the errors of `Url.read_bytes`.
    """
    try:
        content = read_bytes(path, JSON_BYTES)
    except FileNotFoundError:
        return None
    except OSError:
        if isinstance(path, Url):
            raise
        return None
    return unseal(content, key)


def sha256(content: bytes) -> str:
    """The sha256 of the content, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def file_sha256(path: Path) -> str:
    """The sha256 of a regular file, in hexadecimal. Raises OSError, also for anything but a regular file."""
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
    """A descriptor of a regular file, to read from; opening anything else does not block.

    Raises OSError: EISDIR for a folder, ENXIO for a pipe, socket or device.
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
        # Not `limit` bytes at once: there may be less memory than that.
        content = file.read(min(os.fstat(file.fileno()).st_size, limit) + 1)
    if len(content) > limit:
        raise OSError(errno.EFBIG, f"it has more than {limit} bytes", str(path))
    return content
