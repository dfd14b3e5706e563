"""A dataset, and a mixture of several, is what torch's and Grain's own loaders take as it is."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from packages import package

import gen2d
from gen2d.loading import dataset as loader

FIELDS = ("index", "frames", "states/*")


@pytest.fixture(scope="module", params=["dataset", "mixture"])
def source(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A map-style source of 20 videos."""
    root = synthetic.make(synthetic.dataset(tmp_path_factory.mktemp("data") / "toy")).root
    dataset = loader.open(root, "train", FIELDS)
    return dataset if request.param == "dataset" else gen2d.mix({"one": dataset, "other": dataset})


def check(batches: Sequence[dict[str, Any]], source: Any, order: Sequence[int]) -> None:
    """Fails unless the batches hold the videos at these positions, to the bit."""
    for name, values in source[np.asarray(order)].items():
        actual = np.concatenate([np.asarray(batch[name]) for batch in batches])
        assert actual.dtype == values.dtype
        assert_array_equal(actual, values)


# ---- torch


@pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")  # more than this process has cores
@pytest.mark.parametrize("method", [None, "fork", "spawn"])
def test_torch_reads_the_same_in_any_number_of_processes(source: Any, method: str | None) -> None:
    torch = package("torch")
    workers = {"num_workers": 2, "multiprocessing_context": method} if method else {"num_workers": 0}
    batches = list(torch.utils.data.DataLoader(source, batch_size=6, **workers))
    assert [len(batch["index"]) for batch in batches] == [6] * (len(source) // 6) + [len(source) % 6]
    assert all(isinstance(values, torch.Tensor) for batch in batches for values in batch.values())
    check(batches, source, range(len(source)))


def test_torch_asks_for_whole_batches(source: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    torch = package("torch")
    requests: list[list[int]] = []
    whole = type(source).__getitems__
    monkeypatch.setattr(
        type(source), "__getitems__", lambda self, indices: requests.append(list(indices)) or whole(self, indices)
    )
    generator = torch.Generator().manual_seed(0)
    batches = list(torch.utils.data.DataLoader(source, batch_size=5, shuffle=True, generator=generator))
    order = [number for batch in requests for number in batch]
    assert [len(batch) for batch in requests] == [5] * (len(source) // 5)
    assert sorted(order) == list(range(len(source)))
    check(batches, source, order)


# ---- Grain


def test_grain_shuffles_and_batches(source: Any) -> None:
    package("grain")
    grain = importlib.import_module("grain.python")
    plain = grain.MapDataset.source(source)
    assert len(plain) == len(source)
    check(list(plain.batch(4)), source, range(len(source)))
    numbers = grain.MapDataset.source(np.arange(len(source))).seed(7).shuffle()
    batches = list(plain.seed(7).shuffle().batch(4))
    check(batches, source, [int(numbers[place]) for place in range(len(source))])
    assert sorted(int(numbers[place]) for place in range(len(source))) == list(range(len(source)))


@pytest.mark.parametrize("workers", [0, 2])
def test_grains_own_loader_reads_the_same(source: Any, workers: int) -> None:
    package("grain")
    grain = importlib.import_module("grain.python")
    importlib.import_module("absl.flags").FLAGS.mark_as_parsed()  # as absl.app does; Grain asks them for its workers
    sampler = grain.IndexSampler(len(source), shuffle=False, num_epochs=1, seed=0)
    loading = grain.DataLoader(data_source=source, sampler=sampler, operations=[grain.Batch(5)], worker_count=workers)
    batches = list(loading)
    order = [int(number) for batch in batches for number in batch["index"]]
    assert sorted(order) == sorted(source[:]["index"].tolist())
    if workers == 0:
        check(batches, source, range(len(source)))
