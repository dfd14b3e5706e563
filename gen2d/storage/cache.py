"""A cache folder for files of remote datasets, each under its sha256, with a limit on their total size.

Any number of processes may share it. The process that holds the lock of a file downloads it under a temporary name and
renames it when its hash is right, so a crash leaves no wrong file; the system releases the lock of a dead process.
"""

import contextlib
import dataclasses
import fcntl
import os
import re
from collections.abc import Iterator
from pathlib import Path

from gen2d.core.errors import DamagedError
from gen2d.storage.leases import is_at
from gen2d.storage.paths import Url, download
from gen2d.storage.sealed import file_sha256

_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclasses.dataclass(frozen=True)
class Cache:
    """Files in `folder` by their sha256, at most `limit` bytes in total; the least recently used are removed first."""

    folder: Path
    limit: int | None
    verified: set[str] = dataclasses.field(default_factory=set)  # sha256 of the files that this process has verified

    def path(self, url: Url, sha256: str, size: int) -> Path:
        """The path of the file, downloaded if needed; open it soon, as other processes may remove it at any time.

        Raises OSError or UnreachableError if it cannot be downloaded, DamagedError if it has another sha256.
        """
        path = self.folder / sha256
        if not self._holds(path):
            with self._locked(path.with_suffix(".part")) as part:
                if not self._holds(path):  # another process may have downloaded it meanwhile
                    download(url, part, size)
                    if file_sha256(part) != sha256:
                        raise DamagedError(f"{url} is not what was written: its sha256 differs")
                    self._make_room(part.stat().st_size)
                    part.replace(path)
                    self.verified.add(sha256)
        return path

    def _holds(self, path: Path) -> bool:
        """Whether the file exists and has its sha256; sets its time of last use."""
        try:
            if path.name not in self.verified and file_sha256(path) != path.name:
                return False
            os.utime(path)
        except FileNotFoundError:
            return False
        self.verified.add(path.name)
        return True

    @contextlib.contextmanager
    def _locked(self, part: Path) -> Iterator[Path]:
        """Context that locks the temporary file `part`, which the block may rename."""
        self.folder.mkdir(parents=True, exist_ok=True)
        while True:
            with part.open("ab") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                if not is_at(file.fileno(), part):
                    continue  # the previous owner of the lock has renamed it
                try:
                    yield part
                finally:
                    if is_at(file.fileno(), part):  # not renamed; no other process renames it while it is locked
                        part.unlink()
                return

    def _make_room(self, size: int) -> None:
        """Remove files, the least recently used first, until another of `size` bytes fits."""
        if self.limit is None:
            return
        files = []
        for path in self.folder.iterdir():
            if _SHA256.fullmatch(path.name):
                with contextlib.suppress(FileNotFoundError):
                    status = path.stat()
                    files.append((status.st_mtime_ns, status.st_size, path))
        total = size + sum(file_size for _, file_size, _ in files)
        for _, file_size, path in sorted(files):
            if total <= self.limit:
                break
            path.unlink(missing_ok=True)
            total -= file_size
