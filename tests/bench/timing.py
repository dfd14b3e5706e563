"""Work that tells how long it took, for the benchmark."""

import time
from collections.abc import Callable
from typing import Any


def timed(work: Callable[[], Any], count: int, clock: Callable[[], float] = time.process_time) -> Callable[[], float]:
    """What does the work and returns the seconds for each of `count` things that it makes; of CPU time, unless told
    otherwise."""

    def seconds() -> float:
        began = clock()
        work()
        return (clock() - began) / count

    return seconds
