"""PNG and animated WebP files, and their folders."""

import contextlib
import errno
import io
import struct
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from gen2d.core.errors import FolderError
from gen2d.media.contact_sheet import add_border
from gen2d.storage.atomic import publish

WEBP_SIDE = 16383  # px, the largest height and width of the format
SHORTEST = 11  # ms, the minimum duration of a frame; browsers show shorter ones for 100 ms


def check_folder(out: Path) -> None:
    """Make the folder for pictures; raises FolderError if no file can be written there."""
    with writing(out), tempfile.TemporaryFile(dir=out):
        pass


@contextlib.contextmanager
def writing(out: Path) -> Iterator[None]:
    """Context that makes a folder and turns an OSError of writing there into a FolderError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise FolderError(f"{out}: pictures cannot be written there ({error.strerror or error})") from None


def animate(path: Path, frames: np.ndarray, fps: float) -> None:
    """Write videos [n, T, H, W, 3] side by side as a lossless animated WebP that loops; raises OSError."""
    columns = int(np.ceil(np.sqrt(len(frames))))
    tiles = [np.stack([add_border(frame) for frame in video]) for video in frames]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[i : i + columns], axis=2) for i in range(0, len(tiles), columns)]
    film = np.concatenate(rows, axis=1)
    height, width = film.shape[1:3]
    if max(height, width) > WEBP_SIDE:
        raise OSError(errno.EFBIG, f"{width} x {height} px, but a WebP has at most {WEBP_SIDE} px a side")
    first, *others = [Image.fromarray(image) for image in film]
    content, duration = io.BytesIO(), max(SHORTEST, round(1000 / fps))
    first.save(content, "WEBP", save_all=True, append_images=others, duration=duration, loop=0, lossless=True)
    publish(path, content.getvalue())


def write(path: Path, image: np.ndarray) -> None:
    """Write a picture [H, W, 3], uint8 RGB, as a PNG file."""
    publish(path, png(image))


def png(image: np.ndarray) -> bytes:
    """The bytes of a PNG file that holds a picture, [H, W, 3] of RGB or [H, W] of grey levels, uint8 or uint16."""
    if image.dtype == np.uint16:
        return _png16(image)
    content = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(content, "PNG")
    return content.getvalue()


def _png16(image: np.ndarray) -> bytes:
    """PNG of 16 bits a channel, which Pillow writes of grey levels only; each row is stored as it is (filter 0)."""
    height, width = image.shape[:2]
    pixels = np.ascontiguousarray(image, ">u2").reshape(height, -1).view(np.uint8)
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels], axis=1)
    kind = 2 if image.ndim == 3 else 0  # RGB, or grey levels
    header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes())), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )
