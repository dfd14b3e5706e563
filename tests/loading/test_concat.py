"""A list of datasets is one dataset: the videos of the first, then those of the next, however they are asked for."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from packages import package

import gen2d
from gen2d.core.errors import ConfigError, FolderError, UserError
from gen2d.core.schema import Field
from gen2d.loading import dataset as loader
from gen2d.loading.concat import ConcatDataset
from gen2d.programs.redraw import render

COUNTS = {3: 20, 4: 9, 5: 1}  # videos by seed
TOTAL = 30


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Datasets of one recipe that differ in seed, size and, as that changes no value, in codec."""
    folder, codecs = tmp_path_factory.mktemp("data"), ("gzip", "zstd", "none")
    specs = (
        synthetic.dataset(folder / f"{seed}", train=count, seed=seed, codec=codec, chunk_frames=chunk)
        for (seed, count), codec, chunk in zip(COUNTS.items(), codecs, (None, 1, 5), strict=True)
    )
    return [synthetic.folder(synthetic.make(one)) for one in specs]


def stored(roots: list[Path]) -> dict[str, np.ndarray]:
    """What h5py reads, one dataset after the other."""
    parts = [synthetic.stored(root) for root in roots]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def assert_same(actual: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert actual.keys() == expected.keys()
    for name, values in expected.items():
        assert actual[name].dtype == values.dtype
        assert_array_equal(actual[name], values)


# ---- Videos by number


def test_videos_come_one_dataset_after_the_other(roots: list[Path]) -> None:
    concatenated, expected = loader.open(roots, "train", fields="*"), stored(roots)
    assert len(concatenated) == TOTAL
    for key in (0, 19, 20, 28, -1, -30, slice(None), slice(15, 25), slice(None, None, -7), [29, 0, 20, -2, 20], []):
        assert_same(concatenated[key], {name: values[key] for name, values in expected.items()})
    for number, video in zip((21, 3), concatenated.__getitems__([21, 3]), strict=True):
        assert_same(video, {name: values[number] for name, values in expected.items()})


@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_windows_and_layouts_are_those_of_each_dataset(roots: list[Path], data: st.DataObject) -> None:
    view: dict[str, Any] = {"window": data.draw(st.integers(1, 3)), "stride": data.draw(st.integers(1, 2))}
    view |= {"layout": data.draw(st.sampled_from(["THWC", "CTHW"])), "dtype": "float32", "fields": "*"}
    concatenated, parts = loader.open(roots, **view), [loader.open(root, **view) for root in roots]
    chosen = data.draw(st.lists(st.integers(0, TOTAL - 1), min_size=1, max_size=6))
    last = 5 - (view["window"] - 1) * view["stride"] - 1
    starts = data.draw(st.lists(st.integers(0, last), min_size=len(chosen), max_size=len(chosen)))
    owners = [(part, number) for part in parts for number in range(len(part))]
    alone = [
        owners[number][0].batch([owners[number][1]], [start]) for number, start in zip(chosen, starts, strict=True)
    ]
    expected = {name: np.concatenate([batch[name] for batch in alone]) for name in alone[0]}
    assert_same(concatenated.batch(chosen, starts), expected)
    out = concatenated.empty(len(chosen))
    assert concatenated.batch(chosen, starts, out) is out
    assert_same(out, expected)


@pytest.mark.parametrize("index", [TOTAL, -TOTAL - 1, [0, TOTAL]])
def test_a_video_that_is_not_there_is_an_error(roots: list[Path], index: Any) -> None:
    with pytest.raises(IndexError, match="has 30 videos"):
        loader.open(roots)[index]


def test_a_list_of_one_is_that_one(roots: list[Path]) -> None:
    concatenated, alone = loader.open(roots[:1]), loader.open(roots[0])
    assert_same(concatenated[:], alone[:])
    assert concatenated.fields == alone.fields
    assert_array_equal(concatenated.time, alone.time)
    for name, values in alone.stats.items():
        for key, value in values.items():
            assert_allclose(np.array(concatenated.stats[name][key], float), np.array(value, float), rtol=1e-12)


def test_a_pickled_list_is_the_same_and_a_url_may_stand_in_it(roots: list[Path]) -> None:
    fsspec = package("fsspec")
    files = fsspec.filesystem("memory")
    for name, content in synthetic.tree(roots[1]).items():
        files.pipe_file(f"/joined/{name}", content)
    concatenated = pickle.loads(pickle.dumps(loader.open((str(roots[0]), "memory://joined", roots[2]), fields="*")))
    assert_same(concatenated[:], stored(roots))


# ---- As one dataset


def test_statistics_are_those_of_all_videos(roots: list[Path]) -> None:
    actual, frames = loader.open(roots, fields="*").stats, stored(roots)["frames"][:, ::8, ::4, ::4].astype(float)
    for key, law in {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}.items():
        assert_allclose(np.array(actual["frames"][key]), law(frames, axis=(0, 1, 2, 3)), rtol=1e-9)
    alone = [loader.open(root, fields="*").stats for root in roots]
    for name, values in actual.items():
        for key, law in {"min": np.min, "max": np.max}.items():
            assert_array_equal(np.array(values[key]), law(np.array([part[name][key] for part in alone]), axis=0))


@pytest.mark.parametrize("shuffle", [True, False])
def test_an_epoch_gives_every_video_of_every_dataset_once(roots: list[Path], shuffle: bool) -> None:
    concatenated, whole = loader.open(roots, fields=("index", "states/angle"), window=2), stored(roots)["states/angle"]
    options: dict[str, Any] = {"seed": 5, "shuffle": shuffle, "epochs": 1, "drop_last": False, "num_threads": 3}
    batches = list(gen2d.DataLoader(concatenated, 7, **options))
    assert [len(batch["index"]) for batch in batches] == [7, 7, 7, 7, 2]
    angles = np.concatenate([batch["states/angle"] for batch in batches])
    actual = [
        next(i for i, video in enumerate(whole) if any((video[s : s + 2] == angle).all() for s in range(4)))
        for angle in angles
    ]
    assert sorted(actual) == list(range(TOTAL))
    assert (actual == list(range(TOTAL))) != shuffle
    again = gen2d.DataLoader(concatenated, 7, **options)
    next(iter(again))
    again.close()
    resumed = gen2d.DataLoader(concatenated, 7, **options)
    resumed.load_state_dict(again.state_dict())
    for one, other in zip(resumed, batches[1:], strict=True):
        assert_same(one, other)


def test_a_list_can_be_a_part_of_a_mixture(roots: list[Path]) -> None:
    concatenated, alone = loader.open(roots[:2], fields="index"), loader.open(roots[0], fields="index")
    mixture = gen2d.mix({"two": concatenated, "one": alone}, [2, 1])
    order = np.array(mixture.source_of(range(len(mixture))))
    assert_array_equal(mixture[:]["index"][order == "two"], concatenated[: (order == "two").sum()]["index"])


# ---- What cannot be one


CHANGES: dict[str, tuple[dict[str, Any], str]] = {
    "sizes": ({"sizes": {"T": 5, "H": 8, "W": 8, "K": 4}}, "size K is 4, but in .* 3: what is opened as one"),
    "rate": ({"fps": 20.0}, "fps is 20.0, but in .* 10.0: "),
    "axes": (
        {"fields": synthetic.FIELDS | {"states/angle": Field("float32", "n T K", "degree", "unwrapped")}},
        "field states/angle is float32 n T K, degree, but in .* float32 n T K, rad: ",
    ),
    "fewer": (
        {"fields": {name: field for name, field in synthetic.FIELDS.items() if name != "states/angle"}},
        "field states/angle is missing, but in .* float32 n T K, rad: ",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_datasets_that_do_not_agree_are_named(roots: list[Path], tmp_path: Path, change: str) -> None:
    options, message = CHANGES[change]
    other = synthetic.folder(synthetic.make(synthetic.dataset(tmp_path / "other", train=2, **options)))
    with pytest.raises(ConfigError, match=f"other: {message}") as caught:
        loader.open([roots[0], other])
    assert "\n" not in str(caught.value)


def test_another_split_is_named(roots: list[Path], tmp_path: Path) -> None:
    only = synthetic.folder(synthetic.make(synthetic.dataset(tmp_path / "only", splits={"test": 2})))
    with pytest.raises(ConfigError, match=r"only: split is test, but in .*3 train"):
        loader.open([roots[0], only])
    assert len(loader.open([roots[0], only], "test")) == 5


def test_what_is_no_list_of_datasets_is_an_error(roots: list[Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="path is an empty list"):
        loader.open([])
    with pytest.raises(FolderError, match="not a gen2d dataset"):
        loader.open([roots[0], tmp_path])
    assert isinstance(loader.open(roots), ConcatDataset)
    concatenated: Any = loader.open(roots)
    with pytest.raises(UserError, match="ds is ConcatDataset, but must be a dataset of one folder"):
        render(concatenated, [0])
