"""What a dataset says about itself is true, and its examples run."""

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
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
def test_the_examples_of_the_card_run(tmp_path: Path, example: str, codec: str) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path / "copied elsewhere", codec=codec))
    blocks = re.findall(r"```python\n(.*?)```", (synthetic.folder(made) / "README.md").read_text(), re.S)
    (code,) = (block for block in blocks if example in block and (example == "torch" or "torch" not in block))
    for module in re.findall(r"import (.*)", code)[0].split(", "):
        if not importlib.util.find_spec(module):
            pytest.skip(f"{module} is not installed")
    shown = {"torch": 'batch["frames"].numpy()', "gen2d": 'video["frames"]', "h5py": "video"}[example]
    code += f"\nimport numpy\nnumpy.save('shown.npy', {shown})"
    # In a process of its own: where hdf5plugin is imported, HDF5 writes the filter's name into new zstd files.
    subprocess.run([sys.executable, "-c", code], cwd=synthetic.folder(made), check=True)
    found = np.load(synthetic.folder(made) / "shown.npy")
    if example == "torch":
        assert found.shape == (20, 5, 8, 8, 3)
    else:
        assert_array_equal(found, synthetic.video(made, "train", 0)["frames"])
