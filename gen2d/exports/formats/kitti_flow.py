"""Optical flow as in KITTI: image_2/KEY_0000.png, and flow_noc/KEY_0000.png for all frames but the last.

A flow image has 16 bits a channel: 64 dx + 32768, 64 dy + 32768 and whether the flow is valid. It is valid where it
ends in the next frame at a pixel of the same object (KITTI's non-occluded pixels), if it is less than 512 px.
"""

from pathlib import Path

import numpy as np

from gen2d.plugin import Batch, Export, Source, images

SCALE, ZERO, LARGEST = 64, 32768, 65535


def write(target: Path, source: Source) -> None:
    """Write images and flow to the folder."""
    for name in ("image_2", "flow_noc"):
        (target / name).mkdir()

    def write_video(key: str, video: Batch) -> None:
        for frame, image in enumerate(video["frames"]):
            (target / "image_2" / f"{key}_{frame:04d}.png").write_bytes(images.png(image))
        for frame, flow in enumerate(video["flow/forward"][:-1].astype(np.float64)):
            coded = np.round(SCALE * flow) + ZERO
            valid = (video["flow/forward_valid"][frame] > 0) & ((coded >= 0) & (coded <= LARGEST)).all(-1)
            channels = np.where(valid[..., None], coded, 0)
            image = np.concatenate([channels, valid[..., None]], -1).astype(np.uint16)
            (target / "flow_noc" / f"{key}_{frame:04d}.png").write_bytes(images.png(image))

    source.each(write_video)


EXPORT = Export(
    fields=("frames", "flow/forward", "flow/forward_valid"),
    write=write,
    separate=True,
    fixed=True,
    loss="frames and forward flow alone, rounded to 1/64 px",
)
