"""Errors with one sentence for the user, made from OSErrors of reading and writing."""

import errno
import os
from pathlib import Path

from gen2d.core.errors import DamagedError, FolderError, UnreachableError, UserError, argument

FULL = (errno.ENOSPC, errno.EDQUOT)
# The disk or its network fails; the data may be whole.
_FAILING = tuple(
    getattr(errno, name)
    for name in ("EIO", "ESTALE", "ETIMEDOUT", "ENOTCONN", "EHOSTDOWN", "EREMOTEIO", "ENODEV")
    if hasattr(errno, name)  # no system has them all
)
_TOO_MANY = (errno.EMFILE, errno.ENFILE)
_NO_FILE = (errno.ENXIO, errno.EISDIR, errno.ENOTDIR, errno.ELOOP)


def reason(error: Exception) -> str:
    """Message of an error, without the file's name."""
    return str(getattr(error, "strerror", None) or error)


def reading_error(path: object, error: OSError) -> Exception:
    """The error to raise when a file of a dataset cannot be read."""
    if isinstance(error, FileNotFoundError):
        return DamagedError(f"{path} is missing")
    if error.errno in _TOO_MANY:
        return UserError(f"{path} cannot be opened: too many files are open; allow more of them (ulimit -n)")
    if error.errno == errno.ENOMEM:
        return UserError(f"{path} cannot be read: the machine has no memory left")
    if error.errno in (errno.EACCES, errno.EPERM):
        return FolderError(f"{path} cannot be read: permission denied")
    if error.errno in _FAILING:
        return UnreachableError(f"{path} cannot be read: the disk or its network fails ({reason(error)})")
    if error.errno == errno.EFBIG:
        return DamagedError(f"{path} is larger than such a file can be")
    if error.errno == errno.ENAMETOOLONG:
        return FolderError(f"{path} cannot be read: its name is too long")
    if error.errno == errno.EOPNOTSUPP:
        return FolderError(f"{path} cannot be read: {reason(error)}")
    if error.errno in _NO_FILE:
        return DamagedError(f"{path} is not a regular file")
    return UnreachableError(f"{path} cannot be read ({reason(error)})")


def writing_error(where: Path, error: OSError, again: str = "run the same command again", need: str = "") -> UserError:
    """The error to raise when a file cannot be written in the folder `where`.

    `again` is the advice for continuing, `need` a phrase for the space needed. The exit code is 1 for a disk that is
    full or fails, and 2 for errors that another folder avoids.
    """
    if isinstance(error, FileExistsError | NotADirectoryError):
        path = Path(error.filename or where)
        found = next((each for each in (path, *path.parents) if each.is_file()), path)
        return FolderError(f"{found} is a file, not a folder: choose another {argument('out')}")
    if isinstance(error, PermissionError):
        return FolderError(
            f"you have no permission to write in {error.filename or where}: choose another {argument('out')}"
        )
    if error.errno == errno.EROFS:
        return FolderError(f"{where} is on a disk that is read-only: choose another {argument('out')}")
    if error.errno in _TOO_MANY:
        return UserError(f"{where} cannot be written: too many files are open; allow more of them (ulimit -n)")
    if isinstance(error, FileNotFoundError):
        return FolderError(f"{error.filename or where} is gone: was {where} moved or removed during the run?")
    if error.errno in FULL:
        need = f"{need}, " if need else ""
        sentence = f"no space left for {where}: {need}the disk has {_space(where)}: make room and {again}"
    elif error.errno == errno.EFBIG:
        sentence = (
            f"{where} cannot hold so large a file: its file system, or ulimit -f, allows none; allow it and {again}"
        )
    elif error.errno in _FAILING:
        sentence = (
            f"{where} cannot be written, as the disk or its network fails ({reason(error)}): repair it and {again}"
        )
    else:
        return FolderError(f"{where} cannot be written ({reason(error)}): choose another {argument('out')}")
    failure = FolderError(sentence)
    failure.exit_code = 1
    return failure


def _space(where: Path) -> str:
    """Phrase for the free space on a disk."""
    try:
        disk = os.statvfs(next(folder for folder in (where, *where.absolute().parents) if folder.exists()))
    except (OSError, StopIteration):
        return "none"
    if disk.f_files and not disk.f_favail:
        return "no inodes left"
    return f"{disk.f_bavail * disk.f_frsize / 1e6:.1f} MB left"
