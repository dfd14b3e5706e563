"""Messages name arguments as their reader writes them: flags on a command line, keywords in Python."""

import ast
from pathlib import Path

import pytest
from tiny import run_main

import gen2d
from gen2d.core.errors import ConfigError, Error, argument, command_line

PACKAGE = Path(gen2d.__file__).parent
COMMAND_LINE = "cli/"


def test_an_argument_is_a_flag_on_a_command_line() -> None:
    with command_line(), command_line():
        assert (argument("out"), argument("gpus_per_worker")) == ("--out", "--gpus-per-worker")
        assert (argument("overwrite", True), argument("device", "cpu")) == ("--overwrite", "--device cpu")
        assert argument("set", "video.fps=5") == "--set video.fps=5"
    assert (argument("out"), argument("gpus_per_worker"), argument("set")) == ("out", "gpus_per_worker", "overrides")
    assert (argument("overwrite", True), argument("device", "cpu")) == ("overwrite=True", "device='cpu'")
    assert argument("set", "video.fps=5") == "overrides=['video.fps=5']"


@pytest.mark.parametrize(
    ("options", "flags", "said"),
    [
        ({"n": 0}, ["--n", "0"], "{n} is 0, but must be a whole number"),
        ({"seed": -1}, ["--seed", "-1"], "{seed} is -1, but must be a whole number from 0"),
        ({"split": "a b"}, ["--split", "a b"], "{split} is 'a b', but must be letters"),
        ({"overrides": ["fps"]}, ["--set", "fps"], "{set} is 'fps', but must be section.option=value"),
        ({"overrides": ["video.fps=["]}, ["--set", "video.fps=["], "{set} video.fps"),
        (
            {"config": "nothing.yaml"},
            ["--config", "nothing.yaml"],
            "the config is 'nothing.yaml', but there is no such",
        ),
    ],
)
def test_one_error_in_two_languages(options: dict, flags: list[str], said: str, tmp_path: Path) -> None:
    arguments = {"config": "bouncing.yaml", "n": 4, "out": tmp_path / "a"} | options
    with pytest.raises(Error) as caught:
        gen2d.generate(arguments.pop("config"), arguments.pop("n"), arguments.pop("out"), **arguments)
    python = {name: argument(name) for name in ("n", "seed", "split", "set", "config")}
    assert str(caught.value).startswith(said.format(**python))
    words = ["--config", "bouncing.yaml", "--n", "4", "--out", tmp_path / "a"]
    done = run_main(*words, *flags)
    assert done.returncode == 2
    assert said.format(**{name: f"--{name}" for name in python}).partition(",")[0] in done.stderr
    assert argument("out") == "out"  # the command line has ended


def test_an_error_names_the_override_or_the_file_that_causes_it(tmp_path: Path) -> None:
    overrides = ["video.frames=4", "video.fps=-1", "look=flat"]
    said = "video.fps is -1, but must be a number, above 0"
    for config in ("bouncing.yaml", {"scene": "bouncing"}):
        with pytest.raises(ConfigError) as caught:
            gen2d.load_config(config, overrides)
        assert str(caught.value).startswith(f"overrides=['video.fps=-1']: {said}")
        with command_line(), pytest.raises(ConfigError) as caught:
            gen2d.load_config(config, overrides)
        assert str(caught.value).startswith(f"--set video.fps=-1: {said}")
    (tmp_path / "own.yaml").write_text("scene: {name: bouncing, bals: 3}")
    for given, cause in (
        ([], f"{tmp_path / 'own.yaml'}: scene.bals is not an option"),
        (["look=flat"], f"{tmp_path / 'own.yaml'}: scene.bals is not an option"),
        (overrides, f"overrides=['video.fps=-1']: {said}"),
        (
            ["scene.radius=0.1", "scene=chain", "scene.bals=4"],
            "overrides=['scene.bals=4']: scene.bals is not an option",
        ),
    ):
        with pytest.raises(ConfigError) as caught:
            gen2d.load_config(tmp_path / "own.yaml", given)
        assert str(caught.value).startswith(cause)


def raised_texts(path: Path) -> list[str]:
    """Texts in the statements that raise."""
    raises = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Raise)]
    return [
        each.value
        for node in raises
        for each in ast.walk(node)
        if isinstance(each, ast.Constant) and isinstance(each.value, str)
    ]


def test_no_error_of_python_names_a_flag() -> None:
    paths = [
        path for path in PACKAGE.rglob("*.py") if not path.relative_to(PACKAGE).as_posix().startswith(COMMAND_LINE)
    ]
    texts = {text: path for path in paths for text in raised_texts(path)}
    assert len(texts) > 300
    assert not [(path.name, text) for text, path in texts.items() if "--" in text]
