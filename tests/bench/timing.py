"""Timing of functions, medians, and the first batch of a config, for all sections of the benchmark."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np


def timed(work: Callable[[], Any], count: int, clock: Callable[[], float] = time.process_time) -> Callable[[], float]:
    """A function that runs `work` on `count` items and returns the seconds per item, of CPU time by default."""

    def seconds() -> float:
        began = clock()
        work()
        return (clock() - began) / count

    return seconds


def medians(turns: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Median of each measurement over its turns."""
    return {name: statistics.median(values) for name, values in turns.items()}


def first_batch(rollout: Any) -> Any:
    """Simulated batch of the first videos of the split train, repeated on every device."""
    return rollout.start("train", np.tile(np.arange(rollout.batch_size), len(rollout.devices)))
