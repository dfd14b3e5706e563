"""Files and folders at a URL, used by the names that pathlib has for the same.

`place` makes a Path of a folder on disk and a Url of anything else, and what is written for the one then works with the
other. fsspec knows the protocols; it is imported when the first URL is met. An object appears whole or not at all, so
nothing is renamed; folders are only what names begin with. What fails is tried again, as networks do fail; what then
remains is an OSError that names the URL.
"""

import contextlib
import dataclasses
import errno
import fnmatch
import functools
import os
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple, TypeVar

from gen2d.core.errors import FolderError

ATTEMPTS = 4
PAUSE = 0.25  # s, before the second attempt; doubled before each that follows
NEAR = 2**18  # bytes: reading over such a gap takes less time than asking twice
LONGEST = 2**23  # bytes in one request: longer ones take more time than several at once

T = TypeVar("T")


@dataclasses.dataclass(frozen=True, order=True)
class Url:
    """A file or folder elsewhere; methods do as those of pathlib.Path, and raise OSError as they do."""

    text: str

    def __truediv__(self, name: str | PurePath) -> "Url":
        return Url(f"{self.text}/{PurePath(name).as_posix()}")

    def __str__(self) -> str:
        return self.text

    @property
    def name(self) -> str:
        return self.text.rpartition("/")[2]

    @property
    def parent(self) -> "Url":
        return Url(self.text.rpartition("/")[0])

    def stat(self) -> os.stat_result:
        """Size and kind; the rest is not known."""
        about = _tried(self, lambda system, path: system.info(path))
        kind = stat.S_IFDIR if about["type"] == "directory" else stat.S_IFREG
        return os.stat_result((kind, 0, 0, 1, 0, 0, about["size"] or 0, 0, 0, 0))

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
        """Does nothing: a folder is there when something is in it."""

    def iterdir(self) -> "Iterator[Url]":
        listed = _tried(self, lambda system, path: _listed(system, path, system.ls))
        return (self / name for name in listed)

    def glob(self, pattern: str) -> "Iterator[Url]":
        return (path for path in self.iterdir() if fnmatch.fnmatchcase(path.name, pattern))

    def rglob(self, pattern: str) -> "Iterator[Url]":
        listed = _tried(self, lambda system, path: _listed(system, path, system.find))
        return (self / name for name in listed if fnmatch.fnmatchcase(PurePath(name).name, pattern))

    def read_bytes(self) -> bytes:
        return _tried(self, lambda system, path: system.cat_file(path))

    def unlink(self, missing_ok: bool = False) -> None:
        try:
            _tried(self, lambda system, path: system.rm_file(path))
        except FileNotFoundError:
            if not missing_ok:
                raise


Place = Path | Url


def place(path: str | Place) -> Place:
    """Where a dataset lies: a Path, or a Url of what has a protocol other than file.

    Raises FolderError for a URL of which it is known at once that it cannot be used.
    """
    if not isinstance(path, str) or "://" not in path:
        return path if isinstance(path, Url) else Path(path)
    protocol, _, rest = path.partition("://")
    if protocol in ("file", "local"):
        return Path(rest)
    if not rest.strip("/") or "::" in path:
        raise FolderError(f"{path} must be PROTOCOL://FOLDER, such as s3://bucket/dataset")
    url = Url(path.rstrip("/"))
    _system(url)
    return url


@contextlib.contextmanager
def reading(root: Place) -> Iterator[None]:
    """A block that reads a dataset; of a Url its OSError becomes a FolderError."""
    try:
        yield
    except OSError as error:
        if isinstance(root, Path):
            raise
        raise FolderError(f"{error.filename or root} cannot be read ({error.strerror or error})") from error


def upload(source: Path, url: Url) -> None:
    """Returns when the file is there, whole."""

    def put(system: Any, path: str) -> None:
        system.put_file(str(source), path)
        _check_size(system.info(path)["size"], source.stat().st_size)

    _tried(url, put)


def download(url: Url, target: Path, size: int | None = None) -> None:
    """Returns when `target` holds the file, all its `size` bytes if that is known."""

    def get(system: Any, path: str) -> None:
        system.get_file(path, str(target))
        if size is not None:
            _check_size(target.stat().st_size, size)

    _tried(url, get)


class Range(NamedTuple):
    """The bytes of a file from `start` to before `end`."""

    url: Url
    start: int
    end: int


def read_ranges(ranges: Sequence[Range]) -> list[bytes | OSError]:
    """The bytes of each range, or why there are none; asked for at once, those near each other together."""
    spans = _spans(ranges)
    read = dict(zip(spans, _read(list(spans)), strict=True))
    found: dict[Range, bytes | OSError] = {}
    for span, members in spans.items():
        data = read[span]
        for one in members:
            found[one] = data if isinstance(data, OSError) else data[one.start - span.start : one.end - span.start]
    return [found[one] for one in ranges]


def _spans(ranges: Sequence[Range]) -> dict[Range, list[Range]]:
    """What to ask for, and which ranges are in it."""
    spans: dict[Range, list[Range]] = {}
    span, members = None, []
    for one in sorted(ranges):
        if span and one.url == span.url and one.start - span.end <= NEAR and one.end - span.start <= LONGEST:
            del spans[span]
            span = Range(span.url, span.start, max(span.end, one.end))
        else:
            span, members = one, []
        members.append(one)
        spans[span] = members
    return spans


def _read(spans: list[Range]) -> list[bytes | OSError]:
    found: dict[int, bytes | OSError] = {i: b"" for i, span in enumerate(spans) if span.start == span.end}
    missing = [i for i in range(len(spans)) if i not in found]
    for attempt in range(ATTEMPTS):
        if not missing:
            break
        if attempt:
            time.sleep(PAUSE * 2 ** (attempt - 1))
        read = _asked([spans[i] for i in missing])
        found |= zip(missing, read, strict=True)
        missing = [i for i in missing if isinstance(found[i], OSError) and not isinstance(found[i], _FINAL)]
    return [found[i] for i in range(len(spans))]


def _asked(spans: list[Range]) -> list[bytes | OSError]:
    """One attempt."""
    system = _system(spans[0].url)
    paths = [system._strip_protocol(span.url.text) for span in spans]
    try:
        read = system.cat_ranges(paths, [s.start for s in spans], [s.end for s in spans], on_error="return")
    except Exception as error:
        read = [error] * len(spans)
    return [_checked(data, span) for data, span in zip(read, spans, strict=True)]


def _checked(data: bytes | BaseException, span: Range) -> bytes | OSError:
    if isinstance(data, BaseException):
        return _told(data, span.url)
    if len(data) > span.end - span.start:
        return OSError(errno.EOPNOTSUPP, "the server does not give parts of files: say cache_dir=", str(span.url))
    if len(data) < span.end - span.start:
        return OSError(errno.EIO, "the file ends too early", str(span.url))
    return data


def _check_size(found: int, expected: int) -> None:
    if found != expected:
        raise OSError(errno.EIO, f"{found} bytes came of {expected}")


def _listed(system: Any, path: str, call: Callable[..., list[str]]) -> list[str]:
    """The names under a folder, from it on; a server that lists nothing has none."""
    try:
        found = call(path, detail=False)
    except (FileNotFoundError, NotADirectoryError):
        return []
    inside = system._strip_protocol(path).rstrip("/") + "/"
    names = (system._strip_protocol(name) for name in found)
    return sorted(name.removeprefix(inside) for name in names if name.startswith(inside) and name != inside)


def _tried(url: Url, call: Callable[[Any, str], T]) -> T:
    """What `call` returns for the URL's file system and path there, after as many attempts as it takes."""
    system = _system(url)
    path = system._strip_protocol(url.text)
    for attempt in range(ATTEMPTS):
        try:
            return call(system, path)
        except Exception as error:
            told = _told(error, url)
            if isinstance(told, _FINAL) or attempt == ATTEMPTS - 1:
                raise told from error
        time.sleep(PAUSE * 2**attempt)
    raise AssertionError("unreachable")


# Another attempt would end alike.
_FINAL = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)


def _told(error: BaseException, url: Url) -> OSError:
    """The error as one that pathlib could raise."""
    cause = error.__cause__
    if isinstance(error, FileNotFoundError) and type(cause).__module__.startswith("aiohttp"):
        error = cause or error  # fsspec calls a file missing also where no server answers
    if getattr(error, "status", None) in (401, 403) or "Credentials" in type(error).__name__:
        error = PermissionError()
    for kind in _FINAL:
        if isinstance(error, kind):
            number = errno.EACCES if kind is PermissionError else errno.ENOENT
            return kind(number, os.strerror(number), str(url))
    number = getattr(error, "errno", None) or errno.EIO
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return OSError(number, " ".join(text.split()), str(url))


def _system(url: Url) -> Any:
    """The file system that knows the URL; one that was made before a fork is another."""
    return _made("/".join(url.text.split("/")[:3]), os.getpid())


@functools.lru_cache(maxsize=32)
def _made(start: str, process: int) -> Any:
    try:
        import fsspec
    except ImportError:
        raise FolderError(f"{start} needs fsspec: pip install 'gen2d[remote]'") from None
    try:
        # What others write must be seen at once.
        return fsspec.core.url_to_fs(start, use_listings_cache=False)[0]
    except ImportError as error:
        hint = ": pip install 'gen2d[remote]'" if start.startswith(("s3:", "http")) else ""
        raise FolderError(f"{start} needs another package ({error}){hint}") from None
    except Exception as error:
        known = ", ".join(sorted(name for name in fsspec.available_protocols() if name in _COMMON))
        told = " ".join(str(error).split())
        raise FolderError(f"{start} cannot be used ({told}); common protocols are {known}") from None


_COMMON = ("s3", "gs", "az", "http", "https", "sftp", "memory", "file")
