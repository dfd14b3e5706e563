"""-q, -v, --log and --json, the overview of `list`, and completion."""

import builtins
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from packages import require
from tiny import CONFIG, run_main

import gen2d
from gen2d.cli.main import VERBS
from gen2d.cli.parser import Parser
from gen2d.config.plugins import config_names, names, summary, written_summary
from gen2d.config.reading import yaml_text


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("output")
    (folder / "tiny.yaml").write_text(yaml_text(CONFIG))
    gen2d.generate(folder / "tiny.yaml", 2, folder / "data")
    return folder


def test_quiet_prints_the_result_alone_and_verbose_a_time_before_each_message(folder: Path) -> None:
    words = "tiny.yaml", "--n", 2, "--overwrite", "--out"
    normal, quiet, verbose = (run_main(*words, folder / out, *more, cwd=folder) for out, more in
                              (("a", []), ("b", ["-q"]), ("c", ["--verbose"])))  # fmt: skip
    assert {done.returncode for done in (normal, quiet, verbose)} == {0}
    assert "will take about" in normal.stderr
    assert quiet.stderr == ""
    assert all(done.stdout.startswith("2 videos in ") for done in (normal, quiet, verbose))
    lines = verbose.stderr.splitlines()
    assert any("will take about" in line for line in lines)
    assert all(re.match(r"\[\d+\.\d s\] ", line) for line in lines)


def test_a_log_holds_all_that_is_printed_and_grows(folder: Path) -> None:
    log = folder / "log.txt"
    done = run_main("tiny.yaml", "--n", 3, "--out", "grown", "-q", "--log", log, cwd=folder)
    bad = run_main("info", "nowhere", "-q", "--log", log, cwd=folder)
    assert (done.returncode, done.stderr, bad.returncode) == (0, "", 2)
    lines = log.read_text().splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ", line) for line in lines)
    texts = [line[20:] for line in lines]
    assert any("will take about" in text for text in texts)
    assert texts[-2:] == [done.stdout.strip(), bad.stderr.strip()]


def test_an_error_is_one_sentence_unless_verbose(folder: Path) -> None:
    sentence = "gen2d: nowhere is not a gen2d dataset: it has no manifest.json"
    for more in ([], ["-q"]):
        assert run_main("info", "nowhere", *more, cwd=folder).stderr == f"{sentence}\n"
    verbose = run_main("info", "nowhere", "-v", cwd=folder)
    assert (verbose.returncode, verbose.stderr.splitlines()[-1]) == (2, sentence)
    assert "Traceback" in verbose.stderr


@pytest.mark.parametrize("words", [["--log", "no/where/log"], ["--log", "."], ["-q", "-v"]])
def test_impossible_output_is_one_sentence(words: list[str], tmp_path: Path) -> None:
    done = run_main("list", *words, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


def test_json_is_what_other_programs_read(folder: Path) -> None:
    manifest = json.loads(run_main("info", "data", "--json", cwd=folder).stdout)
    assert manifest["splits"] == {"train": 2}
    assert manifest["dataset"] == "data"
    assert json.loads(run_main("clean", "data", "--json", cwd=folder).stdout) == {"dataset": "data", "removed": []}
    files = json.loads(run_main("preview", "data", "--out", "pictures", "--json", cwd=folder).stdout)["files"]
    assert files
    assert all((folder / file).is_file() for file in files)
    made = json.loads(run_main("export", "data", "--to", "npz", "--out", "arrays", "--json", cwd=folder).stdout)
    size = sum(path.stat().st_size for path in (folder / "arrays").glob("*.npz"))
    assert made.pop("seconds") > 0
    assert made == {"out": "arrays", "videos": 2, "bytes": size, "loss": ""}
    listed = json.loads(run_main("list", "--json").stdout)
    assert [*listed["scene"]] == names("scene")
    assert listed["config"] == config_names()


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_can_print_json(verb: str) -> None:
    parser = Parser()
    VERBS[verb].add_arguments(parser)
    assert "--json" in parser.format_help()


def test_list_is_one_screen_and_details_are_shown_on_request() -> None:
    done = run_main("list")
    lines = done.stdout.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 100
    words = set(re.findall(r"\w+", done.stdout))
    for kind in ("scene", "look", "annotation", "export"):
        assert {*names(kind)} <= words
    assert {name.removesuffix(".yaml") for name in config_names()} <= words
    detailed = run_main("list", "--options").stdout
    assert "video.frames" in detailed
    assert "scene.balls" in detailed
    assert "video.frames" not in done.stdout
    assert "scene.balls" in run_main("list", "bouncing").stdout
    assert run_main("list", "bouncing", "--json").returncode == 2


def test_the_overview_imports_no_jax() -> None:
    code = "import sys; from gen2d.cli.main import main; main(['list']); sys.exit('jax' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize("kind", ["scene", "look", "annotation", "export"])
def test_a_summary_read_from_a_file_is_that_of_the_module(kind: str) -> None:
    assert [written_summary(kind, name) for name in names(kind)] == [summary(kind, name) for name in names(kind)]


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_completion_knows_all_verbs_and_their_options(shell: str, tmp_path: Path) -> None:
    require("shtab")
    done = run_main("--print-completion", shell)
    assert (done.returncode, done.stderr) == (0, "")
    assert all(verb in done.stdout for verb in VERBS)
    assert "videos" in done.stdout
    if shell == "bash" and shutil.which("bash"):
        (tmp_path / "script").write_text(done.stdout)
        check = ". ./script; COMP_WORDS=(gen2d ver); COMP_CWORD=1; _shtab_gen2d; echo ${COMPREPLY[@]}"
        answer = subprocess.run(["bash", "-c", check], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert answer.stdout.split() == ["verify"]


def test_completion_without_shtab_or_of_an_unknown_shell_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    done = run_main("--print-completion", "fisch")
    assert (done.returncode, "'fisch', but must be one of bash, zsh, tcsh" in done.stderr) == (2, True)
    assert run_main("--print-completion").returncode == 2
    real = builtins.__import__

    def without_shtab(name: str, *arguments: Any, **more: Any) -> Any:
        if name == "shtab":
            raise ImportError(name)
        return real(name, *arguments, **more)

    monkeypatch.setattr(builtins, "__import__", without_shtab)
    done = run_main("--print-completion", "bash")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "gen2d: completion needs shtab: pip install 'gen2d[completion]'\n"
