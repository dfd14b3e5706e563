"""Start positions: apart, inside their box, and such that what moves stays in view if it can."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from gen2d.sampling.placement import CLEARANCE, place, start_position

COUNT = 200
LOW, HIGH = jnp.array([-1.0, 2.0]), jnp.array([3.0, 5.0])


@functools.cache
def _program() -> Any:
    return jax.jit(jax.vmap(place, (0, None, None, None, None)))


def placed(radius: Sequence[float] | np.ndarray, present: Sequence[bool]) -> list[np.ndarray]:
    keys = jax.random.split(jax.random.key(0), COUNT)
    return [np.asarray(x) for x in _program()(keys, jnp.array(radius), jnp.array(present), LOW, HIGH)]


def test_objects_are_inside_their_box_and_apart() -> None:
    radius, present = np.array([0.9, 0.5, 0.4, 0.3]), [True, True, False, True]
    position, rejected, fits = placed(radius, present)
    assert fits.all()
    assert rejected.max() > 0
    assert (position[:, 2] == 0).all()
    there = np.flatnonzero(present)
    assert (position[:, there] >= np.asarray(LOW) + radius[there, None] - 1e-6).all()
    assert (position[:, there] <= np.asarray(HIGH) - radius[there, None] + 1e-6).all()
    apart = np.linalg.norm(position[:, there, None] - position[:, None, there], axis=-1)
    gaps = apart - radius[there, None] - radius[there]
    assert gaps[:, *np.triu_indices(3, 1)].min() >= CLEARANCE - 1e-6
    assert_allclose(position[:, 0].mean(0), [1, 3.5], atol=0.25)  # anywhere in the box


def test_what_is_absent_takes_up_no_room() -> None:
    _, rejected, fits = placed([1.4, 1.4, 1.4, 0.3], [False, False, False, True])
    assert (rejected == 0).all()
    assert fits.all()


def test_what_cannot_be_placed_is_said() -> None:
    assert not placed([1.4, 1.4, 1.4, 0.3], [True, True, True, True])[2].any()


def test_what_moves_stays_in_view_if_it_can_and_else_enters() -> None:
    fraction = jnp.linspace(0, 1, 11)
    for displacement in (-3.0, 0.0, 2.0):
        start = np.asarray(start_position(fraction, 0.0, 4.0, jnp.array(displacement), 1.0))
        ends = np.stack([start, start + displacement])
        assert_allclose([ends.min(), ends.max()], [0, 4], atol=1e-6)
    assert_allclose(start_position(fraction, 0.0, 4.0, jnp.array(-9.0), 1.0), 4 - fraction, atol=1e-6)
    assert_allclose(start_position(fraction, 0.0, 4.0, jnp.array(9.0), 1.0), fraction, atol=1e-6)
    assert_allclose(start_position(fraction, 0.0, 4.0, jnp.array(9.0), 6.0), 4 * fraction, atol=1e-6)
    assert_array_equal(start_position(jnp.zeros(()), 0.0, 4.0, jnp.array(9.0), 1.0), 0)
