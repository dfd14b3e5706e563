"""Every version that pyproject.toml promises works, in environments of its own (`versions.sh`)."""

import os
import re
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path

import floors
import pytest

SCRIPT = Path(__file__).parent / "versions.sh"


@pytest.mark.slow
@pytest.mark.parametrize(("section", "python"), [("lowest", "3.11"), ("newest", "3.13"), ("sdist", "3.12")])
def test_the_versions_that_are_promised_work(
    section: str, python: str, record_property: Callable[[str, object], None]
) -> None:
    """One Python for each section: `tests/versions.sh` alone runs all nine. `pytest -rP` prints the tables."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment["PYTHONS"] = python
    done = subprocess.run([str(SCRIPT), section], env=environment, capture_output=True, text=True, check=False)
    print(done.stdout)
    for line in done.stdout.splitlines():
        if line.startswith("not run: "):
            record_property("not run", line.removeprefix("not run: "))
    assert done.returncode == 0, done.stdout + done.stderr


def test_pages_install_extras_of_a_checkout() -> None:
    """As `pip install ".[torch]"`: the name alone would need an index, and an extra must be there."""
    root = floors.PROJECT.parent
    extras = tomllib.loads(floors.PROJECT.read_text())["project"]["optional-dependencies"]
    pages = [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").rglob("*.md"))]
    found = [
        (page, path, name)
        for page in pages
        for path, names in re.findall(r'"(\.|[\w./-]*gen2d)\[([\w,]+)\]"', page.read_text())
        for name in names.split(",")
    ]
    assert len(found) >= 8
    for page, path, name in found:
        assert path != "gen2d", page
        assert name in extras, (page, name)


def test_every_requirement_has_a_lowest_version() -> None:
    project = tomllib.loads(floors.PROJECT.read_text())["project"]
    extras = project["optional-dependencies"]
    assert all("==" in floors.floor(requirement) for requirement in floors.requirements(extras))
    of_users = {line for name, lines in extras.items() if name not in ("cuda", "dev", "torch") for line in lines}
    assert of_users <= set(extras["dev"]), "the extras are tested at their lowest versions with those of dev"
