"""A folder that keeps files of remote datasets, each under its sha256, with a limit on their size.

Any number of processes may share it. A file is fetched under another name by whoever has that name's lock, and renamed
when its hash is right, so that a crash leaves nothing that counts; the system gives a dead process's lock to the next.
"""

import contextlib
import dataclasses
import fcntl
import os
import re
from collections.abc import Iterator
from pathlib import Path

from gen2d.core.errors import DamagedError
from gen2d.storage.paths import Url, download
from gen2d.storage.sealed import file_sha256

_OURS = re.compile(r"[0-9a-f]{64}")


@dataclasses.dataclass(frozen=True)
class Cache:
    """Files by their sha256 in `folder`; the ones used longest ago go when they take more than `limit` bytes."""

    folder: Path
    limit: int | None
    seen: set[str] = dataclasses.field(default_factory=set)  # what this process knows to be right

    def path(self, url: Url, sha256: str, size: int) -> Path:
        """Where the file is, fetched if need be; open it soon, as others may make room at any time.

        Raises OSError if it cannot be fetched, DamagedError if it is not what was written.
        """
        path = self.folder / sha256
        if not self._holds(path):
            with self._locked(path.with_suffix(".part")) as part:
                if not self._holds(path):  # another process may have fetched it meanwhile
                    download(url, part, size)
                    if file_sha256(part) != sha256:
                        raise DamagedError(f"{url} is not what was written: its sha256 differs")
                    self._make_room(part.stat().st_size)
                    part.replace(path)
                    self.seen.add(sha256)
        return path

    def _holds(self, path: Path) -> bool:
        """Whether the file is there and right; its time then says when it was last used."""
        try:
            if path.name not in self.seen and file_sha256(path) != path.name:
                return False
            os.utime(path)
        except FileNotFoundError:
            return False
        self.seen.add(path.name)
        return True

    @contextlib.contextmanager
    def _locked(self, part: Path) -> Iterator[Path]:
        """The name to fetch a file under, while no one else does."""
        self.folder.mkdir(parents=True, exist_ok=True)
        while True:
            with part.open("ab") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                if not _is_at(file.fileno(), part):
                    continue  # renamed by whoever had the lock before
                try:
                    yield part
                finally:
                    if _is_at(file.fileno(), part):  # not renamed; and nobody else may, as long as it is locked
                        part.unlink()
                return

    def _make_room(self, size: int) -> None:
        """Removes files, the longest unused first, until another of `size` bytes fits."""
        if self.limit is None:
            return
        files = []
        for path in self.folder.iterdir():
            if _OURS.fullmatch(path.name):
                with contextlib.suppress(FileNotFoundError):
                    about = path.stat()
                    files.append((about.st_mtime_ns, about.st_size, path))
        total = size + sum(taken for _, taken, _ in files)
        for _, taken, path in sorted(files):
            if total <= self.limit:
                break
            path.unlink(missing_ok=True)
            total -= taken


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether the open file has this name still."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
