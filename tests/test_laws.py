"""The solver against the laws of mechanics: closed forms, conservation, symmetry, and what empty slots may not do."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from worlds import STEP, box, energies, momenta, rules, run, turned, world

from gen2d import types
from gen2d.simulate import simulate, substeps

GRAVITY = 9.81  # m/s^2
QUARTERS = (0, 90, 180, 270)


def gas(seed: int, elasticity: float, friction: float, gravity: tuple[float, float], discs: int = 8) -> tuple:
    """Discs at random places and speeds in a 10 m box."""
    rng = np.random.default_rng(seed)
    radius, places = rng.uniform(0.4, 0.8, discs), []
    while len(places) < discs:
        k = len(places)
        place = rng.uniform(radius[k], 10 - radius[k], 2)
        if all(np.hypot(*(place - p)) > radius[k] + r for p, r in zip(places, radius, strict=False)):
            places.append(place)
    rows = [
        {
            "x": x,
            "v": rng.normal(0, 3, 2),
            "radius": r,
            "spin": rng.normal(0, 5),
            "elasticity": elasticity,
            "friction": friction,
        }
        for x, r in zip(places, radius, strict=True)
    ]
    return world(rows, box(10, 1.0, friction), gravity)


def cluster(seed: int, elasticity: float, friction: float) -> tuple:
    """Eight spinning discs that fly at each other, with nothing around them."""
    rng = np.random.default_rng(seed)
    rows = [
        {
            "x": turned((3, 0), 45 * k),
            "v": turned((-2 + rng.normal(0, 0.3), rng.normal(0, 0.3)), 45 * k),
            "radius": rng.uniform(0.3, 0.7),
            "spin": rng.normal(0, 4),
            "elasticity": elasticity,
            "friction": friction,
        }
        for k in range(8)
    ]
    return world(rows)


def test_free_fall_is_an_exact_parabola():
    flight = world([{"x": (0, 0), "v": (3, 4)}], gravity=(0, -GRAVITY))
    made = run([flight], frames=61, steps=8)
    t = np.arange(61) * 8 * STEP
    assert_allclose(made.states.position[0, :, 0, 0], 3 * t, atol=1e-4)
    assert_allclose(made.states.position[0, :, 0, 1], 4 * t - GRAVITY * t**2 / 2, atol=1e-4)


def test_damping_is_exponential_whatever_the_step():
    flight = world([{"v": (3, 4), "spin": 5}])
    coarse = run([flight], 61, 8, rules(damping=0.5))
    fine = run([flight], 61, 16, rules(STEP / 2, damping=0.5))
    speed = np.exp(-0.5 * np.arange(61) * 8 * STEP)
    assert_allclose(coarse.states.velocity[0, :, 0], speed[:, None] * [3, 4], rtol=1e-4)
    assert_allclose(coarse.states.angular_velocity[0, :, 0], speed * 5, rtol=1e-4)
    assert_allclose(fine.states.velocity, coarse.states.velocity, rtol=1e-4)


@pytest.mark.parametrize("angle", QUARTERS)
@pytest.mark.parametrize("mass", [1.0, 10.0, 100.0])
def test_head_on_collision_follows_newton(mass, angle):
    elasticities, u = [0.0, 0.5, 1.0], 2.0
    pairs = [
        world([
            {"x": turned((-2, 0), angle), "v": turned((u, 0), angle), "mass": 1.0, "friction": 1.0},
            {"x": turned((2, 0), angle), "mass": mass, "elasticity": e, "friction": 1.0},
        ])
        for e in elasticities
    ]  # fmt: skip
    made = run(pairs, 61, 8)
    back = np.array([turned(v, -angle) for v in made.states.velocity[:, -1].reshape(-1, 2)]).reshape(3, 2, 2)
    expected = [[(1 - mass * e) * u / (1 + mass), (1 + e) * u / (1 + mass)] for e in elasticities]
    assert_allclose(back[..., 0], expected, rtol=1e-5, atol=1e-6)
    # Head-on means no tangential impulse: neither a sideways speed nor a spin.
    assert_allclose(back[..., 1], 0, atol=1e-6)
    assert_allclose(made.states.angular_velocity, 0, atol=1e-6)


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.6, 0.9])
def test_oblique_smooth_collision_exchanges_the_normal_components(offset):
    made = run([world([{"x": (-3, 0), "v": (4, 0)}, {"x": (0, offset)}])], 61, 8)
    normal = np.array([np.sqrt(1 - offset**2), offset])
    first, second = made.states.velocity[0, -1]
    assert_allclose(second, 4 * normal[0] * normal, atol=4e-3)
    assert_allclose(first, [4, 0] - 4 * normal[0] * normal, atol=4e-3)


@pytest.mark.parametrize("elasticity", [1.0, 0.9, 0.8, 0.5])
@pytest.mark.parametrize("angle", QUARTERS)
def test_bounces_rise_to_e_squared_of_the_height_before(elasticity, angle):
    height = 3.0
    floor = [{"a": turned((-50, 0), angle), "b": turned((50, 0), angle)}]
    drop = world(
        [{"x": turned((0, 0.5 + height), angle), "elasticity": elasticity}], floor, turned((0, -GRAVITY), angle)
    )
    made = run([drop], frames=960, steps=1)
    y = made.states.position[0, :, 0] @ np.array(turned((0, 1), angle)) - 0.5
    apexes = [y[i] for i in range(1, len(y) - 1) if y[i - 1] <= y[i] > y[i + 1]]
    expected = [height * elasticity ** (2 * n) for n in range(1, len(apexes) + 1)]
    high = [(a, e) for a, e in zip(apexes, expected, strict=True) if e > 0.2]  # lower ones fall between frames
    assert high
    assert_allclose(*np.transpose(high), rtol=2e-3)
    assert_allclose(*high[0], rtol=5e-4)
    assert y.max() <= height * (1 + 1e-4)


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.2, 1.0])
@pytest.mark.parametrize("elasticity", [0.0, 0.5, 1.0])
def test_rim_friction_at_a_wall_is_coulombs(friction, elasticity):
    spins, speed = (0.0, 10.0, -10.0), np.array([3.0, -4.0])
    floor = [{"a": (-50, 0), "b": (50, 0)}]
    hits = [
        world([{"x": (0, 1.013), "v": speed, "spin": w, "elasticity": elasticity, "friction": friction}], floor_with)
        for w in spins
        for floor_with in [[{**floor[0], "friction": 1.0}]]
    ]
    made = run(hits, 61, 2)
    for i, spin in enumerate(spins):
        slip = speed[0] + 0.5 * spin
        change = min(friction * (1 + elasticity) * abs(speed[1]), abs(slip) / 3) * np.sign(slip)
        last = made.states.velocity[i, -1, 0]
        assert_allclose(last, [speed[0] - change, -elasticity * speed[1]], atol=2e-3)
        # m r change = I (change of spin), with I = m r^2 / 2
        assert_allclose(made.states.angular_velocity[i, -1, 0], spin - 2 * change / 0.5, atol=8e-3)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 1), st.floats(0, 1))
def test_momentum_is_conserved_and_energy_never_grows(seed, elasticity, friction):
    worlds = [cluster(seed + i, elasticity, friction) for i in range(8)]
    made = run(worlds, 61, 8)
    linear, angular = momenta(worlds, made)
    size = np.abs(linear[:, :1]).max() + 16  # kg m/s: eight discs at about 2 m/s
    assert np.abs(linear - linear[:, :1]).max() <= 1e-5 * size
    assert np.abs(angular - angular[:, :1]).max() <= 5e-4 * 3 * size
    energy = energies(worlds, made)
    assert (np.diff(energy, axis=1) <= 8 * 1e-4 * energy[:, :1]).all()  # 1e-4 a step
    assert np.isfinite(made.states.position).all()


def test_elastic_gas_keeps_its_energy_for_a_minute():
    worlds = [gas(seed, 1.0, 0.0, (0, -g)) for seed in range(8) for g in (0.0, GRAVITY)]
    energy = energies(worlds, run(worlds, frames=601, steps=24))
    assert np.abs(energy / energy[:, :1] - 1).max() < 1e-3


def test_nothing_leaves_the_box_and_all_comes_to_rest():
    worlds = [gas(seed, 0.5, 0.5, (0, -GRAVITY)) for seed in range(16)]
    made = run(worlds, frames=601, steps=24)
    for i, (scene, _, layout) in enumerate(worlds):
        radius = np.asarray(scene.objects.radius)[: layout.discs]
        x = made.states.position[i, :, : layout.discs]
        assert (x >= 0.9 * radius[:, None]).all()
        assert (x <= 10 - 0.9 * radius[:, None]).all()
    speed = np.hypot(*np.moveaxis(made.states.velocity[:, -100:, :8], -1, 0))
    assert speed.max() < 0.05  # rolling on: nothing resists that
    assert np.abs(made.states.velocity[:, -100:, :8, 1]).max() < 0.02
    energy = energies(worlds, made)
    assert (np.diff(energy, axis=1) <= 24 * 1e-4 * energy[:, :1]).all()  # 1e-4 a step


def test_resting_disc_carries_its_weight_without_sinking():
    floor = [{"a": (-50, 0), "b": (50, 0), "friction": 1.0}]
    made = run([world([{"x": (0, 0.5), "elasticity": 0.5, "friction": 0.5}], floor, (0, -GRAVITY))], 601, 24)
    assert np.abs(made.states.position[0, :, 0] - [0, 0.5]).max() < 1e-3
    assert np.abs(made.states.velocity[0, 1:, 0]).max() < 1e-3


def test_overlapping_discs_part_gently():
    made = run([world([{"x": (-0.45, 0), "elasticity": 0.5}, {"x": (0.45, 0), "elasticity": 0.5}])], 241, 4)
    apart = np.hypot(*(made.states.position[0, :, 1] - made.states.position[0, :, 0]).T)
    assert 1 - 5e-3 < apart[-1] < 1 + 5e-3
    assert np.abs(made.states.velocity[0, -1]).max() < 1e-3
    assert np.diff(apart).max() <= 2 * 3.0 * 4 * STEP  # no faster than the push speed


@pytest.mark.parametrize("speed", [5.0, 50.0, 500.0])
def test_nothing_tunnels_at_any_speed(speed):
    wall = [{"a": (0, -5), "b": (0, 5)}]
    shots = [
        world([{"x": (-1 - speed * STEP * phase / 16, 0.01), "v": (speed, 0), "radius": 0.05, "elasticity": e}], wall)
        for phase in range(16)
        for e in (0.0, 1.0)
    ]
    made = run(shots, 121, 4)
    assert (made.states.position[:, :, 0, 0] < 0.01).all()


def test_mirror_image_moves_as_the_mirror_image():
    worlds = [gas(seed, 0.8, 0.3, (0, -GRAVITY)) for seed in range(4)]
    mirrored = []
    for scene, state, layout in worlds:
        flip = jnp.asarray([-1.0, 1.0])
        position = state.position * flip
        mirrored.append((scene, dataclasses.replace(
            state, position=position, velocity=state.velocity * flip, angle=-state.angle,
            angular_velocity=-state.angular_velocity,
        ), layout))  # fmt: skip
    one, other = run(worlds, 61, 8), run(mirrored, 61, 8)
    assert_array_equal(one.states.position * [-1, 1], other.states.position)
    assert_array_equal(one.states.angular_velocity, -other.states.angular_velocity)


def test_empty_slots_change_nothing_whatever_they_hold():
    scene, state, layout = gas(3, 0.9, 0.2, (0, -GRAVITY), discs=5)
    layout = dataclasses.replace(layout, discs=8)

    def padded(value: float, record):
        def widen(x):
            fill = jnp.full((3, *x.shape[1:]), value if jnp.issubdtype(x.dtype, jnp.floating) else 0).astype(x.dtype)
            return jnp.concatenate([x[:5], fill, x[5:]])

        return jax.tree.map(widen, record)

    worlds = [
        (types.Scene(padded(v, scene.objects), scene.gravity), padded(v, state), layout) for v in (0.0, np.nan, 1e9)
    ]
    made = run(worlds, 61, 8)
    for field in (made.states.position, made.states.velocity, made.states.angle, made.quality.max_penetration):
        assert_array_equal(field[0], field[1])
        assert_array_equal(field[0], field[2])
    assert (made.states.position[:, :, 5:8] == 0).all()


def test_gradient_through_a_bounce_is_right():
    """d x_T / d (x_0, v_0) of one elastic hit of a wall is (-1, -T); without the time of impact it is not."""
    scene, state, layout = types_of(world([{"x": (-2.0, 0)}], [{"a": (0, -50), "b": (0, 50)}]))

    def last(x0, v0):
        start = dataclasses.replace(
            state,
            position=state.position.at[0, 0, 0].set(x0),
            velocity=state.velocity.at[0, 0, 0].set(v0),
        )
        return simulate(scene, start, layout, rules(), 31, 8).states.position[-1, 0, 0, 0]

    by_place, by_speed = jax.jit(jax.grad(last, (0, 1)))(jnp.float32(-2.0), jnp.float32(3.0))
    assert_allclose(by_place, -1, atol=1e-3)
    assert_allclose(by_speed, -30 * 8 * STEP, atol=1e-3)


def test_gradients_are_never_nan():
    worlds = [gas(seed, 0.9, 0.3, (0, -GRAVITY), discs=4) for seed in range(8)]
    layout = worlds[0][2]
    scene, state = (types.to_device(jax.tree.map(lambda *x: jnp.stack(x), *(w[i] for w in worlds))) for i in (0, 1))

    def far(velocity):
        made = simulate(scene, dataclasses.replace(state, velocity=velocity), layout, rules(), 13, 10)
        return jnp.sum(made.states.position**2)

    assert np.isfinite(jax.jit(jax.grad(far))(state.velocity)).all()


def types_of(one: tuple) -> tuple:
    """One world as a batch of one in the device's layout."""
    scene, state, layout = one
    stacked = jax.tree.map(lambda x: x[None], (scene, state))
    return *(types.to_device(record) for record in stacked), layout


@given(st.floats(0.5, 1000), st.integers(1, 64))
def test_substeps_keep_a_step_under_its_limit(fps, asked):
    steps = substeps(fps, None, 1 / 240)
    assert 1 / (fps * steps) <= 1 / 240 * (1 + 1e-6)
    assert steps == 1 or 1 / (fps * (steps - 1)) > 1 / 240
    assert substeps(fps, asked, 1 / 240) == asked
