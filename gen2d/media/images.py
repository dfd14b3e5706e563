"""PNG and GIF files, and the folders that they go into."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from gen2d.core.errors import FolderError
from gen2d.media.contact_sheet import framed
from gen2d.storage.atomic import publish


def check_folder(out: Path) -> None:
    """Returns nothing; makes the folder for pictures, or raises FolderError, before any is drawn."""
    with writing(out), tempfile.TemporaryFile(dir=out):
        pass


@contextlib.contextmanager
def writing(out: Path) -> Iterator[None]:
    """A block that writes into a folder, which is made first; its OSError becomes a FolderError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise FolderError(f"{out}: pictures cannot be written there ({error.strerror or error})") from None


def animate(path: Path, frames: np.ndarray, fps: float) -> None:
    """Writes all videos side by side as an animated GIF that loops."""
    across = int(np.ceil(np.sqrt(len(frames))))
    blank = np.zeros_like(frames[0])
    cells = [*frames, *[blank] * (-len(frames) % across)]
    rows = [np.concatenate([_tiled(v) for v in cells[i : i + across]], axis=2) for i in range(0, len(cells), across)]
    movie = cv2.Animation()
    movie.frames = [image[..., ::-1].copy() for image in np.concatenate(rows, axis=1)]
    movie.durations = [max(20, round(1000 / fps))] * len(movie.frames)
    done, content = cv2.imencodeanimation(".gif", movie)
    if not done:
        raise OSError("OpenCV could not make a GIF")
    publish(path, content.tobytes())


def _tiled(video: np.ndarray) -> np.ndarray:
    return np.stack([framed(frame) for frame in video])


def write(path: Path, image: np.ndarray) -> None:
    """Writes a picture [H, W, 3]."""
    publish(path, png(image))


def png(image: np.ndarray) -> bytes:
    """A picture [H, W, 3] as the bytes of a PNG file."""
    done, content = cv2.imencode(".png", image[..., ::-1])
    if not done:
        raise OSError("OpenCV could not write a PNG")
    return content.tobytes()
