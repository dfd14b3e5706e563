"""Files and folders at a URL, with the interface of pathlib.

`place` returns a Path for a folder on disk and a Url for anything else, and most code works with both. fsspec provides
the protocols; it is imported when the first URL is met. An object appears whole or not at all, so nothing is renamed;
folders are only prefixes of names.

Every request, uploads and downloads included, is made by `retries.attempt`, which limits its time, retries it and
explains its errors. No message, repr or log shows the user name, password or query of a URL.
"""

import contextlib
import dataclasses
import errno
import fnmatch
import os
import re
import stat
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath
from typing import Any

from gen2d.core.errors import ConfigError, DamagedError, FolderError
from gen2d.storage.filesystems import file_system, redact_url
from gen2d.storage.retries import Address, Network, attempt, http_status

PIECE = 2**20  # bytes of a file that are received at once


class Url(Address):
    """A file or folder at a URL; its methods behave like those of pathlib.Path and raise the same OSErrors."""

    def __truediv__(self, name: str | PurePath) -> "Url":
        return dataclasses.replace(self, text=f"{self.text}/{PurePath(name).as_posix()}")

    @property
    def name(self) -> str:
        return self.text.rpartition("/")[2]

    @property
    def parent(self) -> "Url":
        return dataclasses.replace(self, text=self.text.rpartition("/")[0])

    @property
    def is_web(self) -> bool:
        """Whether it is on a plain web server, which need not list folders."""
        return self.text.startswith(("http://", "https://"))

    def stat(self) -> os.stat_result:
        """The size and kind; all other entries are zero."""
        info = attempt(self, _info)
        kind = stat.S_IFDIR if info["type"] == "directory" else stat.S_IFREG
        return os.stat_result((kind, 0, 0, 1, 0, 0, info["size"] or 0, 0, 0, 0))

    def is_file(self) -> bool:
        return stat.S_ISREG(self._kind())

    def is_dir(self) -> bool:
        return stat.S_ISDIR(self._kind())

    def exists(self) -> bool:
        return self._kind() != 0

    def _kind(self) -> int:
        try:
            return self.stat().st_mode
        except FileNotFoundError:
            return 0

    def mkdir(self, parents: bool = False, exist_ok: bool = False) -> None:
        """Do nothing: a folder exists when something is in it."""

    def iterdir(self) -> "Iterator[Url]":
        names = attempt(self, lambda system, path: _names(system, path, system.ls)) if not self.is_web else []
        return (self / name for name in names)

    def glob(self, pattern: str) -> "Iterator[Url]":
        return (path for path in self.iterdir() if fnmatch.fnmatchcase(path.name, pattern))

    def rglob(self, pattern: str) -> "Iterator[Url]":
        names = attempt(self, lambda system, path: _names(system, path, system.find)) if not self.is_web else []
        return (self / name for name in names if fnmatch.fnmatchcase(PurePath(name).name, pattern))

    def read_bytes(self, limit: int) -> bytes:
        """The whole content of at most `limit` bytes; raises OSError(EFBIG) for a larger file."""
        return attempt(self, lambda system, path: _read(self, system, path, limit))

    def unlink(self, missing_ok: bool = False) -> None:
        try:
            attempt(self, lambda system, path: system.rm_file(path))
        except FileNotFoundError:
            if not missing_ok:
                raise

    def copy(self, target: "Url") -> None:
        """Copy the object to another URL of the same server."""
        attempt(self, lambda system, path: system.cp_file(path, system._strip_protocol(target.text)), 2**33)


Place = Path | Url


def place(path: str | Place, network: Network | None = None) -> Place:
    """The Path of a folder on disk, or the Url of a text with another protocol than `file`.

    `network` holds the limits of a Url that is made. Raises FolderError for a URL that cannot be used, and ConfigError
    for anything but a path or a URL.
    """
    if isinstance(path, Url):
        return path  # it has its own limits
    if not isinstance(path, str | os.PathLike):
        raise ConfigError(f"a folder is given as {path!r:.60}, but must be a path or a URL")
    if not isinstance(path, str) or "://" not in path:
        return Path(path)
    protocol, _, rest = path.partition("://")
    if protocol in ("file", "local"):
        return Path(rest)
    if not rest.strip("/") or "::" in path or not re.fullmatch(r"[A-Za-z0-9+.-]+", protocol):
        raise FolderError(f"{redact_url(path)} must be PROTOCOL://FOLDER, such as s3://bucket/dataset")
    text, mark, query = path.partition("?") if protocol in ("http", "https", "az", "abfs", "abfss") else (path, "", "")
    url = Url(text.rstrip("/"), mark + query, network or Network())
    file_system(url.text, url.network.timeout)
    return url


@contextlib.contextmanager
def reading(root: Place) -> Iterator[None]:
    """Context of reading a dataset, which turns an OSError into a FolderError if the dataset is at a URL."""
    try:
        yield
    except OSError as error:
        if isinstance(root, Path):
            raise
        raise FolderError(f"{error.filename or root} cannot be read ({error.strerror or error})") from None


def upload(source: Path, url: Url) -> None:
    """Upload a file; on return the server has all of it."""
    size = source.stat().st_size

    def put(system: Any, path: str) -> None:
        system.put_file(str(source), path)
        _check_size(system.info(path)["size"], size)

    attempt(url, put, size)


def download(url: Url, target: Path, size: int) -> None:
    """Download a file of `size` bytes; raises DamagedError if the server says that it has another size."""

    def check_length(length: int | None) -> None:
        if length is not None and length != size:
            raise DamagedError(f"{url} has {length} bytes, but must have {size}")

    def get(system: Any, path: str) -> None:
        if not url.is_web:
            check_length(system.info(path)["size"])
            system.get_file(path, str(target))
            return _check_size(target.stat().st_size, size)
        received = 0
        with target.open("wb") as file, _stream(system, path) as source:
            check_length(_content_length(source))
            while received <= size and (piece := source.read(min(PIECE, size + 1 - received))):
                received += len(piece)
                file.write(piece)
        _check_size(received, size)

    attempt(url, get, size)


def read_range(url: Url, system: Any, path: str, start: int, end: int) -> bytes:
    """The bytes `start` to `end - 1` of a file, and at most one more if a web server sends too many."""
    if not url.is_web:
        return system.cat_file(path, start=start, end=end)
    with _stream(system, path, Range=f"bytes={start}-{end - 1}") as file:
        if file.r.status != 206:
            raise OSError(errno.EOPNOTSUPP, "the server does not give parts of files: say cache_dir=")
        return _read_at_most(file, end - start)


def _read(url: Url, system: Any, path: str, limit: int) -> bytes:
    length = None
    if url.is_web:
        with _stream(system, path) as file:
            content, length = _read_at_most(file, limit), _content_length(file)
    else:
        try:
            content = system.cat_file(path, start=0, end=limit + 1)
        except Exception as error:
            if http_status(error) != 416:
                raise
            content = b""  # an empty file has no range
    if len(content) > limit:
        raise OSError(errno.EFBIG, f"it has more than {limit} bytes")
    if length is not None:
        _check_size(len(content), length)
    return content


def _content_length(file: Any) -> int | None:
    """The number of bytes that a web server announces; None if it announces none."""
    text = file.r.headers.get("Content-Length", "")
    return int(text) if text.isdigit() and "Content-Encoding" not in file.r.headers else None


def _stream(system: Any, path: str, **headers: str) -> Any:
    """The answer of a web server as a stream, without another request for its size."""
    return system.open(path, "rb", block_size=0, size=1, headers={"Accept-Encoding": "identity", **headers})


def _read_at_most(file: Any, limit: int) -> bytes:
    """The content of a stream, up to one byte more than `limit`."""
    content = bytearray()
    while len(content) <= limit and (piece := file.read(min(PIECE, limit + 1 - len(content)))):
        content += piece
    return bytes(content)


def _check_size(received: int, expected: int) -> None:
    if received != expected:
        raise OSError(errno.EIO, f"{received} of {expected} bytes arrived")


def _info(system: Any, path: str) -> dict[str, Any]:
    try:
        return system.info(path)
    except FileNotFoundError as error:
        if error.__cause__ is not None:  # fsspec reports a missing file even if no server answers
            raise error.__cause__ from None
        raise


def _names(system: Any, path: str, call: Callable[..., list[str]]) -> list[str]:
    """The names that `call` lists in a folder, relative to it, sorted."""
    try:
        paths = call(path, detail=False)
    except (FileNotFoundError, NotADirectoryError):
        return []
    prefix = system._strip_protocol(path).rstrip("/") + "/"
    names = (system._strip_protocol(name) for name in paths)
    return sorted(name.removeprefix(prefix) for name in names if name.startswith(prefix) and name != prefix)
