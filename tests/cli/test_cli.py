"""The command line: verbs, help, errors of one sentence, exit codes."""

import subprocess
import sys
from pathlib import Path

import jax
import pytest
from tiny import CONFIG, run_command, run_main, sentences

import gen2d
from gen2d.cli.main import VERBS
from gen2d.cli.parser import Parser, parse
from gen2d.config.reading import yaml_text


def parser_of(verb: str) -> Parser:
    parser = Parser(prog=verb)
    VERBS[verb].add_arguments(parser)
    return parser


OPTIONS = [(verb, name) for verb in VERBS for name in parser_of(verb)._option_string_actions if len(name) > 5]


@pytest.mark.parametrize("width", [80, 120])
def test_help_fits_the_terminal(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    top = run_main("--help")
    assert run_main().stdout == top.stdout
    for words in ((), *((verb,) for verb in VERBS)):
        done = run_main(*words, "--help")
        assert (done.returncode, done.stderr) == (0, "")
        assert max(map(len, done.stdout.splitlines())) <= width
    for verb, module in VERBS.items():
        assert f"\n    {verb} " in top.stdout
        assert (module.__doc__ or "").strip().endswith(".")


def test_every_argument_has_help() -> None:
    for verb in VERBS:
        assert all(action.help for action in parser_of(verb)._actions), verb


def test_generate_is_the_verb_of_a_line_without_one() -> None:
    words = ["--config", "a.yaml", "--n", "3", "--set", "video.fps=30", "--worker", "1/4"]
    bare, named = vars(parse(words, VERBS)), vars(parse(["generate", *words], VERBS))
    assert (bare.pop("arguments"), named.pop("arguments")) == (words, ["generate", *words])
    assert bare == named
    assert bare["worker"] == (1, 4)


@pytest.mark.parametrize(("text", "number"), [("7", 7), ("10_000", 10_000), ("1e5", 100_000), ("2.5e3", 2500)])
def test_a_line_may_begin_with_a_config_and_numbers_have_any_form(text: str, number: int) -> None:
    options = parse(["a.yaml", "--n", text], VERBS)
    assert (options.config, options.n, options.run) == ("a.yaml", number, VERBS["generate"].run)


@pytest.mark.parametrize(("verb", "name"), OPTIONS)
def test_an_option_cut_short_is_an_error_that_names_it(verb: str, name: str) -> None:
    if (verb, name[:-1]) in OPTIONS:
        return  # --workers and --worker
    done = run_main(verb, f"{name[:-1]}=1")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"gen2d: {name[:-1]} is not an option; did you mean {name}?\n"


@pytest.mark.parametrize("verb", VERBS)
def test_a_misspelt_verb_is_an_error_that_names_it(verb: str) -> None:
    done = run_main(verb[:2] + verb[3:], "data")
    assert (done.returncode, done.stderr) == (
        2,
        f"gen2d: {verb[:2] + verb[3:]!r} is not a verb; did you mean {verb}?\n",
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("a.yaml", "--n", "1e400"), "--n: '1e400' is not a whole number, such as 100; see "),
        (("a.yaml", "--n", "0.5"), "--n: '0.5' is not a whole number, such as 100; see "),
        (("bounce",), "'bounce' is not a verb; "),
        (("bouncing",), "the following arguments are required: --n; see python -m gen2d generate --help"),
        (("-q", "bouncing", "--n", "1", "--set", "a.b=1"), "--set a.b=1: a is not a section; there are: "),
        (
            ("generate", "chain", "--n", "1", "--set", "scene.linkz=1"),
            "--set scene.linkz=1: scene.linkz is not an option",
        ),
        (("--n", "1"), "a config is needed, such as bouncing.yaml; "),
        (("bouncing", "--n", "1", "--device", "tpu"), "--device is 'tpu', but must be one of auto, cpu, gpu"),
        (("info", "data", "--verbal"), "--verbal is not an option; did you mean --verbose?"),
        (("info", "data", "--fps"), "--fps is not an option; there are: --deadline, "),
        (("--config", "a.yaml", "--n", "many"), "--n: 'many' is not a whole number, such as 100; see "),
        (("--config", "a.yaml", "--n", "1", "extra"), "'extra' is one argument too many; see "),
        (("--config", "a.yaml"), "the following arguments are required: --n; see python -m gen2d generate --help"),
        (("info", "data", "--timeout", "soon"), "--timeout: 'soon' is not a number of seconds, such as 30; see "),
        (("info", "a", "\x1b[31m"), r"'\x1b[31m' is one argument too many; see python -m gen2d info --help"),
    ],
)
def test_an_error_says_what_to_write(words: tuple[str, ...], sentence: str) -> None:
    done = run_main(*words)
    assert (done.returncode, done.stdout, len(sentences(done.stderr))) == (2, "", 1)
    assert done.stderr.startswith(f"gen2d: {sentence}")


def test_words_after_two_dashes_are_no_options(tmp_path: Path) -> None:
    done = run_main("info", "--", "--nothing", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (
        2,
        "gen2d: --nothing is not a gen2d dataset: it has no manifest.json\n",
    )


def test_a_reader_may_leave_early() -> None:
    code = f"{sys.executable} -m gen2d list | head -n 1"
    done = subprocess.run(code, shell=True, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("Scene families:\n", "")


def test_help_imports_no_numpy() -> None:
    code = "import sys, gen2d.cli.main as cli; cli.parse(['info', 'data'], cli.VERBS); print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_the_command_line_tells_what_it_did(tmp_path: Path):
    (tmp_path / "tiny.yaml").write_text(yaml_text(CONFIG))
    done = run_command("--config", "tiny.yaml", "--n", 9, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "9 videos in" in done.stdout
    assert "datasets/tiny" in done.stdout
    assert "will take about" in done.stderr
    again = run_main("--config", "tiny.yaml", "--n", 9, cwd=tmp_path)
    assert (again.returncode, "nothing to do" in again.stdout) == (0, True)
    sheet = run_main("info", "datasets/tiny", cwd=tmp_path)
    assert "train: 9 videos" in sheet.stdout
    assert "m/s^2" in sheet.stdout
    assert [name for name in gen2d.open(tmp_path / "datasets/tiny").manifest.fields if name not in sheet.stdout] == []
    assert run_main("verify", "datasets/tiny", cwd=tmp_path).returncode == 0
    path = tmp_path / "datasets/tiny/shards/train-00001-n1.h5"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    broken = run_command("verify", "datasets/tiny", cwd=tmp_path)
    assert broken.returncode == 1
    assert "train-00001" in broken.stdout
    pictures = run_main("preview", "tiny.yaml", "--videos", 2, "--out", "pictures", cwd=tmp_path)
    assert pictures.returncode == 0, pictures.stderr
    for name in pictures.stdout.split():
        assert (tmp_path / name).stat().st_size > 500


@pytest.mark.parametrize(
    "arguments",
    [
        ["--config", "nothing.yaml", "--n", "1"],
        ["--config", "bouncing.yaml"],
        ["--config", "bouncing.yaml", "--n", "many"],
        ["--config", "bouncing.yaml", "--n", "0"],
        ["--config", "bouncing.yaml", "--n", "1", "--seed", "-1"],
        ["--config", "bouncing.yaml", "--n", "1", "--set", "scene.balls=0"],
        ["--config", "bouncing.yaml", "--n", "1", "--worker", "3"],
        ["--config", "bouncing.yaml", "--n", "1", "--split", "../x"],
        ["--config", "bouncing.yaml", "--n", "1", "--over"],
        ["--config", "bouncing.yaml", "--n", "1", "--device", "gpu"],
        ["verify", "nowhere"],
        ["info", "nowhere"],
        ["preview", "nowhere"],
        ["list", "nothing"],
        ["bouncing.yaml"],
        ["--config", "", "--n", "1"],
        ["--config", "/dev/zero", "--n", "1"],
        ["--config", ".", "--n", "1"],
        ["--config", "bouncing.yaml", "--n", "99999999999999999999"],
        ["--config", "bouncing.yaml", "--n", "1", "--seed", "1.5"],
        ["--config", "bouncing.yaml", "--n", "1", "--split", ""],
        ["--config", "bouncing.yaml", "--n", "1", "--set", "a"],
        ["--config", "bouncing.yaml", "--n", "1", "--set", "=1"],
        ["--config", "bouncing.yaml", "--n", "1", "--set", "scene.balls.x=1"],
        ["--config", "bouncing.yaml", "--n", "1", "--set", "scene.balls=[[["],
        ["--config", "bouncing.yaml", "--n", "1", "--worker", "1/0"],
        ["--config", "bouncing.yaml", "--n", "1", "--worker", "2/2"],
        ["--config", "bouncing.yaml", "--n", "1", "--timeout", "0"],
        ["--config", "bouncing.yaml", "--n", "1", "--deadline", "nan"],
        ["--config", "bouncing.yaml", "--n", "1", "--out", "nope://x"],
        ["--config", "bouncing.yaml", "--n", "1", "extra"],
        ["verify", "nowhere", "--level", "deep"],
        ["verify", "nowhere", "--videos", "x"],
        ["verify"],
        ["verify", "s3://"],
        ["clean", "nowhere"],
        ["clean", "/dev/null"],
        ["info", "/dev/null"],
        ["info", "x" * 300],
        ["export", "nowhere", "--to", "npz"],
        ["export", "nowhere", "--to", "nothing"],
        ["preview", "bouncing.yaml", "--videos", "0"],
        ["preview", "bouncing.yaml", "--out", "/dev/null/x"],
        ["preview", "bouncing.yaml", "--seed", "-3"],
        ["list", "\x1b[31m"],
    ],
)
def test_bad_commands_end_with_one_sentence_and_code_two(tmp_path: Path, arguments: list[str]):
    if "gpu" in arguments and any(d.platform == "gpu" for d in jax.devices()):
        return
    done = (run_command if "many" in arguments else run_main)(*arguments, cwd=tmp_path)
    assert done.returncode == 2, done.stdout + done.stderr
    sentences = [line for line in done.stderr.splitlines() if line.startswith("gen2d: ")]
    assert len(sentences) == 1
    assert "Traceback" not in done.stderr
    assert not any(tmp_path.iterdir())
