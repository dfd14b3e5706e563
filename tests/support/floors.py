"""Lowest versions that pyproject.toml allows, for this interpreter; `python floors.py [EXTRA ...]` prints them for pip.

`python floors.py --installed` prints the installed versions of gen2d's dependencies.
"""

import sys
import tomllib
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = Path(__file__).parents[2] / "pyproject.toml"


def requirements(extras: Sequence[str] = ()) -> Iterator[Requirement]:
    """Requirements of gen2d and of these extras, without those that are not for this interpreter."""
    project = tomllib.loads(PROJECT.read_text())["project"]
    for line in [*project["dependencies"], *(x for extra in extras for x in project["optional-dependencies"][extra])]:
        requirement = Requirement(line)
        if requirement.marker is None or requirement.marker.evaluate():
            yield requirement


def floor(requirement: Requirement) -> str:
    """The requirement with `==` for its `>=`; it has no other condition."""
    (specifier,) = requirement.specifier
    assert specifier.operator == ">=", f"{requirement} must have a lowest version, and nothing else"
    extras = f"[{','.join(sorted(requirement.extras))}]" if requirement.extras else ""
    return f"{requirement.name}{extras}=={specifier.version}"


if __name__ == "__main__":
    if sys.argv[1:] == ["--installed"]:
        print(", ".join(f"{need.name} {metadata.version(need.name)}" for need in requirements()))
    else:
        print("\n".join(floor(need) for need in requirements(sys.argv[1:])))
