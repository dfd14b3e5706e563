"""Ownership of temporary files, by locks that the system releases when a process dies.

Host names and process numbers identify no owner, as two containers may share both. So a temporary file has a random
token in its name, and its writer holds an exclusive lock (flock) on it; a file whose lock is free is abandoned. On a
file system without locks, or with locks that other machines do not see, no file counts as abandoned.
"""

import contextlib
import errno
import fcntl
import os
import re
import secrets
import shutil
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

TEMPORARY = re.compile(r"\.tmp\.[0-9a-f]{16}(\.lock)?$")  # the end of a temporary name
LOCK = ".lock"  # suffix of the lock file of a temporary folder

# File systems whose locks hold for all processes that see a file; NFS and Lustre may be mounted without locks.
_ON_DISK = frozenset(
    ("ext2", "ext3", "ext4", "xfs", "btrfs", "zfs", "f2fs", "bcachefs", "jfs", "reiserfs", "apfs", "hfs")
)
_SHARED = frozenset(("nfs", "nfs4", "ceph", "gpfs", "lustre", "gfs2", "ocfs2"))
_WITH_LOCKS = _ON_DISK | _SHARED | {"tmpfs", "ramfs", "rootfs", "overlay", "aufs"}
_WITHOUT = frozenset(("nolock", "local_lock=all", "local_lock=flock", "localflock", "noflock"))


def temporary_name(name: str) -> str:
    """A unique temporary name for a file that becomes `name`."""
    return f"{name}.tmp.{secrets.token_hex(8)}"


@contextlib.contextmanager
def lease(path: Path) -> Iterator[int]:
    """Descriptor of a new, empty file with this name, locked until the block ends.

    On a file system without locks, the file is created but not locked. Raises OSError.
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            if try_lock(descriptor) is not False and is_at(descriptor, path):
                yield descriptor
                return
        finally:
            os.close(descriptor)
        time.sleep(0.001)  # another process removed it as abandoned before it was locked


@contextlib.contextmanager
def exclusive_lock(path: Path, seconds: float) -> Iterator[None]:
    """Context that one process at a time enters, by a lock on the file `path`, which is not removed.

    On a file system without locks, any number of processes enter. Raises TimeoutError if another process holds the lock
    for longer than `seconds`.
    """
    end = time.monotonic() + seconds
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
    try:
        while try_lock(descriptor) is False:
            if time.monotonic() > end:
                raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT), str(path))
            time.sleep(0.02)
        yield
    finally:
        os.close(descriptor)


def try_lock(descriptor: int) -> bool | None:
    """Lock a file if no other process has; returns whether it is locked, None if the file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EBADF):
            return None
        raise
    return True


def is_at(descriptor: int, path: Path) -> bool:
    """Whether the open file still has this name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def remove_abandoned(paths: Iterable[Path], force: bool = False) -> list[Path]:
    """Remove the abandoned temporary files and folders among the paths; returns their paths.

    `force` also removes those on a file system without locks, where they may still be in use.
    """
    removed = []
    for path in paths:
        of_folder = path.name.endswith(LOCK) and path.with_name(path.name.removesuffix(LOCK)).exists()
        if TEMPORARY.search(path.name) and not of_folder:  # a folder's lock goes with the folder
            with contextlib.suppress(OSError), abandoned(path, force) as is_abandoned:
                if is_abandoned:
                    (shutil.rmtree if path.is_dir() and not path.is_symlink() else os.unlink)(path)
                    removed.append(path)
    return removed


@contextlib.contextmanager
def abandoned(path: Path, force: bool = False) -> Iterator[bool]:
    """Context whose value is whether the file or folder has no owner; if so, none can take it during the block."""
    if not force and not has_locks(path.parent):
        yield False
        return
    is_folder = path.is_dir() and not path.is_symlink()
    lock = path.with_name(path.name + LOCK) if is_folder else path
    if is_folder and not lock.exists():
        yield True
        return
    descriptor = os.open(lock, os.O_RDWR | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        locked = try_lock(descriptor)
        free = bool(locked or (force and locked is None)) and is_at(descriptor, lock)
        yield free
        if free and is_folder:
            lock.unlink(missing_ok=True)
    finally:
        os.close(descriptor)


def temporary_files(folder: Path, prefix: str = "") -> Iterator[Path]:
    """The temporary files and folders directly in a folder whose names begin with `prefix`."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
        for entry in entries:
            if TEMPORARY.search(entry.name) and entry.name.startswith(prefix):
                yield Path(entry.path)


def has_locks(folder: Path) -> bool:
    """Whether locks in this folder hold for every process that sees it, on all machines."""
    try:
        mounts = Path("/proc/self/mountinfo").read_text().splitlines()
    except OSError:
        return True  # not Linux: locks hold at least on this machine
    kind, options = _mount_of(os.path.realpath(folder), mounts)
    if kind == "lustre" and "flock" not in options:
        return False
    return kind in _WITH_LOCKS and options.isdisjoint(_WITHOUT)


def _mount_of(path: str, mounts: Iterable[str]) -> tuple[str, frozenset[str]]:
    """The type and options of the file system that holds a path (proc(5), mountinfo)."""
    best, mount = "", ("", frozenset[str]())
    for line in mounts:
        mounted, _, system = line.partition(" - ")
        point = mounted.split(" ")[4].encode().decode("unicode_escape")  # a space is written \040
        inside = path == point or path.startswith(point.rstrip("/") + "/")
        if inside and len(point) >= len(best):
            kind, _, options = system.split(" ", 2)
            best = point
            mount = kind, frozenset((options.split(" ")[-1] + "," + mounted.split(" ")[5]).split(","))
    return mount
