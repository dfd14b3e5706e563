"""Tests, and the processes that they start, share one cache of compiled programs, which outlives the run."""

import gc
import os
import pathlib
import sys
import tempfile
import warnings
from collections.abc import Generator
from typing import Any

import packages
import pytest

Reports = Generator[None, pytest.TestReport, pytest.TestReport]

_CACHE = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "gen2d-tests"
_CACHE_BYTES = 2**32
_LONGEST = (
    "test_pages.py",
    "test_readme.py",
    "test_recovery.py",
    "test_versions.py",
    "test_families.py",
    "test_random_worlds.py",
)
_CONFIG = tempfile.TemporaryDirectory(prefix="gen2d-test-config-")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
_COMPILER = "--xla_backend_optimization_level=2 --xla_cpu_use_fusion_emitters=false"  # as gen2d's programs are compiled
os.environ["XLA_FLAGS"] = f"{_COMPILER} {os.environ.get('XLA_FLAGS', '')}".strip()
os.environ["XDG_CONFIG_HOME"] = _CONFIG.name  # the user's list of trusted code is not ours


def pytest_configure() -> None:
    """Empty a cache that has grown too large, and give each of several test processes a core of its own."""
    warnings.simplefilter("error", ResourceWarning)  # also between tests, where the filters of pytest do not hold
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if not worker:
        files = [(path.stat(), path) for path in _CACHE.rglob("*") if path.is_file()]
        if sum(state.st_size for state, _ in files) > _CACHE_BYTES:
            for _, path in files:
                path.unlink(missing_ok=True)
    if worker and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})


@pytest.fixture(autouse=True, scope="module")
def _compiled_programs_end_with_their_file():
    """Hundreds of compiled programs at once are more memory maps than a process may have, and XLA crashes."""
    yield
    if "jax" in sys.modules:
        sys.modules["jax"].clear_caches()
    gc.collect()  # a file that is open in a cycle of references is an error too


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Reports:
    """A test that owes laws (`laws.holds`) is a strict expected failure, and is marked `asked`."""
    report = yield
    owed = sys.modules["laws"].owed if "laws" in sys.modules else {}
    if call.when == "call" and report.passed:
        kept = [law for law, (measured, asked) in owed.items() if measured <= asked]
        if kept:
            report.outcome, report.longrepr = "failed", f"[XPASS(strict)] holds at the asked bound: {'; '.join(kept)}"
        elif bool(owed) != bool(item.get_closest_marker("asked")):
            report.outcome = "failed"
            report.longrepr = "a test is marked `asked` if, and only if, it owes a law: holds(..., asked=...)"
        elif owed:
            report.outcome = "skipped"
            report.wasxfail = "; ".join(f"{law}: {got:.2g}, asked {asked:.2g}" for law, (got, asked) in owed.items())
    if call.when == "call":
        owed.clear()
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the files that take longest, so that no process works at one alone in the end. Slow tests may last."""
    items.sort(key=lambda item: _LONGEST.index(item.path.name) if item.path.name in _LONGEST else len(_LONGEST))
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(3600))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Name everything that was not run, such as tests of a package that is not installed."""
    reports = [report for kind in ("passed", "failed") for report in terminalreporter.stats.get(kind, [])]
    for line in packages.summary(terminalreporter.stats.get("skipped", []), reports):
        terminalreporter.write_line(line)
