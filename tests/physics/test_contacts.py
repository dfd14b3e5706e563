"""Laws of contact: the distance is the true one, the points are shared, and it does not matter from where one looks.

The reference is brute force in NumPy and float64: the nearest points of two convex cores are a corner of one and a
point on an edge of the other; cores that overlap part along an edge normal of either. A shape is a dict of corners,
position, angle and radius here, with scenes first, from which `world_shape` makes a shape of `collision`.
"""

from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from gen2d.physics.collision import (
    FAR,
    PAIRS,
    SLOP,
    Disc,
    Hull,
    ManifoldPoint,
    Stadium,
    edge_normals,
    hull_at,
    manifold,
)
from gen2d.physics.constraint import mix_materials

MANY = 2000
V = 5  # corners of a hull, some of them repeated
KINDS = {Disc: 0, Stadium: 1, Hull: 2}
EVERY_PAIR = [(a, b) for a in KINDS for b in KINDS]


@pytest.fixture(autouse=True)
def strict():
    with jax.numpy_dtype_promotion("strict"):
        yield


# Random shapes, as corners [n, V, 2], position, angle and radius ------------------------------------------------------


def shapes(kind: type, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Shapes about their own centres: corners [n, V, 2] (one, two, or three to five, the last repeated) and radii."""
    radius = rng.uniform(0.2, 0.8, MANY)
    if kind is Disc:
        return {"corners": np.zeros((MANY, 1, 2)), "radius": radius}
    if kind is Stadium:
        ends = np.array([[-1.0, 0], [1, 0]]) * rng.uniform(0.1, 1, (MANY, 1, 1))
        return {"corners": ends, "radius": np.where(rng.random(MANY) < 0.5, 0.0, radius)}
    count = rng.integers(3, V + 1, MANY)[:, None]
    turn = (np.minimum(np.arange(V), count - 1) + rng.uniform(0, 0.8, (MANY, 1))) * 2 * np.pi / count
    turn += 0.3 * np.sin(turn)  # uneven corners, still in order
    ellipse = np.stack([np.cos(turn), rng.uniform(0.2, 1, (MANY, 1)) * np.sin(turn)], -1)
    return {
        "corners": ellipse * rng.uniform(0.3, 1, (MANY, 1, 1)),
        "radius": np.where(rng.random(MANY) < 0.5, 0.0, radius / 8),
    }


@cache
def pair_of_shapes(kind_a: type, kind_b: type) -> tuple[dict, dict]:
    """Overlapping, near and (a tenth) far apart; a third of them are made to touch, by the reference."""
    rng = np.random.default_rng(1)
    a, b = (shapes(kind, rng) for kind in (kind_a, kind_b))
    for shape in (a, b):
        shape["position"] = rng.normal(size=(MANY, 2)) * np.where(np.arange(MANY) % 10 == 1, 20, 1)[:, None]
        shape["angle"] = rng.uniform(-np.pi, np.pi, MANY)
    near_a, near_b = ({name: value[::3].copy() for name, value in shape.items()} for shape in (a, b))
    for _ in range(40):  # along the line of centres, closer by what is left
        line = near_b["position"] - near_a["position"]
        near_b["position"] -= true_gap(near_a, near_b)[:, None] * line / np.linalg.norm(line, axis=-1, keepdims=True)
    b["position"][::3] = near_b["position"]
    return a, b


def world(shape: dict) -> np.ndarray:
    """The corners [n, V, 2] where they are."""
    cos, sin = np.cos(shape["angle"])[:, None], np.sin(shape["angle"])[:, None]
    x, y = np.moveaxis(shape["corners"], -1, 0)
    return shape["position"][:, None] + np.stack([cos * x - sin * y, sin * x + cos * y], -1)


def world_shape(shape: dict, dtype: type = np.float64) -> Disc | Stadium | Hull:
    """Shape in the world."""
    x = {name: jnp.moveaxis(jnp.asarray(value, dtype), 0, -1) for name, value in shape.items()}
    corners = x["corners"]
    if len(corners) == 1:
        return Disc(x["position"], x["radius"])
    if len(corners) == 2:
        way = jnp.stack([jnp.cos(x["angle"]), jnp.sin(x["angle"])])
        return Stadium(x["position"], way, corners[1, 0], x["radius"])
    return hull_at(corners, edge_normals(corners), x["position"], x["angle"], x["radius"])


# The reference --------------------------------------------------------------------------------------------------------


def nearest_apart(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The least distance [n] of a corner of p from an edge of q."""
    start, edge = q[:, None], np.roll(q, -1, axis=1)[:, None] - q[:, None]
    offset = p[:, :, None] - start
    length = (edge**2).sum(-1)
    part = np.clip((offset * edge).sum(-1) / np.where(length > 0, length, 1), 0, 1)
    return np.linalg.norm(offset - part[..., None] * edge, axis=-1).min((1, 2))


def widest_apart(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The largest separation [n] along a normal of an edge of p; none along an edge without length."""
    edge = np.roll(p, -1, axis=1) - p
    length = np.linalg.norm(edge, axis=-1, keepdims=True)
    normal = np.stack([edge[..., 1], -edge[..., 0]], -1) / np.where(length > 0, length, 1)
    reach = np.einsum("nek,nvk->nev", normal, q).min(-1) - np.einsum("nek,nvk->nev", normal, p).max(-1)
    return np.where(length[..., 0] > 0, reach, -np.inf).max(1)


def true_gap(a: dict, b: dict) -> np.ndarray:
    """The distance [n] of two shapes; negative, the depth at which they overlap."""
    p, q = world(a), world(b)
    apart = np.minimum(nearest_apart(p, q), nearest_apart(q, p))
    along = np.maximum(widest_apart(p, q), widest_apart(q, p))
    return np.where((along >= 0) | (along == -np.inf), apart, along) - a["radius"] - b["radius"]


compiled = jax.jit(manifold, compiler_options={"xla_backend_optimization_level": 0})  # LLVM takes longer than the tests


def contacts_of(a: dict, b: dict, dtype: type = np.float64):
    """The points of contact, in NumPy, as normal [points, 2, n], gap [points, n] and world points [points, 2, n] by a
    and by b."""
    with jax.enable_x64(dtype == np.float64):
        points = compiled(world_shape(a, dtype), world_shape(b, dtype))
        assert all(x.dtype == dtype for point in points for x in point)
        normal, gap, arm_a, arm_b = (np.stack(x) for x in zip(*points, strict=True))
    return normal, gap, a["position"].T + arm_a, b["position"].T + arm_b


def gradient(a: dict, b: dict, weights: tuple[ManifoldPoint, ...]) -> tuple[dict, dict]:
    """Gradient with respect to both shapes of the sum of their points times the weights; in float32."""
    a, b, weights = jax.tree.map(jnp.float32, (a, b, weights))  # not compiled, as that takes longer
    return jax.vjp(lambda a, b: manifold(world_shape(a, np.float32), world_shape(b, np.float32)), a, b)[1](weights)


def errors(a: dict, b: dict, dtype: type) -> np.ndarray:
    return np.abs(contacts_of(a, b, dtype)[1].min(0) - true_gap(a, b))


# Distance -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind_a", "kind_b"), EVERY_PAIR)
def test_the_smallest_gap_is_the_true_distance(kind_a: type, kind_b: type):
    a, b = pair_of_shapes(kind_a, kind_b)
    gap = true_gap(a, b)
    assert (gap < -0.05).mean() > 0.05
    assert (gap > 0.05).mean() > 0.05
    assert (np.abs(gap) < 1e-6).mean() > 0.25
    assert errors(a, b, np.float64).max() < 2 * SLOP  # where two features are as near as SLOP, either may be taken
    assert np.quantile(errors(a, b, np.float64), 0.99) < 1e-12


@pytest.mark.parametrize(("kind_a", "kind_b"), PAIRS)
def test_so_it_is_in_single_precision(kind_a: type, kind_b: type):
    assert errors(*pair_of_shapes(kind_a, kind_b), np.float32).max() < 3 * SLOP


def move(shape: dict, angle: float, shift: np.ndarray) -> dict:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return shape | {"position": shape["position"] @ turn.T + shift, "angle": shape["angle"] + angle}


def mirror(shape: dict) -> dict:
    """In the line x = 0, still counter-clockwise."""
    flip = np.array([-1, 1])
    corners = shape["corners"] * flip if shape["corners"].shape[1] != 2 else shape["corners"][:, ::-1] * flip
    corners = corners[:, ::-1] if shape["corners"].shape[1] > 2 else corners
    return shape | {"corners": corners, "position": shape["position"] * flip, "angle": -shape["angle"]}


@pytest.mark.parametrize(("kind_a", "kind_b"), EVERY_PAIR)
class TestFrames:
    def test_points_meet_and_normals_are_unit(self, kind_a: type, kind_b: type):
        normal, gap, by_a, by_b = contacts_of(*pair_of_shapes(kind_a, kind_b))
        assert_allclose(by_a, by_b, atol=1e-12)
        assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
        tangent = np.stack([-normal[0, 1], normal[0, 0]])
        order = ((by_a[-1] - by_a[0]) * tangent).sum(0)
        assert (order[gap.max(0) < FAR] > -1e-9).all()

    def test_a_moved_scene_gives_moved_points(self, kind_a: type, kind_b: type):
        a, b = pair_of_shapes(kind_a, kind_b)
        angle, shift = 2.1, np.array([3.0, -5])
        normal, gap, point, _ = contacts_of(a, b)
        normal_, gap_, point_, _ = contacts_of(move(a, angle, shift), move(b, angle, shift))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        assert_allclose(gap_, gap, atol=1e-11)
        assert_allclose(normal_, turn @ normal, atol=1e-6)
        assert_allclose(point_, turn @ point + shift[:, None], atol=1e-6)

    def test_swapped_shapes_give_mirrored_points(self, kind_a: type, kind_b: type):
        a, b = pair_of_shapes(kind_a, kind_b)
        same_points(contacts_of(a, b), contacts_of(b, a), lambda v: v, lambda n: -n)

    def test_a_mirrored_scene_gives_mirrored_points(self, kind_a: type, kind_b: type):
        a, b = pair_of_shapes(kind_a, kind_b)
        flip = np.array([-1, 1])[:, None]
        same_points(contacts_of(a, b), contacts_of(mirror(a), mirror(b)), lambda v: flip * v, lambda n: flip * n)


def same_points(one: tuple, other: tuple, place, way):
    """The second's tangent runs the other way, and with it the order of its points; a missing one has no place."""
    (normal, gap, point, _), (normal_, gap_, point_, _) = one, other
    missing = (gap == FAR).any(0)
    turned = np.where(missing[None], np.sort(gap_, 0), gap_[::-1])
    here = np.where(missing[None], np.sort(gap, 0), gap)
    assert_allclose(turned, here, atol=2 * SLOP)  # where two faces are as wide as SLOP, either may be taken
    assert_allclose(way(normal_), normal, atol=1e-4)
    near, near_ = (np.take_along_axis(p, g.argmin(0)[None, None], 0)[0] for p, g in ((point, gap), (point_, gap_)))
    clear = missing if len(gap) == 2 else np.ones_like(missing)  # which of two points is nearer may be rounding
    assert_allclose(place(near_)[:, clear], near[:, clear], atol=1e-4)
    assert_allclose(place(point_[::-1])[..., ~missing], point[..., ~missing], atol=1e-4)


# Known scenes ---------------------------------------------------------------------------------------------------------


def hull_arrays(corners: list, x: float = 0.0, y: float = 0.0, angle: float = 0.0, radius: float = 0.0) -> dict:
    return {"corners": np.array(corners), "position": np.array([x, y]), "angle": angle, "radius": radius}


def disc(x: float, y: float, radius: float) -> dict:
    return hull_arrays([[0.0, 0]], x, y, 0, radius)


def line(half_length: float, x: float = 0.0, y: float = 0.0, angle: float = 0.0, radius: float = 0.0) -> dict:
    return hull_arrays([[-half_length, 0], [half_length, 0.0]], x, y, angle, radius)


def box(width: float, height: float, x: float = 0.0, y: float = 0.0, angle: float = 0.0) -> dict:
    x2, y2 = width / 2, height / 2
    return hull_arrays([[-x2, -y2], [x2, -y2], [x2, y2], [-x2, y2], [-x2, y2]], x, y, angle)


def batch(scenes: list[dict]) -> dict:
    """Scenes over and over, MANY in all: the same shapes for the compiler as everywhere here."""
    return {k: np.resize(np.stack([s[k] for s in scenes]), (MANY, *np.shape(scenes[0][k]))) for k in scenes[0]}


def contacts_of_each(scenes: list[tuple[dict, dict]]) -> zip:
    """For each scene, normal [points, 2], gap [points] and world point [points, 2]."""
    a, b = (batch(list(side)) for side in zip(*scenes, strict=True))
    normal, gap, point, _ = contacts_of(a, b)
    return zip(*(np.moveaxis(x, -1, 0)[: len(scenes)] for x in (normal, gap, point)), strict=True)


def test_a_box_flat_on_a_box_stands_on_its_corners():
    cases = [(gap, shift) for gap in (-1e-3, 0.0, 1e-6, 1e-3, 0.4) for shift in (0.0, 1e-7, 0.2, -0.2)]
    scenes = [(box(2, 1), box(2, 0.6, shift, 0.8 + gap)) for gap, shift in cases]
    for (gap, shift), (normals, gaps, points) in zip(cases, contacts_of_each(scenes), strict=True):
        right, left = min(1, 1 + shift), max(-1, -1 + shift)  # the tangent of 'up' runs to the left
        assert_allclose(gaps, gap, atol=1e-12)
        assert_allclose(normals, [[0, 1], [0, 1]], atol=1e-12)
        assert_allclose(points, [[right, 0.5 + gap / 2], [left, 0.5 + gap / 2]], atol=1e-12)


def test_a_box_on_a_floor_stands_on_its_corners():
    radii = [0.0, 0.1]
    scenes = [(line(10, radius=r), box(1, 1, 3, 0.5 + r)) for r in radii]
    for radius, (normals, gaps, points) in zip(radii, contacts_of_each(scenes), strict=True):
        assert_allclose(gaps, 0, atol=1e-12)
        assert_allclose(normals, [[0, 1], [0, 1]], atol=1e-12)
        assert_allclose(points, [[3.5, radius], [2.5, radius]], atol=1e-12)


TILTS = [0.0, 1e-9, -1e-9, np.pi]


@pytest.mark.parametrize("floor", [line(10), box(20, 2, 0, -1)], ids=["line", "box"])
def test_a_capsule_lies_on_two_points(floor: dict):
    for _, gaps, points in contacts_of_each([(floor, line(0.5, 3, 0.2, tilt, 0.2)) for tilt in TILTS]):
        assert_allclose(gaps, 0, atol=1e-8)
        assert_allclose(points, [[3.5, 0], [2.5, 0]], atol=1e-8)


@pytest.mark.parametrize("floor", [line(10), box(20, 2, 0, -1)], ids=["line", "box"])
def test_a_capsule_stands_on_one_point(floor: dict):
    for _, gaps, points in contacts_of_each([(floor, line(0.5, 3, 0.7, tilt + np.pi / 2, 0.2)) for tilt in TILTS]):
        assert_allclose(sorted(gaps), [0, 1], atol=1e-8)
        assert_allclose(points[gaps.argmin()], [3, 0], atol=1e-8)


@pytest.mark.parametrize("floor", [line(10), box(20, 2, 0, -1)], ids=["line", "box"])
def test_a_capsule_stands_at_the_very_end(floor: dict):
    over = [0.0, 1e-9, 1e-7, -1e-7, 5e-6, 2e-5, -2e-5]
    cases = [(side, x, angle) for side in (-1, 1) for x in over for angle in (np.pi / 2, -np.pi / 2)]
    scenes = [(floor, line(0.5, side * (10 + x), 0.7, angle, 0.2)) for side, x, angle in cases]
    for (side, *_), (_, gaps, points) in zip(cases, contacts_of_each(scenes), strict=True):
        assert_allclose(gaps.min(), 0, atol=SLOP)
        assert_allclose(points[gaps.argmin()], [10 * side, 0], atol=3 * SLOP)


def test_lines_in_line_are_as_far_apart_as_their_ends():
    way, cases = np.array([np.cos(0.3), np.sin(0.3)]), [1e-4, 0.3, 5.0]
    scenes = [
        (line(1, 0, 0, 0.3, 0.1), line(0.5, (1.5 + apart) * way[0], (1.5 + apart) * way[1], 0.3, 0.2))
        for apart in cases
    ]
    for apart, (normals, gaps, points) in zip(cases, contacts_of_each(scenes), strict=True):
        assert_allclose(gaps, [apart - 0.3, FAR], atol=1e-12)
        assert_allclose(normals, [way, way], atol=1e-9)
        assert_allclose(points[0], (1.1 + (apart - 0.3) / 2) * way, atol=1e-12)


@pytest.mark.parametrize("repeats", [[0, 1, 2, 3, 4, 4, 4], [0, 0, 1, 2, 2, 3, 4]])
def test_repeated_corners_change_nothing(repeats: list):
    a, b = pair_of_shapes(Hull, Hull)
    more = a | {"corners": a["corners"][:, repeats]}
    for x, y in zip(contacts_of(a, b), contacts_of(more, b), strict=True):
        assert_allclose(x, y, atol=1e-9)


# Gradients and lost directions ----------------------------------------------------------------------------------------

UNIT, NONE = box(1, 1), box(0, 0)  # an empty slot has no size
DEGENERATE = {
    (Disc, Disc): [(disc(1, 2, 0.3), disc(1, 2, 0.5)), (disc(1, 2, 0), disc(1, 2, 0))],
    (Stadium, Disc): [
        (line(1), disc(0, 0, 0.3)),  # on the middle
        (line(1), disc(1, 0, 0.3)),  # on the end
        (line(1), disc(1.5, 0, 0.3)),  # in line
        (line(0), disc(0, 0, 0)),
    ],
    (Hull, Disc): [
        (UNIT, disc(0, 0, 0.3)),
        (UNIT, disc(0.5, 0, 0.3)),
        (UNIT, disc(0.5, 0.5, 0)),
        (UNIT, disc(1, 1, 0.3)),
    ],
    (Stadium, Stadium): [
        (line(1), line(1)),
        (line(1), line(1, 2)),
        (line(1), line(1, 0, 0, np.pi / 2)),
        (line(0), line(0)),
        (line(0), line(0, 1)),
        (line(0), line(1)),
        (line(1), line(0)),
        (line(1), line(0, 0, 1)),
    ],
    (Hull, Stadium): [
        (UNIT, line(0)),
        (UNIT, line(1)),
        (UNIT, line(0.5, 0, 0.5)),
        (UNIT, line(0.5, 1, 0.5)),
        (UNIT, line(0.5, 0, 1, np.pi / 2)),
        (UNIT, line(0, 0.5, 0.5)),
        (UNIT, line(0, 2)),
    ],
    (Hull, Hull): [
        (UNIT, UNIT),
        (UNIT, box(1, 1, 1, 0)),
        (UNIT, box(1, 1, 1, 1)),
        (UNIT, box(1, 1, 2, 2)),
        (UNIT, box(1, 1, 0, 2)),
        (UNIT, box(0.5, 0.5)),
    ],
}


@pytest.mark.parametrize(("kind_a", "kind_b"), PAIRS)
def test_degenerate_scenes_have_unit_normals_and_finite_gradients(kind_a: type, kind_b: type):
    scenes = DEGENERATE[kind_a, kind_b]
    a, b = (batch(list(side)) for side in zip(*scenes, strict=True))
    normal, gap, *_ = contacts_of(a, b, np.float32)
    assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    assert_allclose(gap.min(0), true_gap(a, b), atol=1e-5)
    chex.assert_tree_all_finite(gradient(a, b, some_weights(len(gap))))


def some_weights(points: int) -> tuple[ManifoldPoint, ...]:
    vector = jnp.linspace(0.5, 1.7, 2 * MANY).reshape(2, MANY)
    return points * (ManifoldPoint(vector, vector[0], -vector, vector / 3),)


@pytest.mark.parametrize(("a", "b"), [(NONE, NONE), (NONE, UNIT), (UNIT, NONE), (NONE, line(0)), (NONE, disc(0, 0, 0))])
def test_empty_slots_give_numbers(a: dict, b: dict):
    a, b = batch([a]), batch([b])
    points = contacts_of(a, b, np.float32)
    chex.assert_tree_all_finite((points, gradient(a, b, some_weights(len(points[1])))))


@pytest.mark.parametrize(("kind_a", "kind_b"), PAIRS)
def test_a_gap_opens_along_its_normal(kind_a: type, kind_b: type):
    """d gap / d position of b is the normal; of a, what is opposite."""
    a, b = pair_of_shapes(kind_a, kind_b)
    normal, gap, *_ = contacts_of(a, b, np.float32)
    nearest = np.arange(len(gap))[:, None] == gap.argmin(0)
    zero = jnp.zeros((2, MANY))
    by_a, by_b = gradient(a, b, tuple(ManifoldPoint(zero, jnp.asarray(on), zero, zero) for on in nearest))
    assert_allclose(by_b["position"].T, normal[0], atol=0.03)  # corners hardly apart in float32
    assert_allclose(by_a["position"].T, -normal[0], atol=0.03)
    assert np.quantile(np.abs(by_b["position"].T - normal[0]), 0.99) < 1e-5


def test_coefficients_of_a_pair_mix_as_named():
    exact = {"product": 0.16, "mean": 0.5, "max": 0.8, "geometric": 0.4}
    for name, coefficient in exact.items():
        assert_allclose(mix_materials(jnp.float32(0.2), jnp.float32(0.8), name), coefficient, rtol=1e-6)


def test_the_table_has_every_pair_once():
    for a in KINDS:
        for b in KINDS:
            assert ((a, b) in PAIRS) + ((b, a) in PAIRS) == (2 if a is b else 1)
