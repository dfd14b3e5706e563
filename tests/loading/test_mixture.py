"""A mixture keeps its proportions at every position, gives each video as often as any other, and resumes."""

import pickle
from collections import Counter
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

import gen2d
from gen2d.core.errors import ConfigError
from gen2d.loading import dataset as loader
from gen2d.loading.mixture import Mixture, tijdeman_schedule

WEIGHTS = {"a": 0.5, "b": 0.3, "c": 0.2}


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, loader.Dataset]:
    folder = tmp_path_factory.mktemp("data")
    sizes = {"a": 20, "b": 9, "c": 31}
    roots = {name: synthetic.make(synthetic.dataset(folder / name, train=n)).root for name, n in sizes.items()}
    return {name: loader.open(root, "train", ("index", "states/angle")) for name, root in roots.items()}


def videos(mixture: Mixture, batches: Any) -> list[tuple[str, int]]:
    """The source and number of each video delivered: positions and sources go together in every epoch."""
    numbers = [int(number) for batch in batches for number in batch["index"]]
    names = mixture.source_of([position % len(mixture) for position in range(len(numbers))])
    return list(zip(names, numbers, strict=True))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 60), min_size=1, max_size=7))
def test_every_source_has_its_share_within_one_at_every_position(shares: list[int]) -> None:
    period, schedule = sum(shares), tijdeman_schedule(shares, [10**6] * len(shares))
    assert len(schedule) == period
    counts = np.cumsum(schedule[:, None] == np.arange(len(shares)), axis=0)
    due = np.arange(1, period + 1)[:, None] * np.array([float(Fraction(share, period)) for share in shares])
    assert abs(counts - due).max() < 1
    assert counts[-1].tolist() == shares


@pytest.mark.parametrize("weights", [WEIGHTS, [1, 1, 1], [3, 1, 1000], None, [0.001, 1, 2], [1 / 3, 1 / 3, 1 / 7]])
def test_an_epoch_is_as_long_as_no_video_comes_twice(sources: dict, weights: Any) -> None:
    mixture = gen2d.mix(sources, weights)
    actual = videos(mixture, [mixture[:]])
    assert len(set(actual)) == len(mixture) == len(actual)
    given = [1, 1, 1] if weights is None else weights if isinstance(weights, list) else list(weights.values())
    due = np.arange(1, len(mixture) + 1)[:, None] * np.array(given) / sum(given)
    names = np.array([name for name, _ in actual])
    assert abs(np.cumsum(names[:, None] == np.array(list(sources)), axis=0) - due).max() < 1.01
    counts = Counter(name for name, _ in actual)
    assert any(counts[name] == len(source) for name, source in sources.items())
    whole = {name: source[:]["states/angle"] for name, source in sources.items()}
    assert_array_equal(mixture[:]["states/angle"], np.stack([whole[name][number] for name, number in actual]))


def test_over_epochs_every_video_comes_equally_often(sources: dict) -> None:
    mixture = gen2d.mix(sources, WEIGHTS)
    for shuffle in (True, False):
        loading = gen2d.DataLoader(mixture, 6, seed=3, shuffle=shuffle, epochs=31, drop_last=False)
        often = Counter(videos(mixture, loading))
        for name, source in sources.items():
            own = [often[name, number] for number in range(len(source))]
            assert max(own) - min(own) <= 1, name


def test_shuffling_leaves_the_proportions_of_each_batch(sources: dict) -> None:
    mixture = gen2d.mix(sources, WEIGHTS)
    one, other = (videos(mixture, gen2d.DataLoader(mixture, 10, seed=seed, epochs=1)) for seed in (0, 1))
    assert [name for name, _ in one] == [name for name, _ in other]
    assert one != other
    for first in range(0, len(one), 10):
        assert Counter(name for name, _ in one[first : first + 10]) == {"a": 5, "b": 3, "c": 2}


def test_each_dataset_has_an_order_of_its_own(sources: dict) -> None:
    mixture = gen2d.mix({"a": sources["c"], "b": sources["c"]})
    actual = videos(mixture, gen2d.DataLoader(mixture, 2, epochs=1))
    one, other = ([number for name, number in actual if name == source] for source in "ab")
    assert sorted(one) == sorted(other) == list(range(31))
    assert sum(a == b for a, b in zip(one, other, strict=True)) < 10


def test_a_mixture_resumes_at_the_very_batch_on_any_world_size(sources: dict) -> None:
    roots = {name: loader.open(source.root, "train", ("index", "states/angle"), 2) for name, source in sources.items()}
    mixture = gen2d.mix(roots, WEIGHTS)
    full = gen2d.DataLoader(mixture, 6, epochs=2)
    expected, states = [], [full.state_dict()]
    for batch in full:
        expected.append(batch)
        states.append(full.state_dict())
    for done, state in enumerate(states[:-1]):
        parts = []
        for rank in range(2):
            part = gen2d.DataLoader(pickle.loads(pickle.dumps(mixture)), 3, epochs=2, rank=rank, world_size=2)
            part.load_state_dict(state)
            parts.append(list(part))
        for shares, batch in zip(zip(*parts, strict=True), expected[done:], strict=True):
            for name, values in batch.items():
                assert_array_equal(np.concatenate([share[name] for share in shares]), values)


def test_a_state_of_other_weights_is_refused(sources: dict) -> None:
    one, other = (gen2d.DataLoader(gen2d.mix(sources, weights), 6) for weights in (WEIGHTS, [1, 2, 3]))
    state = one.state_dict()
    other.epoch_sampler.videos = one.epoch_sampler.videos  # a mixture of the same length
    with pytest.raises(ConfigError, match=r"the state has shares \[5, 3, 2\], but the dataset \[1, 2, 3\]"):
        other.load_state_dict(state)


def test_a_filtered_mixture_keeps_its_proportions(sources: dict) -> None:
    mixture = gen2d.mix(sources, WEIGHTS)
    found, expected = mixture.filter("index >= 4"), {name: own.filter("index >= 4") for name, own in sources.items()}
    assert found.shares == mixture.shares
    other = gen2d.mix(expected, WEIGHTS)
    assert videos(found, [found[:]]) == videos(other, [other[:]])
    assert (found[:]["index"] >= 4).all()
    with pytest.raises(ConfigError, match=r"filter is 'index > 900', which is true of no video of dataset \w+"):
        mixture.filter("index > 900")
    with pytest.raises(AttributeError, match="call select of its datasets, then"):
        mixture.select([0])


def test_a_mixture_of_mixtures_is_refused(sources: dict) -> None:
    inner: Any = gen2d.mix(sources)
    with pytest.raises(ConfigError, match="dataset inner is a mixture, but must be a dataset"):
        gen2d.mix({"inner": inner, **sources})


def test_a_mixture_of_one_is_that_one(sources: dict) -> None:
    mixture = gen2d.mix({"a": sources["a"]}, {"a": 2.5})
    assert len(mixture) == 20
    assert_array_equal(mixture[[3, -1]]["index"], [3, 19])
    assert [video["index"] for video in mixture.__getitems__([4, 2])] == [4, 2]
    with pytest.raises(IndexError, match="video 20 is not there"):
        mixture[20]


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"a": 1, "b": 1, "d": 1}, "weights has the names a, b, d, but must have a, b, c"),
        ([1, 2], "weights has 2 numbers, but there are 3 datasets"),
        ([1, 0, 1], "weights of b is 0, but must be"),
        ([1, float("nan"), 1], "weights of b is nan"),
        ([1, 1, "many"], "weights of c is 'many'"),
    ],
)
def test_wrong_weights_are_named(sources: dict, weights: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        gen2d.mix(sources, weights)


def test_datasets_that_do_not_fit_are_named(sources: dict, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="datasets is empty"):
        gen2d.mix({})
    less = loader.open(sources["b"].root, "train", "index")
    with pytest.raises(ConfigError, match="dataset b has no field 'states/angle', but a has: open both with"):
        gen2d.mix({"a": sources["a"], "b": less})
    other = synthetic.make(synthetic.dataset(tmp_path, sizes={"T": 5, "H": 8, "W": 8, "K": 4})).root
    with pytest.raises(ConfigError, match=r"states/angle of dataset b is float32 \(5, 4\), but of a float32 \(5, 3\)"):
        gen2d.mix({"a": sources["a"], "b": loader.open(other, "train", ("index", "states/angle"))})
