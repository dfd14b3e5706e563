"""Videos as films: OpenCV's MPEG-4 encoder, which is always there, and PyAV's encoders, an extra."""

import os
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np

from gen2d.errors import ConfigError, UserError

LARGEST_RATE = 2**16 - 1  # what MPEG-4 has bits for, in numerator and denominator


def mp4v(path: Path, frames: np.ndarray, fps: float) -> None:
    """Writes frames [T, H, W, 3], H and W even, as MPEG-4; OSError if the file does not hold all of them."""
    height, width = frames.shape[1:3]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (width, height))
    if not writer.isOpened():
        raise OSError(f"{path}: OpenCV could not write a film")
    for image in frames:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
    # It tells of no error, not even of a full disk.
    found = cv2.VideoCapture(str(path))
    sizes = [
        found.get(what) for what in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)
    ]
    found.release()
    if sizes != [len(frames), height, width]:
        raise OSError(f"{path}: OpenCV could not write all of a film")


def encode(path: Path, frames: np.ndarray, fps: float, codec: str, pixels: str, options: Mapping[str, str]) -> None:
    """Writes frames [T, H, W, 3] by one of PyAV's encoders; `pixels` and `options` are FFmpeg's."""
    av = pyav()
    # Bit-exact: without versions and random numbers in the file.
    with av.open(str(path), "w", options={"fflags": "+bitexact"}) as file:
        stream = file.add_stream(codec, rate=rate_of(fps), options=dict(options))
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
        stream.codec_context.thread_count = 1  # videos are encoded side by side
        for image in frames:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode(None))


def pyav() -> ModuleType:
    """PyAV, or a UserError that says how to get it."""
    os.environ.setdefault("SVT_LOG", "1")  # errors alone, when AV1's encoder is loaded
    try:
        import av
    except ImportError:
        raise UserError("this format needs PyAV: pip install gen2d[video]") from None
    return av


def rate_of(fps: float) -> Fraction:
    """The frame rate as films store it, such as 30000/1001."""
    return Fraction(fps).limit_denominator(1001)


def check(name: str, size: tuple[int, int], fps: float) -> None:
    """Returns nothing; raises ConfigError where a film with half the colours' resolution cannot be as asked."""
    for side, pixels in zip(("height", "width"), size, strict=True):
        if pixels % 2:
            raise ConfigError(
                f"video.{side} is {pixels} px, but {name} must have an even {side}: choose ffv1, npz or webdataset"
            )
    check_rate(name, fps)


def check_rate(name: str, fps: float) -> None:
    """Returns nothing; raises ConfigError for a frame rate that films cannot store."""
    rate = rate_of(fps)
    if not 0 < rate.numerator <= LARGEST_RATE or abs(rate / Fraction(fps) - 1) > 1e-4:
        raise ConfigError(f"video.fps is {fps:g}, but {name} must have 0.001 to {LARGEST_RATE} frames/s")
