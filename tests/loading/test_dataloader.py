"""The order is a permutation that can be resumed anywhere, and batches are the same wherever they are made."""

import gc
import itertools
import multiprocessing
import pickle
import subprocess
import sys
import threading
import time
import types
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from packages import package
from tiny import run_on

import gen2d
from gen2d.core.errors import ConfigError
from gen2d.core.permutation import hashed
from gen2d.loading import dataset as loader
from gen2d.loading import epochs
from gen2d.loading.dataloader import DataLoader
from gen2d.loading.epochs import order

TRAIN = 20


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.folder(synthetic.make(synthetic.dataset(tmp_path_factory.mktemp("data") / "toy")))


def numbers(batches: Sequence[dict[str, Any]]) -> list[list[int]]:
    return [batch["index"].tolist() for batch in batches]


# ---- The order


@pytest.mark.parametrize("count", [*range(1, 70), 255, 256, 257, 1000, 4097])
def test_the_order_is_a_permutation(count: int) -> None:
    everything = order(3, 1, np.arange(count), count)
    assert_array_equal(np.sort(everything), np.arange(count))
    some = np.arange(count)[:: max(1, count // 7)]
    assert_array_equal(order(3, 1, some, count), everything[some])


def test_orders_differ_and_look_random() -> None:
    orders = [order(seed, epoch, np.arange(1000), 1000) for seed in range(5) for epoch in range(20)]
    assert len({values.tobytes() for values in orders}) == 100
    # The mean of 100 places is normal around 499.5 with deviation 289 / sqrt(100).
    assert abs(np.mean(orders, 0) - 499.5).max() < 5 * 28.9
    assert abs(np.corrcoef(orders)[np.triu_indices(100, 1)]).max() < 0.2


def test_streams_of_random_numbers_share_nothing() -> None:
    positions = np.arange(8)
    streams = [hashed(use, 3, 1, positions) for use in (epochs.ORDER, epochs.WINDOWS, epochs.SOURCES)]
    assert len(np.unique(streams)) == 24


def test_a_huge_dataset_needs_no_memory() -> None:
    actual = order(0, 0, np.arange(10**12 - 5, 10**12), 10**12)
    assert len(set(actual.tolist())) == 5
    assert ((actual >= 0) & (actual < 10**12)).all()


# ---- Batches


def test_an_epoch_gives_each_video_once(toy: Path) -> None:
    dataset = loader.open(toy, fields="index")
    for shuffle in (True, False):
        batches = numbers(list(DataLoader(dataset, 6, epochs=1, shuffle=shuffle, drop_last=False)))
        assert [len(batch) for batch in batches] == [6, 6, 6, 2]
        assert sorted(itertools.chain(*batches)) == list(range(TRAIN))
        assert (list(itertools.chain(*batches)) == list(range(TRAIN))) is not shuffle
    dropped = DataLoader(dataset, 6, epochs=1)
    assert [len(batch) for batch in numbers(list(dropped))] == [6, 6, 6]
    assert len(dropped) == 3


@pytest.mark.parametrize("drop_last", [True, False])
def test_the_length_is_the_number_of_batches(toy: Path, drop_last: bool) -> None:
    dataset = loader.open(toy, fields="index")
    for size in (1, 3, 5, 6, 19, 20):
        batches = DataLoader(dataset, size, epochs=1, drop_last=drop_last)
        assert len(batches) == len(list(batches))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size is 0, but must be a whole number, 1 or more"),
        ({"batch_size": "4"}, "batch_size is '4', but must be a whole number"),
        ({"epochs": 0}, "epochs is 0, but must be a whole number, 1 or more"),
        ({"seed": "a"}, "seed is 'a', but must be a whole number"),
        ({"rank": 3, "world_size": 2}, "rank is 3, but must be from 0 to world_size - 1, which is 1"),
        ({"dataset": [1, 2, 3]}, r"dataset is \[1, 2, 3\], but must be a dataset from gen2d.open or gen2d.mix"),
    ],
)
def test_an_argument_that_is_wrong_is_named(toy: Path, options: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {"dataset": loader.open(toy), "batch_size": 4, **options}
    with pytest.raises(ConfigError, match=message):
        DataLoader(given.pop("dataset"), given.pop("batch_size"), **given)


def test_what_is_no_folder_or_dataset_is_named(toy: Path, tmp_path: Path) -> None:
    ds: Any = loader.open(toy)
    name: Any = "toy"
    pair: Any = [ds, ds]
    for call, message in (
        (lambda: gen2d.mix(pair), r"datasets is .*, but must be a mapping of names to datasets"),
        (lambda: gen2d.export(ds, "npz", tmp_path / "out"), r"a folder is given as .*, but must be a path or a URL"),
        (lambda: loader.open(toy, stride=0), "stride is 0, but must be 1 or more"),
        (lambda: gen2d.load_config("bouncing", "a.b=1"), r"overrides is .a.b=1., but must be a list"),
        (
            lambda: gen2d.render(ds.select([0]), [0]),
            r"ds is Subset, .* one folder: give ds\.source",
        ),
        (lambda: gen2d.render(name, [0]), "ds is str, but must be a dataset of one folder"),
    ):
        with pytest.raises(ConfigError, match=message):
            call()


def test_each_iteration_goes_on_with_the_next_epoch(toy: Path) -> None:
    dataset = loader.open(toy, fields="index")
    one, two = (DataLoader(dataset, 6, epochs=epochs) for epochs in (1, 2))
    assert numbers(list(one)) + numbers(list(one)) == numbers(list(two))
    again, length = DataLoader(dataset, 6, epochs=1), len(one)
    parts = [numbers(list(itertools.islice(again, length))) for _ in range(2)]  # the iterations do not reach their end
    assert parts[0] + parts[1] == numbers(list(DataLoader(dataset, 6, epochs=2)))


def test_a_state_from_after_the_loop_goes_on_with_the_next_epoch(toy: Path) -> None:
    dataset = loader.open(toy, fields="index")
    expected = numbers(list(DataLoader(dataset, 6, epochs=3)))
    one, other = (DataLoader(dataset, 6, epochs=1) for _ in range(2))
    first = numbers(list(one))
    other.load_state_dict(one.state_dict())
    assert other.state_dict()["epoch"] == 1
    assert first + numbers(list(other)) + numbers(list(other)) == expected


@pytest.mark.parametrize("drop_last", [True, False])
def test_ranks_share_each_global_batch(toy: Path, drop_last: bool) -> None:
    dataset = loader.open(toy, fields="index")
    alone = numbers(list(DataLoader(dataset, 6, epochs=2, drop_last=drop_last)))
    for world_size in (2, 3):
        ranks = [
            numbers(list(DataLoader(dataset, 6 // world_size, 0, True, 2, rank, world_size, drop_last)))
            for rank in range(world_size)
        ]
        assert [list(itertools.chain(*parts)) for parts in zip(*ranks, strict=True)] == alone


@pytest.mark.parametrize("drop_last", [True, False])
def test_a_state_resumes_at_the_very_batch_on_any_world_size(toy: Path, drop_last: bool) -> None:
    dataset = loader.open(toy, fields=("index", "states/angle"), window=2)
    full = DataLoader(dataset, 6, epochs=2, drop_last=drop_last)
    batches, states = [], [full.state_dict()]
    for batch in full:
        batches.append(batch)
        states.append(pickle.loads(pickle.dumps(full.state_dict())))
    for done, state in enumerate(states):  # the last one is taken in the loop, too, and nothing is left to read
        for world_size in (1, 2, 3):
            ranks = []
            for rank in range(world_size):
                part = DataLoader(dataset, 6 // world_size, 0, True, 2, rank, world_size, drop_last)
                part.load_state_dict(state)
                ranks.append(list(part))
            for parts, expected in zip(zip(*ranks, strict=True), batches[done:], strict=True):
                for name, values in expected.items():
                    assert_array_equal(np.concatenate([part[name] for part in parts]), values)


def test_random_windows_follow_from_seed_epoch_and_position(toy: Path) -> None:
    dataset, whole = loader.open(toy, fields=("index", "states/angle"), window=2), synthetic.stored(toy)["states/angle"]

    def starts(size: int = 4, **options: Any) -> list[int]:
        frames = []
        for batch in DataLoader(dataset, size, epochs=3, **options):
            for index, angle in zip(batch["index"], batch["states/angle"], strict=True):
                frames += [start for start in range(4) if np.array_equal(whole[index, start : start + 2], angle)]
        return frames

    assert starts() == starts(num_threads=1, prefetch=1)
    assert starts() == starts(size=5) == starts(size=20)
    assert starts() != starts(seed=1)
    one, two, three = np.array(starts(shuffle=False)).reshape(3, TRAIN)
    assert (one != two).any()
    assert (two != three).any()
    assert set(starts()) == {0, 1, 2, 3}
    assert len(starts()) == 3 * TRAIN


def test_ranks_are_those_of_the_process_group_or_torchrun_unless_given(
    toy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ds = loader.open(toy, fields="index")
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    inferred, given = DataLoader(ds, 4, epochs=1), DataLoader(ds, 4, epochs=1, rank=1, world_size=2)
    alone = DataLoader(ds, 4, epochs=1, rank=0, world_size=1)
    assert len(inferred) == len(given) == TRAIN // 8 != len(alone)
    for one, other in zip(inferred, given, strict=True):
        assert_array_equal(one["index"], other["index"])
    group = {"is_available": lambda: True, "is_initialized": lambda: True}
    group |= {"get_rank": lambda: 0, "get_world_size": lambda: 4}
    with monkeypatch.context() as patched:  # a process group comes before the environment
        patched.setitem(sys.modules, "torch.distributed", types.SimpleNamespace(**group))
        assert len(DataLoader(ds, 4, epochs=1)) == TRAIN // 16
        assert len(DataLoader(ds, 4, epochs=1, rank=0, world_size=1)) == len(alone)
    monkeypatch.setenv("RANK", "one")
    with pytest.raises(ConfigError, match="RANK and WORLD_SIZE are 'one'"):
        DataLoader(ds, 4)


def test_a_state_of_another_order_is_refused(toy: Path) -> None:
    dataset = loader.open(toy, fields="index")
    state = DataLoader(dataset, 4, seed=1).state_dict()
    with pytest.raises(ConfigError, match="the state has seed 1, but this loader has 0"):
        DataLoader(dataset, 4).load_state_dict(state)
    sampler = DataLoader(dataset, 4).epoch_sampler
    with pytest.raises(ConfigError, match="the state has videos 20, but this loader has 19"):
        sampler.with_videos(19).load_state_dict(sampler.state_dict())


def test_break_and_go_on(toy: Path) -> None:
    dataset = loader.open(toy, fields="index")
    expected = numbers(list(DataLoader(dataset, 4, epochs=1)))
    with DataLoader(dataset, 4, epochs=1) as batches:
        actual = [next(iter(batches))["index"].tolist()]
        actual += numbers(list(batches))
    assert actual == expected


def test_a_closed_loader_has_no_threads(toy: Path) -> None:
    def slow(batch: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        time.sleep(0.3)
        return batch

    before = set(threading.enumerate())
    with DataLoader(loader.open(toy, fields="index"), 4, transform=slow, num_threads=2) as batches:
        next(iter(batches))
        assert set(threading.enumerate()) - before
    assert not set(threading.enumerate()) - before


def test_an_error_in_a_thread_reaches_the_caller(toy: Path) -> None:
    def transform(batch: loader.Batch) -> loader.Batch:
        raise ValueError("no such luck")

    with pytest.raises(ValueError, match="no such luck"):
        next(iter(DataLoader(loader.open(toy), 4, transform=transform)))


def test_a_transform_gets_each_batch(toy: Path) -> None:
    batches = DataLoader(loader.open(toy), 4, epochs=1, transform=lambda batch: {"sum": batch["frames"].sum()})
    assert sum(int(batch["sum"]) for batch in batches) == synthetic.stored(toy)["frames"].sum()


@pytest.mark.parametrize(
    "options", [{"batch_size": 21}, {"batch_size": 0}, {"rank": 1}, {"to": "tensorflow"}, {"shuffle": "local"}]
)
def test_a_wrong_loader_option_is_refused(toy: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        DataLoader(loader.open(toy), **{"batch_size": 4, **options})


# ---- Other kinds of arrays


@pytest.fixture
def aligned_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches begin at multiples of 64 bytes, where jax on a CPU takes over the memory itself."""

    def aligned_like(values: np.ndarray) -> np.ndarray:
        room = np.empty(values.nbytes + 64, np.uint8)
        first = -room.ctypes.data % 64
        return room[first : first + values.nbytes].view(values.dtype).reshape(values.shape)

    empty = loader.Dataset.empty
    monkeypatch.setattr(
        loader.Dataset, "empty", lambda self, count: {k: aligned_like(v) for k, v in empty(self, count).items()}
    )


@pytest.mark.usefixtures("aligned_arrays")
@pytest.mark.parametrize("kind", ["jax", "torch"])
def test_batches_stay_as_they_were_while_others_follow(toy: Path, kind: Any) -> None:
    library = package(kind)
    dataset = loader.open(toy, fields="*", window=2)
    expected = list(DataLoader(dataset, 4, epochs=3))
    batches = list(DataLoader(dataset, 4, epochs=3, prefetch=1, to=kind))
    for actual, batch in zip(batches, expected, strict=True):
        assert actual.keys() == batch.keys()
        for name, values in batch.items():
            assert isinstance(actual[name], library.Array if kind == "jax" else library.Tensor)
            rounded = values.astype(np.float32) if kind == "jax" and values.dtype == np.float64 else values
            assert_array_equal(np.asarray(actual[name]), rounded)


def test_an_abandoned_iterator_joins_no_thread(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The garbage collector may end it while another thread starts and holds the lock that joining needs."""
    joined = []
    monkeypatch.setattr(threading.Thread, "join", lambda thread, timeout=None: joined.append(thread.name))
    data_loader = DataLoader(loader.open(toy), 4, num_threads=1)
    next(iter(data_loader))
    alive = weakref.ref(data_loader)
    del data_loader
    for _ in range(100):  # until its thread has done what was requested ahead
        gc.collect()
        if alive() is None:
            break
        time.sleep(0.1)
    assert alive() is None
    assert not joined


MEMORY = """
import resource, sys, gen2d
sizes, seen = [], 0
for batch in gen2d.DataLoader(gen2d.open(sys.argv[1], fields="*"), 50, epochs=50, num_threads=2):
    seen += len(batch["index"])
    if seen % 10_000 == 0:
        with open("/proc/self/statm") as file:
            sizes.append(int(file.read().split()[1]) * resource.getpagesize())
print(seen, *sizes)
"""


@pytest.mark.slow
def test_memory_does_not_grow_over_100_000_samples(tmp_path: Path) -> None:
    """Of 250 shards, which are more files than stay open."""
    synthetic.make(synthetic.small(tmp_path, {"train": 2000}), size=8)
    done = subprocess.run([sys.executable, "-c", MEMORY, str(tmp_path)], capture_output=True, text=True, check=True)
    seen, *sizes = map(int, done.stdout.split())
    assert seen == 100_000
    growth = max(sizes) - max(sizes[:2])
    print(f"{growth / 2**20:.2f} MiB more after 100,000 samples than after 20,000, of {max(sizes) / 2**20:.0f} MiB")
    assert growth < 4 * 2**20  # 42 bytes per sample; malloc's own arenas grow by 3 MiB in all


def check_device_placement(root: str) -> None:
    """Fails unless batches for jax lie on the device, or over the devices, that they are asked to."""
    import jax

    devices = jax.devices()
    mesh = jax.sharding.Mesh(np.array(devices), ("videos",))
    spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("videos"))
    dataset = loader.open(root, fields=("frames", "states/angle"))
    count = 4 * len(devices)
    expected = next(iter(DataLoader(dataset, count, epochs=1)))
    places: list[tuple[dict[str, Any], Any]] = [
        ({"device": devices[-1]}, jax.sharding.SingleDeviceSharding(devices[-1])),
        ({"sharding": spread}, spread),
    ]
    for options, place in places:
        for name, values in next(iter(DataLoader(dataset, count, epochs=1, to="jax", **options))).items():
            assert values.devices() == place.device_set
            assert values.sharding.is_equivalent_to(place, values.ndim)
            assert_array_equal(np.asarray(values), expected[name])


def test_jax_batches_lie_where_they_are_asked_to(toy: Path) -> None:
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r});"
    code += f"import test_dataloader; test_dataloader.check_device_placement({str(toy)!r})"
    run_on(2, "assert len(jax.devices()) == 2;" + code, JAX_PLATFORMS="cpu")


def test_torch_batches_lie_where_they_are_asked_to(toy: Path) -> None:
    torch = package("torch")
    batch = next(iter(DataLoader(loader.open(toy), 4, to="torch", device="meta")))
    assert all(values.device == torch.device("meta") for values in batch.values())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"device": "cpu"}, "device is 'cpu', but must be None with to='numpy'"),
        ({"sharding": "all", "to": "torch"}, "sharding is 'all', but must be None unless to is 'jax'"),
        ({"sharding": "all", "device": "cpu", "to": "jax"}, "sharding is 'all', but must be None"),
    ],
)
def test_a_place_that_cannot_be_is_refused(toy: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        DataLoader(loader.open(toy), 4, **options)


# ---- Processes


def read_in_process(dataset: loader.Dataset, send: Callable[[Any], None]) -> None:
    send([*numbers(list(DataLoader(dataset, 4, epochs=1))), int(dataset[3]["frames"].sum())])


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_processes_read_the_same(toy: Path, method: str) -> None:
    dataset = loader.open(toy, fields=("index", "frames"))
    actual: list[Any] = []
    read_in_process(dataset, actual.append)
    context: Any = multiprocessing.get_context(method)
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=read_in_process, args=(dataset, sender.send))
    process.start()
    assert receiver.poll(60)
    assert receiver.recv() == actual[0]
    process.join()
