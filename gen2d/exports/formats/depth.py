"""Heights of surfaces as 16-bit grey levels: images/KEY-0000.png and depth/KEY-0000.png.

A level is .1 mm of height above the plane of motion, towards the viewer. The background and rims are 0.
"""

from pathlib import Path

import numpy as np

from gen2d.plugin import ConfigError, Export, Source, arrays

PER_METRE, LARGEST = 10_000, 65535


def write(target: Path, source: Source) -> None:
    """Write images and heights to the folder. Raises ConfigError if a surface is higher than 6.5535 m."""

    def encode(height: np.ndarray) -> np.ndarray:
        levels = np.round(PER_METRE * height.astype(np.float64))
        if levels.max(initial=0) > LARGEST:
            raise ConfigError(
                f"{source.ds.root}: a surface is {height.max():g} m high, but depth holds at most "
                f"{LARGEST / PER_METRE} m: choose npz"
            )
        return levels.astype(np.uint16)

    arrays.write_images(target, source, "depth", "surface/height", encode)


EXPORT = Export(
    fields=("frames", "surface/height"),
    write=write,
    separate=True,
    fixed=True,
    loss="frames and heights alone, rounded to .1 mm",
)
