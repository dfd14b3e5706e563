"""Compiled programs on disk: found without tracing, never read where others can write, replaced when damaged."""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from tiny import everything, run_on, same, tiny_config

from gen2d import Space
from gen2d.config.reading import yaml_text
from gen2d.generation.run import generate
from gen2d.programs import devices, environment, executables, shared
from gen2d.space.arrange import compiled_program

CONFIG = tiny_config(video={"frames": 3}, scene={"balls": 1})


def entry_files(cache: Path) -> list[Path]:
    return sorted(path for path in (cache / "programs").rglob("*") if path.is_file())


def make(out: Path, cache: Path) -> dict[str, np.ndarray]:
    """Every field of four videos of a run with no program in memory, and those of `cache` on disk."""
    devices.prepare("cpu")
    before = jax.config.values["jax_compilation_cache_dir"]
    shared.clear()
    jax.config.update("jax_compilation_cache_dir", str(cache))
    try:
        generate(CONFIG, 4, out, device="cpu")
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        shared.clear()
    return everything(out)


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    """A folder of programs, and the videos of the run that filled it."""
    folder = tmp_path_factory.mktemp("stock")
    return folder / "cache", make(folder / "data", folder / "cache")


@pytest.fixture
def cache(stock: tuple[Path, dict[str, np.ndarray]], tmp_path: Path) -> Iterator[Path]:
    """A copy of the stock's programs, which is the current one."""
    shutil.copytree(stock[0], tmp_path / "cache")
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    jax.config.update("jax_compilation_cache_dir", before)


def test_programs_are_found_before_anything_is_traced(
    stock: tuple[Path, dict[str, np.ndarray]], cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(entry_files(cache)) == 8  # a trace and an executable of each program
    monkeypatch.setattr(shared, "_traced", lambda *_: pytest.fail("a program was traced"))
    same(make(tmp_path / "data", cache), stock[1])
    marks = [(root / "manifest.json").read_text().split('"fingerprint"')[1] for root in (stock[0].parent / "data",)]
    assert marks[0] == (tmp_path / "data" / "manifest.json").read_text().split('"fingerprint"')[1]


def test_damaged_entries_are_replaced(stock: tuple[Path, dict[str, np.ndarray]], cache: Path, tmp_path: Path) -> None:
    for path in entry_files(cache):
        content = path.read_bytes()
        middle = len(content) // 2
        changed = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
        for damaged in (content[:middle], b"", b"\x80\x04K\x01.", changed):
            path.write_bytes(damaged)
            assert executables._read(path) is None
    same(make(tmp_path / "data", cache), stock[1])
    assert len(entry_files(cache)) == 8
    assert all(executables._read(path) for path in entry_files(cache))


def test_entries_that_cannot_be_used_are_left_out(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trace, executable = (next((cache / "programs" / name).rglob("*[0-9a-f]")) for name in ("traces", "executables"))
    assert shared._loadable(executables.Trace(None, "", None), jax.devices()[0], False) is None  # type: ignore[arg-type]
    monkeypatch.setattr(executables, "find_executable", lambda *_: b"no executable")
    assert shared._loadable(executables.Trace(None, "", None), jax.devices()[0], False) is None  # type: ignore[arg-type]
    folder = trace if trace.is_dir() else trace.parent
    monkeypatch.setattr(executables, "_trace_folder", lambda *_: folder)
    assert len(list(executables.find_traces("", jax.devices()[0], False))) == 1
    (folder / "later").write_bytes(executable.read_bytes())  # whole, but no trace
    (folder / "directory").mkdir()
    assert len(list(executables.find_traces("", jax.devices()[0], False))) == 1


@pytest.mark.parametrize("who", ["group", "others", "link", "file", "user"])
def test_what_others_can_write_is_not_read(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, who: str
) -> None:
    files = entry_files(cache)
    assert all(executables._read(path) for path in files)
    for folder in {path.parent for path in files}:
        if who == "link":
            folder.rename(tmp_path / folder.name)
            folder.symlink_to(tmp_path / folder.name)
        elif who in ("group", "others"):
            folder.chmod(0o770 if who == "group" else 0o707)
    for path in files if who == "file" else []:
        path.chmod(0o666)
    if who == "user":
        user = files[0].stat().st_uid
        monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    assert all(executables._read(path) is None for path in files)


def test_the_least_recently_used_entries_are_removed(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert executables.MAX_BYTES == 2 * 2**30
    files = entry_files(cache)
    for age, path in enumerate(files):
        os.utime(path, (1000 - age, 1000 - age))
    assert executables._read(files[-1]) is not None  # now it is the last used
    monkeypatch.setattr(executables, "MAX_BYTES", files[-1].stat().st_size + files[0].stat().st_size)
    executables._evict()
    assert entry_files(cache) == [files[0], files[-1]]


def test_a_module_that_a_users_file_imports_is_part_of_the_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "helper_of_a_user.py").write_text("SPEED = 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "helper_of_a_user", __import__("helper_of_a_user"))
    before = environment.local_sources()
    assert str(tmp_path / "helper_of_a_user.py") in before
    assert not any("site-packages" in path or "gen2d/programs/rollout" in path for path in before)
    (tmp_path / "helper_of_a_user.py").write_text("SPEED = 2.0\n")
    assert environment.local_sources() != before


COMPILED = """
compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **named: compiled.append(named.get("fun_name", "")) if "backend_compile" in event else None)
from pathlib import Path
from gen2d.generation.run import generate
assert len(jax.devices()) == 3
generate({config!r}, 24, {out!r}, device="cpu")
names = [f"jit({{name}})" for name in ("sample", "simulate", "stage", "draw")]
Path({log!r}).write_text(" ".join(name for name in compiled if name in names))
"""


def test_a_cached_function_is_traced_once(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its programs are found on disk by another process; another key, shape or type has a program of its own."""
    traced = []

    def power(exponent: int, key: object) -> Callable[..., Any]:
        def function(values: Any, shift: Any) -> dict[str, jax.Array]:
            traced.append(exponent)
            return {"power": values["x"] ** exponent + shift}

        return shared.cached_jit(function, key)

    x, one = np.arange(3.0, dtype=np.float32), np.float32(1)
    for _ in range(2):  # as in two processes
        square = power(2, "square")
        np.testing.assert_array_equal(square({"x": x}, one)["power"], x**2 + 1)
        np.testing.assert_array_equal(square({"x": x + 1}, one)["power"], (x + 1) ** 2 + 1)
        shared.clear()
    assert traced == [2]
    np.testing.assert_array_equal(power(3, "cube")({"x": x}, one)["power"], x**3 + 1)
    np.testing.assert_array_equal(power(2, "square")({"x": x[:2]}, one)["power"], x[:2] ** 2 + 1)
    np.testing.assert_array_equal(power(2, "square")({"x": np.arange(3)}, 1)["power"], [1, 2, 5])
    assert traced == [2, 3, 2, 2]
    gradient = jax.grad(lambda x: power(3, "cube")({"x": x}, 0.0)["power"].sum())(x)
    np.testing.assert_allclose(gradient, 3 * x**2)
    before = len(entry_files(cache))
    power(5, None)({"x": x}, one)
    assert len(entry_files(cache)) == before


def test_a_function_in_float64_is_another_program_in_memory_and_on_disk(cache: Path) -> None:
    def thirds(x: jax.Array) -> jax.Array:
        return jax.numpy.arange(3.0) / 3 * x

    functions = {x64: shared.cached_jit(thirds, "thirds", x64=x64) for x64 in (True, False)}
    for _ in range(2):
        for x64, function in functions.items():
            result = np.asarray(function(np.float32(1)))
            assert result.dtype == (np.float64 if x64 else np.float32)
            np.testing.assert_array_equal(result, np.arange(3, dtype=result.dtype) / 3)
        shared.clear()  # then from disk


def test_a_space_is_not_traced_again(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fall() -> np.ndarray:
        space = Space(gravity=(0, -9.8))
        space.add_circle((0, 3), 0.5)
        return space.simulate(0.5, fps=10).position

    first = fall()
    shared.clear()
    compiled_program.cache_clear()
    monkeypatch.setattr(shared, "_traced", lambda *_: pytest.fail("a program was traced"))
    np.testing.assert_array_equal(fall(), first)


def test_several_devices_run_one_executable(tmp_path: Path) -> None:
    """Three devices compile each program once, and give the bits of one device."""
    (tmp_path / "tiny.yaml").write_text(yaml_text(CONFIG))
    config, out, log = (str(tmp_path / name) for name in ("tiny.yaml", "data", "log"))
    cache = str(tmp_path / "cache")
    run_on(3, COMPILED.format(config=config, out=out, log=log), JAX_COMPILATION_CACHE_DIR=cache)
    assert sorted(Path(log).read_text().split()) == ["jit(draw)", "jit(sample)", "jit(simulate)", "jit(stage)"]
    shared.clear()
    generate(CONFIG, 24, tmp_path / "one", device="cpu")
    same(everything(Path(out)), everything(tmp_path / "one"))


def test_the_tests_compile_with_the_options_of_the_programs() -> None:
    options = environment.compiler_options(jax.devices("cpu")[0])
    assert {f"--{name}={str(value).lower()}" for name, value in options.items()} <= {*os.environ["XLA_FLAGS"].split()}


def test_a_version_of_xla_without_our_options_compiles_with_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "_CPU_OPTIONS", {"xla_cpu_option_of_no_version": True})
    environment._cpu_options.cache_clear()
    try:
        options = environment.compiler_options(jax.devices("cpu")[0])
        assert jax.jit(lambda x: x + 1).lower(1.0).compile(options)(2.0) == 3
    finally:
        environment._cpu_options.cache_clear()
