"""Groups of bodies: what they take from a family's factors."""

import jax.numpy as jnp
import numpy as np
import pytest

from gen2d.core.enums import STATIC
from gen2d.records.layout import JointSpec, Layout, SlotGroup
from gen2d.sampling import builder


def test_material_is_what_there_is_among_the_factors():
    density, color, friction = (jnp.full(1, x) for x in (1, 2, 3))
    factors = {"density": density, "color": color, "wall_friction": friction, "radius": density, "wall_width": color}
    assert builder.material(factors) == {"density": density, "color": color}
    assert builder.material(factors, "wall") == {"friction": friction}
    assert builder.material(factors, "floor") == {}


def test_a_floor_is_level_and_reaches_beyond_the_view():
    layout = Layout((SlotGroup("circle", 1),), (-3.0, 0.0, 3.0, 2.0), 1.0)
    floor = builder.floor(layout, 2.0, friction=0.5)
    assert (floor.run.kind, floor.run.count) == (builder.STATIC, 1)
    np.testing.assert_array_equal(floor.state.position, [[0, 0]])
    np.testing.assert_array_equal(floor.state.angle, [0])
    np.testing.assert_array_equal(floor.objects["half_length"], [6])
    np.testing.assert_array_equal(floor.objects["friction"], [0.5])


def test_an_absent_body_is_zero_in_every_field():
    places, present = jnp.ones((3, 2)), jnp.array([True, False, True])
    numbers = {"velocity": (1, 2), "spin": 3, "friction": 0.5, "force": (1, 1), "torque": 2, "rolling_resistance": 0.1}
    groups = [
        builder.discs(places, 0.5, present, angle=1.0, **numbers),
        builder.boxes(places, 1.0, 2.0, 1.0, present, **numbers),
        builder.segments(places, 2 * places, present),
    ]
    for group in groups:
        for name, values in group.objects.items():
            assert not np.asarray(values)[1].any(), name
        for values in (group.state.position, group.state.angle, group.state.velocity, group.state.angular_velocity):
            assert not np.asarray(values)[1].any()
        assert np.asarray(group.objects["mass"])[[0, 2]].all()


def test_a_given_mass_takes_the_place_of_that_of_the_density():
    places = jnp.zeros((1, 2))
    for make in (
        lambda **of: builder.discs(places, 0.5, **of),
        lambda **of: builder.capsules(places, 0.0, 1.0, 0.5, **of),
        lambda **of: builder.boxes(places, 0.0, 2.0, 1.0, **of),
    ):
        dense, given = (make(density=3.0).objects, make(mass=7.0).objects)
        assert given["mass"] == 7
        np.testing.assert_allclose(given["moment"] / given["mass"], dense["moment"] / dense["mass"], rtol=1e-6)


def test_walls_of_a_box_face_inwards():
    """The middle of the box is on the left of each wall."""
    walls = builder.box_walls(4.0, 3.0)
    angle, position = np.asarray(walls.state.angle), np.asarray(walls.state.position)
    np.testing.assert_allclose(position, [[2, 0], [4, 1.5], [2, 3], [0, 1.5]])
    np.testing.assert_allclose(walls.objects["half_length"], [2, 1.5, 2, 1.5])
    inwards = np.stack([-np.sin(angle), np.cos(angle)], -1)
    assert (((np.array([2, 1.5]) - position) * inwards).sum(-1) > 0).all()


def _rods(kind: str = "distance", present: bool = True, **numbers: object):
    """Rest lengths of joints between a pin and two discs, the first of which is turned by a quarter."""
    joints = JointSpec(kind, 0, 1), JointSpec("revolute", 1, 2), JointSpec("distance", 0, 2)
    layout = Layout((SlotGroup("circle", 1, STATIC), SlotGroup("circle", 2)), joints=joints)
    pin = builder.discs(jnp.zeros((1, 2)), 0.1, kind=STATIC)
    discs = builder.discs(
        jnp.array([[3.0, 0.0], [0.0, 7.0]]), 0.5, jnp.array([True, present]), angle=jnp.array([jnp.pi / 2, 0.0])
    )
    anchors = jnp.array([[0.0, 4.0], [0.0, 0.0], [0.0, 1.0]]), jnp.array([[0.0, 3.0], [0.0, 0.0], [0.0, 0.0]])
    made = builder.distance_joints(*anchors, **numbers)
    scene, _ = builder.assemble(layout, [pin, discs], jnp.zeros(2), made)
    assert scene.joints is not None
    return np.asarray(scene.joints.rest)


def test_a_rest_length_that_is_not_given_is_that_of_the_start():
    """The anchor (0, 3) of the turned disc lies at (0, 0) of the world, 4 m below that of the pin."""
    np.testing.assert_allclose(_rods(), [4, 0, 6], atol=1e-6)
    np.testing.assert_allclose(_rods("revolute"), [0, 0, 6], atol=1e-6)
    np.testing.assert_allclose(_rods(present=False), [4, 0, 0], atol=1e-6)
    np.testing.assert_allclose(_rods(rest=2.5), 2.5)


def test_joints_are_those_of_the_layout():
    layout = Layout((SlotGroup("circle", 2),), joints=(JointSpec("distance", 0, 1),))
    discs = builder.discs(jnp.eye(2), 0.1)
    two = builder.distance_joints(jnp.zeros((2, 2)), jnp.zeros((2, 2)))
    for count, joints in ((0, None), (2, two)):
        with pytest.raises(AssertionError, match=f"given {count} joints, but the layout has 1;"):
            builder.assemble(layout, [discs], jnp.zeros(2), joints)
