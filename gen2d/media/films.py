"""Film files, encoded by PyAV, an optional dependency."""

import dataclasses
import os
import tempfile
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import numpy as np

from gen2d.core.errors import ConfigError, UserError

LOSS = "lossy: colours at half the resolution, and rounded"  # of YUV 4:2:0
SLOWEST = 0.1  # frames/s
FASTEST = 2**16 - 1  # frames/s; MPEG-4 stores 16 bits


@dataclasses.dataclass(frozen=True)
class Codec:
    """A way to encode frames as a film."""

    meaning: str
    suffix: str
    encoder: str  # FFmpeg's name
    fastest: float = FASTEST  # frames/s
    loss: str = LOSS  # what it does not preserve; "" if it preserves all
    pixels: str = "yuv420p"  # FFmpeg's name of the pixel format
    options: Mapping[str, str] = dataclasses.field(default_factory=dict[str, str])  # FFmpeg's

    def check(self, name: str, size: tuple[int, int], fps: float) -> None:
        """Raise ConfigError for unsupported frame sizes and rates, and UserError without PyAV."""
        if self.loss:
            check_size(name, size)
        check_rate(name, fps, self.fastest)
        pyav()

    def write(self, path: Path, frames: np.ndarray, fps: float) -> None:
        """Write frames [T, H, W, 3], uint8 RGB. Raises OSError, and UserError without PyAV."""
        encode(path, frames, fps, self.encoder, self.pixels, self.options)

    def content(self, frames: np.ndarray, fps: float) -> bytes:
        """Content of the film's file. Raises OSError, and UserError without PyAV."""
        with tempfile.TemporaryDirectory(prefix="gen2d-") as folder:
            path = Path(folder) / f"film{self.suffix}"
            self.write(path, frames, fps)
            return path.read_bytes()


def encode(path: Path, frames: np.ndarray, fps: float, codec: str, pixels: str, options: Mapping[str, str]) -> None:
    """Write frames [T, H, W, 3], uint8 RGB, with a codec of PyAV. Raises OSError, and UserError without PyAV.

    `codec`, `pixels` (the pixel format) and `options` are FFmpeg's.
    """
    av = pyav()
    # Bit-exact: no library versions or random numbers in the file.
    try:
        with av.open(str(path), "w", options={"fflags": "+bitexact"}) as file:
            stream = file.add_stream(codec, rate=rate_of(fps), options=dict(options))
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
            stream.codec_context.thread_count = 1  # several videos are encoded in parallel
            for image in frames:
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            file.mux(stream.encode(None))
    except av.FFmpegError as error:  # only some of these are an OSError
        raise OSError(error.errno, error.strerror, str(path)) from error


def pyav() -> ModuleType:
    """The module of PyAV; raises UserError if it is not installed."""
    os.environ.setdefault("SVT_LOG", "1")  # AV1's encoder prints errors only
    try:
        import av
    except ImportError:
        raise UserError("this format needs PyAV: pip install 'gen2d[video]'") from None
    return av


def rate_of(fps: float) -> Fraction:
    """Frame rate as a fraction of numbers of 16 bits, as MPEG-4 stores it, such as 30000/1001."""
    return Fraction(fps).limit_denominator(max(1, min(1001, int(FASTEST / fps))))


def check_size(name: str, size: tuple[int, int]) -> None:
    """Raise ConfigError for an odd height or width, at which colours cannot have half the resolution."""
    for side, pixels in zip(("height", "width"), size, strict=True):
        if pixels % 2:
            raise ConfigError(f"video.{side} is {pixels}, but must be even for {name}: choose ffv1 or npz")


def check_rate(name: str, fps: float, fastest: float) -> None:
    """Raise ConfigError for a frame rate that a format cannot store."""
    if not SLOWEST <= fps <= fastest:
        raise ConfigError(f"video.fps is {fps:g}, but must be from {SLOWEST:g} to {fastest:g} for {name}: choose npz")


CODECS = {
    "mp4v": Codec(
        "MPEG-4 part 2 by PyAV, for old programs; browsers do not play it",
        ".mp4",
        "mpeg4",
        options={"flags": "+bitexact", "qmin": "3", "qmax": "3"},  # the scale of quality is from 1 to 31
    ),
    # Flat discs need a better quality than camera images, for which the default crf of 23 is meant. With mbtree (x264
    # in PyAV 18) encoding is not reproducible: 1 in 5 videos of 64 px and 32 frames had other bytes in another run.
    "h264": Codec(
        "H.264 by PyAV, which browsers play",
        ".mp4",
        "libx264",
        options={"crf": "12", "x264-params": "no-mbtree=1", "movflags": "+faststart"},
    ),
    "av1": Codec(
        "AV1 by PyAV: smaller than H.264, but slower to encode",
        ".mp4",
        "libsvtav1",
        fastest=240,  # the maximum of this encoder
        options={"crf": "20", "preset": "8", "svtav1-params": "lp=1"},
    ),
    "ffv1": Codec(
        "FFV1 in Matroska by PyAV, lossless, with a checksum in every frame",
        ".mkv",
        "ffv1",
        fastest=1000,  # Matroska stores times in milliseconds
        loss="",
        pixels="bgr0",  # the stored bytes in another order; every YUV format would round them
        options={"level": "3", "coder": "1", "context": "1", "slicecrc": "1"},
    ),
}
