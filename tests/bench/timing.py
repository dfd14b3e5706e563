"""Timing of functions for the benchmark."""

import time
from collections.abc import Callable
from typing import Any


def timed(work: Callable[[], Any], count: int, clock: Callable[[], float] = time.process_time) -> Callable[[], float]:
    """A function that runs `work` on `count` items and returns the seconds per item, of CPU time by default."""

    def seconds() -> float:
        began = clock()
        work()
        return (clock() - began) / count

    return seconds
