"""Scenes in which engines differ: ghost collisions, heavy on light, tall stacks, fast spin, friction from rest.

Each asks for what an exact solver would give; what gen2d owes is marked `asked`. 240 steps per s.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from laws import deepest_overlap, holds, total_energy
from worlds import rules, run, world

from gen2d.physics.constraint import ContactConstraint, ContactFrame, ContactPoint, Inertia, Motion
from gen2d.physics.simulate import SaveAt
from gen2d.physics.support import Support, supported_pair
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


@pytest.mark.full
@pytest.mark.parametrize(("ratio", "bound"), [(10, 5e-4), (100, 1e-3), (1000, 1e-3), (3000, 1e-3)])
def test_heavy_box_stands_on_a_light_one(ratio, bound):
    space = Space(gravity=(0, -GRAVITY))
    space.add_segment((-10, 0), (10, 0))
    light = space.add_box((0, 0.5), 1, 1)
    heavy = space.add_box((0, 1.5), 1, 1, density=ratio)
    video = space.simulate(10, fps=240, energy=False, contacts=0)
    sinking = 1.5 - video.position[:, heavy, 1]
    holds(f"heavy box on a light one, {ratio}:1, sinking in 10 s, m", sinking, bound)
    holds(f"heavy box on a light one, {ratio}:1, sideways, m", video.position[:, [light, heavy], 0], 1e-3)


def heavy_on_light(scene: str, ratio: float) -> np.ndarray:
    """Height in m of a heavy body on light ones, in each step of 6 s."""
    space = Space(gravity=(0, -GRAVITY))
    space.add_segment((-10, 0), (10, 0))
    if scene == "plank on two boxes":
        for x in (-1, 1):
            space.add_box((x, 0.25), 0.5, 0.5)
        heavy = space.add_box((0, 0.75), 3, 0.5, density=ratio)
    elif scene == "disc on a box":
        space.add_box((0, 0.5), 1, 1)
        heavy = space.add_circle((0.2, 1.5), 0.5, density=ratio)
    elif scene == "tower":
        for y in (0.5, 1.5):
            space.add_box((0, y), 1, 1)
        heavy = space.add_box((0, 2.5), 1, 1, density=ratio)
    else:
        space.add_box((0, 0.5), 1, 1)
        heavy = space.add_box((0.3, 1.5), 1, 1, density=ratio)
    return space.simulate(6, fps=240, energy=False, contacts=0).position[:, heavy, 1]


@pytest.mark.parametrize("ratio", [10, pytest.param(100, marks=pytest.mark.full)])
@pytest.mark.parametrize(
    "scene",
    [
        *(pytest.param(name, marks=pytest.mark.full) for name in ("box off the centre of a box", "disc on a box")),
        "plank on two boxes",
    ],
)
def test_heavy_bodies_stand_anywhere_on_light_ones(scene, ratio):
    heights = heavy_on_light(scene, ratio)
    holds(f"{scene}, {ratio}:1: sinking in 6 s, m", heights[0] - heights, 5e-4)


@pytest.mark.full
@pytest.mark.parametrize("ratio", np.geomspace(80, 480, 12))
def test_a_heavy_plank_stands_on_light_boxes_whatever_its_mass(ratio):
    """Its load changes from one corner of a light box to the other at some ratios."""
    heights = heavy_on_light("plank on two boxes", ratio)
    holds(f"plank on two boxes, {ratio:.3g}:1: sinking in 6 s, m", heights[0] - heights, 5e-4)


@pytest.mark.asked
@pytest.mark.full
@pytest.mark.parametrize(("ratio", "bound", "asked"), [(10, 2.5e-3, 5e-4), (100, 0.025, 1e-3)])
def test_a_heavy_box_stands_on_a_tower_of_light_ones(ratio, bound, asked):
    heights = heavy_on_light("tower", ratio)
    holds(f"heavy box on two light ones, {ratio}:1: sinking in 6 s, m", heights[0] - heights, bound, asked)


@pytest.mark.full
def test_a_heavy_box_stands_on_a_light_one_on_a_slope():
    """On 15 degrees, where friction bears a quarter of the weight."""
    space, tilt = Space(gravity=(0, -GRAVITY)), math.radians(15)
    along, up = np.array([math.cos(tilt), math.sin(tilt)]), np.array([-math.sin(tilt), math.cos(tilt)])
    space.add_segment(-8 * along, 8 * along, friction=1.0)
    space.add_box(0.5 * up, 1, 1, angle=tilt, friction=1.0)
    heavy = space.add_box(1.5 * up, 1, 1, angle=tilt, density=30, friction=1.0)
    way = space.simulate(6, fps=240, energy=False, contacts=0).position[:, heavy] - 1.5 * up
    holds("heavy box on a light one on a slope: sinking in 6 s, m", -way @ up, 1e-3)
    holds("heavy box on a light one on a slope: way in 6 s, m", way @ along, 0.01)


@pytest.mark.full
@pytest.mark.parametrize("ratio", [4, 10, 50, 290])
def test_a_heavy_box_that_falls_onto_a_light_one_does_not_enter_it(ratio):
    space = Space(gravity=(0, -GRAVITY))
    space.add_segment((-10, 0), (10, 0))
    space.add_box((0, 0.5), 1, 1)
    heavy = space.add_box((0, 2.5), 1, 1, density=ratio)
    heights = space.simulate(4, fps=240, energy=False, contacts=0).position[:, heavy, 1]
    holds(f"heavy box dropped on a light one, {ratio}:1: overlap, m", np.maximum(1.5 - heights, 0), 5e-4)


@pytest.mark.parametrize(
    ("lower", "order"),
    [
        pytest.param("box", "pairs", id="box", marks=pytest.mark.full),
        pytest.param("disc", "pairs", id="disc"),
        pytest.param("disc", "time", id="disc, in the order of time", marks=pytest.mark.full),
    ],
)
def test_a_heavy_ball_rebounds_from_a_light_body_as_from_the_floor(lower, order):
    """It returns to e^2 of its height, and loses nothing if e = 1."""
    height, heights = 1.2, {}
    for e in (0.5, 1.0):
        space = Space(gravity=(0, -GRAVITY), impact_order=order)
        space.add_segment((-10, 0), (10, 0), elasticity=1)
        if lower == "box":
            space.add_box((0, 0.25), 1, 0.5, elasticity=1)
        else:
            space.add_circle((0, 0.25), 0.25, elasticity=1)
        x = 0.2 if lower == "box" else 0.0
        ball = space.add_circle((x, 0.8 + height), 0.3, density=50, elasticity=e)
        heights[e] = space.simulate(3, fps=240, energy=False, contacts=0).position[:, ball, 1] - 0.8
    start = round(240 * math.sqrt(2 * height / GRAVITY))
    holds(f"heavy ball on a light {lower}, e = 1: gain of height in 3 s", heights[1.0].max() / height - 1, 1e-4)
    last = heights[1.0][-240:].max()
    holds(f"heavy ball on a light {lower}, e = 1: loss of height in 3 s", last / height - 1, 1e-4)
    first = heights[0.5][start + 5 : start + 130].max()
    holds(f"heavy ball on a light {lower}, e = .5: first height over a quarter", first / (0.25 * height) - 1, 1e-3)
    holds(f"heavy ball on a light {lower}: overlap, m", [np.minimum(h, 0).min() for h in heights.values()], 5e-4)


@pytest.mark.parametrize("ratio", [20, 100])
def test_a_heavy_plank_rolls_on_light_rollers(ratio):
    """Without slip, at constant speed; the rollers are half as fast."""
    space = Space(gravity=(0, -GRAVITY))
    space.add_segment((-5, 0), (60, 0), friction=1.0)
    for x in (-1, 1):
        roller = space.add_circle((x, 0.25), 0.25, velocity=(0.5, 0), spin=-2, friction=1.0)
    plank = space.add_box((0, 0.75), 4, 0.5, density=ratio, velocity=(1, 0), friction=1.0)
    video = space.simulate(1.2, fps=240, energy=False, contacts=0)
    holds(f"plank on rollers, {ratio}:1: change of speed", video.velocity[-1, plank, 0] - 1, 1e-3)
    holds(f"plank on rollers, {ratio}:1: change of the rollers'", video.velocity[-1, roller, 0] - 0.5, 1e-3)
    holds(f"plank on rollers, {ratio}:1: sinking, m", 0.75 - video.position[:, plank, 1], 5e-4)


def test_heavy_discs_stand_on_light_ones():
    """Light discs between walls, each under a heavy one."""
    space = Space(gravity=(0, -GRAVITY))
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


@pytest.mark.parametrize(("ratio", "deepest"), [(18, 0.06), (400, 0.09), (20000, 0.11)])
@pytest.mark.parametrize("sparse", [True, False])
def test_a_heavy_disc_does_not_go_through_a_light_one_that_bounces_between_it_and_a_floor(ratio, deepest, sparse):
    """Both fly towards the floor, which the light one strikes several times in a step."""
    light = {"x": (0, 0.68), "v": (1, -17), "radius": 0.68, "mass": 1.0, "elasticity": 0.9}
    heavy = {"x": (-0.05, 2.15), "v": (0, -9), "radius": 0.73, "mass": ratio, "elasticity": 0.9}
    floor = {"a": (-40, 0), "b": (40, 0), "elasticity": 1}
    numbers = rules(extreme_mass_ratios=True)
    of = run([world([light, heavy], [floor], (0, -GRAVITY))], 61, 1, numbers, sparse=sparse).states
    x, v = (np.asarray(a[0, :, :2], float) for a in (of.position, of.velocity))
    holds("crushed light disc: overlap, m", np.maximum(1.41 - np.linalg.norm(x[:, 0] - x[:, 1], axis=-1), 0), deepest)
    energy = np.array([1, ratio]) * (0.5 * (v**2).sum(-1) + GRAVITY * x[..., 1])
    holds(
        "crushed light disc: energy gained in a step, relative", np.diff(energy.sum(-1)).max() / energy[0].sum(), 1e-5
    )


@pytest.mark.parametrize("sparse", [True, pytest.param(False, marks=pytest.mark.full)])
def test_a_light_disc_that_a_heavy_one_drives_out_of_a_wedge_is_no_faster_than_one_that_nothing_bears(sparse):
    """It lies on a wall and the end of a segment, which let it through when the heavy one strikes."""
    walls = [{"a": (-5, -6), "b": (-5, 6), "elasticity": 1}, {"a": (-4.275, -2.92), "b": (-2.33, -3.1)}]
    light = {"x": (-4.62, -2.776), "radius": 0.377, "elasticity": 0.2, "friction": 0.6}
    heavy = {"x": (-4.174, -1.103), "v": (-2.3, -8.88), "radius": 0.517, "mass": 12.0, "friction": 1.0}
    worlds = [world([light | {"mass": mass}, heavy], walls, (0, -GRAVITY)) for mass in (0.05, 0.2, 0.74, 2.0)]
    of = run(worlds, 40, 1, rules(relax_iterations=1), SaveAt(energy=True), sparse=sparse)
    speed, energy = 9.17, 6 * 9.17**2  # of the heavy one before
    name, gain = "light disc driven out of a wedge:", np.diff(total_energy(of)).max()
    holds(f"{name} energy gained in a step, relative", gain / energy, 1e-4)
    holds(f"{name} residual of the energy, relative", of.energy.residual / energy, 1e-4)
    x, v = (np.asarray(of_both)[:, :, 0] for of_both in (of.states.position, of.states.velocity))
    holds(f"{name} speed, over that of the heavy one before", np.linalg.norm(v, axis=-1) / speed, 1.5)
    holds(f"{name} way in a step, in the same unit", 240 * np.linalg.norm(np.diff(x, axis=1), axis=-1) / speed, 1.5)


@pytest.mark.full
@pytest.mark.parametrize("speed", [3.0, 30.0])
def test_a_ball_that_strikes_a_loaded_disc_gives_it_all_of_its_speed(speed):
    """A heavy disc rests on it, as well balanced as its start; all are smooth and elastic."""
    space = Space(gravity=(0, -GRAVITY))
    smooth: dict[str, Any] = {"elasticity": 1.0, "friction": 0.0}
    space.add_segment((-30, 0), (30, 0), **smooth)
    ball = space.add_circle((-1 - 0.1 * speed, 0.5), 0.5, velocity=(speed, 0.0), **smooth)
    loaded = space.add_circle((0, 0.5), 0.5, **smooth)
    space.add_circle((0, 1.5), 0.5, density=100, **smooth)
    v = space.simulate(0.15, fps=240, contacts=0).velocity
    holds("loaded disc: speed before a ball strikes it, m/s", v[:22, loaded], 1e-6)
    holds("ball that strikes a loaded disc: speed that it keeps, relative", v[26:, ball, 0] / speed, 1e-3)
    holds("ball that strikes a loaded disc: speed of the disc, relative", v[26, loaded, 0] / speed - 1, 1e-2)


@pytest.mark.parametrize("torque", [None, 0.0, 0.3])
def test_a_load_that_fades_bears_nothing_in_the_end(torque):
    """The load of a body that slides along a wall without gravity falls by orders of magnitude in each step."""
    load = jnp.asarray(np.logspace(-45, 0, 901), jnp.float32)
    one, zero = jnp.ones_like(load), jnp.zeros_like(load)
    heavy, light = Inertia(0.001 * one, 0.001 * one), Inertia(0.05 * one, 0.08 * one)
    on_heavy = Support(jnp.stack([zero, zero]), None if torque is None else zero, zero)
    on_light = Support(jnp.stack([zero, load]), None if torque is None else torque * load, zero)
    constraint = ContactConstraint(heavy, light, one > 0, zero, zero, None, None, static=False)
    frame = ContactFrame(None, None, None, zero, one, one, one, one)
    point = ContactPoint(frame, jnp.stack([zero, -one]), zero, zero, None, None)
    pair = supported_pair(constraint, [point], (on_heavy, on_light), (None, None))
    assert pair is not None
    motion = Motion(jnp.stack([one, -one]), one)
    _, left = pair.left((motion, motion))
    assert all(jnp.isfinite(x).all() for x in (pair.share, left.velocity, left.spin))
    borne = np.asarray(pair.lighter[1])
    assert borne[np.asarray(load) > 1e-12].all()
    assert not borne[np.asarray(load) < 1e-19].any()
    along = left.velocity[1] + (0.0 if torque is None else torque * left.spin)
    np.testing.assert_allclose(np.asarray(along)[borne], 0.0, atol=1e-6)


@pytest.mark.full
@pytest.mark.parametrize(
    ("ratio", "bound", "asked"), [pytest.param(20, 5e-4, None), pytest.param(100, 6e-3, 1e-3, marks=pytest.mark.asked)]
)
def test_a_heavy_disc_stands_on_two_light_ones_in_a_box(ratio, bound, asked):
    """Each of the light ones bears on the floor and on a wall, both rough."""
    space = Space(gravity=(0, -GRAVITY))
    for a, b in (((-5, 0), (5, 0)), ((-1, 0), (-1, 9)), ((1, 0), (1, 9))):
        space.add_segment(a, b)
    for x in (-0.5, 0.5):
        space.add_circle((x, 0.5), 0.5)
    heavy = space.add_circle((0, 0.5 + math.sqrt(0.75)), 0.5, density=ratio)
    heights = space.simulate(6, fps=240, energy=False, contacts=0).position[:, heavy, 1]
    name = f"heavy disc on two light ones in a box, {ratio}:1: sinking in 6 s, m"
    holds(name, heights[0] - heights, bound, asked)


@pytest.mark.parametrize(("drop", "precision", "bound"), [(0.0, "float32", 1e-4), (1.0, "float64", 1e-9)])
def test_the_energy_budget_accounts_for_heavy_discs_on_light_ones(drop, precision, bound):
    space = Space(gravity=(0, -GRAVITY), precision=precision)
    space.add_segment((-10, 0), (10, 0))
    for x in (-0.5, 0.5):
        space.add_segment((x, 0), (x, 4), friction=0.5)
    space.add_circle((0, 0.5), 0.5)
    heavy = space.add_circle((0, 1.5 + drop), 0.5, density=100)
    energy = space.simulate(2, fps=60, contacts=0).energy
    name = f"heavy disc on a light one, dropped from {drop:g} m: residual"
    holds(f"{name} over its weight times a metre", energy.residual / (space.bodies[heavy].mass * GRAVITY), bound)


@pytest.mark.full
def test_stack_of_ten_boxes_stands():
    space = Space(gravity=(0, -GRAVITY))
    space.add_segment((-10, 0), (10, 0))
    boxes = [space.add_box((0, 0.5 + k), 1, 1) for k in range(10)]
    video = space.simulate(10, fps=60)
    last = video.position[300:, boxes]
    way = np.linalg.norm(last - last[:1], axis=-1)
    holds("stack of 10 boxes: overlap, m", deepest_overlap(space, video), 1e-3)
    holds("stack of 10 boxes: way in the last 5 of 10 s, m", way, 1e-4)
    overlap = np.maximum(1 - np.diff(video.position[60:, boxes, 1], axis=1), 0)
    holds("stack of 10 boxes: overlap after a second, m", overlap, 1e-3)


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
