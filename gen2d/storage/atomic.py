"""Files and folders that appear whole or not at all: written under a temporary name, synced, renamed.

Those of a Url are written in the system's folder for temporary files, and uploaded.
"""

import contextlib
import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from gen2d.storage.leases import LOCK, TEMPORARY, abandoned, leased, remove_abandoned, temporaries, temporary_name
from gen2d.storage.paths import Place, Url, upload
from gen2d.storage.sealed import read_bytes

_OLD = ".old"  # before a temporary name's end: what a new folder is about to replace


@contextlib.contextmanager
def publishing(path: Place) -> Iterator[Path]:
    """A temporary file to write, locked; it appears as `path` when the block ends well, and never otherwise."""
    folder = Path(tempfile.gettempdir()) if isinstance(path, Url) else path.parent
    prefix = "gen2d-" if isinstance(path, Url) else ""
    temporary = folder / temporary_name(prefix + path.name)
    with leased(temporary):
        try:
            yield temporary
            if isinstance(path, Url):
                upload(temporary, path)
            else:
                sync(temporary)
                temporary.replace(path)
                sync(folder)
        finally:  # also after an interrupt
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def publishing_folder(path: Path) -> Iterator[Path]:
    """A temporary folder to write in; it appears as `path`, instead of what was there, when the block ends well."""
    temporary, replaced = (path.with_name(temporary_name(path.name + old)) for old in ("", _OLD))
    with _leased_folder(temporary), _leased_folder(replaced):
        try:
            temporary.mkdir()
            yield temporary
            os.sync()  # once: a file at a time, many small ones would take minutes
            if path.exists():
                path.rename(replaced)
            temporary.rename(path)
        except BaseException:  # also an interrupt
            if replaced.exists() and not path.exists():
                replaced.rename(path)
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        sync(path.parent)
        shutil.rmtree(replaced, ignore_errors=True)


@contextlib.contextmanager
def _leased_folder(folder: Path) -> Iterator[None]:
    """A block in which the temporary folder is this process's; a locked file beside it says so."""
    lock = folder.with_name(folder.name + LOCK)
    with leased(lock):
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def publish(path: Place, content: bytes) -> None:
    """Returns when the disk, or the server, has `content` as `path`, whole."""
    with publishing(path) as temporary:
        temporary.write_bytes(content)


def publish_changed(path: Place, content: bytes) -> None:
    """The same, but a file that holds just that stays as it is."""
    try:
        if read_bytes(path, len(content)) == content:
            return
    except OSError:
        pass
    publish(path, content)


def link_or_copy(source: Path, target: Path) -> None:
    """Returns when the file has this name, too; it is copied where a file system gives no second name."""
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
    """The folder on disk in which what goes to `root` is written first."""
    return Path(tempfile.gettempdir()) if isinstance(root, Url) else root


def sweep(root: Place, folders: tuple[str, ...], force: bool = False) -> list[Path]:
    """The temporary files that nobody holds in these folders of `root`, which are removed."""
    if isinstance(root, Url):
        return remove_abandoned(temporaries(work_folder(root), "gen2d-"), force)
    return [path for name in folders for path in remove_abandoned(temporaries(root / name), force)]


def sweep_beside(path: Path) -> None:
    """Removes what nobody holds any more of what was to become `path`; a folder that was about to be replaced when
    its process was killed comes back."""
    for left in temporaries(path.parent, f"{path.name}{_OLD}."):
        if not left.is_dir():
            continue
        with abandoned(left) as is_abandoned:
            if is_abandoned and not path.exists():
                left.rename(path)
    remove_abandoned(temporaries(path.parent, f"{path.name}."))


def is_temporary(name: str) -> bool:
    """Whether it is the name of what is being written, or was when its process was killed."""
    return TEMPORARY.search(name) is not None


def remove_tree(folder: Place) -> None:
    """Removes the folder and all in it; a link is removed, and not what it leads to."""
    if isinstance(folder, Url):
        for path in folder.rglob("*"):
            path.unlink(missing_ok=True)
    elif folder.is_symlink():
        folder.unlink()
    else:
        shutil.rmtree(folder, ignore_errors=True)


def size_of(path: Place) -> int | None:
    """The size of a regular file in bytes; None if there is none."""
    try:
        about = path.stat()
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP):
            return None
        raise
    return about.st_size if stat.S_ISREG(about.st_mode) else None


def sync(path: Path) -> None:
    """Returns when the disk has the file, or the folder's list of names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
