"""Export of one split of a dataset to another format, written completely or not at all.

Formats whose files belong to parts of the videos are written part by part into a folder beside the output, and an
export that was killed goes on with the parts that are missing.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gen2d._version import __version__
from gen2d.config import plugins
from gen2d.config.contracts import Export
from gen2d.core.errors import ConfigError, FolderError, argument
from gen2d.core.progress import inform, progress, stopping_on_sigterm
from gen2d.engines.protocol import Engine, results
from gen2d.exports.partial import PartialExport
from gen2d.exports.parts import ExportJob, ExportTask, load_format, write_part
from gen2d.exports.source import Source, source_of
from gen2d.loading.dataset import RenderOptions
from gen2d.loading.selection import matching
from gen2d.media import films
from gen2d.storage.atomic import publishing, publishing_folder, replace_folder, sweep_beside
from gen2d.storage.explain import writing_error
from gen2d.storage.paths import Place, Url, place
from gen2d.storage.retries import Network
from gen2d.storage.sealed import JSON_BYTES, as_json, parse_json, read_bytes, sha256

SCHEMA = "gen2d.export/1"
MOST_JOBS = 256
DESCRIPTION = "export.json"  # in every exported folder: its origin, and the files that belong to it


@dataclasses.dataclass(frozen=True)
class Exported:
    """Result of an export."""

    out: Path  # a folder, or a file for formats of one file
    videos: int
    bytes: int
    seconds: float
    loss: str  # what the format does not preserve; "" if it preserves everything


def export(
    root: str | Place,
    to: str,
    out: str | Path | None = None,
    *,
    split: str | None = None,
    fields: Sequence[str] | None = None,
    overwrite: bool = False,
    log: Callable[[str], None] | None = None,
    trust: Sequence[str] = (),
    engine: Engine | None = None,
    render: RenderOptions | None = None,
    select: str | None = None,
    codec: str | None = None,
    jobs: int | None = None,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> Exported:
    """Export one split of a complete dataset to another format.

    The output appears when it is complete. Frames that are not stored are rendered, which imports jax. An export that
    was stopped goes on where it was when it is started again, in formats that have files for each video.

    Parameters
    ----------
    root : str or Path
        Folder or URL of the dataset.
    to : str
        Name of a format, such as "mp4", "npz" or "webdataset", or path of a Python file that ends with an `EXPORT`
        (`gen2d.plugin.Export`).
    out : str or Path, optional
        Folder to write, or the file for formats of one file, such as phyworld. The default is ROOT-FORMAT beside the
        dataset, and in the current folder if the dataset is at a URL.
    split : str, optional
        Name of the split. The default is "train", or the only split.
    fields : sequence of str, optional
        Names or patterns of fields, only for formats that can hold any field, such as npz and webdataset. The default
        is all fields.
    overwrite : bool
        Whether an existing file, or an export of another dataset, is replaced. A folder with an earlier export of the
        same dataset is replaced in any case, and a folder with other files never.
    log : callable, optional
        Function that is called with each line of progress.
    trust : sequence of str
        sha256 of code that came with the dataset and may run to render frames, as in `gen2d.render`.
    engine : gen2d.engines.Ray, optional
        Where the videos are written, in formats that have files for each video; by default in this process. All
        machines must see the dataset and the folder of `out`.
    render : RenderOptions, optional
        Size, look and other options of the frames, such as `{"height": 256, "width": 256}`, as in `open`.
    select : str, optional
        Conditions on the values of the videos to export, such as "factors/balls > 3 and factors/gravity[1] < -5". By
        default all videos of the split are exported.
    codec : str, optional
        Encoding of the frames, in formats that have several, such as "ffv1" for lossless films in "webdataset".
    jobs : int, optional
        Number of threads that encode videos; by default one for each core, but at most 8.
    timeout : float
        Maximum time, in s, to wait for a server to connect or to send the next part of an answer.
    deadline : float
        Maximum time, in s, of a request with all its attempts. Large downloads may take longer.

    Returns
    -------
    Exported
        Path, number of videos, bytes, seconds, and what the format does not preserve.

    Raises
    ------
    ConfigError
        If an argument is invalid, or if the format cannot hold these videos.
    FolderError
        If the dataset cannot be read, or if `out` cannot be written or must not be replaced.
    UntrustedError
        If code that came with the dataset would have to run, but is not in `trust`.
    UserError
        If the format needs a package that is not installed.
    DamagedError, UnreachableError
        If stored data is damaged, or if a disk or server does not answer.

    Examples
    --------
    >>> exported = gen2d.export("datasets/bouncing", "h264", "films", split="train")
    >>> print(exported.videos, exported.bytes, exported.loss)
    """
    start, name = time.perf_counter(), Path(to).name
    format_, content = load_format(to)
    folder = place(root, Network(timeout, deadline))
    source = source_of(folder, split, _patterns(to, format_, fields), trust, render)
    out = Path(out) if out is not None else _default_out(folder, f"{name.removesuffix('.py')}{format_.suffix}")
    source = dataclasses.replace(source, codec=_codec(to, format_, codec), jobs=_jobs(jobs))
    if select is not None:
        source = dataclasses.replace(source, selection=_selection(source, select))
    description = _export_description(source, name) | ({"select": select} if select else {})
    format_.check(source)
    _check_out(out, format_, description, overwrite)
    log = log or inform
    if engine is not None and not format_.separate:
        names = ", ".join(each for each in plugins.names("export") if plugins.load("export", each).separate)
        raise ConfigError(
            f"{argument('to')} is {to}, whose files hold many videos: leave out "
            f"{argument('engine')}, or choose one of {names}"
        )

    def write(target: Path) -> None:
        with stopping_on_sigterm(log), progress("Exporting", len(source), log) as advance:
            format_.write(target, dataclasses.replace(source, advance=advance))

    def write_parts(staging: PartialExport) -> None:
        size, count = format_.part_videos(source), len(source)
        parts = [range(first, min(first + size, count)) for first in range(0, count, size)]
        todo = [part for part in parts if part.start not in staging.done]
        left = sum(map(len, todo))
        if len(todo) < len(parts):
            log(f"{count - left:,} of {count:,} videos are written already")
        if engine is not None:
            there = folder.absolute() if isinstance(folder, Path) else folder
            options = source.ds.options.split, tuple(source.fields), trust, render, to, content
            more = source.selection, source.codec, source.jobs
            job = ExportJob(ExportTask(there, *options, staging.files.absolute(), *more))
            for done in results(engine, job, todo, log):
                staging.add(done.item.start)
        else:
            with stopping_on_sigterm(log), progress("Exporting", left, log) as advance:
                for part in todo:
                    write_part(format_, dataclasses.replace(source, part=part, advance=advance), staging.files)
                    staging.add(part.start)
        format_.finish(staging.files, dataclasses.replace(source, notes=staging.notes))

    with _translate_errors(out):
        if format_.separate:
            size = _write_staged(out, write_parts, description, [[*source.numbers], source.codec, sha256(content)])
        else:
            size = _write_output(out, format_, write, description)
    return Exported(out, len(source), size, time.perf_counter() - start, _loss(format_, source.codec))


def _selection(source: Source, select: str) -> np.ndarray:
    """Numbers of the videos that are selected; raises ConfigError if there are none."""
    numbers = matching(source.ds, select, argument("select"))
    if not len(numbers):
        split = source.ds.options.split
        raise ConfigError(f"{argument('select')} is {select!r}, but no video of the split {split} is like that")
    return numbers


def _codec(to: str, format_: Export, codec: str | None) -> str:
    """The codec that is chosen, or the format's default; "" if the format has one only."""
    if codec is None:
        return format_.codecs[0] if format_.codecs else ""
    if not format_.codecs:
        several = [name for name in plugins.names("export") if plugins.load("export", name).codecs]
        raise ConfigError(
            f"{argument('codec')} is {codec!r}, but {to} has one encoding only: choose {' or '.join(several)}"
        )
    if codec not in format_.codecs:
        raise ConfigError(f"{argument('codec')} is {codec!r}, but must be one of {', '.join(format_.codecs)} for {to}")
    return codec


def _jobs(jobs: int | None) -> int:
    if jobs is not None and not 1 <= jobs <= MOST_JOBS:
        raise ConfigError(f"{argument('jobs')} is {jobs}, but must be from 1 to {MOST_JOBS}")
    return jobs or 0


def _loss(format_: Export, codec: str) -> str:
    """What the format and its codec do not preserve."""
    losses = [films.CODECS[codec].loss] if codec in films.CODECS else []
    return "; ".join(filter(None, [*losses, format_.loss]))


def _patterns(to: str, format_: Export, fields: Sequence[str] | None) -> Sequence[str]:
    fields = [fields] if isinstance(fields, str) else fields
    if fields is None or list(fields) == list(format_.fields):
        return format_.fields
    if format_.fixed:
        free = [name for name in plugins.names("export") if not plugins.load("export", name).fixed]
        raise ConfigError(
            f"{argument('fields')} is {' '.join(fields)}, but {to} has its own: choose {' or '.join(free)}"
        )
    if not fields:
        raise ConfigError(f"{argument('fields')} is empty, but must name one field or more")
    return fields


def _default_out(root: Place, ending: str) -> Path:
    if isinstance(root, Url):
        return Path(f"{root.name}-{ending}")
    root = root.resolve() if not root.name else root
    return root.with_name(f"{root.name}-{ending}")


def _export_description(source: Source, to: str) -> dict[str, Any]:
    """Contents of a folder's export.json, without the list of files."""
    manifest = source.ds.manifest
    keys = ("name", "seed", "fps", "conventions", "licence", "manifest_sha256", "config_sha256")
    origin = {key: manifest.plain[key] for key in keys} | {"split": source.ds.options.split, "sizes": source.sizes}
    fields = {name: dataclasses.asdict(field) for name, field in source.fields.items()}
    return origin | {"schema": SCHEMA, "format": to, "fields": fields, "videos": len(source)}


# ---- Output


def _check_out(out: Path, format_: Export, description: Mapping[str, Any], overwrite: bool) -> None:
    """Raise FolderError if `out` holds something that must not be replaced."""
    with _translate_errors(out):
        if Path.cwd().is_relative_to(out.resolve()):
            raise FolderError(f"{out} is the current folder, or holds it: choose another {argument('out')}")
        if not out.exists():
            return
        if out.is_dir() == bool(format_.suffix):
            kinds = ("folder", "file") if out.is_dir() else ("file", "folder")
            name = description["format"]
            raise FolderError(f"{out} is a {kinds[0]}, but {name} makes a {kinds[1]}: choose another {argument('out')}")
        if out.is_dir():
            _check_folder(out, description, overwrite)
        elif not overwrite:
            raise FolderError(
                f"{out} is there already: choose another {argument('out')}, or "
                f"{argument('overwrite', True)} to replace it"
            )


def _check_folder(out: Path, description: Mapping[str, Any], overwrite: bool) -> None:
    previous = read_description(out)
    known = {DESCRIPTION, *(name.split("/")[0] for name in previous["files"])} if previous else set()
    foreign = {path.name for path in out.iterdir()} - known
    if foreign:
        raise FolderError(f"{out} holds {min(foreign)}, which no export made: choose another {argument('out')}")
    if not known:
        return  # an empty folder
    keys = "format", "split", "name", "seed", "config_sha256", "select"
    same = all(previous.get(key) == description.get(key) for key in keys)
    if not same and not overwrite:
        raise FolderError(
            f"{out} holds another export: choose another {argument('out')}, or "
            f"{argument('overwrite', True)} to replace it"
        )


def read_description(out: Path) -> dict[str, Any]:
    """Contents of the folder's export.json; empty if there is no valid one."""
    try:
        description = parse_json(read_bytes(out / DESCRIPTION, JSON_BYTES)) or {}
    except FileNotFoundError:
        return {}
    return description if description.get("schema") == SCHEMA and isinstance(description.get("files"), dict) else {}


def _write_output(out: Path, format_: Export, write: Callable[[Path], None], description: Mapping[str, Any]) -> int:
    """Write `out` completely and return its size in bytes; also remove temporary files of killed exports."""
    out.parent.mkdir(parents=True, exist_ok=True)
    sweep_beside(out)
    if format_.suffix:
        with publishing(out) as temporary:
            write(temporary)
        return out.stat().st_size
    with publishing_folder(out) as temporary:
        write(temporary)
        size = _describe(temporary, description)
    return size


def _write_staged(
    out: Path, write: Callable[[PartialExport], None], description: Mapping[str, Any], choices: list[Any]
) -> int:
    """Write `out` part by part and return its size in bytes; go on with what a stopped export of the same has left.

    `choices` are what decides the files beside the description.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    sweep_beside(out)
    identity = sha256(as_json([dict(description), choices, __version__]))
    with PartialExport(out, identity) as staging:
        write(staging)
        size = _describe(staging.files, description)
        replace_folder(out, staging.files)
        staging.remove()
    return size


def _describe(folder: Path, description: Mapping[str, Any]) -> int:
    """Write export.json and return the bytes of the other files."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / DESCRIPTION)
    files = {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}
    (folder / DESCRIPTION).write_bytes(as_json({**description, "files": files}))
    return sum(files.values())


@contextlib.contextmanager
def _translate_errors(out: Path) -> Generator[None]:
    """Context that turns an OSError into a UserError with one sentence."""
    try:
        yield
    except OSError as error:
        raise writing_error(out, error) from None
