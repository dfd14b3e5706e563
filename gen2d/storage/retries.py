"""Requests to servers: timeouts, deadlines, retries, and the errors of a request that failed in the end.

Reads, uploads and downloads all pass through `attempt`. Each request has a timeout and a deadline. Failures of servers
that may be temporary are retried until the deadline and then raise UnreachableError; FileNotFoundError and
PermissionError are raised where the server says so. Errors of the program, such as TypeError, are raised as they are.
"""

import dataclasses
import errno
import os
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

from gen2d.core.errors import ConfigError, DamagedError, UnreachableError
from gen2d.storage.filesystems import file_system, redact, redact_url

PAUSE = 0.25  # s, before the second attempt; doubled before each later one
ATTEMPTS = 4
SLOWEST = 2**20  # bytes/s, by which the deadline of a large file is extended

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Network:
    """Limits on the time that a server may take."""

    timeout: float = 30.0  # s, to connect and between two parts of an answer
    deadline: float = 300.0  # s, for a request including all further attempts

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e9:
                raise ConfigError(f"{name} is {value!r}, but must be a number of seconds above 0")


@dataclasses.dataclass(frozen=True, order=True)
class Address:
    """A URL and the limits on requests to it."""

    text: str = dataclasses.field(repr=False)  # without the query
    query: str = dataclasses.field(default="", repr=False)  # including its question mark
    network: Network = dataclasses.field(default=Network(), compare=False, repr=False)

    def __str__(self) -> str:
        return redact_url(self.text + self.query)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"


def attempt(url: Address, call: Callable[[Any, str], T], size: int = 0) -> T:
    """The result of `call` for the URL's file system and the path in it, after as many attempts as it takes.

    `size` is the number of bytes to transfer, which extends the deadline. Raises OSError for failures that another
    attempt would not solve, DamagedError, and UnreachableError.
    """
    system = file_system(url.text, url.network.timeout)
    path = system._strip_protocol(url.text) + url.query
    end = time.monotonic() + url.network.deadline + size / SLOWEST
    for number in range(ATTEMPTS):
        try:
            return _within(end - time.monotonic(), lambda: call(system, path))
        except Exception as error:
            failure = request_error(error, url)
        left = end - time.monotonic() - PAUSE * 2**number
        if not isinstance(failure, UnreachableError) or number == ATTEMPTS - 1 or left <= 0:
            raise failure from None
        time.sleep(PAUSE * 2**number)
    raise AssertionError("unreachable")


def _within(seconds: float, call: Callable[[], T]) -> T:
    """The result of the call; raises TimeoutError if it takes longer, and leaves it to its thread."""
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


# Errors that another attempt would not solve.
_FINAL = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)
# Errors of the program itself. Their subclass NotImplementedError is not one: the protocol cannot do what is asked.
_BUGS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    ImportError,
    LookupError,
    MemoryError,
    NameError,
    RuntimeError,
    SystemError,
    TypeError,
)
_FINAL_NUMBERS = (errno.EFBIG, errno.EOPNOTSUPP, errno.ENOSPC, errno.EMFILE, errno.ENFILE)


def request_error(error: BaseException, url: Address) -> Exception:
    """The error to raise for a library's error: OSError if another attempt would not solve it, DamagedError for a file
    of another length, the same error for one of the program, otherwise UnreachableError."""
    status = http_status(error)
    if status in (401, 403) or "Credentials" in type(error).__name__:
        error = PermissionError()
    elif status in (404, 410):
        error = FileNotFoundError()
    elif status == 416:  # range not satisfiable
        return DamagedError(f"{url} ends too early")
    if isinstance(error, DamagedError) or (isinstance(error, _BUGS) and not isinstance(error, NotImplementedError)):
        return error
    for kind in _FINAL:
        if isinstance(error, kind):
            number = errno.EACCES if kind is PermissionError else errno.ENOENT
            return kind(number, os.strerror(number), str(url))
    number = getattr(error, "errno", None)
    text = getattr(error, "strerror", None) or str(error)
    text = text or ("no answer in time" if isinstance(error, TimeoutError) else type(error).__name__)
    text = " ".join(redact(text, url.text, url.query).split()).rstrip(".")
    final = number in _FINAL_NUMBERS or isinstance(error, ValueError | NotImplementedError)
    if final or (status is not None and 400 <= status < 500 and status not in (408, 425, 429)):
        return OSError(number or errno.EIO, text, str(url))
    return UnreachableError(f"{url} cannot be reached ({text})")


def http_status(error: BaseException | None) -> int | None:
    """The HTTP status that a web server or S3 answered with."""
    while error is not None:
        status = getattr(error, "status", None)
        response = getattr(error, "response", None)
        if status is None and isinstance(response, dict):
            status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
            if response.get("Error", {}).get("Code") == "RequestTimeout":  # for which S3 answers with 400
                status = 408
        if isinstance(status, int):
            return status
        error = error.__cause__
    return None
