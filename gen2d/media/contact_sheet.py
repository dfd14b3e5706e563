"""Contact sheets: one row per video, time from left to right."""

import numpy as np
from PIL import Image

COLUMNS = 10  # frames across the sheet
LARGEST = 192  # px; maximum side of a frame on a dataset card
GAP, GREY = 2, 170  # width of a frame's border in px, and its sRGB value
SMALLEST = 96  # px; smaller frames are enlarged by integer factors, which keeps pixels sharp


def sheet_frames(frames: int) -> np.ndarray:
    """Indices of the frames that a sheet shows, evenly spaced from the first to the last."""
    return np.unique(np.linspace(0, frames - 1, COLUMNS).round().astype(int))


def contact_sheet(frames: np.ndarray) -> np.ndarray:
    """Contact sheet [H, W, 3] of videos [n, T, H, W, 3], uint8."""
    rows = [np.concatenate([add_border(video[t]) for t in sheet_frames(len(video))], axis=1) for video in frames]
    return np.concatenate(rows)


def downsample(video: np.ndarray) -> np.ndarray:
    """Frames of a video [T, H, W, 3] for a sheet, averaged over blocks of pixels to at most LARGEST pixels a side."""
    frames = video[sheet_frames(len(video))]
    factor = -(-max(frames.shape[1:3]) // LARGEST)
    if factor == 1:
        return frames
    return np.stack([resized(frame, frames.shape[1] // factor, frames.shape[2] // factor) for frame in frames])


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Picture [height, width, 3], uint8, whose pixels are the averages over the areas of a larger one."""
    return np.array(Image.fromarray(np.ascontiguousarray(image)).resize((width, height), Image.Resampling.BOX))


def upscale(image: np.ndarray) -> np.ndarray:
    """Image [H, W] or [H, W, 3] with its pixels repeated by an integer factor, so that no side is below SMALLEST."""
    factor = -(-SMALLEST // min(image.shape[:2]))
    return np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)


def add_border(frame: np.ndarray) -> np.ndarray:
    """Upscaled frame with a grey border."""
    return np.pad(upscale(frame), [(GAP, GAP), (GAP, GAP), (0, 0)], constant_values=GREY)
