"""COCO instances of every frame: KEY-0000.png and one annotations.json, with run-length masks, boxes and keypoints.

An annotation is an object that is seen in a frame; its `track_id` is its slot + 1. `bbox` surrounds its visible pixels,
x y width height from the image's corner, as in gen2d. The keypoints are the centre, and the end of the object's own x
axis at its outline, which shows how it is turned; they are in COCO's coordinates, in which the first pixel's centre is
0 and not 0.5, and are visible (2) in pixels that show the object, hidden (1) elsewhere, and (0) outside the image.
"""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from gen2d.plugin import Batch, Export, Source, arrays, facts, images

SKELETON = [[1, 2]]
DESCRIPTION = "annotations.json"


def write(target: Path, source: Source) -> None:
    """Write the images to the folder, and notes with the entries of the annotations, but for their ids."""
    height, width = source.frame_size
    size = SimpleNamespace(fps=source.fps, height=height, width=width)
    first = source.places.start
    with (
        (source.notes / f"images-{first:09d}").open("w") as image_notes,
        (source.notes / f"annotations-{first:09d}").open("w") as annotations,
    ):
        for place, number, video in zip(source.places, source.numbers, source.videos(), strict=True):
            scene = facts.VideoFacts(video | dict(source.ds.manifest.constants), size)
            for frame, mask in enumerate(video["masks/instance"]):
                image_id, name = place * source.sizes["T"] + frame + 1, f"{source.key(number)}-{frame:04d}.png"
                (target / name).write_bytes(images.png(video["frames"][frame]))
                image = {"id": image_id, "file_name": name, "height": height, "width": width}
                image_notes.write(json.dumps(image | {"video_id": number, "frame_id": frame}) + "\n")
                for entry in _annotations(video, scene, mask, frame):
                    annotations.write(json.dumps({"image_id": image_id, **entry}) + "\n")
            source.advance(1)


def finish(target: Path, source: Source) -> None:
    """Write the file of annotations from the notes of all parts."""
    keypoints = {"keypoints": ["centre", "front"], "skeleton": SKELETON}
    categories = [{"id": i, "name": name, **keypoints} for i, name in enumerate(facts.CLASSES, 1)]
    info = {"description": source.ds.manifest.plain["name"], "version": "1.0"}
    with (target / DESCRIPTION).open("w", newline="\n") as file:
        file.write(f'{{"info": {json.dumps(info)},\n"categories": {json.dumps(categories)}')
        file.write(',\n"images": [')
        file.writelines("," * (i > 1) + f"\n{entry}" for i, entry in arrays.notes(source, "images"))
        file.write('],\n"annotations": [')
        entries = arrays.notes(source, "annotations")
        file.writelines("," * (i > 1) + f'\n{{"id": {i}, {entry[1:]}' for i, entry in entries)
        file.write("]}\n")


def _annotations(video: Batch, scene: Any, mask: np.ndarray, frame: int) -> list[dict[str, Any]]:
    """Annotations of the objects that a mask [H, W] shows."""
    found = []
    pixels = scene.pixels(frame)
    reach = scene.reach * float(video["camera/scale"][frame])
    turn = video["states/angle"][frame].astype(float) - float(video["camera/angle"][frame])
    fronts = pixels + reach[:, None] * np.stack([np.cos(turn), -np.sin(turn)], -1)
    for slot in np.unique(mask[(mask > 0) & (mask < 255)]).astype(int) - 1:
        shown = mask == slot + 1
        rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
        x, y = int(columns[0]), int(rows[0])
        points = [value for point in (pixels[slot], fronts[slot]) for value in _keypoint(point, shown)]
        found.append(
            {
                "category_id": facts.CLASSES.index(scene.nouns[slot]) + 1,
                "track_id": int(slot) + 1,
                "segmentation": {"size": [*mask.shape], "counts": run_lengths(shown)},
                "area": int(shown.sum()),
                "bbox": [x, y, int(columns[-1]) + 1 - x, int(rows[-1]) + 1 - y],
                "iscrowd": 0,
                "keypoints": points,
                "num_keypoints": sum(points[i] > 0 for i in (2, 5)),
            }
        )
    return found


def _keypoint(point: np.ndarray, shown: np.ndarray) -> list[float]:
    """COCO's x, y and visibility of a point in px."""
    column, row = np.floor(point).astype(int)
    if not (0 <= row < shown.shape[0] and 0 <= column < shown.shape[1]):
        return [0, 0, 0]
    x, y = np.round(point - 0.5, 3).tolist()
    return [x, y, 2 if shown[row, column] else 1]


def run_lengths(mask: np.ndarray) -> str:
    """COCO's compressed run-length code of a mask [H, W], column by column.

    Each length is a difference from the one before the last, in groups of five bits from the lowest on; the sixth bit
    says that more follow.
    """
    flat = np.concatenate([[0], mask.ravel(order="F").astype(np.int8), [1 - mask[-1, -1]]])
    ends = np.flatnonzero(np.diff(flat))
    lengths = np.diff(np.concatenate([[0], ends])).tolist()
    text = []
    for index, length in enumerate(lengths):
        value = length - lengths[index - 2] if index > 2 else length
        while True:
            bits, value = value & 31, value >> 5
            more = value != (-1 if bits & 16 else 0)
            text.append(chr((bits | 32 if more else bits) + 48))
            if not more:
                break
    return "".join(text)


def check(source: Source) -> None:
    """Raise ConfigError for frames with lens distortion."""
    arrays.check_undistorted(source, "coco")


EXPORT = Export(
    fields=("frames", "masks/instance", "objects/*", "states/*", "camera/*", "world/*"),
    write=write,
    check=check,
    separate=True,
    finish=finish,
    fixed=True,
    loss="frames, masks, boxes and keypoints alone",
)
