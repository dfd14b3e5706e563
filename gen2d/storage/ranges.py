"""Byte ranges of remote files, read in parallel and coalesced when they are close."""

import errno
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from gen2d.core.errors import DamagedError, UnreachableError
from gen2d.storage.paths import Url, read_range
from gen2d.storage.retries import attempt

NEAR = 2**18  # bytes; reading a gap of this size takes less time than a second request
LONGEST = 2**23  # bytes of a request; a longer one takes more time than several in parallel
AT_ONCE = 32  # parallel requests


class Range(NamedTuple):
    """The bytes of a file from `start` to before `end`."""

    url: Url
    start: int
    end: int


def read_ranges(ranges: Sequence[Range]) -> list[bytes | Exception]:
    """Bytes of each range, or the error of reading it."""
    spans = _spans(ranges)
    if len(spans) > 1:
        with ThreadPoolExecutor(min(AT_ONCE, len(spans)), "gen2d-ranges") as pool:
            read = dict(zip(spans, pool.map(_read, spans), strict=True))
    else:
        read = {span: _read(span) for span in spans}
    contents: dict[Range, bytes | Exception] = {}
    for span, members in spans.items():
        data = read[span]
        for one in members:
            contents[one] = data if isinstance(data, Exception) else data[one.start - span.start : one.end - span.start]
    return [contents[one] for one in ranges]


def _spans(ranges: Sequence[Range]) -> dict[Range, list[Range]]:
    """Range of each request, and the ranges inside it.

    fsspec's `merge_offset_ranges` is not used, as older versions lose the end of a range that contains another.
    """
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


def _read(span: Range) -> bytes | Exception:
    url, start, end = span
    if start == end:
        return b""
    try:
        data = attempt(url, lambda system, path: read_range(url, system, path, start, end))
    except (OSError, DamagedError, UnreachableError) as error:
        return error
    if len(data) > end - start:
        return OSError(errno.EOPNOTSUPP, "the server sends more than was asked for: say cache_dir=", str(url))
    return data if len(data) == end - start else DamagedError(f"{url} ends too early")
