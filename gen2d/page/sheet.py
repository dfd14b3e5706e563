"""The contact sheet of a dataset: its first videos with their names, and the annotations of the first one."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from gen2d.core.schema import Field
from gen2d.dataset.manifest import Manifest
from gen2d.loading.dataset import Dataset, ViewOptions
from gen2d.media import overlays
from gen2d.media.contact_sheet import add_border, downsample, sheet_frames
from gen2d.media.drawing import label
from gen2d.page.page import members_of
from gen2d.storage.paths import Place

LABEL = 118  # px, width of the names
BETWEEN = 8  # px, between matched sets, and before the annotations
CHANGED = ("matched/member", "matched/kind", "matched/onset")

# What is drawn of each annotation, and the fields that it needs beside the frames.
Overlay = Callable[[Mapping[str, np.ndarray]], np.ndarray]
ANNOTATIONS: Mapping[str, tuple[Overlay, Mapping[str, str]]] = {
    "masks": (overlays.masks_overlay, {"masks/instance": "n T H W"}),
    "boxes": (overlays.boxes_overlay, {"boxes/visible": "n T K 4", "boxes/amodal": "n T K 4"}),
    "flow": (overlays.flow_overlay, {"flow/forward": "n T H W 2"}),
    "depth": (overlays.height_overlay, {"surface/height": "n T H W"}),
    "normals": (overlays.normals_overlay, {"surface/normal": "n T H W 3"}),
    "shadow": (overlays.shadow_overlay, {"surface/shadow": "n T H W"}),
}


def first_videos(manifest: Manifest, split: str, most: int) -> range:
    """Numbers of the first videos of a split, whole matched sets if one fits."""
    members = members_of(manifest)
    count = min(most, manifest.splits[split])
    return range(count // members * members or count)


def dataset_sheet(root: Place, manifest: Manifest, split: str, numbers: Sequence[int]) -> np.ndarray:
    """Contact sheet [H, W, 3], uint8, of these videos with stored frames; raises the errors of `Dataset.batch`.

    Time runs from left to right. Only one video is in memory at a time: they may be long and large.
    """
    fields = manifest.fields
    stored = {name: own for name, (_, own) in ANNOTATIONS.items() if _stores(own, fields)}
    names = [name for name in CHANGED if name in fields]
    rows: list[np.ndarray] = []
    annotated: list[np.ndarray] = []
    for place, number in enumerate(numbers):
        own = {name for needed in stored.values() for name in needed} if not place else set()
        options = ViewOptions(split, ("frames", *names, *sorted(own)), None, 1, "first", "THWC", "uint8", "checksum")
        video = Dataset(root, manifest, options)[number]
        if place and not number % members_of(manifest) and members_of(manifest) > 1:
            rows.append(_gap(rows[0]))
        rows.append(labelled(video_label(split, number, video, fields), downsample(video["frames"])))
        if not place:
            annotated = [labelled([name], frames) for name, frames in _annotated(video, stored)]
    return np.concatenate([*rows, *([_gap(rows[0]), *annotated] if annotated else [])])


def labelled(lines: Sequence[str], frames: np.ndarray) -> np.ndarray:
    """A row of frames [T, H, W, 3] with lines of text at the left."""
    row = np.concatenate([add_border(frame) for frame in frames], axis=1)
    return np.concatenate([label(lines, len(row), LABEL), row], axis=1)


def video_label(split: str, number: int, video: Mapping[str, np.ndarray], fields: Mapping[str, Field]) -> list[str]:
    """Lines that name a video: its split and number and, in a matched set, what differs from when on."""
    lines = [f"{split[:12]} {number}"]
    if any(name not in video for name in CHANGED):
        return lines
    if int(video["matched/member"]) == 0:
        return [*lines, "original"]
    kinds = dict(re.findall(r"(\d+) (\w+)", fields["matched/kind"].meaning))
    kind = kinds.get(str(int(video["matched/kind"])), "changed").replace("_", " ")
    onset = int(video["matched/onset"])
    return [*lines, kind[:14], *([f"frame {onset}"] if onset >= 0 else [])]


def _gap(row: np.ndarray) -> np.ndarray:
    return np.full((BETWEEN, row.shape[1], 3), 255, np.uint8)


def _stores(needed: Mapping[str, str], fields: Mapping[str, Field]) -> bool:
    """Whether a dataset stores these fields as gen2d does; a plug-in may store others under their names."""
    own = [fields.get(name) for name in needed]
    return all(
        field is not None and field.axes == axes and not field.is_text and (name != "masks/instance" or _is_id(field))
        for field, (name, axes) in zip(own, needed.items(), strict=True)
    )


def _is_id(field: Field) -> bool:
    return field.dtype == "uint8"


def _annotated(
    video: Mapping[str, np.ndarray], stored: Mapping[str, Mapping[str, str]]
) -> Iterator[tuple[str, np.ndarray]]:
    """Name of each annotation, and frames [T, H, W, 3] of the sheet that show it."""
    times = sheet_frames(len(video["frames"]))
    for name, needed in stored.items():
        columns = {field: video[field][times] for field in ("frames", *needed)}
        for field in needed.keys() - {"masks/instance"}:  # a stranger's numbers may be any
            columns[field] = np.clip(np.nan_to_num(columns[field].astype(np.float32)), -1e4, 1e4)
        for field in {"flow/forward", "surface/height"} & columns.keys():  # in parts of the largest value
            columns[field] /= max(float(np.abs(columns[field]).max()), 1e-3)
        frames = [ANNOTATIONS[name][0]({field: own[t] for field, own in columns.items()}) for t in range(len(times))]
        yield name, downsample(np.stack(frames))
