"""What comes to rest stays at rest, nothing passes through anything, and joints of segments are not felt.

Stacks, a full bin, mass on mass, a groove, collinear segments (C17 to C19) and shots at up to 500 m/s.
"""

import functools
import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from laws import DOWN, FAR, FLOOR, GRAVITY, POSES, QUARTERS, Case, holds, overlaps, pose_world, watch
from worlds import STEP, rotate, run

from gen2d.physics.collision import Shape, edge_normals
from gen2d.physics.constraint import Motion
from gen2d.physics.shapes import BodyShape, CapsuleShape, DiscShape, PolygonShape, to_world
from gen2d.physics.tunnelling import barriers_of, clamp_displacement

RADIUS = 0.5  # m
SLOP = 0.005  # m


def wall(x: float, height: float = 60.0) -> dict:
    """A smooth upright wall."""
    return {"a": (x, -1.0), "b": (x, height), "elasticity": 1.0, "friction": 0.0}


def rest_measures(case: Case, slots: int, settle: int, walls: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Overlap in m, way in m and speed in m/s over the 10 s after `settle` s, at most, by pose; the bodies upright and
    mirrored, at 60 frames per s.

    A disc on the floor counts by what it slides: nothing ends the rolling of one that no other disc presses.
    """
    worlds = [pose_world(case, pose, slots, walls) for pose in (QUARTERS[0], POSES[4])]
    made = run(worlds, 60 * (settle + 10) + 1, 4)
    states, count = made.states, len(case.discs)
    position, velocity, angle, spin = (
        np.asarray(a, float)[:, 60 * settle :, :count]
        for a in (states.position, states.velocity, states.angle, states.angular_velocity)
    )
    moved, turned = (a - a[:, :1] for a in (position, angle))
    radius = np.array([disc.get("radius", RADIUS) for disc in case.discs])
    on_floor = np.abs(position[..., 1] - radius) < SLOP
    moved[..., 0] += np.where(on_floor, radius * turned, 0.0)
    velocity[..., 0] += np.where(on_floor, radius * spin, 0.0)
    way = np.linalg.norm(moved, axis=-1)
    speed = np.linalg.norm(velocity, axis=-1)
    depth = [overlaps(one, x) for one, x in zip(worlds, states.position[:, 60 * settle :], strict=True)]
    return np.max(depth, axis=1), way.max((1, 2)), speed.max((1, 2))


# Rest ---------------------------------------------------------------------------------------------------------------


def test_one_disc_rests():
    made = watch([Case([{"x": (0, RADIUS), "elasticity": e, "friction": 0.5}], [FLOOR], DOWN) for e in (0, 0.5)], 2401)
    holds("Rest: one disc, way in 10 s, m", made.x[..., 0, :] - [0, RADIUS], 1e-3)
    holds("Rest: one disc, speed, m/s", made.v[..., 0, :], 1e-3)


def test_a_disc_a_hair_above_a_floor_comes_to_rest_on_it():
    made = watch([Case([{"x": (0, RADIUS + gap), "elasticity": 0}], [FLOOR], DOWN) for gap in (1e-4, 1e-3)])
    holds("Rest: a hair above the floor, height in the end, m", made.x[:, :, -1, 0, 1] - RADIUS, 1e-4)


def test_column_of_ten_in_a_channel_rests():
    discs = [{"x": (0, RADIUS * (1 + 2 * k)), "elasticity": 0.5, "friction": 0.5} for k in range(10)]
    case = Case(discs, [FLOOR, wall(-RADIUS), wall(RADIUS)], DOWN)
    depth, way, speed = rest_measures(case, 16, settle=5)
    holds("Rest: column of 10, overlap, m", np.maximum(depth, 0), 3e-4)
    holds("Rest: column of 10, way in 10 s, m", way, 1e-3)
    holds("Rest: column of 10, speed, m/s", speed, 1e-3)


@pytest.mark.full
def test_zigzag_channel_of_sixteen_rests():
    """Smooth discs in a channel 1.6 diameters wide press against both walls: the hardest to carry.

    Pushed together at the start by 2 mm, they take half a minute to part.
    """
    width = 1.6 * 2 * RADIUS
    side, rise = width / 2 - RADIUS, np.sqrt((2 * RADIUS) ** 2 - (width - 2 * RADIUS) ** 2)
    discs = [{"x": ((-1) ** k * side, RADIUS + k * rise), "elasticity": 0} for k in range(16)]
    case = Case(discs, [FLOOR, wall(-width / 2), wall(width / 2)], DOWN)
    depth, way, speed = rest_measures(case, 16, settle=30)
    holds("Rest: zigzag channel of 16, overlap, m", np.maximum(depth, 0), 5e-4)
    holds("Rest: zigzag channel of 16, way in 10 s, m", way, 1e-3)
    holds("Rest: zigzag channel of 16, speed, m/s", speed, 1e-3)


@pytest.mark.full
def test_walled_pyramid_of_six_rows_rests():
    rows = 6
    places = [(k - (n - 1) / 2, 0.5 + (rows - n) * np.sqrt(0.75)) for n in range(rows, 0, -1) for k in range(n)]
    discs = [{"x": x, "elasticity": 0, "friction": np.sqrt(0.5)} for x in places]
    case = Case(discs, [{**FLOOR, "friction": np.sqrt(0.5)}, wall(-rows / 2), wall(rows / 2)], DOWN)
    depth, way, speed = rest_measures(case, 22, settle=5)
    holds("Rest: pyramid of 6 rows, overlap, m", np.maximum(depth, 0), 3e-4)
    holds("Rest: pyramid of 6 rows, way in 10 s, m", way, 1e-3)
    holds("Rest: pyramid of 6 rows, speed, m/s", speed, 1e-3)


def bin_of(count: int, width: float) -> Case:
    """Discs of four sizes that fall into a bin."""
    rng, across = np.random.default_rng(1), int(width)
    discs = [
        {
            "x": (k % across - (across - 1) / 2 + rng.uniform(-0.05, 0.05), 1 + 1.1 * (k // across)),
            "radius": (0.3, 0.35, 0.4, 0.45)[rng.integers(4)],
            "elasticity": 0.2,
            "friction": np.sqrt(0.5),
        }
        for k in range(count)
    ]
    sides = [{**wall(s * width / 2), "friction": np.sqrt(0.5)} for s in (-1, 1)]
    return Case(discs, [{**FLOOR, "friction": np.sqrt(0.5)}, *sides], DOWN)


@pytest.mark.parametrize(
    ("count", "width", "settle"), [(32, 6.0, 15), pytest.param(64, 8.0, 40, marks=pytest.mark.slow)]
)
def test_full_bin_rests(count, width, settle):
    depth, way, speed = rest_measures(bin_of(count, width), count, settle)
    holds(f"Rest: bin of {count}, overlap, m", np.maximum(depth, 0), 5e-4)
    holds(f"Rest: bin of {count}, speed, m/s", speed, 1e-3)
    holds(f"Rest: bin of {count}, way in 10 s, m", way, 1e-3)


@pytest.mark.full
def test_bowl_of_the_article_rests():
    """Demonstration D4: three segments, five discs of 1 m that fall into the bowl."""
    segments = [{"a": (-4, 4), "b": (0, 0)}, {"a": (0, 0), "b": (4, 0)}, {"a": (4, 0), "b": (8, 4)}]
    bowl = [
        {"a": np.add(s["a"], (0, 2)), "b": np.add(s["b"], (0, 2)), "elasticity": 0.5, "friction": 1} for s in segments
    ]
    places = [(2, 2 + 2), (4, 3 + 2), (3, 6 + 2), (6, 5 + 2), (5, 7 + 2)]
    discs = [{"x": x, "radius": 1, "mass": 1, "moment": 0.5, "elasticity": 0.5, "friction": 0.2} for x in places]
    depth, way, speed = rest_measures(Case(discs, bowl, DOWN), 8, settle=30)
    holds("Rest: bowl of the article, overlap, m", np.maximum(depth, 0), 5e-4)
    holds("Rest: bowl of the article, way in 10 s, m", way, 1e-3)
    holds("Rest: bowl of the article, speed, m/s", speed, 1e-3)


@pytest.mark.parametrize(("ratio", "bound"), [(10, 5e-4), (100, 5e-3)])
def test_heavy_disc_rests_on_a_light_one(ratio, bound):
    discs = [{"x": (0, RADIUS), "mass": 1}, {"x": (0, 3 * RADIUS), "mass": ratio}]
    for name, first, second in (("heavy on light", *discs), ("light on heavy", *discs[::-1])):
        pair = [{**first, "x": discs[0]["x"]}, {**second, "x": discs[1]["x"]}]
        pair = [{**d, "elasticity": 0, "friction": 0.5} for d in pair]
        depth, way, speed = rest_measures(Case(pair, [FLOOR, wall(-RADIUS), wall(RADIUS)], DOWN), 8, settle=10)
        holds(f"Mass ratio {ratio}, {name}: overlap, m", np.maximum(depth, 0), bound)
        holds(f"Mass ratio {ratio}, {name}: way in 10 s, m", way, 1e-3)
        holds(f"Mass ratio {ratio}, {name}: speed, m/s", speed, 1e-3)


# Grooves and joints -------------------------------------------------------------------------------------------------


def test_c17_disc_rests_in_a_v_groove_without_swinging():
    groove = [{"a": (0, 0), "b": rotate((50, 0), d), "elasticity": 1, "friction": 1} for d in (45, 135)]
    disc = {"x": (0, RADIUS * np.sqrt(2))}
    cases = [Case([{**disc, "elasticity": e, "friction": mu}], groove, DOWN) for e in (0, 0.5, 1) for mu in (0, 0.5)]
    made = watch(cases)
    holds("C17 V-groove: way in 3 s, m", made.x[..., 0, :] - disc["x"], 1e-3)
    holds("C17 V-groove: speed, m/s", made.v[..., 0, :], 1e-3)
    holds("C17 V-groove: rim speed, m/s", made.spin[..., 0] * RADIUS, 1e-3)
    holds("C17 V-groove: speed after 0.5 s, m/s", made.v[..., 120:, 0, :], 1e-4)


def floor_of_segments(pieces: int, length: float) -> list[dict]:
    """A floor from -length / 2 to length / 2 in collinear pieces; an even number has a joint at 0."""
    ends = np.linspace(-length / 2, length / 2, pieces + 1)
    return [{**FLOOR, "a": (a, 0), "b": (b, 0)} for a, b in itertools.pairwise(ends)]


OFFSETS = np.array([0, 0.01, -0.01, 0.1, -0.1, 0.25, -0.25]) * RADIUS
ELASTICITIES, PIECES = (0.0, 0.5, 1.0), (1, 2, 8)
DROP = 1.0  # m


@functools.cache
def drop_on_joints() -> tuple[np.ndarray, np.ndarray]:
    """Places and velocities, [elasticity, pieces, offset, pose, frame, 2], of a disc that falls 1 m on a floor."""
    cases = [
        Case([{"x": (x, RADIUS + DROP), "elasticity": e, "friction": 0.5}], floor_of_segments(pieces, 8.0), DOWN)
        for e in ELASTICITIES
        for pieces in PIECES
        for x in OFFSETS
    ]
    made = watch(cases, 241, walls=16)
    shape = (len(ELASTICITIES), len(PIECES), len(OFFSETS), *made.x.shape[1:3], 2)
    return made.x[..., 0, :].reshape(shape), made.v[..., 0, :].reshape(shape)


@pytest.mark.full
@pytest.mark.parametrize("pieces", PIECES)
@pytest.mark.parametrize("elasticity", ELASTICITIES)
def test_c18_disc_dropped_on_a_joint_moves_as_on_one_segment(elasticity, pieces):
    """The article's disc fell through, or rebounded at 2.1 times the speed."""
    x, v = (a[ELASTICITIES.index(elasticity)] for a in drop_on_joints())
    case = f"C18 {pieces} pieces, e = {elasticity:g}"
    arrival = np.sqrt(2 * DROP * GRAVITY)
    frame = round(arrival / GRAVITY / STEP) + 2
    since = frame * STEP - arrival / GRAVITY
    left = v[PIECES.index(pieces), :, :, frame, 1] + GRAVITY * since * (elasticity > 0)
    holds(f"{case}: ratio of speeds", left / arrival - elasticity, 1e-3)
    holds(f"{case}: against one segment, 1 s, m", x[PIECES.index(pieces)] - x[0], 1e-4)


@pytest.mark.full
def test_c19_disc_rolls_over_joints_without_feeling_them():
    u = 3.0
    disc = {"x": (-4.5, RADIUS), "v": (u, 0), "spin": -u / RADIUS, "elasticity": 0, "friction": 0.5}
    made = watch([Case([{**disc, "elasticity": e}], floor_of_segments(16, 11.2), DOWN) for e in (0, 0.5)], walls=16)
    holds("C19 rolling over joints: height, m", made.x[..., 0, 1] - RADIUS, SLOP)
    holds("C19 rolling over joints: speed along, m/s", made.v[..., 0, 0] - u, 1e-4)
    holds("C19 rolling over joints: speed up, m/s", made.v[..., 0, 1], 1e-4)
    holds("C19 rolling over joints: rim speed, m/s", made.spin[..., 0] * RADIUS + u, 1e-4)


# No tunnelling ------------------------------------------------------------------------------------------------------

SPEEDS, SIZES, PHASES = (5.0, 50.0, 500.0), (0.05, 0.25, 1.0), range(16)
SHOTS = [(r, v, STEP * phase / 16, e) for r in SIZES for v in SPEEDS for phase in PHASES for e in (0, 1)]


def shot_positions(shots: list[Case]) -> np.ndarray:
    """Positions of the discs, [shot, turn, frame, slot, 2], in the frame of the shots; every step of 0.5 s, 4 turns."""
    found = []
    for k in range(0, len(shots), len(SHOTS)):  # one size of batch, one program
        worlds = [pose_world(case, turn, 2, 2) for turn in QUARTERS for case in shots[k : k + len(SHOTS)]]
        made = np.asarray(run(worlds, 121, 1).states.position, float)[:, :, :2].reshape(4, len(SHOTS), 121, 2, 2)
        found.append(np.stack([x @ turn for x, turn in zip(made, QUARTERS, strict=True)], axis=1))
    return np.concatenate(found)


def shots_at(segments: list[dict], aims: list[float]) -> list[Case]:
    """Discs that fly along +x at the origin, or as many radii beside it, and get there at all phases of a step."""
    return [
        Case([{"x": (-2 * r - v * (STEP + late), y * r), "v": (v, 0), "radius": r, "elasticity": e}], segments)
        for y in aims
        for r, v, late, e in SHOTS
    ]


def assert_none(crossed: Any) -> None:
    """Asserts that no shot, [shot, turn], has crossed; the message tells sizes and speeds of those that have."""
    bad = np.resize(np.array(SHOTS), (len(crossed), 4))[crossed.any(1)]
    kinds = sorted({(float(r), float(v)) for r, v, *_ in bad})
    assert not len(bad), f"{len(bad)} of {len(crossed)} shots crossed; (radius, speed) in {kinds}"


def test_no_disc_passes_a_segment():
    x = shot_positions(shots_at([{"a": (0, -5), "b": (0, 5)}], [0.01]))
    assert_none((x[..., 0, 0] >= 0).any(2))


def test_no_disc_passes_a_segment_near_its_end():
    x = shot_positions(shots_at([{"a": (0, -5), "b": (0, 0)}], [-0.01, -0.5]))[..., 0, :]
    assert_none(((x[:, :, 1:, 0] >= 0) & (x[:, :, :-1, 0] < 0) & (x[:, :, 1:, 1] <= 0)).any(2))


def test_no_disc_passes_an_end_cap():
    """Along the segment, head on: it is thrown back or stopped."""
    x = shot_positions(shots_at([{"a": (0, 0), "b": (20, 0)}], [0]))
    assert_none((x[..., 0, 0] >= 0).any(2))


@pytest.mark.parametrize("half", [15, 45, 80])
def test_no_disc_leaves_a_wedge_through_its_corner(half):
    """Two segments that meet at 0 and open towards -x, at `half` degrees each to the axis."""
    walls = [{"a": (0, 0), "b": rotate((-400, 0), side * half)} for side in (-1, 1)]
    away = 1.5 / np.sin(np.radians(half))
    shots = [
        Case([{"x": (-away * r - v * late, y * r), "v": (v, 0), "radius": r, "elasticity": e}], walls)
        for y in (0, 0.3)
        for r, v, late, e in SHOTS
    ]
    x = shot_positions(shots)[..., 0, :]
    sin, cos = np.sin(np.radians(half)), np.cos(np.radians(half))
    assert_none((-sin * x[..., 0] <= cos * np.abs(x[..., 1])).any(2))


@pytest.mark.parametrize("mass", [1, 100])
def test_no_disc_passes_a_disc(mass):
    """Head on: the order along x is kept."""
    shots = [
        Case([{"x": (-2 * r - v * (STEP + late), 0), "v": (v, 0), "radius": r, "elasticity": e, "mass": mass},
              {"x": (2 * r, 0), "v": (-v / 2, 0), "radius": r, "elasticity": e, "mass": 1}])
        for r, v, late, e in SHOTS
    ]  # fmt: skip
    x = shot_positions(shots)
    assert_none((x[..., 1, 0] <= x[..., 0, 0]).any(2))


def test_a_disc_that_is_hit_meets_the_wall_that_it_reaches_in_the_same_step():
    """Neither the disc nor the wall is near when the step begins, as seen from the disc alone, which is at rest."""
    shots = [
        Case(
            [{"x": (-1.01 - v * STEP / 8, 0), "v": (v, 0)}, {"x": (0, 0)}],
            [{"a": (0.5 + room, -5), "b": (0.5 + room, 5)}],
        )
        for v in (20.0, 60.0)
        for room in (0.01, 0.03)
    ]
    made = watch(shots)
    room = np.array([0.01, 0.03] * 2)[:, None, None]
    holds("Disc hit towards a wall: overlap with it, m", np.maximum(made.x[:, :, :, 1, 0] - room, 0), 1e-3)


def test_far_things_are_far():
    """The segments that fill up a case are out of reach of every fall here."""
    assert GRAVITY * 10**2 / 2 < FAR


NONE_PASSES = [np.zeros((1, 1), bool)]  # which bodies a barrier does not stop


def clamped(shape: Shape, displacement: tuple[float, float], spin: float, barrier: Shape) -> np.ndarray:
    """Displacement [2] in m of a body beside a static one."""
    moved = Motion(jnp.asarray(displacement, float).reshape(2, 1, 1), jnp.full((1, 1), spin))
    (new,) = clamp_displacement([moved], [shape], barriers_of(barrier, jnp.ones((1, 1), bool), NONE_PASSES))
    return np.asarray(new.velocity)[:, 0, 0]


def shape_at(shape: BodyShape, x: float, y: float) -> Shape:
    return to_world(shape, jnp.asarray((x, y), float).reshape(2, 1, 1), jnp.zeros((1, 1)))


def box(width: float, height: float) -> PolygonShape:
    corners = [(-width, -height), (width, -height), (width, height), (-width, height)]
    vertices = tuple(jnp.asarray(corner).reshape(2, 1, 1) / 2 for corner in corners)
    return PolygonShape(vertices, edge_normals(vertices), jnp.zeros((1, 1)))


CAPSULE = CapsuleShape(jnp.full((1, 1), 0.5), jnp.full((1, 1), 0.1))
BODIES = {"disc": DiscShape(jnp.full((1, 1), 0.1)), "capsule": CAPSULE, "box": box(1.0, 0.4)}
FLOORS = {
    "segment": shape_at(CapsuleShape(jnp.full((1, 1), 5.0), jnp.zeros((1, 1))), 0, 0),
    "polygon": shape_at(box(10.0, 2.0), 0, -1),
}


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("body", BODIES)
def test_no_displacement_takes_a_body_through_a_floor(body, floor):
    for y, spin, down in itertools.product((0.7, 1.5, 3.0), (0.0, 0.4), (1.0, 4.0, 50.0)):
        _, moved = clamped(shape_at(BODIES[body], 0, y), (0, -down), spin, FLOORS[floor])
        assert y + moved > 0
        if down < y - 0.7:  # does not get there
            assert moved == -down
    far = clamped(shape_at(BODIES[body], 8, 1), (0, -50), 0.0, FLOORS[floor])
    assert far[1] == -50  # beside the floor


def test_the_end_of_a_capsule_does_not_turn_through_a_floor():
    capsule = shape_at(CAPSULE, 0, 0.3)
    turned = Motion(jnp.zeros((2, 1, 1)), jnp.full((1, 1), 1.5))
    (new,) = clamp_displacement(
        [turned], [capsule], barriers_of(FLOORS["segment"], jnp.ones((1, 1), bool), NONE_PASSES)
    )
    assert 0.3 - 0.5 * np.sin(new.spin.item()) > 0


def test_the_end_of_a_capsule_that_is_through_a_floor_comes_back():
    """It stayed there for good: the end outside was stopped on its way in, and the end inside on its way out."""
    upright = to_world(CAPSULE, jnp.asarray((0.0, 0.3)).reshape(2, 1, 1), jnp.full((1, 1), np.pi / 2))
    for way in (0.1, -0.1):  # one end is at .8, one at -.2
        moved = clamped(upright, (0, way), 0.0, FLOORS["segment"])
        assert moved[1] == pytest.approx(max(way, 0.0))


def test_a_body_may_leave_a_polygon():
    assert clamped(shape_at(BODIES["disc"], 0, -0.3), (0, 3), 0.0, FLOORS["polygon"])[1] == 3


SHORT = {
    "segment": CapsuleShape(jnp.full((1, 1), 0.5), jnp.zeros((1, 1))),
    "polygon": box(1.0, 0.4),
    "rounded polygon": box(1.0, 0.4)._replace(radius=jnp.full((1, 1), 0.05)),
}


@pytest.mark.parametrize("barrier", SHORT)
@pytest.mark.parametrize("ends", [1, 2])
def test_a_body_that_passes_a_corner_is_not_held(barrier, ends):
    """A capsule hung in the air beside the corner of a box: its end had crossed the line of a side, not the side."""
    rng, count, radius = np.random.default_rng(0), 20000, 0.1
    start, moved = rng.uniform(-1, 1, (2, 1, count)), rng.uniform(-0.3, 0.3, (2, 1, count)).astype(np.float32)
    one, static = jnp.ones((1, count)), to_world(SHORT[barrier], jnp.zeros((2, 1, 1)), jnp.zeros((1, 1)))
    disc, capsule = DiscShape(radius * one), CapsuleShape(0.2 * one, radius * one)
    angle = rng.uniform(0, np.pi, (1, count))
    body = to_world(disc if ends == 1 else capsule, jnp.asarray(start), jnp.asarray(angle))
    (new,) = clamp_displacement(
        [Motion(jnp.asarray(moved), 0 * one)], [body], barriers_of(static, one[:, :1] > 0, NONE_PASSES)
    )
    arm = 0.0 if ends == 1 else 0.2 * np.stack([np.cos(angle), np.sin(angle)])
    height, skin = (0.0 if barrier == "segment" else 0.2), (0.05 if barrier == "rounded polygon" else 0.0)
    free = np.ones(count, bool)
    for part, side in itertools.product(np.linspace(0, 1, 101), np.linspace(-1, 1, 9)):
        x, y = np.abs(start + part * moved + side * arm)[:, 0]
        free &= np.hypot(np.maximum(x - 0.5, 0), np.maximum(y - height, 0)) > radius + skin + 1e-3
    assert 1000 < free.sum() < count - 1000
    kept = (np.asarray(new.velocity) == moved).all(0)
    assert kept[:, free].all()
    assert not kept.all()  # some others are held
