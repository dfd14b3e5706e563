"""torch's own loaders give the same windows for any sampler and workers, and torchdata resumes at the very batch."""

import ast
import copy
import itertools
import pickle
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from packages import package

import gen2d
from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.loading import dataset as loader

TRAIN, FRAMES = 20, 5
FIELDS = ("index", "frames", "states/angle")
WORKERS = [(0, None), (1, "fork"), (3, "fork")]
# Workers may be more than the cores of this process, and torchdata uses what newer versions of torch warn of.
pytestmark = [
    pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning"),
    pytest.mark.filterwarnings("ignore:'set_vital' is deprecated:UserWarning"),
]


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.folder(synthetic.make(synthetic.dataset(tmp_path_factory.mktemp("data") / "toy")))


@pytest.fixture(scope="module")
def stored(toy: Path) -> dict[str, np.ndarray]:
    return synthetic.stored(toy)


@pytest.fixture(params=["dataset", "concatenation", "mixture"])
def source(request: pytest.FixtureRequest, toy: Path) -> Any:
    """A source of at least 20 windows of 2 of 5 frames."""
    ds = loader.open(toy, fields=FIELDS, window=2)
    both = loader.open([toy, toy], fields=FIELDS, window=2)
    return {"dataset": ds, "concatenation": both, "mixture": gen2d.mix({"one": ds, "other": both}, [1, 2])}[
        request.param
    ]


def torch() -> Any:
    package("torch")
    return gen2d.torch


def data_loader(data: Any, workers: tuple[int, str | None] = (0, None), stateful: bool = False, **options: Any) -> Any:
    """torch's DataLoader, or torchdata's, with a number of workers that start in some way."""
    cls = (
        package("torchdata.stateful_dataloader").StatefulDataLoader
        if stateful
        else package("torch").utils.data.DataLoader
    )
    number, method = workers
    timeout = 120 if number else 0  # s: a worker that is forked beside threads of other libraries may wait forever
    return cls(data, num_workers=number, multiprocessing_context=method, timeout=timeout, **options)


def check_windows(batch: dict[str, Any], stored: dict[str, np.ndarray]) -> None:
    """Fails unless each window of a batch lies where the batch says."""
    starts, times = np.asarray(batch["window/start"]), np.asarray(batch["window/time"])
    assert (starts.dtype, times.dtype) == (np.int64, np.float64)
    for row, (index, start) in enumerate(zip(np.asarray(batch["index"]), starts, strict=True)):
        frames = slice(start, start + 2)
        assert_array_equal(np.asarray(batch["states/angle"][row]), stored["states/angle"][index, frames])
        assert_array_equal(np.asarray(batch["frames"][row]), stored["frames"][index, frames])
        assert_array_equal(times[row], (np.arange(FRAMES) / 10)[frames])


def same(batches: Iterable[dict[str, Any]], expected: Sequence[dict[str, Any]]) -> None:
    """Fails unless the batches have the same fields, types and bits."""
    for batch, other in zip(batches, expected, strict=True):
        assert batch.keys() == other.keys()
        for name, values in other.items():
            assert np.asarray(batch[name]).dtype == np.asarray(values).dtype
            assert_array_equal(np.asarray(batch[name]), np.asarray(values), err_msg=name)


# ---- Windows that are read by index


def test_a_random_window_has_no_first_frame_by_index(source: Any) -> None:
    for key in (0, -1, slice(2), [3, 4]):
        with pytest.raises(ConfigError, match=r"start is 'random'.*gen2d\.torch\.dataset\(ds\).*start=0"):
            source[key]
    torch()
    for workers in ((0, None), (2, "fork")):
        with pytest.raises(Exception, match=r"start is 'random'.*gen2d\.torch\.dataset\(ds\)"):
            next(iter(data_loader(source, workers, batch_size=4, shuffle=True)))


def test_windows_that_are_not_random_are_read_by_index(toy: Path, stored: dict[str, np.ndarray]) -> None:
    for start in (0, 2, "first"):
        batch = loader.open(toy, fields=FIELDS, window=2, start=start)[3:9]
        check_windows(batch, stored)
        assert set(batch["window/start"].tolist()) == {0 if start == "first" else start}
    check_windows(loader.open(toy, fields=FIELDS, window=2).batch([3, 1], starts=[2, 0]), stored)
    # There is only one window of all frames; without a window, nothing lies anywhere.
    assert_array_equal(loader.open(toy, fields=FIELDS, window=FRAMES)[2]["frames"], stored["frames"][2])
    assert loader.open(toy, fields=FIELDS)[2].keys() == set(FIELDS)


def test_every_batch_says_where_its_windows_lie(source: Any, stored: dict[str, np.ndarray]) -> None:
    torch()
    data = gen2d.torch.dataset(source)
    batches = [
        *gen2d.DataLoader(source, 6, epochs=2),
        *gen2d.DataLoader(source, 6, epochs=2, to="torch"),
        *data_loader(data, batch_size=6),
        *gen2d.torch.iterable(source, 6),
    ]
    for batch in batches:
        check_windows(batch, stored)
    single = data[7]
    check_windows({name: values[None] for name, values in single.items()}, stored)


def test_times_are_those_of_strided_windows(toy: Path) -> None:
    for batch in gen2d.DataLoader(loader.open(toy, window=2, stride=3), 5, epochs=1, to="jax"):
        starts = np.asarray(batch["window/start"])
        expected = (np.arange(FRAMES) / 10)[starts[:, None] + np.array([0, 3])].astype(np.float32)
        assert_array_equal(np.asarray(batch["window/time"]), expected)


# ---- Map-style


@pytest.mark.full
def test_spawned_workers_do_as_others(toy: Path) -> None:
    torch()
    ds, workers = loader.open(toy, fields=FIELDS, window=2), (2, "spawn")
    data, many = gen2d.torch.dataset(ds), gen2d.torch.iterable(ds, 3)
    maps = [data_loader(data, each, batch_size=3, persistent_workers=each[0] > 0) for each in (WORKERS[0], workers)]
    iterables = [data_loader(many, each, batch_size=None, stateful=True) for each in (WORKERS[0], workers)]
    for epoch in range(2):
        data.set_epoch(epoch)
        same(maps[1], list(maps[0]))
        many.set_epoch(epoch)
        expected, iterator = list(iterables[0]), iter(iterables[1])
        same(itertools.islice(iterator, 2), expected[:2])
        iterables[1].load_state_dict(iterables[1].state_dict())
        same(iterables[1], expected[2:])


@pytest.mark.parametrize("workers", WORKERS)
def test_windows_follow_from_seed_epoch_and_index_alone(source: Any, workers: tuple[int, str | None]) -> None:
    torch()
    data = gen2d.torch.dataset(source, seed=3)
    everything = list(range(len(source)))
    expected = []
    for epoch in range(3):
        data.set_epoch(epoch)
        expected.append(data_loader(data, batch_size=len(source)))
        expected[-1] = next(iter(expected[-1]))
    utils = package("torch").utils.data
    samplers = {
        "in order": everything,
        "weighted": list(utils.WeightedRandomSampler([1.0] * len(source), 30)),
        "of a rank": list(utils.DistributedSampler(data, num_replicas=2, rank=1, shuffle=True)),
    }
    for order in samplers.values():
        options: dict[str, Any] = {"persistent_workers": True} if workers[0] else {}
        batches = data_loader(data, workers, batch_size=7, sampler=order, **options)
        for epoch in (0, 2, 1):
            data.set_epoch(epoch)
            rows = itertools.batched(order, 7) if sys.version_info >= (3, 12) else _batched(order, 7)
            same(batches, [{name: values[list(r)] for name, values in expected[epoch].items()} for r in rows])
        del batches


def _batched(order: Sequence[int], size: int) -> list[Sequence[int]]:
    return [order[first : first + size] for first in range(0, len(order), size)]


def starts_of(data: Any) -> list[int]:
    return [int(data[index]["window/start"]) for index in range(len(data))]


def test_windows_are_all_there_is_and_differ_between_epochs_and_seeds(toy: Path) -> None:
    torch()
    ds = loader.open(toy, fields="index", window=2)
    data, starts = gen2d.torch.dataset(ds, seed=0), []
    for epoch in range(30):
        data.set_epoch(epoch)
        starts.append(starts_of(data))
    counts = np.bincount(np.concatenate(starts), minlength=4)
    assert len(counts) == 4
    assert (abs(counts - 150) < 5 * 12.2 * (3 / 4) ** 0.5).all()  # of 600, each frame a quarter
    assert len(set(map(tuple, starts))) == 30
    assert starts_of(gen2d.torch.dataset(ds, seed=1)) != starts[0] == starts_of(gen2d.torch.dataset(ds))


def test_a_mixture_goes_on_in_each_epoch(toy: Path) -> None:
    torch()
    ds = {name: loader.open(toy, name, fields="index", window=2) for name in ("train", "test")}
    mixture = gen2d.mix(ds)
    data = gen2d.torch.dataset(mixture)
    for epoch, batch in enumerate(gen2d.DataLoader(mixture, len(mixture), shuffle=False, epochs=3)):
        data.set_epoch(epoch)
        assert [int(data[i]["index"]) for i in range(len(data))] == batch["index"].tolist()


def test_parts_and_copies_of_a_dataset_give_its_windows(toy: Path) -> None:
    torch()
    utils = package("torch").utils.data
    data = gen2d.torch.dataset(loader.open(toy, fields=FIELDS, window=2), seed=5)
    data.set_epoch(4)
    whole = [data[i] for i in range(TRAIN)]
    for other in (copy.copy(data), copy.deepcopy(data), pickle.loads(pickle.dumps(data))):
        assert other.epoch == 4
        same([other[i] for i in range(TRAIN)], whole)
    separate = pickle.loads(pickle.dumps(data))
    separate.set_epoch(5)
    assert data.epoch == 4
    one, other = utils.random_split(data, [12, 8], package("torch").Generator().manual_seed(0))
    same(iter(one), [whole[i] for i in one.indices])
    same(iter(other), [whole[i] for i in other.indices])
    both = utils.ConcatDataset([data, data])
    same([both[TRAIN + 3]], [whole[3]])


def test_whole_videos_and_text_are_collated(toy: Path, stored: dict[str, np.ndarray], tmp_path: Path) -> None:
    torch()
    batches = list(data_loader(gen2d.torch.dataset(loader.open(toy, fields=FIELDS)), (2, "fork"), batch_size=8))
    assert_array_equal(np.concatenate([batch["frames"] for batch in batches]), stored["frames"])
    fields = synthetic.FIELDS | {"text/caption": Field("S8", "n", "UTF-8", "what is seen")}
    spec = synthetic.make(synthetic.dataset(tmp_path / "text", fields=fields))
    batch = next(iter(data_loader(gen2d.torch.dataset(loader.open(spec.root, fields="*")), batch_size=4)))
    assert batch["index"].tolist() == [0, 1, 2, 3]
    assert [type(text) for text in batch["text/caption"]] == [np.bytes_] * 4


def test_the_sampler_sets_the_epoch_of_order_and_windows(toy: Path) -> None:
    torch()
    data = gen2d.torch.dataset(loader.open(toy, fields=FIELDS, window=2), seed=2)
    order = gen2d.torch.sampler(data)
    batches, orders = data_loader(data, (2, "fork"), batch_size=4, sampler=order, persistent_workers=True), []
    assert len(order) == TRAIN
    for epoch in range(3):
        order.set_epoch(epoch)
        actual = list(batches)
        assert data.epoch == epoch
        orders.append(np.concatenate([batch["index"] for batch in actual]).tolist())
        same([actual[0]], [next(iter(data_loader(data, batch_size=4, sampler=orders[-1])))])
    assert all(sorted(each) == list(range(TRAIN)) for each in orders)
    assert len(set(map(tuple, orders))) == 3
    assert list(gen2d.torch.sampler(data, shuffle=False)) == list(range(TRAIN))


@pytest.mark.parametrize("workers", WORKERS)
@pytest.mark.parametrize("kind", ["map-style", "iterable"])
def test_an_epoch_that_is_never_set_gives_one_warning(toy: Path, kind: str, workers: tuple[int, str | None]) -> None:
    torch()

    def new(**options: Any) -> tuple[Any, Any]:
        ds = loader.open(toy, fields=FIELDS, **options)
        data = gen2d.torch.dataset(ds) if kind == "map-style" else gen2d.torch.iterable(ds, 5)
        return data, data_loader(data, workers, batch_size=5 if kind == "map-style" else None)

    data, batches = new(window=2)
    for _ in range(2):
        list(batches)
    with pytest.raises(UserWarning, match="set_epoch was not called, so each epoch is the same"):
        list(batches)
    list(batches)
    data, batches = new(window=2)
    data.set_epoch(0)
    for _ in range(4):
        list(batches)
    if kind == "map-style":  # whole videos do not depend on the epoch
        _, batches = new()
        for _ in range(4):
            list(batches)


@pytest.mark.parametrize("epoch", [-1, 1.5, "2", None, True])
def test_an_epoch_is_a_whole_number(toy: Path, epoch: Any) -> None:
    torch()
    ds = loader.open(toy, window=2)
    for data in (gen2d.torch.dataset(ds), gen2d.torch.iterable(ds)):
        with pytest.raises(ConfigError, match=r"epoch is .*, but must be a whole number, 0 or more"):
            data.set_epoch(epoch)


def test_wrong_arguments_are_named(toy: Path) -> None:
    torch()
    ds: Any = loader.open(toy, window=2)
    wrong: list[tuple[Any, str]] = [
        (lambda: gen2d.torch.dataset(str(toy)), "but must be a dataset from gen2d.open"),  # pyright: ignore
        (lambda: gen2d.torch.dataset(ds, seed=0.5), "seed is 0.5"),  # pyright: ignore
        (lambda: gen2d.torch.sampler(ds), "but must be a dataset from gen2d.torch.dataset"),
        (lambda: gen2d.torch.iterable(ds, 0), "batch_size is 0, but must be a whole number, 1 or more"),
        (lambda: gen2d.torch.iterable(ds, 4, epochs=0), "epochs is 0"),
        (lambda: gen2d.torch.iterable(ds, 4, shuffle="local"), "shuffle is 'local'"),
        (lambda: gen2d.torch.iterable(ds, 21), "21 videos make a global batch, but there are only 20"),
        (
            lambda: gen2d.torch.iterable(ds, 4, rank=2, world_size=2),
            "rank is 2, but must be from 0 to world_size - 1, which is 1",
        ),
        (lambda: gen2d.grain.source(ds, epochs=0), "epochs is 0"),
        (lambda: gen2d.grain.source(5), "ds is 5"),  # pyright: ignore
    ]
    for call, message in wrong:
        with pytest.raises(ConfigError) as caught:
            call()
        assert message in str(caught.value)


def test_torch_is_imported_by_its_module_alone(tmp_path: Path) -> None:
    code = "import gen2d, sys; gen2d.open, gen2d.DataLoader, gen2d.grain; assert 'torch' in dir(gen2d);"
    code += "assert not {'torch', 'grain', 'jax'} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)
    code = "import sys; sys.modules['torch'] = None; import gen2d; gen2d.torch"
    done = subprocess.run([sys.executable, "-c", code], check=False, cwd=tmp_path, capture_output=True, text=True)
    last = done.stderr.strip().splitlines()[-1]
    assert last == "ModuleNotFoundError: gen2d.torch needs PyTorch, which is not installed: pip install torch"


# ---- Iterable


@pytest.mark.parametrize("workers", WORKERS)
@pytest.mark.parametrize("drop_last", [True, False])
def test_batches_are_those_of_gen2d_for_any_workers(
    source: Any, workers: tuple[int, str | None], drop_last: bool
) -> None:
    torch()
    data = gen2d.torch.iterable(source, 6, seed=3, drop_last=drop_last)
    batches = data_loader(data, workers, batch_size=None, **({"persistent_workers": True} if workers[0] else {}))
    expected = iter(list(gen2d.DataLoader(source, 6, seed=3, epochs=3, drop_last=drop_last)))
    assert len(batches) == len(gen2d.DataLoader(source, 6, drop_last=drop_last))
    for epoch in range(3):
        data.set_epoch(epoch)
        same(batches, list(itertools.islice(expected, len(data))))


def test_an_iteration_may_have_several_epochs(toy: Path) -> None:
    torch()
    ds = loader.open(toy, fields=FIELDS, window=2)
    expected = list(gen2d.DataLoader(ds, 6, seed=3, epochs=4))
    several, endless = (gen2d.torch.iterable(ds, 6, seed=3, epochs=epochs) for epochs in (4, None))
    assert len(several) == len(expected)
    same(data_loader(several, (2, "fork"), batch_size=None), expected)
    same(itertools.islice(data_loader(endless, (2, "fork"), batch_size=None), len(expected)), expected)
    with pytest.raises(TypeError, match="epochs=None never ends, so it has no length"):
        len(endless)


@pytest.mark.parametrize("drop_last", [True, False])
@pytest.mark.parametrize("number", [0, 2, 3])
def test_ranks_and_workers_share_the_videos(toy: Path, drop_last: bool, number: int) -> None:
    torch()
    ds = loader.open(toy, "train", fields=FIELDS, window=2)
    workers, seen = (number, "fork" if number else None), []
    expected = list(gen2d.DataLoader(ds, 6, seed=1, epochs=1, drop_last=drop_last))
    parts = []
    for rank in range(3):
        shares: dict[str, Any] = {"rank": rank, "world_size": 3, "drop_last": drop_last}
        parts.append(list(data_loader(gen2d.torch.iterable(ds, 2, 1, **shares), workers, batch_size=None)))
        singles = data_loader(gen2d.torch.iterable(ds, seed=1, **shares), workers, batch_size=4)
        seen += np.concatenate([batch["index"] for batch in singles]).tolist()
    whole = [
        {name: np.concatenate([part[name] for part in ranks]) for name in FIELDS} for ranks in zip(*parts, strict=True)
    ]
    same(whole, [{name: batch[name] for name in FIELDS} for batch in expected])
    assert len(seen) == len(set(seen)) == (18 if drop_last else TRAIN)


def test_ranks_are_those_of_torchrun(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch()
    ds = loader.open(toy, fields=FIELDS, window=2)
    expected = list(gen2d.torch.iterable(ds, 4, rank=1, world_size=2))
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    same(gen2d.torch.iterable(ds, 4), expected)


RANK = """
import sys, torch, gen2d
root, meeting, rank = sys.argv[1], sys.argv[2], int(sys.argv[3])
torch.distributed.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=2)
ds = gen2d.open(root, fields="index", window=2)
batches = torch.utils.data.DataLoader(gen2d.torch.iterable(ds, 4), batch_size=None, num_workers=1)
print([batch["index"].tolist() + batch["window/start"].tolist() for batch in batches])
data = gen2d.torch.dataset(ds)
order = torch.utils.data.DistributedSampler(data)
print([batch["index"].tolist() for batch in torch.utils.data.DataLoader(data, batch_size=5, sampler=order)])
torch.distributed.destroy_process_group()
"""


@pytest.mark.full
def test_the_ranks_of_a_process_group_share_the_videos(toy: Path, tmp_path: Path) -> None:
    torch()
    words = [sys.executable, "-c", RANK, str(toy), str(tmp_path / "meeting")]
    running = [subprocess.Popen([*words, str(rank)], stdout=subprocess.PIPE, text=True) for rank in range(2)]
    shown = [process.communicate(timeout=120)[0].splitlines() for process in running]
    ds = loader.open(toy, fields="index", window=2)
    for rank, lines in enumerate(shown):
        expected = [
            batch["index"].tolist() + batch["window/start"].tolist()
            for batch in gen2d.DataLoader(ds, 4, epochs=1, rank=rank, world_size=2)
        ]
        assert lines[0] == str(expected)
    assert sorted(index for lines in shown for batch in ast.literal_eval(lines[1]) for index in batch) == [
        *range(TRAIN)
    ]


# ---- States


@pytest.mark.parametrize("batch_size", [3, None])
@pytest.mark.parametrize("workers", [(0, None), (2, "fork")])
@pytest.mark.parametrize("done", [0, 1, 4, 6, 11])
def test_a_stateful_loader_resumes_at_the_very_batch(
    toy: Path, workers: tuple[int, str | None], batch_size: int | None, done: int
) -> None:
    torch()

    def new() -> tuple[Any, Any]:
        ds = loader.open(toy, fields=FIELDS, window=2)
        data = gen2d.torch.iterable(ds, batch_size, seed=9, epochs=2)
        return data, data_loader(data, workers, stateful=True, batch_size=None if batch_size else 3)

    data, batches = new()
    data.set_epoch(5)
    expected = list(batches)
    assert len(expected) > 11
    data, batches = new()
    data.set_epoch(5)
    iterator = iter(batches)
    same(itertools.islice(iterator, done), expected[:done])
    state = pickle.loads(pickle.dumps(batches.state_dict()))
    del iterator
    data, batches = new()
    batches.load_state_dict(state)
    same(batches, expected[done:])
    data.set_epoch(5)
    same(batches, expected)  # the next iteration is a whole one


def test_a_map_style_dataset_resumes_with_its_sampler(toy: Path) -> None:
    torch()

    def new() -> Any:
        data = gen2d.torch.dataset(loader.open(toy, fields=FIELDS, window=2), seed=9)
        order = gen2d.torch.sampler(data)
        order.set_epoch(3)
        return data_loader(data, (2, "fork"), stateful=True, batch_size=3, sampler=order)

    expected, batches = list(new()), new()
    same(itertools.islice(batches, 4), expected[:4])
    state, batches = batches.state_dict(), new()
    batches.load_state_dict(state)
    same(batches, expected[4:])


def test_a_state_without_workers_fits_any_number(toy: Path) -> None:
    torch()
    data = gen2d.torch.iterable(loader.open(toy, fields=FIELDS, window=2), 3, epochs=2)
    expected, iterator = list(data), iter(data)
    same(itertools.islice(iterator, 5), expected[:5])
    state = data.state_dict()
    for workers in ((0, None), (2, "fork"), (3, "fork")):
        data.load_state_dict(state)
        same(data_loader(data, workers, batch_size=None), expected[5:])
        data.load_state_dict(state)
        list(data)  # a process without workers has used the state up


def test_a_state_of_another_order_is_refused(toy: Path, tmp_path: Path) -> None:
    torch()
    ds = loader.open(toy, fields=FIELDS, window=2)
    state = gen2d.torch.iterable(ds, 4).state_dict()
    other = loader.open(synthetic.make(synthetic.dataset(tmp_path / "other", seed=8)).root, window=2)
    for data, message in [
        (gen2d.torch.iterable(ds, 4, seed=1), "the state has seed 0, but this dataset has 1"),
        (gen2d.torch.iterable(ds, 5), "the state has global_batch_size 4, but this dataset has 5"),
        (gen2d.torch.iterable(ds, 4, shuffle=False), "the state has shuffle True"),
        (gen2d.torch.iterable(other, 4), "open it with the snapshot of the state"),
    ]:
        with pytest.raises(ConfigError, match=message):
            data.load_state_dict(state)
    data = gen2d.torch.iterable(ds, 4)
    for broken in ({}, state | {"position": -1}, state | {"epoch": "2"}, state | {"workers": 2}, None):
        with pytest.raises(ConfigError, match=r"the state|position is -1|epoch is '2'"):
            data.load_state_dict(broken)  # pyright: ignore
    data.load_state_dict(state)
