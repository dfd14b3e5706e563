"""What the solver may not change: momentum, energy, symmetry, slots that hold nothing, and its order in the step.

Steps are of 1/240 s. Random scenes are eight to an example of hypothesis, all of one layout.
"""

import dataclasses
import hashlib
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from laws import DOWN, FLOOR, GRAVITY, QUARTERS, Case, holds, pose_world, to_double, watch
from numpy.testing import assert_array_equal
from worlds import STEP, box, energies, momenta, rotate, rules, run, world

from gen2d.physics.simulate import SaveAt, simulate, substeps
from gen2d.programs.devices import processor_kind
from gen2d.records import axes

SEEDS = st.integers(0, 2**31)


def gas(seed: int, elasticity: float, friction: float, gravity: Any = (0, 0), discs: int = 8, **more: Any) -> tuple:
    """Discs at random places and speeds in a 10 m box."""
    rng = np.random.default_rng(seed)
    radius, places = rng.uniform(0.4, 0.8, discs), []
    while len(places) < discs:
        k = len(places)
        place = rng.uniform(radius[k], 10 - radius[k], 2)
        if all(np.hypot(*(place - p)) > radius[k] + r for p, r in zip(places, radius, strict=False)):
            places.append(place)
    rows = [
        {"x": x, "v": rng.normal(0, 3, 2), "radius": r, "spin": rng.normal(0, 5)}
        | {"elasticity": elasticity, "friction": friction}
        for x, r in zip(places, radius, strict=True)
    ]
    return world(rows, box(10, 1.0, friction), gravity, **more)


def cluster(seed: int, elasticity: float, friction: float) -> tuple:
    """Eight spinning discs that fly at each other, with nothing around them."""
    rng = np.random.default_rng(seed)
    rows = [
        {
            "x": rotate((3, 0), 45 * k),
            "v": rotate((-2 + rng.normal(0, 0.3), rng.normal(0, 0.3)), 45 * k),
            "radius": rng.uniform(0.3, 0.7),
            "spin": rng.normal(0, 4),
            "elasticity": elasticity,
            "friction": friction,
        }
        for k in range(8)
    ]
    return world(rows)


def wedge(seed: int, elasticity: float, friction: float) -> tuple:
    """Eight discs that fall into a narrow valley."""
    rng = np.random.default_rng(seed)
    half = rng.uniform(15, 60)  # degrees between a wall and the vertical
    walls = [{"a": (0, 0), "b": rotate((0, 30), side * half), "friction": friction} for side in (-1, 1)]
    walls += [{"a": (-1, -1000 - k), "b": (1, -1000 - k)} for k in range(2)]
    rows = [
        {"x": (rng.uniform(-0.2, 0.2), 4 + 1.5 * k), "v": rng.normal(0, 2, 2), "radius": rng.uniform(0.3, 0.7)}
        | {"spin": rng.normal(0, 5), "elasticity": elasticity, "friction": friction}
        for k in range(8)
    ]
    return world(rows, walls, DOWN)


def momentum_scales(worlds: list[tuple]) -> tuple[np.ndarray, np.ndarray]:
    """Per world the sums of |m v| and of |m x| |v| + |I w| at the start."""
    linear, angular = [], []
    for scene, state, layout in worlds:
        mass, moment, x, v, w = (
            np.asarray(a, float)[: layout.groups[0].count]
            for a in (scene.objects.mass, scene.objects.moment, state.position, state.velocity, state.angular_velocity)
        )
        speed = np.hypot(*v.T)
        linear.append((mass * speed).sum())
        angular.append((mass * np.hypot(*x.T) * speed + np.abs(moment * w)).sum())
    return np.array(linear), np.array(angular)


# Conservation -------------------------------------------------------------------------------------------------------


@settings(max_examples=8, deadline=None, derandomize=True)
@given(SEEDS, st.floats(0, 1), st.floats(0, 1))
def test_i1_i2_momentum_is_conserved_without_fixed_objects(seed, elasticity, friction):
    worlds = [cluster(seed + i, elasticity, friction) for i in range(8)]
    linear, angular = momenta(worlds, run(worlds, 481, 1))
    sizes, angular_sizes = momentum_scales(worlds)
    drift = np.linalg.norm(linear - linear[:, :1], axis=-1).max(1) / sizes / 2  # in 2 s
    holds("I1 momentum, of the sum of |m v|, per s", drift, 1e-5)
    holds("I2 angular momentum, relative", np.abs(angular - angular[:, :1]).max(1) / angular_sizes, 1e-5)


def energy_gains(worlds: list[tuple]) -> np.ndarray:
    """The largest gain of energy in a step of 2 s, relative to that at the start, by world."""
    energy = energies(worlds, run(worlds, 481, 1))
    return np.diff(energy).max(1) / energy[:, 0]


@settings(max_examples=8, deadline=None, derandomize=True)
@given(SEEDS, st.floats(0, 1), st.floats(0, 1))
def test_i3_energy_never_grows_among_free_discs(seed, elasticity, friction):
    worlds = [cluster(seed + i, elasticity, friction) for i in range(8)]
    holds("I3 energy gained in a step, free discs, relative", energy_gains(worlds), 1e-4)


@settings(max_examples=8, deadline=None, derandomize=True)
@given(SEEDS, st.floats(0, 1), st.floats(0, 1))
def test_i3_energy_never_grows_in_a_box(seed, elasticity, friction):
    worlds = [gas(seed + i, elasticity, friction, DOWN) for i in range(8)]
    holds("I3 energy gained in a step, box, relative", energy_gains(worlds), 1e-4)


@pytest.mark.slow
@pytest.mark.asked
def test_i3_energy_never_grows_in_many_boxes():
    """Discs that neither bounce nor rub overlap most, so a quarter of the worlds is of such."""
    rng = np.random.default_rng(5)
    pairs = [(0.0, 0.0) if k % 4 == 0 else rng.uniform(size=2) for k in range(60)]
    parts = [[gas(1000 * k + i, float(e), float(f), DOWN) for i in range(8)] for k, (e, f) in enumerate(pairs)]
    gains = np.concatenate([energy_gains(worlds) for worlds in parts])
    holds("I3 energy gained in a step, 480 boxes, relative", gains, 1e-3, asked=1e-4)
    holds("I3 share of 480 boxes that gain more", (gains > 1e-4).mean(), 0.02, asked=0.0)


@pytest.mark.asked
@settings(max_examples=8, deadline=None, derandomize=True)
@given(SEEDS, st.floats(0, 1), st.floats(0, 1))
def test_i3_energy_never_grows_in_a_wedge(seed, elasticity, friction):
    worlds = [wedge(seed + i, elasticity, friction) for i in range(8)]
    holds("I3 energy gained in a step, wedge, relative", energy_gains(worlds), 1e-2, asked=1e-4)


def test_i3_simultaneous_impacts_gain_no_energy():
    """A disc hits one, two or three others that touch each other; the first step decides."""
    h = np.sqrt(3) / 2
    groups = [[(0, 0), (1, 0)], [(0, 0.5), (0, -0.5)], [(0, 0.5), (0, -0.5), (h, 0)], [(0, 0), (h, 0.5), (h, -0.5)]]
    cases = [
        Case([{"x": (-1.5, y), "v": (4, 0), "elasticity": e}, *({"x": x, "elasticity": e} for x in group)])
        for group in groups
        for y in (0, 0.2)
        for e in (0.5, 1.0)
    ]
    made = watch(cases, 241, 1, slots=8)
    moment = 0.5 * 0.5**2 / 2 * made.spin**2
    energy = (0.5 * (made.v**2).sum(-1) + moment).sum(-1) / 8
    holds("I3 energy gained in a step, simultaneous impacts, relative", np.diff(energy).max(-1), 1e-4)


@pytest.mark.full
def test_i3_elastic_gas_keeps_its_energy():
    worlds = [gas(seed, 1.0, 0.0, (0, -g)) for seed in range(4) for g in (0.0, GRAVITY)]
    energy = energies(worlds, run(worlds, 101, 24))
    holds("I3 elastic gas of 8, 10 s, relative", energy / energy[:, :1] - 1, 1e-3)


@pytest.mark.slow
def test_i3_elastic_gas_keeps_its_energy_for_a_minute():
    worlds = [gas(seed, 1.0, 0.0, (0, -g), discs=16) for seed in range(8) for g in (0.0, GRAVITY)]
    energy = energies(worlds, run(worlds, 601, 24))
    holds("I3 elastic gas of 16, 60 s, relative", energy / energy[:, :1] - 1, 1e-3)


@pytest.mark.full
def test_elastic_gas_in_double_precision_conserves_to_the_ninth_digit():
    with jax.enable_x64(True):
        free = to_double([cluster(seed, 1.0, mu) for seed in range(8) for mu in (0.0, 0.5)])
        boxed = to_double([gas(seed, 1.0, 0.0) for seed in range(8)])
        flying, bouncing = run(free, 481, 1), run(boxed, 481, 1)
    assert np.asarray(flying.states.position).dtype == np.float64
    linear, angular = momenta(free, flying)
    sizes, angular_sizes = momentum_scales(free)
    drift = np.linalg.norm(linear - linear[:, :1], axis=-1).max(1)
    holds("f64: momentum, relative", drift / sizes, 1e-9)
    energy = energies(boxed, bouncing)
    holds("f64: energy of an elastic gas, relative", energy / energy[:, :1] - 1, 1e-9)
    turned = np.abs(angular - angular[:, :1]).max(1) / angular_sizes
    holds("f64: angular momentum, relative", turned, 1e-12)


# Odd scenes ---------------------------------------------------------------------------------------------------------


def test_i4_degenerate_scenes_stay_finite():
    """Two statics, coincident centres, no length, 10^4 in mass, 10^4 in size, nothing there at all."""
    floor = {**FLOOR, "a": (-5, 0), "b": (5, 0)}
    crossing = {**FLOOR, "a": (-5, 0.5), "b": (5, -0.5)}
    point = {**FLOOR, "a": (0, 0), "b": (0, 0)}
    disc = {"x": (0, 1), "elasticity": 0.5, "friction": 0.5}
    above = {**disc, "x": (0.1, 2.5)}
    cases = [
        Case([disc], [floor, floor], DOWN),
        Case([disc, above], [floor, crossing], DOWN),
        Case([disc, disc, above], [floor], DOWN),
        Case([disc, {**disc, "radius": 0.2}, {**disc, "v": (1, 0)}], [], (0, 0)),
        Case([{**disc, "x": (0, 0)}, above], [floor], DOWN),  # on the line of a segment
        Case([{**disc, "x": (0, 0)}, above], [point], DOWN),
        Case([disc, above], [point, floor], DOWN),
        Case([{**disc, "mass": 1e-2}, {**above, "mass": 1e2}], [floor], DOWN),
        Case([{**disc, "mass": 1e2}, {**above, "mass": 1e-2}], [floor], DOWN),
        Case([{**disc, "radius": 1e-3, "x": (0, 0.5)}, {**disc, "radius": 10, "x": (0, 11)}], [floor], DOWN),
        Case([{**disc, "mass": 0}, above], [floor], DOWN),
        Case([], [floor], DOWN),
        Case([], [], DOWN),
    ]
    made = watch(cases, 121, 8, slots=8)
    for name, values in made._asdict().items():
        assert np.isfinite(values).all(), (name, np.isfinite(values).all((1, 2, 3)))
    speed = np.hypot(made.v[..., 0], made.v[..., 1]).max((1, 2, 3))
    # Nothing falls for longer than 4 s, and nothing is pushed apart at more than the push speed.
    holds("I4 fastest disc of degenerate scenes, m/s", speed, 4 * GRAVITY + 3)


def test_i4_resting_disc_is_held_by_m_g_h_in_every_step():
    """Of the contact's impulse: the momentum that gravity gives is taken in each step, all of it and no more."""
    disc = {"x": (0, 0.5), "elasticity": 0.5, "friction": 0.5}
    made = watch([Case([{**disc, "mass": m}], [FLOOR], DOWN) for m in (1e-2, 1.0, 1e2)], 721)
    impulse = GRAVITY * STEP + np.diff(made.v[..., 0, 1], axis=-1)  # per kg
    holds("I4 impulse on a resting disc, relative to m g h", impulse[..., 1:] / (GRAVITY * STEP) - 1, 1e-3)


@pytest.mark.full
def test_i5_resting_disc_does_not_move_in_ten_thousand_steps():
    disc = {"x": (0, 0.5), "friction": 0.5}
    made = watch([Case([{**disc, "elasticity": e}], [FLOOR], DOWN) for e in (0, 0.5, 1)], 101, 100)
    holds("I5 resting disc: way in 10^4 steps, m", made.x[..., 0, :] - [0, 0.5], 1e-3)
    holds("I5 resting disc: speed, m/s", made.v[..., 0, :], 1e-3)


def test_i6_overlapping_discs_part_gently_and_then_stand():
    overlaps_of = (0.2, 1.0)  # of the radius
    cases = [
        Case([{"x": (s * (1 - part * 0.5) / 2, 0), "elasticity": e} for s in (-1, 1)])
        for part in overlaps_of
        for e in (0, 0.5, 1)
    ]
    made = watch(cases)
    apart = np.linalg.norm(made.x[..., 1, :] - made.x[..., 0, :], axis=-1)
    holds("I6 overlapping discs: distance at the end, m", apart[..., -1] - 1, 5e-3)
    holds("I6 overlapping discs: speed at the end, m/s", made.v[:, :, -1], 1e-3)
    holds("I6 overlapping discs: speed of parting, m/s", np.diff(apart) / STEP, 3 * (1 + 1e-3))


def test_i6_resting_overlapping_discs_on_a_floor_do_not_fly_apart():
    cases = [
        Case([{"x": (s * 0.45, 0.5 - sunk), "elasticity": 0.5} for s in (-1, 1)], [FLOOR], DOWN) for sunk in (0, 0.1)
    ]
    made = watch(cases)
    apart = made.x[..., 1, 0] - made.x[..., 0, 0]
    holds("I6 overlapping discs on a floor: distance at the end, m", apart[..., -1] - 1, 5e-3)
    holds("I6 overlapping discs on a floor: speed at the end, m/s", made.v[:, :, -1], 1e-3)


def test_an_overlap_is_corrected_like_that_of_a_damped_spring_which_is_stiffer_against_static_bodies():
    """Each step takes the same part of what is deeper than is allowed (Catto, 'Solver2D', 2024), without a speed."""
    cases = [
        Case([{"x": (0, 0.45)}], [FLOOR]),
        Case([{"x": (-0.475, 0)}, {"x": (0.475, 0)}]),
    ]
    made, params = watch(cases), rules()
    allowed, most = 0.5 * STEP * params.bounce_threshold, STEP * params.push_speed
    for name, hertz, left in (
        ("a floor", 60, 0.5 - made.x[0, :, :121, 0, 1]),
        ("a disc", 30, 1 - np.linalg.norm(made.x[1, :, :121, 1] - made.x[1, :, :121, 0], axis=-1)),
    ):
        omega = 2 * np.pi * hertz
        part = STEP * omega / (2 * params.damping_ratio + STEP * omega)
        law = [0.05]
        for _ in range(120):
            law.append(law[-1] - min(part * max(law[-1] - allowed, 0.0), most))
        holds(f"Overlap with {name}, of that at the start", (left - np.array(law)) / 0.05, 1e-3)
    holds("Speed of bodies that are pushed apart, m/s", made.v, 1e-6)


def test_a_slow_disc_far_from_the_origin_moves():
    """Its way in a step is a hundredth of the distance of two neighbouring numbers in single precision."""
    v, spin = np.array([2e-3, -1e-3]), 1e-3
    made = watch([Case([{"x": (900, 900), "v": v, "spin": spin}])])
    holds("Slow disc far away, 3 s, m", made.x[:, :, -1, 0] - ([900, 900] + 720 * STEP * v), 1e-4)


def test_angle_is_not_wrapped():
    made = watch([Case([{"spin": s}]) for s in (10.0, -10.0)])
    exact = np.array([10.0, -10.0])[:, None, None] * np.arange(721) * STEP
    holds("Angle of a spinning disc, 30 rad, rad", made.angle[..., 0] - exact, 1e-3)


# Invariances --------------------------------------------------------------------------------------------------------


def replace_state(one: tuple, **states: Any) -> tuple:
    """The world with other fields of its state."""
    scene, state, layout = one
    return scene, dataclasses.replace(state, **states), layout


def test_mirror_image_moves_as_the_mirror_image():
    worlds = [gas(seed, 0.8, 0.3, DOWN) for seed in range(4)]
    flip = jnp.asarray([-1.0, 1.0])
    mirrored = [
        replace_state(w, position=w[1].position * flip, velocity=w[1].velocity * flip, angle=-w[1].angle,
                angular_velocity=-w[1].angular_velocity)
        for w in worlds
    ]  # fmt: skip
    one, other = run([*worlds, *worlds], 61, 8), run([*mirrored, *mirrored], 61, 8)
    assert_array_equal(one.states.position * [-1, 1], other.states.position)
    assert_array_equal(one.states.angular_velocity, -other.states.angular_velocity)


def few_events(shift: Any = (0, 0), boost: Any = (0, 0), order: Any = (0, 1, 2), walls: bool = True) -> Case:
    """Three discs, two oblique hits one after the other and, with walls, a bounce: 1 s. Hits multiply errors."""
    discs = [
        {"x": (2, 5), "v": (7, 0.3), "spin": 2.0},
        {"x": (4, 5.3), "v": (0, 0), "radius": 0.4},
        {"x": (6, 6), "v": (0, -0.2), "spin": -3.0},
    ]
    discs = [
        {**d, "x": np.add(d["x"], shift), "v": np.add(d["v"], boost), "elasticity": 0.8, "friction": 0.4} for d in discs
    ]
    around = box(7, 1.0, 0.5, (5 + shift[0], 5 + shift[1])) if walls else []
    return Case([discs[k] for k in order], around, (0, -2) if walls else (0, 0))


@pytest.mark.full
def test_a_quarter_turn_turns_the_motion():
    worlds = [pose_world(few_events(), turn, 8, 4) for turn in QUARTERS] * 2
    made = run(worlds, 241, 1)
    for k, turn in enumerate(QUARTERS):
        holds(
            "Turned by a quarter, 1 s, m", made.states.position[k, :, :3] @ turn - made.states.position[0, :, :3], 1e-5
        )
    assert made.quality.contacts[0] >= 3


@pytest.mark.full
def test_twice_the_unit_of_length_gives_the_same_bits():
    """All lengths, speeds and accelerations twice as large, a power of two: hidden constants would show."""
    worlds = [gas(seed, 0.8, 0.3, DOWN) for seed in range(8)]

    def twice(one: tuple) -> tuple:
        scene, state, layout = one
        o = scene.objects
        objects = dataclasses.replace(o, radius=2 * o.radius, half_length=2 * o.half_length, moment=4 * o.moment)
        scene = dataclasses.replace(scene, objects=objects, gravity=2 * scene.gravity)
        return replace_state((scene, state, layout), position=2 * state.position, velocity=2 * state.velocity)

    ordinary = rules()
    larger = rules(bounce_threshold=2 * ordinary.bounce_threshold, push_speed=2 * ordinary.push_speed)
    one, other = run(worlds, 61, 8, ordinary), run([twice(w) for w in worlds], 61, 8, larger)
    assert_array_equal(2 * one.states.position, other.states.position)
    assert_array_equal(2 * one.states.velocity, other.states.velocity)
    assert_array_equal(one.states.angular_velocity, other.states.angular_velocity)


@pytest.mark.full
def test_translation_translates():
    far = np.array([64.0, -32.0])
    made = run([pose_world(few_events(shift), QUARTERS[0], 8, 4) for shift in ((0, 0), far)] * 4, 241, 1)
    x = np.asarray(made.states.position, float)[:, :, :3]
    holds("Translated by (64, -32), 1 s, m", x[1] - far - x[0], 1e-4)


def test_boost_without_fixed_objects_boosts():
    boost = np.array([2.0, -1.0])
    made = run([pose_world(few_events(boost=u, walls=False), QUARTERS[0], 8, 4) for u in ((0, 0), boost)] * 4, 241, 1)
    x = np.asarray(made.states.position, float)[:, :, :3]
    way = boost * (np.arange(241) * STEP)[:, None, None]
    holds("Boosted by (2, -1), 1 s, m", x[1] - way - x[0], 1e-4)


def test_the_order_of_the_discs_does_not_matter():
    orders = [(0, 1, 2), (1, 2, 0), (2, 0, 1), (1, 0, 2), (2, 1, 0), (0, 2, 1)]
    cases = [few_events(order=order) for order in orders]
    made = run([pose_world(case, QUARTERS[0], 8, 4) for case in [*cases, *cases[:2]]], 241, 1)
    x = np.asarray(made.states.position, float)
    for k, order in enumerate(orders):
        holds("Other order of the discs, 1 s, 3 events, m", x[k, :, :3] - x[0][:, list(order)], 3e-5)
    assert_array_equal(made.quality.contacts, made.quality.contacts[0])
    assert made.quality.contacts[0] >= 3


def test_empty_slots_change_nothing_whatever_they_hold():
    scene, state, layout = gas(3, 0.9, 0.2, DOWN, discs=5, slots=8)

    def fill_empty_slots(value: float, record: Any) -> Any:
        def fill(x: jax.Array) -> jax.Array:
            return x.at[5:8].set(value) if jnp.issubdtype(x.dtype, jnp.floating) else x

        return jax.tree.map(fill, record)

    worlds = [
        (dataclasses.replace(scene, objects=fill_empty_slots(v, scene.objects)), fill_empty_slots(v, state), layout)
        for v in (0.0, np.nan, 1e9, np.inf)
    ]
    made = run([*worlds, *worlds], 61, 8)
    for field in (made.states.position, made.states.velocity, made.states.angle, made.quality.max_penetration):
        for k in (1, 2, 3):
            assert_array_equal(field[0], field[k])
    assert (made.states.position[:, :, 5:8] == 0).all()


def test_a_video_does_not_depend_on_its_place_or_its_neighbours():
    worlds = [gas(seed, 0.9, 0.3, DOWN) for seed in range(8)]
    others = [gas(100 + seed, 0.2, 0.8, DOWN) for seed in range(7)]
    one, again, turned_round = (run(w, 61, 8) for w in (worlds, worlds, worlds[::-1]))
    elsewhere = run([*others, worlds[0]], 61, 8)
    assert_array_equal(one.states.position, again.states.position)
    assert_array_equal(one.states.position, turned_round.states.position[::-1])
    assert_array_equal(one.states.position[0], elsewhere.states.position[7])


# Hash of a simulation by version of jaxlib and kind of processor. A change of the solver that is meant to change
# results replaces it; one that is not, such as a move or a new name, must not.
KNOWN_BITS = {("0.10.2", "avx512f GenuineIntel"): "4bfaee2cf4faf0a9"}


def test_a_simulation_has_the_bits_that_are_known_for_this_platform():
    platform = version("jaxlib"), processor_kind()
    states = run([gas(seed, 0.9, 0.3, DOWN) for seed in range(8)], 61, 8).states
    found = hashlib.sha256(b"".join(np.ascontiguousarray(x).tobytes() for x in jax.tree.leaves(states))).hexdigest()[
        :16
    ]
    if platform not in KNOWN_BITS:
        pytest.skip(f"no bits are known for jaxlib {platform[0]} with {platform[1]}: here they are {found!r}")
    assert found == KNOWN_BITS[platform], "the solver's results have changed: if that is meant, replace KNOWN_BITS"


PRINT = """
import hashlib, sys
sys.path[:0] = [{here!r}, {support!r}, {root!r}]
from test_invariants import DOWN, gas, run
worlds = [gas(seed % 5, 0.9, 0.3, DOWN) for seed in range({lanes})]
print(hashlib.sha256(run(worlds, 61, 8).states.position[:1].tobytes()).hexdigest())
"""


def printed_hash(lanes: int, flags: str, cores: int) -> str:
    """The hash of a video made by a fresh process in a batch of that size."""
    here = Path(__file__).parent
    code = PRINT.format(here=str(here), support=str(here.parent / "support"), root=str(here.parents[1]), lanes=lanes)
    command = ["taskset", "-c", "0" if cores == 1 else f"0-{cores - 1}", sys.executable, "-c", code]
    env = {**os.environ, "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} {flags}", "JAX_PLATFORMS": "cpu"}
    return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux" or (os.cpu_count() or 1) < 2, reason="binds processes to cores")
def test_bits_do_not_depend_on_threads_nor_with_avx_alone_on_the_batch():
    assert printed_hash(8, "", 1) == printed_hash(8, "", 2)
    assert len({printed_hash(lanes, "--xla_cpu_max_isa=AVX", 2) for lanes in (1, 7, 64)}) == 1


# Order of convergence -----------------------------------------------------------------------------------------------

PER_SIXTIETH = (1, 2, 4, 8, 16)  # steps of 1/60 to 1/960 s


def slope(errors: np.ndarray) -> float:
    """The order of the error in the step."""
    return -np.polyfit(np.log(PER_SIXTIETH), np.log(np.abs(errors)), 1)[0]


@pytest.mark.full
def test_order_of_convergence_in_double_precision():
    """Free fall, a bounce and a slide (locked) are exact or of first order, the end of the slide is of first order."""
    u, mu, height = 5.0, 0.3, 1.0
    cases = [
        Case([{"x": (0, 20), "v": (3, 4)}], [FLOOR], DOWN),
        Case([{"x": (0, 0.5 + height), "elasticity": 0.8}], [FLOOR], DOWN),
        Case([{"x": (0, 0.5), "v": (u, 0), "elasticity": 0, "friction": mu, "moment": np.inf}], [FLOOR], DOWN),
    ]
    with jax.enable_x64(True):
        worlds = to_double([pose_world(case, QUARTERS[0], 2, 2) for case in cases])
        made = [np.asarray(run(worlds, 121, n, rules(1 / 60 / n)).states.position) for n in PER_SIXTIETH]
    fall = [x[0, 30, 0, 1] - (20 + 4 * 0.5 - GRAVITY * 0.5**2 / 2) for x in made]
    hit = np.sqrt(2 * height / GRAVITY)
    rises = 0.7 - hit  # s after the bounce
    bounce = [x[1, 42, 0, 1] - (0.5 + 0.8 * GRAVITY * hit * rises - GRAVITY * rises**2 / 2) for x in made]
    stop = [x[2, -1, 0, 0] - u**2 / (2 * mu * GRAVITY) for x in made]
    for name, errors, least, most in (("free fall", fall, 0.98, 1.02), ("bounce", bounce, 0.95, 9)):
        print(f"Order of {name}: errors {np.array(errors)}")
        if np.abs(errors).max() > 1e-6:  # else exact, but for the rounding of what was given
            assert least <= slope(np.array(errors)) <= most, (name, errors)
    slide = [x[2, 30, 0, 0] - (u * 0.5 - mu * GRAVITY * 0.5**2 / 2) for x in made]
    holds("Sliding disc after half a second in float64, m", slide, 1e-12)
    print(f"Order of the sliding stop: {slope(np.array(stop)):.3f}")
    assert slope(np.array(stop)) >= 0.9, stop  # the time of the stop within a step has a part in it
    holds("Sliding disc that has stopped in float64, m", stop, 5e-5)


def test_states_between_frames_lead_to_those_of_the_frames():
    """In a world without pairs of bodies."""
    scene, state, layout = world([{"v": (3, 4), "spin": 2.0}], gravity=DOWN)
    device = [axes.to_device(jax.tree.map(lambda x: x[None], record)) for record in (scene, state)]
    program = jax.jit(lambda scene, state: simulate(scene, state, layout, rules(), 6, 5, SaveAt(between=True)))
    made = program(device[0], device[1])
    jax.tree.map(lambda steps, frames: assert_array_equal(steps[:, -1], frames[1:]), made.between, made.states)
    t = (1 + np.arange(25)) * STEP
    holds("States between frames: place, m", made.between.position[:, :, 0, 0, 0].ravel() - 3 * t, 1e-5)


@given(st.floats(0.5, 1000), st.integers(1, 64))
def test_substeps_keep_a_step_under_its_limit(fps, asked):
    steps = substeps(fps, None, 1 / 240)
    assert 1 / (fps * steps) <= 1 / 240 * (1 + 1e-6)
    assert steps == 1 or 1 / (fps * (steps - 1)) > 1 / 240
    assert substeps(fps, asked, 1 / 240) == asked
