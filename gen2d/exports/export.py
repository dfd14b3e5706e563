"""Export of one split of a dataset to another format, written completely or not at all."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gen2d.config import plugins
from gen2d.config.contracts import Export
from gen2d.core.errors import ConfigError, FolderError
from gen2d.core.progress import inform, progress, stopping_on_sigterm
from gen2d.engines.protocol import Engine, results
from gen2d.exports.parts import PART, ExportJob, ExportTask, load_format
from gen2d.exports.source import Source, source_of
from gen2d.loading.dataset import RenderOptions
from gen2d.storage.atomic import publishing, publishing_folder, remove_tree, sweep_beside
from gen2d.storage.explain import writing_error
from gen2d.storage.paths import Place, Url, place
from gen2d.storage.retries import Network
from gen2d.storage.sealed import JSON_BYTES, as_json, parse_json, read_bytes

SCHEMA = "gen2d.export/1"
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
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> Exported:
    """Export one split of a complete dataset to another format.

    The output appears when it is complete. Frames that are not stored are rendered, which imports jax.

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
    description = _export_description(source, name)
    format_.check(source)
    _check_out(out, format_, description, overwrite)
    log = log or inform
    if engine is not None and not format_.separate:
        names = ", ".join(each for each in plugins.names("export") if plugins.load("export", each).separate)
        raise ConfigError(f"--to is {to}, whose files hold many videos: leave out --engine, or choose one of {names}")

    def write(target: Path) -> None:
        if engine is not None:
            there = folder.absolute() if isinstance(folder, Path) else folder
            fields = tuple(source.fields)
            options = source.ds.options.split, fields, trust, render, to, content
            job = ExportJob(ExportTask(there, *options, target.absolute()))
            parts = [source.numbers[first : first + PART] for first in range(0, len(source), PART)]
            for _ in results(engine, job, parts, log):
                pass
            return
        with stopping_on_sigterm(log), progress("Exporting", len(source), log) as advance:
            format_.write(target, dataclasses.replace(source, advance=advance))

    with _translate_errors(out):
        size = _write_output(out, format_, write, description)
    return Exported(out, len(source), size, time.perf_counter() - start, format_.loss)


def _patterns(to: str, format_: Export, fields: Sequence[str] | None) -> Sequence[str]:
    fields = [fields] if isinstance(fields, str) else fields
    if fields is None or list(fields) == list(format_.fields):
        return format_.fields
    if format_.fixed:
        free = [name for name in plugins.names("export") if not plugins.load("export", name).fixed]
        raise ConfigError(f"--fields is {' '.join(fields)}, but {to} has its own: choose {' or '.join(free)}")
    if not fields:
        raise ConfigError("--fields is empty, but must name one field or more")
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
    origin = {key: manifest.plain[key] for key in keys} | {"split": source.ds.options.split, "sizes": source.ds.sizes}
    fields = {name: dataclasses.asdict(field) for name, field in source.fields.items()}
    return origin | {"schema": SCHEMA, "format": to, "fields": fields, "videos": len(source)}


# ---- Output


def _check_out(out: Path, format_: Export, description: Mapping[str, Any], overwrite: bool) -> None:
    """Raise FolderError if `out` holds something that must not be replaced."""
    with _translate_errors(out):
        if not out.exists():
            return
        if out.is_dir() == bool(format_.suffix):
            kinds = ("folder", "file") if out.is_dir() else ("file", "folder")
            name = description["format"]
            raise FolderError(f"{out} is a {kinds[0]}, but {name} makes a {kinds[1]}: choose another --out")
        if out.is_dir():
            _check_folder(out, description, overwrite)
        elif not overwrite:
            raise FolderError(f"{out} is there already: choose another --out, or --overwrite to replace it")


def _check_folder(out: Path, description: Mapping[str, Any], overwrite: bool) -> None:
    previous = _read_description(out)
    known = {DESCRIPTION, *(name.split("/")[0] for name in previous["files"])} if previous else set()
    foreign = {path.name for path in out.iterdir()} - known
    if foreign:
        raise FolderError(f"{out} holds {min(foreign)}, which no export made: choose another --out")
    if not known:
        return  # an empty folder
    same = all(previous.get(key) == description[key] for key in ("format", "split", "name", "seed", "config_sha256"))
    if not same and not overwrite:
        raise FolderError(f"{out} holds another export: choose another --out, or --overwrite to replace it")


def _read_description(out: Path) -> dict[str, Any]:
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
        for path in temporary.glob(".part-*"):  # of workers that were killed
            remove_tree(path)
        paths = sorted(path for path in temporary.rglob("*") if path.is_file())
        files = {path.relative_to(temporary).as_posix(): path.stat().st_size for path in paths}
        (temporary / DESCRIPTION).write_bytes(as_json({**description, "files": files}))
    return sum(files.values())


@contextlib.contextmanager
def _translate_errors(out: Path) -> Generator[None]:
    """Context that turns an OSError into a UserError with one sentence."""
    try:
        yield
    except OSError as error:
        raise writing_error(out, error) from None
