"""Datasets and exports that are pushed to a stand-in for the Hugging Face Hub are there, and are loaded from it."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import synthetic
import tiny
from hub import Hub, hub
from packages import package, require

import gen2d
from gen2d.core.errors import UserError

package("huggingface_hub")
SPLITS = {"train": 9, "ood-gravity": 3}


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    return synthetic.folder(synthetic.make(synthetic.dataset(tmp_path / "toy", splits=SPLITS)))


@pytest.fixture
def server() -> Iterator[Hub]:
    with hub() as running:
        yield running


@pytest.fixture
def environment(server: Hub, tmp_path: Path) -> dict[str, str]:
    """For processes, as the libraries read it when they are imported."""
    names = {"HF_ENDPOINT": server.url, "HF_HOME": str(tmp_path / "huggingface"), "HF_TOKEN": "hf_of_nobody"}
    return os.environ | names | {"HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1"}


def push(environment: dict[str, str], *words: object) -> subprocess.CompletedProcess[str]:
    command, _ = tiny.command("push", *words)
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def files_of(root: Path) -> dict[str, bytes]:
    return {name: content for name, content in synthetic.tree(root).items() if name != ".gitattributes"}


def test_a_dataset_is_pushed_whole_and_loaded_back(toy: Path, server: Hub, environment: dict[str, str]) -> None:
    require("datasets")
    done = push(environment, toy, "me/toy", "--private")
    assert done.returncode == 0, done.stderr
    assert f"in {server.url}/datasets/me/toy" in done.stdout
    there = server.repositories["me/toy"]
    assert {name: content for name, content in there.items() if name != ".gitattributes"} == files_of(toy)
    assert server.private["me/toy"]
    code = """if True:
        import datasets, json
        for streaming in (False, True):
            found = datasets.load_dataset("me/toy", streaming=streaming)
            print(json.dumps({split: [row["index"] for row in rows] for split, rows in found.items()}))
    """
    words = [sys.executable, "-c", code]
    loaded = subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()
    for line in loaded:
        assert json.loads(line) == {"ood_gravity": [0, 1, 2], "train": list(range(9))}
    assert len(loaded) == 2


def test_what_a_grown_dataset_replaces_leaves_the_repository(
    toy: Path, server: Hub, environment: dict[str, str]
) -> None:
    assert push(environment, toy, "me/toy").returncode == 0
    server.repositories["me/toy"]["mine.txt"] = b"of somebody else"
    synthetic.make(synthetic.dataset(toy, splits=SPLITS | {"train": 16}))
    done = push(environment, toy, "me/toy")
    assert "2 old files removed" in done.stdout  # a partial shard and a table
    there = server.repositories["me/toy"]
    assert there.pop("mine.txt") == b"of somebody else"
    assert {name: content for name, content in there.items() if name != ".gitattributes"} == files_of(toy)


def test_an_export_is_pushed_with_its_card(toy: Path, tmp_path: Path, server: Hub, environment: dict[str, str]) -> None:
    out = gen2d.export(toy, "webdataset", tmp_path / "tars", codec="npz").out
    done = push(environment, out, "toy-tars", "--licence", "MIT", "--json")
    assert done.returncode == 0, done.stderr
    pushed = json.loads(done.stdout)
    assert pushed["url"].endswith("/datasets/me/toy-tars")
    assert (pushed["files"], pushed["removed"]) == (3, 0)
    there = server.repositories["me/toy-tars"]
    assert there.keys() == {".gitattributes", "README.md", "export.json", "train-000000.tar"}
    assert there["train-000000.tar"] == (out / "train-000000.tar").read_bytes()
    assert there["README.md"].decode().startswith("---\nlicense: mit\npretty_name: ")
    assert there["README.md"].decode().count("license:") == 1
    assert (out / "README.md").read_text().startswith('---\npretty_name: "toy"\nlicense: cc0-1.0\n')


@pytest.mark.parametrize("part_bytes", [0, 5000])
def test_shards_are_uploaded_once_by_git_lfs(
    toy: Path, server: Hub, environment: dict[str, str], part_bytes: int
) -> None:
    server.part_bytes = part_bytes
    assert push(environment, toy, "me/toy").returncode == 0
    shards = {name: content for name, content in files_of(toy).items() if name.endswith(".h5")}
    assert shards
    assert {hashlib.sha256(content).hexdigest() for content in shards.values()} <= server.objects.keys()
    largest = max(shards.values(), key=len)
    sent = [path for path in server.asked if path.startswith("PUT ") and hashlib.sha256(largest).hexdigest() in path]
    assert len(sent) == (-(-len(largest) // part_bytes) if part_bytes else 1)
    assert {name: server.repositories["me/toy"][name] for name in shards} == shards
    server.asked.clear()
    assert push(environment, toy, "me/other").returncode == 0
    assert not [path for path in server.asked if path.startswith("PUT ")]
    assert {name: server.repositories["me/other"][name] for name in shards} == shards


@pytest.mark.parametrize(("code", "exit_code"), [(403, 2), (501, 3)])
def test_a_refused_object_is_one_sentence_and_no_commit(
    toy: Path, server: Hub, environment: dict[str, str], code: int, exit_code: int
) -> None:
    server.lfs_refusal = code
    done = push(environment, toy, "me/toy")
    assert (done.returncode, len(tiny.sentences(done.stderr))) == (exit_code, 1), done.stderr
    assert server.repositories["me/toy"].keys() == {".gitattributes"}


@pytest.mark.parametrize(
    ("code", "exit_code", "message"),
    [
        (401, 2, "me/toy: the Hub refuses the upload (401): run `hf auth login`"),
        (403, 2, "me/toy: the Hub refuses the upload (403)"),
        (404, 2, "me/toy: the Hub has no such repository, owner or branch"),
        (501, 3, "the Hub does not answer"),
    ],
)
def test_a_refusal_is_one_sentence(
    toy: Path, server: Hub, environment: dict[str, str], code: int, exit_code: int, message: str
) -> None:
    server.refusal = code
    done = push(environment, toy, "me/toy")
    assert (done.returncode, len(tiny.sentences(done.stderr))) == (exit_code, 1), done.stderr
    assert message in done.stderr
    assert not server.repositories


def test_bad_input_is_one_sentence_and_sends_nothing(
    toy: Path, tmp_path: Path, server: Hub, environment: dict[str, str]
) -> None:
    lost = Path(shutil.copytree(toy, tmp_path / "lost"))
    (lost / "shards" / "train-00000.h5").unlink()
    cases = [
        ((toy, "a b/c"), 2, "REPO is 'a b/c', but must be NAME or OWNER/NAME"),
        ((tmp_path / "nowhere", "me/toy"), 2, "is not a gen2d dataset"),
        ((lost, "me/toy"), 1, "train-00000.h5 is missing: verify with --repair"),
    ]
    for words, code, message in cases:
        done = push(environment, *words)
        assert (done.returncode, len(tiny.sentences(done.stderr))) == (code, 1), done.stderr
        assert message in done.stderr
    assert not server.asked


def test_a_missing_library_is_named(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(UserError, match=r"pip install 'gen2d\[hub\]'"):
        gen2d.push(toy, "me/toy")
