"""A config small enough to generate in a test, and helpers that run the command line."""

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

import gen2d
from gen2d.cli.main import main

CONFIG = {
    "name": "tiny",
    "video": {"frames": 6, "fps": 20, "height": 16, "width": 20},
    "scene": {"name": "bouncing", "balls": [1, 3], "width": 6, "height": 5, "gravity": [0, [-9.8, 0]]},
    "physics": {"substeps": 4},
    "storage": {"videos_per_shard": 8, "batch_size": 4},
}

CROWDED = {"balls": 6, "radius": 1.6, "width": 8, "height": 8}  # a scene in which the balls do not fit


def tiny_config(**sections: dict) -> dict:
    """The tiny config with changed options, by section."""
    return {**CONFIG, **{name: {**CONFIG.get(name, {}), **options} for name, options in sections.items()}}


def everything(root: Path, split: str = "train") -> dict[str, np.ndarray]:
    """All fields of all videos of a split, read by gen2d."""
    ds = gen2d.open(root, split=split, fields="*")
    return ds.batch(range(len(ds)))


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray], count: int | None = None) -> None:
    """Assert that both have the same fields with the same bits in the first `count` videos."""
    assert one.keys() == other.keys()
    for name, values in one.items():
        a, b = np.ascontiguousarray(values[:count]), np.ascontiguousarray(other[name][:count])
        assert a.tobytes() == b.tobytes(), name


def command(*arguments: object, **changes: str) -> list:
    """Arguments and environment of `python -m gen2d ...`; `changes` are environment variables."""
    return [[sys.executable, "-m", "gen2d", *map(str, arguments)], {**os.environ, **changes}]


def run_command(*arguments: object, cwd: Path | None = None, **changes: str) -> subprocess.CompletedProcess[str]:
    """Output and exit code of `python -m gen2d ...`."""
    argv, environment = command(*arguments, **changes)
    return subprocess.run(argv, env=environment, cwd=cwd, capture_output=True, text=True, timeout=300, check=False)


def sentences(stderr: str) -> list[str]:
    """Lines of standard error without those that say what is waited for, which depend on the machine."""
    return [line for line in stderr.splitlines() if line.startswith("gen2d: ") or " ..." not in line]


def run_on(devices: int, code: str, **changes: str) -> None:
    """Run code in a new process with this many CPU devices, in the folder of this file, and assert its success."""
    prelude = f"import jax; jax.config.update('jax_num_cpu_devices', {devices}); jax.devices();"
    argv, environment = command(**changes)
    argv, folder = [argv[0], "-c", prelude + code], Path(__file__).parent
    done = subprocess.run(argv, env=environment, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr


def run_main(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """As `run_command`, but in this process: starting another takes seconds."""
    argv, stdout, stderr = [*map(str, arguments)], io.StringIO(), io.StringIO()
    with contextlib.chdir(cwd or Path.cwd()), contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        try:
            code = main(argv)
        except SystemExit as exit_:
            code = exit_.code
    return subprocess.CompletedProcess(argv, int(code or 0), stdout.getvalue(), stderr.getvalue())
