"""Engine that runs a job in this process, on all its devices."""

import dataclasses
import os
from collections.abc import Iterator
from typing import Any

from gen2d.core.progress import Log
from gen2d.engines.protocol import Done, EngineError, Job


@dataclasses.dataclass(frozen=True)
class Local:
    """The calling process as the only worker, on all its devices: the default engine."""

    def start(self, job: Job, log: Log) -> "LocalWorkers":
        """The worker in this process, when its programs are traced."""
        return LocalWorkers(job, log)


class LocalWorkers:
    """The only worker; it runs all items at once."""

    def __init__(self, job: Job, log: Log) -> None:
        self.worker, self.items, self.log = job.open(job.device, log), [], log
        for refusal in job.refusals([self.worker.report()]):
            if refusal:
                raise EngineError(refusal)

    def submit(self, item: Any) -> None:
        self.items.append(item)

    def done(self) -> Iterator[Done]:
        results = self.worker.run_all(self.items, self.log)
        name = f"{os.uname().nodename}:{os.getpid()}"
        for item, result in zip(self.items, results, strict=True):
            yield Done(item, result, name)

    def stop(self) -> None:
        self.worker.close()
