"""Annotations drawn over frames."""

from collections.abc import Mapping

import cv2
import numpy as np

from gen2d.media.contact_sheet import enlarged

SEEN, WHOLE = (255, 255, 255), (255, 140, 0)  # boxes around what is seen, and around all of an object
VideoFields = Mapping[str, np.ndarray]


# ---- One frame, from its columns


def colors(count: int) -> np.ndarray:
    """Colours [count, 3] uint8 that differ, for ids: 0 is black, 255 grey."""
    hue = np.arange(count) * 0.618034 % 1 * 180  # the golden section: neighbours differ, and none comes twice
    full = np.stack([hue, np.full(count, 170), np.full(count, 255)], -1).astype(np.uint8)
    made = cv2.cvtColor(full[None], cv2.COLOR_HSV2RGB)[0]
    made[0], made[255:] = 0, 128
    return made


def masks_overlay(frame: VideoFields) -> np.ndarray:
    """The instance mask in false colours."""
    return colors(256)[frame["masks/instance"]]


def amodal_overlay(frame: VideoFields) -> np.ndarray:
    """The outline of all of each object."""
    image = enlarged(frame["frames"])
    height, width = frame["frames"].shape[:2]
    for slot, packed in enumerate(frame["masks/amodal"]):
        mask = enlarged(np.unpackbits(packed)[: height * width].reshape(height, width))
        image[(mask > 0) & (cv2.erode(mask, np.ones((3, 3), np.uint8)) == 0)] = colors(256)[slot + 1]
    return image


def boxes_overlay(frame: VideoFields) -> np.ndarray:
    """What is seen of each object in a white box, all of it in an orange one."""
    image = enlarged(frame["frames"])
    factor = len(image) // len(frame["frames"])
    for name, color in (("boxes/amodal", WHOLE), ("boxes/visible", SEEN)):
        for left, top, right, bottom in np.round(frame[name] * factor).astype(int).tolist():
            if right > left:
                cv2.rectangle(image, (left, top), (right - 1, bottom - 1), color)
    return image


def flow_overlay(frame: VideoFields) -> np.ndarray:
    """The flow to the next frame: its direction as a hue, its speed as saturation."""
    x, y = np.moveaxis(frame["flow/forward"], -1, 0)
    hue = np.degrees(np.arctan2(y, x)) % 360 / 2
    hsv = np.stack([hue, 255 * np.clip(np.hypot(x, y), 0, 1), np.full_like(x, 255)], -1)
    return cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB)


def tracks_overlay(frame: VideoFields) -> np.ndarray:
    """Points that are fixed to objects, where they are seen."""
    image = enlarged(frame["frames"])
    factor = len(image) // len(frame["frames"])
    for number, (point, seen) in enumerate(zip(frame["tracks/points"], frame["tracks/visible"], strict=True)):
        if seen:
            place = (np.floor(point * factor)).astype(int).tolist()
            cv2.circle(image, place, 1, colors(256)[number % 254 + 1].tolist(), -1)
    return image
