"""The JSON Schema of configs: it accepts what is read, and refuses wrong names, types and ranges as reading does."""

import dataclasses
import functools
import json
from collections.abc import Iterator
from typing import Any

import fuzz
import pytest
from packages import package

from gen2d.config.config import SECTIONS, load_config
from gen2d.config.json_schema import json_schema
from gen2d.config.options import Option
from gen2d.config.plugins import config_folder, config_names, load, names
from gen2d.config.reading import parse_yaml
from gen2d.config.resolved import resolved
from gen2d.config.sections import SimulationAnnotations
from gen2d.core.errors import ConfigError


@functools.cache
def validator(family: str | None = None) -> Any:
    classes = package("jsonschema").Draft202012Validator
    return classes(json_schema(family))


def read(config: Any) -> bool:
    try:
        load_config(config)
    except ConfigError:
        return False
    return True


@pytest.mark.parametrize("family", [None, *names("scene")])
def test_the_schema_is_one_of_draft_2020_12(family: str | None) -> None:
    package("jsonschema").Draft202012Validator.check_schema(json_schema(family))


@pytest.mark.parametrize("name", config_names())
def test_shipped_configs_and_their_resolved_forms_are_accepted(name: str) -> None:
    config = load_config(name)
    own, every = validator(config.scene.name), validator()
    for plain in (parse_yaml((config_folder() / name).read_text(), name), resolved(config)):
        assert [error.message for each in (own, every) for error in each.iter_errors(plain)] == []


@pytest.mark.parametrize("count", [300, pytest.param(3000, marks=pytest.mark.slow)])
def test_a_config_that_is_read_is_accepted(count: int) -> None:
    every, accepted = validator(), 0
    for config in fuzz.changed_configs(count, seed=count + 1):
        if read(config):
            accepted += 1
            assert [error.message for error in every.iter_errors(json.loads(json.dumps(config)))] == []
    assert accepted > count / 50


FORMS: list[Any] = [
    3, [1, 2], {"uniform": [1, 2]}, {"integer": [1, 2]}, {"choice": [1, 2]}, {"grid": [1, 2]}, {"constant": [1]},
    {"log_uniform": [1, 2]}, {"normal": [1, 2]}, {"normal": [1, 2, 0.5, 1.5]}, {"mixture": [1, [1, 2]]},
    {"mixture": [1, {"choice": [2]}], "weights": [1, 2]}, {"minus": [[1, 4], 2]}, {"minus": [{"normal": [0, 1]}, 2]},
    {"intersection": [[1, 4], [2, 3]]}, {"mixture": [{"minus": [[1, 4], 2]}, 1]},
]  # fmt: skip


@pytest.mark.parametrize("factor", ["radius", "balls", "spin"])  # above 0, whole, without limits
@pytest.mark.parametrize("form", FORMS, ids=str)
def test_each_form_of_a_distribution_is_accepted_where_it_is_read(factor: str, form: Any) -> None:
    config = {"scene": {"name": "bouncing", factor: form}}
    if read(config):
        assert all(each.is_valid(config) for each in (validator(), validator("bouncing")))
    split = {"scene": {"name": "bouncing"}, "splits": {"train": {}, "test": {"overlaps": True, "factors": {}}}}
    split["splits"]["test"]["factors"] = {factor: form}
    if read(split):
        assert all(each.is_valid(split) for each in (validator(), validator("bouncing")))


def bad_values(spec: Option) -> Iterator[Any]:
    """Values of a wrong type or out of range."""
    yield {"nothing": [1]}
    if not spec.optional:
        yield None
    if spec.kind is str:
        yield from [3, "wrong"] if spec.choices else [3]
        return
    yield from ["1"] if spec.kind is bool else ["1", True]
    outside = [] if spec.low is None else [spec.low - 1]
    outside += [] if spec.above is None else [spec.above, spec.above - 1]
    outside.append(1e13 if spec.high is None else spec.high + 1)
    for value in outside:
        yield value
        yield [value] * (spec.parts or 2)
        if spec.draw:
            yield from ({kind: [value]} for kind in ("choice", "grid", "mixture", "constant"))
            yield from ({kind: [value, value]} for kind in ("uniform", "log_uniform"))
            yield {"mixture": [{"choice": [value]}], "weights": [1]}
    if spec.kind is int:
        yield from (1.5, {"log_uniform": [1, 2]}, {"choice": [1.5]})
    if spec.parts:
        yield from ([1] * (spec.parts + 1), 1)
    if spec.draw:
        yield from ([1, 2, 3, 4], {"choice": []}, {"uniform": [1]}, {"mixture": []}, {"choice": [1], "grid": [1]})
        yield from ({"mixture": [1], "weights": [0]}, {"uniform": 1}, {"normal": [0, 0]}, {"grid": [2, 2]})


def options_of(where: str, options: type) -> list[tuple[str, str, Option]]:
    return [(where, field.name, field.metadata["option"]) for field in dataclasses.fields(options)]


DECLARED = [
    *(each for section, options in SECTIONS.items() for each in options_of(section, options)),
    *options_of("annotations", SimulationAnnotations),
]


def assert_refused_by_both(config: dict[str, Any], schemas: list[Any]) -> None:
    assert not read(config), f"{config} is read"
    assert not any(schema.is_valid(config) for schema in schemas), f"{config} is accepted"


def test_bad_values_of_sections_are_refused_as_reading_refuses_them() -> None:
    every = [validator()]
    for section, name, spec in DECLARED:
        for value in bad_values(spec):
            assert_refused_by_both({section: {name: value}}, every)
        assert_refused_by_both({section: {f"{name}x": 1}}, every)


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind in ("scene", "look") for name in names(kind)])
def test_bad_values_of_plugins_are_refused_as_reading_refuses_them(kind: str, name: str) -> None:
    schemas = [validator(), *([validator(name)] if kind == "scene" else [])]
    for _, option, spec in options_of(kind, load(kind, name).options):
        for value in bad_values(spec):
            assert_refused_by_both({kind: {"name": name, option: value}}, schemas)
        assert_refused_by_both({kind: {"name": name, f"{option}x": 1}}, schemas)


@pytest.mark.parametrize(
    "config",
    [
        {"sceen": "bouncing"},
        {"scene": "bouncin"},
        {"scene": {"name": 3}},
        {"scene": {"name": "pile", "sha256": "0"}},
        {"scene": 3},
        {"seed": -1},
        {"seed": 2**63},
        {"seed": "one"},
        {"name": "a b"},
        {"video": [1]},
        {"annotations": {"masks": 1}},
        {"annotations": {"maskz": True}},
        {"splits": {"a b": {}}},
        {"splits": {"train": {"videos": 0}}},
        {"splits": {"train": {"video": 1}}},
        {"splits": {"train": {"overlaps": 1}}},
        {"splits": {"train": {"physics": {"substeps": 0}}}},
        {"splits": {"train": 3}},
        [],
    ],
    ids=str,
)
def test_other_mistakes_are_refused_as_reading_refuses_them(config: Any) -> None:
    assert_refused_by_both(config, [validator()])


@pytest.mark.parametrize(
    "factors",
    [
        {"radios": 1}, {"radius": -1}, {"mixture": []}, {"mixture": [{"radius": "x"}]}, {"minus": {}}, 3, None,
        {"condition": [{}, {"when": {"radius": 1}}]}, {"condition": [{}, {"when": {}, "then": {"radius": -1}}]},
    ],
    ids=str,
)  # fmt: skip
def test_factors_of_splits_are_checked_by_the_schema_of_a_family(factors: Any) -> None:
    assert_refused_by_both({"scene": "bouncing", "splits": {"train": {"factors": factors}}}, [validator("bouncing")])


def test_the_schema_of_a_family_is_of_that_family_alone() -> None:
    assert validator("pile").is_valid({"scene": "pile"})
    assert not any(validator("pile").is_valid(config) for config in ({}, {"scene": "bouncing"}, {"scene": {}}))
    assert validator("bouncing").is_valid({"scene": {"balls": 3}})
    with pytest.raises(ConfigError, match="'piel', which is no scene family; did you mean pile"):
        json_schema("piel")


def test_every_option_states_its_default_unit_and_meaning() -> None:
    frames = json_schema()["$defs"]["section.video"]["properties"]["frames"]
    expected = {"type": "integer", "minimum": 1, "maximum": 100_000, "default": 64, "x-unit": "frames"}
    assert expected.items() <= frames.items()
    assert frames["description"] == "length of a video, including the initial state (frames)"
