"""Laws: cut exactly, drawn from as declared, compared without drawing; splits that have provably nothing in common."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from gen2d.config import truncation
from gen2d.config.config import load_config
from gen2d.config.distribution_syntax import parse
from gen2d.config.distributions import Distribution, Span, next_float32
from gen2d.config.joint_distribution import intersect, parse_distribution
from gen2d.core.errors import ConfigError
from gen2d.records import keys as keys_module
from gen2d.sampling.sampler import Sampler

COUNT = 4000
RED, BLUE = [255, 0, 0], [0, 0, 255]
SMALL = {"storage": {"batch_size": 8}, "video": {"frames": 4, "height": 16, "width": 16}}

DISTRIBUTIONS = st.sampled_from(
    [3, [0, 4], {"log_uniform": [0.5, 8]}, {"integer": [0, 5]}, {"choice": [0.5, 1, 2, 3]}, {"normal": [2, 1]},
     {"normal": [1, 1, 0, 3]}, {"mixture": [[0, 1], {"choice": [2, 3]}, [2.5, 4]], "weights": [1, 2, 3]}]
)  # fmt: skip


def read(written):
    return {name: parse(value) for name, value in written.items()}


def draws(source: Distribution, count: int = COUNT) -> np.ndarray:
    return np.asarray(source.sample(jax.random.key(0), (count,)), np.float64)


# ---- Numbers


@settings(max_examples=25, deadline=None)
@given(DISTRIBUTIONS, DISTRIBUTIONS)
def test_what_is_cut_is_inside_or_outside_and_both_are_all(one, other):
    source, region = parse(one), parse(other).spans
    inside, outside = truncation.inside(source, region), truncation.outside(source, region)
    assert_allclose(truncation.total(inside) + truncation.total(outside), 1, atol=1e-6)
    held = np.any([span.contains(draws(source)) for span in region], axis=0)
    assert_allclose(held.mean(), truncation.total(inside), atol=4 * 0.5 / np.sqrt(COUNT))
    for pieces, expected in ((inside, True), (outside, False)):
        if pieces:
            values = draws(truncation.mixture(pieces), 400)
            assert source.contains(values).all()
            assert (np.any([span.contains(values) for span in region], axis=0) == expected).all()


@pytest.mark.parametrize(
    ("value", "cut", "share"),
    [
        ([0, 4], [1, 2], 0.25),
        ({"log_uniform": [1, 100]}, [1, 10], 0.5),
        ({"integer": [1, 8]}, [3, 5], 2 / 8),  # without 5
        ({"normal": [0, 1]}, [-1, 1], 0.6827),
        ({"choice": [1, 2, 4]}, [1, 3], 2 / 3),
    ],
)
def test_the_probability_of_a_piece_is_its_share(value, cut, share):
    inside = truncation.inside(parse(value), parse(cut).spans)
    assert_allclose(truncation.total(inside), share, rtol=1e-4)


def test_ranges_that_meet_have_nothing_in_common():
    low, high = parse([0.7, 1.4]), parse([1.4, 2.0])
    assert low.spans[0].intersect(high.spans[0]) is None
    assert not low.contains(1.4)
    assert high.contains(1.4)
    assert low.spans[0].last < 1.4 < next_float32(low.spans[0].last) + 1e-6


def test_whole_numbers_and_ranges_meet_in_whole_numbers():
    both = Span(3, 9, whole=True).intersect(Span(4.5, 7.0))
    assert both is not None
    assert both.contains([4, 5, 5.5, 6, 7]).tolist() == [False, True, False, True, False]
    assert Span(3, 9, whole=True).intersect(Span(4.2, 4.8)) is None


def test_a_composed_distribution_is_read_again_as_it_is_written():
    for value in (
        {"minus": [[0.5, 1.5], [1.0, 1.2]]},
        {"minus": [{"normal": [0, 1]}, [-1, 1]]},
        {"mixture": [1, [2, 3]]},
    ):
        source = parse(value)
        assert parse(source.plain()) == source


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"minus": [[0, 1], [-1, 2]]}, "leaves something"),
        ({"mixture": [1, 2], "weights": [1]}, "as many weights"),
        ({"mixture": [1, 2], "weights": [1, 0]}, "above 0"),
        ({"mixture": []}, "list of distributions"),
        ({"grid": [1, 1]}, "different"),
    ],
)
def test_what_cannot_be_composed_is_said(value, message):
    with pytest.raises(ValueError, match=message):
        parse(value)


# ---- Laws


BASE = {"a": parse([0, 4]), "b": parse({"integer": [1, 6]}), "c": parse({"normal": [0, 1]})}


def test_a_law_without_a_box_and_the_box_have_nothing_in_common_and_are_all():
    box = {"a": [1, 2], "b": {"choice": [2, 5]}}
    rest, held = (
        parse_distribution({"minus": [{}, box]}, BASE, read),
        parse_distribution({"intersection": [{}, box]}, BASE, read),
    )
    assert intersect(rest, held) is None
    a, b, c = (draws(BASE[name]) for name in "abc")
    one, other = (joint.contains({"a": a, "b": b, "c": c}) for joint in (rest, held))
    assert (one ^ other).all()
    assert_array_equal(other, (a >= 1) & (a < 2) & np.isin(b, [2, 5]))
    assert intersect(rest, parse_distribution(box, BASE, read)) is None
    point = intersect(parse_distribution({}, BASE, read), parse_distribution(box, BASE, read))
    assert point is not None
    assert parse_distribution(box, BASE, read).contains(point)


def test_held_out_combinations_are_of_both_and_not_of_one():
    corners = [{"a": [0, 1], "b": {"choice": [1]}}, {"a": [3, 4], "b": {"choice": [6]}}]
    train, test = (
        parse_distribution({"minus": [{}, *corners]}, BASE, read),
        parse_distribution({"mixture": corners}, BASE, read),
    )
    assert intersect(train, test) is None
    assert train.contains({"a": 0.5, "b": 6})
    assert not train.contains({"a": 0.5, "b": 1})
    assert intersect(train, parse_distribution({"a": [0.5, 1]}, BASE, read)) is not None  # b may be another


def test_a_condition_changes_other_factors_where_it_holds():
    joint = parse_distribution(
        {"condition": [{}, {"when": {"b": {"choice": [1, 2]}}, "then": {"a": [10, 11]}}]}, BASE, read
    )
    assert joint.contains({"a": 10.5, "b": 2})
    assert not joint.contains({"a": 10.5, "b": 3})
    assert not joint.contains({"a": 3, "b": 2})
    assert_allclose(sum(p.share for p in joint.products if p.parts["a"].contains(10.5)), 1 / 3, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(DISTRIBUTIONS, DISTRIBUTIONS), min_size=2, max_size=2))
def test_two_laws_are_disjoint_just_if_no_draw_is_in_both(written):
    base = {"a": parse(0), "b": parse(0)}
    one, other = (parse_distribution({"a": a, "b": b}, base, read) for a, b in written)
    point = intersect(one, other)
    if point is not None:
        assert one.contains(point)
        assert other.contains(point)
    else:
        values = {name: draws(one.products[0].parts[name], 300) for name in "ab"}
        assert not other.contains(values).any()


# ---- Splits of a config


def sampler(splits, **scene):
    config = load_config(SMALL | {"scene": {"name": "bouncing", "balls": [2, 4], **scene}, "splits": splits})
    return config, Sampler(config)


@functools.partial(jax.jit, static_argnums=0)
def _drawn(of, keys, row, given):
    drawn = jax.vmap(of.sample_factors, (0, None, 0))(keys, row, given)
    return drawn, jax.vmap(of.ood_distances)(drawn)


def drawn(config, of, split, count=COUNT):
    words, numbers = keys_module.seed_words(3, 7), np.arange(count, dtype=np.uint32)
    given = of.grid_values(config.split_index(split), words, numbers)
    found = _drawn(
        of, keys_module.video_keys(jnp.asarray(words), jnp.asarray(numbers)), config.split_index(split), given
    )
    return [{name: np.asarray(values) for name, values in each.items()} for each in found]


def test_the_draws_of_a_split_are_of_its_law_and_tell_how_far_from_training_they_are():
    hole = {"radius": [0.7, 0.8]}
    config, of = sampler({
        "train": {"factors": {"minus": [{}, hole]}},
        "test": {},
        "holes": {"factors": hole},
        "far": {"factors": {"balls": [5, 6], "gravity": [0, [-30, -20]]}},
    }, radius=[0.5, 1.0], gravity=[0, -9.8])  # fmt: skip
    for split in ("train", "test"):
        values, outside = drawn(config, of, split)
        there = np.arange(6) < values["balls"][:, None]
        assert not outside["out_of_distribution"].any()
        assert not any(outside[f"ood_distance/{name}"].any() for name in ("radius", "gravity", "balls"))
        radius = values["radius"]
        assert (~((radius >= 0.7) & (radius < 0.8)) | ~there).all()
        assert (radius[~there] == 0).all()
        assert_allclose((radius[there] < 0.7).mean(), 0.5, atol=0.03)  # .2 of .4 m
    values, outside = drawn(config, of, "holes")
    there = np.arange(6) < values["balls"][:, None]
    assert outside["out_of_distribution"].all()
    radius = values["radius"][there]
    assert_allclose(outside["ood_distance/radius"][there], np.minimum(radius - 0.7, 0.8 - radius), atol=1e-6)
    values, outside = drawn(config, of, "far")
    assert set(np.unique(values["balls"])) == {5, 6}
    assert_array_equal(outside["ood_distance/balls"], values["balls"] - 4)
    assert_allclose(outside["ood_distance/gravity"][:, 1], -9.8 - values["gravity"][:, 1], rtol=1e-6)
    assert not outside["ood_distance/gravity"][:, 0].any()


def test_pairs_of_attributes_are_swapped_for_each_ball():
    pairs = [{"color": RED, "elasticity": [0.8, 1.0]}, {"color": BLUE, "elasticity": [0.0, 0.2]}]
    swapped = [{"color": BLUE, "elasticity": [0.8, 1.0]}, {"color": RED, "elasticity": [0.0, 0.2]}]
    config, of = sampler({
        "train": {"factors": {"mixture": pairs}},
        "swapped": {"factors": {"mixture": swapped, "weights": [3, 1]}},
    })  # fmt: skip
    for split, hard in (("train", RED), ("swapped", BLUE)):
        values, outside = drawn(config, of, split)
        there = np.arange(4) < values["balls"][:, None]
        is_hard = (values["color"] == np.asarray(hard)).all(-1)
        assert ((values["elasticity"] >= 0.8) == is_hard)[there].all()
        assert (is_hard[:, 0] != is_hard[:, 1]).any()  # each ball has a draw of its own
        assert_allclose(is_hard[there].mean(), 0.5 if split == "train" else 0.75, atol=0.02)
        assert outside["out_of_distribution"].all() == (split == "swapped")
        assert not outside["ood_distance/color"].any()  # each factor alone is as in training


def test_a_grid_gives_every_combination_once_before_any_twice():
    config, of = sampler(
        {"train": {"factors": {"minus": [{}, {"gravity": [0, 0], "wall_friction": 0.5}]}},
         "all": {"factors": {}, "overlaps": True}},
        gravity=[0, {"grid": [0, -5, -10]}], wall_friction={"grid": [0, 0.25, 0.5]},
    )  # fmt: skip
    for split, count in (("train", 8), ("all", 9)):
        values, _ = drawn(config, of, split, 4 * count)
        combinations = list(zip(values["gravity"][:, 1].tolist(), values["wall_friction"].tolist(), strict=True))
        rounds = [combinations[i : i + count] for i in range(0, 4 * count, count)]
        assert all(len(set(one)) == count for one in rounds)
        assert rounds[0] != rounds[1]  # in another order
        assert ((0, 0.5) in combinations) == (split == "all")


@pytest.mark.full
def test_draws_of_a_split_do_not_depend_on_the_others():
    near = {"factors": {"radius": [0.3, 0.4]}}
    one, other = (
        sampler({"train": {}, "near": near}),
        sampler({"near": near, "train": {}, "far": {"factors": {"radius": 2}}}),
    )
    alone = sampler({})
    for split in ("train", "near"):
        values = [drawn(*made, split, 50)[0] for made in (one, other)]
        for name in values[0]:
            assert_array_equal(values[0][name], values[1][name])
    assert_array_equal(drawn(*one, "train", 50)[0]["radius"], drawn(*alone, "train", 50)[0]["radius"])


@pytest.mark.parametrize(
    ("splits", "message"),
    [
        ({"train": {}, "near": {"factors": {"radius": [0.9, 1.2]}}}, r"splits.near and splits.train .* radius 0.9"),
        ({"train": {}, "near": {"factors": {"size": 1}}}, "splits.near.factors.size is not a factor"),
        ({"train": {}, "near": {"factors": {"radius": -1}}}, "splits.near.factors.radius is -1"),
        ({"train": {}, "near": {"factor": {}}}, "did you mean factors"),
        ({"train": {}, "near": {"videos": 0}}, "splits.near.videos is 0"),
        ({"train": {"factors": {"minus": [{}, {"radius": [0.1, 9]}]}}}, "minus that leaves something"),
        ({"train": {}, "near": {"look": "shiny"}}, "splits.near: look is 'shiny'"),
        ({"train": {}, "a b": {}}, "letters, digits"),
        ([1], "must be a mapping"),
        ({"train": {"factors": {"mixture": [{}], "radius": 1}}}, "mixture alone"),
    ],
)
def test_a_split_that_cannot_be_is_said_in_a_sentence(splits, message):
    with pytest.raises(ConfigError, match=message):
        sampler(splits, radius=[0.5, 1.0])


def test_sizes_of_splits_are_no_part_of_the_recipe():
    few, many = (sampler({"train": {}, "test": {"videos": n}})[0] for n in (10, 1000))
    assert few.sha256() == many.sha256()
    assert few.sha256() != sampler({"train": {}})[0].sha256()
    assert load_config(few.plain()) == few
