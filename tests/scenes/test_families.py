"""What every scene family keeps, over some hundred keys of its own config: the layout that it tells, no overlap at the
start, factors within what they are declared to be, and scenes that depend on their keys alone; over 100,000 keys also
that whole videos are numbers and that nothing gets out of walls (`pytest -m slow tests/scenes/test_families.py`).

What moves begins inside the layout's bounds; a family where some of it comes from outside declares `begins_outside`.
"""

import functools
import itertools
import os
from typing import Any, NamedTuple

import chex
import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gen2d.config import plugins, truncation
from gen2d.config.config import Config, load_config
from gen2d.config.distributions import Distribution, Span, next_float32
from gen2d.config.options import factor_options
from gen2d.config.plugin_options import Plugin
from gen2d.core.enums import DYNAMIC, SHAPES
from gen2d.physics.collision import Disc, Hull, Shape, manifold
from gen2d.physics.params import solver_params
from gen2d.physics.shapes import body_shape_of, to_world
from gen2d.physics.simulate import simulate, substeps
from gen2d.records.axes import to_device, to_stored
from gen2d.records.layout import Layout, SlotGroup
from gen2d.records.scene import Objects, Scene, State
from gen2d.sampling.sampler import Sampler
from gen2d.tools import gallery

FAMILIES = plugins.names("scene")
KEYS, LANES = 256, 500
MANY = int(os.environ.get("FAMILY_VIDEOS", "3000"))  # of the third tier: 100,000 take ten minutes a family
OVERLAP, EDGE = 1e-4, 1e-3  # m
WALLED = ("billiards", "bouncing", "hidden_mass", "occluder", "pile")  # by walls on all sides


class Made(NamedTuple):
    """What a family makes of some keys; arrays have them first."""

    factors: Any  # by name
    scene: Scene
    state: State
    fits: Any
    overlap: Any  # [n] m, the deepest
    extent: Any  # [n, 4] m: left, bottom, right and top end of all that moves


def config_of(family: str) -> Config:
    """The config of a family's name, or else its defaults."""
    return load_config(f"{family}.yaml" if f"{family}.yaml" in plugins.config_names() else {"scene": family})


@functools.cache
def program(family: str) -> tuple[Plugin, Layout, Any]:
    """A family's config, its layout, and the one program that a test of it compiles."""
    config = config_of(family)
    scene = config.scene
    layout = scene.contract.layout(scene.options)

    def run(keys: jax.Array) -> Made:
        factors, begun = jax.vmap(Sampler(config).sample)(keys)
        things, state, fits = begun.scene, begun.state, begun.fits
        on_device = to_device(things), to_device(state)
        shapes = shapes_of(layout, on_device[0].objects, on_device[1])
        present = on_device[0].objects.present
        return Made(factors, things, state, fits, overlap(layout, shapes, present), extent(layout, shapes, present))

    return scene, layout, jax.jit(run)


def make(family: str, seed: int, count: int) -> Made:
    """What a family makes of some keys."""
    return jax.tree.map(np.asarray, program(family)[2](jax.random.split(jax.random.key(seed), count)))


@functools.cache
def made(family: str) -> Made:
    """What a family makes of KEYS keys."""
    return make(family, 0, KEYS)


def shapes_of(layout: Layout, objects: Objects, state: State) -> list[Any]:
    """The shape of each run at the start: from numbers of its slots."""

    def of(run: SlotGroup, first: int) -> Any:
        def some(numbers: np.ndarray) -> Shape:
            slots = first + numbers
            form = body_shape_of(objects, run, jnp.asarray(slots))
            return to_world(form, state.position[:, slots], state.angle[slots])

        return some

    return [of(run, first) for run, first in layout.spans]


def overlap(layout: Layout, shapes: list[Any], present: jax.Array) -> jax.Array:
    """The deepest overlap [n] in m of two that collide."""
    deepest = jnp.full(present.shape[1:], -jnp.inf)
    spans = zip(layout.spans, shapes, strict=True)
    for ((a, first), of_a), ((b, second), of_b) in itertools.combinations_with_replacement(spans, 2):
        if not (a.collides and b.collides) or DYNAMIC not in (a.kind, b.kind):
            continue
        pairs = [(i, j) for i in range(a.count) for j in range(b.count) if first + i < second + j]
        pairs = [pair for pair in pairs if frozenset((first + pair[0], second + pair[1])) not in layout.exempt]
        if not pairs:
            continue
        i, j = np.array(pairs).T
        gaps = jnp.stack([point.gap for point in manifold(of_a(i), of_b(j))]).min(0)
        both = present[first + i] & present[second + j]
        deepest = jnp.maximum(deepest, jnp.where(both, -gaps, -jnp.inf).max(0))
    return deepest


def extent(layout: Layout, shapes: list[Any], present: jax.Array) -> jax.Array:
    """The ends [n, 4] of all that moves, in m."""
    lows, highs = [], []
    for (run, first), of in zip(layout.spans, shapes, strict=True):
        if run.kind != DYNAMIC:
            continue
        shape, there = of(np.arange(run.count)), present[first : first + run.count]
        low, high = ends(shape)
        lows.append(jnp.where(there, low, jnp.inf).min(1))
        highs.append(jnp.where(there, high, -jnp.inf).max(1))
    low, high = (choose(jnp.stack(x), axis=0) for choose, x in ((jnp.min, lows), (jnp.max, highs)))
    return jnp.concatenate([low, high]).T


def ends(shape: Shape) -> tuple[jax.Array, jax.Array]:
    """The lower left and upper right ends [2, K, n] of shapes."""
    if isinstance(shape, Hull):
        corners = jnp.stack(shape.vertices)
        return corners.min(0) - shape.radius, corners.max(0) + shape.radius
    half = jnp.zeros_like(shape.centre) if isinstance(shape, Disc) else jnp.abs(shape.direction) * shape.half_length
    return shape.centre - half - shape.radius, shape.centre + half + shape.radius


LONG = ("seesaw", "pile", "tower", "dominoes", "wrecking_ball", "marble_run")


TIERED = [pytest.param(name, marks=pytest.mark.full) if name in LONG else name for name in FAMILIES]


@pytest.mark.parametrize("family", TIERED)
def test_slots_hold_what_the_layout_tells(family):
    (_, layout, _), objects = program(family), made(family).scene.objects
    assert layout.slots <= 254
    for run, first in layout.spans:
        here = slice(first, first + run.count)
        there = objects.present[:, here]
        assert (objects.kind[:, here][there] == run.kind).all()
        assert (objects.shape[:, here][there] == SHAPES.index(run.shape)).all()


@pytest.mark.parametrize("family", TIERED)
def test_everything_finds_a_place_without_overlap(family):
    found = made(family)
    assert found.fits.all()
    assert np.isfinite(found.state.position).all()
    assert found.overlap.max() <= OVERLAP


@pytest.mark.parametrize("family", TIERED)
def test_what_moves_begins_in_view(family):
    scene, layout, _ = program(family)
    if scene.contract.begins_outside:
        return
    left, bottom, right, top = made(family).extent.T
    bounds = layout.bounds
    assert min(left.min() - bounds[0], bottom.min() - bounds[1]) > -EDGE
    assert min(bounds[2] - right.max(), bounds[3] - top.max()) > -EDGE


def distance(source: Distribution, values: np.ndarray) -> float:
    """The largest difference of the share of draws up to a number and of its probability."""
    x, counts = np.unique(values, return_counts=True)
    expected = [truncation.total(truncation.inside(source, [Span(-np.inf, next_float32(value))])) for value in x]
    return float(np.abs(np.cumsum(counts) / len(values) - expected).max())


@pytest.mark.parametrize("family", TIERED)
def test_factors_are_what_they_are_declared_to_be(family):
    check_factors(program(family)[0], made(family).factors)


def check_factors(scene: Plugin, found: dict[str, np.ndarray], doubt: float = 1e-3) -> None:
    """Asserts that factors are in their support, and drawn as they are declared to be (A. Kolmogorov, N. Smirnov)."""
    most = np.sqrt(-np.log(doubt / 2) / 2)
    for name, spec in factor_options(scene.contract).items():
        source, values = getattr(scene.options, name), found[name]
        parts = source if spec.parts else [source]
        values = values if spec.parts else values[..., None]
        there = np.ones(values.shape[:-1], bool)
        if spec.each in found:
            there = np.arange(values.shape[1]) < found[spec.each][:, None]
        assert (values[~there] == 0).all(), name
        for part, drawn in zip(parts, np.moveaxis(values, -1, 0), strict=True):
            assert part.contains(drawn[there]).all(), name
            assert distance(part, drawn[there]) < most / np.sqrt(there.sum()), name
    for name in scene.contract.derived:
        assert np.isfinite(found[name]).all(), name


@pytest.mark.parametrize("family", TIERED)
def test_a_key_is_a_scene(family):
    found = made(family)
    again = program(family)[2](jax.random.split(jax.random.key(0), KEYS))
    chex.assert_trees_all_equal(found, again)
    rows = [np.asarray(x, np.float32).reshape(KEYS, -1) for x in (found.state.position, *found.factors.values())]
    assert len(np.unique(np.concatenate(rows, axis=1), axis=0)) == KEYS


@pytest.mark.slow
@pytest.mark.parametrize("family", TIERED)
def test_many_videos_are_numbers_begin_apart_and_stay_within_walls(family):
    config = config_of(family)
    scene, video, physics = config.scene, config.video, config.physics
    layout, steps = scene.contract.layout(scene.options), substeps(video.fps, physics.substeps, physics.max_step)
    rules = solver_params(physics, video.fps, steps)

    @jax.jit
    def run(scene: Scene, state: State) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Whether all is a number, and the ends [2] of where centres are, of each video."""
        made = to_stored(simulate(to_device(scene), to_device(state), layout, rules, video.frames, steps, sparse=True))
        there = (scene.objects.present & (scene.objects.kind == DYNAMIC))[:, None, :, None]
        place = made.states.position
        good = jnp.stack([jnp.isfinite(x).reshape(len(x), -1).all(1) for x in jax.tree.leaves(made)]).all(0)
        low, high = jnp.where(there, place, jnp.inf).min((1, 2)), jnp.where(there, place, -jnp.inf).max((1, 2))
        return good, low, high

    factors = []
    for seed in range(MANY // LANES):
        found = make(family, 1 + seed, LANES)
        assert found.fits.all()
        assert found.overlap.max() <= OVERLAP
        factors.append(found.factors)
        good, low, high = (np.asarray(x) for x in run(found.scene, found.state))
        assert good.all()
        if family in WALLED:
            assert (low > layout.bounds[:2]).all()
            assert (high < layout.bounds[2:]).all()
    # Of 300 numbers of all families one is beyond .001 by chance every third time.
    check_factors(scene, jax.tree.map(lambda *x: np.concatenate(x), *factors), doubt=1e-3 / 300)


@pytest.mark.full
def test_the_page_of_all_families_has_a_row_of_each(tmp_path, monkeypatch):
    names, few = plugins.names, {"scene": ["bouncing"], "look": ["flat"]}
    monkeypatch.setattr(plugins, "names", lambda kind: few.get(kind) or names(kind))
    monkeypatch.setattr(gallery, "_annotation_rows", lambda *_: iter(()))
    small = ["video.frames=3", "video.height=16", "video.width=16", "storage.batch_size=1"]
    page, own = gallery.families(tmp_path, overrides=small)
    assert (page.name, own.name) == ("families.png", "bouncing-gallery.png")
    assert np.asarray(cv2.imread(str(page))).shape == (333, gallery.LABEL + gallery.PAGE, 3)
    assert own.stat().st_size > 0
