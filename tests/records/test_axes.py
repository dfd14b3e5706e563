"""Layouts of records: declared axes are checked, transposed and transposed back."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import rules, world

from gen2d.physics.simulate import simulate
from gen2d.records.axes import check_shapes, to_device, to_stored
from gen2d.records.layout import SlotGroup
from gen2d.records.scene import State

VIDEOS, FRAMES, SLOTS = 3, 5, 4


def states(frames: int | None = FRAMES) -> State:
    """Random states in stored layout [n, T, K, ...], without T where `frames` is None."""
    rng, lead = np.random.default_rng(0), (VIDEOS, SLOTS) if frames is None else (VIDEOS, frames, SLOTS)
    vectors, numbers = (jnp.asarray(rng.normal(size=(2, *shape)), jnp.float32) for shape in ((*lead, 2), lead))
    return State(vectors[0], numbers[0], vectors[1], numbers[1])


class TestTransposition(chex.TestCase):
    @chex.variants(with_jit=True, without_jit=True, with_device=True, without_device=True)  # pyright: ignore[reportCallIssue]
    def test_device_layout_has_the_videos_last_and_comes_back_unchanged(self):
        for frames in (FRAMES, None):
            stored = states(frames)
            device = self.variant(to_device)(stored)
            lead = (frames,) if frames else ()
            chex.assert_shape([device.position, device.velocity], (*lead, 2, SLOTS, VIDEOS))
            chex.assert_shape([device.angle, device.angular_velocity], (*lead, SLOTS, VIDEOS))
            chex.assert_trees_all_equal(self.variant(to_stored)(device), stored)


def test_declared_axes_are_checked_in_all_layouts():
    stored = states()
    check_shapes(stored, n=VIDEOS, T=FRAMES, K=SLOTS)
    check_shapes(to_device(stored), device=True, n=VIDEOS, T=FRAMES, K=SLOTS)
    check_shapes(jax.tree.map(lambda x: x[0], stored), absent="n", T=FRAMES, K=SLOTS)
    check_shapes(to_device(states(None)), absent="T", device=True, K=SLOTS)
    jax.vmap(lambda one: check_shapes(one, absent="n", K=SLOTS))(stored)


@pytest.mark.parametrize("wrong", [{"K": SLOTS + 1}, {"T": 1}, {"n": 2}, {"absent": "n"}, {"device": True}])
def test_other_axes_are_refused_with_the_name_of_the_field(wrong: dict):
    with pytest.raises(AssertionError, match=r"states/position.* has the shape"):
        check_shapes(states(), **wrong)


def test_simulate_refuses_records_of_another_layout():
    scene, state, layout = world([{"x": (k, 0)} for k in range(SLOTS)])
    scene, state = (to_device(jax.tree.map(lambda x: x[None], record)) for record in (scene, state))
    other = dataclasses.replace(layout, groups=(SlotGroup("circle", SLOTS + 1), *layout.groups[1:]))
    fewer = dataclasses.replace(state, velocity=state.velocity[:, 1:])
    for given, where, name in ((state, other, "objects/present"), (fewer, layout, "states/velocity")):
        with pytest.raises(AssertionError, match=name):
            simulate(scene, given, where, rules(), 2, 1)
