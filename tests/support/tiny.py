"""A dataset small enough to be made in a test, and the command line run as people run it."""

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

CROWDED = {"balls": 6, "radius": 1.6, "width": 8, "height": 8}  # a scene in which the balls find no place


def changed(**sections: dict) -> dict:
    """The tiny config with some options changed, by section."""
    return {**CONFIG, **{name: {**CONFIG.get(name, {}), **options} for name, options in sections.items()}}


def everything(root: Path, split: str = "train") -> dict[str, np.ndarray]:
    """Every field of every video of a dataset, read by gen2d."""
    ds = gen2d.open(root, split=split, fields="*")
    return ds.batch(range(len(ds)))


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray], count: int | None = None) -> None:
    """Fails unless both hold the same bits in every field, for the first `count` videos."""
    assert one.keys() == other.keys()
    for name, values in one.items():
        a, b = np.ascontiguousarray(values[:count]), np.ascontiguousarray(other[name][:count])
        assert a.tobytes() == b.tobytes(), name


def command(*arguments: object, **changes: str) -> list:
    """The arguments and environment of `python -m gen2d ...`."""
    return [[sys.executable, "-m", "gen2d", *map(str, arguments)], {**os.environ, **changes}]


def ran(*arguments: object, cwd: Path | None = None, **changes: str) -> subprocess.CompletedProcess[str]:
    """What `python -m gen2d ...` printed, and its exit code."""
    words, environment = command(*arguments, **changes)
    return subprocess.run(words, env=environment, cwd=cwd, capture_output=True, text=True, timeout=300, check=False)


def run_on(devices: int, code: str, **changes: str) -> None:
    """Runs code in a process of its own that has so many CPU devices, in the folder of the tests; fails if it fails."""
    first = f"import jax; jax.config.update('jax_num_cpu_devices', {devices}); jax.devices();"
    words, environment = command(**changes)
    words, here = [words[0], "-c", first + code], Path(__file__).parent
    done = subprocess.run(words, env=environment, cwd=here, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr


def ran_here(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """What `ran` returns, of the same command line in this process: starting one takes seconds."""
    words, out, told = [*map(str, arguments)], io.StringIO(), io.StringIO()
    with contextlib.chdir(cwd or Path.cwd()), contextlib.redirect_stdout(out), contextlib.redirect_stderr(told):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code
    return subprocess.CompletedProcess(words, int(code or 0), out.getvalue(), told.getvalue())
