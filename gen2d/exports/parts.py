"""Export by several machines: each writes some of the videos into one folder."""

import dataclasses
import functools
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gen2d._version import __version__
from gen2d.config import plugins
from gen2d.config.contracts import Export
from gen2d.core.errors import ConfigError, argument
from gen2d.core.progress import Log
from gen2d.engines.protocol import Report, other_version
from gen2d.exports.partial import NOTES
from gen2d.exports.source import Source, source_of
from gen2d.loading.dataset import RenderOptions
from gen2d.storage.paths import Place


def load_format(to: str) -> tuple[Export, bytes]:
    """Format with this name, or from this Python file, and the file's content."""
    known, is_file = plugins.names("export"), plugins.is_user_file(to)
    if not is_file and to not in known:
        raise ConfigError(f"{argument('to')} is {to!r}, but must be one of {', '.join(known)}, or a Python file")
    content = plugins.content_of(to, argument("to")) if is_file else b""
    return plugins.load("export", to, argument("to"), content), content


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
    selection: np.ndarray | None = None
    codec: str = ""
    jobs: int = 0


def write_part(format_: Export, source: Source, target: Path) -> None:
    """Write the files of a part of the videos into the folder, and its notes beside it, each whole or not at all."""
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".part-") as folder:
        files, notes = Path(folder, "files"), Path(folder, NOTES)
        files.mkdir()
        notes.mkdir()
        format_.write(files, dataclasses.replace(source, notes=notes))
        for own, others in ((files, target), (notes, target.parent / NOTES)):
            for path in sorted(own.rglob("*")):  # whole files only, as another worker may write the same
                to = others / path.relative_to(own)
                if path.is_dir():
                    to.mkdir(exist_ok=True)
                else:
                    path.replace(to)


class ExportJob:
    """Places of the videos to export among those that are selected, in ranges, for an engine."""

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
        source = source_of(task.root, task.split, task.fields, task.trust, task.render)
        self.source = dataclasses.replace(source, selection=task.selection, codec=task.codec, jobs=task.jobs)
        self.format: Export = plugins.load("export", task.to, "--to", task.content)
        self.target = task.target

    def report(self) -> Report:
        return Report("cpu", versions={"gen2d": __version__})

    def check(self) -> str:
        return (
            ""
            if self.target.is_dir()
            else f"it does not see {self.target}: name an {argument('out')} that all machines share"
        )

    def run(self, items: Sequence[range]) -> list[int]:
        for part in items:
            write_part(self.format, dataclasses.replace(self.source, part=part), self.target)
        return [len(part) for part in items]

    def run_all(self, items: Sequence[range], log: Log) -> list[int]:
        return self.run(items)

    def close(self) -> None:
        """Nothing is open."""
