"""Progress display of long tasks, and interruption by signals."""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

from gen2d.core.humanize import in_time


def to_stderr(line: str) -> None:
    """Print a line to standard error and flush."""
    print(line, file=sys.stderr, flush=True)


@contextmanager
def progress(count: int, log: Callable[[str], None]) -> Iterator[Callable[[int], None]]:
    """Progress bar on a terminal; elsewhere one line every ten seconds, passed to `log`.

    Yields a function that advances the progress by a number of videos.
    """
    if sys.stderr.isatty():
        with tqdm(total=count, unit=" videos", smoothing=0.1, dynamic_ncols=True) as bar:

            def update(videos: int) -> None:
                bar.update(videos)

            yield update
        return
    start = printed = time.perf_counter()
    done = 0

    def advance(videos: int) -> None:
        nonlocal done, printed
        done += videos
        now = time.perf_counter()
        if now - printed >= 10 and done < count:
            printed, speed = now, done / (now - start)
            log(f"{done:,} of {count:,} videos, {speed:,.0f} videos/s, {in_time((count - done) / speed)} left")

    yield advance


@contextmanager
def stopping_on_sigterm(log: Callable[[str], None]) -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGTERM or SIGINT inside the block; a second signal ends the process at once.

    Without effect outside the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, _: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        log("Stopping, once compilation has ended and open files are closed or removed; a second signal stops at once.")
        raise KeyboardInterrupt(number)

    handlers = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
