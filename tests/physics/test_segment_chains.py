"""Static segments that continue each other: a body slides, falls and bounces as on one segment."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from laws import DOWN, holds, total_energy

import gen2d
from gen2d.core.errors import ConfigError
from gen2d.physics.collision import FAR, Stadium
from gen2d.physics.segment_lines import neighbours_of
from gen2d.space.space import Space

CORNERS = [(-0.4, -0.3), (0.4, -0.3), (0.1, 0.5)]
SHAPES = ["box", *(pytest.param(name, marks=pytest.mark.full) for name in ("capsule", "triangle"))]


def add_body(space: Space, shape: str, position: tuple[float, float], **options: Any) -> int:
    """A body of about a metre."""
    x, y = position
    if shape == "box":
        return space.add_box(position, 1.0, 0.6, angle=0.2, **options)
    if shape == "capsule":
        return space.add_capsule((x - 0.4, y - 0.1), (x + 0.4, y + 0.1), 0.2, **options)
    return space.add_polygon([(x + a, y + b) for a, b in CORNERS], **options)


# Straight lines -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_a_body_bounces_over_joints_as_on_one_segment(shape):
    """The pieces are of any length, some of them point the other way, and they are added in another order."""
    pieces = [(-6.0, -0.7), (-0.7, -0.4), (-0.4, 0.05), (0.05, 0.3), (0.3, 6.0)]
    ways = []
    for parts in ([(-6.0, 6.0)] * 5, [pieces[k] for k in (3, 0, 4, 1, 2)]):
        space = Space(gravity=DOWN)
        for k, (first, last) in enumerate(parts):
            height = -1000.0 * (k > 0 and parts[0] == parts[1])  # the same program, with one segment in reach
            ends = [(first, height), (last, height)]
            space.add_segment(*(ends if k % 2 else ends[::-1]), elasticity=1.0, friction=0.5)
        body = add_body(space, shape, (0.0, 1.2), velocity=(1.0, 0.0), spin=2.0, elasticity=0.8, friction=0.5)
        video = space.simulate(1.5, fps=60)
        assert video.contacts.count > 2
        ways.append(video.position[:, body])
    holds(f"{shape} over joints against one segment, 1.5 s, m", ways[0] - ways[1], 1e-4)


def test_a_box_lies_across_a_joint_as_still_as_on_one_segment():
    space = Space(gravity=DOWN)
    space.add_chain([(-4, 0), (0.3, 0), (4, 0)], friction=0.5)
    body = space.add_box((0, 0.5), 1, 1, friction=0.5)
    video = space.simulate(3, fps=30)
    holds("box across a joint: way in 3 s, m", video.position[:, body] - [0, 0.5], 2e-4)
    holds("box across a joint: angle, rad", video.angle[:, body], 1e-6)


def line_of(*segments: tuple[tuple[float, float], tuple[float, float], float]) -> dict[int, np.ndarray]:
    """For segments of two ends and a radius: ends of the line, and the part in which the segment acts."""
    shapes = {}
    for k, (a, b, radius) in enumerate(segments):
        middle, span = np.add(a, b) / 2, np.subtract(b, a)
        half = np.hypot(*span) / 2
        column = [jnp.asarray(x, jnp.float32)[..., None, None] for x in (middle, span / (2 * half))]
        shapes[k] = Stadium(*column, *(jnp.full((1, 1), x, jnp.float32) for x in (half, radius)))
    _, others = neighbours_of(shapes)
    return {k: np.array(of.line)[:, 0, 0] for k, of in others.items()}


def test_lines_are_of_segments_that_meet_and_are_straight():
    lines = line_of(
        ((0, 0), (2, 0), 0.0),
        ((6, 0), (2, 0), 0.0),  # meets it, and points the other way
        ((6, 0), (6, 3), 0.0),  # turns
        ((6, 0), (8, 0), 0.1),  # thicker
        ((9, 0), (10, 0), 0.0),  # leaves a gap
        ((2, 1), (4, 1), 0.0),  # parallel
    )
    np.testing.assert_allclose(lines[0], [-1, 5, -FAR, 1], atol=1e-5)
    np.testing.assert_allclose(lines[1], [-2, 4, -FAR, 2], atol=1e-5)
    for k, half in ((2, 1.5), (3, 1), (4, 0.5), (5, 1)):
        np.testing.assert_allclose(lines[k], [-half, half, -FAR, FAR], atol=1e-5)


def test_a_line_of_many_segments_is_known_to_each():
    count = 21
    lines = line_of(*(((k, 0.5 * k), (k + 1, 0.5 * k + 0.5), 0.0) for k in range(count)))
    for k, (first, last, *_) in lines.items():
        np.testing.assert_allclose([first, last], np.hypot(1, 0.5) * np.array([-0.5 - k, count - k - 0.5]), atol=1e-4)


# Turns --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_a_body_slides_through_a_bowl_of_segments(shape):
    """It rises again almost to its height, and nothing on its way throws it back."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 41)
    space = Space(gravity=DOWN)
    space.add_chain(4 * np.stack([np.sin(angles), 1 - np.cos(angles)], axis=1), friction=0.0)
    body = add_body(space, shape, (-2.6, 2.2), friction=0.0)
    video = space.simulate(4, fps=60)
    x, y = np.asarray(video.position)[:, body].T
    energy = total_energy(video)
    assert x.max() > 1.5
    assert np.diff(energy).max() < 1e-3 * np.abs(energy).max()
    assert (np.hypot(x, y - 4) < 4).all()


def test_a_box_slides_over_a_ridge_and_keeps_its_speed():
    space = Space(gravity=(0.0, 0.0))
    turns = np.linspace(0, 0.3, 7)
    points = np.concatenate([[(-6.0, 0.0)], np.cumsum(np.stack([np.cos(turns), -np.sin(turns)], axis=1), axis=0)])
    space.add_chain(points, friction=0.0)
    body = space.add_box((-3, 0.25), 0.5, 0.5, velocity=(3.0, 0.0), friction=0.0)
    video = space.simulate(2, fps=60)
    holds("box over a ridge without gravity: velocity, m/s", video.velocity[:, body] - [3, 0], 1e-5)


def test_a_box_that_slides_off_the_end_of_a_chain_tips_over_it():
    space = Space(gravity=DOWN)
    space.add_chain([(-4, 0), (-1, 0), (0, 0)], friction=0.0)
    body = space.add_box((-1, 0.25), 0.5, 0.5, velocity=(1.0, 0.0), friction=0.0)
    video = space.simulate(1.5, fps=60)
    assert video.angle[:, body].min() < -0.5
    assert video.position[-1, body, 1] < -0.2


# The interface ------------------------------------------------------------------------------------------------------


def test_a_chain_is_its_segments():
    points = [(0, 0), (1, 0), (2, 1), (0, 3)]
    chain, segments = gen2d.Space(), gen2d.Space()
    assert chain.add_chain(points, closed=True, radius=0.1, friction=0.2) == [0, 1, 2, 3]
    for k in range(4):
        segments.add_segment(points[k], points[(k + 1) % 4], radius=0.1, friction=0.2)
    for ours, theirs in zip(chain.bodies, segments.bodies, strict=True):
        assert str(ours) == str(theirs)
    assert chain.add_chain([(5, 5), (6, 5), (7, 6)]) == [4, 5]


@pytest.mark.parametrize(
    ("points", "options", "sentence"),
    [
        ([(0, 0)], {}, "add_chain: points has 1 points, but must have at least 2"),
        ([(0, 0), (1, 0)], {"closed": True}, "add_chain: points has 2 points, but must have at least 3"),
        ([(0, 0), (1, 0), (1, 0)], {}, "add_chain: points[1] and the next are both [1.0, 0.0], but must differ"),
        ([(0, 0), (1, float("nan"))], {}, "add_chain: points[1]"),
        ([(0, 0), (1, 0)], {"kind": "dynamic"}, "add_chain: kind is 'dynamic', but must be 'static'"),
        ([(0, 0), (1, 0)], {"radius": -1}, "add_chain: radius"),
        ([(0, 0), (1, 0)], {"friction": -1}, "add_chain: friction"),
    ],
)
def test_errors_name_the_argument(points, options, sentence):
    with pytest.raises(ConfigError) as error:
        gen2d.Space().add_chain(points, **options)
    assert str(error.value).startswith(sentence)
