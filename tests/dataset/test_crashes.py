"""A crash at any change to the disk costs nothing: readers keep what they have, and the next run leaves what one run
would have left."""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from crashes import every_crash
from numpy.testing import assert_array_equal
from synthetic import small

import gen2d
from gen2d.core.errors import FolderError
from gen2d.dataset import folder
from gen2d.dataset.manifest import read_manifest
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.dataset.spec import DatasetSpec, Shard
from gen2d.generation import regenerate
from gen2d.tools.verify import verify

SPLITS = {count: {"train": count, "test": 3} for count in (12, 30)}


def videos(ds: Any) -> Mapping[str, np.ndarray]:
    return ds[:]


def same(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> None:
    assert one.keys() == other.keys()
    for name, values in one.items():
        assert_array_equal(values, other[name])


def contents(root: Path) -> dict[str, bytes]:
    """Every file and its bytes, except earlier snapshots, which wait to be removed."""
    return {name: own for name, own in synthetic.contents(root).items() if not name.startswith(".gen2d/snapshots/")}


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The dataset with these numbers of videos, each made in one run."""
    home = tmp_path_factory.mktemp("grown")
    return {count: synthetic.folder(synthetic.make(small(home / f"{count}", SPLITS[count]))) for count in (12, 30)}


def test_while_a_dataset_grows(grown: dict[int, Path], tmp_path: Path) -> None:
    crashes = 0
    root = tmp_path / "data"

    def restored() -> None:
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(grown[12], root)

    restored()
    expected, before, after = videos(gen2d.open(grown[12], fields="*")), *(contents(grown[count]) for count in (12, 30))
    reader = gen2d.open(root, fields="*")
    for _ in every_crash(lambda: synthetic.make(small(root, SPLITS[30]))):
        crashes += 1
        same(videos(reader), expected)  # who has it open, or was to go on where it stood, reads on
        same(videos(gen2d.open(root, fields="*", snapshot=reader.snapshot)), expected)
        opened = gen2d.open(root, fields="*")
        assert len(opened) in (12, 30)
        same({name: values[:12] for name, values in videos(opened).items()}, expected)
        assert verify(root, "full") == []
        synthetic.make(small(root, SPLITS[30]))
        assert contents(root) == after
        same(videos(reader), expected)
        restored()
        assert contents(root) == before
        reader = gen2d.open(root, fields="*")
    assert crashes > 50


def test_while_a_dataset_is_made(grown: dict[int, Path], tmp_path: Path) -> None:
    crashes, root = 0, tmp_path / "data"
    for _ in every_crash(lambda: synthetic.make(small(root, SPLITS[12])), step=2):
        crashes += 1
        if (root / "manifest.json").exists():
            assert len(gen2d.open(root, fields="*")) == 12
        else:
            with pytest.raises(FolderError, match=r"incomplete|not a gen2d dataset"):
                gen2d.open(root, fields="*")
        synthetic.make(small(root, SPLITS[12]))
        assert contents(root) == contents(grown[12])
        shutil.rmtree(root)
    assert crashes > 30


def test_while_snapshots_are_cleaned_away(grown: dict[int, Path], tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(grown[12], root)
    synthetic.make(small(root, SPLITS[30]))
    after = contents(root)
    for _ in every_crash(lambda: folder.clean(root)):
        assert verify(root, "full") == []
        shutil.rmtree(root)
        shutil.copytree(grown[12], root)
        synthetic.make(small(root, SPLITS[30]))
    assert folder.clean(root) == [] or folder.clean(root) == []
    assert contents(root) == after
    assert not list((root / ".gen2d" / "snapshots").glob("*"))


DAMAGES = {
    "a shard": ("shards/train-00000.h5",),
    "the manifest and a shard": ("manifest.json", "shards/train-00001-n4.h5"),
    "the table and the config": ("index/train-12.npy", "config.yaml", "sheet.png", "index.html"),
}


def repaired(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has repair make the synthetic videos again instead of simulating."""

    def make(rollout: object, spec: DatasetSpec, todo: list[Shard], log: object) -> None:
        with ShardWriter(spec) as writer:
            for shard in todo:
                writer.write(shard, synthetic.blocks(spec, shard))

    def made(rollout: object, root: Path, counts: Mapping[str, int], fingerprint: object) -> DatasetSpec:
        return small(root, dict(counts))

    monkeypatch.setattr(regenerate, "source_of", lambda *_, **__: None)
    monkeypatch.setattr(regenerate, "check_fingerprint", lambda *_: None)
    monkeypatch.setattr(regenerate.devices, "versions", lambda: dict.fromkeys(regenerate.WRITERS))
    monkeypatch.setattr(regenerate, "dataset_of", made)
    monkeypatch.setattr(regenerate, "generate_shards", make)


@pytest.mark.parametrize(
    "damage", [x if x == "the manifest and a shard" else pytest.param(x, marks=pytest.mark.full) for x in DAMAGES]
)
def test_while_a_dataset_is_repaired(
    grown: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    repaired(monkeypatch)
    crashes, root, names = 0, tmp_path / "data", DAMAGES[damage]
    pristine = contents(grown[12])

    def restored() -> None:
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(grown[12], root)
        for name in names:
            content = bytearray((root / name).read_bytes())
            content[len(content) // 2] ^= 8
            (root / name).write_bytes(content)

    restored()
    bad = [Path(name).stem for name in names if name.startswith("shards/")]
    for _ in every_crash(lambda: regenerate.repair(root, bad)):
        crashes += 1
        for name, content in contents(root).items():
            if ".tmp." not in name and name not in names and not name.startswith(".gen2d/"):
                assert content == pristine[name], name  # what was whole still is
            elif name in names:
                assert content == pristine[name] or len(content) == len(pristine[name])
        regenerate.repair(root, bad)
        assert verify(root, "full") == []
        folder.clean(root)
        assert contents(root) == pristine
        restored()
    assert crashes > 5
    regenerate.repair(root, bad)
    assert contents(root) == pristine


def test_while_a_dataset_is_exported(grown: dict[int, Path], tmp_path: Path) -> None:
    crashes, out = 0, tmp_path / "out"
    gen2d.export(grown[12], "npz", out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    for _ in every_crash(lambda: gen2d.export(grown[12], "npz", out)):
        crashes += 1
        if out.exists():  # for a moment, between two renamings, it is not
            assert {path.name: path.read_bytes() for path in out.iterdir()} == before
        gen2d.export(grown[12], "npz", out)
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert crashes > 5


def test_a_repair_that_makes_other_bytes_changes_nothing(
    grown: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repaired(monkeypatch)
    root = Path(shutil.copytree(grown[12], tmp_path / "data"))
    (root / "shards" / "train-00000.h5").write_bytes(b"")
    before = contents(root)

    def wrong(rollout: object, spec: DatasetSpec, todo: list[Shard], log: object) -> None:
        other = small(spec.root, spec.splits, seed=8)
        with ShardWriter(spec) as writer:
            for shard in todo:
                writer.write(shard, synthetic.blocks(other, shard))

    monkeypatch.setattr(regenerate, "generate_shards", wrong)
    with pytest.raises(FolderError, match="train-00000, made again, is not right, so nothing was changed"):
        regenerate.repair(root)
    assert contents(root) == before
    assert read_manifest(root).splits == {"train": 12, "test": 3}


def test_a_repair_finds_what_is_missing_by_itself(
    grown: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that is gone or shorter, by its row; without a manifest every byte is compared."""
    repaired(monkeypatch)
    pristine, names = contents(grown[12]), ("train-00000", "train-00001-n4")
    for damage in ("gone", "shorter", "other bytes, and no manifest"):
        root = Path(shutil.copytree(grown[12], tmp_path / damage))
        for name in names:
            path = root / "shards" / f"{name}.h5"
            content = path.read_bytes()
            path.write_bytes(content[:-1] + (b"" if damage == "shorter" else bytes([content[-1] ^ 1])))
            if damage == "gone":
                path.unlink()
        if damage.endswith("no manifest"):
            synthetic.flip(root / "manifest.json", 3000)
        assert regenerate.repair(root) == [*names]
        assert contents(root) == pristine


def test_a_repair_of_a_dataset_that_grows_meanwhile_changes_nothing(
    grown: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repaired(monkeypatch)
    root, make = Path(shutil.copytree(grown[12], tmp_path / "data")), regenerate.generate_shards

    def growing(*arguments: Any) -> None:
        make(*arguments)
        synthetic.make(small(root, SPLITS[30]))

    monkeypatch.setattr(regenerate, "generate_shards", growing)
    with pytest.raises(FolderError, match="has changed during the repair: run it again"):
        regenerate.repair(root, ["train-00000"])
    assert verify(root, "full") == []
    assert read_manifest(root).splits == SPLITS[30]


def test_a_repaired_shard_is_on_the_disk_before_its_manifest(
    grown: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repaired(monkeypatch)
    root, done, sync, replace = Path(shutil.copytree(grown[12], tmp_path / "data")), list[str](), os.fsync, os.replace

    def fsync(descriptor: int) -> None:
        sync(descriptor)
        done.append(f"flushed {Path(f'/proc/self/fd/{descriptor}').resolve().name}")

    def renamed(source: Any, target: Any) -> None:
        replace(source, target)
        done.append(f"renamed {target}")

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", renamed)
    regenerate.repair(root, ["train-00000"])
    place = done.index(f"renamed {root / 'shards' / 'train-00000.h5'}")
    assert done[place + 1] == "flushed shards"
