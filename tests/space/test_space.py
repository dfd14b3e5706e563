"""The builder: results come in the order of addition, errors are one sentence, and the same layout compiles once."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import gen2d
from gen2d.core.errors import ConfigError
from gen2d.physics.simulate import simulate
from gen2d.records.axes import to_device, to_stored
from gen2d.space import arrange as space_module
from gen2d.space.space import Space

GRAVITY = 9.8


def falling() -> Space:
    """Shapes of every kind, well apart and mixed, so that the order of slots is another."""
    space = Space()
    space.add_circle((30, 0), 0.5, kind="kinematic", velocity=(4, 0), spin=2)
    space.add_box((0, 0), 1, 2, angle=0.3, velocity=(1, 0))
    space.add_circle((10, 0), 0.5, velocity=(2, 0), spin=1)
    space.add_capsule((19, 0), (21, 0), 0.25, velocity=(3, 0))
    space.add_circle((-10, 0), 0.5, velocity=(5, 0))
    return space


@pytest.fixture(scope="module")
def fallen() -> tuple:
    space = falling()
    return space, space.simulate(1, fps=10, contacts=0)


def test_results_are_in_the_order_of_addition(fallen):
    space, video = fallen
    assert video.position.shape == (11, 5, 2)
    assert sorted(space.slots) == list(range(5)) != list(space.slots)
    drop = -GRAVITY / 2
    went = video.position[-1] - video.position[0]
    assert_allclose(went, [(4, 0), (1, drop), (2, drop), (3, drop), (5, drop)], atol=1e-3)
    assert_allclose(video.angle[-1], [2, 0.3, 1, 0, 0], atol=1e-5)
    assert_allclose(video.velocity[-1, :, 0], [4, 1, 2, 3, 5], atol=1e-5)
    assert_allclose(video.time, np.arange(11) / 10)


def test_momentum_and_energy_are_kept_in_books(fallen):
    space, video = fallen
    mass = np.array([b.mass if math.isfinite(b.mass) else 0.0 for b in space.bodies])
    assert_allclose(video.momentum, (mass[:, None] * video.velocity).sum(1), rtol=1e-4, atol=1e-4)
    assert np.abs(video.energy.residual).max() < 1e-4 * np.abs(video.energy.potential).max()


def test_the_same_layout_compiles_once(fallen):
    before = space_module.compiled_program.cache_info().misses
    again = falling()
    again.bodies[2] = dataclasses.replace(again.bodies[2], radius=0.4)
    again.simulate(1, fps=10, contacts=0)
    assert space_module.compiled_program.cache_info().misses == before


def test_a_scene_can_be_batched():
    space = Space()
    space.add_segment((-5, 0), (5, 0), elasticity=1)
    space.add_circle((0, 1), 0.5, elasticity=0.5)
    scene, state, layout = space.scene()
    rules, steps = space._solver_params(30.0, None)
    scenes, states = (jax.tree.map(lambda x: jnp.stack([x, x]), record) for record in (scene, state))
    made = to_stored(
        jax.jit(lambda s, t: simulate(to_device(s), to_device(t), layout, rules, 31, steps))(scenes, states)
    )
    for lane in range(2):
        assert_allclose(np.asarray(made.states.position)[lane][:, space.slots], space.simulate(1).position, atol=1e-4)


def test_contacts_name_bodies_by_number():
    space = Space()
    floor = space.add_segment((-5, 0), (5, 0), elasticity=1)
    ball = space.add_circle((0, 1.5), 0.5, elasticity=0.5)
    contacts = space.simulate(1).contacts
    assert set(contacts.a) == {floor}
    assert set(contacts.b) == {ball}
    assert_allclose(contacts.time[0], math.sqrt(2 / GRAVITY), atol=1e-4)
    assert_allclose(contacts.normal, np.broadcast_to((0, 1), contacts.normal.shape), atol=1e-6)
    assert (np.diff(contacts.time) >= 0).all()
    with pytest.warns(UserWarning, match="contacts=1 keeps"):
        assert len(space.simulate(2, contacts=1).contacts.time) == 1


def test_forces_see_bodies_by_number_and_the_time():
    space = Space(gravity=(0, 0))
    space.add_capsule((5, 0), (6, 0), 0.1, mass=1)
    ball = space.add_circle((0, 0), 0.5, mass=2, moment=4)

    def forces(state, time):  # a spring to the origin's right, and a torque, on the ball only
        force = jnp.zeros_like(state.position).at[ball, 0].set(-8 * (state.position[ball, 0] - 1))
        return force, jnp.zeros_like(state.angle).at[ball].set(4 * time)

    video = space.simulate(math.pi, fps=100 / math.pi, forces=forces, contacts=0)
    assert_allclose(video.position[:, ball, 0], 1 - np.cos(2 * video.time), atol=2e-2)
    assert_allclose(video.angular_velocity[-1], [0, 0.5 * math.pi**2], rtol=2e-3)
    assert_allclose(video.position[:, 0], np.broadcast_to((5.5, 0), (101, 2)), atol=1e-6)


def test_the_world_that_a_joint_holds_is_no_body():
    space = Space()
    ball = space.add_circle((1, 0), 0.1)
    space.add_circle((0, 0), 0.2)  # falls through the anchor, which touches nothing
    space.add_joint("distance", ball, anchor_b=(0, 0))
    video = space.simulate(1)
    assert video.position.shape[1] == 2
    assert_allclose(np.hypot(*video.position[:, ball].T), 1, atol=1e-3)
    assert_allclose(video.position[-1, 1], (0, -GRAVITY / 2), atol=1e-4)
    assert len(video.contacts.time) == 0


@pytest.mark.parametrize(("ratio", "warns"), [(9, 0), (11, 1)])
def test_a_space_warns_of_masses_that_its_contacts_cannot_bear(ratio, warns, caplog):
    space = Space()
    space.add_segment((-9, 0), (9, 0))
    for x, density in ((0, 1.0), (3, float(ratio))):
        space.add_circle((x, 2), 0.5, density=density)
    space.simulate(0.1, fps=10, contacts=0)
    records = [record.getMessage() for record in caplog.records if record.name.startswith("gen2d.space")]
    assert len(records) == warns
    assert all("1/10 of its mass sinks in" in message for message in records)


def test_masses_and_moments_are_those_of_solid_bodies():
    space = Space()
    space.add_circle((0, 0), 2, density=3)
    space.add_box((0, 0), 2, 4, angle=1)
    space.add_polygon([(5, 5), (5, 9), (7, 9), (7, 5)])  # clockwise
    space.add_segment((0, 0), (3, 4), kind="dynamic", mass=6)
    disc, box, polygon, rod = space.bodies
    assert_allclose((disc.mass, disc.moment), (12 * math.pi, 24 * math.pi))
    assert_allclose((box.mass, box.moment), (8, 8 * 20 / 12))
    assert_allclose((polygon.mass, polygon.moment), (box.mass, box.moment))
    assert_allclose(polygon.position, (6, 7))
    assert_allclose((rod.mass, rod.moment, rod.half_length), (6, 6 * 25 / 12, 2.5))


def test_overlaps_are_found_and_not_resolved():
    space = Space()
    a = space.add_box((0, 0), 2, 2)
    b = space.add_circle((1.2, 0), 0.5)
    c = space.add_circle((5, 0), 0.5)
    wall = space.add_segment((-1, 5), (7, 5))
    space.add_segment((0, 4), (0, 6))  # two that cannot move do not count
    places = np.repeat(space.poses().position, 2, axis=0)
    places[1, c] = (5, 4.8)
    found = space.poses(places).contacts
    assert_array_equal(found.frame, [0, 1, 1])
    assert [{x, y} for x, y in zip(found.a, found.b, strict=True)] == [{a, b}, {a, b}, {c, wall}]
    assert_allclose(found.depth, [0.3, 0.3, 0.3], atol=1e-6)
    assert_allclose(np.abs(found.normal), [(1, 0), (1, 0), (0, 1)], atol=1e-6)
    space.add_joint("distance", a, b)
    assert len(space.overlaps().a) == 0


def test_space_is_a_public_name():
    assert gen2d.Space is Space


WRONG = {
    "radius is -1, but must be a number and above 0": lambda s: s.add_circle((0, 0), -1),
    "radius is nan, but": lambda s: s.add_circle((0, 0), math.nan),
    "position is (0, inf), but must be two numbers": lambda s: s.add_circle((0, math.inf), 1),
    "a and b are both [1.0, 1.0], but must be two points": lambda s: s.add_capsule((1, 1), (1, 1), 0.5),
    "width is 0, but": lambda s: s.add_box((0, 0), 0, 1),
    "must be convex": lambda s: s.add_polygon([(0, 0), (2, 0), (0.5, 0.5), (0, 2)]),
    "has shape [9, 2], but must be 3 to 8": lambda s: s.add_polygon([(math.cos(t), math.sin(t)) for t in range(9)]),
    "mass is None, but a dynamic": lambda s: s.add_segment((0, 0), (1, 0), kind="dynamic"),
    "mass is inf, but": lambda s: s.add_circle((0, 0), 1, mass=math.inf),
    "kind is 'fixed', but must be one of dynamic": lambda s: s.add_circle((0, 0), 1, kind="fixed"),
    "a static body has velocity": lambda s: s.add_circle((0, 0), 1, kind="static", velocity=(1, 0)),
    "elasticity is 2, but": lambda s: s.add_circle((0, 0), 1, elasticity=2),
    "friction is 'much', but": lambda s: s.add_circle((0, 0), 1, friction="much"),
    "color is (300, 0, 0), but": lambda s: s.add_circle((0, 0), 1, color=(300, 0, 0)),
    "b is 7, but must be the number of a body, 0 to 1": lambda s: s.add_joint("distance", 0, 7),
    "a and b are both 0": lambda s: s.add_joint("distance", 0, 0),
    "neither body is dynamic": lambda s: s.add_joint("revolute", 1, anchor_a=(0, 0)),
    "kind is 'weld', but": lambda s: s.add_joint("weld", 0, 1),
    "a revolute joint needs anchor_a": lambda s: s.add_joint("revolute", 0, 1),
    "anchor_b is None, but": lambda s: s.add_joint("distance", 0),
    "limits and motor are of a revolute": lambda s: s.add_joint("distance", 0, 1, limits=(0, 1)),
    "limits[1] is -1, but": lambda s: s.add_joint("revolute", 0, 1, anchor_a=(0, 0), limits=(1, -1)),
    "seconds is 0, but": lambda s: s.simulate(0),
    "substeps is 0, but": lambda s: s.simulate(1, substeps=0),
    "gravity is (0,), but": lambda s: Space(gravity=(0,)),
    "physics.damping is -1, but must be a number, 0 or more": lambda s: Space(damping=-1),
    "physics.bounce is not an option": lambda s: Space(bounce=1),
    "none of its 0 bodies is dynamic": lambda s: Space().simulate(1),
    "has shape [1, 3, 2], but must have [T, 2, 2]": lambda s: s.poses(np.zeros((1, 3, 2))),
}


@pytest.mark.parametrize("says", WRONG)
def test_what_cannot_be_is_said_in_one_sentence(says):
    space = Space()
    space.add_circle((0, 0), 1)
    space.add_segment((-1, -5), (1, -5))
    with pytest.raises(ConfigError) as caught:
        WRONG[says](space)
    assert says in str(caught.value)
    assert len(space.bodies) == 2
    assert len(space.joints) == 0
