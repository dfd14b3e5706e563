"""Videos as films: OpenCV's MPEG-4 encoder, which is always there, and PyAV's encoders, an extra."""

import os
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np

from gen2d.core.errors import ConfigError, UserError

LOSS = "lossy: colours at half the resolution, and rounded"  # of YUV 4:2:0
SLOWEST = 0.1  # frames/s; OpenCV rounds rates to a thousandth
FASTEST = 2**16 - 1  # frames/s; what MPEG-4 has bits for


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
    """Writes frames [T, H, W, 3] by one of PyAV's encoders, or raises OSError; `pixels` and `options` are FFmpeg's."""
    av = pyav()
    # Bit-exact: without versions and random numbers in the file.
    try:
        with av.open(str(path), "w", options={"fflags": "+bitexact"}) as file:
            stream = file.add_stream(codec, rate=rate_of(fps), options=dict(options))
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
            stream.codec_context.thread_count = 1  # videos are encoded side by side
            for image in frames:
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            file.mux(stream.encode(None))
    except av.FFmpegError as error:  # of which some are an OSError, and some are not
        raise OSError(error.errno, error.strerror, str(path)) from error


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


def check_size(name: str, size: tuple[int, int]) -> None:
    """Returns nothing; raises ConfigError where colours cannot be stored at half the frame's resolution."""
    for side, pixels in zip(("height", "width"), size, strict=True):
        if pixels % 2:
            raise ConfigError(f"video.{side} is {pixels}, but must be even for {name}: choose ffv1, npz or webdataset")


def check_rate(name: str, fps: float, fastest: float) -> None:
    """Returns nothing; raises ConfigError for a frame rate that a format cannot store."""
    if not SLOWEST <= fps <= fastest:
        raise ConfigError(
            f"video.fps is {fps:g}, but must be from {SLOWEST:g} to {fastest:g} for {name}: choose npz or webdataset"
        )
