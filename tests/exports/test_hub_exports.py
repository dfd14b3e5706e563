"""Parquet files and folders of films hold what the dataset holds, as Hugging Face's `datasets` reads them."""

import io
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from packages import package
from ruamel.yaml import YAML

import gen2d
from gen2d.core.errors import UserError

datasets = package("datasets")
TRAIN = 5
SIZES = {"T": 6, "H": 64, "W": 48, "K": 3}


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = synthetic.dataset(tmp_path_factory.mktemp("data") / "toy", TRAIN, sizes=SIZES)
    return synthetic.folder(synthetic.make(made))


def film(content: bytes) -> np.ndarray:
    """Frames [T, H, W, 3] of an encoded film."""
    with av.open(io.BytesIO(content), "r") as file:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])


def load(root: Path, cache: Path, streaming: bool, column: str, **how: Any) -> list[dict[str, Any]]:
    """Rows, whose films are not decoded, as that needs torchcodec."""
    found = datasets.load_dataset(**how, split="train", streaming=streaming, cache_dir=str(cache))
    assert isinstance(found.features[column], datasets.Video)
    return list(found.cast_column(column, datasets.Video(decode=False)))


def check(row: dict[str, Any], stored: dict[str, np.ndarray], number: int) -> None:
    """Each column but films is the stored field."""
    assert_array_equal(row["time"], np.arange(6) / 10)
    for name, values in stored.items():
        if name in row and name != "frames":
            found = np.asarray(row[name])
            assert_array_equal(found.astype(values.dtype), values[number])


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize("by", ["files", "folder"])
def test_parquet_has_every_field(toy: Path, tmp_path: Path, streaming: bool, by: str) -> None:
    out, stored = gen2d.export(toy, "parquet", tmp_path / "out", codec="ffv1").out, synthetic.stored(toy)
    files = {"path": "parquet", "data_files": [str(path) for path in sorted(out.glob("*.parquet"))]}
    how: dict[str, Any] = files if by == "files" else {"path": str(out)}
    rows = load(out, tmp_path / "cache", streaming, "frames", **how)
    assert len(rows) == TRAIN
    assert rows[0].keys() == {*stored, "time"}
    for number, row in enumerate(rows):
        check(row, stored, number)
        assert_array_equal(film(row["frames"]["bytes"]), stored["frames"][number])


def test_parquet_declares_arrays_units_and_images(toy: Path, tmp_path: Path) -> None:
    out, stored = gen2d.export(toy, "parquet", tmp_path / "out", codec="png").out, synthetic.stored(toy)
    (path,) = out.glob("*.parquet")
    found = datasets.load_dataset("parquet", data_files=str(path), split="train", cache_dir=str(tmp_path / "cache"))
    assert found.features["states/position"] == datasets.Array3D((6, 3, 2), "float32")
    assert found.features["flow/forward"] == datasets.Array4D((6, 64, 48, 2), "float16")
    for number, row in enumerate(found):
        assert_array_equal(np.stack([np.asarray(image) for image in row["frames"]]), stored["frames"][number])
    table = package("pyarrow.parquet").read_table(path, memory_map=False)
    about = table.schema.field("states/position").metadata
    assert (about[b"unit"], about[b"axes"]) == (b"m", b"n T K 2")
    image = cv2.imdecode(np.frombuffer(table["frames"][1][2]["bytes"].as_py(), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert_array_equal(image[..., ::-1], stored["frames"][1][2])


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize("by", ["videofolder", "folder"])
def test_a_folder_of_films_has_a_table_of_the_other_fields(toy: Path, tmp_path: Path, streaming: bool, by: str) -> None:
    out, stored = gen2d.export(toy, "videofolder", tmp_path / "out", codec="mp4v").out, synthetic.stored(toy)
    how = {"path": "videofolder", "data_dir": str(out)} if by == "videofolder" else {"path": str(out)}
    rows = load(out, tmp_path / "cache", streaming, "video", **how)
    images = {"frames", "masks/instance", "flow/forward"}
    assert rows[0].keys() == {"video", "time", *stored} - images
    for row in rows:
        number = row["index"]
        check(row, stored, number)
        assert Path(row["video"]["path"]).name == f"train-{number:09d}.mp4"
        frames = film(Path(row["video"]["path"]).read_bytes())
        assert np.abs(frames.astype(float) - stored["frames"][number]).mean() < 20
    assert sorted(row["index"] for row in rows) == list(range(TRAIN))


@pytest.mark.parametrize("to", ["parquet", "videofolder"])
def test_the_card_of_an_export_has_the_hub_s_metadata(toy: Path, tmp_path: Path, to: str) -> None:
    out = gen2d.export(toy, to, tmp_path / "out", split="test", codec="mp4v", select="index < 2").out
    text = (out / "README.md").read_text().split("---\n")
    about = YAML(typ="safe").load(text[1])
    assert (about["pretty_name"], about["license"], about["size_categories"]) == ("toy", "cc0-1.0", ["n<1K"])
    (files,) = about["configs"][0]["data_files"]
    assert files["split"] == "test"
    found = datasets.load_dataset(str(out), cache_dir=str(tmp_path / "cache"))
    assert {split: len(rows) for split, rows in found.items()} == {"test": 2}


@pytest.mark.parametrize("to", ["parquet", "videofolder"])
def test_without_arrow_the_extra_is_named(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to: str) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(UserError, match=r"pip install 'gen2d\[hub\]'"):
        gen2d.export(toy, to, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.filterwarnings("ignore:Exception ignored in:pytest.PytestUnraisableExceptionWarning")  # it closes no file
def test_webdataset_reads_tars(toy: Path, tmp_path: Path) -> None:
    webdataset = package("webdataset")
    out, stored = gen2d.export(toy, "webdataset", tmp_path / "out").out, synthetic.stored(toy)
    tars = [str(path) for path in out.glob("*.tar")]
    found = list(webdataset.WebDataset(tars, shardshuffle=False).decode())
    assert [sample["json"]["number"] for sample in found] == list(range(TRAIN))
    for number, sample in enumerate(found):
        check(dict(sample["npz"]) | {"time": np.arange(6) / 10}, stored, number)
        assert film(sample["mp4"]).shape == stored["frames"][number].shape
