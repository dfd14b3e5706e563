"""Shadows as 8-bit grey levels: images/KEY-0000.png and shadow/KEY-0000.png.

A level is the part of the pixel's color, in 1/255, that is the color of shadows.
"""

from pathlib import Path

import numpy as np

from gen2d.plugin import Export, Source, arrays


def write(target: Path, source: Source) -> None:
    """Write images and shadows to the folder."""
    arrays.write_images(target, source, "shadow", "surface/shadow", np.asarray)


EXPORT = Export(
    fields=("frames", "surface/shadow"),
    write=write,
    separate=True,
    fixed=True,
    loss="frames and shadows alone",
)
