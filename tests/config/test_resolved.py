"""The resolved config: every option is there, and it is the same config."""

import dataclasses

import pytest

from gen2d.config.config import SECTIONS, load_config
from gen2d.config.plugins import config_names
from gen2d.config.reading import parse_yaml
from gen2d.config.resolved import resolved, resolved_text

CHANGES = [
    [],
    ["video.fps=25", "scene.radius={minus: [[0.2, 0.5], [0.3, 0.4]]}", "annotations.tracks=3", "look=studio"],
    ["splits={train: {}, test: {factors: {balls: 7}, look: {name: textured}}}", "scene.balls=[1, 3]", "seed=9"],
    ["physics.precision=float64", "annotations.contacts=4", "annotations.captions=true", "matched.change=[remove]"],
]


@pytest.mark.parametrize(
    ("name", "overrides"), [*((name, []) for name in config_names()), *(("bouncing", each) for each in CHANGES)]
)
def test_the_resolved_config_of_a_resolved_config_is_itself(name: str, overrides: list[str]) -> None:
    config = load_config(name, overrides)
    for comments in (True, False):
        text = resolved_text(config, comments)
        assert parse_yaml(text, "text") == resolved(config)
        again = load_config(parse_yaml(text, "text"))
        assert again == config
        assert again.sha256() == config.sha256()
        assert (again.seed, again.name) == (config.seed, config.name)
        assert resolved_text(again, comments) == text


def test_every_option_of_every_section_is_there() -> None:
    config = load_config("bouncing")
    plain = resolved(config)
    assert {*SECTIONS, "scene", "look", "annotations"} <= {*plain}
    for section, options in {**SECTIONS, "scene": config.scene.contract.options}.items():
        names = [field.name for field in dataclasses.fields(options)]
        assert [name for name in plain[section] if name != "name"] == names
    assert plain["physics"]["precision"] == "float32"  # stored configs leave it out
    assert "precision" not in config.plain()["physics"]


def test_comments_give_the_unit_and_the_meaning() -> None:
    lines = resolved_text(load_config("bouncing")).splitlines()
    assert "  frames: 64  # frames; length of a video, including the initial state" in lines
    assert "  pan:  # m/s; velocity of the camera" in lines
