"""Splits and videos of a kind as datasets: the same whatever is made first, alone or together; the study's presets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from synthetic import tree

import gen2d
from gen2d.config.config import load_config
from gen2d.config.joint_distribution import intersect
from gen2d.core.errors import ConfigError
from gen2d.core.permutation import hashed
from gen2d.programs import devices
from gen2d.programs.rollout import DeviceBatch, Rollout
from gen2d.records import keys as keys_module
from gen2d.sampling import rejection
from gen2d.sampling.sampler import Sampler

CONFIG = {
    "name": "tiny",
    "video": {"frames": 10, "fps": 10, "height": 16, "width": 16},
    "scene": {"name": "bouncing", "balls": [2, 3], "radius": [0.5, 1.0]},
    "physics": {"substeps": 2},
    "storage": {"batch_size": 8, "videos_per_shard": 8},
}
SPLITS = {
    "train": {"frames": 6, "factors": {"minus": [{}, {"radius": [0.7, 0.8]}]}},
    "holes": {"videos": 9, "factors": {"radius": [0.7, 0.8]}},
    "heavier": {"videos": 3, "factors": {"gravity": [0, -30]}},
}
PRESETS = {"uniform_motion": 7, "parabola": 7, "collision": 13}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "whole"
    summary = gen2d.generate(CONFIG | {"splits": SPLITS}, 12, root, seed=4)
    assert (summary.generated, summary.complete) == (24, True)
    return root


def test_a_dataset_is_the_same_whatever_split_is_made_first(whole, tmp_path):
    config = CONFIG | {"splits": SPLITS}
    for split, count in (("heavier", 3), ("train", 12), ("holes", 9)):
        gen2d.generate(config, count, tmp_path / "one", seed=4, split=split)
    assert tree(tmp_path / "one") == tree(whole)


def test_each_video_says_its_split_and_how_far_outside_it_is(whole):
    for split, count in (("train", 12), ("holes", 9), ("heavier", 3)):
        videos = gen2d.open(whole, split, fields=("split", "out_of_distribution", "ood_distance/*", "factors/*"))[:]
        assert videos["split"].tolist() == [split.encode()] * count
        assert (videos["out_of_distribution"] == (split != "train")).all()
        assert (videos["ood_distance/radius"].max(1) > 0).all() == (split == "holes")
        assert (videos["ood_distance/gravity"][:, 1] > 0).all() == (split == "heavier")


def test_a_split_may_give_the_first_frames_only(whole):
    """So that what is learnt on short videos can be asked of longer ones."""
    short, long = gen2d.open(whole, "train"), gen2d.open(whole, "holes")
    assert (short[0]["frames"].shape[0], len(short.time)) == (6, 6)
    assert (long[0]["frames"].shape[0], len(long.time)) == (10, 10)
    every = gen2d.open(whole, "train", window=2)
    starts = every._starts(np.zeros(5, np.int64), np.arange(5, dtype=np.uint64) * 7)
    assert starts is not None
    assert starts.max() <= 4
    with pytest.raises(ConfigError, match="need 7 frames, but the videos have 6"):
        gen2d.open(whole, "train", window=7, start="first")
    batch = next(iter(gen2d.stream(CONFIG | {"splits": SPLITS}, 4, 8, split="train", n=12)))
    for name, values in gen2d.open(whole, "train").batch(np.arange(8)).items():
        assert_array_equal(batch[name], values)
    with pytest.raises(ConfigError, match=r"splits.train.frames is 11, but must be video.frames, 10, or less"):
        load_config(CONFIG | {"splits": {"train": {"frames": 11}}})


def test_a_stream_of_a_split_is_the_dataset_s(whole):
    fields = ["factors/radius", "states/position", "split"]
    batch = next(iter(gen2d.stream(CONFIG | {"splits": SPLITS}, 4, 8, split="holes", fields=fields, n=9)))
    stored = gen2d.open(whole, "holes", fields=fields)[:8]
    for name in fields:
        assert_array_equal(np.asarray(batch[name]), stored[name])


def test_a_split_that_there_is_not_is_said():
    with pytest.raises(ConfigError, match="must be one of the config's: train, holes, heavier"):
        gen2d.generate(CONFIG | {"splits": SPLITS}, 3, "nowhere", split="hole")


@pytest.mark.parametrize("family", PRESETS)
def test_the_study_s_splits_have_nothing_in_common_with_training_and_start_in_view(family):
    config = load_config(f"phyworld_{family}.yaml")
    assert len(config.splits) == PRESETS[family] + 1
    training, of = config.training, Sampler(config)
    assert training is not None
    starts = jax.jit(jax.vmap(of.sample, (0, None)))
    for row, split in enumerate(config.splits):
        assert (intersect(training.distribution, split.distribution) is None) == (split.name not in ("train", "test"))
        keys = keys_module.video_keys(jnp.asarray(keys_module.seed_words(0, row)), jnp.arange(500, dtype=jnp.uint32))
        drawn, made = jax.tree.map(np.asarray, starts(keys, row))
        position, radius = made.state.position, made.scene.objects.radius
        assert np.isfinite(position).all()
        assert (position[..., 1] - radius >= -1e-5).all()
        assert (position[..., 1] + radius <= 10 + 1e-5).all()
        assert (np.abs(position[..., 0] - 5) + radius <= 5 + 1e-5).all()
        assert len(np.unique(position.reshape(500, -1), axis=0)) == 500
        if family == "collision":
            gap = position[:, 1, 0] - position[:, 0, 0] - radius.sum(1)
            closing, frame = drawn["speed_1"] + drawn["speed_2"], drawn["contact_frame"]
            np.testing.assert_allclose(gap[closing > 0], (frame * closing / 10)[closing > 0], rtol=1e-3, atol=1e-4)
            feasible = 10 - 2 * radius.sum(1) >= 0.8 * closing
            assert (((frame >= 8 - 1e-4) & (frame <= 24 + 1e-4)) | ~feasible | (closing == 0)).all()


# ---- Videos of a kind


def columns(numbers, **asked):
    """The columns of the training videos with these numbers, a lane each."""
    config = CONFIG | {"quality": asked, "storage": {"batch_size": len(numbers)}}
    (batch,) = Rollout(load_config(config), devices.prepare("cpu")[:1]).start("train", np.array(numbers))
    return {name: np.asarray(values) for name, values in batch.columns.items()}


def test_videos_of_a_kind_are_those_that_are_and_others_in_place_of_the_rest():
    every, some = columns(range(8)), columns(range(8), min_contacts=1, max_contacts=2)
    contacts, tried = some["quality/contacts"], some["quality/rejected_videos"]
    assert ((contacts >= 1) & (contacts <= 2)).all()
    assert 0 < (tried == 0).sum() < 8
    assert_array_equal(tried == 0, (every["quality/contacts"] >= 1) & (every["quality/contacts"] <= 2))
    for name, values in every.items():
        assert_array_equal(values[tried == 0], some[name][tried == 0])
    assert (every["states/position"][tried > 0] != some["states/position"][tried > 0]).any((1, 2, 3)).all()


@pytest.mark.full
def test_how_little_may_be_seen_of_an_object_can_be_asked_for(tmp_path):
    seen = {"annotations": {"visibility": True}, "scene": {"name": "bouncing", "balls": 4, "radius": [0.8, 1.0]}}
    every, some = ({"quality": asked} | seen for asked in ({}, {"min_visibility": 0.7}))
    found = []
    for number, more in enumerate((every, some)):
        gen2d.generate(CONFIG | more, 8, tmp_path / str(number), seed=1)
        found.append(gen2d.open(tmp_path / str(number), fields=("quality/*", "frames"))[:])
    least, tried = found[1]["quality/min_visibility"], found[1]["quality/rejected_videos"]
    assert (least >= 0.7).all()
    assert_array_equal(tried == 0, found[0]["quality/min_visibility"] >= 0.7)
    assert 0 < (tried == 0).sum() < 8
    assert_array_equal(found[0]["frames"][tried == 0], found[1]["frames"][tried == 0])


def test_a_video_does_not_depend_on_what_is_made_with_it():
    """Attempts are tried in order, however many of them fit into a batch."""

    def luck(lanes: np.ndarray, attempts: np.ndarray) -> np.ndarray:
        return hashed(lanes, attempts).astype(np.int64) % 17

    options = load_config(CONFIG | {"quality": {"max_contacts": 1}}).quality
    for count in (1, 3, 8):
        numbers = np.arange(count)
        _, chosen = rejection.accepted_batch(lambda lanes, attempts: _batch(luck(lanes, attempts)), numbers, options)
        for number in numbers:
            tries = luck(np.full(1000, number), np.arange(1000))
            assert chosen[number] == np.argmax(tries <= 1)


def _batch(values: np.ndarray) -> DeviceBatch:
    return DeviceBatch({"quality/contacts": jnp.asarray(values)}, (), jnp.ones(len(values), bool))  # type: ignore[arg-type]


def test_a_kind_that_there_is_not_is_said(tmp_path):
    asked = {"min_contacts": 500, "attempts": 20}
    with pytest.raises(
        rejection.NoVideoError, match="none of 20 attempts at video 0 has quality/contacts from 500 to inf"
    ):
        gen2d.generate(CONFIG | {"quality": asked}, 2, tmp_path / "none")
    for wrong, message in (
        (
            {"min_contacts": 5, "max_contacts": 2},
            "quality.min_contacts is 5, but must be max_contacts, 2, or less",
        ),
        ({"max_visibility": 0.5}, "quality.max_visibility is asked for, but needs annotations.visibility"),
        ({"max_lyapunov": 2}, "quality.max_lyapunov is asked for, but needs annotations.lyapunov"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_config(CONFIG | {"quality": wrong})
