"""Optical flow as Middlebury's .flo: KEY-0000.png and, for all frames but the last, KEY-0000.flo.

A .flo holds 'PIEH', the width and the height as int32, and dx right, dy down as float32, row by row. The flow is given
at all pixels, also at those that are hidden in the next frame.
"""

from pathlib import Path

import numpy as np

from gen2d.plugin import Batch, Export, Source, images


def write(target: Path, source: Source) -> None:
    """Write images and flow to the folder."""

    def write_video(key: str, video: Batch) -> None:
        for frame, image in enumerate(video["frames"]):
            (target / f"{key}-{frame:04d}.png").write_bytes(images.png(image))
        for frame, flow in enumerate(video["flow/forward"][:-1]):
            height, width = flow.shape[:2]
            head = b"PIEH" + np.array([width, height], "<i4").tobytes()
            (target / f"{key}-{frame:04d}.flo").write_bytes(head + flow.astype("<f4").tobytes())

    source.each(write_video)


EXPORT = Export(
    fields=("frames", "flow/forward"), write=write, separate=True, fixed=True, loss="frames and forward flow alone"
)
