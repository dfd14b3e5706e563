"""The solver's two forms: what is near is found, each pair once, and solving only that changes nothing."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import holds
from worlds import STEP, box, rules, run, world

from gen2d.core.enums import IMPACT
from gen2d.physics.broad_phase import (
    active_pairs,
    bits_in_round_robin,
    bits_of,
    bounding_radius,
    round_robin_of,
    row_lookup,
    signed_distance,
)
from gen2d.physics.collision import Disc, Hull, Stadium, edge_normals, hull_at
from gen2d.physics.schedule import Match, matches, pairings
from gen2d.physics.simulate import SaveAt, simulate
from gen2d.records import axes, trajectory
from gen2d.records import scene as scene_module
from gen2d.space.space import Space

EVERYTHING = SaveAt(contacts=300, energy=True)


def gas(seed: int, discs: int, **more: float) -> tuple:
    """Discs that fly, fall and bounce in a box."""
    rng, columns = np.random.default_rng(seed), int(np.ceil(np.sqrt(discs)))
    side = 2.2 * columns
    cells = [((i + 0.5) * side / columns, (j + 0.5) * side / columns) for i in range(columns) for j in range(columns)]
    rows = [
        {"x": x, "v": rng.normal(0, 3, 2), "radius": rng.uniform(0.5, 1), "elasticity": 0.7, "friction": 0.3, **more}
        for x in cells[:discs]
    ]
    return world(rows, box(side, 0.9, 0.2, (side / 2, side / 2)), (0, -9.81))


def assert_alike(ours: trajectory.Trajectory, theirs: trajectory.Trajectory, within: float) -> None:
    """Both trajectories are the same but for what grows out of rounding."""
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True):
        name = jax.tree_util.keystr(path)
        if np.issubdtype(a.dtype, np.integer):
            np.testing.assert_array_equal(a, b, name)
        else:
            np.testing.assert_allclose(a, b, rtol=within, atol=within, err_msg=name)


def test_both_forms_give_the_same_discs():
    worlds = [gas(seed, 5, rolling=0.05, torque=0.1) for seed in range(3)]
    made = [run(worlds, 41, 4, keep=EVERYTHING, sparse=sparse) for sparse in (True, False)]
    assert made[0].contacts.count.min() > 0
    assert_alike(*made, within=2e-3)


@pytest.mark.full
def test_both_forms_give_the_same_impacts_in_the_order_of_their_times():
    worlds = [gas(seed, 5) for seed in range(3)]
    made = [run(worlds, 41, 4, rules(by_time=True), EVERYTHING, sparse=sparse) for sparse in (True, False)]
    assert made[0].contacts.count.min() > 0
    assert_alike(*made, within=2e-3)


def test_both_forms_give_the_same_loads_on_a_disc_that_two_walls_bear():
    """A disc of a twelfth of the mass of the one on it bears it in a valley; both walls add to what bears it."""
    walls = [{"a": (-9.0, 9.0), "b": (0.0, 0.0)}, {"a": (0.0, 0.0), "b": (9.0, 9.0)}]
    low, high = 0.5 * math.sqrt(2), 0.5 * math.sqrt(2) + 1.0
    rows = [{"x": (0, low), "radius": 0.5, "mass": 1.0}, {"x": (0, high), "radius": 0.5, "mass": 12.0}]
    worlds = [world(rows, walls, (side, -9.81)) for side in (0.0, 0.4)]
    both = [run(worlds, 21, 4, keep=EVERYTHING, sparse=sparse) for sparse in (True, False)]
    assert both[0].contacts.count.min() >= 3
    assert_alike(*both, within=2e-4)


def velocities_in_a_step(rows: list[dict], walls: list[dict]) -> np.ndarray:
    """Velocities [solver, order, step, disc, 2] in the first steps, of discs in all orders, by both solvers."""
    orders = [list(order) for order in itertools.permutations(range(len(rows)))]
    worlds = [world([rows[k] for k in order], walls) for order in orders]
    both = [run(worlds, 3, 1, rules(by_time=True), sparse=sparse).states.velocity for sparse in (True, False)]
    return np.array([[v[k, 1:, np.argsort(order)] for k, order in enumerate(orders)] for v in both]).swapaxes(2, 3)


@pytest.mark.full
def test_discs_that_strike_one_into_a_corner_in_a_step_are_struck_back_in_it():
    """Two of the three wait behind the first, along the diagonal; it meets both walls at one time."""
    gap, speed = 0.01, 60.0  # m; m/s along each axis
    places = [-0.5 - gap - k * (math.sqrt(0.5) + 2 * gap) for k in range(3)]
    rows = [{"x": (place, place)} for place in places]
    walls = [{"a": (-9.0, 0.0), "b": (0.0, 0.0)}, {"a": (0.0, -9.0), "b": (0.0, 0.0)}]
    found = velocities_in_a_step([*rows[:2], rows[2] | {"v": (speed, speed)}], walls)
    holds("struck into a corner: velocities, m/s", found - [(0, 0), (0, 0), (-speed, -speed)], 1e-3)


def test_an_impact_that_waits_for_one_that_does_not_happen_acts():
    """The first disc would graze the third, which the fourth strikes out of its way, and then strikes the second."""
    speed, h = 60.0, 1 / 240
    normal = np.array([math.cos(math.radians(10)), math.sin(math.radians(10))])
    third = np.array([0.3 * speed * h + math.sqrt(1 - 0.995**2), 0.995])
    rows = [
        {"x": (0, 0), "v": (speed, 0)},
        {"x": (1 + 0.5 * speed * h, 0)},
        {"x": tuple(third)},
        {"x": tuple(third - (1 + 0.1 * speed * h) * normal), "v": tuple(speed * normal)},
    ]
    found = velocities_in_a_step(rows, [])
    exact = [(0, 0), (speed, 0), speed * normal, (0, 0)]
    holds("impact that waits for another one: velocities, m/s", found[:, :, 0] - exact, 1e-3)


@pytest.mark.full
def test_relaxing_passes_pass_a_blow_on_through_a_row_of_discs():
    """Six touching discs, in several orders of their slots: without elasticity all move on, with it the last one."""
    count, speed = 6, 6.0  # m/s
    orders = [np.random.default_rng(seed).permutation(count) for seed in range(8)]
    elasticities = [0.0] * len(orders) + [1.0] * len(orders)
    places = [np.argsort(order) for order in 2 * orders]
    worlds = []
    for order, elasticity in zip(2 * orders, elasticities, strict=True):
        row = [{"x": (0.9999 * k, 0), "v": (speed * (k == 0), 0), "elasticity": elasticity} for k in order]
        worlds.append(world(row))
    both = [run(worlds, 31, 1, rules(relax_iterations=32), EVERYTHING, sparse=sparse) for sparse in (True, False)]
    assert_alike(*both, within=1e-5)
    velocity = np.array([v[:, place, 0] for v, place in zip(both[0].states.velocity, places, strict=True)])
    holds("Row that a disc strikes, e = 0: departure from one speed, relative", velocity[:8, 1] - 1, 0.02)
    holds("Row that a disc strikes, e = 1: speeds at the end, m/s", velocity[8:, -1] - [0, 0, 0, 0, 0, speed], 1e-4)


def exact_column(heights: list[float], speeds: list[float], elasticity: float, time: float) -> tuple[list, list]:
    """Heights above the last contact and upward speeds of a disc over another one over a floor, one impact at a time.

    The first height is that above the lower disc.
    """
    gaps, (upper, lower), left = list(heights), speeds, time
    while True:
        closing = [lower - upper, -lower]
        times = [gap / speed if speed > 0 else np.inf for gap, speed in zip(gaps, closing, strict=True)]
        first = min(*times, left)
        gaps = [gap - first * speed for gap, speed in zip(gaps, closing, strict=True)]
        left -= first
        if left <= 0:
            return gaps, [upper, lower]
        if times[0] <= times[1]:
            mean, half = (upper + lower) / 2, elasticity * (lower - upper) / 2
            upper, lower = mean + half, mean - half
        else:
            lower = -elasticity * lower


@pytest.mark.parametrize("passes", [pytest.param(8, marks=pytest.mark.full), None])
def test_relaxing_passes_find_impacts_that_others_cause_in_the_same_step(passes):
    """A disc strikes another one over a floor, and meets it again as it comes back, in the same step.

    In two of three worlds, of more than are solved at once; in the others they are too far apart.
    """
    speed, floor = -10.0, {"a": (-5, 0), "b": (5, 0)}
    cases = [((0.01 if k % 3 else 1.0, 0.004), 0.2 + 0.01 * k) for k in range(36)]  # gaps, m; elasticity
    worlds = [
        world([{"x": (0, 0.5 + gaps[1]), "elasticity": e}, {"x": (0, 1.5 + sum(gaps)), "v": (0, speed)}], [floor])
        for gaps, e in cases
    ]
    exact = [exact_column(list(gaps), [speed, 0.0], e, STEP) for gaps, e in cases]
    both = [run(worlds, 2, 1, rules(relax_iterations=passes), EVERYTHING, sparse=sparse) for sparse in (True, False)]
    assert_alike(*both, within=1e-5)
    y, v = both[0].states.position[:, 1, :2, 1], both[0].states.velocity[:, 1, :2, 1]
    found = np.stack([y[:, 1] - y[:, 0] - 1, y[:, 0] - 0.5], axis=1)
    holds("Impacts that follow each other in a step: gaps, m", found - [of for of, _ in exact], 1e-5)
    holds("Impacts that follow each other in a step: speeds, m/s", v[:, ::-1] - [of for _, of in exact], 1e-4)


@pytest.mark.parametrize("passes", [pytest.param(8, marks=pytest.mark.full), None])
def test_an_impact_that_another_one_causes_in_the_same_step_is_logged(passes):
    """A disc bounces off a floor and strikes another one above it, in the same step."""
    speed, gaps = 10.0, (0.01, 0.02)
    lower = {"x": (0, 0.5 + gaps[0]), "v": (0, -speed), "elasticity": 1.0}
    upper = {"x": (0, 1.5 + sum(gaps)), "elasticity": 1.0}
    worlds = [world([lower, upper], [{"a": (-5, 0), "b": (5, 0), "elasticity": 1.0}])]
    both = [run(worlds, 2, 1, rules(relax_iterations=passes), EVERYTHING, sparse=sparse) for sparse in (True, False)]
    assert_alike(*both, within=1e-5)
    rows = both[0].contacts
    assert rows.count[0] == 2
    assert both[0].quality.contacts[0] == 2
    assert set(rows.kind[0, :2]) == {IMPACT}
    holds("impact that a bounce causes: approach speeds, m/s", rows.approach_speed[0, :2] - speed, 1e-4)
    holds(
        "impact that a bounce causes: times, s",
        rows.time[0, :2] - [gaps[0] / speed, (gaps[1] + 2 * gaps[0]) / speed],
        1e-6,
    )
    holds("impact that a bounce causes: height of the point, m", rows.point[0, 1, 1] - (1 + sum(gaps)), 1e-5)


@pytest.mark.full
@pytest.mark.parametrize("sparse", [True, False])
def test_passes_end_in_each_scene_by_itself(sparse):
    """A disc strikes another one over a floor: with elasticity it soon flies up; without, each pass halves its speed.

    So the first scenes are solved after 4 passes, and the others take 8. A slow row of discs changes in every pass.
    """
    speed, floor = -10.0, {"a": (-5, 0), "b": (5, 0)}
    row = [{"x": (10 + 0.9999 * k, 5), "v": (0.005 * (k == 0), 0), "elasticity": 0.0} for k in (4, 2, 0, 1, 3)]
    worlds = [
        world([{"x": (0, 0.504), "elasticity": e}, {"x": (0, 1.508), "v": (0, speed), "elasticity": e}, *row], [floor])
        for e in [0.9] * 10 + [0.0] * 10
    ]
    velocities = [
        run(worlds, 2, 1, rules(relax_iterations=n), sparse=sparse).states.velocity[:, -1] for n in (4, 8, None)
    ]
    few, many, some = velocities
    assert (abs(few - many)[:, 2:7].max((1, 2)) > 1e-4).all()
    np.testing.assert_allclose(some, np.concatenate([few[:10], many[10:]]), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_both_forms_give_the_same_of_more_discs_than_a_word_has_bits():
    worlds = [gas(seed, 19) for seed in range(3)]
    made = [run(worlds, 31, 4, sparse=sparse) for sparse in (True, False)]
    assert made[0].quality.contacts.min() > 0
    assert_alike(*made, within=2e-3)


@pytest.mark.slow
def test_both_forms_give_the_same_mixture():
    """Pairs of several shapes, bodies that move as they like, a joint, and forces that depend on the state."""
    space = Space((0, -9.81))
    space.add_segment((-4, 0), (0, 0.5))
    space.add_segment((0, 0.5), (4, 0))
    space.add_box((1.5, 1), 0.8, 0.8, kind="kinematic", velocity=(-1.0, 0.0), spin=0.5)
    space.add_circle((-2, 0.6), 0.3, kind="static")
    space.add_capsule((-0.5, 1), (0.2, 1.2), 0.1)
    space.add_capsule((0.3, 1.2), (1, 1.5), 0.1)
    space.add_joint("distance", 4, 5)
    space.add_circle((-2.1, 1.5), 0.3)
    space.add_circle((0.1, 1.9), 0.3)
    scene, state, layout = space.scene()
    many = [axes.to_device(jax.tree.map(lambda x: jnp.asarray(x)[None], record)) for record in (scene, state)]

    def wind(state: scene_module.State, time: jax.Array) -> tuple:
        return jnp.stack([jnp.cos(time) - 0.1 * state.velocity[0], 0 * state.angle]), -0.1 * state.angular_velocity

    def made(sparse: bool) -> trajectory.Trajectory:
        params = rules()
        program = jax.jit(lambda a, b: simulate(a, b, layout, params, 31, 4, EVERYTHING, wind, sparse))
        return jax.tree.map(np.asarray, axes.to_stored(program(many[0], many[1])))

    ours, theirs = made(True), made(False)
    assert ours.contacts is not None
    assert ours.contacts.count.min() > 0
    assert_alike(ours, theirs, within=2e-3)


def _visited(words: np.ndarray, chunk: int) -> list[tuple[int, int, int]]:
    """Round, word and bit of all rows, in the order in which they are solved."""
    rows, found = active_pairs(jnp.asarray(words), chunk), []
    for k in range(int(rows.starts[-1])):
        spot = jax.tree.map(np.asarray, row_lookup(rows, jnp.asarray(k), chunk))
        found += [
            (int(spot.round), int(w), int(b)) for w, b in zip(spot.word[spot.there], spot.bit[spot.there], strict=True)
        ]
    return found


def test_the_schedule_has_every_pair_once_and_no_body_twice_in_a_round():
    sizes = [4, 1, 6, 2]
    met = []
    for match in matches(sizes, 2):
        if match.static:
            met.append(("static", match.first, match.second))
            continue
        a, b = pairings(sizes[match.first], sizes[match.second], match)
        assert len(a) == match.rounds
        for one, other in zip(a.tolist(), b.tolist(), strict=True):
            bodies = [(match.first, i) for i in one] + [(match.second, j) for j in other]
            assert len(set(bodies)) == len(bodies)
            met += [tuple(sorted(((match.first, i), (match.second, j)))) for i, j in zip(one, other, strict=True)]
    bodies = [(g, i) for g, size in enumerate(sizes) for i in range(size)]
    pairs = [(x, y) for k, y in enumerate(bodies) for x in bodies[:k]]
    assert sorted(map(str, met)) == sorted(map(str, [*pairs, *[("static", f, g) for f in range(2) for g in range(4)]]))


@pytest.mark.parametrize("density", [0.0, 0.01, 0.3, 1.0])
def test_every_bit_is_visited_once_and_in_order(density):
    rng = np.random.default_rng(1)
    bits = rng.random((5, 75, 16)) < density
    words = (bits * 2 ** np.arange(16)).sum(-1).astype(np.uint32)
    assert _visited(words, 16) == list(map(tuple, np.argwhere(bits).tolist()))


@pytest.mark.parametrize("count", [2, 4, 16, 18, 40])
def test_a_ring_finds_each_near_pair_once(count):
    rng, lanes = np.random.default_rng(count), 3
    centre, reach = rng.uniform(0, 5, (2, count, lanes)), rng.uniform(0.2, 0.8, (count, lanes))
    reach[0, 0] = np.nan  # is not there
    a, b = pairings(count, count, Match(0, 0, count - 1))
    ring = round_robin_of(a, b)
    words = np.asarray(bits_in_round_robin(jnp.asarray(centre), jnp.asarray(reach), ring))
    found = []
    for turn, word, bit in _visited(words, 16):
        pair = ring.pair[turn, word // lanes * 16 + bit]
        found.append((*sorted((a[turn, pair], b[turn, pair])), word % lanes))
    distance = np.hypot(*(centre[:, :, None] - centre[:, None]))
    near = np.argwhere(np.triu((distance < reach[:, None] + reach[None]).T, 1))
    assert sorted(found) == sorted((i, j, lane) for lane, i, j in near.tolist())


def test_bits_of_more_pairs_than_a_word_has():
    near = np.random.default_rng(2).random((3, 21, 4)) < 0.5
    words = np.asarray(bits_of(jnp.asarray(near))).reshape(3, 2, 4)
    back = [(words[:, p // 16] >> (p % 16)) & 1 for p in range(21)]
    np.testing.assert_array_equal(np.stack(back, axis=1), near)


def test_a_shape_is_nowhere_nearer_than_its_clearance_nor_beyond_its_circle():
    rng = np.random.default_rng(3)
    points = rng.uniform(-3, 3, (2, 400))
    square = [jnp.array([[x], [y]]) for x, y in ((-1, -0.5), (1, -0.5), (1, 0.5), (-1, 0.5))]
    zero, at = jnp.zeros(1), jnp.array([[0.3], [-0.2]])
    tilt = jnp.full(1, 0.4)
    shapes = [
        (Disc(at, jnp.full(1, 0.7)), [at[:, 0]], 0.7),
        (Stadium(at, jnp.array([[0.8], [0.6]]), jnp.ones(1), jnp.full(1, 0.2)), _along(at, 1.0), 0.2),
        (hull_at(square, edge_normals(square), at, tilt, zero), None, 0.0),
    ]
    for shape, core, radius in shapes:
        outline = _outline(shape) if core is None else np.array(core).T
        apart = np.sqrt(((points[:, :, None] - outline[:, None]) ** 2).sum(0)).min(1) - radius
        assert (np.asarray(signed_distance(shape, jnp.asarray(points))) <= apart + 1e-5).all()
        furthest = np.hypot(*(outline - np.asarray(at))).max() + radius
        assert float(bounding_radius(shape)[0]) >= furthest - 1e-5


def _along(at: jax.Array, half_length: float) -> list[np.ndarray]:
    return [np.asarray(at[:, 0]) + s * np.array([0.8, 0.6]) for s in np.linspace(-half_length, half_length, 201)]


def _outline(shape: Hull) -> np.ndarray:
    corners = [np.asarray(v)[:, 0] for v in shape.vertices]
    sides = zip(corners, [*corners[1:], corners[0]], strict=True)
    return np.array([p + t * (q - p) for p, q in sides for t in np.linspace(0, 1, 101)]).T
