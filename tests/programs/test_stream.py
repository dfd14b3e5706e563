"""Streams: the batches of a dataset, without the dataset."""

import itertools
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from packages import package
from tiny import CONFIG, CROWDED, tiny_config

import gen2d
from gen2d.core.errors import ConfigError
from gen2d.programs.source import NoPlaceError
from gen2d.programs.stream import Stream, cell_size

VIDEOS = 22


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("root") / "tiny"
    gen2d.generate(CONFIG, VIDEOS, out, seed=5)
    return out


def open_stream(batch_size: int = 4, **options: Any) -> Stream:
    return gen2d.stream(CONFIG, 5, batch_size, n=VIDEOS, **options)


def assert_same(stream, loader, count: int | None = None) -> None:
    """Fails unless both give the same batches, the first `count` of them."""
    for here, there in itertools.islice(zip(stream, loader, strict=count is None), count):
        assert here.keys() == there.keys()
        for name, array in here.items():
            assert_array_equal(np.asarray(array), there[name], err_msg=name)


@pytest.mark.parametrize("shuffle", [False, "global"])
@pytest.mark.parametrize("batch_size", [1, 3, 4, 9])
def test_a_stream_gives_the_batches_of_the_dataset(root: Path, batch_size: int, shuffle: bool | str):
    options: dict[str, Any] = {"shuffle": shuffle, "epochs": 1, "drop_last": False}
    loader = gen2d.DataLoader(gen2d.open(root, fields="*"), batch_size, seed=7, **options)
    assert_same(open_stream(batch_size, fields="*", order_seed=7, **options), loader)


@pytest.mark.parametrize(
    "view",
    [
        {"window": 3, "stride": 2, "layout": "TCHW"},
        {"window": 2, "start": 1, "dtype": "float32"},
        {"fields": ["states/position", "factors/*", "index"]},
        {"fields": "frames", "layout": "CTHW", "dtype": "float32"},
    ],
)
def test_windows_layouts_and_types_are_those_of_the_loader(root: Path, view: dict):
    options: dict[str, Any] = {"shuffle": True, "epochs": 2}
    ds = gen2d.open(root, **view)
    assert_same(open_stream(**view, **options), gen2d.DataLoader(ds, 4, **options, to="jax"))
    assert open_stream(**view).fields.keys() == ds.fields.keys()


@pytest.mark.parametrize("drop_last", [True, False])
def test_a_state_goes_on_in_a_stream_or_in_a_loader_on_any_number_of_ranks(root: Path, drop_last: bool):
    options: dict[str, Any] = {"shuffle": True, "drop_last": drop_last, "epochs": 2}
    ds = gen2d.open(root)
    stream = open_stream(6, **options)
    assert len(list(itertools.islice(stream, 2))) == 2
    state = stream.state_dict()
    for rank in range(3):
        ranks: dict[str, Any] = {"rank": rank, "world_size": 3}
        here, there = open_stream(2, **options, **ranks), gen2d.DataLoader(ds, 2, **options, **ranks)
        here.load_state_dict(state)
        there.load_state_dict(state)
        assert here.state_dict() == state
        assert there.state_dict() == state | {"snapshot": ds.snapshot}
        assert_same(here, there)
        assert there.state_dict() == here.state_dict() | {"snapshot": ds.snapshot}


def test_without_an_end_it_begins_like_the_dataset_and_goes_on(root: Path):
    stream = gen2d.stream(CONFIG, 5, 4, fields=["states/*", "index"])
    batches = list(itertools.islice(stream, 8))
    assert_array_equal(np.concatenate([b["index"] for b in batches]), np.arange(32))
    stored = gen2d.open(root).batch(range(20))
    assert_array_equal(np.concatenate([b["states/position"] for b in batches[:5]]), stored["states/position"])


def test_arrays_are_on_the_device_and_torch_takes_them(root: Path):
    assert isinstance(next(iter(open_stream()))["frames"], jax.Array)
    torch = package("torch")
    batch = next(iter(open_stream(to="torch")))
    assert batch["frames"].dtype == torch.uint8
    assert_array_equal(batch["frames"].numpy(), gen2d.open(root).batch(range(4))["frames"])


@given(st.integers(1, 600), st.sampled_from([1, 4, 6, 64, 100, 512]))
def test_cells_waste_little(batch_size: int, lanes: int):
    cell = cell_size(batch_size, lanes)
    assert lanes % cell == 0
    assert -(-batch_size // cell) * cell <= batch_size * 9 / 8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fields": "framess"}, "frames"),
        ({"window": 7}, "7 frames"),
        ({"to": "numpy"}, "to is 'numpy'"),
        ({"layout": "HWC"}, "layout is 'HWC'"),
        ({"shuffle": "some"}, "shuffle is 'some'"),
        ({"n": 0}, "n is 0"),
        ({"rank": 2}, "rank"),
        ({"batch_size": 0}, "batch_size"),
        ({"n": 3}, "only 3"),
    ],
)
def test_a_wrong_option_is_an_error(options: dict, message: str):
    with pytest.raises(ConfigError, match=message) as caught:
        gen2d.stream(CONFIG, **{"batch_size": 4, **options})
    assert "\n" not in str(caught.value)


@pytest.mark.full
def test_a_scene_that_does_not_fit_is_an_error():
    with pytest.raises(NoPlaceError, match="could not be placed"):
        next(iter(gen2d.stream(tiny_config(scene=CROWDED), batch_size=4)))
