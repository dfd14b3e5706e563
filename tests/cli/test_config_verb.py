"""`config`: resolved configs, checks of many configs, and the schema for editors."""

import json
from pathlib import Path

import pytest
from tiny import CONFIG, run_main

from gen2d.config.config import load_config
from gen2d.config.json_schema import json_schema
from gen2d.config.reading import parse_yaml, yaml_text
from gen2d.config.resolved import resolved


def test_a_shown_config_is_one_that_shows_itself(tmp_path: Path) -> None:
    shown = run_main("config", "show", "--set", "video.fps=20", "bouncing", "--set", "annotations.masks=true")
    assert (shown.returncode, shown.stderr) == (0, "")
    (tmp_path / "shown.yaml").write_text(shown.stdout)
    assert run_main("config", "show", "shown.yaml", cwd=tmp_path).stdout == shown.stdout
    config = load_config("bouncing", ["video.fps=20", "annotations.masks=true"])
    assert load_config(tmp_path / "shown.yaml").sha256() == config.sha256()
    bare = run_main("config", "show", "shown.yaml", "--no-comments", cwd=tmp_path).stdout
    assert " # " not in bare
    assert parse_yaml(bare, "") == resolved(config) == parse_yaml(shown.stdout, "")
    assert json.loads(run_main("config", "show", "shown.yaml", "--json", cwd=tmp_path).stdout) == resolved(config)


def test_check_has_a_line_for_each_config_and_code_two_if_one_is_invalid(tmp_path: Path) -> None:
    (tmp_path / "good.yaml").write_text(yaml_text(CONFIG))
    (tmp_path / "bad.yaml").write_text("scene: {balls: 0}")
    done = run_main("config", "check", "good.yaml", "bouncing", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "good.yaml: valid\nbouncing: valid\n", "")
    words = "good.yaml", "bad.yaml", "nothing.yaml", "bouncing"
    done = run_main("config", "check", *words, cwd=tmp_path)
    lines = done.stdout.splitlines()
    assert (done.returncode, lines[0], lines[3], done.stderr) == (2, "good.yaml: valid", "bouncing: valid", "")
    assert lines[1] == "bad.yaml: scene.balls is 0, but must be a whole number, 1 or more and 64 or less"
    assert "'nothing.yaml', but there is no such file" in lines[2]
    done = run_main("config", "check", *words, "--json", cwd=tmp_path)
    values = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(each["config"], each["valid"]) for each in values] == list(
        zip(words, (True, False, False, True), strict=True)
    )
    assert [each["problem"] for each in values] == [None, *lines[1:3], None]


def test_a_set_option_is_checked_too() -> None:
    done = run_main("config", "check", "bouncing", "--set", "video.fps=-1")
    assert (done.returncode, done.stdout.count("video.fps is -1, but must be")) == (2, 1)


@pytest.mark.parametrize("family", [None, "pile"])
def test_the_schema_is_printed_as_json(family: str | None) -> None:
    done = run_main("config", "schema", *([family] if family else []))
    assert (done.returncode, json.loads(done.stdout)) == (0, json_schema(family))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("shw", "bouncing"), "config 'shw' is not an action; did you mean show?"),
        (("show",), "config show has 0 names, but must have one config, such as bouncing"),
        (("show", "bouncing", "pile"), "config show has 2 names, but must have one config, such as bouncing"),
        (("check",), "config check has 0 names, but must have one config or more, such as bouncing"),
        (("schema", "piel"), "config schema is asked for 'piel', which is no scene family; did you mean pile?"),
        (("schema", "--set", "a.b=1"), "--set changes a config, but config schema is of all configs"),
        (("show", "bouncin"), "'bouncin', but there is no such file; did you mean bouncing.yaml?"),
        ((), "the following arguments are required: ACTION"),
    ],
)
def test_a_mistake_is_one_sentence(words: tuple[str, ...], sentence: str) -> None:
    done = run_main("config", *words)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert sentence in done.stderr
