"""The blocks of the page on loading run, each on its own, beside a small dataset."""

import re
from pathlib import Path

import pytest
from packages import require

import gen2d

PAGE = Path(__file__).parents[2] / "docs" / "loading.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
OTHERS = (
    "torch",
    "torchdata",
    "lightning",
    "accelerate",
    "grain",
    "tensorflow",
    "tensorflow_datasets",
    "pandas",
    "pyarrow",
    "datasets",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the dataset that the blocks name."""
    home = tmp_path_factory.mktemp("page")
    scene = {"name": "bouncing", "balls": [2, 8], "gravity": [0, [-20, 0]], "radius": 0.4}
    video = {"frames": 28, "height": 16, "width": 16}
    config = {"scene": scene, "video": video, "annotations": {"masks": True}}
    gen2d.generate(config, 32, home / "datasets" / "bouncing")
    (home / "datasets" / "annotated").symlink_to("bouncing")
    return home


@pytest.mark.filterwarnings("ignore")  # of other libraries
@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_a_block_runs(number: int, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    block = BLOCKS[number].replace("train-00000.h5", "train-00000-n32.h5")  # a part of a shard has its count
    needed = {name for name in OTHERS if re.search(rf"^(?:import|from) {name}\b", block, re.MULTILINE)}
    require(*sorted(needed | ({"torch"} if "gen2d.torch" in block else set())))
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HF_HOME", str(folder / "huggingface"))
    names: dict[str, object] = {"__name__": "__main__"}
    exec(compile(block, f"block {number} of {PAGE}", "exec"), names)
    for value in names.values():
        if isinstance(value, gen2d.DataLoader):
            value.close()
