"""Files and folders at a URL, used by the names that pathlib has for the same.

`place` makes a Path of a folder on disk and a Url of anything else, and what is written for the one then works with the
other. fsspec knows the protocols; it is imported when the first URL is met. An object appears whole or not at all, so
nothing is renamed; folders are only what names begin with.

Every request has a limit on waiting and a deadline. What a server may mend is tried again until then; what remains is
UnreachableError, or FileNotFoundError and PermissionError where the server says so. No message, repr or log shows the
user name, password or query of a URL.
"""

import contextlib
import dataclasses
import errno
import fnmatch
import functools
import os
import re
import stat
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath
from typing import Any, TypeVar

from gen2d.core.errors import ConfigError, DamagedError, FolderError, UnreachableError

PAUSE = 0.25  # s, before the second attempt; doubled before each that follows
ATTEMPTS = 4
PIECE = 2**20  # bytes of a file that are received at once
SLOWEST = 2**20  # bytes/s: a file may take so much longer than the deadline

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Network:
    """How long a server is waited for."""

    timeout: float = 30.0  # s, to connect, and between two pieces of an answer
    deadline: float = 300.0  # s, for a request in all, every further attempt included

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e9:
                raise ConfigError(f"{name} is {value!r}, but must be a number of seconds above 0")


@dataclasses.dataclass(frozen=True, order=True)
class Url:
    """A file or folder elsewhere; methods do as those of pathlib.Path, and raise OSError as they do."""

    text: str = dataclasses.field(repr=False)  # without the query
    query: str = dataclasses.field(default="", repr=False)  # with its question mark
    network: Network = dataclasses.field(default=Network(), compare=False, repr=False)

    def __truediv__(self, name: str | PurePath) -> "Url":
        return dataclasses.replace(self, text=f"{self.text}/{PurePath(name).as_posix()}")

    def __str__(self) -> str:
        return shown(self.text + self.query)

    def __repr__(self) -> str:
        return f"Url({str(self)!r})"

    @property
    def name(self) -> str:
        return self.text.rpartition("/")[2]

    @property
    def parent(self) -> "Url":
        return dataclasses.replace(self, text=self.text.rpartition("/")[0])

    @property
    def is_listed(self) -> bool:
        """Whether the server tells what is in a folder; plain web servers need not."""
        return not self.is_web

    @property
    def is_web(self) -> bool:
        return self.text.startswith(("http://", "https://"))

    def stat(self) -> os.stat_result:
        """Size and kind; the rest is not known."""
        about = attempt(self, _about)
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
        listed = attempt(self, lambda system, path: _listed(system, path, system.ls)) if self.is_listed else []
        return (self / name for name in listed)

    def glob(self, pattern: str) -> "Iterator[Url]":
        return (path for path in self.iterdir() if fnmatch.fnmatchcase(path.name, pattern))

    def rglob(self, pattern: str) -> "Iterator[Url]":
        listed = attempt(self, lambda system, path: _listed(system, path, system.find)) if self.is_listed else []
        return (self / name for name in listed if fnmatch.fnmatchcase(PurePath(name).name, pattern))

    def read_bytes(self, limit: int) -> bytes:
        """The whole content, of at most `limit` bytes; OSError(EFBIG) where it has more."""
        return attempt(self, lambda system, path: _read(self, system, path, limit))

    def unlink(self, missing_ok: bool = False) -> None:
        try:
            attempt(self, lambda system, path: system.rm_file(path))
        except FileNotFoundError:
            if not missing_ok:
                raise

    def copy(self, target: "Url") -> None:
        """Returns when the object has this name, too."""
        attempt(self, lambda system, path: system.cp_file(path, system._strip_protocol(target.text)), 2**33)


Place = Path | Url


def place(path: str | Place, network: Network | None = None) -> Place:
    """Where a dataset lies: a Path, or a Url of what has a protocol other than file.

    Raises FolderError for a URL of which it is known at once that it cannot be used.
    """
    if isinstance(path, Url):
        return path if network is None else dataclasses.replace(path, network=network)
    if not isinstance(path, str) or "://" not in path:
        return Path(path)
    protocol, _, rest = path.partition("://")
    if protocol in ("file", "local"):
        return Path(rest)
    if not rest.strip("/") or "::" in path or not re.fullmatch(r"[A-Za-z0-9+.-]+", protocol):
        raise FolderError(f"{shown(path)} must be PROTOCOL://FOLDER, such as s3://bucket/dataset")
    text, mark, query = path.partition("?") if protocol in ("http", "https", "az", "abfs", "abfss") else (path, "", "")
    url = Url(text.rstrip("/"), mark + query, network or Network())
    _system(url)
    return url


def shown(text: str) -> str:
    """A URL without what must stay secret: user name and password, and the values of its query."""
    start, mark, rest = text.partition("://")
    if not mark:
        return text
    rest, question, _ = rest.partition("?")
    host, slash, path = rest.partition("/")
    _, at, bare = host.rpartition("@")
    return f"{start}://{'***@' if at else ''}{bare}{slash}{path}{'?***' if question else ''}"


def _without_secrets(sentence: str, url: Url) -> str:
    """What a library says of a URL, with none of its secrets."""
    host = url.text.partition("://")[2].partition("/")[0]
    user = host.rpartition("@")[0]
    values = [value for pair in url.query.lstrip("?").split("&") for value in (pair.partition("=")[2],)]
    for secret in (url.query, user, *user.split(":"), *values):
        if len(secret) > 2:
            sentence = sentence.replace(secret, "***")
    return sentence


@contextlib.contextmanager
def reading(root: Place) -> Iterator[None]:
    """A block that reads a dataset; of a Url its OSError becomes a FolderError."""
    try:
        yield
    except OSError as error:
        if isinstance(root, Path):
            raise
        raise FolderError(f"{error.filename or root} cannot be read ({error.strerror or error})") from None


def upload(source: Path, url: Url) -> None:
    """Returns when the file is there, whole."""
    size = source.stat().st_size

    def put(system: Any, path: str) -> None:
        system.put_file(str(source), path)
        _check_size(system.info(path)["size"], size)

    attempt(url, put, size)


def download(url: Url, target: Path, size: int) -> None:
    """Returns when `target` holds the file, all its `size` bytes."""

    def get(system: Any, path: str) -> None:
        if not url.is_web:
            _check_length(system.info(path)["size"], size, url)
            system.get_file(path, str(target))
            return _check_size(target.stat().st_size, size)
        got = 0
        with target.open("wb") as file, _stream(system, path) as source:
            _check_length(_length(source), size, url)
            while got <= size and (piece := source.read(min(PIECE, size + 1 - got))):
                got += len(piece)
                file.write(piece)
        _check_size(got, size)

    attempt(url, get, size)


def read_range(url: Url, system: Any, path: str, start: int, end: int) -> bytes:
    """The bytes of a file from `start` to before `end`, and never more, whatever the server sends."""
    if not url.is_web:
        return system.cat_file(path, start=start, end=end)
    with _stream(system, path, Range=f"bytes={start}-{end - 1}") as file:
        if file.r.status != 206:
            raise OSError(errno.EOPNOTSUPP, "the server does not give parts of files: say cache_dir=")
        return _read_at_most(file, end - start)


def _read(url: Url, system: Any, path: str, limit: int) -> bytes:
    if not url.is_web:
        content = _all_of(system, path, limit + 1)
        if len(content) > limit:
            raise _too_large(limit)
        return content
    with _stream(system, path) as file:
        content, length = _read_at_most(file, limit), _length(file)
    if len(content) > limit:
        raise _too_large(limit)
    if length is not None:
        _check_size(len(content), length)
    return content


def _all_of(system: Any, path: str, most: int) -> bytes:
    """The first `most` bytes of a file, in one request."""
    try:
        return system.cat_file(path, start=0, end=most)
    except Exception as error:
        if _status(error) == 416:  # it has none
            return b""
        raise


def _length(file: Any) -> int | None:
    """How many bytes a web server says will come; None if it does not say."""
    said = file.r.headers.get("Content-Length", "")
    return int(said) if said.isdigit() and "Content-Encoding" not in file.r.headers else None


def _check_length(said: int | None, expected: int, url: Url) -> None:
    if said is not None and said != expected:
        raise DamagedError(f"{url} has {said} bytes, but must have {expected}")


def _stream(system: Any, path: str, **headers: str) -> Any:
    """The answer of a web server, to be read as it comes; a request, and not one more to learn the size."""
    return system.open(path, "rb", block_size=0, size=1, headers={"Accept-Encoding": "identity", **headers})


def _read_at_most(file: Any, limit: int) -> bytes:
    """What comes of a file up to a byte more than `limit`."""
    content = bytearray()
    while len(content) <= limit and (piece := file.read(min(PIECE, limit + 1 - len(content)))):
        content += piece
    return bytes(content)


def _too_large(limit: int) -> OSError:
    return OSError(errno.EFBIG, f"it has more than {limit} bytes")


def _check_size(found: int, expected: int) -> None:
    if found != expected:
        raise OSError(errno.EIO, f"{found} bytes came of {expected}")


def _about(system: Any, path: str) -> dict[str, Any]:
    try:
        return system.info(path)
    except FileNotFoundError as error:
        if error.__cause__ is not None:  # fsspec calls a file missing also where no server answers
            raise error.__cause__ from None
        raise


def _listed(system: Any, path: str, call: Callable[..., list[str]]) -> list[str]:
    """The names under a folder, from it on."""
    try:
        found = call(path, detail=False)
    except (FileNotFoundError, NotADirectoryError):
        return []
    inside = system._strip_protocol(path).rstrip("/") + "/"
    names = (system._strip_protocol(name) for name in found)
    return sorted(name.removeprefix(inside) for name in names if name.startswith(inside) and name != inside)


# ---- Attempts


def attempt(url: Url, call: Callable[[Any, str], T], size: int = 0) -> T:
    """What `call` returns for the URL's file system and path there, after as many attempts as it takes.

    `size` are the bytes that move: a large file has more time. Raises OSError for what no other attempt would mend,
    and UnreachableError.
    """
    system = _system(url)
    path = system._strip_protocol(url.text) + url.query
    end = time.monotonic() + url.network.deadline + size / SLOWEST
    for number in range(ATTEMPTS):
        try:
            return _within(end - time.monotonic(), lambda: call(system, path))
        except Exception as error:
            failure = explained(error, url)
        left = end - time.monotonic() - PAUSE * 2**number
        if not isinstance(failure, UnreachableError) or number == ATTEMPTS - 1 or left <= 0:
            raise failure from None
        time.sleep(PAUSE * 2**number)
    raise AssertionError("unreachable")


def _within(seconds: float, call: Callable[[], T]) -> T:
    """What the call returns, if it takes no longer; it is left alone in its thread where it does."""
    returned: list[T] = []
    raised: list[BaseException] = []

    def run() -> None:
        try:
            returned.append(call())
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True, name="gen2d-request")
    thread.start()
    thread.join(max(0.0, seconds))
    if raised:
        raise raised[0]
    if not returned:
        raise TimeoutError("no answer within the deadline")
    return returned[0]


_FINAL = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)
_LASTING = (errno.EFBIG, errno.EOPNOTSUPP, errno.ENOSPC, errno.EMFILE, errno.ENFILE)  # and these


def explained(error: BaseException, url: Url) -> Exception:
    """The error as one of ours: OSError for what another attempt would not mend, DamagedError for a file of another
    length, else UnreachableError."""
    status = _status(error)
    if status in (401, 403) or "Credentials" in type(error).__name__:
        error = PermissionError()
    elif status in (404, 410):
        error = FileNotFoundError()
    elif status == 416:  # range not satisfiable
        return DamagedError(f"{url} ends too early")
    if isinstance(error, DamagedError):
        return error
    for kind in _FINAL:
        if isinstance(error, kind):
            number = errno.EACCES if kind is PermissionError else errno.ENOENT
            return kind(number, os.strerror(number), str(url))
    number = getattr(error, "errno", None)
    text = getattr(error, "strerror", None) or str(error)
    text = text or ("no answer in time" if isinstance(error, TimeoutError) else type(error).__name__)
    text = " ".join(_without_secrets(text, url).split()).rstrip(".")
    lasting = number in _LASTING or isinstance(error, TypeError | ValueError | NotImplementedError | AttributeError)
    if lasting or (status is not None and 400 <= status < 500 and status not in (408, 425, 429)):
        return OSError(number or errno.EIO, text, str(url))
    return UnreachableError(f"{url} cannot be reached ({text})")


def _status(error: BaseException | None) -> int | None:
    """What a web server, or S3, answered with."""
    while error is not None:
        status = getattr(error, "status", None)
        response = getattr(error, "response", None)
        if status is None and isinstance(response, dict):
            status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
        if isinstance(status, int):
            return status
        error = error.__cause__
    return None


def _system(url: Url) -> Any:
    """The file system that knows the URL; one that was made before a fork is another."""
    return _file_system("/".join(url.text.split("/")[:3]), url.network.timeout, os.getpid())


@functools.lru_cache(maxsize=32)
def _file_system(start: str, timeout: float, process: int) -> Any:
    name = shown(start)
    try:
        import fsspec
    except ImportError:
        raise FolderError(f"{name} needs fsspec: pip install 'gen2d[remote]'") from None
    try:
        # What others write must be seen at once.
        return fsspec.core.url_to_fs(start, use_listings_cache=False, **_limits(start, timeout))[0]
    except ImportError as error:
        hint = ": pip install 'gen2d[remote]'" if start.startswith(("s3:", "http")) else ""
        raise FolderError(f"{name} needs another package ({error}){hint}") from None
    except Exception as error:
        known = ", ".join(sorted(name for name in fsspec.available_protocols() if name in _COMMON))
        reason = _without_secrets(" ".join(str(error).split()), Url(start))
        raise FolderError(f"{name} cannot be used ({reason}); common protocols are {known}") from None


def _limits(start: str, timeout: float) -> dict[str, Any]:
    """How a file system is told how long to wait for a server; that of another protocol has its own limits."""
    if start.startswith(("http://", "https://")):
        import aiohttp

        limits = aiohttp.ClientTimeout(total=None, sock_connect=timeout, sock_read=timeout)
        return {"client_kwargs": {"timeout": limits}}
    if start.startswith(("s3://", "s3a://")):
        retries = {"max_attempts": 1}  # trying again is for `attempt`
        return {"config_kwargs": {"connect_timeout": timeout, "read_timeout": timeout, "retries": retries}}
    return {}


_COMMON = ("s3", "gs", "az", "http", "https", "sftp", "memory", "file")
