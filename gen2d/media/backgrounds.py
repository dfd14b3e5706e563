"""Crops of the user's images, for backgrounds."""

import functools
import io
import warnings

import numpy as np
from PIL import Image

from gen2d.core.errors import ConfigError
from gen2d.storage.image_folder import image_file

FORMATS = ("PNG", "JPEG", "WEBP")
PIXELS, SIDE = 2**26, 2048  # of an image at most, and of what is kept of it
KEPT = 32  # decoded images, of 12 MiB at most each


def crops(
    digests: tuple[str, ...], index: np.ndarray, corner: np.ndarray, extent: np.ndarray, height: int, width: int
) -> np.ndarray:
    """Crops [n, H, W, 3] uint8 of images with these sha256.

    `index` [n] chooses the images. A crop has the shape of a frame and the part `extent` [n], above 0 and at most 1, of
    the largest size; `corner` [n, 2] is its place, from 0, at the left and the top, to 1. Raises ConfigError for an
    image that cannot be read.
    """
    pictures = np.empty((len(index), height, width, 3), np.uint8)
    for row in np.argsort(index, kind="stable"):  # each image is decoded once
        image = _decoded(digests[int(index[row])])
        scale = min(image.width / width, image.height / height) * float(extent[row])
        room = image.width - scale * width, image.height - scale * height
        left, top = (max(space, 0.0) * float(part) for space, part in zip(room, corner[row], strict=True))
        box = left, top, min(left + scale * width, image.width), min(top + scale * height, image.height)
        pictures[row] = np.asarray(image.resize((width, height), Image.Resampling.BILINEAR, box=box))
    return pictures


@functools.lru_cache(maxsize=KEPT)
def _decoded(digest: str) -> Image.Image:
    """The image with this sha256 in RGB, reduced to SIDE px a side at most."""
    path, content = image_file(digest)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content), formats=FORMATS) as image:
                if image.width * image.height > PIXELS:
                    raise ConfigError(f"{path}: has {image.width} x {image.height} px, but may have {PIXELS:,} in all")
                image.thumbnail((SIDE, SIDE))
                return image.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ConfigError(f"{path}: cannot be read as a {', '.join(FORMATS)} image ({error})") from None
