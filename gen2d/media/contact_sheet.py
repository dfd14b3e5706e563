"""Contact sheets: videos down, time across."""

import cv2
import numpy as np

COLUMNS = 10  # frames across the sheet
LARGEST = 192  # px: of a frame on a dataset's card
GAP, GREY = 2, 170  # px between pictures, and its sRGB
SMALLEST = 96  # px: smaller frames are enlarged by whole factors, so that pixels stay pixels


def shown(frames: int) -> np.ndarray:
    """Indices of the frames that a sheet shows, evenly spaced from the first to the last."""
    return np.unique(np.linspace(0, frames - 1, COLUMNS).round().astype(int))


def contact_sheet(frames: np.ndarray) -> np.ndarray:
    """A picture [H, W, 3] of videos [n, T, H, W, 3]: a row for each, with time from left to right."""
    rows = [np.concatenate([framed(video[t]) for t in shown(len(video))], axis=1) for video in frames]
    return np.concatenate(rows)


def reduced(video: np.ndarray) -> np.ndarray:
    """Frames of a video [T, H, W, 3] that a sheet shows, at most LARGEST pixels a side by averaging."""
    frames = video[shown(len(video))]
    factor = -(-max(frames.shape[1:3]) // LARGEST)
    if factor == 1:
        return frames
    size = frames.shape[2] // factor, frames.shape[1] // factor
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])


def enlarged(image: np.ndarray) -> np.ndarray:
    """An image [H, W] or [H, W, 3] repeated by a whole factor until no side is below SMALLEST."""
    factor = -(-SMALLEST // min(image.shape[:2]))
    return np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)


def framed(frame: np.ndarray) -> np.ndarray:
    """An enlarged frame with a grey border."""
    return np.pad(enlarged(frame), [(GAP, GAP), (GAP, GAP), (0, 0)], constant_values=GREY)
