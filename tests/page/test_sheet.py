"""The contact sheet names its videos, whole matched sets where they fit, and shows stored annotations."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal

from gen2d.core.schema import Field
from gen2d.dataset.manifest import read_manifest
from gen2d.media.overlays import masks_overlay
from gen2d.page.sheet import LABEL, dataset_sheet, first_videos, video_label

MATCHED = {
    "matched/kind": Field("uint8", "n", "1", "code of the change: 1 teleport, 2 identity_swap"),
    "matched/member": Field("uint8", "n", "1", "number of the video in its set; 0: the original"),
    "matched/onset": Field("int32", "n", "1", "first frame that differs from the original; -1: none"),
    "matched/set": Field("int32", "n", "1", "number of the set"),
}


@pytest.mark.parametrize(
    ("member", "kind", "onset", "lines"),
    [
        (0, 2, -1, ["train 4", "original"]),
        (1, 2, 7, ["train 4", "identity swap", "frame 7"]),
        (2, 1, -1, ["train 4", "teleport"]),
        (1, 9, 3, ["train 4", "changed", "frame 3"]),
    ],
)
def test_the_videos_of_a_set_are_named(member: int, kind: int, onset: int, lines: list[str]) -> None:
    video: dict[str, np.ndarray] = {"matched/member": np.array(member), "matched/kind": np.array(kind)}
    video["matched/onset"] = np.array(onset)
    assert video_label("train", 4, video, MATCHED) == lines
    assert video_label("train", 4, {}, MATCHED) == lines[:1]


def test_whole_sets_are_on_a_sheet(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path))
    manifest = read_manifest(tmp_path)
    fields = {**manifest.fields, **MATCHED}
    for members, count in ((1, 4), (2, 4), (3, 3), (5, 4)):
        matched = dataclasses.replace(manifest, fields=fields, config={"matched": {"members": members}})
        assert first_videos(matched, "train", 4) == range(count)
    assert first_videos(manifest, "test", 4) == range(3)


def test_a_sheet_ends_with_the_annotations_of_the_first_video(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path))
    sheet = dataset_sheet(tmp_path, read_manifest(tmp_path), "train", range(2))
    side = 8 * 12 + 4  # a frame, enlarged, with its border
    assert sheet.shape == (4 * side + 8, LABEL + 5 * side, 3)
    video = synthetic.video(made, "train", 0)
    for t in range(5):
        tile = sheet[2 * side + 8 : 3 * side + 8, LABEL + t * side : LABEL + (t + 1) * side]
        expected = masks_overlay({"masks/instance": video["masks/instance"][t]})
        assert_array_equal(tile[2:-2, 2:-2][::12, ::12], expected)
    assert (sheet[:side, :LABEL] < 128).any()  # a name


def test_numbers_that_are_not_finite_are_drawn(tmp_path: Path) -> None:
    boxes = {f"boxes/{kind}": Field("float32", "n T K 4", "px", "a box") for kind in ("visible", "amodal")}
    video = synthetic.video
    with pytest.MonkeyPatch.context() as patch:
        wild = np.full((5, 3, 4), [np.nan, -np.inf, np.inf, 1e30], np.float32)
        patch.setattr(synthetic, "video", lambda *which: video(*which) | dict.fromkeys(boxes, wild))
        synthetic.make(synthetic.dataset(tmp_path, fields={**synthetic.FIELDS, **boxes}))
    assert dataset_sheet(tmp_path, read_manifest(tmp_path), "train", range(1)).any()
