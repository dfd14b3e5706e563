"""What a command prints beside its result: -q, -v and --log, which all verbs have."""

import argparse
import contextlib
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TextIO

from gen2d.core.errors import Error, UserError


class LineStream:
    """A text stream that passes whole lines to a function; it is no terminal, and otherwise as another stream."""

    def __init__(self, stream: TextIO, write_line: Callable[[str], None]) -> None:
        self._stream, self._write_line, self._rest = stream, write_line, ""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def isatty(self) -> bool:
        return False  # progress is shown as lines

    def write(self, text: str) -> int:
        *lines, self._rest = (self._rest + text).split("\n")
        for line in lines:
            self._write_line(line)
        return len(text)

    def finish(self) -> None:
        """Pass on a last line without an end."""
        if self._rest:
            self._write_line(self._rest)
        self._rest = ""


@contextlib.contextmanager
def output(options: argparse.Namespace) -> Iterator[None]:
    """A block whose output is as the arguments of `add_output` say. Raises UserError if the log cannot be opened."""
    if not (options.quiet or options.verbose or options.log):
        yield
        return
    start, stdout, stderr = time.perf_counter(), sys.stdout, sys.stderr
    with contextlib.ExitStack() as stack:
        log = stack.enter_context(_opened(options.log)) if options.log else None

        def record(line: str) -> None:
            if log is not None:
                print(time.strftime("%Y-%m-%d %H:%M:%S"), line, file=log, flush=True)

        def result(line: str) -> None:
            record(line)
            print(line, file=stdout, flush=True)

        def message(line: str) -> None:
            record(line)
            if not options.quiet or line.startswith("gen2d: "):  # an error
                print(*([f"[{time.perf_counter() - start:.1f} s]"] if options.verbose else []), line, file=stderr)

        streams = LineStream(stdout, result), LineStream(stderr, message)
        sys.stdout, sys.stderr = streams  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        except BaseException as error:
            if options.verbose and isinstance(error, Exception):
                for line in "".join(traceback.format_exception(error)).splitlines():
                    message(line)
            record(f"gen2d: {error if isinstance(error, Error) else repr(error)}")
            raise
        finally:
            sys.stdout, sys.stderr = stdout, stderr
            for stream in streams:
                stream.finish()


def _opened(path: str) -> TextIO:
    try:
        return Path(path).open("a", encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise UserError(f"--log is {path!r}, which cannot be written ({error.strerror})") from None
