"""COCO panoptic segmentation of every frame: images/KEY-0000.png, panoptic/KEY-0000.png and panoptic.json.

A pixel's segment is R + 256 G + 65536 B: slot + 1 for an object, 255 for an occluder, 256 for the background. No pixel
is void (0).
"""

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np

from gen2d.plugin import Export, Source, facts

OCCLUDER, BACKGROUND = 255, 256
STUFF = ("background", "occluder")
CLASSES = (*facts.CLASSES, *STUFF)


def write(target: Path, source: Source) -> None:
    """Write images, segments and their description to the folder."""
    for name in ("images", "panoptic"):
        (target / name).mkdir()
    height, width = source.frame_size
    size = SimpleNamespace(fps=source.fps, height=height, width=width)
    images, annotations = target / ".images", target / ".annotations"
    with images.open("w") as image_lines, annotations.open("w") as annotation_lines:
        count = 0
        for number, video in zip(source.numbers, source.videos(), strict=True):
            nouns = facts.VideoFacts(video | dict(source.ds.manifest.constants), size).nouns
            for frame, mask in enumerate(video["masks/instance"]):
                count += 1
                name = f"{source.key(number)}-{frame:04d}.png"
                segments = np.where(mask == 0, BACKGROUND, mask.astype(np.int32))
                _write_png(target / "images" / name, video["frames"][frame])
                _write_png(target / "panoptic" / name, np.stack([segments & 255, segments >> 8, 0 * segments], -1))
                infos = [_segment(segments == i, int(i), nouns) for i in np.unique(segments)]
                image = {"id": count, "file_name": name, "height": height, "width": width, "video_id": number}
                comma = ",\n" if count > 1 else ""
                image_lines.write(comma + json.dumps(image))
                annotation = {"image_id": count, "file_name": name, "segments_info": infos}
                annotation_lines.write(comma + json.dumps(annotation))
            source.advance(1)
    categories = [{"id": i, "name": name, "isthing": int(name not in STUFF)} for i, name in enumerate(CLASSES, 1)]
    with (target / "panoptic.json").open("w", newline="\n") as file:
        file.write(f'{{"categories": {json.dumps(categories)},\n"images": [\n')
        with images.open() as lines:
            file.writelines(lines)
        file.write('\n],\n"annotations": [\n')
        with annotations.open() as lines:
            file.writelines(lines)
        file.write("\n]}\n")
    images.unlink()
    annotations.unlink()


def _segment(shown: np.ndarray, number: int, nouns: dict[int, str]) -> dict:
    """Entry of a segment, whose pixels are `shown` [H, W]."""
    names = {BACKGROUND: "background", OCCLUDER: "occluder"}
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    x, y = int(columns[0]), int(rows[0])
    box = [x, y, int(columns[-1]) + 1 - x, int(rows[-1]) + 1 - y]
    category = CLASSES.index(names.get(number) or nouns[number - 1]) + 1
    return {"id": number, "category_id": category, "area": int(shown.sum()), "bbox": box, "iscrowd": 0}


def _write_png(path: Path, image: np.ndarray) -> None:
    if not cv2.imwrite(str(path), image[..., ::-1].astype(np.uint8)):
        raise OSError(f"{path}: OpenCV could not write an image")


EXPORT = Export(
    fields=("frames", "masks/instance", "objects/*", "states/*", "camera/*", "world/*"),
    write=write,
    fixed=True,
    loss="frames and visible masks alone",
)
