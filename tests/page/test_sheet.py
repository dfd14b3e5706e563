"""The contact sheet names its videos, whole matched sets where they fit, and shows stored annotations."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from test_page import pictures

from gen2d.core.schema import Field
from gen2d.dataset.manifest import read_manifest
from gen2d.media.overlays import masks_overlay
from gen2d.page.sheet import LABEL, dataset_sheet, first_videos, video_label
from gen2d.page.video import Detail, Videos

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


def test_surfaces_are_on_a_sheet_and_on_the_page(tmp_path: Path) -> None:
    """Heights in parts of the largest one, of the page shadows too, and normals as a normal map."""
    fields = {
        "surface/height": Field("float16", "n T H W", "m", "a height"),
        "surface/normal": Field("int8", "n T H W 3", "1/127", "a normal"),
        "surface/shadow": Field("uint8", "n T H W", "1/255", "an opacity"),
    }
    made = synthetic.make(synthetic.dataset(tmp_path, fields={**synthetic.FIELDS, **fields}))
    sheet = dataset_sheet(tmp_path, read_manifest(tmp_path), "train", range(1))
    side = 8 * 12 + 4
    assert sheet.shape[0] == (1 + 2 + 3) * side + 8  # frames; masks and flow; depth, normals and shadow
    video, last = synthetic.video(made, "train", 0), slice(LABEL + 4 * side + 2, LABEL + 5 * side - 2)
    tiles = [sheet[8 + row * side + 2 : 8 + (row + 1) * side - 2, last][::12, ::12].astype(float) for row in (3, 4, 5)]
    for tile, name in ((tiles[0], "surface/height"), (tiles[2], "surface/shadow")):
        values = video[name].astype(float)
        expected = 255 * values[4] / (values.max() if name == "surface/height" else 255)
        assert abs(tile - expected[..., None]).max() <= 1
    assert abs(tiles[1] - (video["surface/normal"][4] + 128.0)).max() == 0
    page = Videos(tmp_path, read_manifest(tmp_path), "train").video(0, Detail(5, 64, 64, None, 9, 9))
    for name, field in (("depth", "surface/height"), ("shadow", "surface/shadow")):
        values = video[field].astype(float)
        assert abs(pictures(page[name], 5) - (255 * values / values.max())[..., None]).max() <= 1
    assert_array_equal(pictures(page["normals"], 5), video["surface/normal"].astype(int) + 128)


def test_numbers_that_are_not_finite_are_drawn(tmp_path: Path) -> None:
    boxes = {f"boxes/{kind}": Field("float32", "n T K 4", "px", "a box") for kind in ("visible", "amodal")}
    video = synthetic.video
    with pytest.MonkeyPatch.context() as patch:
        wild = np.full((5, 3, 4), [np.nan, -np.inf, np.inf, 1e30], np.float32)
        patch.setattr(synthetic, "video", lambda *which: video(*which) | dict.fromkeys(boxes, wild))
        synthetic.make(synthetic.dataset(tmp_path, fields={**synthetic.FIELDS, **boxes}))
    assert dataset_sheet(tmp_path, read_manifest(tmp_path), "train", range(1)).any()
