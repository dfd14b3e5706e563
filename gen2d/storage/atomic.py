"""Files that appear whole or not at all: written under a temporary name, synced, renamed; their hashes and JSON.

Those of a Url are written in the folder for temporary files, and uploaded.
"""

import contextlib
import glob
import hashlib
import json
import os
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from gen2d.storage.paths import Place, Url, upload

_HOST = socket.gethostname()


@contextlib.contextmanager
def publishing(path: Place) -> Iterator[Path]:
    """A temporary name to write under; the file appears as `path` when the block ends well, and never otherwise."""
    with _uploading(path) if isinstance(path, Url) else _renaming(path) as temporary:
        yield temporary


@contextlib.contextmanager
def _renaming(path: Path) -> Iterator[Path]:
    temporary = path.with_name(f"{path.name}{_mark()}")
    try:
        yield temporary
        _sync(temporary)
        temporary.replace(path)
    except BaseException:  # also an interrupt
        temporary.unlink(missing_ok=True)
        raise
    _sync(path.parent)


@contextlib.contextmanager
def publishing_folder(path: Path) -> Iterator[Path]:
    """A temporary folder to write in; it appears as `path`, instead of what was there, when the block ends well."""
    temporary, replaced = (path.with_name(f"{path.name}{old}{_mark()}") for old in ("", ".old"))
    try:
        temporary.mkdir()
        yield temporary
        os.sync()  # once: a file at a time, many small ones would take minutes
        if path.exists():
            path.rename(replaced)
        temporary.rename(path)
    except BaseException:  # also an interrupt
        if replaced.exists() and not path.exists():
            replaced.rename(path)
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    _sync(path.parent)
    shutil.rmtree(replaced, ignore_errors=True)


@contextlib.contextmanager
def _uploading(url: Url) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="gen2d-", suffix=_mark()) as folder:
        yield Path(folder) / url.name
        upload(Path(folder) / url.name, url)


def _mark() -> str:
    """The end of the name of what is temporary."""
    return f".tmp.{_HOST}.{os.getpid()}"


def publish(path: Place, content: bytes) -> None:
    """Returns when the disk, or the server, has `content` as `path`, whole."""
    with publishing(path) as temporary:
        temporary.write_bytes(content)


def work_folder(root: Place) -> Path:
    """The folder on disk in which what goes to `root` is written first."""
    return Path(tempfile.gettempdir()) if isinstance(root, Url) else root


def sweep(root: Place) -> None:
    """Returns nothing; removes what dead processes of this host left behind. Of other hosts nothing is known."""
    pattern = f"*.tmp.{_HOST}.*"
    left = work_folder(root).glob(f"gen2d-{pattern}") if isinstance(root, Url) else root.rglob(pattern)
    _remove_abandoned(left)


def sweep_beside(path: Path) -> None:
    """Returns nothing; removes what dead processes of this host left when they were to publish `path`."""
    _remove_abandoned(path.parent.glob(f"{glob.escape(path.name)}.*tmp.{_HOST}.*"))


def _remove_abandoned(paths: Iterable[Path]) -> None:
    for path in paths:
        if not _is_abandoned(path):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def remove_tree(folder: Place) -> None:
    """Returns nothing; the folder and all in it are gone."""
    if isinstance(folder, Path):
        shutil.rmtree(folder, ignore_errors=True)
        return
    for path in folder.rglob("*"):
        path.unlink(missing_ok=True)


def size_of(path: Place) -> int | None:
    """The size of the file in bytes; None if there is none."""
    try:
        about = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return about.st_size if stat.S_ISREG(about.st_mode) else None


def as_json(value: Any) -> bytes:
    """The one way JSON is written here, so that equal values have equal bytes."""
    return json.dumps(value, sort_keys=True, indent=1, ensure_ascii=False).encode()


def read_json(path: Place) -> dict[str, Any] | None:
    """The JSON object in the file; None if there is none. Raises OSError if that cannot be known of a Url."""
    content = _content(path)
    return None if content is None else parsed(content)


def _content(path: Place) -> bytes | None:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError:
        if isinstance(path, Url):
            raise
        return None


def parsed(content: bytes) -> dict[str, Any] | None:
    """The JSON object that these bytes are; None if they are none."""
    try:
        value = json.loads(content)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None


def sealed(values: Mapping[str, Any], key: str) -> dict[str, Any]:
    """The values, and under `key` the sha256 of all the others."""
    rest = {name: value for name, value in values.items() if name != key}
    return rest | {key: sha256(as_json(rest))}


def unsealed(content: bytes, key: str) -> dict[str, Any] | None:
    """What `sealed` gave, from its bytes; None if any of them changed."""
    values = parsed(content)
    return values if values is not None and content == as_json(sealed(values, key)) else None


def read_sealed(path: Place, key: str) -> dict[str, Any] | None:
    """What `sealed` gave and the file holds; None as for `read_json`, or if any byte changed."""
    content = _content(path)
    return None if content is None else unsealed(content, key)


def sha256(content: bytes) -> str:
    """The content's sha256, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def file_sha256(path: Place) -> str:
    """The file's sha256, read piece by piece from a disk."""
    if isinstance(path, Url):
        return sha256(path.read_bytes())
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    """Returns when the disk has the file, or the folder's list of names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_abandoned(temporary: Path) -> bool:
    """Whether the process that a temporary name tells of is dead."""
    process = temporary.name.rpartition(".")[2]
    return process.isdigit() and not _is_alive(int(process))


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # someone else's, so it lives
    return True
