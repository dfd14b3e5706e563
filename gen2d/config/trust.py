"""Which code that came with a dataset may run: none, unless this user made it, or has said so.

A dataset keeps copies of the families and looks of its maker's own. Loading, checking, exporting and previewing what is
stored never run them; drawing and simulating again must. The user's list holds the sha256 of every file that this user
has generated with, and of those added by hand, a line each.
"""

import contextlib
import os
import re
import stat
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from gen2d.core.errors import ConfigError, UntrustedError
from gen2d.storage.sealed import open_regular, sha256

_HASH = re.compile(r"[0-9a-f]{64}")
_BYTES = 2**20  # of the list, at most


def list_path() -> Path:
    """Where the user's list lies."""
    home = Path(os.environ.get("XDG_CONFIG_HOME") or "~/.config")
    with contextlib.suppress(RuntimeError):  # a user without a home
        home = home.expanduser()
    return home / "gen2d" / "trusted"


def check_trusted(copies: Mapping[str, bytes], trust: str | Sequence[str], root: object) -> None:
    """Raises UntrustedError for the first of the files (by their place in the dataset) that must not run."""
    said = {trust} if isinstance(trust, str) else set(trust)
    for word in said:
        if not isinstance(word, str) or not _HASH.fullmatch(word):
            raise ConfigError(f"--trust is {word!r}, but must be the sha256 of a file, 64 hexadecimal digits")
    unknown = {place: sha256(content) for place, content in copies.items()}
    known = said | _listed() if unknown.keys() and not set(unknown.values()) <= said else said
    for place, digest in sorted(unknown.items()):
        if digest not in known:
            raise UntrustedError(
                f"{root}/{place} is code that came with the dataset and would have to run: read it, and if you trust "
                f"it say --trust {digest} (in Python trust={digest!r}), or add that line to {list_path()}"
            )


def remember(contents: Iterable[bytes]) -> None:
    """Adds files that this user generates with to the list; where it cannot be written nothing is remembered."""
    try:
        path, known = list_path(), _listed()
        new = sorted({sha256(content) for content in contents} - known)
        if new:
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            day = time.strftime("%Y-%m-%d")
            descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "w") as file:
                file.write("".join(f"{digest}  generated {day}\n" for digest in new))
    except OSError:
        pass


def _listed() -> set[str]:
    """The hashes in the user's list; none where somebody else can write it."""
    try:
        with os.fdopen(open_regular(list_path()), "rb") as file:
            about = os.fstat(file.fileno())
            if about.st_uid != os.getuid() or about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                return set()
            lines = file.read(_BYTES).decode("utf-8", "replace").splitlines()
    except OSError:
        return set()
    return {words[0] for line in lines if (words := line.split()) and _HASH.fullmatch(words[0])}
