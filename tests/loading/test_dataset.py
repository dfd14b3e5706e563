"""The loader gives what h5py gives, in whatever window and layout is asked for."""

import inspect
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import forged
import numpy as np
import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from gen2d.core.errors import ConfigError, DamagedError, FolderError
from gen2d.loading import chunks
from gen2d.loading import dataset as loader
from gen2d.loading.mixture import mix

TRAIN = 20
AXES = {"THWC": (0, 1, 2, 3, 4), "TCHW": (0, 1, 4, 2, 3), "CTHW": (0, 4, 1, 2, 3)}


# Frames of a chunk by codec: whole videos, or parts of them.
@pytest.fixture(scope="module", params=[("gzip", None), ("zstd", None), ("none", None), ("zstd", 1), ("none", 5)])
def root(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    codec, frames = request.param
    folder = tmp_path_factory.mktemp("data") / codec
    return synthetic.folder(synthetic.make(synthetic.dataset(folder, codec=codec, chunk_frames=frames)))


@pytest.fixture(scope="module", params=[None, 1])
def toy(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    spec = synthetic.dataset(tmp_path_factory.mktemp("data") / "toy", chunk_frames=request.param)
    return synthetic.folder(synthetic.make(spec))


def assert_same(actual: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert actual.keys() == expected.keys()
    for name, values in expected.items():
        assert actual[name].dtype == values.dtype
        assert_array_equal(actual[name], values)


# ---- Videos by number


def test_the_loader_gives_what_is_stored(root: Path) -> None:
    for split, count in (("train", TRAIN), ("test", 3)):
        dataset, expected = loader.open(root, split, fields="*"), synthetic.stored(root, split)
        assert len(dataset) == count
        assert_same(dataset[:], expected)
        assert_same(dataset[1], {name: values[1] for name, values in expected.items()})
        assert_same(dataset[[2, 0, -1]], {name: values[[2, 0, -1]] for name, values in expected.items()})
        assert_same(dataset[-1:0:-2], {name: values[-1:0:-2] for name, values in expected.items()})
        for row, video in zip((1, 1, -2), dataset.__getitems__([1, 1, -2]), strict=True):
            assert_same(video, {name: values[row] for name, values in expected.items()})


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_windows_and_layouts_are_views_of_what_is_stored(toy: Path, data: st.DataObject) -> None:
    stride = data.draw(st.integers(1, 3))
    window = data.draw(st.integers(1, (5 - 1) // stride + 1))
    layout, dtype = data.draw(st.sampled_from(sorted(AXES))), data.draw(st.sampled_from(["uint8", "float32"]))
    indices = data.draw(st.lists(st.integers(-TRAIN, TRAIN - 1), max_size=5))
    first = st.integers(0, 5 - (window - 1) * stride - 1)
    starts = data.draw(st.lists(first, min_size=len(indices), max_size=len(indices)))
    dataset = loader.open(toy, "train", "*", window=window, stride=stride, layout=layout, dtype=dtype)
    actual, expected = dataset.batch(indices, starts), synthetic.stored(toy)
    for name, field in dataset.fields.items():
        videos = [expected[name][index] for index in indices]
        if "T" in field.axes.split():
            videos = [
                video[s : s + (window - 1) * stride + 1 : stride] for video, s in zip(videos, starts, strict=True)
            ]
        values = np.array(videos) if videos else np.empty((0, *actual[name].shape[1:]), expected[name].dtype)
        if videos and field.is_image and values.ndim == 5:
            values = values.transpose(AXES[layout])
        if name == "frames" and dtype == "float32":
            values = (values / 255).astype(np.float32)
        assert_array_equal(actual[name], values)
        assert actual[name].dtype == values.dtype


def test_an_integer_start_begins_there(toy: Path) -> None:
    actual = loader.open(toy, window=2, start=3)[4]["states/angle"]
    assert_array_equal(actual, synthetic.stored(toy)["states/angle"][4, 3:5])


@pytest.mark.parametrize("start", [-1, 4])
def test_a_window_beyond_the_video_is_refused(toy: Path, start: int) -> None:
    with pytest.raises(ConfigError, match=rf"must be a frame from 0 to 3 for each video, but are \[3, {start}\]"):
        loader.open(toy, window=2).batch([0, 1], starts=[3, start])


def test_a_batch_can_be_filled_in_place(root: Path) -> None:
    dataset = loader.open(root)
    out = dataset.empty(2)
    assert dataset.batch([3, 4], out=out) is out
    assert_same(out, dataset[3:5])
    with pytest.raises(ConfigError, match="must be a contiguous"):
        dataset.batch([3, 4, 5], out=out)


def test_what_a_dataset_tells_about_itself(toy: Path) -> None:
    dataset = loader.open(toy, fields=("states/*", "frames"))
    assert list(dataset.fields) == ["states/angle", "states/position", "frames"]
    assert dataset.fields["frames"] == synthetic.FIELDS["frames"]
    assert dataset.stats.keys() == dataset.fields.keys()
    assert dataset.manifest.name == "toy"
    assert_array_equal(dataset.time, np.arange(5) / 10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fields": "state/position"}, "has no field 'state/position': did you mean 'states/position'?"),
        ({"fields": "time"}, "has no field 'time'"),
        ({"split": "tran"}, "has no split 'tran': did you mean 'train'?"),
        ({"window": 3, "stride": 3}, "need 7 frames, but the videos have 5"),
        ({"window": 3, "start": 3}, "need 6 frames, but the videos have 5"),
        ({"window": 0}, "must be 1 or more"),
        ({"start": "last"}, "start is 'last'"),
        ({"start": 2}, "say window="),
        ({"layout": "HWTC"}, "layout is 'HWTC'"),
        ({"dtype": "float64"}, "dtype is 'float64'"),
        ({"verify": "maybe"}, "verify is 'maybe'"),
    ],
)
def test_a_wrong_option_is_named(toy: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        loader.open(toy, **options)
    assert message in str(caught.value)


@pytest.mark.parametrize("index", [TRAIN, -TRAIN - 1, [0, TRAIN]])
def test_a_video_that_is_not_there_is_an_error(toy: Path, index: Any) -> None:
    with pytest.raises(IndexError, match="train has 20 videos"):
        loader.open(toy)[index]
    with pytest.raises(TypeError, match="must be an integer"):
        loader.open(toy)[cast(Any, 1.5)]


def test_a_folder_that_is_no_complete_dataset_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FolderError, match="not a gen2d dataset"):
        loader.open(tmp_path)
    (tmp_path / ".gen2d").mkdir()
    with pytest.raises(FolderError, match="incomplete: run the command"):
        loader.open(tmp_path)


# ---- Damage


def test_a_damaged_row_of_an_index_is_named(toy: Path, tmp_path: Path) -> None:
    root, manifest = shutil.copytree(toy, tmp_path / "toy"), loader.open(toy).manifest
    row = np.load(root / "index" / "train-20.npy")[1]
    check = int(row["index"]) + 4 * manifest.video_type.itemsize - 1  # the last byte of the row of video 11
    synthetic.flip(root / "shards" / "train-00001.h5", 8 * check)
    dataset = loader.open(root)
    for numbers in ([11], range(20)):
        with pytest.raises(DamagedError, match="the index of train video 11 is not what was written"):
            dataset.batch(numbers)
    assert_same(dataset[10], loader.open(toy)[10])


def test_a_chunk_that_lies_outside_its_file_is_refused(toy: Path, tmp_path: Path) -> None:
    root = shutil.copytree(toy, tmp_path / "toy")

    def beyond(content: bytearray, index: np.ndarray, row: np.void) -> None:
        index["frames"]["offset"][3, 0] = len(content) - 1

    forged.change_shard(root, "train", 0, beyond)
    with pytest.raises(DamagedError, match="frames lies outside the file, by its index"):
        loader.open(root)[3]


# ---- Files and blocks in memory


def test_a_file_that_is_replaced_is_opened_anew(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"one")
    first = chunks.open_file(path)
    assert chunks.open_file(path) is first
    (tmp_path / "b").write_bytes(b"two")
    (tmp_path / "b").replace(path)
    assert chunks.open_file(path).read(0, 3) == b"two"
    assert first.read(0, 3) == b"one"


def test_a_forked_process_opens_its_own_files(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"one")
    descriptor = chunks.open_file(tmp_path / "a").descriptor
    process = os.fork()
    if not process:
        os._exit(chunks.open_file(tmp_path / "a").descriptor == descriptor)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 0


def test_blocks_of_tables_are_dropped_when_many_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synthetic.make(synthetic.dataset(tmp_path, train=20, videos_per_shard=1), size=1)
    monkeypatch.setattr(chunks, "BLOCK", 4)
    monkeypatch.setattr(chunks, "CACHED_BLOCKS", 2)
    monkeypatch.setattr(chunks, "CACHED_SHARDS", 3)
    dataset = loader.open(tmp_path, fields="index")
    for number in (*range(20), 0, 19, 7):
        assert dataset[number]["index"] == number
        assert len(dataset._files._blocks) <= 2
        assert len(dataset._files._shards) <= 3


# What can be called or read; all else has an underscore.
COMMON = ["at", "batch", "empty", "exact", "fields", "fps", "snapshot", "stats", "time"]
SELECTABLE = [*COMMON, "filter", "select", "to_arrow", "to_pandas"]
PUBLIC = {
    "Dataset": [*SELECTABLE, "config", "manifest", "options", "root", "sizes", "splits"],
    "ConcatDataset": [*SELECTABLE, "datasets"],
    "Subset": [*SELECTABLE, "indices", "source"],
    "Mixture": [
        *(name for name in COMMON if name not in ("stats", "time")),
        "datasets",
        "filter",
        "shares",
        "source_of",
    ],
}


def test_public_names_are_those_of_the_documentation(toy: Path) -> None:
    ds = loader.open(toy)
    for made in (ds, loader.open([toy, toy]), ds.select([1]), mix({"a": ds, "b": ds}, [1, 2])):
        names = {name for name in dir(made) if not name.startswith("_")}
        assert names == {*PUBLIC[type(made).__name__]}, type(made)
        for name in names - vars(made).keys():
            assert getattr(type(made), name).__doc__, name
    text = inspect.getdoc(loader.Dataset) or ""
    assert all(f"\n{name} : " in text for name in vars(ds) if not name.startswith("_"))


# ---- Processes


def test_a_pickled_dataset_is_the_same(toy: Path) -> None:
    dataset = loader.open(toy, "test", ("frames",), 2, 2, "first", "TCHW", "float32", "none")
    again = pickle.loads(pickle.dumps(dataset))
    assert again.options == dataset.options
    assert_same(again[1], dataset[1])


def test_files_are_closed_when_many_are_open(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path, train=140, videos_per_shard=1), size=1)
    dataset = loader.open(tmp_path, fields="index")
    before = len(list(Path("/proc/self/fd").iterdir()))
    assert dataset[:]["index"].tolist() == list(range(140))
    assert len(list(Path("/proc/self/fd").iterdir())) <= before + 128
    assert len(chunks._files) <= chunks.OPEN_FILES


def test_no_jax_is_imported(toy: Path) -> None:
    code = f"import sys, gen2d; next(iter(gen2d.DataLoader(gen2d.open({str(toy)!r}, fields='*'), 2)));"
    code += "assert 'jax' not in sys.modules and 'h5py' not in sys.modules;"
    code += "import gen2d.dataset.folder, gen2d.tools.verify; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
