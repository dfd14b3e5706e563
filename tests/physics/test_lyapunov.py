"""How fast a small change of the start grows: closed forms, and differences of two simulations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import STEP, box, rules, world

from gen2d.physics import lyapunov
from gen2d.physics.lyapunov import SMALL, last_state, perturbation, perturbation_size
from gen2d.physics.simulate import simulate
from gen2d.records import axes
from gen2d.records import keys as keys_module
from gen2d.records import scene as scene_module

FRAMES, STEPS = 61, 4
SECONDS = (FRAMES - 1) * STEPS * STEP
COLUMNS = (2, 5, 8)  # m, where three balls of 0.5 m begin, in a box of 10 x 10 m
VELOCITIES = {
    "apart": [(0, 1), (0, -1), (0, 2)],
    "walls": [(0, 8), (0, -6), (0, 7)],  # each bounces, on its own line
    "meet": [(5, 0.3), (-4, 0), (-6, -0.2)],  # again and again
    "once": [(2, 0.4), (0, 0), (0, 0)],
}


@functools.cache
def made() -> tuple:
    """Keys, scenes and states of the videos, each twice, with the program that simulates them."""
    discs = [[{"x": (x, 5), "v": v} for x, v in zip(COLUMNS, speeds, strict=True)] for speeds in VELOCITIES.values()]
    worlds = [world(balls, box(10)) for balls in discs]
    scene, state = (jax.tree.map(lambda *x: jnp.stack(x), *(w[i] for w in worlds)) for i in (0, 1))
    keys = keys_module.video_keys(jnp.asarray(keys_module.seed_words(3, 0)), jnp.arange(len(worlds), dtype=jnp.uint32))
    run = functools.partial(simulate, layout=worlds[0][2], params=rules(), frames=FRAMES, steps=STEPS, sparse=True)
    return keys, axes.to_device(scene), axes.to_device(state), run


@functools.cache
def growths() -> dict[str, float]:
    keys, scene, state, run = made()
    found = jax.jit(lambda k, a, b: lyapunov.lyapunov_exponent(k, a, b, run, SECONDS))(keys, scene, state)
    return dict(zip(VELOCITIES, np.asarray(found, float).tolist(), strict=True))


def change() -> scene_module.State:
    keys, scene, state, _ = made()
    return jax.tree.map(lambda x: np.asarray(x, float) / SMALL, perturbation(keys, scene, state))


@pytest.mark.full
def test_a_change_has_the_size_one_and_is_of_what_moves() -> None:
    whole = change()
    assert_allclose((whole.position**2 + whole.velocity**2).sum((0, 1)), 1, rtol=1e-5)
    assert not whole.position[:, len(COLUMNS) :].any()
    assert not whole.angle.any()
    assert len(np.unique(whole.position[0, 0])) == len(VELOCITIES)  # each video has its own


@pytest.mark.full
@pytest.mark.parametrize("name", ["apart", "walls"])
def test_in_free_flight_and_off_flat_walls_it_grows_as_its_speed_carries_it(name: str) -> None:
    """A mirror keeps every length, so that a bounce changes nothing."""
    whole, i = change(), list(VELOCITIES).index(name)
    place, speed = whole.position[..., i], whole.velocity[..., i]
    after = np.sqrt(((place + SECONDS * speed) ** 2 + speed**2).sum())
    assert_allclose(growths()[name], np.log10(after) / SECONDS, rtol=1e-3, atol=1e-4)


@pytest.mark.full
def test_balls_that_meet_again_and_again_are_harder_to_foretell() -> None:
    found = growths()
    assert found["meet"] > 2 * max(found["apart"], found["walls"])
    assert found["meet"] > found["once"] > found["apart"] - 0.1


def test_it_is_the_difference_of_two_simulations() -> None:
    _, scene, state, run = made()
    way, step = change(), 2e-4
    moved = [
        jax.tree.map(lambda x, d, sign=sign: x + jnp.asarray(sign * step * d, x.dtype), state, way) for sign in (1, -1)
    ]
    program = jax.jit(lambda start: last_state(run(scene, start).states))
    above, below = (program(start) for start in moved)
    apart = perturbation_size(jax.tree.map(lambda a, b: (a - b) / (2 * step), above, below))
    for i, name in enumerate(VELOCITIES):
        if name != "meet":  # there two simulations differ too soon
            assert_allclose(np.log10(apart[i]) / SECONDS, growths()[name], atol=0.01)


def test_sizes_beyond_the_range_of_squares() -> None:
    parts = jnp.asarray([3e-30, 0])[None, :, None], jnp.asarray([0, 4e-30])[None, :, None]
    assert_allclose(perturbation_size(parts), 5e-30, rtol=1e-6)
    assert_allclose(perturbation_size((parts[0] * 1e35, parts[1] * 1e35)) / 1e5, 5, rtol=1e-5)
    assert perturbation_size((parts[0] * 0, parts[1] * 0)) == 0
