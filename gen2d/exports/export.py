"""Datasets for other programs: `export` writes one split in a format of `exports/`, whole or not at all."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gen2d.config import plugins
from gen2d.config.contracts import Export
from gen2d.core.errors import ConfigError, FolderError
from gen2d.core.progress import progress, stopping_on_sigterm
from gen2d.exports.source import Source, source_of
from gen2d.storage.atomic import publishing, publishing_folder, sweep_beside
from gen2d.storage.explain import writing_error
from gen2d.storage.paths import Network, Place, Url, place
from gen2d.storage.sealed import JSON_BYTES, as_json, parsed, read_bytes

SCHEMA = "gen2d.export/1"
ABOUT = "export.json"  # in every folder that is made: what it is, and which files belong to it


@dataclasses.dataclass(frozen=True)
class Exported:
    """What an export made."""

    out: Path  # a folder, or for phyworld a file
    videos: int
    bytes: int
    seconds: float
    loss: str  # what the format does not keep; "" if it is exact


def export(
    root: str | Place,
    to: str,
    out: str | Path | None = None,
    *,
    split: str | None = None,
    fields: Sequence[str] | None = None,
    overwrite: bool = False,
    say: Callable[[str], None] | None = None,
    trust: Sequence[str] = (),
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> Exported:
    """The export of a split of a complete dataset in another format.

    `to` names the format, or a Python file that declares one (`gen2d.plugin.Export`). `out` is the folder (for
    phyworld the file) that is made, ROOT-FORMAT by default; it appears when it is whole. An earlier export of the same
    dataset is replaced, another one only with `overwrite`. `split` may be left out as in `open`. `fields` are names or
    patterns, for formats that can hold any, such as npz and webdataset (default: all). Frames that are not stored are
    drawn. `say` takes lines for a person; `trust` is that of `render`, `timeout` and `deadline` are those of `open`.
    Raises ConfigError, FolderError and UntrustedError (UserErrors) with one sentence, DamagedError, UnreachableError.
    """
    began, form, name = time.perf_counter(), _format(to), Path(to).name
    where = place(root, Network(timeout, deadline))
    source = source_of(where, split, _patterns(to, form, fields), trust)
    out = Path(out) if out is not None else _beside(where, f"{name.removesuffix('.py')}{form.suffix}")
    about = _about(source, name)
    form.check(source)
    _check_out(out, form, about, overwrite)
    say = say or (lambda line: None)
    with _explained(out), stopping_on_sigterm(say), progress(len(source), say) as advance:
        size = _written(out, form, dataclasses.replace(source, advance=advance), about)
    return Exported(out, len(source), size, time.perf_counter() - began, form.loss)


def _format(to: str) -> Export:
    """The format of a name, or of a Python file of the user's own."""
    if plugins.is_own(to):
        return plugins.load("export", to, "--to", plugins.content_of(to, "--to"))
    known = plugins.names("export")
    if to not in known:
        raise ConfigError(f"--to is {to!r}, but must be one of {', '.join(known)}, or a Python file")
    return plugins.load("export", to, "--to")


def _patterns(to: str, form: Export, fields: Sequence[str] | None) -> Sequence[str]:
    fields = [fields] if isinstance(fields, str) else fields
    if fields is None or list(fields) == list(form.fields):
        return form.fields
    if form.fixed:
        free = [name for name in plugins.names("export") if not plugins.load("export", name).fixed]
        raise ConfigError(f"--fields is {' '.join(fields)}, but {to} has its own: choose {' or '.join(free)}")
    if not fields:
        raise ConfigError("--fields is empty, but must name one field or more")
    return fields


def _beside(root: Place, ending: str) -> Path:
    if isinstance(root, Url):
        return Path(f"{root.name}-{ending}")
    root = root.resolve() if not root.name else root
    return root.with_name(f"{root.name}-{ending}")


def _about(source: Source, to: str) -> dict[str, Any]:
    """What a folder's export.json says, but for its files."""
    manifest = source.ds.manifest
    shown = ("name", "seed", "fps", "sizes", "conventions", "licence", "manifest_sha256", "config_sha256")
    about = {key: manifest.plain[key] for key in shown} | {
        "schema": SCHEMA,
        "format": to,
        "split": source.ds.options.split,
    }
    fields = {name: dataclasses.asdict(field) for name, field in source.fields.items()}
    return about | {"fields": fields, "videos": len(source)}


# ---- Where it goes


def _check_out(out: Path, form: Export, about: Mapping[str, Any], overwrite: bool) -> None:
    """Returns nothing; raises FolderError where `out` holds what must stay."""
    with _explained(out):
        if not out.exists():
            return
        if out.is_dir() == bool(form.suffix):
            kinds = ("folder", "file") if out.is_dir() else ("file", "folder")
            raise FolderError(f"{out} is a {kinds[0]}, but {about['format']} makes a {kinds[1]}: choose another --out")
        if out.is_dir():
            _check_folder(out, about, overwrite)
        elif not overwrite:
            raise FolderError(f"{out} is there already: choose another --out, or --overwrite to replace it")


def _check_folder(out: Path, about: Mapping[str, Any], overwrite: bool) -> None:
    there = _described(out)
    own = {ABOUT, *there["files"]} if there else set()
    foreign = {path.name for path in out.iterdir()} - own
    if foreign:
        raise FolderError(f"{out} holds {min(foreign)}, which no export made: choose another --out")
    if not own:
        return  # an empty folder
    same = all(there.get(key) == about[key] for key in ("format", "split", "name", "seed", "config_sha256"))
    if not same and not overwrite:
        raise FolderError(f"{out} holds another export: choose another --out, or --overwrite to replace it")


def _described(out: Path) -> dict[str, Any]:
    """What the folder's export.json says; nothing if no export made it."""
    try:
        there = parsed(read_bytes(out / ABOUT, JSON_BYTES)) or {}
    except FileNotFoundError:
        return {}
    return there if there.get("schema") == SCHEMA and isinstance(there.get("files"), dict) else {}


def _written(out: Path, form: Export, source: Source, about: Mapping[str, Any]) -> int:
    """The bytes written; afterwards `out` is there, whole, and what a killed export left beside it is not."""
    out.parent.mkdir(parents=True, exist_ok=True)
    sweep_beside(out)
    if form.suffix:
        with publishing(out) as temporary:
            form.write(temporary, source)
        return out.stat().st_size
    with publishing_folder(out) as temporary:
        form.write(temporary, source)
        files = {path.name: path.stat().st_size for path in sorted(temporary.iterdir())}
        (temporary / ABOUT).write_bytes(as_json({**about, "files": files}))
    return sum(files.values())


@contextlib.contextmanager
def _explained(out: Path) -> Iterator[None]:
    """A block whose OSError becomes one sentence."""
    try:
        yield
    except OSError as error:
        raise writing_error(out, error) from None
