"""The notebooks run in an empty folder, and their models beat their baselines; what is stored of them is small."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from packages import require

import gen2d

FOLDER = Path(__file__).parent.parent / "docs" / "notebooks"
RESULT = re.compile(r"(error|accuracy|ARI) ([\d.]+), of [a-z -]+? ([\d.]+)")
COMPARED = {"intuitive_physics": 1, "object_centric_learning": 2, "video_prediction": 2}  # how often each compares
NAMES = sorted(COMPARED)


def _cells(name: str) -> list[dict[str, Any]]:
    return json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]


def _check(name: str, text: str) -> None:
    """Fails unless the model wins each comparison in the text, by a tenth of the error or by .05 of the score."""
    results = RESULT.findall(text)
    assert len(results) == COMPARED[name], text
    for kind, ours, baseline in results:
        won = float(ours) < 0.9 * float(baseline) if kind == "error" else float(ours) > float(baseline) + 0.05
        assert won, text


def test_every_notebook_is_tested() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_what_is_stored_is_small_and_shows_the_result(name: str) -> None:
    outputs = [output for cell in _cells(name) for output in cell.get("outputs", ())]
    assert {output["output_type"] for output in outputs} == {"stream", "display_data"}  # no errors, and no timings
    assert {output["name"] for output in outputs if "name" in output} == {"stdout"}
    _check(name, "".join("".join(output.get("text", "")) for output in outputs))
    assert (FOLDER / f"{name}.ipynb").stat().st_size < 200_000


@pytest.mark.parametrize("name", NAMES)
def test_only_public_names_are_used(name: str) -> None:
    source = "".join("".join(cell["source"]) + "\n" for cell in _cells(name) if cell["cell_type"] == "code")
    assert "gen2d.generate(" in source
    assert not re.findall(r"^\s*(?:from gen2d|import gen2d\.)", source, re.MULTILINE)
    assert set(re.findall(r"\bgen2d\.(\w+)", source)) <= set(gen2d.__all__)


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs_and_its_model_beats_the_baseline(name: str, tmp_path: Path) -> None:
    require("torch", "matplotlib")
    source = "\n".join("".join(cell["source"]) for cell in _cells(name) if cell["cell_type"] == "code")
    script = "import matplotlib\nmatplotlib.use('agg')\n" + source
    words, one_core = [sys.executable, "-c", script], os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, cwd=tmp_path, env=one_core, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    _check(name, done.stdout)
