"""Scenes in which engines differ: ghost collisions, heavy on light, tall stacks, fast spin, friction from rest.

Each asks for what an exact solver would give; what gen2d owes is marked `asked`. 240 steps per s.
"""

import math
from typing import Any

import numpy as np
import pytest
from laws import deepest_overlap, holds, total_energy

from gen2d.space.space import Space

GRAVITY = 9.81  # m/s^2


# Ghost collisions ---------------------------------------------------------------------------------------------------


def add_slider(space: Space, shape: str) -> int:
    """A smooth body of 1 m that slides at 3 m/s; its lowest points are at y = 0."""
    options = {"velocity": (3.0, 0.0), "friction": 0.0}
    if shape == "box":
        return space.add_box((0, 0.5), 1, 1, **options)
    if shape == "capsule":
        return space.add_capsule((-0.5, 0.25), (0.5, 0.25), 0.25, **options)
    return space.add_polygon([(-0.5, 0), (0.5, 0), (0, 0.8)], **options)


@pytest.mark.full
@pytest.mark.parametrize("shape", ["box", "capsule", "triangle"])
def test_sliding_body_does_not_feel_the_joints_of_a_floor(shape):
    space = Space(gravity=(0, -GRAVITY))
    for k in range(24):
        space.add_segment((2 * k - 4, 0), (2 * k - 2, 0), friction=0.0)
    body = add_slider(space, shape)
    video = space.simulate(10, fps=60)
    way, lean = video.position[-1, body, 0] - video.position[0, body, 0], np.abs(video.angle[:, body]).max()
    holds(f"{shape} over 24 collinear segments: way in 10 s less 30 m, m", way - 30, 1e-3)
    holds(f"{shape} over 24 collinear segments: angle, rad", lean, 1e-4)


# Rest ---------------------------------------------------------------------------------------------------------------


@pytest.mark.asked
@pytest.mark.full
@pytest.mark.parametrize(
    ("ratio", "bound", "asked"),
    [(10, 1.5e-3, 5e-4), (100, 1.6e-2, 1e-3), (1000, 0.35, 5e-3)],
)
def test_heavy_box_stands_on_a_light_one(ratio, bound, asked):
    heavy_on_light(ratio, bound, asked)


@pytest.mark.full
@pytest.mark.parametrize(("ratio", "bound"), [(10, 5e-4), (100, 1e-3), (1000, 1e-3), (3000, 1e-3)])
def test_heavy_box_stands_on_a_light_one_with_shock_propagation(ratio, bound):
    heavy_on_light(ratio, bound, shock_propagation=True)


def heavy_on_light(ratio: float, bound: float, asked: float | None = None, **physics: Any) -> None:
    """Check that a box of `ratio` times the density stands on another one."""
    space = Space(gravity=(0, -GRAVITY), **physics)
    space.add_segment((-10, 0), (10, 0))
    light = space.add_box((0, 0.5), 1, 1)
    heavy = space.add_box((0, 1.5), 1, 1, density=ratio)
    video = space.simulate(10, fps=60)
    sinking = 1.5 - video.position[:, heavy, 1]
    holds(f"heavy box on a light one, {ratio}:1, {physics}, sinking in 10 s, m", sinking, bound, asked)
    sideways = video.position[:, [light, heavy], 0]
    holds(f"heavy box on a light one, {ratio}:1, {physics}, sideways, m", sideways, 1e-3 if ratio < 1000 else 0.01)


@pytest.mark.asked
@pytest.mark.full
@pytest.mark.parametrize(
    ("scene", "shock_propagation", "bound"),
    [("off centre", False, 2e-3), ("plank", False, 6e-3), ("off centre", True, 8e-3), ("plank", True, 0.5)],
)
def test_heavy_boxes_that_are_off_centre_stand_on_light_ones(scene, shock_propagation, bound):
    """A box of ten times the mass .3 m beside the centre of another, and a plank over two boxes."""
    space = Space(gravity=(0, -GRAVITY), shock_propagation=shock_propagation)
    space.add_segment((-10, 0), (10, 0))
    if scene == "off centre":
        space.add_box((0, 0.5), 1, 1)
        heavy = space.add_box((0.3, 1.5), 1, 1, density=10)
    else:
        for x in (-1, 1):
            space.add_box((x, 0.25), 0.5, 0.5)
        heavy = space.add_box((0, 0.75), 3, 0.5, density=10)
    heights = space.simulate(6, fps=240, energy=False, contacts=0).position[:, heavy, 1]
    name = f"{scene}{', shock propagation' if shock_propagation else ''}"
    holds(f"heavy box on light ones, {name}, sinking in 6 s, m", heights[0] - heights, bound, 5e-4)


def test_heavy_discs_stand_on_light_ones_with_shock_propagation():
    """Light discs between walls, each under a heavy one."""
    space = Space(gravity=(0, -GRAVITY), shock_propagation=True)
    floor, ratios = space.add_segment((-10, 0), (30, 0)), (3, 30, 300)
    heavy = []
    for k, ratio in enumerate(ratios):
        x = 3.0 * k
        for side in (-0.5, 0.5):
            space.add_segment((x + side, 0), (x + side, 4), friction=0.0)
        space.add_circle((x, 0.5), 0.5)
        heavy.append(space.add_circle((x, 1.5), 0.5, density=ratio))
    video = space.simulate(2, fps=60)
    holds("heavy discs on light ones: sinking in 2 s, m", video.position[:, heavy, 1] - 1.5, 1e-3)
    rows = video.contacts
    weight = sum(body.mass for body in video.bodies if np.isfinite(body.mass)) * GRAVITY
    load = rows.normal_impulse[(rows.time > 0.99) & ((rows.a == floor) | (rows.b == floor))].sum()
    holds("heavy discs on light ones: force on the floor, of their weight", load / weight - 1, 1e-2)


@pytest.mark.asked
@pytest.mark.full
def test_stack_of_ten_boxes_stands():
    stack_of_ten(3e-3, asked=1e-3)


@pytest.mark.full
def test_stack_of_ten_boxes_stands_with_shock_propagation():
    stack_of_ten(2e-3, after_a_second=1e-3, shock_propagation=True)


def stack_of_ten(bound: float, asked: float | None = None, after_a_second: float | None = None, **physics: Any) -> None:
    """Check that ten boxes stand on each other."""
    space = Space(gravity=(0, -GRAVITY), **physics)
    space.add_segment((-10, 0), (10, 0))
    boxes = [space.add_box((0, 0.5 + k), 1, 1) for k in range(10)]
    video = space.simulate(10, fps=60)
    last = video.position[300:, boxes]
    way = np.linalg.norm(last - last[:1], axis=-1)
    holds(f"stack of 10 boxes, {physics}: overlap, m", deepest_overlap(space, video), bound, asked)
    holds(f"stack of 10 boxes, {physics}: way in the last 5 of 10 s, m", way, 1e-4)
    if after_a_second is not None:
        overlap = np.maximum(1 - np.diff(video.position[60:, boxes, 1], axis=1), 0)
        holds(f"stack of 10 boxes, {physics}: overlap after a second, m", overlap, after_a_second)


@pytest.mark.full
def test_shock_propagation_changes_nothing_where_nothing_is_static():
    paths = []
    for shock_propagation in (False, True):
        rng = np.random.default_rng(1)
        space = Space(gravity=(0, 0), shock_propagation=shock_propagation)
        for k in range(8):
            x = np.array([k % 4, k // 4]) - [1.5, 0.5]
            density = 10 ** rng.uniform(-2, 2)
            space.add_box(x, 0.5, 0.7, velocity=-2 * x, spin=rng.normal(), density=density, elasticity=rng.uniform())
        paths.append(space.simulate(1, fps=60).position)
    holds("shock propagation without static bodies: change of the paths, m", paths[0] - paths[1], 1e-4)


@pytest.mark.full
def test_weight_of_a_pile_is_what_the_floor_carries():
    space = Space(gravity=(0, -GRAVITY))
    floor = space.add_segment((-3, 0), (3, 0))
    for x in (-3, 3):
        space.add_segment((x, 0), (x, 10), friction=0.0)
    rng = np.random.default_rng(0)
    discs = [space.add_circle((k % 5 - 2 + rng.uniform(-0.1, 0.1), 0.6 + k // 5), 0.45) for k in range(20)]
    video = space.simulate(20, fps=60)
    rows = video.contacts
    at_rest = (rows.time > 15) & ((rows.a == floor) | (rows.b == floor))
    impulse = rows.normal * rows.normal_impulse[:, None]
    up = np.where(rows.b == floor, -1, 1) * impulse[:, 1]
    weight = sum(video.bodies[k].mass for k in discs) * GRAVITY
    holds("pile of 20: mean force on the floor over 5 s, of its weight", up[at_rest].sum() / 5 / weight - 1, 1e-3)


# Energy -------------------------------------------------------------------------------------------------------------


@pytest.mark.full
@pytest.mark.parametrize("spin", [20.0, 80.0])
def test_spinning_elastic_box_keeps_its_energy(spin):
    space = Space(gravity=(0, 0))
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        space.add_segment(a, b, elasticity=1.0, friction=0.0)
    space.add_box((0.1, 0.05), 1.0, 0.6, velocity=(5, 3), spin=spin, elasticity=1.0, friction=0.0)
    video = space.simulate(5, fps=60)
    now = total_energy(video)
    holds(f"elastic box with a spin of {spin:g} rad/s in a box: energy in 5 s, relative", now / now[0] - 1, 1e-4)


# Friction -----------------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_sliding_from_rest_is_uniformly_accelerated():
    """A body that slides down a slope: g (sin - mu cos) t^2 / 2."""
    slope, mu, seconds = math.radians(20), 0.2, 10
    space = Space(gravity=(GRAVITY * math.sin(slope), -GRAVITY * math.cos(slope)))
    space.add_segment((-10, 0), (200, 0), friction=math.sqrt(mu))
    disc = space.add_circle((0, 0.5), 0.5, friction=math.sqrt(mu), moment=math.inf)
    box = space.add_box((0, 5.5), 1, 1, friction=math.sqrt(mu))
    space.add_segment((-10, 5), (200, 5), friction=math.sqrt(mu))
    video = space.simulate(seconds, fps=60)
    exact = GRAVITY * (math.sin(slope) - mu * math.cos(slope)) * seconds**2 / 2
    holds("disc that slides from rest: way in 10 s, m", video.position[-1, disc, 0] - exact, 5e-3)
    holds("box that slides from rest: way in 10 s, m", video.position[-1, box, 0] - exact, 5e-3)
