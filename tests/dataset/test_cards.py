"""What a dataset says about itself is true, and its examples run."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from packages import package, require
from ruamel.yaml import YAML

from gen2d.dataset.hub import shard_patterns, size_category
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


def front_matter(root: Path) -> dict[str, Any]:
    """The metadata of the Hub in a dataset's card, by a parser of YAML."""
    text = (root / "README.md").read_text().split("---\n")
    assert text[0] == ""
    return YAML(typ="safe").load(text[1])


def test_the_card_begins_with_the_metadata_of_the_hub(tmp_path: Path) -> None:
    splits = {"train": 20, "train-00001": 17, "train_00001": 3, "ood.gravity": 8}
    made = synthetic.dataset(tmp_path, splits=splits, licence="CC-BY-4.0")
    synthetic.make(made)
    found = front_matter(tmp_path)
    assert (found["pretty_name"], found["license"]) == ("toy", "cc-by-4.0")
    assert found["task_categories"] == ["image-to-video", "time-series-forecasting", "image-segmentation"]
    assert found["size_categories"] == ["n<1K"]
    assert {"gen2d", "physics"} <= set(found["tags"])
    (config,) = found["configs"]
    named = {files["split"]: files["path"] for files in config["data_files"]}
    assert named.keys() == {"train", "train_00001", "train_00001_", "ood_gravity"}
    shards = {split: [path for pattern in paths for path in tmp_path.glob(pattern)] for split, paths in named.items()}
    counts = {split: len(paths) for split, paths in shards.items()}  # without those of splits that begin as this one
    assert counts == {"train": 3, "train_00001": 3, "train_00001_": 1, "ood_gravity": 1}
    assert {path for paths in shards.values() for path in paths} == {*(tmp_path / "shards").iterdir()}


@pytest.mark.parametrize(
    ("licence", "entries"),
    [
        ("", {}),
        ("MIT", {"license": "mit"}),
        ('Ask "me"', {"license": "other", "license_name": 'Ask "me"'}),
    ],
)
def test_the_licence_is_one_of_the_hub_s(tmp_path: Path, licence: str, entries: dict[str, str]) -> None:
    synthetic.make(synthetic.dataset(tmp_path, licence=licence))
    assert {key: value for key, value in front_matter(tmp_path).items() if key.startswith("license")} == entries


@pytest.mark.parametrize(
    ("videos", "word"),
    [(1, "n<1K"), (999, "n<1K"), (1000, "1K<n<10K"), (123_456, "100K<n<1M"), (10**6, "1M<n<10M"), (10**12, "n>1T")],
)
def test_the_size_is_in_the_hub_s_words(videos: int, word: str) -> None:
    assert size_category(videos) == word


def test_more_shards_than_five_digits_count_have_patterns_too(tmp_path: Path) -> None:
    manifest = read_manifest(synthetic.folder(synthetic.make(synthetic.dataset(tmp_path))))
    many = shard_patterns(dataclasses.replace(manifest, splits={"train": 8 * 100_001}))["train"]
    assert [pattern.count("[0-9]") for pattern in many] == [5, 6]


@pytest.mark.parametrize("streaming", [False, True])
def test_hugging_face_reads_shards_and_folders(tmp_path: Path, streaming: bool) -> None:
    datasets = package("datasets")
    made = synthetic.make(synthetic.dataset(tmp_path / "toy"))
    shards = [str(path) for path in sorted((tmp_path / "toy" / "shards").glob("train-*.h5"))]
    options = {"split": "train", "streaming": streaming, "cache_dir": str(tmp_path / "cache")}
    of_shards = datasets.load_dataset("hdf5", data_files=shards, **options)
    of_folder = datasets.load_dataset(str(tmp_path / "toy"), **options)
    for found in (of_shards, of_folder):
        rows = list(found)  # with_format("numpy") makes float32 of float64
        assert len(rows) == made.splits["train"]
        for number, row in enumerate(rows):
            for name, expected in (synthetic.video(made, "train", number) | dict(made.constants)).items():
                group, _, own = name.rpartition("/")
                value = np.asarray((row[group] if group else row)[own])
                assert_array_equal(value.astype(expected.dtype), expected)


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
@pytest.mark.parametrize("example", ["gen2d", "gen2d, torch", "gen2d, jax", "datasets, os", "h5py"])
def test_the_examples_of_the_card_run(tmp_path: Path, example: str, codec: str) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path / "copied elsewhere", codec=codec))
    root = synthetic.folder(made)
    blocks = re.findall(r"```python\n(.*?)```", (root / "README.md").read_text(), re.S)
    plugin = ", hdf5plugin" if codec == "zstd" and example in ("h5py", "datasets, os") else ""
    (code,) = (block for block in blocks if f"import {example}{plugin}\n" in block)
    require(*re.findall(r"import (.*)", code)[0].split(", "))
    batch = "numpy.asarray(batch['frames'])"
    shown = {"gen2d, torch": batch, "gen2d, jax": batch, "h5py": "video"}
    shown = shown.get(example, 'video["frames"]')
    code += f"\nimport numpy\nnumpy.save('shown.npy', {shown})"
    # In a process of its own: where hdf5plugin is imported, HDF5 writes the filter's name into new zstd files.
    subprocess.run([sys.executable, "-c", code], cwd=root, check=True, env=os.environ | {"HF_HOME": str(tmp_path)})
    found = np.load(root / "shown.npy")
    if "gen2d, " in example:
        assert found.shape == (20, 5, 8, 8, 3)
    else:
        assert_array_equal(found, synthetic.video(made, "train", 0)["frames"])
