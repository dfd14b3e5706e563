"""Trust in the code that comes with a dataset: it runs only if this user generated with it or declared it trusted.

A dataset keeps copies of its author's plug-in files. Loading, verifying, exporting and previewing stored data never run
them; rendering and simulating again do. The user's list of trusted files holds one sha256 per line: those of all files
that this user has generated with, and those added by hand.
"""

import contextlib
import os
import re
import stat
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from gen2d.core.errors import ConfigError, UntrustedError, argument
from gen2d.storage.sealed import open_regular, sha256

_HASH = re.compile(r"[0-9a-f]{64}")
_MAX_BYTES = 2**20  # read from the list, at most


def list_path() -> Path:
    """Path of the user's list of trusted files."""
    home = Path(os.environ.get("XDG_CONFIG_HOME") or "~/.config")
    with contextlib.suppress(RuntimeError):  # a user without a home folder
        home = home.expanduser()
    return home / "gen2d" / "trusted"


def check_trusted(copies: Mapping[str, bytes], trust: str | Sequence[str], root: object) -> None:
    """Raise UntrustedError for the first file, by its path in the dataset, that is not trusted.

    copies: contents by path. trust: one or more sha256 given by the user; ConfigError is raised if one is malformed.
    """
    trusted = {trust} if isinstance(trust, str) else set(trust)
    for entry in trusted:
        if not isinstance(entry, str) or not _HASH.fullmatch(entry):
            raise ConfigError(
                f"{argument('trust')} is {entry!r}, but must be the sha256 of a file, 64 hexadecimal digits"
            )
    digests = {path: sha256(content) for path, content in copies.items()}
    allowed = trusted | _read_list() if digests.keys() and not set(digests.values()) <= trusted else trusted
    for path, digest in sorted(digests.items()):
        if digest not in allowed:
            raise UntrustedError(
                f"{root}/{path} is code that came with the dataset and would have to run: read it, and if you trust "
                f"it say {argument('trust', digest)}, or add that line to {list_path()}"
            )


def remember(contents: Iterable[bytes]) -> None:
    """Add files that this user generates with to the list; do nothing if the list cannot be written."""
    try:
        path, known = list_path(), _read_list()
        new = sorted({sha256(content) for content in contents} - known)
        if new:
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            day = time.strftime("%Y-%m-%d")
            descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "w") as file:
                file.write("".join(f"{digest}  generated {day}\n" for digest in new))
    except OSError:
        pass


def _read_list() -> set[str]:
    """Hashes in the user's list; none if another user owns it or can write to it."""
    try:
        with os.fdopen(open_regular(list_path()), "rb") as file:
            status = os.fstat(file.fileno())
            if status.st_uid != os.getuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                return set()
            lines = file.read(_MAX_BYTES).decode("utf-8", "replace").splitlines()
    except OSError:
        return set()
    return {words[0] for line in lines if (words := line.split()) and _HASH.fullmatch(words[0])}
