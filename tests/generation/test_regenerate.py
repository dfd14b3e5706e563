"""Videos made again from the recipe are those that are stored, and what is damaged is made again to the byte."""

import functools
import json
import shutil
from pathlib import Path

import forged
import pytest
from synthetic import contents, flip
from tiny import run_command, sentences, tiny_config

from gen2d.core.errors import FolderError
from gen2d.dataset.manifest import read_manifest
from gen2d.dataset.spec import EARLIER_SCHEMA, DatasetSpec
from gen2d.generation.regenerate import repair
from gen2d.generation.run import generate
from gen2d.tools.verify import chosen_videos, verify, verify_and_repair


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tiny") / "data"
    config = tiny_config(storage={"codec": "zstd"})
    generate(config, 21, out)
    generate(config, 3, out, split="test")
    return out


@pytest.fixture
def root(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine, tmp_path / "data"))


def test_what_was_made_is_what_is_made_again(pristine: Path) -> None:
    assert verify(pristine, "regen", videos=24) == []


def test_videos_are_chosen_by_the_seed() -> None:
    splits = {"test": 3, "train": 21}
    everything = [("test", i) for i in range(3)] + [("train", i) for i in range(21)]
    assert chosen_videos(splits, 99, 0) == everything
    few = [chosen_videos(splits, 5, seed) for seed in range(60)]
    assert all(len(set(own)) == 5 and set(own) <= set(everything) for own in few)
    assert few[0] == chosen_videos(splits, 5, 0)
    assert {video for own in few for video in own} == set(everything)


def test_a_dataset_with_other_values_but_right_checksums_is_found_and_made_again(pristine: Path, root: Path) -> None:
    forged.flip_value(root, "train", 1, "states/position", 2)
    assert verify(root, "full") == []
    outcome = verify_and_repair(root, "regen", videos=24)
    (sentence,) = outcome.problems
    assert "train-00001.h5: states/position of train video 10 is not what its recipe makes" in sentence
    outcome = verify_and_repair(root, "regen", lambda names: repair(root, names), videos=24)
    assert (outcome.problems, outcome.repaired, outcome.remade) == ([], [sentence], ["train-00001"])
    assert contents(root) == contents(pristine)


LAST, TEST, TABLE = "shards/train-00002-n5.h5", "shards/test-00000-n3.h5", "index/train-21.npy"
DAMAGES = {
    "shard": ["shards/train-00000.h5"],
    "table": [TABLE],
    "mark": [".gen2d/dataset.json"],
    "manifest": ["manifest.json"],
    "manifest and a shard": ["manifest.json", LAST],
    "manifest and a table": ["manifest.json", TABLE],
    "manifest, a table and a shard": ["manifest.json", TABLE, LAST],
    "many": ["shards/train-00001.h5", TEST, "config.yaml", "croissant.json", "sheet.png", "index.html"],
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_repair_restores_every_byte(pristine: Path, root: Path, damage: str) -> None:
    for name in DAMAGES[damage]:
        flip(root / name, 8 * ((root / name).stat().st_size // 2) + 3)
    outcome = verify_and_repair(root, "full", lambda names: repair(root, names))
    assert outcome.problems == []
    named = "\n".join(outcome.repaired)
    listed = DAMAGES[damage][:1] if damage.startswith("manifest") else DAMAGES[damage]
    assert all(name in named for name in listed)
    assert contents(root) == contents(pristine)


def test_an_earlier_dataset_is_repaired_in_its_own_schema(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as earlier:
        earlier.setattr("gen2d.generation.worker.DatasetSpec", functools.partial(DatasetSpec, schema=EARLIER_SCHEMA))
        generate(tiny_config(), 9, tmp_path / "pristine")
    assert read_manifest(tmp_path / "pristine").schema == EARLIER_SCHEMA
    for damage in (["shards/train-00000.h5"], [".gen2d/dataset.json"], ["manifest.json", "shards/train-00001-n1.h5"]):
        root = Path(shutil.copytree(tmp_path / "pristine", tmp_path / f"{len(list(tmp_path.iterdir()))}"))
        for name in damage:
            flip(root / name, 8 * ((root / name).stat().st_size // 2) + 3)
        assert verify_and_repair(root, "full", lambda names, root=root: repair(root, names)).problems == []
        assert contents(root) == contents(tmp_path / "pristine")


def test_missing_and_empty_files_are_restored(pristine: Path, root: Path) -> None:
    for name in (TABLE, "shards/train-00000.h5", "README.md", ".gen2d/dataset.json"):
        (root / name).unlink()
    for name in ("config.yaml", TEST):
        (root / name).write_bytes(b"")
    outcome = verify_and_repair(root, "quick", lambda names: repair(root, names))
    assert outcome.problems == []
    assert outcome.remade == ["test-00000-n3", "train-00000", "train-00001", "train-00002-n5"]
    assert contents(root) == contents(pristine)


def test_a_dataset_that_nothing_describes_is_not_guessed(root: Path) -> None:
    for name in ("manifest.json", ".gen2d/dataset.json"):
        flip(root / name, 1000)
    before = contents(root)
    with pytest.raises(FolderError, match="both damaged"):
        repair(root, [])
    assert contents(root) == before


def test_a_dataset_that_may_have_been_larger_is_not_guessed(root: Path) -> None:
    flip(root / "manifest.json", 1000)
    for path in (root / "index").iterdir():
        path.unlink()
    before = contents(root)
    with pytest.raises(FolderError, match=r"nothing says how many videos there were: run the command"):
        repair(root, [])
    assert contents(root) == before


def test_other_versions_are_an_error_and_nothing_is_changed(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    flip(root / "shards" / "train-00000.h5", 80000)
    before = contents(root)
    for call in (lambda: verify(root, "regen"), lambda: repair(root, ["train-00000"])):
        with pytest.raises(FolderError, match=r"fingerprint.xla_flags is .* there and --xla"):
            call()
    assert contents(root) == before
    flip(root / "shards" / "train-00000.h5", 80000)
    flip(root / TABLE, 300)  # in its header
    assert verify(root, "full", lambda names: repair(root, names)) == []  # that takes no simulation


def test_the_command_line_repairs(pristine: Path, root: Path) -> None:
    done = run_command("verify", root, "--level", "regen", "--videos", 3, "--seed", 5)
    assert (done.returncode, "3 videos chosen by --seed 5" in done.stdout) == (0, True), done.stderr
    flip(root / "shards" / "train-00001.h5", 80000)
    flip(root / "manifest.json", 3000)
    done = run_command("verify", root, "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["level"] == "full"
    done = run_command("verify", root, "--repair", "--json")
    assert done.returncode == 0, done.stderr
    about = json.loads(done.stdout)
    assert (about["problems"], about["remade"]) == ([], ["train-00001"])
    assert "manifest.json" in about["repaired"][0]
    assert contents(root) == contents(pristine)
    other = run_command("verify", root, "--level", "regen", XLA_FLAGS="--xla_cpu_enable_fast_math=false")
    assert (other.returncode, other.stdout) == (2, "")
    assert len(sentences(other.stderr)) == 1
