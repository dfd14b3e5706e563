"""Groups of bodies: what they take from a family's factors."""

import jax.numpy as jnp
import numpy as np

from gen2d.records.layout import Layout, SlotGroup
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
