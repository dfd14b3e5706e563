"""Atomic publication of files and folders: written under a temporary name, synced, renamed.

A file for a URL is written in the system's temporary folder and uploaded.
"""

import contextlib
import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from gen2d.storage.leases import LOCK, TEMPORARY, abandoned, lease, remove_abandoned, temporary_files, temporary_name
from gen2d.storage.paths import Place, Url, upload
from gen2d.storage.sealed import read_bytes

_OLD = ".old"  # part of the temporary name of a folder that is being replaced


@contextlib.contextmanager
def publishing(path: Place) -> Iterator[Path]:
    """Context with a locked temporary file, which becomes `path` when the block ends without an error."""
    folder = Path(tempfile.gettempdir()) if isinstance(path, Url) else path.parent
    prefix = "gen2d-" if isinstance(path, Url) else ""
    temporary = folder / temporary_name(prefix + path.name)
    with lease(temporary):
        try:
            yield temporary
            if isinstance(path, Url):
                upload(temporary, path)
            else:
                sync(temporary)
                temporary.replace(path)
                sync(folder)
        finally:  # including an interrupt
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def publishing_folder(path: Path) -> Iterator[Path]:
    """Context with a temporary folder, which replaces `path` when the block ends without an error."""
    temporary = path.with_name(temporary_name(path.name))
    with _lease_folder(temporary):
        try:
            temporary.mkdir()
            yield temporary
            replace_folder(path, temporary)
        except BaseException:  # including an interrupt
            shutil.rmtree(temporary, ignore_errors=True)
            raise


def replace_folder(path: Path, new: Path) -> None:
    """Give the folder `new`, on the same disk, the name `path`, and remove the folder that has it; all or nothing."""
    replaced = path.with_name(temporary_name(path.name + _OLD))
    with _lease_folder(replaced):
        try:
            os.sync()  # all at once: syncing many small files one by one takes minutes
            if path.exists():
                path.rename(replaced)
            new.rename(path)
        except BaseException:  # including an interrupt
            if replaced.exists() and not path.exists():
                replaced.rename(path)
            raise
        sync(path.parent)
        shutil.rmtree(replaced, ignore_errors=True)


@contextlib.contextmanager
def _lease_folder(folder: Path) -> Iterator[None]:
    """Context in which this process owns the temporary folder, by a locked file beside it."""
    lock = folder.with_name(folder.name + LOCK)
    with lease(lock):
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def publish(path: Place, content: bytes) -> None:
    """Write a file atomically; on return it is stored on the disk or server."""
    with publishing(path) as temporary:
        temporary.write_bytes(content)


def publish_changed(path: Place, content: bytes) -> None:
    """Write a file atomically unless it already has this content."""
    try:
        if read_bytes(path, len(content)) == content:
            return
    except OSError:
        pass
    publish(path, content)


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where the file system has no hard links."""
    try:
        os.link(source, target)
    except FileExistsError:
        return
    except FileNotFoundError:
        raise
    except OSError:
        with publishing(target) as temporary:
            shutil.copyfile(source, temporary)


def work_folder(root: Place) -> Path:
    """Local folder in which files for `root` are written first."""
    return Path(tempfile.gettempdir()) if isinstance(root, Url) else root


def sweep(root: Place, folders: tuple[str, ...], force: bool = False) -> list[Path]:
    """Remove the abandoned temporary files in these folders of `root` and return their paths."""
    if isinstance(root, Url):
        return remove_abandoned(temporary_files(work_folder(root), "gen2d-"), force)
    return [path for name in folders for path in remove_abandoned(temporary_files(root / name), force)]


def sweep_beside(path: Path) -> None:
    """Remove abandoned temporary files of `path`; restore a folder whose replacement was interrupted."""
    for folder in temporary_files(path.parent, f"{path.name}{_OLD}."):
        if not folder.is_dir():
            continue
        with abandoned(folder) as is_abandoned:
            if is_abandoned and not path.exists():
                folder.rename(path)
    remove_abandoned(temporary_files(path.parent, f"{path.name}."))


def is_temporary(name: str) -> bool:
    """Whether this is the name of a temporary file or folder."""
    return TEMPORARY.search(name) is not None


def remove_tree(folder: Place) -> None:
    """Remove a folder and its contents; a link is removed, but not its target."""
    if isinstance(folder, Url):
        for path in folder.rglob("*"):
            path.unlink(missing_ok=True)
    elif folder.is_symlink():
        folder.unlink()
    else:
        shutil.rmtree(folder, ignore_errors=True)


def list_folder(folder: Place) -> list[Place]:
    """The paths in a folder, sorted; none if there is no such folder."""
    try:
        return sorted(folder.iterdir(), key=str)
    except (FileNotFoundError, NotADirectoryError):
        return []


def size_of(path: Place | os.DirEntry[str]) -> int | None:
    """The size of a regular file in bytes; None if there is no such file."""
    try:
        status = path.stat()
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP):
            return None
        raise
    return status.st_size if stat.S_ISREG(status.st_mode) else None


def sync(path: Path) -> None:
    """Flush a file, or a folder's list of names, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
