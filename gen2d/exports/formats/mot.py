"""MOTChallenge: a folder per video with img1/000001.png, gt/gt.txt and seqinfo.ini.

A line of gt.txt is frame, id, left, top, width, height, 1, 1, visibility: of each moving object of which something lies
in the frame. Frames, ids and pixels are counted from 1, so `left` is gen2d's x + 1; ids are slot + 1. Boxes are amodal,
and may reach beyond the image.
"""

from pathlib import Path

import numpy as np

from gen2d.plugin import STATIC, Batch, Export, Source, images


def write(target: Path, source: Source) -> None:
    """Write a folder for each video to the folder."""
    height, width = source.frame_size

    def write_video(key: str, video: Batch) -> None:
        folder = target / key
        for name in ("img1", "gt"):
            (folder / name).mkdir(parents=True)
        for frame, image in enumerate(video["frames"], 1):
            (folder / "img1" / f"{frame:06d}.png").write_bytes(images.png(image))
        info = {"name": key, "imDir": "img1", "frameRate": f"{source.fps:g}", "seqLength": len(video["frames"])}
        info |= {"imWidth": width, "imHeight": height, "imExt": ".png"}
        text = "[Sequence]\n" + "".join(f"{name}={value}\n" for name, value in info.items())
        (folder / "seqinfo.ini").write_text(text, newline="\n")
        (folder / "gt" / "gt.txt").write_text("".join(_lines(video, height, width)), newline="\n")

    source.each(write_video)


def _lines(video: Batch, height: int, width: int) -> list[str]:
    """Lines of gt.txt, by frame and object."""
    moving = np.flatnonzero(video["objects/present"] & (video["objects/kind"] != STATIC))
    lines = []
    for frame, boxes in enumerate(video["boxes/amodal"].astype(float)):
        for slot in moving.tolist():
            x0, y0, x1, y1 = boxes[slot].tolist()
            if x1 > 0 and y1 > 0 and x0 < width and y0 < height:
                box = f"{x0 + 1:.3f},{y0 + 1:.3f},{x1 - x0:.3f},{y1 - y0:.3f}"
                lines.append(f"{frame + 1},{slot + 1},{box},1,1,{video['visibility/fraction'][frame, slot]:.4f}\n")
    return lines


EXPORT = Export(
    fields=("frames", "boxes/amodal", "visibility/fraction", "objects/present", "objects/kind"),
    write=write,
    separate=True,
    fixed=True,
    loss="frames, boxes and visibility of moving objects alone",
)
