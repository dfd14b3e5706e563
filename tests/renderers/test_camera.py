"""Cameras: where points of the world are in the picture, and that each moves as its options say."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import straight_motion

from gen2d.config.config import load_config
from gen2d.records.layout import Layout, SlotGroup
from gen2d.records.scene import State
from gen2d.renderers import rasterizer
from gen2d.renderers.camera import CameraView, fit_bounds, largest_scale, sample_view, to_pixels, to_world

HEIGHT, WIDTH, FPS, FRAMES = 48, 64, 20, 12
LAYOUT = Layout((SlotGroup("circle", 3),), bounds=(0.0, 0.0, 10.0, 6.0))
BALLS = {
    "video": {"frames": FRAMES, "fps": FPS, "height": HEIGHT, "width": WIDTH},
    "scene": {"name": "bouncing", "balls": 2, "radius": 1.0, "gravity": [0, 0], "color": [255, 255, 255]},
    "look": {"name": "flat", "background": [0, 0, 0], "wall_width": 3},
    "seed": 4,
}
draw = jax.jit(rasterizer.draw_tiles, static_argnums=1)


class Watched(NamedTuple):
    """A `CameraView` in NumPy, in float64."""

    center: np.ndarray
    scale: np.ndarray
    angle: np.ndarray


def views(rng, count):
    """Random ones."""
    center, scale = rng.uniform(-5, 5, (count, 2)), np.exp(rng.uniform(0, 4, count))
    return CameraView(*map(jnp.float32, (center, scale, rng.uniform(-7, 7, count))))


def watched(seed=0, states=None, **options):
    """The view of one video with these options of its camera; a distribution is written as in a config."""
    config = load_config({"camera": options})
    if states is None:
        states = State(*(jnp.zeros((FRAMES, 3, *shape)) for shape in ((2,), (), (2,), ())))
    view = sample_view(jax.random.key(seed), config.camera, LAYOUT, states, FPS, HEIGHT, WIDTH)
    return Watched(*(np.asarray(part, float) for part in view))


# ---- Pixels and metres


def test_from_the_world_to_pixels_and_back():
    rng = np.random.default_rng(0)
    view, points = views(rng, 50), jnp.float32(rng.uniform(-9, 9, (50, 20, 2)))
    pixels = to_pixels(view, points, HEIGHT, WIDTH)
    again = np.stack(to_world(view, pixels[..., 0], pixels[..., 1], HEIGHT, WIDTH), -1)
    assert_allclose(again, points, atol=2e-4)


def test_up_is_up_and_the_picture_turns_against_the_camera():
    def at(angle, x, y):
        view = CameraView(*(jnp.float32(part) for part in ([[2, 1]], [10], [angle])))
        return np.asarray(to_pixels(view, jnp.float32([[[x, y]]]), HEIGHT, WIDTH))[0, 0]

    assert_allclose(at(0, 2, 1), [32, 24])
    assert_allclose(at(0, 3, 1), [42, 24])
    assert_allclose(at(0, 2, 2), [32, 14])
    assert_allclose(at(np.pi / 2, 2, 2), [42, 24], atol=1e-4)  # above is to the right of one who leans to the left


@pytest.mark.parametrize("bounds", [(0, 0, 10, 5), (-3, 1, 4, 20)])
@pytest.mark.parametrize(("height", "width"), [(50, 100), (100, 100), (37, 11)])
@pytest.mark.parametrize("margin", [0, 0.7])
def test_a_fitted_camera_just_shows_the_bounds(bounds, height, width, margin):
    center, scale = fit_bounds(bounds, height, width, margin)
    view = CameraView(*(jnp.float32(part) for part in ([center], [scale], [0])))
    corners = jnp.float32([[bounds[:2], bounds[2:]]])
    (left, bottom), (right, top) = np.asarray(to_pixels(view, corners, height, width), float)[0]
    room = np.array([left, top, width - right, height - bottom])
    assert_allclose(room.min(), margin * scale, atol=1e-3)
    assert_allclose([left, top], [width - right, height - bottom], atol=1e-3)


# ---- Movements


def test_a_camera_without_options_stands_still_and_shows_the_scene():
    view = watched()
    assert_allclose(view.center, np.broadcast_to([5, 3], (FRAMES, 2)))
    assert_allclose(view.scale, 6.4)
    assert_array_equal(view.angle, 0)


def test_a_camera_moves_as_its_options_say():
    time = np.arange(FRAMES) / FPS
    view = watched(pan=[1.5, -0.5], zoom=0.7, turn=-2, angle=0.3, center=[1, 2], scale=9)
    assert_allclose(view.center, [1, 2] + time[:, None] * [1.5, -0.5], rtol=1e-6)
    assert_allclose(view.scale, 9 * np.exp(0.7 * time), rtol=1e-6)
    assert_allclose(view.angle, 0.3 - 2 * time, rtol=1e-6)


def test_what_is_drawn_at_random_is_another_in_each_video_and_does_not_depend_on_the_rest():
    speeds = [np.diff(watched(seed, pan=[[-1, 1], [2, 3]]).center, axis=0)[0] * FPS for seed in range(20)]
    x, y = np.transpose(speeds)
    assert ((x > -1) & (x < 1)).all()
    assert ((y > 2) & (y < 3)).all()
    assert len(np.unique(x)) == 20
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.7
    both = watched(3, pan=[[-1, 1], [2, 3]], turn=[0, 1], zoom=[0, 1])
    assert_array_equal(both.center, watched(3, pan=[[-1, 1], [2, 3]]).center)
    assert_array_equal(both.angle, watched(3, turn=[0, 1]).angle)


def test_a_hand_shakes_by_as_much_as_asked():
    way = np.concatenate([watched(seed, shake=0.4).center - [5, 3] for seed in range(60)])
    assert_allclose(np.sqrt((way**2).mean(0)), 0.4, rtol=0.1)  # along each axis
    assert_allclose(way.mean(0), 0, atol=0.06)
    assert abs(np.corrcoef(way[:, 0], way[:, 1])[0, 1]) < 0.2


def test_a_followed_object_stays_in_the_middle():
    rng = np.random.default_rng(1)
    places = np.cumsum(rng.normal(0, 0.2, (FRAMES, 3, 2)), 0).astype(np.float32)
    states = State(jnp.asarray(places), *(jnp.zeros((FRAMES, 3, *shape)) for shape in ((), (2,), ())))
    view = watched(states=states, follow=1, zoom=0.5, angle=1)
    pixels = to_pixels(CameraView(*map(jnp.float32, view)), jnp.asarray(places), HEIGHT, WIDTH)[:, 1]
    assert_allclose(pixels, np.broadcast_to([WIDTH / 2, HEIGHT / 2], (FRAMES, 2)), atol=1e-3)
    away = watched(states=states, follow=1, pan=[1, 0])
    assert_allclose(away.center - places[:, 1], np.arange(FRAMES)[:, None] / FPS * [1, 0], atol=1e-5)


@pytest.mark.parametrize("zoom", [0.8, [-1, 1], -0.5])
def test_no_frame_has_more_pixels_per_metre_than_is_said(zoom):
    options = load_config({"camera": {"zoom": zoom}}).camera
    most = largest_scale(options, LAYOUT, HEIGHT, WIDTH, FRAMES / FPS)
    assert max(watched(seed, zoom=zoom).scale.max() for seed in range(20)) <= most * (1 + 1e-6)


# ---- In the picture


def shown(drawn=None, **camera):
    """Three videos with a camera at 7 px/m, their plan, and their frames [n, T, H, W] in grey levels; all slots are
    drawn, or those that are named."""
    stages, plan, *_ = straight_motion({**BALLS, "camera": {"scale": 7, **camera}}, 3)
    if drawn is not None:
        stages = stages._replace(paint=stages.paint._replace(drawn=np.tile(drawn, (3, 1))))
    return stages, plan, np.asarray(draw(stages, plan)[0])[..., 0].astype(float)


def test_a_panned_wall_moves_by_the_pan():
    _, _, light = shown(drawn=np.array([0, 0, 0, 0, 0, 1], bool), pan=[-4, 0], center=[4, 5])  # the left wall, at 0 m
    column = light.sum(2) @ (np.arange(WIDTH) + 0.5) / light.sum((2, 3))
    expected = WIDTH / 2 - 4 * 7 + 4 * 7 / FPS * np.arange(FRAMES)
    assert_allclose(column, np.tile(expected, (3, 1)), atol=0.02)


def test_a_followed_ball_is_drawn_in_the_middle():
    stages, _, light = shown(drawn=np.array([0, 1, 0, 0, 0, 0], bool), follow=1)
    assert np.ptp(np.asarray(stages.instants.position)[:, :, 1], axis=1).min() > 0.1
    columns, rows = light.sum(2) @ (np.arange(WIDTH) + 0.5), light.sum(3) @ (np.arange(HEIGHT) + 0.5)
    assert_allclose(columns / light.sum((2, 3)), WIDTH / 2, atol=0.01)
    assert_allclose(rows / light.sum((2, 3)), HEIGHT / 2, atol=0.01)


def test_a_moving_camera_shows_what_a_moved_world_does():
    stages, plan, light = shown(pan=[3, 1], turn=1.5, angle=0.4)
    at = jax.tree.map(np.asarray, stages.instants)
    cos, sin = (part(at.view.angle)[..., None] for part in (np.cos, np.sin))
    x, y = np.moveaxis(at.position - at.view.center[:, :, None], -1, 0)
    moved = at._replace(
        position=np.stack([x * cos + y * sin, y * cos - x * sin], -1),
        angle=at.angle - at.view.angle[..., None],
        view=CameraView(0 * at.view.center, at.view.scale, 0 * at.view.angle),
    )
    other = np.asarray(draw(stages._replace(instants=moved), plan)[0])[..., 0].astype(float)
    assert light.std() > 20
    assert np.abs(light - other).max() <= 1


@pytest.mark.full
def test_an_exposure_ends_at_its_frame_and_its_camera_moves_on_meanwhile():
    """Samples are the middles of equal parts of the exposure, in the world and of the camera alike."""
    image = {"exposure": 0.6, "exposure_samples": 4}
    stages, *_ = straight_motion({**BALLS, "image": image, "camera": {"scale": 7, "pan": [3, -1], "turn": 0.5}}, 2)
    late = -0.6 * (1 - (np.arange(4) + 0.5) / 4) / FPS  # s
    at, exposed = stages.instants, stages.exposed
    assert exposed is not None
    pan, turn = np.array([3, -1]), 0.5
    assert_allclose(exposed.view.center, at.view.center[:, :, None] + late[:, None] * pan, atol=1e-4)
    assert_allclose(exposed.view.angle, at.view.angle[:, :, None] + late * turn, atol=1e-5)
    velocity = (at.position[:, 1:2] - at.position[:, :1]) * FPS
    assert np.abs(velocity).max() > 1
    path = at.position[:, :, None] + late[:, None, None] * velocity[:, :, None]
    assert_allclose(exposed.position, path, atol=1e-4)
