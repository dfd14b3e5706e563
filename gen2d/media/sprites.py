"""Sprite sheets: all frames of a video in one WebP picture, from which a browser shows any frame at once."""

import io
import math

import numpy as np
from PIL import Image

from gen2d.media.images import WEBP_SIDE


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

    `quality` is from 0 to 100, None for lossless. The same frames give the same bytes with the same version of Pillow,
    which brings its own encoder.
    """
    count, height, width = frames.shape[:3]
    rows = sprite_rows(count, height)
    columns = -(-count // rows)
    padded = np.concatenate([frames, np.repeat(frames[-1:], rows * columns - count, axis=0)])
    sheet = np.concatenate(padded.reshape(columns, rows * height, width, frames.shape[3]), axis=1)
    lossless = {"lossless": True, "quality": 30, "method": 1}
    content = io.BytesIO()
    options = lossless if quality is None else {"quality": quality, "method": 2}
    Image.fromarray(np.ascontiguousarray(sheet)).save(content, "WEBP", **options)
    return content.getvalue()
