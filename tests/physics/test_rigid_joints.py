"""Rigid joints as one linear system: its solution, mass ratios, joints that say the same twice, what they conserve."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from bench_demos import bridge
from laws import holds
from numpy.testing import assert_allclose

from gen2d import Space
from gen2d.physics.banded import factor, multiply, solve_factored
from gen2d.physics.rigid_joints import joint_system_plan
from gen2d.records.layout import JointSpec
from gen2d.space.bodies import hinge_gap
from gen2d.space.video import Video


@pytest.mark.parametrize(("rows", "width"), [(1, 1), (2, 2), (3, 1), (7, 3), (20, 4), (6, 6)])
def test_a_band_is_solved_as_the_whole_matrix_is(rows, width):
    random = np.random.default_rng(rows)
    i, j = np.indices((rows, rows))
    half = random.normal(size=(5, rows, rows)) * (i >= j) * (i - j < width) + 5 * np.eye(rows)
    matrix, wanted = half @ half.swapaxes(1, 2), random.normal(size=(5, rows))
    bands = jnp.stack([np.pad(np.diagonal(matrix, o, 1, 2), ((0, 0), (0, o))).T for o in range(width)], axis=1)
    every, some = np.ones((5, rows), bool), random.random((5, rows)) < 0.7
    for usable in (every, some):
        found = np.asarray(solve_factored(factor(bands, jnp.asarray(usable.T)), jnp.asarray(wanted.T))).T
        both = usable[:, :, None] & usable[:, None]
        expected = np.linalg.solve(np.where(both, matrix, np.eye(rows)), (usable * wanted)[..., None])[..., 0]
        assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    whole = (matrix @ wanted[..., None])[..., 0]
    assert_allclose(np.asarray(multiply(bands, jnp.asarray(wanted.T))).T, whole, rtol=1e-4, atol=1e-4)


def test_chains_are_narrow_bands_and_hinges_that_say_nothing_new_have_no_row():
    links = [JointSpec("revolute", 30, 0), *(JointSpec("revolute", i, i + 1) for i in range(29))]
    shuffled = [links[i] for i in np.random.default_rng(0).permutation(30)]
    assert (joint_system_plan(shuffled, 30).width, len(joint_system_plan(shuffled, 30).joint)) == (4, 60)
    welded = joint_system_plan(
        [JointSpec("revolute", 0, 1), JointSpec("revolute", 1, 0), JointSpec("revolute", 0, 1)], 2
    )
    assert welded.joint.tolist().count(0) == 2
    assert len(welded.joint) == 3


def ends(video: Video, number: int, half: float) -> np.ndarray:
    """Both ends of a rod in every frame, m [2, T, 2]."""
    angle = video.angle[:, number]
    way = half * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.stack([video.position[:, number] - way, video.position[:, number] + way])


@pytest.mark.parametrize("kind", [pytest.param("revolute", marks=pytest.mark.full), "distance"])
def test_a_body_swings_through_the_static_box_that_a_joint_ties_it_to(kind):
    """The sides of the box stopped the body, which hung in the air, although the two do not collide."""
    states = []
    for size in ((0.8, 2.4), (0.1, 0.1)):
        space = Space(gravity=(0, -9.81))
        box, bob = space.add_box((0, 0), *size, kind="static"), space.add_capsule((-1.3, 0), (-0.5, 0), 0.1)
        space.add_joint(kind, bob, box, anchor_a=(0, 0) if kind == "revolute" else None)
        states.append(space.simulate(2.0, fps=60).position[:, bob])
    assert states[1][:, 0].max() > 0.5  # it gets to the other side
    assert_allclose(*states, atol=1e-4)


def test_a_bob_on_a_rod_that_strikes_a_wall_gains_no_energy():
    """The rod is nearly perpendicular to the wall when the bob strikes, so it takes nearly all of each impact."""
    space, gravity = Space(gravity=(0, -9.81)), 9.81
    space.add_segment((2.2, -5), (2.2, 5), elasticity=1.0, friction=0.0)
    bob = space.add_circle((2 * np.cos(1), 2 * np.sin(1)), 0.3, elasticity=0.8, friction=0.0)
    space.add_joint("distance", bob, anchor_b=(0, 0))
    video = space.simulate(4, fps=60, contacts=0)
    x, y = video.position[:, bob].T
    energy = 0.5 * (video.velocity[:, bob] ** 2).sum(-1) + gravity * y
    holds("bob that strikes a wall: energy gained, m of height", np.maximum(energy - energy[0], 0) / gravity, 1e-5)
    holds("bob that strikes a wall: length of the rod, m", np.hypot(x, y) - 2, 1e-5)
    assert energy[-1] < energy[0] - 1
    assert x.max() > 1.89


@pytest.mark.full
def test_light_links_hold_a_weight_that_is_a_hundred_times_as_heavy():
    space = Space()
    links = [space.add_capsule((i, 0), (i + 1, 0), 0.05, mass=0.01) for i in range(6)]
    weight = space.add_circle((6.5, 0), 0.5, mass=1)
    space.add_joint("revolute", links[0], anchor_a=(0, 0))
    for i, (a, b) in enumerate(zip(links, [*links[1:], weight], strict=True)):
        space.add_joint("revolute", a, b, anchor_a=(i + 1, 0))
    video = space.simulate(3, contacts=0)
    places = [ends(video, link, 0.5) for link in links]
    gaps = [np.hypot(*(b[0] - a[1]).T) for a, b in itertools.pairwise(places)]
    assert np.max(gaps) < 1e-4
    assert np.hypot(*places[0][0].T).max() < 1e-4
    assert video.position[:, weight, 1].min() < -5


@pytest.mark.full
def test_a_mechanism_that_is_held_twice_over_stays_whole_and_keeps_its_momentum():
    """A square of bars with more rods between its corners than it takes, and two bars in one, free in space."""
    space = Space(gravity=(0, 0))
    corners = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)]
    bars = [
        space.add_capsule(a, b, 0.05, velocity=(0.5, 0.2), spin=1.0)
        for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)
    ]
    for i in range(4):
        space.add_joint("revolute", bars[i - 1], bars[i], anchor_a=corners[i])
    for a, b in ((0, 2), (1, 3)):
        for one, other in ((0, 0), (1, 1), (0, 1), (1, 0)):
            space.add_joint(
                "distance", bars[a], bars[b], anchor_a=corners[(a + one) % 4], anchor_b=corners[(b + other) % 4]
            )
    weld = [space.add_capsule((x, 5), (x + 1, 5), 0.05, velocity=(0, x - 5)) for x in (5, 6)]
    for x in (6.0, 6.5, 5.5):
        space.add_joint("revolute", *weld, anchor_a=(x, 5))
    video = space.simulate(4, contacts=0)
    places = [ends(video, bar, 1.0) for bar in bars]
    for i in range(4):
        assert np.hypot(*(places[i][0] - places[i - 1][1]).T).max() < 1e-3
        assert_allclose(np.hypot(*(places[i][0] - places[i - 2][0]).T), np.sqrt(8), atol=2e-3)
    assert_allclose(video.angle[:, weld[0]], video.angle[:, weld[1]], atol=1e-3)
    assert abs(video.angle[-1, weld[0]]) > 1
    masses = np.array([body.mass for body in space.bodies])
    momentum = (masses[:, None] * video.velocity).sum(1)
    assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-4)
    # Once the joints have made one motion of what was given, it goes on without loss.
    energy = np.asarray(video.energy.kinetic + video.energy.rotational)[1:]
    assert_allclose(energy, np.broadcast_to(energy[0], energy.shape), rtol=2e-3)


@pytest.mark.full
@pytest.mark.parametrize("planks", [5, 20, 30])
def test_a_level_bridge_between_two_cliffs_hangs(planks):
    space = Space(gravity=(0, -9.81))
    bridge(space, planks)
    height = space.simulate(4, fps=60, contacts=0).position[..., 1]
    assert -0.01 * planks < height.min() < -0.001 * planks
    assert height.max() < 0.01


@pytest.mark.full
@pytest.mark.parametrize(("planks", "max_step", "warned"), [(20, 1 / 240, 0), (40, 1 / 240, 1), (40, 1 / 960, 0)])
def test_hinges_that_come_apart_are_warned_of(planks, max_step, warned, caplog):
    space = Space(gravity=(0, -9.81), max_step=max_step)
    bridge(space, planks)
    video = space.simulate(2, fps=60, contacts=0)
    messages = [record.getMessage() for record in caplog.records if "hinges come apart" in record.getMessage()]
    assert len(messages) == warned
    assert all("max_step is 0.00417 s" in message for message in messages)
    assert (hinge_gap(space.joints, video.position, video.angle) > 1) == bool(warned)
