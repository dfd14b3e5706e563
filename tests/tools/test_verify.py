"""Whatever byte of a dataset changes, `full` finds it; whatever is complete passes."""

import shutil
from pathlib import Path

import forged
import h5py
import numpy as np
import pytest
import synthetic
from synthetic import flip

from gen2d.core.errors import ConfigError, DamagedError, FolderError
from gen2d.dataset.block import encode
from gen2d.dataset.folder import open_folder
from gen2d.generation.complete import complete
from gen2d.loading import dataset as loader
from gen2d.tools.verify import damaged_shards, verify


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.folder(
        synthetic.make(synthetic.dataset(tmp_path_factory.mktemp("data") / "toy", train=10, codec="zstd"))
    )


@pytest.fixture
def root(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine, tmp_path / "toy"))


@pytest.mark.parametrize("codec", ["gzip", "zstd", "none"])
@pytest.mark.parametrize("level", ["quick", "full"])
def test_what_was_written_passes(tmp_path: Path, codec: str, level: str) -> None:
    synthetic.make(synthetic.dataset(tmp_path, codec=codec))
    assert verify(tmp_path, level) == []
    assert damaged_shards(tmp_path, level) == []


KINDS = [
    *("shards/*.h5", "index/*.npy", "manifest.json", "config.yaml", "croissant.json", "sheet.png", "index.html"),
    ".gen2d/dataset.json",
]


def everything(root: Path) -> dict[str, dict[str, np.ndarray]]:
    """Every field of every video, by split, as training reads it."""
    return {split: loader.open(root, split, "*")[:] for split in ("train", "test")}


def refused(root: Path, expected: dict[str, dict[str, np.ndarray]]) -> str:
    """What the loader says of damage when it reads everything; empty if it gives what was written."""
    try:
        found = everything(root)
    except (DamagedError, FolderError) as error:
        return str(error)
    for split, fields in expected.items():
        for name, values in fields.items():
            assert found[split][name].tobytes() == values.tobytes(), f"{name} of {split} was read wrong in silence"
    return ""


@pytest.mark.parametrize("kind", [*KINDS, pytest.param("**/*", marks=pytest.mark.slow)])
def test_a_flipped_bit_anywhere_is_found_and_never_read(root: Path, kind: str) -> None:
    """A hundred of each kind of file; slow: of all together, by their sizes."""
    paths = sorted(p for p in root.glob(kind) if p.is_file() and p.name not in ("README.md", "run.jsonl"))
    expected, random = everything(root), np.random.default_rng(0)
    share = np.array([path.stat().st_size for path in paths], float)
    for number in random.choice(len(paths), 100, p=share / share.sum()).tolist():
        path, bit = paths[number], int(random.integers(0, 8 * share[number]))
        flip(path, bit)
        found = verify(root, "full")
        assert any(str(path) in sentence for sentence in found), f"bit {bit} of {path}: {found}"
        assert str(path) in (refused(root, expected) or str(path))
        flip(path, bit)
    assert verify(root, "full") == []


@pytest.mark.parametrize("level", ["quick", "full"])
def test_files_in_each_others_place_are_found_and_never_read(root: Path, level: str) -> None:
    expected = everything(root)
    for kind in ("shards/*.h5", "index/*.npy"):
        one, other = sorted(root.glob(kind))[:2]
        contents = one.read_bytes(), other.read_bytes()
        for path, content in zip((one, other), reversed(contents), strict=True):
            path.write_bytes(content)
        found = verify(root, level)
        if level == "full" or len(contents[0]) != len(contents[1]) or not kind.startswith("shards"):
            assert all(any(str(path) in sentence for sentence in found) for path in (one, other)), kind
        sentence = refused(root, expected) or str(one)
        assert str(one) in sentence or str(other) in sentence
        for path, content in zip((one, other), contents, strict=True):
            path.write_bytes(content)
    assert verify(root, level) == []


@pytest.mark.parametrize("size", ["gone", "empty", "half", "longer"])
def test_a_file_of_another_length_is_found_and_never_read(root: Path, size: str) -> None:
    expected = everything(root)
    for path in sorted({path for kind in KINDS for path in root.glob(kind) if path.is_file()}):
        content = path.read_bytes()
        changed = {"gone": b"", "empty": b"", "half": content[: len(content) // 2], "longer": content + b"0"}[size]
        path.write_bytes(changed)
        if size == "gone":
            path.unlink()
        found = verify(root, "quick")
        named = root if size == "gone" and path.name == "manifest.json" else path
        assert any(str(named) in sentence for sentence in found), path
        assert str(named) in (refused(root, expected) or str(named))
        path.write_bytes(content)
    assert verify(root, "quick") == []


def test_a_copy_without_the_programs_own_files_is_whole(root: Path) -> None:
    shutil.rmtree(root / ".gen2d")
    assert verify(root, "full") == []


def test_a_damaged_piece_is_named_and_not_returned(root: Path) -> None:
    with h5py.File(root / "shards" / "train-00000.h5") as file:
        stored = file["frames"]
        assert isinstance(stored, h5py.Dataset)
        piece = stored.id.get_chunk_info(5)
    flip(root / "shards" / "train-00000.h5", 8 * (piece.byte_offset + piece.size // 2))
    assert any("frames of train video 5" in sentence for sentence in verify(root, "full"))
    assert damaged_shards(root, "full") == ["train-00000"]
    dataset = loader.open(root)
    with pytest.raises(DamagedError, match=r"train-00000.h5: frames of train video 5"):
        dataset[5]
    assert dataset[4].keys() == dataset.fields.keys()


def test_a_damaged_state_is_named_and_not_returned(root: Path) -> None:
    with h5py.File(root / "shards" / "train-00001-n2.h5") as file:
        stored = file["states/position"]
        assert isinstance(stored, h5py.Dataset)
        offset = stored.id.get_offset()
    assert offset
    flip(root / "shards" / "train-00001-n2.h5", 8 * offset)
    with pytest.raises(DamagedError, match=r"train-00001-n2.h5: states/position of train video 8"):
        loader.open(root)[8]
    assert loader.open(root, fields=("frames", "states/angle"))[8]
    assert loader.open(root, verify="none")[8]


@pytest.mark.parametrize("level", ["quick", "full"])
def test_missing_cut_empty_and_extra_files_are_found(root: Path, level: str) -> None:
    (root / "shards" / "train-00000.h5").unlink()
    (root / "shards" / "test-00000-n3.h5").write_bytes(b"")
    path = root / "shards" / "train-00001-n2.h5"
    path.write_bytes(path.read_bytes()[:-1])
    (root / "shards" / "train-00007.h5").write_bytes(b"of a run that goes on")
    (root / "shards" / "notes.txt").write_bytes(b"more")
    (root / "index" / "extra.npy").write_bytes(b"")
    found = verify(root, level)
    wrong = ("train-00000.h5 is missing", "test-00000-n3.h5 has 0 bytes", "train-00001-n2.h5 has")
    for part in (*wrong, "notes.txt does not belong", "extra.npy does not belong"):
        assert any(part in sentence for sentence in found), part
    assert damaged_shards(root, level) == ["test-00000-n3", "train-00000", "train-00001-n2"]
    (root / "index" / "train-10.npy").unlink()
    assert any("train-10.npy is missing" in sentence for sentence in verify(root, level))


@pytest.mark.parametrize("level", ["quick", "full"])
def test_an_incomplete_dataset_says_how_to_go_on(root: Path, level: str) -> None:
    (root / "manifest.json").unlink()
    (sentence,) = verify(root, level)
    assert "incomplete: run the command that made it again" in sentence
    (sentence,) = verify(root.parent, level)
    assert "is not a gen2d dataset" in sentence


def test_a_shard_that_lies_is_found_although_its_checksums_fit(tmp_path: Path) -> None:
    made = synthetic.dataset(tmp_path, train=10)
    for shard in open_folder(made):
        columns = synthetic.columns(made, shard)
        if shard.name == "train-00000":
            columns["states/angle"][2, 1, 0] = np.nan
            columns["states/position"][3, 1, 0, 0] = np.inf
            columns["objects/mass"][4, 2] = np.nan
            columns["index"][5] = 99
        synthetic.write(made, shard, [encode(columns, made.fields, made.codec)])
    assert complete(made)
    assert verify(tmp_path, "quick") == []
    found = verify(tmp_path, "full")
    assert len(found) == 4
    wrong = (
        "states/angle of video 2",
        "states/position of video 3",
        "objects/mass of video 4",
        "index of video 5 is 99",
    )
    assert all(any(part in sentence for sentence in found) for part in wrong)
    assert damaged_shards(tmp_path, "full") == ["train-00000"]


@pytest.mark.parametrize("key", ["bytes", "largest"])
def test_a_manifest_whose_sums_are_wrong_is_found(root: Path, key: str) -> None:
    forged.seal(root, lambda plain: plain["tables"]["train"].update({key: plain["tables"]["train"][key] + 1}))
    (sentence,) = [each for each in verify(root, "quick") if "dataset.json" not in each]
    assert "train-10.npy has shards of other sizes than manifest.json says" in sentence


def test_a_repair_makes_the_bad_shards_again(root: Path) -> None:
    before = synthetic.tree(root)
    flip(root / "shards" / "train-00001-n2.h5", 80000)
    (root / "shards" / "test-00000-n3.h5").unlink()

    def repair(names: list[str]) -> None:
        assert names == ["test-00000-n3", "train-00001-n2"]
        for name in names:
            (root / "shards" / f"{name}.h5").unlink(missing_ok=True)
        synthetic.make(synthetic.dataset(root, train=10, codec="zstd"))

    assert verify(root, "full", repair) == []
    assert synthetic.tree(root) == before


def test_an_unknown_level_is_refused(root: Path) -> None:
    with pytest.raises(ConfigError, match="level is 'fast'"):
        verify(root, "fast")
