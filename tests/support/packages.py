"""Packages and machines that only some tests need: without them, the summary of the run names what was 'not run'."""

import importlib.util
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import pytest

LIST = Path(__file__).parents[1] / "packages.txt"
MARK = "not run: "


def package(name: str) -> Any:
    """The imported package, or module of a package, if tests that need it can run."""
    require(name.partition(".")[0])
    return importlib.import_module(name)


def require(*names: str) -> None:
    """Without one of these packages, the test is not run, or fails in CI if `packages.txt` lists it. Imports none."""
    for name in names:
        if importlib.util.find_spec(name) is None:
            if os.environ.get("CI") and name in listed():
                pytest.fail(f"{name} is not installed, but tests/packages.txt lists it", pytrace=False)
            not_run(name)


def not_run(what: str) -> NoReturn:
    """Skip the test, or the module that is being imported, and name in the summary what was not run."""
    pytest.skip(MARK + what, allow_module_level=True)


def listed() -> list[str]:
    """Names in `packages.txt`."""
    return [line for line in LIST.read_text().split("\n") if line and not line.startswith("#")]


def summary(skipped: Iterable[Any], others: Iterable[Any]) -> list[str]:
    """A line for everything that was not run, by the reports of skipped tests and the properties of the others."""
    reasons = [str(report.longrepr[2]).removeprefix("Skipped: ") for report in skipped]
    reasons += [f"{MARK}{value}" for report in others for name, value in report.user_properties if name == "not run"]
    return sorted({reason for reason in reasons if reason.startswith(MARK)})
