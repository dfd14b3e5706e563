"""Composition of the shipped configs: nothing is too small to be seen, and what a family asks is open."""

from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest

from gen2d.config.config import Config, load_config
from gen2d.core.enums import SHAPES, STATIC
from gen2d.programs.source import VideoSource
from gen2d.renderers import camera
from gen2d.sampling.sampler import Sampler

CONFIGS = Path(__file__).parents[2] / "configs"
STUDIES = ("benchmark", "phyworld_")  # their scenes are those of other programs
NAMES = sorted(path.stem for path in CONFIGS.glob("*.yaml") if not path.stem.startswith(STUDIES))
VIDEOS = 100
SMALLEST, THINNEST, WALL = 6.0, 2.0, 2.0  # px
TURNS = np.linspace(0, np.pi, 60, endpoint=False)


def sizes_in_pixels(config: Config) -> tuple[np.ndarray, np.ndarray, bool]:
    """Largest and smallest extents in px of all moving objects of some videos, and whether there are line segments."""
    sampler, layout = Sampler(config), config.scene.contract.layout(config.scene.options)
    scenes = jax.vmap(lambda key: sampler.sample(key)[1].scene)(jax.random.split(jax.random.key(0), VIDEOS))
    objects = jax.tree.map(np.asarray, scenes.objects)
    video = config.video
    _, scale = camera.initial_view(config.camera, layout, video.height, video.width)
    long, short = 2 * (objects.radius + objects.half_length), 2 * objects.radius
    if objects.vertices is not None:
        along = objects.vertices @ np.stack([np.cos(TURNS), np.sin(TURNS)])
        extents = along.max(2) - along.min(2)
        polygon = objects.shape == SHAPES.index("polygon")
        long, short = np.where(polygon, extents.max(-1), long), np.where(polygon, extents.min(-1), short)
    moving = objects.present & (objects.kind != STATIC)
    segments = objects.present & (objects.kind == STATIC) & (objects.shape == SHAPES.index("segment"))
    return long[moving] * scale, short[moving] * scale, bool(segments.any())


@pytest.mark.parametrize("name", [*NAMES[:2], *(pytest.param(name, marks=pytest.mark.full) for name in NAMES[2:])])
def test_moving_objects_and_walls_are_large_enough_to_be_seen(name: str) -> None:
    config = load_config(f"{name}.yaml")
    long, short, walls = sizes_in_pixels(config)
    print(f"{name}: the smallest object is {long.min():.1f} px across, the thinnest {short.min():.1f} px")
    assert long.min() >= SMALLEST
    assert short.min() >= THINNEST
    if walls:
        assert config.look.options.wall_width >= WALL


def _fallen(videos: dict[str, np.ndarray], turned: float = 0.3) -> np.ndarray:
    """Share [n] of the moving polygons of each video that have turned."""
    moving = videos["objects/present"] & (videos["objects/shape"] == SHAPES.index("polygon"))
    moving &= videos["objects/kind"] != STATIC
    return (moving & (np.abs(videos["states/angle"][:, -1]) > turned)).sum(1) / moving.sum(1)


def _above(videos: dict[str, np.ndarray], height: float) -> np.ndarray:
    """Whether [n] a moving object is above this height (m) at the end."""
    moving = videos["objects/present"] & (videos["objects/kind"] != STATIC)
    return (moving & (videos["states/position"][:, -1, :, 1] > height)).any(1)


OUTCOMES: dict[str, Callable[[dict[str, np.ndarray]], np.ndarray]] = {
    "tower": lambda videos: videos["factors/stable"] > 0,
    "seesaw": lambda videos: videos["states/angle"][:, -1, 2] > 0,
    "dominoes": lambda videos: _fallen(videos) == 1,
    "wrecking_ball": lambda videos: _fallen(videos) > 0,
    "funnel": lambda videos: _above(videos, 3.5),
    "hidden_mass": lambda videos: videos["factors/mass_ratio"][:, 0] > 1,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OUTCOMES)
def test_what_a_family_asks_has_either_answer_about_equally_often(name: str) -> None:
    config = load_config(f"{name}.yaml", ["storage.frames=none"])
    share = OUTCOMES[name](VideoSource(config, jax.devices()[:1]).videos("train", np.arange(200))).mean()
    print(f"{name}: {share:.2f} of 200 videos")
    assert 0.4 <= share <= 0.6
