"""Upload of a dataset, or of an export, to a repository of the Hugging Face Hub."""

import contextlib
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from gen2d.core.errors import ConfigError, DamagedError, FolderError, UnreachableError, UserError, argument
from gen2d.core.humanize import with_noun
from gen2d.core.progress import Log, inform, is_interactive, waiting
from gen2d.dataset.hub import dataset_metadata, licence_lines
from gen2d.dataset.manifest import read_manifest
from gen2d.dataset.spec import MANIFEST, plan, shard_name
from gen2d.exports.export import DESCRIPTION, read_description
from gen2d.storage.explain import reading_error

CARD = "README.md"
_FRONT = re.compile(r"\A---\n(.*?)^---\n", re.DOTALL | re.MULTILINE)


@dataclasses.dataclass(frozen=True)
class Pushed:
    """Result of an upload."""

    url: str  # of the repository
    files: int  # that the repository now has of the folder
    removed: int  # files of an earlier upload that are no longer part of it
    bytes: int


def push(
    root: str | Path,
    repository: str,
    *,
    private: bool = False,
    licence: str = "",
    branch: str = "main",
    log: Log | None = None,
) -> Pushed:
    """Upload a dataset, or an export, to a dataset repository of the Hugging Face Hub, in one commit.

    The repository is created if it is not there. It then holds the files that the folder's manifest or `export.json`
    names, and its dataset card; of earlier uploads it loses the shards, tables and other files that these replace.
    Files that the Hub has already are not sent again. `datasets.load_dataset(repository)` reads what it holds.

    Parameters
    ----------
    root : str or Path
        Folder of a complete dataset, or of an export.
    repository : str
        Name of the repository, NAME or OWNER/NAME.
    private : bool
        Whether a repository that is created is private.
    licence : str, optional
        Licence in the card, such as "cc-by-4.0". The default is that of the dataset.
    branch : str
        Branch of the repository, which must be there unless it is "main".
    log : callable, optional
        Function that is called with each line of progress.

    Returns
    -------
    Pushed
        URL, and the numbers of files and bytes.

    Raises
    ------
    ConfigError
        If the name of the repository is invalid.
    FolderError, DamagedError
        If the folder is no complete dataset or export, or if files are missing.
    UserError
        If huggingface_hub is not installed, or the Hub refuses the upload, as without a token.
    UnreachableError
        If the Hub does not answer.

    Examples
    --------
    >>> gen2d.push("datasets/bouncing", "me/bouncing", private=True, licence="cc-by-4.0").url
    """
    hub, root, log = _library(), Path(root), log or inform
    names = list(_names(root))
    missing = [name for name in names if not (root / name).is_file()]
    if missing:
        raise DamagedError(f"{root / missing[0]} is missing: verify with {argument('repair', True)}, or export again")
    card = _card(root, licence)
    size = sum((root / name).stat().st_size for name in names)
    api = hub.HfApi(library_name="gen2d")
    try:
        url = api.create_repo(repository, repo_type="dataset", private=private, exist_ok=True)
        there = api.list_repo_files(url.repo_id, repo_type="dataset", revision=branch)
        stale = [name for name in there if _is_ours(name) and name not in {*names, CARD}]
        changes = [hub.CommitOperationAdd(name, str(root / name)) for name in names if name != CARD]
        changes += [hub.CommitOperationAdd(CARD, card.encode()), *map(hub.CommitOperationDelete, stale)]
        with waiting(f"Uploading {with_noun(len(names), 'file')}", log), _bars(hub):
            message = f"{root.resolve().name}, by gen2d"
            api.create_commit(url.repo_id, changes, commit_message=message, repo_type="dataset", revision=branch)
    except hub.errors.HFValidationError:
        raise ConfigError(f"REPO is {repository!r}, but must be NAME or OWNER/NAME of letters, digits, - _ .") from None
    except hub.errors.LocalTokenNotFoundError:
        raise UserError(f"{repository}: the Hub wants a token: run `hf auth login`, or set HF_TOKEN") from None
    except Exception as error:
        raise _translated(repository, error) from error
    return Pushed(str(url), len({*names, CARD}), len(stale), size)


@contextlib.contextmanager
def _bars(hub: ModuleType) -> Iterator[None]:
    """Let the library draw its progress bars for a person only."""
    if is_interactive() or hub.utils.are_progress_bars_disabled():
        yield
        return
    hub.utils.disable_progress_bars()
    try:
        yield
    finally:
        hub.utils.enable_progress_bars()


def _library() -> ModuleType:
    try:
        import huggingface_hub
        import huggingface_hub.errors
        import huggingface_hub.utils
    except ImportError:
        raise UserError("push needs huggingface_hub: pip install 'gen2d[hub]'") from None
    return huggingface_hub


def _names(root: Path) -> Iterator[str]:
    """Names of the folder's files that are uploaded. Raises FolderError if it is no complete dataset or export."""
    description = read_description(root) if (root / DESCRIPTION).is_file() else {}
    if description:
        yield from (DESCRIPTION, *description["files"])
        return
    manifest = read_manifest(root)
    yield from (MANIFEST, CARD, "croissant.json", *manifest.files)
    yield from (table.file for table in manifest.tables.values())
    yield from (shard_name(shard.name) for shard in plan(manifest.splits, manifest.videos_per_shard))


def _card(root: Path, licence: str) -> str:
    """Content of the card, with this licence if one is given."""
    path = root / CARD
    try:
        text = path.read_text(encoding="utf-8") if path.is_file() else f"---\n---\n# {root.resolve().name}\n"
    except (OSError, UnicodeDecodeError) as error:
        raise (
            reading_error(path, error) if isinstance(error, OSError) else FolderError(f"{path} is no text")
        ) from None
    if not _FRONT.match(text):
        text = (dataset_metadata(read_manifest(root)) if (root / MANIFEST).is_file() else "---\n---\n") + text
    if not licence:
        return text
    front = _FRONT.match(text)
    assert front is not None
    kept = [line for line in front[1].splitlines() if not line.startswith(("license:", "license_name:"))]
    return "\n".join(["---", *licence_lines(licence), *kept, "---", text[front.end() :]])


def _is_ours(name: str) -> bool:
    """Whether an upload may have written this file, so that a later one may remove it."""
    return name.startswith(("shards/", "index/", "plugins/")) or bool(
        re.fullmatch(r"([^/]+/)?[A-Za-z0-9._-]+-\d{6,9}\.(parquet|tar|mp4|mkv|npz)", name)
    )


def _translated(repository: str, error: Exception) -> Exception:
    """The error of gen2d, with one sentence, for one of the library."""
    if isinstance(error, RuntimeError) and isinstance(error.__cause__, Exception):  # of one large file
        return _translated(repository, error.__cause__)
    response: Any = getattr(error, "response", None)
    code = getattr(response, "status_code", None)
    if code in (401, 403):
        return UserError(
            f"{repository}: the Hub refuses the upload ({code}): run `hf auth login` with a token that may write there"
        )
    if code == 404:
        return UserError(f"{repository}: the Hub has no such repository, owner or branch")
    if isinstance(error, ValueError) and code is None:  # of the card's metadata, which the Hub checks first
        return UserError(f"{repository}: the Hub refuses the upload ({error})")
    if code is not None and code < 500:
        return UserError(f"{repository}: the Hub refuses the upload ({code}: {error})")
    if code is not None or isinstance(error, OSError) or type(error).__module__.partition(".")[0].startswith("http"):
        return UnreachableError(f"the Hub does not answer ({type(error).__name__}: {error}): try again, and it goes on")
    return error
