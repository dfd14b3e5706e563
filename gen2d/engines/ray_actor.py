"""Process of a Ray cluster that has one worker."""

import contextlib
import os
import socket
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gen2d.core.errors import Error
from gen2d.engines.protocol import Report, Worker
from gen2d.storage.leases import try_lock


class Failure(NamedTuple):
    """What a worker answers if a call fails."""

    error: Exception


class Actor:
    """A process of the cluster with one worker. Its calls return a Failure instead of raising."""

    def __init__(self) -> None:
        self.worker: Worker | None = None

    def open(self, job: Any, device: str, cores: int | None, gpus: float) -> tuple[str, str, Report] | Failure:
        """Name of the process, id of its machine, and report of its worker.

        Without a number of cores, it takes the same share of its machine's as of its GPUs.
        """
        import ray

        name, node = f"{socket.gethostname()}:{os.getpid()}", ray.get_runtime_context().get_node_id()
        try:
            if cores is None:
                has = next(each["Resources"] for each in ray.nodes() if each["NodeID"] == node)
                cores = max(1, int(has["CPU"] * gpus / has["GPU"]))
            self.locks = take_cores(cores)
            self.worker = worker = job(device, lambda line: None)
            return name, node, worker.report()
        except Exception as error:
            return _failure(error)

    def check(self) -> str | Failure:
        assert self.worker is not None
        try:
            return self.worker.check()
        except Exception as error:
            return _failure(error)

    def run(self, items: Sequence[Any]) -> list[Any] | Failure:
        assert self.worker is not None
        try:
            return list(self.worker.run(items))
        except Exception as error:
            return _failure(error)

    def close(self) -> None:
        if self.worker is not None:
            self.worker.close()


def _failure(error: Exception) -> Failure:
    """The error, if it is one of ours, or a sentence that says what it is."""
    return Failure(error if isinstance(error, Error) else RuntimeError(f"{type(error).__name__}: {error}"))


def take_cores(count: int) -> list[int]:
    """Restrict this process to this many of its cores, none of which another worker has taken.

    Returns the descriptors of the locks on the cores, which the system frees when the process dies.
    """
    if not hasattr(os, "sched_getaffinity"):
        return []
    allowed, taken, locks = sorted(os.sched_getaffinity(0)), [], []
    folder = Path(tempfile.gettempdir()) / f"gen2d-cores-{os.getuid()}"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        for core in allowed:
            if len(taken) < count < len(allowed):
                lock = os.open(folder / f"{core}", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
                if try_lock(lock):
                    taken.append(core)
                    locks.append(lock)
                else:
                    os.close(lock)
    chosen = taken if len(taken) == count else allowed[:count]
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):  # a thread that has ended
            os.sched_setaffinity(int(thread.name), chosen)
    return locks
