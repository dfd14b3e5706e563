"""Sprite sheets: all frames of a video in one WebP picture, from which a browser shows any frame at once."""

import io
import math

import numpy as np
from PIL import Image

from gen2d.media.images import WEBP_SIDE

STEP = 32  # of rare colours that are rounded before they are encoded without loss
COMMON = 1 / 512  # part of a frame from which a colour is not rare
PLAIN = 0.9  # part of a frame that has common colours, from which on this is small
GOOD = 50  # quality from which it replaces WebP's lossy form


def reduced(frames: np.ndarray, side: int) -> np.ndarray:
    """Frames [T, H, W, 3] averaged over square blocks of pixels, so that they have at most `side` ** 2 pixels each."""
    height, width = frames.shape[1:3]
    factor = math.ceil(math.sqrt(height * width) / side)
    if factor == 1:
        return frames
    factor = min(factor, height, width)
    rows, columns = height // factor, width // factor
    cropped = frames[:, : rows * factor, : columns * factor]
    sums = cropped.reshape(len(frames), rows, factor, columns, factor, 3).sum((2, 4), dtype=np.uint32)
    return ((sums + factor * factor // 2) // (factor * factor)).astype(np.uint8)


def sprite_rows(frames: int, height: int) -> int:
    """Number of frames in a column of a sprite sheet."""
    return max(1, min(frames, WEBP_SIDE // height))


def sprite_sheet(frames: np.ndarray, quality: int | None) -> bytes:
    """WebP picture of the frames [T, H, W, 3 or 4], uint8 RGB or RGBA, one below the other in columns of `sprite_rows`.

    `quality` is from 0 to 100, None for lossless. From `GOOD` on, frames of few colours are encoded without loss, but
    for the rare colours of rims, which are rounded to half a `STEP`: plain grounds have no noise. Shades are not
    rounded. The same frames give the same bytes with the same version of Pillow, which brings its own encoder.
    """
    count, height, width = frames.shape[:3]
    rows = sprite_rows(count, height)
    columns = -(-count // rows)
    padded = np.concatenate([frames, np.repeat(frames[-1:], rows * columns - count, axis=0)])
    sheet = np.concatenate(padded.reshape(columns, rows * height, width, frames.shape[3]), axis=1)
    if quality is None:
        return _webp(sheet, lossless=True)
    first, is_common = _packed(frames[0]), np.zeros(2**24, bool)
    colors, counts = np.unique(first, return_counts=True)
    common = counts >= COMMON * height * width
    is_common[colors[common]] = True
    few = quality >= GOOD and counts[common].sum() >= PLAIN * height * width
    if not few or _are_shades(~is_common[first]):
        return _webp(sheet, lossless=False, quality=quality)
    return _webp(np.where(is_common[_packed(sheet)][..., None], sheet, _rounded(sheet)), lossless=True, quality=60)


def _webp(sheet: np.ndarray, lossless: bool, quality: int = 30) -> bytes:
    """WebP picture; without loss, `quality` is the effort."""
    content = io.BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(sheet))
    picture.save(content, "WEBP", lossless=lossless, quality=quality, method=1 if lossless else 2)
    return content.getvalue()


def _are_shades(rare: np.ndarray) -> bool:
    """Whether pixels [H, W] of rare colours lie side by side, as those of shades do; those of rims form thin lines."""
    inner = rare[1:-1, 1:-1] & rare[:-2, 1:-1] & rare[2:, 1:-1] & rare[1:-1, :-2] & rare[1:-1, 2:]
    return bool(inner.sum() > 0.1 * rare.sum())


def _rounded(colors: np.ndarray) -> np.ndarray:
    """Colours rounded to multiples of `STEP`, white to white."""
    return np.minimum((colors.astype(np.uint16) + STEP // 2) // STEP * STEP, 255).astype(np.uint8)


def _packed(colors: np.ndarray) -> np.ndarray:
    """Colours [..., 3] as numbers of 24 bits."""
    red, green, blue = np.moveaxis(colors.astype(np.uint32), -1, 0)
    return red << 16 | green << 8 | blue
