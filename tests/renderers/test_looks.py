"""Looks: each in the folder paints, in both forms alike, what it says that it paints; and colours can be told apart."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import world

from gen2d.config import plugins
from gen2d.config.config import load_config
from gen2d.core.enums import SHAPES, STATIC
from gen2d.programs import render
from gen2d.records.layout import Layout, SlotGroup
from gen2d.renderers import color as color_module
from gen2d.renderers import look, rasterizer
from gen2d.renderers.compositing import background_image
from gen2d.renderers.noise import noise

LOOKS = plugins.names("look")
RANDOM = [name for name in LOOKS if issubclass(plugins.load("look", name).options, look.PlainOptions)]
FREE = {"palette": "random", "contrast": 150.0}
HEIGHT, WIDTH = 40, 44
PATCHES, DENSE = (jax.jit(form, static_argnums=1) for form in (rasterizer.draw_tiles, rasterizer.draw_dense))
DISCS = Layout((SlotGroup("circle", 4),), (0.0, 0.0, 10.0, 10.0), 1.6)
SHAPES_ALL = Layout(
    (*DISCS.groups, *(SlotGroup(shape, 2) for shape in SHAPES[2:]), SlotGroup("segment", 4, STATIC)), DISCS.bounds, 1.6
)


def config_of(name, **options):
    video = {"frames": 1, "height": HEIGHT, "width": WIDTH}
    return load_config({"video": video, "look": {"name": name, **options}})


def scene_of(layout):
    """A scene of a layout in which slot 3 is empty, and its state at one frame."""
    rng = np.random.default_rng(5)
    places = [(2.5, 3), (7, 7.1), (7.3, 2), (0, 0)]
    discs = [{"x": place, "radius": radius} for place, radius in zip(places, (1.6, 1.2, 1.3, 0), strict=True)]
    scene, state, _ = world(discs + [{"radius": 0}] * (layout.slots - 4))
    shape = np.repeat([SHAPES.index(run.shape) for run in layout.groups], [run.count for run in layout.groups])
    present = np.arange(layout.slots) != 3
    colors = rng.integers(0, 256, (layout.slots, 3)) * present[:, None]
    objects = dataclasses.replace(
        scene.objects, present=jnp.asarray(present), shape=jnp.uint8(shape), color=jnp.uint8(colors)
    )
    return dataclasses.replace(scene, objects=objects), jax.tree.map(lambda a: a[None], state)


def keys(count):
    return jax.random.split(jax.random.key(0), count)


@functools.cache
def painter(name, layout, **options):
    """The compiled paints of one scene."""
    config = config_of(name, **options)
    return jax.jit(jax.vmap(lambda key: render.paint_of(key, config, scene_of(layout)[0], layout)))


def painted(name, count, layout=DISCS, **options):
    """The paints of one scene with some keys."""
    return painter(name, layout, **options)(keys(count))


@functools.cache
def drawn(name):
    """Two videos in a look as it is without options: stages, plan, and the frames [n, H, W, 3] in the form for CPUs."""
    config, (scene, states) = config_of(name), scene_of(DISCS)

    plan = render.plan_of(config, DISCS)
    stages = jax.vmap(lambda key: render.render_scene(key, config, plan, scene, states))(keys(2))
    return stages, plan, np.asarray(PATCHES(stages, plan)[0])[:, 0]


@pytest.mark.parametrize("name", LOOKS)
def test_a_look_paints_in_both_forms_alike(name):
    stages, plan, frames = drawn(name)
    assert frames.std((1, 2)).min() > 5
    apart = np.abs(frames.astype(int) - np.asarray(DENSE(stages, plan)[0])[:, 0])
    print(f"{name}: forms differ by {apart.max()} at most")
    assert apart.max() <= 1


@pytest.mark.parametrize("name", LOOKS)
def test_a_look_paints_all_that_is_there_and_no_more(name):
    slots, made = SHAPES_ALL.slots, painted(name, 3, SHAPES_ALL)
    per_slot = [
        made.color,
        made.drawn,
        made.fill,
        made.grow,
        made.rim,
        made.rim_color,
        made.mark,
        made.mark_color,
        made.shade,
    ]
    assert all(part is None or part.shape[:2] == (3, slots) for part in per_slot)
    there = np.arange(slots) != 3
    if name == "phyworld":  # without walls
        there[-4:] = False
    assert_array_equal(made.drawn, np.tile(there, (3, 1)))
    for color in (made.color, made.fill, made.rim_color, made.mark_color, made.background.color):
        assert color is None or ((color >= 0) & (color <= 255)).all()
    plan = render.plan_of(config_of(name), SHAPES_ALL)
    grown = np.repeat([run.shape in plan.grown for run in SHAPES_ALL.groups], [run.count for run in SHAPES_ALL.groups])
    assert made.grow is None or (made.grow <= plan.grow * grown).all()


@pytest.mark.parametrize("name", LOOKS)
def test_the_colour_that_is_stored_is_painted(name):
    stages, plan, frames = drawn(name)
    scene, states = scene_of(DISCS)
    stored = np.asarray(jax.vmap(lambda made: render.painted_colors(made, scene))(stages.paint))
    assert stored.dtype == np.uint8
    assert not stored[:, 3].any()
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for v, k in np.ndindex(2, 3):
        column, row = np.array([WIDTH, HEIGHT]) / 2 + (np.asarray(states.position)[0, k] - 5) * plan.scale * [1, -1]
        mine = np.hypot(columns - column, rows - row) < plan.scale * scene.objects.radius[k] - 0.7
        apart = frames[v][mine].astype(float) - stored[v, k]
        if stages.paint.texture is not None:  # spots of which go from it to another colour
            way = np.asarray(stages.paint.texture.color)[v, k] - stored[v, k]
            share = apart @ way / (way @ way)
            assert share.min() < 0.45
            assert share.max() > 0.55
            apart = apart - np.clip(share, 0, 1)[:, None] * way
        # A lit surface has its own colour where it faces the viewer, which may be between two pixels.
        assert np.abs(apart).max(-1).min() <= (2 if stages.paint.surface is None else 6)


@pytest.mark.parametrize("name", LOOKS)
def test_one_key_paints_the_same_and_another_key_what_is_random(name):
    options = FREE if name in RANDOM else {}
    one, again = painted(name, 4, **options), painted(name, 4, **options)
    jax.tree.map(assert_array_equal, one, again)
    if name in RANDOM:
        colors = np.asarray(one.color)
        assert len(np.unique(colors[:, 0], axis=0)) == 4
    if one.texture is not None:
        assert len(np.unique(one.texture.seed)) == one.texture.seed.size


@pytest.mark.parametrize("name", RANDOM)
def test_random_colours_can_be_told_apart(name):
    made = painted(name, 4, **FREE)
    colors = np.asarray(made.color)[:, :3]
    one, other = made.background.color, made.background.to_color
    other = other if made.background.texture is None else made.background.texture.color
    for behind in (one,) if other is None else (one, other, (one + other) / 2):
        assert least(np.concatenate([np.asarray(behind)[:, None], colors], 1)).min() >= 150


def test_random_colours_are_the_same_in_all_looks_on_one_background():
    def background(name: str) -> tuple:
        options = config_of(name).look.options
        return options.background, options.background_kind

    names = [name for name in RANDOM if background(name) == background("flat")]
    assert len(names) > 3
    for name in names:
        assert_array_equal(painted(name, 4, **FREE).color, painted("flat", 4, **FREE).color)


# ---- Marks, spots, shade, gradients


@functools.cache
def turned(name):
    """Frames [2, 40, 40, 3] of one disc in the middle, without a turn and after a quarter of one; and its paint."""
    config = load_config(
        {"video": {"frames": 2, "height": 40, "width": 40}, "look": {"name": name, "background_kind": "plain"}}
    )
    scene, state = scene_of(DISCS)
    position = jnp.full_like(state.position, 100).at[:, 0].set(5.0)
    two = jax.tree.map(lambda a: jnp.concatenate([a, a]), dataclasses.replace(state, position=position))
    two = dataclasses.replace(two, angle=two.angle.at[1].add(np.pi / 2))
    plan = render.plan_of(config, DISCS)
    stages = jax.vmap(lambda key: render.render_scene(key, config, plan, scene, two))(keys(1))
    return np.asarray(PATCHES(stages, plan)[0])[0].astype(float), jax.tree.map(lambda a: np.asarray(a[0]), stages.paint)


@pytest.mark.parametrize("name", ["marked", "textured"])
def test_what_is_painted_on_an_object_turns_with_it(name):
    (first, later), _ = turned(name)
    assert np.abs(later - first).max() > 30
    assert_allclose(later, np.rot90(first), atol=2)


def test_a_mark_points_along_the_x_axis_of_its_object():
    (frame, _), paint = turned("marked")
    assert_allclose(frame[19:21, 21:26], np.broadcast_to(paint.mark_color[0], (2, 5, 3)), atol=12)  # it is 1.92 px wide
    assert_allclose(frame[19:21, 14:19], np.broadcast_to(paint.color[0], (2, 5, 3)), atol=1)
    assert_allclose(frame[[16, 23], 21:24], np.broadcast_to(paint.color[0], (2, 3, 3)), atol=1)


def test_light_comes_from_the_upper_left_however_an_object_turns():
    (frame, later), paint = turned("shaded")
    assert_allclose(later, frame, atol=1)
    light = frame.sum(-1) / paint.color[0].sum()
    upper_left, upper_right, lower_left, lower_right = (
        light[a : a + 4, b : b + 4].mean() for a in (16, 20) for b in (16, 20)
    )
    assert_allclose(upper_right, lower_left, atol=0.01)
    assert upper_left > upper_right + 0.05 > lower_right + 0.1
    rim = light[23:25, 23:25].mean()  # towards the darkest point of the rim
    assert 1 - paint.shade[0] - 0.05 < rim < 0.75


@pytest.mark.full
def test_spots_are_metres_large_and_scale_with_the_picture():
    """Frames of twice as many rows and columns, four pixels averaged into one, are the smaller frames."""
    frames = []
    for size in (40, 80):
        video = {"frames": 1, "height": size, "width": size}
        config, (scene, states) = (
            load_config({"video": video, "look": {"name": "textured", "cell_size": 1}}),
            scene_of(DISCS),
        )
        plan = render.plan_of(config, DISCS)
        staged = functools.partial(render.render_scene, config=config, plan=plan, scene=scene, states=states)
        stages = jax.vmap(staged)(keys(2))
        frames.append(np.asarray(PATCHES(stages, plan)[0])[:, 0].astype(float))
    small, large = frames
    averaged = large.reshape(2, 40, 2, 40, 2, 3).mean((2, 4))
    assert small.std() > 20
    assert np.abs(averaged - small).mean() < 2


def test_phyworlds_objects_are_red_and_blue_in_turn_on_white():
    made = painted("phyworld", 1)
    red, blue = (255, 0, 0), (0, 0, 255)
    assert_array_equal(made.color[0], [red, blue, red, blue])
    assert_array_equal(made.background.color[0], (255, 255, 255))


def test_an_outlined_object_is_filled_with_as_much_of_its_colour_as_asked():
    for part in (0.0, 0.25, 1.0):
        made = painted("outline", 1, fill=part)
        mixed = (1 - part) * np.asarray(made.background.color[0]) + part * np.asarray(made.color[0])
        assert_allclose(made.fill[0], mixed, atol=1e-3)
        assert_array_equal(made.rim_color[0], made.color[0])


def test_a_gradient_spans_the_view_in_its_direction():
    config = config_of("flat", background_kind="gradient", background=[0, 0, 0], background_to=[255, 255, 255])
    plan, (scene, states) = render.plan_of(config, DISCS), scene_of(DISCS)
    right, up = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, HEIGHT / 2 - np.arange(HEIGHT) - 0.5)
    for key in keys(6):
        stage = render.render_scene(key, config, plan, scene, states)
        direction = stage.paint.background.direction
        assert direction is not None
        cos, sin = (float(part(direction)) for part in (jnp.cos, jnp.sin))
        along = (right * cos + up * sin) / (abs(cos) * WIDTH / 2 + abs(sin) * HEIGHT / 2)  # -1 to 1 at the corners
        (image,) = np.asarray(background_image(stage, stage.instants, plan))
        assert_allclose(image, np.repeat(255 * (along[..., None] + 1) / 2, 3, -1), atol=0.1)


def test_noise_is_a_number_from_0_to_1_that_changes_over_a_cell_and_is_continuous():
    x, y = np.random.default_rng(6).uniform(-50, 50, (2, 20_000)).astype(np.float32)

    def at(dx, dy):
        return np.asarray(noise(jnp.asarray(x + dx), jnp.asarray(y + dy), jnp.uint32(3)), float)

    here = at(0, 0)
    assert here.min() >= 0
    assert here.max() <= 1
    assert abs(here.mean() - 0.5) < 0.02
    assert 0.12 < here.std() < 0.3
    for dx, dy in ((1, 0), (0, 1)):
        assert np.abs(at(1e-3 * dx, 1e-3 * dy) - here).max() < 5e-3
        assert np.corrcoef(at(0.2 * dx, 0.2 * dy), here)[0, 1] > 0.7
        assert abs(np.corrcoef(at(2 * dx, 2 * dy), here)[0, 1]) < 0.1


def test_noise_is_as_faint_as_its_average_over_a_pixel():
    x, y = np.random.default_rng(7).uniform(-400, 400, (2, 3000)).astype(np.float32)
    for pixel in (0.25, 0.5, 1.0, 2.0):  # of the coarse octave's cell; twice as many of the fine one's
        inside = (np.arange(16, dtype=np.float32) + 0.5) / 16 - 0.5
        points = x[:, None, None] + pixel * inside[:, None], y[:, None, None] + pixel * inside
        u, v = (jnp.asarray(part) for part in np.broadcast_arrays(*points))
        averaged = np.asarray(noise(u, v, jnp.uint32(3))).mean((1, 2))
        faded = np.asarray(noise(jnp.asarray(x), jnp.asarray(y), jnp.uint32(3), pixel))
        assert_allclose(faded.std(), averaged.std(), rtol=0.1)
        assert np.corrcoef(faded, averaged)[0, 1] > 0.7


# ---- Palettes


def least(colors):
    """The least contrast [n] of two of some colours [n, count, 3]."""
    apart = np.asarray(color_module.contrast(jnp.asarray(colors)[:, :, None], jnp.asarray(colors)[:, None]))
    return np.where(np.eye(colors.shape[1], dtype=bool), np.inf, apart).min((1, 2))


@functools.partial(jax.jit, static_argnums=1)
@functools.partial(jax.vmap, in_axes=(0, None, None, 0))
def chosen(key, count, distance, behind):
    return color_module.palette(key, count, distance, behind[None])


def palettes(count, distance, videos=200):
    """Random backgrounds and the first of 8 colours chosen for them, [videos, 1 + count, 3]."""
    behind = np.random.default_rng(2).integers(0, 256, (videos, 3)).astype(np.float32)
    colors = chosen(jax.random.split(jax.random.key(1), videos), 8, distance, behind)
    return np.concatenate([behind[:, None], np.asarray(colors)[:, :count]], 1)


@pytest.mark.parametrize(("count", "distance"), [(1, 200.0), (4, 150.0), (8, 100.0)])
def test_a_palette_keeps_its_colours_apart_where_it_can(count, distance):
    colors = palettes(count, distance)
    found = least(colors)
    print(f"{count} colours: {found.min():.0f} apart at least, {distance} asked for")
    assert found.min() >= distance
    assert (colors == np.round(colors)).all()
    assert ((colors >= 0) & (colors <= 255)).all()


def test_a_palette_that_is_asked_for_too_much_gives_colours_far_apart():
    found = least(palettes(4, 765.0))
    print(f"4 colours: {found.min():.0f} apart at least, {np.median(found):.0f} on the median, 765 asked for")
    assert found.min() > 150


def test_contrast_is_a_distance_of_765_at_most():
    rng = np.random.default_rng(3)
    a, b = jnp.float32(rng.uniform(0, 255, (2, 1000, 3)))
    one, other = color_module.contrast(a, b), color_module.contrast(b, a)
    assert_array_equal(one, other)
    assert_array_equal(color_module.contrast(a, a), 0)
    assert np.max(one) < 765
    assert 764 < color_module.contrast(jnp.zeros(3), jnp.full(3, 255.0)) < 765


def test_contrast_weighs_green_most_and_red_more_than_blue_among_bright_reds():
    """T. Riemersma, 'Colour metric'."""
    for red, order in ((250.0, "brg"), (5.0, "rbg")):
        base = jnp.float32([red, 100, 100])
        apart = {
            name: float(color_module.contrast(base, base + jnp.float32(step)))
            for name, step in zip("rgb", 4 * np.eye(3), strict=True)
        }
        assert sorted(apart, key=lambda name: apart[name]) == list(order), apart


def test_a_mark_is_light_or_dark_whichever_has_the_higher_contrast_ratio():
    """WCAG 2.2, 'contrast ratio' and 'relative luminance'."""

    def luminance(colors):
        share = np.asarray(colors, float) / 255
        linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        return linear @ [0.2126, 0.7152, 0.0722]

    colors = np.random.default_rng(4).integers(0, 256, (500, 3)).astype(np.float32)
    chosen = np.asarray(look.contrasting(jnp.asarray(colors)))
    other = 256 - chosen  # 16 or 240

    def ratio(marks):
        low, high = np.sort([luminance(marks), luminance(colors)], axis=0)
        return (high + 0.05) / (low + 0.05)

    assert set(np.unique(chosen)) == {16, 240}
    assert (ratio(chosen) >= 0.9 * ratio(other)).all()
