"""What a dataset says about itself is true, and its examples run."""

import json
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from packages import package, require

from gen2d.dataset.manifest import read_manifest
from gen2d.media import contact_sheet
from gen2d.page.sheet import LABEL
from gen2d.storage import codecs
from gen2d.storage.sealed import file_sha256
from gen2d.tools.verify import verify


def test_the_cards_name_every_field_and_file(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path))
    readme = (tmp_path / "README.md").read_text()
    assert all(f"| {name} | {field.dtype} | {field.axes} |" in readme for name, field in made.fields.items())
    assert all(word in readme for word in (made.command, made.licence, made.conventions))
    croissant = json.loads((tmp_path / "croissant.json").read_text())
    manifest, files = croissant["distribution"]
    assert manifest["sha256"] == file_sha256(tmp_path / manifest["contentUrl"])
    assert manifest["contentSize"] == f"{(tmp_path / manifest['contentUrl']).stat().st_size} B"
    assert len(list(tmp_path.glob(files["includes"]))) == 4


def test_the_sheet_shows_the_first_videos_and_is_verified(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path))
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    rows = np.split(sheet[:400, LABEL:, ::-1], 4)
    for number, row in enumerate(rows):
        frames = np.split(row, made.sizes["T"], axis=1)
        for frame, stored in zip(frames, synthetic.video(made, "train", number)["frames"], strict=True):
            assert_array_equal(frame[2:-2, 2:-2][::12, ::12], stored)
    (tmp_path / "sheet.png").unlink()
    assert verify(tmp_path) == [f"{tmp_path / 'sheet.png'} is missing"]


def test_without_frames_there_is_no_sheet(tmp_path: Path) -> None:
    fields = {name: field for name, field in synthetic.FIELDS.items() if name != "frames"}
    synthetic.make(synthetic.dataset(tmp_path, fields=fields))
    assert not (tmp_path / "sheet.png").exists()
    assert "sheet.png" not in (tmp_path / "README.md").read_text()
    assert verify(tmp_path, "full") == []


def test_a_large_frame_is_made_smaller_on_the_sheet() -> None:
    video = np.random.default_rng(0).integers(0, 256, (30, 300, 400, 3), np.uint8)
    found = contact_sheet.downsample(video)
    assert found.shape == (10, 100, 133, 3)
    assert abs(found.mean() - video[contact_sheet.sheet_frames(30)].mean()) < 1


def test_the_readme_tells_the_statistics(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path))
    readme = (tmp_path / "README.md").read_text()
    for split, fields in read_manifest(tmp_path).stats.items():
        for name, about in fields.items():
            mean = about["mean"]
            assert mean is not None
            assert f"| {split} | {name} | {', '.join(f'{x:.4g}' for x in mean)} |" in readme


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # the validator's own
def test_croissant_is_valid_and_lists_the_tables(tmp_path: Path) -> None:
    mlcroissant = package("mlcroissant")
    synthetic.make(synthetic.dataset(tmp_path))
    described = mlcroissant.Dataset(jsonld=str(tmp_path / "croissant.json"))
    assert not described.metadata.ctx.issues.errors
    rows = [{key.split("/")[1]: value for key, value in row.items()} for row in described.records("tables")]
    expected = read_manifest(tmp_path).tables.values()
    assert [(row["file"].decode(), row["shards"], row["bytes"]) for row in rows] == [
        (table.file, table.shards, table.bytes) for table in expected
    ]


@pytest.mark.parametrize("codec", codecs.CODECS)
@pytest.mark.parametrize("example", ["gen2d", "gen2d, torch", "gen2d, jax", "h5py"])
def test_the_examples_of_the_card_run(tmp_path: Path, example: str, codec: str) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path / "copied elsewhere", codec=codec))
    root = synthetic.folder(made)
    blocks = re.findall(r"```python\n(.*?)```", (root / "README.md").read_text(), re.S)
    plugin = ", hdf5plugin" if codec == "zstd" and example == "h5py" else ""
    (code,) = (block for block in blocks if f"import {example}{plugin}\n" in block)
    require(*re.findall(r"import (.*)", code)[0].split(", "))
    batch = "numpy.asarray(batch['frames'])"
    shown = {"gen2d, torch": batch, "gen2d, jax": batch, "gen2d": 'video["frames"]', "h5py": "video"}[example]
    code += f"\nimport numpy\nnumpy.save('shown.npy', {shown})"
    # In a process of its own: where hdf5plugin is imported, HDF5 writes the filter's name into new zstd files.
    subprocess.run([sys.executable, "-c", code], cwd=root, check=True)
    found = np.load(root / "shown.npy")
    if "," in example:
        assert found.shape == (20, 5, 8, 8, 3)
    else:
        assert_array_equal(found, synthetic.video(made, "train", 0)["frames"])
