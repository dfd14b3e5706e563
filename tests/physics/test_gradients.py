"""Derivatives of motion: of jax.grad against closed forms and central differences, in double precision; never NaN.

Gradients through many hits are chaotic, as the motion is: two discs already multiply an error by 2 L / r at each hit.
So closed forms and differences are for single events; of whole scenes only finiteness is asked.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import DOWN, FAR, FLOOR, GRAVITY, holds, to_double
from numpy.testing import assert_array_equal
from worlds import STEP, rotate, rules, world

from gen2d.physics.simulate import simulate
from gen2d.records import axes
from gen2d.records.layout import Layout

SECONDS = 1.0
EPS = 1e-5
FAR_WALL = {"a": (-1, -FAR), "b": (1, -FAR)}
WALL = {"a": (0, -50), "b": (0, 50)}
SLIDE = {"u": 2.5, "mu": 0.3}  # stops after 0.85 s


class Event(NamedTuple):
    """One video of at most two discs: derivatives of a coordinate of a disc at the end by some numbers of the start.

    A number is (field, slot, axis) and has its exact derivative, or None where only differences are compared.
    """

    discs: Sequence[dict]
    segments: Sequence[dict]
    gravity: Sequence[float]
    looked_at: tuple[int, int]  # disc, axis
    by: Mapping[tuple[str, int, int], float | None]


def bounce_height(height: float, speed: float, e: float) -> float:
    """The height after a second of a disc thrown up, after one bounce."""
    arrival = np.sqrt(speed**2 + 2 * GRAVITY * (height - 0.5))
    left = SECONDS - (arrival + speed) / GRAVITY
    return 0.5 + e * arrival * left - GRAVITY * left**2 / 2


def bounce_slopes(height: float, speed: float, e: float, d: float = 1e-6) -> tuple[float, float]:
    """The derivatives of `bounce_height` by height and speed."""
    by_height = (bounce_height(height + d, speed, e) - bounce_height(height - d, speed, e)) / (2 * d)
    by_speed = (bounce_height(height, speed + d, e) - bounce_height(height, speed - d, e)) / (2 * d)
    return by_height, by_speed


X, Y = 0, 1
PAIR = [{"x": (-2, 0), "v": (3, 0)}, {"x": (0, 0)}]
OBLIQUE = [{"x": (-2, 0), "v": (3, 0.1), "elasticity": 0.8}, {"x": (0, 0.4), "friction": 1, "radius": 0.6, "spin": 2}]
EVERY = {(field, slot, axis): None for field in ("position", "velocity") for slot in (0, 1) for axis in (X, Y)}
BY_HEIGHT, BY_SPEED = bounce_slopes(2.0, 0.5, 0.8)
EVENTS = {
    # x_T = x_0 + v T + g T^2 / 2
    "free flight": Event([{"v": (3, 4)}], [], DOWN, (0, Y), {
        ("position", 0, X): 0, ("position", 0, Y): 1, ("velocity", 0, X): 0, ("velocity", 0, Y): SECONDS,
        ("gravity", 0, Y): SECONDS**2 / 2}),
    # (-1, -T), at three phases of the step: without the time of impact it is not
    **{f"wall hit from {x}": Event([{"x": (x, 0), "v": (3, 0)}], [WALL], (0, 0), (0, X), {
        ("position", 0, X): -1, ("velocity", 0, X): -SECONDS}) for x in (-2.0, -2.005, -2.01)},
    "bounce on a floor": Event([{"x": (0, 2), "v": (0, 0.5), "elasticity": 0.8}], [FLOOR], DOWN, (0, Y), {
        ("position", 0, Y): BY_HEIGHT, ("velocity", 0, Y): BY_SPEED}),
    # Equal discs exchange places and speeds: x_b(T) = x_a + 2 r + v T and x_a(T) = x_b - 2 r + v_b T.
    "head-on hit, struck disc": Event(PAIR, [], (0, 0), (1, X), {
        ("position", 0, X): 1, ("velocity", 0, X): SECONDS, ("position", 1, X): 0, ("velocity", 1, X): 0}),
    "head-on hit, striking disc": Event(PAIR, [], (0, 0), (0, X), {
        ("position", 0, X): 0, ("velocity", 0, X): 0, ("position", 1, X): 1, ("velocity", 1, X): SECONDS}),
    "smooth oblique hit": Event(OBLIQUE, [], (0, 0), (1, Y), EVERY),
    "rough oblique hit": Event([{**OBLIQUE[0], "friction": 0.3}, OBLIQUE[1]], [], (0, 0), (1, Y), EVERY),
    # x = u^2 / (2 mu g), of first order in the step; the key `moment` of a disc
    "stop of a locked disc": Event(
        [{"x": (0, 0.5), "v": (SLIDE["u"], 0), "elasticity": 0, "friction": SLIDE["mu"], "moment": np.inf}],
        [FLOOR], DOWN, (0, X), {
        ("friction", 0, X): -SLIDE["u"] ** 2 / (2 * SLIDE["mu"] ** 2 * GRAVITY),
        ("velocity", 0, X): SLIDE["u"] / (SLIDE["mu"] * GRAVITY)}),
}  # fmt: skip


def batch(worlds: list[tuple]) -> tuple:
    """The worlds as one batch in the device's layout: the numbers to differentiate by, scene, state and layout."""
    scene, state = (axes.to_device(jax.tree.map(lambda *x: jnp.stack(x), *(w[i] for w in worlds))) for i in (0, 1))
    names = ("radius", "mass", "moment", "elasticity", "friction")
    numbers = {name: getattr(scene.objects, name) for name in names} | {"gravity": scene.gravity}
    return numbers | {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}, scene, state, worlds[0][2]


def ends(numbers: dict, scene: Any, state: Any, layout: Layout, steps: int) -> jax.Array:
    """Where the discs are after the steps, [2, N, n]."""
    of_state = {name: numbers[name] for name in (f.name for f in dataclasses.fields(state))}
    of_objects = {k: v for k, v in numbers.items() if k != "gravity" and k not in of_state}
    scene = dataclasses.replace(
        scene, objects=dataclasses.replace(scene.objects, **of_objects), gravity=numbers["gravity"]
    )
    state = dataclasses.replace(state, **of_state)
    return simulate(scene, state, layout, rules(), 2, steps).states.position[-1, :, : layout.groups[0].count]


def nudge(values: jax.Array, slot: int, axis: int, by: float) -> jax.Array:
    """The values with one number changed in all videos: [2, K, n], [K, n] or, of gravity, [2, n]."""
    place = (axis, slot) if values.ndim == 3 else (axis if values.shape[0] == 2 else slot,)
    return values.at[place].add(by)


@functools.cache
def both_gradients() -> tuple[dict, dict]:
    """For each event and number the derivative by jax.grad, and by differences of 1e-5 and of .05."""
    with jax.enable_x64(True):
        worlds = to_double([
            world(e.discs, [*e.segments, FAR_WALL, FAR_WALL][:2], e.gravity, slots=2) for e in EVENTS.values()
        ])  # fmt: skip
        numbers, scene, state, layout = batch(worlds)
        steps = round(SECONDS / STEP)
        weight = np.zeros((2, 2, len(worlds)))
        for k, event in enumerate(EVENTS.values()):
            weight[event.looked_at[1], event.looked_at[0], k] = 1

        def total(numbers: dict) -> jax.Array:
            return jnp.sum(ends(numbers, scene, state, layout, steps) * weight)

        def per_case(numbers: dict) -> jax.Array:
            return jnp.sum(ends(numbers, scene, state, layout, steps) * weight, axis=(0, 1))

        by_grad, forward = jax.jit(jax.grad(total))(numbers), jax.jit(per_case)
        found, wide = {}, {}
        wanted = sorted({number for event in EVENTS.values() for number in event.by})
        for field, slot, axis in wanted:
            for eps, into in ((EPS, found), (0.05, wide)):
                up, down = (forward({**numbers, field: nudge(numbers[field], slot, axis, s * eps)}) for s in (1, -1))
                into[field, slot, axis] = np.asarray((up - down) / (2 * eps))
        grads = {
            (field, slot, axis): np.asarray(nudge(jnp.zeros_like(by_grad[field]), slot, axis, 1) * by_grad[field]).sum(
                tuple(range(by_grad[field].ndim - 1))
            )
            for field, slot, axis in wanted
        }
    names = list(EVENTS)
    return (
        {(name, number): (grads[number][k], found[number][k]) for k, name in enumerate(names) for number in wanted},
        {(name, number): wide[number][k] for k, name in enumerate(names) for number in wanted},
    )


# Single events ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EVENTS)
def test_gradient_is_the_closed_form_and_the_difference(name):
    event, largest = EVENTS[name], 0.0
    for number, exact in event.by.items():
        by_grad, by_difference = both_gradients()[0][name, number]
        largest = max(largest, abs(by_grad))
        # The stop is of first order in the step: of 204 steps.
        relative, bound = (abs(exact or 1), 1e-2) if "stop" in name else (1, 1e-3)
        if exact is not None:
            holds(f"Gradient, {name}, against the closed form", (by_grad - exact) / relative, bound)
        holds(f"Gradient, {name}, against differences", (by_grad - by_difference) / relative, 1e-3)
    assert largest > 0.3


@pytest.mark.parametrize("x", [-2.0, -2.005, -2.01])
def test_differences_across_several_steps_agree_at_a_wall(x):
    for number, exact in ((("position", 0, X), -1), (("velocity", 0, X), -SECONDS)):
        holds("Differences of .05 at a wall", both_gradients()[1][f"wall hit from {x}", number] - exact, 0.05)


# Nothing and never NaN ----------------------------------------------------------------------------------------------


def random_world(seed: int, discs: int = 4) -> tuple:
    """Discs that fly at each other between two walls that meet below them."""
    rng = np.random.default_rng(seed)
    rows = [
        {"x": rotate((1.1, 0), 90 * k + rng.uniform(0, 20)), "v": rng.normal(0, 4, 2), "radius": rng.uniform(0.3, 0.6)}
        | {"spin": rng.normal(0, 5), "elasticity": rng.uniform(), "friction": rng.uniform()}
        for k in range(discs)
    ]
    walls = [{"a": (0, -2.5), "b": (side * 4, 2), "friction": 0.5} for side in (-1, 1)]
    return world(rows, walls, DOWN, slots=4)


@functools.cache
def program(layout: Layout) -> Any:
    """The gradient of the sum of the squared places after 120 steps."""

    def far(numbers: dict, scene: Any, state: Any) -> jax.Array:
        return jnp.sum(ends(numbers, scene, state, layout, 120) ** 2)

    return jax.jit(jax.grad(far))


def gradients(worlds: list[tuple]) -> dict[str, np.ndarray]:
    """By every number of scene and state, videos last."""
    numbers, scene, state, layout = batch(worlds)
    layout = dataclasses.replace(layout, bounds=(0.0, 0.0, 1.0, 1.0), reach=1.0)
    return jax.tree.map(np.asarray, program(layout)(numbers, scene, state))


@pytest.mark.full
def test_gradients_are_never_nan():
    """16 random scenes, 120 steps."""
    found = gradients([random_world(seed) for seed in range(16)])
    for name, values in found.items():
        assert np.isfinite(values).all(), name
    assert np.abs(found["velocity"]).max() > 0.1


@pytest.mark.full
def test_gradients_of_degenerate_scenes_are_finite():
    """Coincident centres, a disc on a segment's line, overlapping statics, rest, and nothing there."""
    floor = {**FLOOR, "a": (-5, 0), "b": (5, 0)}
    point = {**FLOOR, "a": (0, 0), "b": (0, 0)}
    disc = {"x": (0, 1), "elasticity": 0.5, "friction": 0.5}
    rest = {**disc, "x": (2, 0.5)}
    scenes = {
        "coincident discs": ([disc, disc], [floor]),
        "concentric discs": ([disc, {**disc, "radius": 0.2}, rest], [floor, floor]),
        "disc on a segment": ([{**disc, "x": (0, 0)}, rest], [floor]),
        "disc on a point": ([{**disc, "x": (0, 0)}, rest], [point, floor]),
        "crossing segments": ([rest], [floor, {**floor, "a": (-5, 1), "b": (5, -1)}]),
        "nothing": ([], [floor]),
    }
    worlds = [world(discs, [*walls, FAR_WALL][:2], DOWN, 4) for discs, walls in scenes.values()]
    found = gradients([*worlds, *[random_world(seed) for seed in range(10)]])
    bad = {
        (scene, name)
        for name, values in found.items()
        for k, scene in enumerate([*scenes, *["ordinary"] * 10])
        if not np.isfinite(values[..., k]).all()
    }
    assert not bad, sorted(bad)


@pytest.mark.full
def test_gradients_by_empty_slots_are_zero():
    found = gradients([random_world(seed, discs=3) for seed in range(16)])
    for name, values in found.items():
        if name != "gravity":
            assert_array_equal(values[..., 3, :], 0, err_msg=name)
