"""Files that appear whole or not at all: written under a temporary name, synced, renamed; their hashes and JSON."""

import contextlib
import hashlib
import json
import os
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

_HOST = socket.gethostname()


@contextlib.contextmanager
def publishing(path: Path) -> Iterator[Path]:
    """A temporary name to write under; the file appears as `path` when the block ends well, and never otherwise."""
    temporary = path.with_name(f"{path.name}.tmp.{_HOST}.{os.getpid()}")
    try:
        yield temporary
        _sync(temporary)
        temporary.replace(path)
    except BaseException:  # also an interrupt
        temporary.unlink(missing_ok=True)
        raise
    _sync(path.parent)


def publish(path: Path, content: bytes) -> None:
    """Returns when the disk has `content` as `path`, whole."""
    with publishing(path) as temporary:
        temporary.write_bytes(content)


def sweep(root: Path) -> None:
    """Returns nothing; removes what dead processes of this host left behind. Of other hosts nothing is known."""
    for path in root.rglob(f"*.tmp.{_HOST}.*"):
        process = path.name.rpartition(".")[2]
        if process.isdigit() and not _is_alive(int(process)):
            path.unlink(missing_ok=True)


def as_json(value: Any) -> bytes:
    """The one way JSON is written here, so that equal values have equal bytes."""
    return json.dumps(value, sort_keys=True, indent=1, ensure_ascii=False).encode()


def read_json(path: Path) -> dict[str, Any] | None:
    """The JSON object in the file; None if there is none."""
    try:
        value = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return value if isinstance(value, dict) else None


def sealed(values: Mapping[str, Any], key: str) -> dict[str, Any]:
    """The values, and under `key` the sha256 of all the others."""
    rest = {name: value for name, value in values.items() if name != key}
    return rest | {key: sha256(as_json(rest))}


def read_sealed(path: Path, key: str) -> dict[str, Any] | None:
    """What `sealed` gave and the file holds; None if the file is missing or any byte of it changed."""
    values = read_json(path)
    return values if values is not None and path.read_bytes() == as_json(sealed(values, key)) else None


def sha256(content: bytes) -> str:
    """The content's sha256, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def file_sha256(path: Path) -> str:
    """The file's sha256, read piece by piece."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    """Returns when the disk has the file, or the folder's list of names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # someone else's, so it lives
    return True
