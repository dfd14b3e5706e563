"""Normals of surfaces as 8-bit RGB: images/KEY-0000.png and normals/KEY-0000.png.

Red is the component to the right, green up, blue towards the viewer, 255 (n + 1) / 2 each, as in OpenGL's normal maps:
128 128 255 faces the viewer.
"""

from pathlib import Path

import numpy as np

from gen2d.plugin import Export, Source, arrays

ONE = 127  # of a stored component


def write(target: Path, source: Source) -> None:
    """Write images and normals to the folder."""
    arrays.write_images(target, source, "normals", "surface/normal", _colors)


def _colors(normal: np.ndarray) -> np.ndarray:
    return np.round(255 * (normal / ONE + 1) / 2).astype(np.uint8)


EXPORT = Export(
    fields=("frames", "surface/normal"),
    write=write,
    separate=True,
    fixed=True,
    loss="frames and normals alone, rounded to 2/255",
)
