"""Folders of images that the user names, for backgrounds.

A config, and so a dataset, holds the sha256 of images and no path. Files are found by their hashes among the folders
that the process was given, so nothing that a dataset says makes gen2d open a file.
"""

import os
from pathlib import Path

from gen2d.core.errors import ConfigError, UserError, argument
from gen2d.storage.explain import reason
from gen2d.storage.sealed import read_bytes, sha256

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
MAX_FILES, FILE_BYTES = 10_000, 2**26
MAX_NAMED = 10 * MAX_FILES

_files: dict[str, Path] = {}  # by sha256: of the folders that were named, the oldest first
_newest: tuple[str, ...] = ()  # hashes of the images of the folder named last


def use_images(folder: str | os.PathLike[str]) -> tuple[str, ...]:
    """Name a folder of images for `look.background_kind: images`, in this process.

    Configs without `look.background_images` take the images of the folder named last. Datasets whose config has their
    hashes find them in any folder that was named.

    Parameters
    ----------
    folder : str or path
        Folder of PNG, JPEG and WebP files, each of 64 MiB at most; others in it are ignored, and so are its folders.

    Returns
    -------
    tuple of str
        sha256 of each image, by the names of the files.

    Raises
    ------
    UserError
        If the folder cannot be read, or holds no image, or more than 10,000.

    Examples
    --------
    >>> gen2d.use_images("photos")
    >>> gen2d.generate({"look": {"name": "studio", "background_kind": "images"}}, n=100, out="datasets/seen")
    """
    global _newest
    root, found = Path(folder), {}
    try:
        paths = sorted(path for path in root.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
        if len(paths) > MAX_FILES:
            raise UserError(
                f"{argument('images')} is {root}, which holds {len(paths)} images, but may hold {MAX_FILES}"
            )
        for path in paths:
            found[sha256(read_bytes(path, FILE_BYTES))] = path
    except OSError as error:
        raise UserError(f"{argument('images')} is {root}, which cannot be read ({reason(error)})") from None
    if not found:
        raise UserError(f"{argument('images')} is {root}, but must be a folder of PNG, JPEG or WebP files")
    _files.update(found)
    while len(_files) > MAX_NAMED:
        del _files[next(iter(_files))]
    _newest = tuple(found)
    return _newest


def newest_images() -> tuple[str, ...]:
    """Hashes of the images of the folder that was named last; empty if none was."""
    return _newest


def image_file(digest: str) -> tuple[Path, bytes]:
    """Path and content of the image with this sha256.

    Raises ConfigError if no folder that was named has it, or if the file has changed since.
    """
    path = _files.get(digest)
    if path is None:
        raise ConfigError(
            f"look.background_images has sha256 {digest}, but no image of a folder named in {argument('images')} is it"
        )
    try:
        content = read_bytes(path, FILE_BYTES)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({reason(error)})") from None
    if sha256(content) != digest:
        raise ConfigError(f"{path}: has changed since its folder was named, and its sha256 is no longer {digest}")
    return path, content
