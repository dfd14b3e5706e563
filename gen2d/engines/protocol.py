"""What an engine, its workers and a job promise each other.

    workers = engine.start(job, log)     processes that have opened the job; they report before they get work
    workers.submit(item)                 for each item, such as a shard
    workers.done()                       each item with its result, once, in any order
    workers.stop()                       close or kill the workers

An item may be run more than once, on several workers at the same time: running it twice must be the same as once. An
engine knows nothing of videos: a job says what an item is and which workers may run it.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from gen2d._version import __version__
from gen2d.core.errors import UserError
from gen2d.core.progress import Log


class EngineError(UserError):
    """An engine that cannot start, or that cannot finish its items."""


class HeadLostError(EngineError):
    """A cluster whose head is gone. Its library is left as it was, and may crash when the process ends."""


@dataclasses.dataclass(frozen=True)
class Report:
    """What a worker says of itself before it gets work."""

    device: str  # kind, such as "cpu avx512f GenuineIntel"
    hardware: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # for logs
    versions: Mapping[str, str] = dataclasses.field(default_factory=dict)  # of gen2d and the libraries
    identity: Any = None  # workers with equal identities give equal results
    group: int = 1  # number of items that keep all its devices busy
    details: Any = None  # of the job's own


class Done(NamedTuple):
    """An item with its result and the name of the worker that ran it."""

    item: Any
    result: Any
    worker: str


class Worker(Protocol):
    """A job that is opened in a process: it keeps compiled programs, open files and the like."""

    def report(self) -> Report:
        """What the worker can do; asked first, and once."""
        ...

    def check(self) -> str:
        """Why the worker cannot work, in a sentence, or ""; asked after all else is ready, before its first items."""
        ...

    def run(self, items: Sequence[Any], /) -> Sequence[Any]:
        """The result of each item; an engine may call it from two threads at once, to keep the devices busy."""
        ...

    def run_all(self, items: Sequence[Any], log: Log, /) -> Sequence[Any]:
        """The result of each item, when this is the only worker; shows the progress."""
        ...

    def close(self) -> None:
        """Close what is open."""
        ...


class Job(Protocol):
    """Work to be divided; it stays with the driver, only `open` and the items travel."""

    device: str  # that is asked for: "auto", "cpu" or "gpu"
    title: str  # of the progress, such as "Generating"
    unit: str  # of `size`, such as "videos"
    noun: str  # for an item, such as "shard"

    @property
    def open(self) -> Callable[[str, Log], Worker]:
        """Function that opens a worker on a device; it is pickled."""
        ...

    def size(self, item: Any, /) -> int:
        """Number of units in an item."""
        ...

    def refusals(self, reports: Sequence[Report]) -> list[str]:
        """Why each of these workers cannot take part, in a sentence, or "".

        The first call chooses what all workers must agree on.
        """
        ...


class Workers(Protocol):
    """Started workers, fed by an engine."""

    def submit(self, item: Any) -> None:
        """Add an item to those that are to be run."""
        ...

    def done(self) -> Iterator[Done]:
        """Run all submitted items; yield each when it is done. Raises the error that ends the run."""
        ...

    def stop(self) -> None:
        """Close the workers; kill those that are still busy."""
        ...


class Engine(Protocol):
    """A place where jobs run."""

    def start(self, job: Job, log: Log) -> Workers:
        """Workers that are ready to run the job's items. Raises EngineError."""
        ...


def results(engine: Engine, job: Job, items: Sequence[Any], log: Log) -> Iterator[Done]:
    """Each item with its result, from workers that start with the first and stop after the last."""
    workers = engine.start(job, log)
    try:
        for item in items:
            workers.submit(item)
        yield from workers.done()
    finally:
        workers.stop()


def other_version(report: Report) -> str:
    """Why a worker of another version of gen2d cannot take part, in a sentence, or ""."""
    version = report.versions.get("gen2d")
    return "" if version == __version__ else f"it has gen2d {version}, but here is {__version__}"
