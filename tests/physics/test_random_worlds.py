"""Laws of random closed worlds: nobody leaves or overlaps, energy never rises, friction keeps to its bound, no NaN.

Each class of worlds is a recipe (random_worlds.py). A law is about every world of a class, so the share of the worlds,
or of the rows of contacts, that break it is measured, and none is asked; the tables hold what breaks today. The fast
tier simulates a few worlds of most classes in one batch; the slow tier, thousands of all classes, with capsules, fixed
boxes and joints, and under other options of the solver.
"""

import functools
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from laws import holds
from overlap import depth_of
from random_worlds import LARGE, SMALL, Arena, Measures, Recipe, measure
from worlds import STEP, rules

FEW = 14  # worlds of a class in the fast tier
MANY, BATCHES = 128, 8  # worlds in a batch and batches of a class in the slow tier
FULL = Recipe(discs=(6, 6), capsules=(2, 2), polygons=(3, 3))
DISCS = Recipe(discs=(6, 6), capsules=(0, 0), polygons=(0, 0))
ONE, NONE = (1.0, 1.0), (0.0, 0.0)
SMOOTH = replace(FULL, elasticity=ONE, friction=NONE, gravity=0.0, fixed=0.0, boxes=True)
WILD = replace(FULL, density=3, speed=40, spin=40)  # speeds of 100 m/s and spins of 80 rad/s occur
RECIPES = {
    "discs": DISCS,
    "elastic discs": replace(DISCS, elasticity=ONE),
    "discs, mass ratios up to 1e6": replace(DISCS, density=3, gravity=1, radius=(0.6, 0.8)),
    "all shapes": FULL,
    "elastic shapes": replace(FULL, elasticity=ONE),
    "mass ratios up to 1e6": replace(FULL, density=3, speed=10),
    "smooth elastic boxes": replace(SMOOTH, discs=(0, 0), spin=15, speed=20, radius=(0.6, 1.0)),
    "smooth elastic boxes and fast small discs": replace(SMOOTH, fast=60),
    **{f"fast, mass ratios up to 1e6, e = {e}": replace(WILD, elasticity=(e, e)) for e in (0.0, 0.5, 1.0)},
    "joints, with gravity": Recipe(joints=True, gravity=1),
    "joints, without": Recipe(joints=True, gravity=0),
}
NO_STATICS = replace(FULL, closed=False, gravity=0.0)
DEEP = 0.05  # m: an overlap that is too large where bodies have had half a second to part
DETOUR = 0.02  # m: more than overlaps push a body in a step
NOT_FINITE, LEFT, RISING, ABOVE, OVERLAPPING, DETOURING, PULLING, SLIPPING, IDLE = LAWS = (
    "worlds that are not finite",
    "worlds that lose a body",
    "worlds that gain 1e-4 of their energy in a step",
    "worlds whose energy exceeds that at the start by 1e-4",
    "worlds with an overlap over 5 cm at the mark of a half second",
    "worlds in which a body that touches nothing leaves its parabola",
    "rows of contacts that pull",
    "rows of contacts over Coulomb's bound",
    "rows without a contact that have an impulse",
)
# Largest share that breaks a law today; None: a few worlds of a thousand do, so that a sample may have none (RARELY).
# Laws that are not there hold.
Bounds = Mapping[str, float | None]
RARELY, RARELY_OF_FEW = 0.01, 0.3
FEW_BOUNDS: dict[str, Bounds] = {
    "discs": {RISING: None},
    "elastic discs": {},
    "discs, mass ratios up to 1e6": {RISING: None, OVERLAPPING: 0.7},
    "all shapes": {RISING: None, OVERLAPPING: None},
    "elastic shapes": {RISING: None},
    "mass ratios up to 1e6": {ABOVE: None, RISING: None, OVERLAPPING: 0.6},
    "smooth elastic boxes": {OVERLAPPING: None},
    "smooth elastic boxes and fast small discs": {OVERLAPPING: None},
}
MANY_BOUNDS: dict[str, Bounds] = {
    "discs": {RISING: None},
    "elastic discs": {},
    "discs, mass ratios up to 1e6": {RISING: 0.035, OVERLAPPING: 0.38},
    "all shapes": {RISING: 0.012, SLIPPING: 1e-5},
    "elastic shapes": {},
    "mass ratios up to 1e6": {RISING: 0.012, OVERLAPPING: 0.4},
    "smooth elastic boxes": {OVERLAPPING: 0.01},
    "smooth elastic boxes and fast small discs": {DETOURING: None, OVERLAPPING: None},
    "fast, mass ratios up to 1e6, e = 0.0": {RISING: 0.02, DETOURING: None, SLIPPING: 1e-5, OVERLAPPING: 0.8},
    "fast, mass ratios up to 1e6, e = 0.5": {RISING: None, SLIPPING: 2e-5, OVERLAPPING: 0.42},
    "fast, mass ratios up to 1e6, e = 1.0": {RISING: None, DETOURING: 0.09, OVERLAPPING: 0.2},
    "joints, with gravity": {RISING: 0.1},
    "joints, without": {RISING: 0.05},
}
EXTREME_BOUNDS: dict[str, Bounds] = {  # with `physics.extreme_mass_ratios`
    "discs, mass ratios up to 1e6": {RISING: 0.12, DETOURING: None, OVERLAPPING: 0.15},
    "mass ratios up to 1e6": {RISING: 0.05, DETOURING: None, OVERLAPPING: 0.2},
    "fast, mass ratios up to 1e6, e = 0.5": {RISING: None, DETOURING: 0.08, OVERLAPPING: 0.2},
}
PASSES_BOUNDS: dict[int, dict[str, Bounds]] = {  # with one relaxing pass, or with four in all scenes
    1: {
        "discs": {RISING: None, OVERLAPPING: None},
        "all shapes": {RISING: None, OVERLAPPING: 0.1},
    },
    4: {
        "all shapes": {RISING: 0.01, OVERLAPPING: None},
        "elastic shapes": {},
        "joints, with gravity": {RISING: 0.08},
    },
}
# Speeds up to half of a radius in a step; a fixed obstacle may form a wedge that is narrower than a disc.
HALF_A_RADIUS = replace(DISCS, radius=(0.45, 0.45), speed=14.0, gravity=0.0, fixed=0.0)


def case(name: str, bounds: Iterable[float | None]) -> Any:
    """Parameter of a test: the name, marked as owed if there is a bound."""
    return pytest.param(name, marks=pytest.mark.asked if any(bounds) else ())


def classes(table: Mapping[str, Bounds]) -> list:
    """Parameters of a test: the names of the classes."""
    return [case(name, of.values()) for name, of in table.items()]


def check_laws(name: str, batches: list[Measures], bounds: Bounds, rarely: float) -> None:
    """Checks the laws of closed worlds, those that fail today against their bounds, rare failures against `rarely`."""
    broken = (
        [~m.finite for m in batches],
        [m.outside > 0 for m in batches],
        [m.gain_in_step > 1e-4 for m in batches],
        [m.gain > 1e-4 for m in batches],
        [(m.overlap > DEEP).any(1) for m in batches],
        [m.detour > DETOUR for m in batches],
        [m.normal_impulse[m.rows] < 0 for m in batches],
        [m.slipping[m.rows] for m in batches],
        [m.idle_impulses for m in batches],
    )
    jointed = name in RECIPES and RECIPES[name].joints  # bodies on a hinge overlap
    for law, parts in zip(LAWS, broken, strict=True):
        if law == OVERLAPPING and jointed:
            continue
        of, bound = np.concatenate(parts), bounds.get(law, 0.0)
        asked = 0.0 if bound else None
        holds(f"{name}: share of {len(of)} {law}", of.mean(), rarely if bound is None else bound, asked)
    # A world that explodes may touch more often than there are rows.
    crowded = np.concatenate([(m.contacts.count > m.rows.shape[1]) & m.finite & ~(m.gain > 1) for m in batches])
    assert not crowded.any(), f"there was no room for all rows of {crowded.sum()} worlds"


SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
POINT, WALL = np.zeros((4, 2)), np.array([[-5.0, 0.0], *[[5.0, 0.0]] * 3])


@pytest.mark.parametrize(
    ("a", "offset", "b", "radii", "depth"),
    [
        (SQUARE, (1.9, 0.5), SQUARE, 0.0, 0.1),  # the least way out
        (SQUARE, (5.0, 6.0), SQUARE, 1.0, -4.0),  # corner to corner
        (SQUARE @ [[0.6, 0.8], [-0.8, 0.6]], (0.0, 1.3), WALL, 0.0, 0.1),  # a corner in a thin wall
        (POINT, (3.0, 4.0), POINT, 6.0, 1.0),
        (POINT, (5.3, 0.4), WALL, 0.6, 0.1),  # the end of a wall
        (POINT, (6.0, 0.0), WALL, 0.5, -0.5),  # on its line
        (POINT, (0.2, 0.0), SQUARE, 0.5, 1.3),  # a centre inside
    ],
)
def test_the_measure_of_overlap_is_that_of_closed_forms(a, offset, b, radii, depth):
    a = a + np.array(offset)
    np.testing.assert_allclose([depth_of(a, b, radii), depth_of(b, a, radii)], depth, atol=1e-12)


@functools.cache
def few_worlds() -> dict[str, Measures]:
    """Some worlds of each class, all in one batch."""
    recipes = [*(RECIPES[name] for name in FEW_BOUNDS), NO_STATICS]
    return dict(zip([*FEW_BOUNDS, "no statics"], measure(SMALL, recipes, FEW), strict=True))


@pytest.mark.parametrize("name", classes(FEW_BOUNDS))
def test_few_worlds_keep_the_laws(name):
    check_laws(name, [few_worlds()[name]], FEW_BOUNDS[name], RARELY_OF_FEW)


def momentum_drift(measures: Measures) -> tuple[np.ndarray, np.ndarray]:
    """Relative drift of the momentum, per s, and of the angular momentum, of each world."""
    seconds = (measures.energy.shape[1] - 1) * STEP
    linear = np.linalg.norm(measures.momentum - measures.momentum[:, :1], axis=-1).max(1)
    angular = np.abs(measures.angular - measures.angular[:, :1]).max(1)
    return linear / measures.momentum_scale / seconds, angular / measures.angular_scale


def test_momentum_is_conserved_among_all_shapes():
    measures = few_worlds()["no statics"]
    assert (measures.rows.sum(1) > 0).mean() > 0.5
    holds("no statics: momentum, of the sum of |m v|, per s", momentum_drift(measures)[0], 1e-5)


def test_angular_momentum_is_conserved_among_all_shapes():
    holds("no statics: angular momentum, relative", momentum_drift(few_worlds()["no statics"])[1], 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", classes(MANY_BOUNDS))
def test_many_worlds_keep_the_laws(name):
    batches = [measure(LARGE, [RECIPES[name]], MANY, first=k * MANY)[0] for k in range(BATCHES)]
    check_laws(name, batches, MANY_BOUNDS[name], RARELY)


@pytest.mark.slow
@pytest.mark.parametrize("name", classes(EXTREME_BOUNDS))
def test_worlds_keep_the_laws_where_obstacles_stop_bodies_that_heavy_ones_crush(name):
    numbers = rules(extreme_mass_ratios=True)
    batches = [measure(LARGE, [RECIPES[name]], MANY, first=k * MANY, params=numbers)[0] for k in range(2)]
    check_laws(name, batches, EXTREME_BOUNDS[name], RARELY)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("passes", "name"),
    [
        pytest.param(passes, *of.values, marks=of.marks)
        for passes, table in PASSES_BOUNDS.items()
        for of in classes(table)
    ],
)
def test_worlds_keep_the_laws_with_so_many_relaxing_passes(name, passes):
    numbers = rules(relax_iterations=passes)
    batches = [measure(LARGE, [RECIPES[name]], MANY, first=k * MANY, params=numbers)[0] for k in range(4)]
    check_laws(name, batches, PASSES_BOUNDS[passes][name], RARELY)


ONE_PASS: dict[str, Any] = {"relax_iterations": 1}
CRUSHED: dict[str, Any] = {"extreme_mass_ratios": True}
BY_RATIO = {  # largest share of worlds with an overlap, with mass ratios up to 10 and 100; 0 where there is none
    "discs, one pass": (ONE_PASS, (0.02, 0.16)),
    "discs": ({}, (0.0, 0.06)),
    "discs, extreme mass ratios": (CRUSHED, (0.0, 0.0)),
    "all shapes, one pass": (ONE_PASS, (0.12, 0.25)),
    "all shapes": ({}, (0.03, 0.1)),
    "all shapes, extreme mass ratios": (CRUSHED, (0.0, 0.04)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [case(name, bounds) for name, (_, bounds) in BY_RATIO.items()])
def test_overlaps_are_as_rare_as_the_mass_ratio_allows(name):
    changes, bounds = BY_RATIO[name]
    base = RECIPES["discs, mass ratios up to 1e6" if name.startswith("discs") else "mass ratios up to 1e6"]
    recipes = [replace(base, density=decades / 2) for decades in (1, 2)]
    numbers = rules(**changes)
    parts = [measure(LARGE, recipes, MANY, first=k * MANY, params=numbers) for k in range(2)]
    for ratio, bound, *of in zip((10, 100), bounds, *parts, strict=True):
        overlap = np.concatenate([m.overlap for m in of]) > DEEP
        law = f"{name}, mass ratios up to {ratio}: share of {len(overlap)} {OVERLAPPING}"
        holds(law, overlap.any(1).mean(), bound, 0.0 if bound else None)


@pytest.mark.slow
def test_angular_momentum_is_conserved_with_several_relaxing_passes():
    (measures,) = measure(SMALL, [NO_STATICS], MANY, params=rules(relax_iterations=4))
    holds("no statics, 4 passes: momentum, per s; angular momentum", momentum_drift(measures), 1e-5)


@pytest.mark.slow
def test_a_light_body_in_a_corner_does_not_throw_the_heavy_one_that_crushes_it():
    """A capsule of a thousandth of the mass: the impulses that it carries grew by half in each step."""
    (of,) = measure(LARGE, [RECIPES["fast, mass ratios up to 1e6, e = 0.5"]], 1, first=75)
    holds("heavy polygon on a light capsule in a corner: energy gained in a step, relative", of.gain_in_step, 1e-3)


@pytest.mark.slow
def test_a_light_body_that_a_heavy_one_presses_onto_a_third_does_not_bounce():
    """What the contact at rest adds in a step counted as an impact on the third, harder in each step."""
    (of,) = measure(LARGE, [RECIPES["all shapes"]], 1, first=543)
    holds("heavy disc that presses a light capsule onto a polygon: energy gained in a step", of.gain_in_step, 1e-3)


@pytest.mark.slow
def test_a_disc_that_strikes_a_light_body_on_two_hinges_far_from_its_centre_leaves_it_whole():
    """Without the hinges the blow turns the body by more than a radian in the step, where they were solved."""
    (of,) = measure(LARGE, [RECIPES["joints, with gravity"]], 1, first=289)
    assert of.finite.all()
    holds("blow on a hinged body: energy above that at the start", of.gain, 0.02)


@pytest.mark.slow
def test_discs_that_move_by_half_a_radius_in_a_step_do_not_overlap():
    parts = [measure(LARGE, [HALF_A_RADIUS], MANY, first=k * MANY)[0].overlap for k in range(BATCHES)]
    holds("overlap of discs that move by half a radius in a step, over the radius", np.maximum(parts, 0) / 0.45, 0.1)


OPTIONS = {
    "long steps, damping, means": rules(1 / 60, damping=0.5, mixing="mean"),
    "stiff contacts, high threshold, maxima": rules(
        hertz=60.0, damping_ratio=1.0, push_speed=30.0, bounce_threshold=1.0, mixing="max"
    ),
    "short steps, soft contacts, geometric means": rules(1 / 960, hertz=5.0, push_speed=0.1, mixing="geometric"),
}
OPTION_BOUNDS: dict[str, Bounds] = {
    "long steps, damping, means": {OVERLAPPING: 0.05},
    "stiff contacts, high threshold, maxima": {RISING: 0.2},
    "short steps, soft contacts, geometric means": {RISING: None},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", classes(OPTION_BOUNDS))
def test_worlds_keep_the_laws_with_other_options(name):
    arena = Arena(discs=4, capsules=0, polygons=2, corners=4)
    recipe = Recipe(discs=(4, 4), polygons=(2, 2), fixed=0)
    check_laws(name, measure(arena, [recipe], 2 * MANY, params=OPTIONS[name]), OPTION_BOUNDS[name], RARELY)
