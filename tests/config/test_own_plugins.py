"""A family, look or annotation of one's own goes with the dataset: it makes its videos again after the file is gone."""

import importlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import forged
import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from synthetic import contents, flip
from tiny import run_main, sentences, tiny_config

import gen2d
from gen2d.annotations import tracks
from gen2d.config import plugins
from gen2d.config.config import load_config
from gen2d.config.trust import list_path
from gen2d.core.errors import ConfigError, FolderError, UntrustedError
from gen2d.dataset.manifest import read_manifest
from gen2d.generation.regenerate import repair
from gen2d.generation.run import generate
from gen2d.programs.recipe import config_of
from gen2d.scenes import bouncing
from gen2d.storage.sealed import sha256
from gen2d.tools.verify import verify

flat = importlib.import_module("gen2d.renderers.looks.flat")
COPIES = ["plugins/annotation/mine.py", "plugins/look/mine.py", "plugins/scene/mine.py"]
FOLDERS = {"annotations": tracks, "looks": flat, "families": bouncing}  # in the order of COPIES


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a family, a look and an annotation of one name, and a dataset of them."""
    home = tmp_path_factory.mktemp("home")
    for folder, module in FOLDERS.items():
        (home / folder).mkdir()
        shutil.copy(str(module.__file__), home / folder / "mine.py")
    generate(config(home), 6, home / "data")
    return home


def config(home: Path) -> dict:
    names = {
        "scene": {"name": f"{home}/families/mine.py", "balls": 3},
        "look": {"name": f"{home}/looks/mine.py"},
        "annotations": {f"{home}/annotations/mine.py": 2},
    }
    return tiny_config(storage={"videos_per_shard": 4}, **names)


GONE = {
    "removed": lambda path: path.unlink(),
    "changed": lambda path: path.write_text("raise RuntimeError('what is there now')"),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.fixture(params=["there", *GONE])
def root(request: pytest.FixtureRequest, home: Path, tmp_path: Path) -> Iterator[Path]:
    """The dataset, its originals there, gone, or something else."""
    originals = [home / folder / "mine.py" for folder in FOLDERS]
    kept = [path.read_bytes() for path in originals]
    if request.param != "there":
        for path in originals:
            GONE[request.param](path)
    yield Path(shutil.copytree(home / "data", tmp_path / "data"))
    for path, content in zip(originals, kept, strict=True):
        shutil.rmtree(path, ignore_errors=True)
        path.write_bytes(content)


def test_the_files_lie_in_the_folder_and_in_its_manifest(home: Path) -> None:
    files = read_manifest(home / "data").files
    assert sorted(name for name in files if name.startswith("plugins/")) == COPIES
    for name, kind in zip(COPIES, FOLDERS, strict=True):
        assert (home / "data" / name).read_bytes() == (home / kind / "mine.py").read_bytes()
    assert verify(home / "data", "full") == []


def test_videos_are_made_again(root: Path) -> None:
    assert verify(root, "regen", videos=6) == []
    ds = gen2d.open(root)
    expected = ds[[1, 5]]["frames"]
    assert_array_equal(np.asarray(gen2d.render(ds, [1, 5])), expected)
    points = gen2d.open(root, fields=["tracks/points"])[[1, 5]]["tracks/points"]
    assert_array_equal(np.asarray(gen2d.render(ds, [1, 5], fields=["tracks/points"])["tracks/points"]), points)
    look = config_of(ds).plain()["look"]
    assert_array_equal(np.asarray(gen2d.render(ds, [1, 5], look=look)), expected)
    assert config_of(ds, ["look.background=[9, 9, 9]"]).look.content == config_of(ds).look.content


def test_what_is_damaged_is_made_again(home: Path, root: Path) -> None:
    flip(root / "shards" / "train-00000.h5", 80000)
    flip(root / "config.yaml", 80)
    (root / "index" / "train-6.npy").unlink()
    assert verify(root, "full", lambda names: repair(root, names)) == []
    assert contents(root) == contents(home / "data")


def test_a_damaged_copy_is_found_and_comes_back_where_the_original_is_there(
    request: pytest.FixtureRequest, home: Path, root: Path
) -> None:
    for name in COPIES:
        flip(root / name, 80)
    found = verify(root, "quick")
    assert [f"{root}/{name} is not what was written" for name in COPIES] == found
    for call in (lambda: verify(root, "regen"), lambda: repair(root, []), lambda: gen2d.render(gen2d.open(root), [0])):
        with pytest.raises(ConfigError, match=r"mine\.py") as caught:
            call()
        assert "\n" not in str(caught.value)
    if request.node.callspec.params["root"] == "there":
        generate(config(home), 6, root)  # which names the originals
        assert contents(root) == contents(home / "data")


SEEN = "seen.txt"  # written by the look below when it runs


@pytest.fixture(params=["look", pytest.param("annotation", marks=pytest.mark.full)])
def foreign(request: pytest.FixtureRequest, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset whose look or annotation leaves a trace when it runs, for a user who has never generated with it."""
    trace = f"import pathlib\npathlib.Path({str(tmp_path / SEEN)!r}).touch()\n"
    (tmp_path / "mine.py").write_bytes((home / f"{request.param}s" / "mine.py").read_bytes() + trace.encode())
    path = str(tmp_path / "mine.py")
    own = {"look": path} if request.param == "look" else {"annotations": {path: 1}}
    states = tiny_config(storage={"frames": "none"})
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "of whoever made it"))
    generate(states | own, 3, tmp_path / "data")
    assert sha256((tmp_path / "mine.py").read_bytes()) in list_path().read_text()
    (tmp_path / SEEN).unlink()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "of another"))
    plugins._run_file.cache_clear()
    return tmp_path / "data"


def test_what_came_with_a_dataset_runs_only_if_it_is_trusted(foreign: Path, tmp_path: Path) -> None:
    ds, copy = gen2d.open(foreign), next(foreign.glob("plugins/*/mine.py"))
    digest = sha256(copy.read_bytes())
    assert len(ds[:]) == 4
    assert verify(foreign, "full") == []
    for words in (
        ("info", foreign),
        ("verify", foreign),
        ("export", foreign, "--to", "npz", "--out", tmp_path / "npz"),
    ):
        run_main(*words)
    assert not (tmp_path / SEEN).exists()
    commands = [("preview", foreign, "--out", tmp_path), ("preview", foreign, "--gallery", "--out", tmp_path)]
    commands += [
        ("verify", foreign, "--level", "regen"),
        ("export", foreign, "--to", "mp4", "--out", tmp_path / "films"),
    ]
    flip(foreign / "shards" / "train-00000-n3.h5", 80000)
    commands += [("verify", foreign, "--repair")]
    for words in commands:
        done = run_main(*words)
        assert done.returncode == 2
        assert len(sentences(done.stderr)) == 1
        assert f"{copy}" in done.stderr
        assert f"--trust {digest}" in done.stderr
    for call in (lambda: gen2d.render(ds, [0]), lambda: gen2d.simulate_again(ds, [0]), lambda: repair(foreign)):
        with pytest.raises(UntrustedError, match=digest):
            call()
    with pytest.raises(UntrustedError):
        gen2d.render(ds, [0], trust="0" * 64)
    with pytest.raises(ConfigError, match=r"^trust is 'yes'"):
        gen2d.render(ds, [0], trust="yes")
    assert not (tmp_path / SEEN).exists()
    assert repair(foreign, ["train-00000-n3"], trust=digest) == ["train-00000-n3"]
    assert (tmp_path / SEEN).exists()
    gen2d.render(ds, [0], trust=[digest])
    list_path().parent.mkdir(parents=True)
    list_path().write_text(f"# read by me\n{digest}\n")
    gen2d.render(ds, [0])
    list_path().chmod(0o666)  # then anybody may have written it
    with pytest.raises(UntrustedError):
        gen2d.render(ds, [0])


def test_a_file_that_lies_here_by_chance_is_never_run(foreign: Path, tmp_path: Path) -> None:
    """A manifest may name any file of this machine."""
    shutil.rmtree(foreign / "plugins")
    digest = sha256((tmp_path / "mine.py").read_bytes())
    for trust in ((), digest):
        with pytest.raises(ConfigError, match="holds no copy"):
            gen2d.render(gen2d.open(foreign), [0], trust=trust)
    forged.seal(foreign, lambda plain: plain["config"]["scene"].update(name=str(tmp_path / "mine.py")))
    with pytest.raises(ConfigError, match="holds no copy"):
        repair(foreign)
    assert not (tmp_path / SEEN).exists()


def test_a_copy_is_of_its_own_file_only(home: Path, root: Path) -> None:
    """Another file that is asked for is not taken for the one that the dataset has a copy of."""
    other = home / "other.py"
    other.write_bytes(Path(str(flat.__file__)).read_bytes() + b"# other\n")
    ds = gen2d.open(root)
    own = load_config({"look": str(other)}).look
    assert own.sha256 != config_of(ds).look.sha256
    assert load_config(config_of(ds).plain() | {"look": own.plain()}, copies=config_of(ds).copies).look == own
    with pytest.raises(ConfigError, match=r"sha256 is of another version of .*other\.py"):
        config_of(ds, [f"look.name={other}"])


# ---- What stays an error


def test_a_run_goes_on_with_the_very_file_only(home: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(home / "data", tmp_path / "data"))
    own = config(home)
    original = home / "looks" / "mine.py"
    content = original.read_bytes()
    try:
        original.write_bytes(content + b"# changed\n")
        with pytest.raises(FolderError, match=r"config\.look\.sha256 is .* there and .* here"):
            generate(own, 8, out)
        original.unlink()
        with pytest.raises(ConfigError, match=r"looks/mine.py', but there is no such file"):
            generate(own, 8, out)
    finally:
        original.write_bytes(content)
    assert contents(out) == contents(home / "data")


def test_another_dataset_takes_the_place_of_the_copies_too(tmp_path: Path) -> None:
    copies = {name: name.encode() for name in COPIES}
    synthetic.make(synthetic.dataset(tmp_path, train=1, copies=copies))
    assert all((tmp_path / name).read_bytes() == content for name, content in copies.items())
    synthetic.make(synthetic.dataset(tmp_path, train=1, seed=8, copies={COPIES[0]: b"other"}), overwrite=True)
    assert (tmp_path / COPIES[0]).read_bytes() == b"other"
    assert not (tmp_path / COPIES[1]).exists()
    (tmp_path / COPIES[1]).parent.mkdir()
    (tmp_path / COPIES[1]).touch()
    assert verify(tmp_path) == [f"{tmp_path / COPIES[1]} does not belong to the dataset"]


@pytest.mark.full
def test_a_look_of_a_split_s_own_goes_with_the_dataset_too(home: Path, tmp_path: Path) -> None:
    look = tmp_path / "mine.py"
    look.write_bytes((home / "looks" / "mine.py").read_bytes() + b"# another\n")
    splits = {"train": {"videos": 2}, "dark": {"videos": 2, "look": {"name": str(look), "background": [0, 0, 0]}}}
    generate(config(home) | {"splits": splits}, 2, tmp_path / "data")
    content = look.read_bytes()
    assert (tmp_path / "data" / "plugins" / "splits" / "dark" / "look" / "mine.py").read_bytes() == content
    expected = gen2d.open(tmp_path / "data", "dark")[:]["frames"]
    look.write_bytes(content + b"# changed\n")
    with pytest.raises(FolderError, match=r"config\.splits\.dark\.look\.sha256 is .* there and .* here"):
        generate(config(home) | {"splits": splits}, 2, tmp_path / "data")
    look.unlink()
    assert verify(tmp_path / "data", "regen", videos=4) == []
    assert_array_equal(np.asarray(gen2d.render(gen2d.open(tmp_path / "data", "dark"), [0, 1])), expected)
