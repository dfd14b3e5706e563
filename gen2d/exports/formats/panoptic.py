"""COCO panoptic segmentation of every frame: images/KEY-0000.png, panoptic/KEY-0000.png and panoptic.json.

A pixel's segment is R + 256 G + 65536 B: slot + 1 for an object, 255 for an occluder, 256 for the background. No pixel
is void (0).
"""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from gen2d.plugin import Export, Source, arrays, facts, images

OCCLUDER, BACKGROUND = 255, 256
STUFF = ("background", "occluder")
CLASSES = (*facts.CLASSES, *STUFF)


def write(target: Path, source: Source) -> None:
    """Write images and segments to the folder, and notes with their entries."""
    for name in ("images", "panoptic"):
        (target / name).mkdir()
    height, width = source.frame_size
    size = SimpleNamespace(fps=source.fps, height=height, width=width)
    first = source.places.start
    with (
        (source.notes / f"images-{first:09d}").open("w") as image_notes,
        (source.notes / f"annotations-{first:09d}").open("w") as annotations,
    ):
        for place, number, video in zip(source.places, source.numbers, source.videos(), strict=True):
            nouns = facts.VideoFacts(video | dict(source.ds.manifest.constants), size).nouns
            for frame, mask in enumerate(video["masks/instance"]):
                image_id = place * source.sizes["T"] + frame + 1
                name = f"{source.key(number)}-{frame:04d}.png"
                segments = np.where(mask == 0, BACKGROUND, mask.astype(np.int32))
                (target / "images" / name).write_bytes(images.png(video["frames"][frame]))
                channels = np.stack([segments & 255, segments >> 8, 0 * segments], -1).astype(np.uint8)
                (target / "panoptic" / name).write_bytes(images.png(channels))
                infos = [_segment(segments == i, int(i), nouns) for i in np.unique(segments)]
                image = {"id": image_id, "file_name": name, "height": height, "width": width, "video_id": number}
                image_notes.write(json.dumps(image) + "\n")
                annotation = {"image_id": image_id, "file_name": name, "segments_info": infos}
                annotations.write(json.dumps(annotation) + "\n")
            source.advance(1)


def finish(target: Path, source: Source) -> None:
    """Write the description from the notes of all parts."""
    categories = [{"id": i, "name": name, "isthing": int(name not in STUFF)} for i, name in enumerate(CLASSES, 1)]
    with (target / "panoptic.json").open("w", newline="\n") as file:
        file.write(f'{{"categories": {json.dumps(categories)},\n"images": [\n')
        file.writelines(",\n" * (i > 1) + entry for i, entry in arrays.notes(source, "images"))
        file.write('\n],\n"annotations": [\n')
        file.writelines(",\n" * (i > 1) + entry for i, entry in arrays.notes(source, "annotations"))
        file.write("\n]}\n")


def _segment(shown: np.ndarray, number: int, nouns: dict[int, str]) -> dict:
    """Entry of a segment, whose pixels are `shown` [H, W]."""
    names = {BACKGROUND: "background", OCCLUDER: "occluder"}
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    x, y = int(columns[0]), int(rows[0])
    box = [x, y, int(columns[-1]) + 1 - x, int(rows[-1]) + 1 - y]
    category = CLASSES.index(names.get(number) or nouns[number - 1]) + 1
    return {"id": number, "category_id": category, "area": int(shown.sum()), "bbox": box, "iscrowd": 0}


EXPORT = Export(
    fields=("frames", "masks/instance", "objects/*", "states/*", "camera/*", "world/*"),
    write=write,
    separate=True,
    finish=finish,
    fixed=True,
    loss="frames and visible masks alone",
)
