"""Laws that are owed: expected failures, strict in both directions."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

TESTS = """
import pytest
from laws import holds

@pytest.mark.asked
@pytest.mark.parametrize("part", (1, 2))
def test_owed(part):
    holds("drift, m", 0.1 * part, 0.3, asked=0.05)

@pytest.mark.asked
def test_owed_in_one_of_two_calls():
    for drift in (0.01, 0.2):
        holds("drift, m", drift, 0.3, asked=0.05)

def test_kept():
    holds("drift, m", 0.1, 0.1)

def test_regressed():
    holds("drift, m", 0.4, 0.3, asked=0.05)

@pytest.mark.asked
def test_kept_but_owed():
    holds("drift, m", 0.04, 0.3, asked=0.05)

def test_owed_without_the_mark():
    holds("drift, m", 0.1, 0.3, asked=0.05)

@pytest.mark.asked
def test_marked_without_a_law():
    holds("drift, m", 0.1, 0.3)
"""


def test_owed_laws_are_strict_expected_failures(tmp_path: Path):
    here = Path(__file__).parent
    shutil.copy(here / "conftest.py", tmp_path)
    shutil.copy(here.parent / "pyproject.toml", tmp_path)
    (tmp_path / "test_owed.py").write_text(TESTS)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(here / "support"), *sys.path])}
    command = [sys.executable, "-m", "pytest", "-n0", "-m", "", "-rA", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    summary = re.findall(r"^(PASSED|XFAIL|FAILED) .*?::test_(\S+)", done.stdout, re.M)
    assert sorted(summary) == [
        ("FAILED", "kept_but_owed"),
        ("FAILED", "marked_without_a_law"),
        ("FAILED", "owed_without_the_mark"),
        ("FAILED", "regressed"),
        ("PASSED", "kept"),
        ("XFAIL", "owed[1]"),
        ("XFAIL", "owed[2]"),
        ("XFAIL", "owed_in_one_of_two_calls"),
    ], done.stdout + done.stderr
    assert "test_owed[2] - drift, m: 0.2, asked 0.05" in done.stdout
