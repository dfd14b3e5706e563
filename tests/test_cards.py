"""What a dataset says about itself is true, and its examples run."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import synthetic
from numpy.testing import assert_array_equal

from gen2d import codecs
from gen2d.files import file_sha256


def test_the_cards_name_every_field_and_file(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path))
    readme = (tmp_path / "README.md").read_text()
    assert all(f"| {name} | {field.dtype} | {field.axes} |" in readme for name, field in made.fields.items())
    assert all(word in readme for word in (made.command, made.licence, made.conventions))
    croissant = json.loads((tmp_path / "croissant.json").read_text())
    for part in croissant["distribution"]:
        assert part["sha256"] == file_sha256(tmp_path / part["contentUrl"])
        assert part["contentSize"] == f"{(tmp_path / part['contentUrl']).stat().st_size} B"


@pytest.mark.parametrize("codec", codecs.CODECS)
@pytest.mark.parametrize("example", ["gen2d", "torch", "h5py"])
def test_the_examples_of_the_card_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, example: str, codec: str
) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path / "copied elsewhere", codec=codec))
    blocks = re.findall(r"```python\n(.*?)```", (made.root / "README.md").read_text(), re.S)
    (code,) = (block for block in blocks if example in block and (example == "torch" or "torch" not in block))
    for module in re.findall(r"import (.*)", code)[0].split(", "):
        pytest.importorskip(module)
    monkeypatch.chdir(made.root)
    names: dict[str, Any] = {}
    exec(code, names)
    if example == "torch":
        assert names["batch"]["frames"].shape == (20, 5, 8, 8, 3)
        return
    video = names["video"] if example == "h5py" else names["video"]["frames"]
    assert_array_equal(video, synthetic.video(made, "train", 0)["frames"])
