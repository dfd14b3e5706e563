"""Export by several machines: each writes some of the videos into one folder."""

import dataclasses
import functools
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from gen2d._version import __version__
from gen2d.config import plugins
from gen2d.config.contracts import Export
from gen2d.core.errors import ConfigError
from gen2d.core.progress import Log
from gen2d.engines.protocol import Report, other_version
from gen2d.exports.source import source_of
from gen2d.loading.dataset import RenderOptions
from gen2d.storage.paths import Place

PART = 64  # videos that are written together


def load_format(to: str) -> tuple[Export, bytes]:
    """Format with this name, or from this Python file, and the file's content."""
    known, is_file = plugins.names("export"), plugins.is_user_file(to)
    if not is_file and to not in known:
        raise ConfigError(f"--to is {to!r}, but must be one of {', '.join(known)}, or a Python file")
    content = plugins.content_of(to, "--to") if is_file else b""
    return plugins.load("export", to, "--to", content), content


@dataclasses.dataclass(frozen=True)
class ExportTask:
    """What workers export, and to where."""

    root: Place
    split: str
    fields: Sequence[str]
    trust: Sequence[str]
    render: RenderOptions | None
    to: str
    content: bytes  # of the format's file, if it is the user's
    target: Path


class ExportJob:
    """Numbers of the videos to export, in ranges, for an engine."""

    title, unit, noun = "Exporting", "videos", "part"

    def __init__(self, task: ExportTask) -> None:
        self.open = functools.partial(_ExportWorker, task)
        self.device = "cpu" if task.render is None else "auto"

    def size(self, item: range) -> int:
        return len(item)

    def refusals(self, reports: Sequence[Report]) -> list[str]:
        return [other_version(report) for report in reports]


class _ExportWorker:
    """Worker that writes the files of some videos."""

    def __init__(self, task: ExportTask, device: str, log: Log) -> None:
        if device == "cpu":
            os.environ["JAX_PLATFORMS"] = "cpu"
        self.source = source_of(task.root, task.split, task.fields, task.trust, task.render)
        self.format: Export = plugins.load("export", task.to, "--to", task.content)
        self.target = task.target

    def report(self) -> Report:
        return Report("cpu", versions={"gen2d": __version__})

    def check(self) -> str:
        return "" if self.target.is_dir() else f"it does not see {self.target}: name an --out that all machines share"

    def run(self, items: Sequence[range]) -> list[int]:
        for part in items:
            with tempfile.TemporaryDirectory(dir=self.target, prefix=".part-") as folder:
                self.format.write(Path(folder), dataclasses.replace(self.source, part=part))
                for path in Path(folder).iterdir():  # whole files only, as another worker may write the same
                    path.replace(self.target / path.name)
        return [len(part) for part in items]

    def run_all(self, items: Sequence[range], log: Log) -> list[int]:
        return self.run(items)

    def close(self) -> None:
        """Nothing is open."""
