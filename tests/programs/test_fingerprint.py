"""A dataset takes videos of the very programs that made it: an edited one is refused by name, a renamed one is not."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
import synthetic
from tiny import command, sentences, tiny_config

import gen2d
from gen2d.config.reading import yaml_text
from gen2d.programs.fingerprint import code_hash
from gen2d.programs.shared import canonical

Edit = Callable[[str, str, str], None]
ROOT = Path(gen2d.__file__).parent.parent


def run(package: Path, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """What the command line of another copy of gen2d prints."""
    words, variables = command(*arguments, **environment)
    variables |= {"PYTHONPATH": str(package)}
    done = subprocess.run(words, env=variables, cwd=package, capture_output=True, text=True, timeout=300, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    return done


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of gen2d, and a dataset that it made."""
    home = tmp_path_factory.mktemp("package")
    for name in ("gen2d", "renderers", "configs"):
        shutil.copytree(ROOT / name, home / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    config = tiny_config(video={"frames": 3}, annotations={"contacts": 4, "captions": True})
    (home / "tiny.yaml").write_text(yaml_text(config))
    done = run(home, "--config", "tiny.yaml", "--n", 3, "--out", "data")
    assert done.returncode == 0, done.stderr
    return home


LOOK = "paint = plain(scene, layout, options, key)\n    return paint._replace(color=255 - paint.color)"
EDITS = {
    "scene": ("gen2d/scenes/bouncing.py", "jnp.zeros(2), box", "jnp.zeros(2) + 0.25, box", "samples scenes"),
    "solver": (
        "gen2d/physics/normal_impulse.py",
        "constraint.elasticity * arrival",
        "0.99 * constraint.elasticity * arrival",
        "simulates",
    ),
    "look": ("renderers/looks/flat.py", "return plain(scene, layout, options, key)", LOOK, "prepares rendering"),
    "rasterizer": ("renderers/compositing.py", "((product + 16) >> 5)", "((product + 15) >> 5)", "draws"),
    "captions": (
        "gen2d/captions/sentences.py",
        '"comes to rest", "stops"',
        '"comes to rest", "halts"',
        "writes captions",
    ),
}


@pytest.fixture
def edit_source(package: Path) -> Iterator[Edit]:
    """What replaces a text in a file of the copy, until the test ends."""
    before: dict[Path, bytes] = {}

    def edit(name: str, old: str, new: str) -> None:
        path = package / name
        before.setdefault(path, path.read_bytes())
        text = path.read_text()
        assert old in text, f"{old} in {name}"
        path.write_text(text.replace(old, new))

    yield edit
    for path, content in before.items():
        path.write_bytes(content)


@pytest.mark.parametrize(
    "what", [x if x in ("scene", "solver") else pytest.param(x, marks=pytest.mark.full) for x in EDITS]
)
def test_an_edited_program_is_refused_by_name(
    package: Path, edit_source: Callable[[str, str, str], None], what: str
) -> None:
    file, old, new, does = EDITS[what]
    edit_source(file, old, new)
    before = synthetic.tree(package / "data")
    regen = [("verify", "data", "--level", "regen")] if what == "solver" else []  # each takes seconds
    for arguments in (("--config", "tiny.yaml", "--n", 9, "--out", "data"), *regen):
        done = run(package, *arguments)
        assert done.returncode == 2
        assert len(sentences(done.stderr)) == 1
        assert f"{does} is another, as these files differ: {file}" in done.stderr
    assert synthetic.tree(package / "data") == before


def test_other_names_and_comments_are_not_refused(package: Path, edit_source: Edit) -> None:
    for name in ("time_of_impact", "contact_points"):
        edit_source(f"gen2d/physics/{name}.py", "plane_approach_speed", "speed_at_a_plane")
    edit_source("gen2d/captions/caption.py", "\nSHORT_BYTES =", "\n# In bytes\nSHORT_BYTES =")
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    done = run(package, "--config", "tiny.yaml", "--n", 3, "--out", "data", XLA_FLAGS=flags)
    assert "nothing to do" in done.stdout, done.stderr
    done = run(package, "--config", "tiny.yaml", "--n", 3, "--out", "data", XLA_FLAGS="--xla_cpu_enable_fast_math=true")
    assert done.returncode == 2
    assert re.search("fingerprint.xla_flags is --xla.* there and --xla_cpu_enable_fast_math=true here", done.stderr)


def test_names_do_not_matter_and_numbers_do() -> None:
    def lowered(name: str, number: float) -> str:
        def inner(x: jax.Array) -> jax.Array:
            return jnp.where(x > number, x, number)

        inner.__name__ = name

        def outer(x: jax.Array) -> dict[str, jax.Array]:
            return {name: jax.jit(inner)(x) + jax.jit(inner)(2 * x)}

        outer.__name__ = f"{name}_outer"
        return canonical(jax.jit(outer).lower(jnp.ones(3)).as_text())

    assert lowered("one", 1.5) == lowered("other", 1.5)
    assert lowered("one", 1.5) != lowered("one", 1.25)


def test_comments_do_not_matter_to_what_the_host_makes(tmp_path: Path) -> None:
    texts = [
        "def f(x):\n    return x + 1\n",
        "def f(x):\n    '''It adds.'''\n    return x +  1  # one\n",
        "def f(x): return x + 2\n",
    ]
    hashes = []
    for number, text in enumerate(texts):
        (tmp_path / f"module_{number}.py").write_text(text)
        sys.path.insert(0, str(tmp_path))
        try:
            hashes.append(code_hash(__import__(f"module_{number}")))
        finally:
            sys.path.pop(0)
    assert hashes[0] == hashes[1] != hashes[2]
