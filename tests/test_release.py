"""The release script: versions that agree, a clean tree, and files that an index takes."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from ruamel.yaml import YAML

ROOT = Path(__file__).parent.parent
FILES = (".ci/release", "gen2d/_version.py", "CITATION.cff", "CHANGELOG.md")


def git(folder: Path, *words: str) -> str:
    own = {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_SYSTEM": os.devnull}
    who = ("-c", "user.name=tests", "-c", "user.email=tests@example.org")
    done = subprocess.run(
        ["git", *who, *words], cwd=folder, env=os.environ | own, check=True, capture_output=True, text=True
    )
    return done.stdout


def release(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [str(folder / ".ci" / "release"), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A clean tree in which all versions are 1.2.3."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    version = (ROOT / "gen2d/_version.py").read_text().split('__version__ = "')[1].split('"')[0]
    for name in ("gen2d/_version.py", "CITATION.cff"):
        edit(tmp_path / name, version, "1.2.3")
    text = (tmp_path / "CHANGELOG.md").read_text()
    head, _, rest = text.partition("\n## ")
    (tmp_path / "CHANGELOG.md").write_text(f"{head}\n## 1.2.3 (2030-01-01)\n{rest.partition(chr(10))[2]}")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "all")
    return tmp_path


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_versions_that_agree_in_a_clean_tree_pass(checkout: Path) -> None:
    done = release(checkout, "check")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("CITATION.cff", "version: 1.2.3", "version: 1.2.4", "CITATION.cff has the version 1.2.4, but"),
        (
            "CHANGELOG.md",
            "## 1.2.3 (2030-01-01)",
            "## Unreleased",
            "CHANGELOG.md begins with '## Unreleased', but must",
        ),
        (
            "gen2d/_version.py",
            "1.2.3",
            "1.2.30",
            "CITATION.cff has the version 1.2.3, but gen2d/_version.py has 1.2.30",
        ),
        ("gen2d/_version.py", "__version__", "version", "gen2d/_version.py has no line"),
    ],
)
def test_versions_that_differ_are_named(checkout: Path, name: str, old: str, new: str, message: str) -> None:
    edit(checkout / name, old, new)
    git(checkout, "commit", "--all", "--quiet", "--message", "another")
    done = release(checkout)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert message in done.stderr


def test_a_tree_that_is_not_clean_and_a_tag_that_is_there_are_named(checkout: Path) -> None:
    (checkout / "mine.txt").write_text("")
    assert "the tree is not clean" in release(checkout).stderr
    (checkout / "mine.txt").unlink()
    git(checkout, "tag", "v1.2.3")
    assert "the tag v1.2.3 is there already" in release(checkout).stderr
    assert not (checkout / "dist").exists()


def test_templates_of_issues_ask_for_what_a_report_needs() -> None:
    for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"):
        form = YAML(typ="safe").load(path.read_text())
        if path.name == "config.yml":
            continue
        assert {"name", "description", "body"} <= form.keys()
        assert all(part["attributes"]["label"] for part in form["body"])
        assert len({part["id"] for part in form["body"]}) == len(form["body"])
    assert (ROOT / ".github" / "pull_request_template.md").is_file()
