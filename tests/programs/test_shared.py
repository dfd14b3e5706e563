"""Programs are shared by all configs that differ in numbers only, and give each the bits of its own program."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gen2d
from gen2d.config.config import Config, load_config
from gen2d.generation.run import generate
from gen2d.programs import devices, shared
from gen2d.programs.rollout import Rollout

CONFIGS = sorted(path.stem for path in (Path(gen2d.__file__).parent / "configs").glob("*.yaml"))
SMALL = ["video.frames=5", "video.height=16", "video.width=16", "storage.batch_size=4"]
STATIC = ("video.frames", "video.height", "video.width", "storage.", "annotations.", "quality.", "matched.", "seed")


@pytest.fixture(autouse=True)
def _no_programs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """No program in memory or on disk."""
    monkeypatch.setattr("gen2d.programs.executables._root", lambda: None)
    shared.clear()
    yield
    shared.clear()


def trace(config: Config) -> tuple[shared.BoundProgram, shared.BoundProgram]:
    """The two programs of a config, traced and not compiled."""
    programs = Rollout(config, devices.prepare("cpu")[:1]).programs()
    return programs["simulate"], programs["draw"]


def programs() -> list[shared.Program]:
    """All programs in memory."""
    return [program for _, program in shared._programs]


def edits(plain: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Overrides that change one number each: fractions by a thousandth, the least of a list of whole numbers by one."""
    for name, value in plain.items():
        where = f"{path}.{name}".lstrip(".")
        if where.startswith(STATIC) or name in ("splits", "physics"):
            continue
        if isinstance(value, dict):
            yield from edits(value, where)
        elif isinstance(value, float) and value != 0:
            yield where, value * 1.001
        elif isinstance(value, list) and all(isinstance(x, int) for x in value) and min(value) < max(value):
            yield where, [x + (x == min(value)) for x in value]  # the largest count is a number of slots


@pytest.mark.parametrize("name", [name for name in CONFIGS if not name.startswith("phyworld")])
def test_no_edited_number_of_a_shipped_config_needs_another_program(name: str) -> None:
    config = load_config(f"{name}.yaml", [f"storage.batch_size={4}"])
    programs = [bound.program for bound in trace(config)]
    overrides = dict(edits({section: config.plain()[section] for section in ("look", "scene")}))
    overrides |= {
        "camera.margin": config.camera.margin + 1e-4,
        "physics.push_speed": 2.5,
        "physics.bounce_threshold": 0.02,
    }
    overrides |= {"video.fps": config.video.fps * 1.001, "seed": 7}
    assert len(overrides) > 10
    for where, value in overrides.items():
        changed = load_config(config, [f"{where}={value}"])
        assert [bound.program for bound in trace(changed)] == programs, where


def test_a_shared_program_gives_the_bits_of_an_own_one(tmp_path: Path) -> None:
    overrides = [
        *SMALL,
        "scene.gravity=[0.5,-3]",
        "look.background=[90,0,7]",
        "scene.radius=[0.45,1.0]",
        "video.fps=31",
    ]
    generate("bouncing.yaml", 8, tmp_path / "first", overrides=[*SMALL, "scene.gravity=[0,-9.8]"])
    before = set(programs())
    generate("bouncing.yaml", 8, tmp_path / "shared", overrides=overrides)
    assert set(programs()) == before
    shared.clear()
    generate("bouncing.yaml", 8, tmp_path / "own", overrides=overrides)
    both = [gen2d.open(tmp_path / name, fields="*")[:] for name in ("shared", "own", "first")]
    for name, values in both[0].items():
        np.testing.assert_array_equal(values, both[1][name], name)
    assert not np.array_equal(both[0]["frames"], both[2]["frames"])


def test_an_annotation_needs_another_program_for_drawing_alone() -> None:
    plain = trace(load_config("bouncing.yaml", SMALL))
    masks = trace(load_config("bouncing.yaml", [*SMALL, "annotations.masks=true"]))
    assert masks[0].program is plain[0].program
    assert masks[1].program is not plain[1].program
