"""Jobs for engines without videos: workers that square numbers, and that die, fail or dawdle at chosen ones."""

import os
import pickle
import signal
import time
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

from gen2d.core.errors import ConfigError, FolderError
from gen2d.core.progress import Log
from gen2d.engines.protocol import Report


class Squares:
    """A worker that squares numbers. `faults` maps a number to what it does; once, if the name ends with 'once'."""

    def __init__(self, folder: Path, faults: dict[int, str], seconds: float, group: int) -> None:
        self.folder, self.faults, self.seconds, self.group = folder, faults, seconds, group

    def report(self) -> Report:
        return Report(
            os.environ.get("FAKE_DEVICE", "cpu fake"), identity=os.environ.get("FAKE_IDENTITY", "one"), group=self.group
        )

    def check(self) -> str:
        return ""

    def run(self, items: Sequence[int]) -> list[int]:
        for item in items:
            time.sleep(self.seconds)
            fault = self.faults.get(item, "")
            mark = self.folder / f"{item}"
            if fault and not (fault.endswith("once") and mark.exists()):
                mark.touch()
                _FAULTS[fault.split()[0]]()
        return [item * item for item in items]

    def run_all(self, items: Sequence[int], log: Log) -> list[int]:
        return self.run(items)

    def close(self) -> None:
        (self.folder / f"closed-{os.getpid()}").touch()


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _terminate() -> None:
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(2)


def _raise(error: Exception) -> Any:
    raise error


_FAULTS = {
    "die": _die,
    "terminate": _terminate,
    "config": lambda: _raise(ConfigError("scene.balls is 0, but must be 1 or more")),
    "disk": lambda: _raise(FolderError("the disk is full")),
    "bug": lambda: _raise(ZeroDivisionError("a bug")),
    "dawdle": lambda: time.sleep(60),
}


class Opener:
    """Opens a `Squares`."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __call__(self, device: str, log: Log) -> Squares:
        return Squares(*self.arguments)


class SquareJob:
    """Numbers to square; workers with another identity than the first ones' are refused."""

    title, unit, noun, device = "Squaring", "numbers", "number", "cpu"

    def __init__(
        self, folder: Path, faults: dict[int, str] | None = None, seconds: float = 0.0, group: int = 1
    ) -> None:
        self.open, self.identity = Opener(folder, faults or {}, seconds, group), None

    def size(self, item: Hashable) -> int:
        return 1

    def refusals(self, reports: Sequence[Report]) -> list[str]:
        identities = [report.identity for report in reports]
        self.identity = self.identity or max(sorted(identities), key=identities.count)
        return ["" if own == self.identity else f"it makes {own}, not {self.identity}" for own in identities]


assert pickle.dumps(Opener())
