"""The loader gives what h5py gives, in an order that is a permutation and can be resumed anywhere."""

import itertools
import multiprocessing
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from gen2d import loader
from gen2d.errors import ConfigError, FolderError
from gen2d.formats import hdf5

TRAIN = 20
AXES = {"THWC": (0, 1, 2, 3, 4), "TCHW": (0, 1, 4, 2, 3), "CTHW": (0, 4, 1, 2, 3)}


@pytest.fixture(scope="module", params=["gzip", "zstd", "none"])
def root(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / request.param
    return synthetic.make(synthetic.dataset(folder, codec=request.param)).root


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.make(synthetic.dataset(tmp_path_factory.mktemp("data") / "toy")).root


def stored(root: Path, split: str = "train") -> dict[str, np.ndarray]:
    files = [hdf5.read(path) for path in sorted((root / "shards").glob(f"{split}-*.h5"))]
    return {name: np.concatenate([file[name] for file in files]) for name in files[0] if name != "time"}


def numbers(batches: Sequence[dict[str, Any]]) -> list[list[int]]:
    return [batch["index"].tolist() for batch in batches]


def same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        assert_array_equal(found[name], values)


# ---- Videos by number


def test_the_loader_gives_what_is_stored(root: Path) -> None:
    for split, count in (("train", TRAIN), ("test", 3)):
        dataset, expected = loader.open(root, split, fields="*"), stored(root, split)
        assert len(dataset) == count
        same(dataset[:], expected)
        same(dataset[1], {name: values[1] for name, values in expected.items()})
        same(dataset[[2, 0, -1]], {name: values[[2, 0, -1]] for name, values in expected.items()})
        same(dataset[-1:0:-2], {name: values[-1:0:-2] for name, values in expected.items()})
        for row, video in zip((1, 1, -2), dataset.__getitems__([1, 1, -2]), strict=True):
            same(video, {name: values[row] for name, values in expected.items()})


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
    found, expected = dataset.batch(indices, starts), stored(toy)
    for name, field in dataset.fields.items():
        videos = [expected[name][index] for index in indices]
        if "T" in field.axes.split():
            videos = [
                video[s : s + (window - 1) * stride + 1 : stride] for video, s in zip(videos, starts, strict=True)
            ]
        values = np.array(videos) if videos else np.empty((0, *found[name].shape[1:]), expected[name].dtype)
        if videos and field.is_image and values.ndim == 5:
            values = values.transpose(AXES[layout])
        if name == "frames" and dtype == "float32":
            values = (values / 255).astype(np.float32)
        assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype


def test_an_integer_start_begins_there(toy: Path) -> None:
    found = loader.open(toy, window=2, start=3)[4]["states/angle"]
    assert_array_equal(found, stored(toy)["states/angle"][4, 3:5])


def test_a_batch_can_be_filled_in_place(root: Path) -> None:
    dataset = loader.open(root)
    out = dataset.empty(2)
    assert dataset.batch([3, 4], out=out) is out
    same(out, dataset[3:5])
    with pytest.raises(ConfigError, match="must be a contiguous"):
        dataset.batch([3, 4, 5], out=out)


def test_what_a_dataset_tells_about_itself(toy: Path) -> None:
    dataset = loader.open(toy, fields=("states/*", "frames"))
    assert list(dataset.fields) == ["states/angle", "states/position", "frames"]
    assert dataset.fields["frames"] == synthetic.FIELDS["frames"]
    assert dataset.stats.keys() == dataset.fields.keys()
    assert dataset.manifest["name"] == "toy"
    assert_array_equal(dataset.time, np.arange(5) / 10)


@pytest.mark.parametrize(
    ("options", "told"),
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
def test_a_wrong_option_is_named(toy: Path, options: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        loader.open(toy, **options)
    assert told in str(caught.value)


@pytest.mark.parametrize("index", [TRAIN, -TRAIN - 1, [0, TRAIN]])
def test_a_video_that_is_not_there_is_told(toy: Path, index: Any) -> None:
    with pytest.raises(IndexError, match="train has 20 videos"):
        loader.open(toy)[index]
    with pytest.raises(TypeError, match="must be an integer"):
        loader.open(toy)[1.5]


def test_a_folder_that_is_no_complete_dataset_is_told(tmp_path: Path) -> None:
    with pytest.raises(FolderError, match="not a gen2d dataset"):
        loader.open(tmp_path)
    (tmp_path / ".gen2d").mkdir()
    with pytest.raises(FolderError, match="incomplete: run the command"):
        loader.open(tmp_path)


# ---- The order


@pytest.mark.parametrize("count", [*range(1, 70), 255, 256, 257, 1000, 4097])
def test_the_order_is_a_permutation(count: int) -> None:
    everything = loader.order(3, 1, np.arange(count), count)
    assert_array_equal(np.sort(everything), np.arange(count))
    some = np.arange(count)[:: max(1, count // 7)]
    assert_array_equal(loader.order(3, 1, some, count), everything[some])


def test_orders_differ_and_look_random() -> None:
    orders = [loader.order(seed, epoch, np.arange(1000), 1000) for seed in range(5) for epoch in range(20)]
    assert len({order.tobytes() for order in orders}) == 100
    # The mean of 100 places is normal around 499.5 with deviation 289 / sqrt(100).
    assert abs(np.mean(orders, 0) - 499.5).max() < 5 * 28.9
    assert abs(np.corrcoef(orders)[np.triu_indices(100, 1)]).max() < 0.2


def test_a_huge_dataset_needs_no_memory() -> None:
    found = loader.order(0, 0, np.arange(10**12 - 5, 10**12), 10**12)
    assert len(set(found.tolist())) == 5
    assert ((found >= 0) & (found < 10**12)).all()


# ---- Batches


def test_an_epoch_gives_each_video_once(toy: Path) -> None:
    dataset = loader.open(toy, fields="index")
    for shuffle in (True, False):
        batches = numbers(list(loader.DataLoader(dataset, 6, epochs=1, shuffle=shuffle, remainder="keep")))
        assert [len(batch) for batch in batches] == [6, 6, 6, 2]
        assert sorted(itertools.chain(*batches)) == list(range(TRAIN))
        assert (list(itertools.chain(*batches)) == list(range(TRAIN))) is not shuffle
    dropped = loader.DataLoader(dataset, 6, epochs=1)
    assert [len(batch) for batch in numbers(list(dropped))] == [6, 6, 6]
    assert len(dropped) == 3


def test_each_iteration_goes_on_with_the_next_epoch(toy: Path) -> None:
    dataset = loader.open(toy, fields="index")
    one, two = (loader.DataLoader(dataset, 6, epochs=epochs) for epochs in (1, 2))
    assert numbers(list(one)) + numbers(list(one)) == numbers(list(two))


@pytest.mark.parametrize("remainder", ["drop", "keep"])
def test_ranks_share_each_global_batch(toy: Path, remainder: str) -> None:
    dataset = loader.open(toy, fields="index")
    alone = numbers(list(loader.DataLoader(dataset, 6, epochs=2, remainder=remainder)))
    for world_size in (2, 3):
        ranks = [
            numbers(list(loader.DataLoader(dataset, 6 // world_size, 0, True, 2, rank, world_size, remainder)))
            for rank in range(world_size)
        ]
        assert [list(itertools.chain(*parts)) for parts in zip(*ranks, strict=True)] == alone


@pytest.mark.parametrize("remainder", ["drop", "keep"])
def test_a_state_resumes_at_the_very_batch_on_any_world_size(toy: Path, remainder: str) -> None:
    dataset = loader.open(toy, fields=("index", "states/angle"), window=2)
    full = loader.DataLoader(dataset, 6, epochs=2, remainder=remainder)
    batches, states = [], [full.state_dict()]
    for batch in full:
        batches.append(batch)
        states.append(pickle.loads(pickle.dumps(full.state_dict())))
    for done, state in enumerate(states[:-1]):
        for world_size in (1, 2, 3):
            ranks = []
            for rank in range(world_size):
                part = loader.DataLoader(dataset, 6 // world_size, 0, True, 2, rank, world_size, remainder)
                part.load_state_dict(state)
                ranks.append(list(part))
            for parts, expected in zip(zip(*ranks, strict=True), batches[done:], strict=True):
                for name, values in expected.items():
                    assert_array_equal(np.concatenate([part[name] for part in parts]), values)


def test_random_windows_follow_from_seed_epoch_and_position(toy: Path) -> None:
    dataset, whole = loader.open(toy, fields=("index", "states/angle"), window=2), stored(toy)["states/angle"]

    def starts(**options: Any) -> list[int]:
        found = []
        for batch in loader.DataLoader(dataset, 4, epochs=3, **options):
            for index, angle in zip(batch["index"], batch["states/angle"], strict=True):
                found += [start for start in range(4) if np.array_equal(whole[index, start : start + 2], angle)]
        return found

    assert starts() == starts(num_threads=1, prefetch=1)
    assert starts() != starts(seed=1)
    assert set(starts()) == {0, 1, 2, 3}
    assert len(starts()) == 3 * TRAIN


def test_a_state_of_another_order_is_refused(toy: Path) -> None:
    dataset = loader.open(toy, fields="index")
    state = loader.DataLoader(dataset, 4, seed=1).state_dict()
    with pytest.raises(ConfigError, match="the state has seed 1, but this loader has 0"):
        loader.DataLoader(dataset, 4).load_state_dict(state)


def test_break_and_go_on(toy: Path) -> None:
    dataset = loader.open(toy, fields="index")
    expected = numbers(list(loader.DataLoader(dataset, 4, epochs=1)))
    with loader.DataLoader(dataset, 4, epochs=1) as batches:
        found = [next(iter(batches))["index"].tolist()]
        found += numbers(list(batches))
    assert found == expected


def test_an_error_in_a_thread_reaches_the_caller(toy: Path) -> None:
    def transform(batch: loader.Batch) -> loader.Batch:
        raise ValueError("no such luck")

    with pytest.raises(ValueError, match="no such luck"):
        next(iter(loader.DataLoader(loader.open(toy), 4, transform=transform)))


def test_a_transform_gets_each_batch(toy: Path) -> None:
    batches = loader.DataLoader(loader.open(toy), 4, epochs=1, transform=lambda batch: {"sum": batch["frames"].sum()})
    assert sum(int(batch["sum"]) for batch in batches) == stored(toy)["frames"].sum()


@pytest.mark.parametrize(
    "options", [{"batch_size": 21}, {"batch_size": 0}, {"rank": 1}, {"to": "tensorflow"}, {"shuffle": "local"}]
)
def test_a_wrong_loader_option_is_refused(toy: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        loader.DataLoader(loader.open(toy), **{"batch_size": 4, **options})


# ---- Processes


def read_in_process(dataset: loader.Dataset, send: Callable[[Any], None]) -> None:
    send([*numbers(list(loader.DataLoader(dataset, 4, epochs=1))), int(dataset[3]["frames"].sum())])


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork.*:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:os.fork.*:RuntimeWarning")
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_processes_read_the_same(toy: Path, method: str) -> None:
    dataset = loader.open(toy, fields=("index", "frames"))
    found: list[Any] = []
    read_in_process(dataset, found.append)
    context: Any = multiprocessing.get_context(method)
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=read_in_process, args=(dataset, sender.send))
    process.start()
    assert receiver.poll(60)
    assert receiver.recv() == found[0]
    process.join()


def test_a_pickled_dataset_is_the_same(toy: Path) -> None:
    dataset = loader.open(toy, "test", ("frames",), 2, 2, "first", "TCHW", "float32", "none")
    again = pickle.loads(pickle.dumps(dataset))
    assert again.options == dataset.options
    same(again[1], dataset[1])


def test_files_are_closed_when_many_are_open(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path, train=140, videos_per_shard=1), size=1)
    dataset = loader.open(tmp_path, fields="index")
    assert dataset[:]["index"].tolist() == list(range(140))
    assert len(list(Path("/proc/self/fd").iterdir())) < 140 + 20
    assert loader._opened.cache_info().currsize <= 128


def test_no_jax_is_imported() -> None:
    code = "import sys, gen2d.loader, gen2d.shards, gen2d.verify; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
