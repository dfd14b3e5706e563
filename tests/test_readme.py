"""The README's own commands and code, run in an empty folder as a reader would, with fewer videos and steps."""

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from tiny import run_command

from gen2d.config.config import load_config
from gen2d.programs.rollout import Rollout

README = Path(__file__).parent.parent / "README.md"
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README.read_text(encoding="utf-8"), re.S)


def test_the_set_up_is_one_line_each():
    lines = [line for kind, block in BLOCKS if kind == "sh" for line in block.splitlines()]
    installing = [line for line in lines if "pip install" in line]
    assert len(installing) == 2
    assert installing[0].endswith("&& python -m gen2d --config bouncing.yaml --n 10000")
    assert installing[1].endswith("&& pytest")


@pytest.mark.parametrize("count", [10, pytest.param(len(BLOCKS), marks=pytest.mark.full)], ids=["first", "every"])
def test_the_blocks_run(count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The first blocks install, generate, preview and read; the others take minutes."""
    monkeypatch.chdir(tmp_path)  # where the blocks' own files lie
    monkeypatch.setenv("HF_HOME", str(tmp_path / "huggingface"))
    compared, torch = 0, importlib.util.find_spec("torch") is not None  # models with what they must beat
    for kind, block in BLOCKS[:count]:
        if "import torch" in block and not torch:
            continue
        if "import datasets" in block and importlib.util.find_spec("datasets") is None:
            continue
        if kind == "yaml":
            name, config = block.partition("\n")[0].removeprefix("# "), block.replace("videos: 1000", "videos: 8")
            (tmp_path / name).write_text(config)
            assert load_config(tmp_path / name).name == name.removesuffix(".yaml")
        elif block.startswith("# drop.py"):
            (tmp_path / "drop.py").write_text(block)
        elif kind == "python":
            shorter = block.replace("150", "50") if "gen2d.stream" in block else block  # batches, still enough to win
            shorter = shorter.replace("train-00000.h5", "train-00000-n40.h5")  # a part of a shard has its count
            words = [sys.executable, "-c", shorter]
            done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
            assert done.returncode == 0, block + done.stderr
            told = re.search(r"error ([\d.]+), of .* ([\d.]+)", done.stdout)
            assert told is None or float(told[1]) < 0.9 * float(told[2]), done.stdout
            compared += told is not None
        elif kind == "sh":
            for line in block.splitlines():
                _run(line, tmp_path)
    names = {path.name for path in (tmp_path / "datasets").iterdir()}
    if count < len(BLOCKS):
        assert names == {"bouncing", "mine"}
        return
    assert compared == 1 + torch
    assert names == {
        "bouncing",
        "mine",
        "touched",
        "seen",
        "annotated",
        "splits",
        "counterfactuals",
        "violations",
        "told",
        "drop",
        "states",
        "exact",
    }


def _run(line: str, folder: Path) -> None:
    """Runs the part of a line that is gen2d's, with few videos."""
    words = shlex.split(line.rpartition("&& ")[2] if "pip install" in line else line, comments=True)
    if words[:3] != ["python", "-m", "gen2d"]:
        return
    arguments = ["40" if before == "--n" else word for before, word in zip(["", *words[3:]], words[3:], strict=False)]
    done = run_command(*arguments, cwd=folder)
    assert done.returncode == 0, line + done.stderr


@pytest.mark.parametrize("page", sorted(README.parent.glob("*/README.md")), ids=lambda p: p.parent.name)
def test_pages_name_only_files_that_are_there(page: Path):
    for name in re.findall(r"`([\w./]+\.(?:py|yaml))`", page.read_text(encoding="utf-8")):
        found = [page.parent / name, page.parent.parent / name, *page.parent.glob(f"*/{name}")]
        assert any(path.exists() for path in found), f"{page} names {name}"


EVERY = ("energy", "masks", "amodal", "boxes", "visibility", "flow", "captions", "lyapunov")
DESCRIBED = {
    "scene": "bouncing",
    "look": {"name": "flat", "palette": "paper"},
    "annotations": {"contacts": 4, "tracks": 8, **dict.fromkeys(EVERY, True)},
    "quality": {"min_contacts": 1},
    "splits": {"train": {}, "large": {"factors": {"radius": [1.0, 1.1]}}},
}


def test_the_table_of_fields_is_that_of_the_schema():
    """Names, axes and units; each group of fields has a row."""
    fields = Rollout(load_config(DESCRIBED), jax.devices()[:1]).schema.fields
    rows = re.findall(r"^\| (`.*) \| (n.*|T, n) \| (.*) \|$", README.read_text(encoding="utf-8"), re.M)
    described: set[str] = set()
    for cells in rows:
        group, names = "", []
        for name in re.findall(r"`([^`]+)`", cells[0]):
            group = name.rpartition("/")[0] or group
            own = name if name in fields or "/" in name else f"{group}/{name}"
            names += [each for each in fields if each.startswith(own[:-3])] if own.endswith("...") else [own]
        assert names, cells
        axes = cells[1].split(", ")
        axes = axes if len(axes) == len(names) else [axes[0]] * len(names)
        for name, written in zip(names, axes, strict=True):
            field = fields[name]
            assert field.axes.startswith("n") if written.endswith("...") else field.axes == written, (name, field.axes)
            about = cells[2].startswith(("with ", "each ", "distance "))  # in place of units
            assert about or not cells[2] or field.unit in ("1", "", "id", "object") or field.unit in cells[2], name
        described.update(names)
    assert {name.partition("/")[0] for name in fields} == {name.partition("/")[0] for name in described} | {"split"}
