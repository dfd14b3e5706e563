"""The examples of docstrings run, and show what they say, in a folder with a dataset of their name."""

import doctest
import importlib
import importlib.util
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hub import hub
from packages import require
from PIL import Image

import gen2d

PACKAGE = Path(gen2d.__file__).parent
ROOTS = PACKAGE, PACKAGE / "renderers"  # the latter is a link
WITHOUT_TORCH = {PACKAGE / "torch.py"} if importlib.util.find_spec("torch") is None else set[Path]()
TEXTS = {
    path: path.read_text(encoding="utf-8")
    for root in ROOTS
    for path in sorted(root.rglob("*.py"))
    if path not in WITHOUT_TORCH
}
SHORTER = {"10_000": "64", '"cuda"': '"cpu"', "epochs=10": "epochs=1"}  # fewer videos, on what there is


def examples() -> dict[str, doctest.DocTest]:
    """Docstrings with examples, by the name of what they describe."""
    files = [path.relative_to(PACKAGE.parent) for path, text in TEXTS.items() if "    >>> " in text]
    names = [".".join(file.with_suffix("").parts) for file in files]
    found = [test for name in names for test in doctest.DocTestFinder().find(importlib.import_module(name))]
    return {test.name: test for test in found if test.examples}


EXAMPLES = examples()


def test_all_examples_are_found():
    lines = [line for text in TEXTS.values() for line in text.splitlines() if line.lstrip().startswith(">>> ")]
    assert sum(len(test.examples) for test in EXAMPLES.values()) == len(lines)


class Shown(doctest.OutputChecker):
    """What an example shows must be so; what it does not show may be anything."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        return not want or super().check_output(want, got, optionflags)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Datasets and photos of the examples."""
    home = tmp_path_factory.mktemp("examples")
    gen2d.generate("bouncing.yaml", 64, home / "datasets" / "bouncing")
    for name in ("easy", "hard"):
        shutil.copytree(home / "datasets" / "bouncing", home / "datasets" / name)
    (home / "photos").mkdir()
    Image.new("RGB", (64, 64), (40, 90, 140)).save(home / "photos" / "sea.png")
    return home


@pytest.fixture
def stand_in_for_the_hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A server in place of the Hugging Face Hub, where that may be asked."""
    if importlib.util.find_spec("huggingface_hub") is None:
        yield
        return
    constants = importlib.import_module("huggingface_hub.constants")
    with hub() as server:
        monkeypatch.setattr(constants, "ENDPOINT", server.url)
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        monkeypatch.setenv("HF_TOKEN", "hf_of_nobody")
        yield


@pytest.mark.full
@pytest.mark.usefixtures("stand_in_for_the_hub")
@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_show_what_they_say(name: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    test = EXAMPLES[name]
    if any('to="torch"' in example.source for example in test.examples):
        require("torch")
    if any("gen2d.push" in example.source for example in test.examples):
        require("huggingface_hub")
    if any("to_pandas" in example.source for example in test.examples):
        require("pandas")
    for example in test.examples:
        for long, short in SHORTER.items():
            example.source = example.source.replace(long, short)
    ds, space = gen2d.open("datasets/bouncing"), gen2d.Space()
    space.add_circle((0, 3), radius=0.5)
    position = ds.batch([0])["states/position"]
    known: dict[str, Any] = {"gen2d": gen2d, "jax": jax, "np": np, "ds": ds, "space": space, "position": position}
    known["mixture"] = gen2d.mix({"bouncing": ds})
    test.globs = known | {"target": np.zeros((64, 64, 3)), "train_step": lambda frames: frames.mean()}
    doctest.DebugRunner(Shown()).run(test)
