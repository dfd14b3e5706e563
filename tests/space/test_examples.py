"""Scenes in a few lines each, as a newcomer writes them; each makes its pictures, and keeps its law.

The first four are those of the article that this project grew from (Y. Kanagawa, on 2D physics in JAX), in SI units:
its damping of 0.95 per step is a rate here, and its colours are seaborn's "husl".
"""

import itertools
import math

import cv2
import numpy as np
import pytest
from laws import deepest_overlap, holds, total_energy
from numpy.testing import assert_allclose

from gen2d.space.plot import RED, overlay, picture
from gen2d.space.space import Space
from gen2d.space.video import Video

GRAVITY = 9.8
HUSL = [(247, 112, 136), (186, 147, 49), (50, 176, 101), (56, 167, 208), (244, 97, 221)]
# Where the article's five balls are, and how fast.
FIVE = [((-3, 4), (0, 0)), ((0, 2), (0, 0)), ((5, 3), (0, 0)), ((-3, 1), (0, 10)), ((2, 0), (-2, 8))]


def five_balls(**physics) -> Space:
    space = Space(gravity=(0, -GRAVITY), mixing="mean", **physics)
    for (position, velocity), color in zip(FIVE, HUSL, strict=True):
        options = {"mass": 1.0, "moment": 0.5, "elasticity": 0.5, "friction": 0.2, "color": color}
        space.add_circle(position, 1, velocity=velocity, **options)
    return space


def total(video: Video) -> np.ndarray:
    """Energy at every frame, J [T]; its books add up."""
    energy, found = video.energy, total_energy(video)
    scale = max(np.abs(found).max(), np.abs(energy.potential).max(), energy.kinetic.max())
    assert np.abs(energy.residual).max() < 1e-4 * scale
    return found


def worlds(video: Video, joint: int) -> list[np.ndarray]:
    """Where a joint's two anchors are, each [T, 2]."""
    tie, found = video.joints[joint], []
    for body, (x, y) in ((tie.a, tie.anchor_a), (tie.b, tie.anchor_b)):
        if body < 0:
            found.append(np.broadcast_to((x, y), (len(video.time), 2)))
            continue
        cos, sin = np.cos(video.angle[:, body]), np.sin(video.angle[:, body])
        found.append(video.position[:, body] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=1))
    return found


def apart(video: Video) -> np.ndarray:
    """How far the anchors of each joint are apart, m [J, T]."""
    ends = (worlds(video, joint) for joint in range(len(video.joints)))
    return np.array([np.hypot(*(b - a).T) for a, b in ends])


def opened(path) -> list[np.ndarray]:
    """The frames in a file."""
    if path.suffix == ".png":
        return [np.asarray(cv2.imread(str(path)))[..., ::-1]]
    if path.suffix == ".webp":
        return [frame[..., 2::-1] for frame in cv2.imreadanimation(str(path))[1].frames]
    film, frames = cv2.VideoCapture(str(path)), []
    while (read := film.read())[0]:
        frames.append(read[1][..., ::-1])
    return frames


def red(image: np.ndarray) -> np.ndarray:
    """Where an image has an arrow's colour."""
    return (image == RED).all(-1)


# The article --------------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_three_falling_balls(tmp_path):
    rate = -math.log(0.95) / 0.1
    space = Space(gravity=(0, -GRAVITY), damping=rate)
    for position, angle in (((-3, 4), -2), ((0, 2), 0.1), ((3, 3), 0.2)):
        space.add_circle(position, 1, angle=angle, mass=1, moment=0.5, elasticity=1, friction=1, color=(51, 51, 51))
    video = space.simulate(2, fps=10)
    image = opened(video.save(tmp_path / "fall.png", view=(-5, -5, 5, 5)))[0]

    assert image.shape == (400, 400, 3)
    fallen = (1 - np.exp(-rate * video.time)) * GRAVITY / rate
    assert_allclose(video.velocity[..., 1], np.repeat(-fallen[:, None], 3, axis=1), rtol=2e-3, atol=1e-6)
    assert not video.contacts.count
    total(video)


def test_five_balls_that_overlap(tmp_path):
    space, time = five_balls(), np.arange(11)[:, None] * 0.1
    start, velocity = np.array(FIVE).transpose(1, 0, 2)
    path = start + velocity * time[..., None] + np.array((0, -GRAVITY)) * time[..., None] ** 2 / 2  # nothing in its way
    poses = space.poses(path)
    image = overlay(poses, view=(-10, -10, 10, 10), contacts=True)

    found = poses.contacts
    distance = np.hypot(*(path[found.frame, found.b] - path[found.frame, found.a]).T)
    assert len(distance)
    assert_allclose(found.depth, 2 - distance, atol=1e-5)
    pairs = [
        (f, a, b) for f in range(11) for a in range(5) for b in range(a) if np.hypot(*(path[f, a] - path[f, b])) < 2
    ]
    assert len(pairs) == len(distance)
    for point, normal in zip(found.point, found.normal, strict=True):
        x, y = 20 * (point[0] + 0.7 * normal[0] + 10), 20 * (10 - point[1] - 0.7 * normal[1])
        assert red(image)[int(y) - 3 : int(y) + 4, int(x) - 3 : int(x) + 4].any()
    assert not red(overlay(poses, view=(-10, -10, 10, 10))).any()


@pytest.mark.full
def test_five_balls_that_collide(tmp_path):
    space = five_balls(damping=-math.log(0.95) / 0.04)
    video = space.simulate(1.2, fps=25)
    frames = opened(video.save(tmp_path / "five.webp", view=(-10, -10, 10, 10)))

    assert len(frames) == 31
    assert frames[0].shape[:2] == (404, 404)  # white around it
    assert deepest_overlap(space, video) < 1e-3
    assert (np.diff(total(video)) < 1e-4).all()
    assert video.contacts.count


@pytest.mark.full
def test_five_balls_in_a_bowl(tmp_path):
    space = Space(gravity=(0, -GRAVITY), mixing="mean")
    for a, b in (((-4, 4), (0, 0)), ((0, 0), (4, 0)), ((4, 0), (8, 4))):
        space.add_segment(a, b, elasticity=0.5, friction=1)
    for position, color in zip([(2, 2), (4, 3), (3, 6), (6, 5), (5, 7)], HUSL, strict=True):
        options = {"mass": 1.0, "moment": 0.5, "elasticity": 0.5, "friction": 0.2, "color": color}
        space.add_circle(position, 1, **options)
    video = space.simulate(2, fps=25)
    frames = opened(video.save(tmp_path / "bowl.mp4", view=(-10, 0, 10, 10)))

    assert len(frames) == 51
    assert frames[0].shape == (200, 400, 3)
    x, y = video.position[:, 3:].transpose(2, 0, 1)
    inside = np.minimum(y, np.minimum(x + y, y - x + 4) / math.sqrt(2))
    assert inside.min() > 1 - 0.01  # nothing leaves the bowl, or sinks in
    assert deepest_overlap(space, video) < 0.01
    assert (np.diff(total(video)) < 1e-3).all()
    # An arrow at every touch of the last frame.
    last = video.contacts.frame == 50
    ends = video.contacts.point[last] + 0.07 * 0.5 * 20 * video.contacts.normal[last]
    image = picture(video, 50, view=(-10, 0, 10, 10))
    for x, y in ends[np.hypot(*video.contacts.normal[last].T) > 0]:
        row, column = int(20 * (10 - y)), int(20 * (x + 10))
        assert red(image)[row - 2 : row + 3, column - 2 : column + 3].any()


# Joints -------------------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_pendulum(tmp_path):
    space, swing = Space(gravity=(0, -GRAVITY)), 0.1
    rod = space.add_segment((0, 0), (math.sin(swing), -math.cos(swing)), kind="dynamic", mass=2)
    space.add_joint("revolute", rod, anchor_a=(0, 0))
    video = space.simulate(10, fps=60)
    assert len(opened(video.save(tmp_path / "pendulum.png"))) == 1

    angle = video.angle[:, rod] + math.pi / 2
    before = np.nonzero(angle[:-1] * angle[1:] < 0)[0]
    zero = video.time[before] + angle[before] / (angle[before] - angle[before + 1]) / 60
    moment, mass, length = 2 / 12, 2, 0.5
    exact = 2 * math.pi * math.sqrt((moment + mass * length**2) / (mass * GRAVITY * length)) * (1 + swing**2 / 16)
    assert_allclose(2 * np.diff(zero).mean(), exact, rtol=5e-3)
    assert apart(video).max() < 1e-3
    assert_allclose(np.abs(angle[-60:]).max(), swing, rtol=1e-2)
    total(video)


@pytest.mark.full
def test_chain():
    space, links = Space(gravity=(0, -GRAVITY)), 6
    x, y = 0.5 * math.sin(0.5), -0.5 * math.cos(0.5)
    for i in range(links):
        space.add_capsule((i * x, i * y), ((i + 1) * x, (i + 1) * y), 0.05)
        space.add_joint("revolute", i, i - 1 if i else None, anchor_a=(i * x, i * y))
    video = space.simulate(3, contacts=0)

    assert apart(video).max() < 1e-3
    assert np.ptp(video.position[:, -1, 0]) > 2  # it swings
    energy = total(video)
    assert abs(energy[-1] - energy[0]) < 0.02 * np.ptp(video.energy.potential)


@pytest.mark.full
def test_bridge():
    space = Space(gravity=(0, -GRAVITY))
    ends = [(0, 0), (0.75, -0.25), (1.5, -0.4), (2.25, -0.25), (3, 0)]
    for i, (a, b) in enumerate(itertools.pairwise(ends)):
        space.add_capsule(a, b, 0.05, density=2)
        space.add_joint("revolute", i, i - 1 if i else None, anchor_a=a)
    space.add_joint("revolute", 3, anchor_a=ends[-1])
    ball = space.add_circle((1.2, 0.5), 0.25)
    video = space.simulate(3, contacts=0)

    assert apart(video).max() < 1e-2  # hinges are soft: so far as the ball lands
    assert apart(video)[:, -30:].max() < 2e-3  # and so far under its weight
    low = min(end[-1, 1] for joint in range(5) for end in worlds(video, joint))
    assert video.position[-1, ball, 1] > low  # the bridge holds it
    holds("ball on a bridge: overlap, m", deepest_overlap(space, video), 1e-3)
    total(video)


def test_cradle(tmp_path):
    space, radius, length, swing = Space(gravity=(0, -GRAVITY)), 0.25, 1.5, 0.6
    for i in range(5):
        x = i * (2 * radius + 0.02)
        start = (x, 0) if i else (x - length * math.sin(swing), length - length * math.cos(swing))
        ball = space.add_circle(start, radius, elasticity=1, friction=0)
        space.add_joint("distance", ball, anchor_b=(x, length))
    video = space.simulate(1, fps=60, contacts=0)
    assert len(opened(video.save(tmp_path / "cradle.webp", size=200))) == 61

    speed = math.sqrt(2 * GRAVITY * length * (1 - math.cos(swing)))
    assert_allclose(video.velocity[:, 0, 0].max(), speed, rtol=5e-3)
    assert_allclose(video.velocity[:, -1, 0].max(), speed, rtol=5e-3)  # the last one takes it all
    late = video.time > 0.9
    assert np.abs(video.velocity[late, 1:4]).max() < 0.1 * speed
    assert_allclose(apart(video), length, atol=1e-3)
    total(video)


# Boxes --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [0.3, 0.45])
def test_box_on_a_ramp(friction, tmp_path):
    slope = math.radians(20)  # whose tangent is 0.364
    along, up = np.array([math.cos(slope), math.sin(slope)]), np.array([-math.sin(slope), math.cos(slope)])
    space = Space(gravity=(0, -GRAVITY), mixing="geometric")
    space.add_segment(-5 * along, 5 * along, friction=friction)
    box = space.add_box(2 * along + 0.25 * up, 1, 0.5, angle=slope, friction=friction)
    video = space.simulate(2)
    video.save(tmp_path / "ramp.webp", size=200)

    slid = (video.position[:, box] - video.position[0, box]) @ along
    pull = max(0.0, GRAVITY * (math.sin(slope) - friction * math.cos(slope)))
    assert_allclose(slid, -pull * video.time**2 / 2, atol=5e-3 if pull else 1e-3)
    assert np.abs(video.angle[:, box] - slope).max() < 1e-3
    total(video)


def test_a_box_that_lands_flat_bounces_without_a_turn():
    space, e = Space(gravity=(0, -GRAVITY), mixing="geometric"), 0.8
    space.add_segment((-5, 0), (5, 0), elasticity=e, friction=0.5)
    box = space.add_box((0.3, 1.25), 1, 0.5, elasticity=e, friction=0.5)
    video = space.simulate(2)
    assert np.abs(video.angle[:, box]).max() < 1e-4
    fall = math.sqrt(2 / GRAVITY)
    once = (video.time > fall) & (video.time < fall * (1 + 2 * e))
    since = video.time[once] - fall
    rise = e * math.sqrt(2 * GRAVITY) * since - GRAVITY * since**2 / 2
    assert_allclose(video.position[once, box, 1], 0.25 + rise, atol=2e-3)


@pytest.mark.full
def test_tower():
    space = Space(gravity=(0, -GRAVITY))
    space.add_segment((-3, 0), (3, 0))
    boxes = [space.add_box((0, 0.25 + 0.5 * i), 0.5, 0.5) for i in range(5)]
    video = space.simulate(4)

    settled = video.time > 0.99  # contacts are soft: it sinks by millimetres first
    moved = video.position[settled] - video.position[settled][0]
    assert np.abs(moved).max() < 1e-3  # for three seconds
    assert np.abs(video.position[-1, boxes, 0]).max() < 1e-3
    assert np.abs(video.angle[-1]).max() < 1e-3
    assert np.abs(video.position[-1, :, 1] - video.position[0, :, 1]).max() < 0.02
    # The floor carries all of it, and every box what is above it.
    weights = dict.fromkeys(zip([0, *boxes], boxes, strict=False), 0.0)
    contacts = video.contacts
    for row in np.nonzero(contacts.frame == len(video.time) - 1)[0]:
        a, b = sorted((int(contacts.a[row]), int(contacts.b[row])))
        weights[a, b] += 30 * contacts.normal_impulse[row] / (GRAVITY * 0.25)
    assert_allclose(list(weights.values()), [5, 4, 3, 2, 1], rtol=1e-2)
    total(video)


@pytest.mark.full
def test_piston():
    space = Space(gravity=(0, 0))
    for y in (-1, 1):
        space.add_segment((-1, y), (12, y), elasticity=1, friction=0)
    piston = space.add_segment((0, -1), (0, 1), kind="kinematic", velocity=(1, 0), elasticity=1, friction=0)
    for i in range(3):
        space.add_circle((1.5 + 1.2 * i, 0.1 * i), 0.4, elasticity=1, friction=0)
    video = space.simulate(4)

    assert_allclose(video.position[:, piston, 0], video.time, atol=1e-5)
    energy = total(video)
    first = space.bodies[3].mass * 2**2 / 2  # a ball that a wall hits leaves at twice its speed
    assert energy[-1] > 0.999 * first
    assert_allclose(video.energy.work_in, energy - energy[0], atol=1e-3 * first)
    assert np.abs(video.energy.lost_in_contact).max() < 1e-3 * first
    assert (video.position[:, 3:, 0] > video.position[:, piston, None, 0] + 0.4 - 1e-3).all()
