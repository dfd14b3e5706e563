"""Waits: a short one says nothing, a long one what it is and how far."""

import logging
import os
import subprocess
import sys
import time
import types

import pytest

from gen2d.core import progress as progress_module
from gen2d.core.progress import logged_to_stderr, progress, waiting


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress_module, "PATIENCE", 0.1)
    monkeypatch.setattr(progress_module, "PERIOD", 0.1)


def test_a_short_wait_says_nothing_and_a_long_one_what_it_is() -> None:
    lines: list[str] = []
    with waiting("Resting", lines.append):
        pass
    assert lines == []
    with waiting("Resting", lines.append):
        time.sleep(1)
    assert lines[0] == "Resting ..."
    assert len(lines) > 2
    assert all(line.startswith("Resting ... 0.") or line.startswith("Resting ... 1") for line in lines[1:])
    count = len(lines)
    time.sleep(0.3)
    assert len(lines) == count  # nothing after its end


def test_an_error_ends_a_wait() -> None:
    with pytest.raises(ZeroDivisionError), waiting("Dividing"):
        _ = 1 / 0


def test_progress_says_how_far_it_is_also_while_nothing_advances() -> None:
    lines: list[str] = []
    with progress("Copying", 8, lines.append, "files") as advance:
        time.sleep(0.5)
        advance(4)
        time.sleep(0.5)
    assert lines[0] == "Copying ..."
    assert lines[1].startswith("Copying: 0 of 8 files after ")
    assert lines[-1].startswith("Copying: 4 of 8 files, ")
    assert lines[-1].endswith(" left")


def test_a_library_logs_and_the_command_line_prints(
    caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture
) -> None:
    @waiting("Resting")
    def rest() -> None:
        time.sleep(0.4)

    rest()
    assert capsys.readouterr().err == ""
    with caplog.at_level(logging.INFO, "gen2d"):
        rest()
    assert caplog.messages[0] == "Resting ..."
    assert capsys.readouterr().err == ""
    with logged_to_stderr():
        rest()
    assert capsys.readouterr().err.startswith("Resting ...\n")
    assert logging.getLogger("gen2d").handlers == []


@pytest.mark.parametrize("where", ["terminal", "notebook"])
def test_a_person_without_logging_reads_the_waits(
    where: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    if where == "terminal":
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    else:
        shell = types.SimpleNamespace(kernel=None)
        monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))

    def waited() -> str:
        with waiting("Resting"):
            time.sleep(0.3)
        return capsys.readouterr().err

    assert waited() == ""  # a handler is set, which has the lines
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    assert waited().startswith("Resting ...\nResting ... 0.")


def test_xla_logs_nothing_below_a_crash() -> None:
    code = "import os, gen2d; gen2d.load_config('bouncing.yaml'); print(os.environ['TF_CPP_MIN_LOG_LEVEL'])"
    environment = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "3\n"
