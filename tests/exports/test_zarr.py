"""Zarr groups hold what the dataset holds, as zarr itself and xarray read them."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from packages import package

import gen2d
from gen2d.core.errors import UserError
from gen2d.core.schema import Field
from gen2d.exports.formats import zarr as form

zarr = package("zarr")
SIZES = {"T": 6, "H": 16, "W": 12, "K": 3}
CODES = Field("uint8", "n K", "1", "kind of body: 0 dynamic, 1 static")
FIELDS = {**synthetic.FIELDS, "objects/kind": CODES, "text/caption": Field("S16", "n", "", "what happens")}
TRAIN, FRAMES = 11, 4  # of the split `test` four frames of six are read


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Text that is not ASCII, a field of codes, and a split with fewer frames than are stored."""
    config = {"scene": {"name": "toy"}, "fps": 10, "splits": {"train": {}, "test": {"frames": FRAMES}}}
    root = tmp_path_factory.mktemp("data") / "toy"
    video = synthetic.video
    with pytest.MonkeyPatch.context() as patch:
        text = "Bälle {} →"
        patch.setattr(
            synthetic, "video", lambda *of: {**video(*of), "text/caption": np.array(text.format(of[2]).encode())}
        )
        made = synthetic.make(synthetic.dataset(root, TRAIN, sizes=SIZES, fields=FIELDS, config=config))
    return synthetic.folder(made)


@pytest.fixture
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of 8 videos, so that arrays have whole and broken shards; those of frames hold two videos."""
    monkeypatch.setattr(form, "PART_VIDEOS", 8)
    monkeypatch.setattr(form, "SHARD_BYTES", 2 * 6 * 16 * 12 * 3)
    monkeypatch.setattr(form, "CHUNK_BYTES", 64)


def check(group, split: str, root: Path, numbers: range | list[int]) -> None:
    """Each field of the group is that of the dataset, with its type, to the bit."""
    ds = gen2d.open(root, split, fields="*")
    for name, values in ds.batch(numbers).items():
        found = group[name][:]
        if values.dtype.kind == "S":
            assert [text.encode() for text in found.tolist()] == values.tolist()
        else:
            assert (found.dtype, found.tobytes()) == (values.dtype, np.ascontiguousarray(values).tobytes()), name
    assert_array_equal(group["time"][:], ds.time)


@pytest.mark.usefixtures("small_shards")
@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("codec", ["zstd", "gzip"])
def test_zarr_reads_every_field_bit_by_bit(toy: Path, tmp_path: Path, split: str, codec: str) -> None:
    made = gen2d.export(toy, "zarr", tmp_path / "out", split=split, codec=codec)
    assert made.loss == ""
    group = zarr.open_group(made.out / f"{split}.zarr", mode="r")
    assert group.metadata.zarr_format == 3
    check(group, split, toy, range(made.videos))
    assert {name for name, _ in group.members(max_depth=None)} == {
        *FIELDS, "states", "objects", "masks", "flow", "quality", "text"
    }  # fmt: skip
    assert codec in json.dumps(json.loads((made.out / f"{split}.zarr/frames/zarr.json").read_text())["codecs"])


@pytest.mark.usefixtures("small_shards")
def test_chunks_are_sharded_and_a_video_is_read_alone(toy: Path, tmp_path: Path) -> None:
    group = zarr.open_group(gen2d.export(toy, "zarr", tmp_path / "out").out / "train.zarr", mode="r")
    assert (group["frames"].shards, group["frames"].chunks) == ((2, 6, 16, 12, 3), (1, 6, 16, 12, 3))
    assert (group["index"].shards, group["index"].chunks) == ((8,), (8,))
    files = [path for path in (tmp_path / "out/train.zarr/frames").rglob("*") if path.parent.name == "0"]
    assert sum(path.is_file() for path in files) == -(-TRAIN // 2)


def test_attributes_say_unit_axes_and_origin(toy: Path, tmp_path: Path) -> None:
    group = zarr.open_group(gen2d.export(toy, "zarr", tmp_path / "out").out / "train.zarr", mode="r")
    assert {key: group.attrs[key] for key in ("name", "seed", "fps", "split")} == {
        "name": "toy", "seed": 7, "fps": 10.0, "split": "train"
    }  # fmt: skip
    for name, field in FIELDS.items():
        about = group[name].attrs
        assert (about["unit"], about["axes"]) == (field.unit, field.axes) or name == "time"
        assert " ".join(group[name].metadata.dimension_names) == field.axes
    assert group["time"].attrs["unit"] == "s"
    assert group["objects/kind"].attrs["codes"] == {"0": "dynamic", "1": "static"}


@pytest.mark.usefixtures("small_shards")
def test_numbers_are_kept_where_videos_or_fields_are_chosen(toy: Path, tmp_path: Path) -> None:
    select = "index > 1 and index != 4"
    made = gen2d.export(toy, "zarr", tmp_path / "some", select=select)
    numbers = [n for n in range(TRAIN) if n > 1 and n != 4]
    check(zarr.open_group(made.out / "train.zarr", mode="r"), "train", toy, numbers)
    made = gen2d.export(toy, "zarr", tmp_path / "other", select=select, fields="objects/mass")
    group = zarr.open_group(made.out / "train.zarr", mode="r")
    assert group["index"][:].tolist() == numbers
    assert "frames" not in group


def test_xarray_reads_it_without_a_warning(toy: Path, tmp_path: Path) -> None:
    xarray = package("xarray")
    out = gen2d.export(toy, "zarr", tmp_path / "out").out / "train.zarr"
    tree, stored = xarray.open_datatree(out, engine="zarr"), gen2d.open(toy, fields="*")[:]
    position = tree["states/position"]
    assert position.dims == ("n", "T", "K", "2")
    assert position.attrs["unit"] == "m"
    assert_array_equal(position.values, stored["states/position"])
    assert tree["text/caption"].values[1] == "Bälle 1 →"
    assert_array_equal(xarray.open_zarr(out)["frames"].values, stored["frames"])


def test_a_missing_package_is_named(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(UserError, match=r"needs zarr 3: pip install 'gen2d\[zarr\]'"):
        gen2d.export(toy, "zarr", tmp_path / "out")
    assert not list(tmp_path.iterdir())
