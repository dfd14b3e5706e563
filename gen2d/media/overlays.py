"""Annotations rendered over frames."""

from collections.abc import Mapping

import numpy as np

from gen2d.media.contact_sheet import upscale
from gen2d.media.drawing import rgb_of

VISIBLE, AMODAL = (255, 255, 255), (255, 140, 0)  # colours of visible and amodal boxes
VideoFields = Mapping[str, np.ndarray]


def colors(count: int) -> np.ndarray:
    """Distinct colours of ids [count, 3], uint8: 0 is black, 255 grey."""
    rgb = rgb_of(np.arange(count) * 0.618034 % 1 * 360, 2 / 3)  # golden section: neighbours differ, and no hue repeats
    rgb[0], rgb[255:] = 0, 128
    return rgb


def masks_overlay(frame: VideoFields) -> np.ndarray:
    """Instance mask of a frame in false colours."""
    return colors(256)[frame["masks/instance"]]


def amodal_overlay(frame: VideoFields) -> np.ndarray:
    """Frame with the outline of each object's amodal mask."""
    image = upscale(frame["frames"])
    height, width = frame["frames"].shape[:2]
    palette = colors(256)
    for slot, packed in enumerate(frame["masks/amodal"]):
        mask = upscale(np.unpackbits(packed)[: height * width].reshape(height, width))
        around = np.lib.stride_tricks.sliding_window_view(np.pad(mask, 1, constant_values=1), (3, 3))
        image[(mask > 0) & (around == 0).any((-2, -1))] = palette[slot + 1]
    return image


def boxes_overlay(frame: VideoFields) -> np.ndarray:
    """Frame with a white box around the visible part of each object and an orange one around all of it."""
    image = upscale(frame["frames"])
    factor = len(image) // len(frame["frames"])
    for name, color in (("boxes/amodal", AMODAL), ("boxes/visible", VISIBLE)):
        for left, top, right, bottom in np.round(frame[name] * factor).astype(int).tolist():
            if right > left:
                _draw_box(image, left, top, right, bottom, color)
    return image


def _draw_box(image: np.ndarray, left: int, top: int, right: int, bottom: int, color: tuple[int, int, int]) -> None:
    """Colour the outermost pixels of a box, as far as it lies in the image."""
    rows, columns = (slice(max(first, 0), max(last, 0)) for first, last in ((top, bottom), (left, right)))
    for row in {top, bottom - 1}:
        if 0 <= row < image.shape[0]:
            image[row, columns] = color
    for column in {left, right - 1}:
        if 0 <= column < image.shape[1]:
            image[rows, column] = color


def directions(flow: np.ndarray) -> np.ndarray:
    """Hues [...] in degrees, 0 to 350 in steps of 10, of displacements [..., 2] in px: 0 is to the right, 90 down."""
    return (np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) / 10).round().astype(int) % 36 * 10


def flow_overlay(frame: VideoFields) -> np.ndarray:
    """Flow to the next frame: direction as hue, speed as saturation."""
    x, y = np.moveaxis(frame["flow/forward"], -1, 0)
    return rgb_of(np.degrees(np.arctan2(y, x)) % 360, np.clip(np.hypot(x, y), 0, 1))


def tracks_overlay(frame: VideoFields) -> np.ndarray:
    """Frame with the visible track points."""
    image = upscale(frame["frames"])
    factor, palette = len(image) // len(frame["frames"]), colors(256)
    for number, (point, visible) in enumerate(zip(frame["tracks/points"], frame["tracks/visible"], strict=True)):
        if visible:
            column, row = np.floor(point * factor).astype(int).tolist()
            for across, down in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
                if 0 <= row + down < image.shape[0] and 0 <= column + across < image.shape[1]:
                    image[row + down, column + across] = palette[number % 254 + 1]
    return image


def height_overlay(frame: VideoFields) -> np.ndarray:
    """Heights of a frame, from 0 to 1, as grey values."""
    return grey_levels(255 * frame["surface/height"].astype(np.float32))


def normals_overlay(frame: VideoFields) -> np.ndarray:
    """Normals of a frame: red to the right, green up, blue towards the viewer."""
    return (frame["surface/normal"].astype(np.int16) + 128).astype(np.uint8)


def shadow_overlay(frame: VideoFields) -> np.ndarray:
    """Opacity of a frame's shadows as grey values."""
    return grey_levels(frame["surface/shadow"])


def grey_levels(values: np.ndarray) -> np.ndarray:
    """Grey image [..., 3], uint8, of values [...] from 0 to 255."""
    return np.repeat(np.clip(values, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)
