"""Every test shares one cache of compiled programs, also the processes that tests start."""

import gc
import os
import pathlib
import sys
import tempfile

import pytest

_CACHE = tempfile.TemporaryDirectory(prefix="gen2d-test-cache-")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", _CACHE.name)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
os.environ["XDG_CONFIG_HOME"] = str(pathlib.Path(_CACHE.name) / "config")  # the user's list of trusted code is not ours


def pytest_configure() -> None:
    """Each of several test processes has a core of its own: it then has one device, and compiles for one only."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})


@pytest.fixture(autouse=True, scope="module")
def _compiled_programs_end_with_their_file():
    """Hundreds of compiled programs at once are more memory maps than a process may have, and XLA crashes."""
    yield
    if "jax" in sys.modules:
        sys.modules["jax"].clear_caches()
        gc.collect()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The file that takes longest comes first, so that no process works at it alone in the end."""
    items.sort(key=lambda item: item.path.name != "test_readme.py")
