"""What long work tells a person, and how a signal stops it."""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

from gen2d.core.humanize import in_time


@contextmanager
def progress(count: int, say: Callable[[str], None]) -> Iterator[Callable[[int], None]]:
    """A bar on a terminal; elsewhere a plain line every ten seconds. Yields what to call with each number of videos."""
    if sys.stderr.isatty():
        with tqdm(total=count, unit=" videos", smoothing=0.1, dynamic_ncols=True) as bar:

            def moved(videos: int) -> None:
                bar.update(videos)

            yield moved
        return
    began = told = time.perf_counter()
    done = 0

    def advance(videos: int) -> None:
        nonlocal done, told
        done += videos
        now = time.perf_counter()
        if now - told >= 10 and done < count:
            told, speed = now, done / (now - began)
            say(f"{done:,} of {count:,} videos, {speed:,.0f} videos/s, {in_time((count - done) / speed)} left")

    yield advance


@contextmanager
def stopping_on_sigterm(say: Callable[[str], None]) -> Iterator[None]:
    """Makes SIGTERM stop the run as Ctrl-C does; a second signal of either kind ends the process at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, _: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        say("Stopping; what is being compiled or written is finished or dropped first. A second signal does not wait.")
        raise KeyboardInterrupt(number)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
