"""Progress display of long tasks, and interruption by signals.

Lines go to a caller's `log` or, by default, to the logger "gen2d" at level INFO. The command line shows them, and so do
a terminal and a notebook in which no handler of logging is set.
"""

import json
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from gen2d.core.humanize import in_time, with_noun

PATIENCE, PERIOD = 2.0, 10.0  # seconds after which a wait is announced, and between two lines about it
LOGGER = logging.getLogger("gen2d")
Log = Callable[[str], None]


class Event(str):
    """A line for people, with the same as `values` for machines."""

    values: dict[str, Any]

    @classmethod
    def of(cls, line: str, name: str, **values: Any) -> "Event":
        event = cls(line)
        event.values = {"event": name, **values}
        return event


def to_stderr(line: str) -> None:
    """Print a line to standard error, above a progress bar if there is one, and flush."""
    bars = sys.modules.get("tqdm")
    if bars is not None and sys.stderr.isatty():
        bars.tqdm.write(line, file=sys.stderr)
    else:
        print(line, file=sys.stderr, flush=True)


def to_json(line: str) -> None:
    """Print a line to standard output as a JSON object, with the values of an `Event`, and flush."""
    values = line.values if isinstance(line, Event) else {"event": "log"}
    print(json.dumps({"time": round(time.time(), 3), **values, "message": str(line)}), flush=True)


def is_interactive() -> bool:
    """Whether a person reads standard error now: on a terminal, or in a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return sys.stderr.isatty() or hasattr(shell, "kernel")


def inform(line: str) -> None:
    """Log a line at level INFO; print it for a person who has set no handler of logging."""
    LOGGER.info(line)
    if not LOGGER.hasHandlers() and is_interactive():
        to_stderr(line)


@contextmanager
def logged_to_stderr() -> Iterator[None]:
    """Print the lines of the logger "gen2d" to standard error inside the block."""
    handler = logging.Handler()
    handler.emit = lambda record: to_stderr(record.getMessage())
    level, propagate = LOGGER.level, LOGGER.propagate
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.INFO)
    LOGGER.propagate = False
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        LOGGER.setLevel(level)
        LOGGER.propagate = propagate


@contextmanager
def waiting(what: str, log: Log | None = None, status: Callable[[float], str] | None = None) -> Iterator[None]:
    """Log what a block does if it takes more than two seconds, and then its status every ten seconds.

    `status(seconds)` describes the progress after these seconds; by default it is the time elapsed. Also a decorator of
    functions.
    """
    write, start, done = log or inform, time.perf_counter(), threading.Event()

    def speak() -> None:
        if done.wait(PATIENCE):
            return
        write(f"{what} ...")
        while not done.wait(PERIOD):
            seconds = time.perf_counter() - start
            write(status(seconds) if status else f"{what} ... {in_time(seconds)}")

    thread = threading.Thread(target=speak, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@contextmanager
def progress(
    what: str,
    count: int,
    log: Log | None = None,
    unit: str = "videos",
    workers: Callable[[], int] | None = None,
) -> Iterator[Callable[[int], None]]:
    """Progress bar for a person; elsewhere `what` after two seconds, and then one line every ten seconds.

    `workers` gives the present number of workers, if there are any. Yields a function that advances the progress by a
    number of units.
    """
    if is_interactive() and log is not to_json:
        from tqdm import tqdm

        with tqdm(desc=what, total=count, unit=f" {unit}", smoothing=0.1, dynamic_ncols=True) as bar:

            def update(number: int) -> None:
                if workers is not None:
                    bar.set_postfix_str(with_noun(workers(), "worker"), refresh=not number)
                bar.update(number)

            yield update
        return
    done = 0

    def status(seconds: float) -> Event:
        values: dict[str, Any] = {"done": done, "of": count, "unit": unit, "seconds": round(seconds, 3)}
        at_work, head = [], f"{what}: {done:,} of {count:,} {unit}"
        if workers is not None:
            values["workers"] = workers()
            at_work = [with_noun(values["workers"], "worker")]
        if not done:
            return Event.of(", ".join([f"{head} after {in_time(seconds)}", *at_work]), "progress", **values)
        rate, left = done / seconds, (count - done) * seconds / done
        line = ", ".join([head, f"{rate:,.0f} {unit}/s", *at_work, f"{in_time(left)} left"])
        return Event.of(line, "progress", **values, rate=round(rate, 3), seconds_left=round(left, 3))

    def advance(number: int) -> None:
        nonlocal done
        done += number

    with waiting(what, log, status):
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
