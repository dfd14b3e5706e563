"""Studio: lit frames are those of a supersampled reference in float64, in both forms; shadows own no pixel and fall on
what lies behind."""

import dataclasses
import functools
import math
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import holds
from numpy.testing import assert_allclose, assert_array_equal
from worlds import straight_motion

from gen2d.annotations import shadow
from gen2d.config.config import load_config
from gen2d.core.enums import CIRCLE, POLYGON
from gen2d.core.errors import ConfigError
from gen2d.programs import render
from gen2d.programs.rollout import Rollout
from gen2d.records.layout import Layout
from gen2d.renderers import rasterizer
from gen2d.renderers.looks import studio
from gen2d.sampling import builder

TILES, DENSE = (jax.jit(form, static_argnums=1) for form in (rasterizer.draw_tiles, rasterizer.draw_dense))
SOFT = jax.jit(rasterizer.draw_soft, static_argnums=1)
SAMPLES = 10  # per side of a pixel


def groups():
    """Discs, capsules and boxes between two walls; a disc and the capsule cast shadows on the discs that they touch."""
    discs = builder.discs(jnp.asarray([[2.2, 2.3], [7.6, 7.5], [6.55, 8.85]]), jnp.asarray([1.5, 1.1, 0.6]), angle=0.4)
    capsules = builder.capsules(jnp.asarray([[2.3, 4.95]]), 0.7, 1.0, 0.5)
    boxes = builder.boxes(jnp.asarray([[8.0, 2.6]]), 0.3, 1.6, 2.0)
    walls = builder.segments([(1.1, 0.25), (0.25, 0.7)], [(9.7, 0.25), (0.25, 9.6)])
    return discs, capsules, boxes, walls


@functools.cache
def staged(look, size, turn=0.0, masks=False, occluders=0):
    """Scene, plan and render scene of one frame, without noise on the bodies."""
    video = {"frames": 1, "height": size, "width": size}
    camera = {"angle": turn, "turn": 0.01} if turn else {}
    config = load_config(
        {"video": video, "look": {"name": "studio", **dict(look)}, "camera": camera, "annotations": {"masks": masks},
         "image": {"occluders": occluders, "occluder_front": 0.5}}
    )  # fmt: skip
    made = groups()
    layout = Layout(tuple(group.run for group in made), (0.0, 0.0, 10.0, 10.0), 1.6)
    scene, state = builder.assemble(layout, made, jnp.zeros(2))
    plan = render.plan_of(config, layout)
    states = jax.tree.map(lambda a: a[None], state)
    stage = render.render_scene(jax.random.key(3), config, plan, scene, states)
    surface = stage.paint.surface
    assert surface is not None
    return scene, plan, stage._replace(paint=stage.paint._replace(surface=surface._replace(pattern=None)))


def frames(form, stage, plan):
    image, owners = form(jax.tree.map(lambda a: a[None], stage), plan)
    return np.asarray(image)[0, 0], None if owners is None else np.asarray(owners)[0, 0]


# ---- The reference


class Body:
    """A body in pixels, y up from the frame's lower left, and its surface at points [..., 2]."""

    def __init__(self, scene, stage, plan, slot):
        at, objects = stage.instants, scene.objects
        self.scale, self.shape = float(at.view.scale[0]), int(objects.shape[slot])
        cos, sin = np.cos(float(at.view.angle[0])), np.sin(float(at.view.angle[0]))
        u, v = np.asarray(at.position[0, slot], float) - np.asarray(at.view.center[0], float)
        self.center = np.array([plan.width, plan.height]) / 2 + self.scale * np.array(
            [u * cos + v * sin, v * cos - u * sin]
        )
        angle = float(at.angle[0, slot]) - float(at.view.angle[0])
        self.axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        grow = float(stage.paint.grow[slot])
        self.radius = float(objects.radius[slot]) * self.scale + grow
        self.half = float(objects.half_length[slot]) * self.scale
        self.vertices = np.asarray(objects.vertices[slot], float) * self.scale
        self.bevel = float(stage.paint.surface.bevel[slot]) * self.scale

    def local(self, points, offset=(0.0, 0.0)):
        return (points - self.center - offset) @ self.axes.T

    def sides(self, local):
        """Distance beyond each side, and the outward normals."""
        corners = self.vertices
        side = np.roll(corners, -1, 0) - corners
        normal = np.stack([side[:, 1], -side[:, 0]], -1) / np.linalg.norm(side, axis=-1, keepdims=True)
        return local @ normal.T - (normal * corners).sum(-1), normal

    def surface(self, points):
        """Whether the body covers each point, its tilt [..., 2] along its own axes, and local coordinates."""
        local = self.local(points)
        if self.shape == POLYGON:
            beyond, normal = self.sides(local)
            amount = np.clip(1 + beyond.max(-1) / self.bevel, 0, 1)
            return beyond.max(-1) <= 0, normal[beyond.argmax(-1)] * amount[..., None], local
        core = np.stack([np.clip(local[..., 0], -self.half, self.half), 0 * local[..., 0]], -1)
        away = (local - core) / self.radius
        return np.linalg.norm(away, axis=-1) <= 1, away, local

    def shadow(self, points, offset, blur):
        local = self.local(points, offset)
        if self.shape == POLYGON:
            beyond = self.sides(local)[0]
            return np.maximum(1 - smooth((beyond + blur) / (2 * blur)).sum(-1), 0)
        core = np.stack([np.clip(local[..., 0], -self.half, self.half), 0 * local[..., 0]], -1)
        inner, outer, r = max(self.radius - blur, 0), self.radius + blur, self.radius
        profile = smooth((outer**2 - ((local - core) ** 2).sum(-1)) / (outer**2 - inner**2))
        if self.shape == CIRCLE:
            return profile * (r**2 / (r**2 + blur**2) if r > blur else 2 * r**2 / outer**2)
        return profile * min(r / (24 / 35 * outer), 1)


class Board(Body):
    """An occluder, in the place of a polygon of the frame."""

    def __init__(self, stage, plan, number):
        self.scale, self.shape, self.radius, self.half = float(stage.instants.view.scale[0]), POLYGON, 0.0, 0.0
        left, top, right, bottom = np.asarray(stage.occluders.box[number], float)
        self.center, self.axes = np.array([left + right, 2 * plan.height - top - bottom]) / 2, np.eye(2)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        self.vertices = corners * np.array([right - left, bottom - top]) / 2
        self.bevel = float(stage.paint.screen.bevel) * self.scale


def with_boards(stage):
    """A stage in which the occluders follow the slots in the arrays of `lit`."""
    if stage.occluders is None:
        return stage
    surface, count = stage.paint.surface, len(stage.occluders.rank)
    nothing = jnp.zeros(count)
    parts = {
        name: jnp.concatenate([getattr(surface, name), nothing + getattr(stage.paint.screen, name)])
        for name in ("slope", "bevel", "gloss", "sharpness")
    }
    parts |= {
        name: jnp.concatenate([part, nothing])
        for name in ("stripe", "stripe_light", "mirror")
        if (part := getattr(surface, name)) is not None
    }
    color = jnp.concatenate([stage.paint.color, stage.occluders.color])
    return stage._replace(paint=stage.paint._replace(surface=surface._replace(**parts), color=color))


def smooth(value):
    value = np.clip(value, 0, 1)
    return value**2 * (3 - 2 * value)


def lit(stage, slot, body, points):
    """Coverage [...] and colours [..., 3] of a body, by the formulas of the README."""
    light, surface = (
        jax.tree.map(lambda a: np.asarray(a, float), part) for part in (stage.paint.light, stage.paint.surface)
    )
    inside, tilt, local = body.surface(points)
    angle = float(stage.instants.view.angle[0])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    toward = np.append(turn @ light.direction[:2], light.direction[2])
    flat = np.where(inside[..., None], surface.slope[slot] * (tilt @ body.axes), 0)
    normal = np.concatenate([flat, np.sqrt(1 - np.minimum((flat**2).sum(-1), 0.98))[..., None]], -1)

    def source(cosine):
        soft = light.softness
        return np.where(cosine < soft, soft * np.clip((cosine + soft) / (2 * soft), 0, 1) ** 2, cosine)

    direct = source(normal @ toward) / source(toward[2])
    ambient = (1 + normal[..., 2]) / 2 + 0.25 * normal[..., 1]
    irradiance = (1 - light.ambient) * direct + light.ambient * ambient
    mirror = 0.0 if surface.mirror is None else surface.mirror[slot]
    beside = normal[..., :2] @ toward[:2] / np.linalg.norm(toward[:2])  # the part v of the normal
    room = 1 + 0.12 * beside - 0.44 * np.maximum(1 - ((beside + 0.4) / 0.4) ** 2, 0) ** 2
    factor = irradiance ** (1 / 2.2)
    factor = factor + mirror * (room - factor)
    over = np.clip(factor - 1, 0, 0.12)
    factor = np.minimum(factor, 1) + over - over**2 / 0.24
    half = toward + np.array([0, 0, 1])
    half = half / np.linalg.norm(half)
    lobe = np.maximum(1 - surface.sharpness[slot] / 4 * (1 - normal @ half), 0) ** 4
    shine = surface.gloss[slot] * lobe + 0.25 * (1 - normal[..., 2]) ** 3
    shine = np.minimum(shine, 1)
    shine = shine + mirror * 0.7 * np.maximum(beside, 0) ** 2 * (1 - shine)
    color = np.asarray(stage.paint.color[slot], float) * factor[..., None]
    if surface.stripe is not None and surface.stripe[slot] and body.shape == CIRCLE:
        band = (np.abs(local[..., 1]) < surface.stripe[slot] * body.radius)[..., None]
        bright = surface.stripe_light[slot]
        color = np.where(band, light.highlight * factor[..., None] if bright > 0 else color * (1 + bright), color)
    return inside, np.minimum(color + shine[..., None] * (light.highlight - color), 255)


def reference(scene, plan, stage):
    """Frame [H, W, 3] in floats, the mean of SAMPLES^2 points in each pixel."""
    height, width = plan.height, plan.width
    x, y = ((np.arange(n * SAMPLES) + 0.5) / SAMPLES for n in (width, height))
    points = np.stack(np.meshgrid(x, height - y), -1)
    image = backdrop(stage, plan, points)
    shadow, drawn = stage.paint.shadow, np.flatnonzero(stage.paint.drawn)
    bodies = {slot: Body(scene, stage, plan, slot) for slot in drawn}
    angle, scale = float(stage.instants.view.angle[0]), float(stage.instants.view.scale[0])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    offset, blur = scale * turn @ np.asarray(shadow.offset, float), max(scale * float(shadow.blur), 0.5)
    order = sorted(drawn, key=lambda slot: int(scene.objects.depth[slot]))
    still = [slot for slot in order if not np.isfinite(scene.objects.mass[slot])]
    layers = [[slot] for slot in order if slot not in still]
    ranks = [] if stage.occluders is None else stage.occluders.rank.tolist()
    for number, rank in reversed([*enumerate(ranks)]):
        layers.insert(rank, [plan.layout.slots + number])
        bodies[plan.layout.slots + number] = Board(stage, plan, number)
    for part in (still, *layers):
        for slot in part:
            opacity = float(shadow.opacity) * bodies[slot].shadow(points, offset, blur)
            image = image + opacity[..., None] * (np.asarray(shadow.color, float) - image)
        for slot in part:
            inside, color = lit(with_boards(stage), slot, bodies[slot], points)
            image = np.where(inside[..., None], color, image)
    return image.reshape(height, SAMPLES, width, SAMPLES, 3).mean((1, 3))


def backdrop(stage, plan, points):
    """Gradient towards the light over the first view, and its corners."""
    background = jax.tree.map(lambda a: np.asarray(a, float), stage.paint.background)
    angle = float(stage.instants.view.angle[0])
    centered = points - np.array([plan.width, plan.height]) / 2
    world = centered @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    share = world / (np.array([plan.width, plan.height]) / 2)
    way = np.array([np.cos(stage.paint.sampled["azimuth"]), np.sin(stage.paint.sampled["azimuth"])], float)
    along = world @ way / (np.abs(way) @ np.array([plan.width, plan.height]) / 2)
    image = background.color + np.clip((along[..., None] + 1) / 2, 0, 1) * (background.to_color - background.color)
    return image + np.clip((share**2).sum(-1) / 2, 0, 1)[..., None] * (background.corners - image)


# ---- Frames

CASES = {
    "paper, 88 px": ((), 88, 0.0),
    "lab, 80 px, turned": ((("palette", "lab"), ("softness", 0.1), ("ambient", 0.2)), 80, 0.25),
    "dusk, 128 px": ((("palette", "dusk"), ("azimuth", 0.5), ("elevation", 0.7), ("gloss", 0.6)), 128, 0.0),
    "grey, 72 px": ((("palette", "grey"), ("stripe", 0)), 72, 0.0),
    "metal, 88 px": ((("material", "metal"),), 88, 0.0),
    "metal, 128 px, turned": ((("material", "metal"), ("palette", "dusk"), ("azimuth", 0.5)), 128, 0.25),
    "occluders, 80 px, turned": ((("palette", "lab"), ("ambient", 0.2)), 80, 0.25, False, 2),
}
TIERED = [pytest.param(case, marks=pytest.mark.full if i not in (1, 6) else ()) for i, case in enumerate(CASES)]


def errors_of(case):
    """Differences of a frame from the reference, in grey levels."""
    scene, plan, stage = staged(*CASES[case])
    image, _ = frames(TILES, stage, plan)
    return np.abs(image - reference(scene, plan, stage))


@pytest.mark.parametrize("case", TIERED)
def test_lit_frames_are_those_of_a_supersampled_reference(case):
    errors = errors_of(case)
    holds("studio: mean error", errors.mean(), 0.6)
    # All pixels of a level edge of an occluder have the same error.
    holds("studio: error of 99.9 % of all values", np.quantile(errors, 0.999), 8 if "occluders" in case else 6)
    holds("studio: largest error", errors.max(), 60)


@pytest.mark.parametrize("case", TIERED)
def test_both_forms_render_the_same_lit_frames(case):
    _, plan, stage = staged(*CASES[case])
    tiles, dense = (frames(form, stage, plan)[0].astype(int) for form in (TILES, DENSE))
    assert np.abs(tiles - dense).max() <= 1


def test_soft_frames_are_the_lit_frames_before_rounding():
    _, plan, stage = staged((), 88)
    soft = np.asarray(SOFT(stage, plan))[0]
    assert np.abs(soft - frames(TILES, stage, plan)[0]).max() < 4


def test_a_surface_that_faces_the_viewer_has_its_own_colour():
    """The flat top of a box."""
    _, plan, stage = staged((("gloss", 0),), 96)
    image, _ = frames(TILES, stage, plan)
    column, row = (int(x) for x in (np.array([8.0, 10 - 2.6]) * plan.scale))
    assert_allclose(image[row, column], stage.paint.color[4], atol=1)


@pytest.mark.parametrize(("material", "has_band"), [("metal", True), ("rubber", False)])
def test_metal_alone_is_darkest_inside_a_disc_and_not_at_its_rim(material, has_band):
    """Across a disc, from its middle away from the light."""
    look = ("material", material), ("azimuth", 0.0), ("gloss", 0), ("stripe", 0)
    _, plan, stage = staged(look, 88)
    image, _ = frames(TILES, stage, plan)
    row, middle, rim = (int(x * plan.scale) for x in (10 - 2.3, 2.2, 2.2 - 1.5))
    across = image[row, rim + 2 : middle].astype(float).sum(-1)
    assert across[0] < 0.98 * across[-1]
    assert (across.min() < 0.75 * min(across[0], across[-1])) == has_band


def test_shadows_own_no_pixel_and_fall_away_from_the_light():
    _, plan, stage = staged((("azimuth", 0.0), ("elevation", 0.6)), 64, masks=True)
    opaque = stage.paint.shadow
    assert opaque is not None
    bare = stage._replace(paint=stage.paint._replace(shadow=opaque._replace(opacity=jnp.zeros_like(opaque.opacity))))
    (image, owners), (without, same) = (frames(TILES, some, plan) for some in (stage, bare))
    assert_array_equal(owners, same)
    assert_array_equal(frames(DENSE, stage, plan)[1], owners)
    darker = without.astype(int).sum(-1) - image.astype(int).sum(-1)
    row, left, right = (int(x * plan.scale) for x in (10 - 7.5, 7.6 - 1.3, 7.6 + 1.3))
    assert darker[row, left] > 60
    assert darker[row, right] == 0


def test_shadows_of_walls_fall_far_from_them_in_both_forms():
    _, plan, stage = staged((("azimuth", 3.14), ("elevation", 0.25)), 88)
    tiles, dense = (frames(form, stage, plan)[0].astype(int) for form in (TILES, DENSE))
    assert np.abs(tiles - dense).max() <= 1
    row = int(plan.scale)  # away from all bodies, where the light comes from the left
    assert dense[row, 16].sum() < dense[row, 30].sum() - 20


def inner_pixels(scene, plan, stage):
    """Mask [H, W] of each body's pixels whose centres are 2 px or more inside its rim, without its neighbours'."""
    points = np.stack(np.meshgrid(np.arange(plan.width) + 0.5, plan.height - 0.5 - np.arange(plan.height)), -1)
    around = [points + 2 * np.array(way) for way in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    bodies = [Body(scene, stage, plan, slot) for slot in range(plan.layout.slots)]
    return [np.all([body.surface(part)[0] for part in around], 0) for body in bodies]


@pytest.mark.parametrize("form", [TILES, DENSE])
def test_shadows_fall_on_the_objects_behind_theirs_and_on_no_others(form):
    """The capsule's on the first disc, the third disc's on the second; by as much as the shadow mask says."""
    scene, plan, stage = staged((), 88)
    opaque = stage.paint.shadow
    assert opaque is not None
    bare = stage._replace(paint=stage.paint._replace(shadow=opaque._replace(opacity=jnp.zeros_like(opaque.opacity))))
    image, without = (frames(form, some, plan)[0].astype(int) for some in (stage, bare))
    stages = jax.tree.map(lambda a: a[None], stage)
    share = np.asarray(shadow.annotate(stages, None, plan, on=True)["surface/shadow"])[0, 0, ..., None] / 255
    behind, second, third, capsule, box, *_ = inner_pixels(scene, plan, stage)
    for below in (behind, second):
        assert (without - image)[below].sum(-1).max() > 40
        expected = without + share * (np.asarray(opaque.color) - without)
        assert np.abs(expected - image)[below].max() < 2.5
    for above in (third, capsule, box):
        assert above.sum() > 20
        assert_array_equal(without[above], image[above])


@pytest.mark.parametrize("form", [TILES, DENSE])
def test_shadows_are_the_same_where_the_camera_may_move(form):
    """Those of walls, which no static layer holds then, fall on the background alone."""
    _, plan, stage = staged((("azimuth", 2.6), ("elevation", 0.25)), 88)  # that of the second wall reaches the first
    still, moving = (frames(form, stage, dataclasses.replace(plan, still=way))[0].astype(int) for way in (True, False))
    assert np.abs(still - moving).max() <= 1


def test_no_layer_copies_a_whole_video():
    """XLA's CPU compiler copies the canvas for each layer where it cannot see that it may be painted in place."""
    stages, plan, *_ = straight_motion(
        {"video": {"frames": 8, "height": 48, "width": 40}, "look": {"name": "studio"}, "annotations": {"masks": True},
         "image": {"occluders": 2, "occluder_front": 0.5}},
        2,
    )  # fmt: skip
    code = TILES.lower(stages, plan).compile().as_text() or ""
    copied = re.findall(r"\[([\d,]+)\]\S* copy\(", code)
    assert all(math.prod(map(int, shape.split(","))) < 8 * 48 * 40 * 3 for shape in copied)
    assert "48,40,3]" in code


# ---- Options


def test_defaults_are_those_of_the_page():
    options = load_config({"look": "studio"}).look.options
    drawn = [getattr(options, name).support[0] for name in ("azimuth", "elevation", "softness", "ambient")]
    assert drawn == [2.2, 0.75, 0.3, 0.3]
    assert [options.stripe, options.gloss.support[0], options.shadow.support[0]] == [0.22, 0.45, 0.4]
    assert options.material == ("rubber",)


def test_materials_are_those_of_the_page():
    found = {name: (m.slope, m.gloss, m.sharpness) for name, m in studio.MATERIALS.items()}
    assert found == {
        "rubber": (0.95, 1.2, 40),
        "wood": (0.9, 0.15, 12),
        "metal": (0.95, 1.5, 60),
        "paper": (0.3, 0, 10),
    }
    assert (studio.MATERIALS["metal"].mirror, studio.FLATTER) == (0.85, 0.6)


def test_light_and_materials_are_drawn_from_distributions():
    look = {"name": "studio", "azimuth": [0, 6], "elevation": [0.4, 1.2], "material": ["wood", "metal", "rubber"]}
    config, (scene, plan, _) = load_config({"look": look}), staged((), 88)
    keys = jax.random.split(jax.random.key(0), 100)
    paint = jax.vmap(lambda key: render.paint_of(key, config, scene, plan.layout))(keys)
    assert paint.light is not None
    assert paint.surface is not None
    direction, surface = np.asarray(paint.light.direction), paint.surface
    assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-6)
    elevation = np.arcsin(direction[:, 2])
    assert 0.4 <= elevation.min() < 0.5
    assert 1.1 < elevation.max() <= 1.2
    assert np.ptp(np.arctan2(direction[:, 1], direction[:, 0])) > 5
    moving = np.isfinite(np.asarray(scene.objects.mass))
    assert len(np.unique(surface.sharpness[:, moving])) == 3
    assert len(np.unique(surface.sharpness[:, ~moving])) == 1
    one = render.paint_of(keys[0], config, scene, plan.layout)
    jax.tree.map(lambda a, b: assert_array_equal(a, b[0]), one, paint)


def rolled(*overrides, videos=4) -> Any:
    """Fields by name, and stages, of the first videos of a config in the look `studio`."""
    video = ["video.frames=2", "video.height=24", "video.width=24", f"storage.batch_size={videos}"]
    rollout = Rollout(load_config("bouncing.yaml", ["look=studio", *video, *overrides]), jax.devices()[:1])
    (batch,) = rollout.start("train", np.arange(videos))
    columns = rollout.host_columns([batch])[0]
    return columns | rollout.schema.host_columns(columns, "train"), batch.render_scenes, rollout.schema


def test_the_light_and_the_materials_of_each_video_are_stored():
    drawn = ("look.azimuth=[0,3]", "look.elevation=[0.4,1.2]", "look.shadow=[0.2,0.5]")
    material = ("look.material=[paper,wood,metal]", "look.material_by=elasticity")
    columns, stages, schema = rolled(*drawn, *material, "scene.elasticity=[0,1]", videos=8)
    x, y, z = np.asarray(stages.paint.light.direction, float).T
    assert_allclose(columns["look/azimuth"], np.arctan2(y, x), atol=1e-6)
    assert_allclose(columns["look/elevation"], np.arcsin(z), atol=1e-6)
    for name, used in (("shadow", stages.paint.shadow.opacity), ("ambient", stages.paint.light.ambient)):
        assert_array_equal(columns[f"look/{name}"], used)
    assert len(np.unique(columns["look/azimuth"])) == 8
    assert {name for name in schema.fields if name.startswith("look/")} == {
        f"look/{name}" for name in ("azimuth", "elevation", "softness", "ambient", "gloss", "shadow")
    }
    present = columns["objects/present"] & np.isfinite(columns["objects/mass"])
    third = np.minimum(columns["objects/elasticity"] * 3, 2).astype(int)
    expected = np.array([b"paper", b"wood", b"metal"])[third]
    assert_array_equal(columns["objects/material_name"][present], expected[present])
    assert len(np.unique(expected[present])) == 3


def test_materials_by_two_properties_are_two_programs():
    """They differ in the input that they read alone, of the same shape."""
    hashes = set()
    for by in ("elasticity", "friction"):
        look = {"name": "studio", "material": ["paper", "wood"], "material_by": by}
        config = load_config({"look": look, "video": {"frames": 2}, "storage": {"batch_size": 2}})
        hashes.add(Rollout(config, jax.devices()[:1]).programs["stage"].sha256)
    assert len(hashes) == 2


def test_what_the_look_or_the_images_of_a_split_lack_is_stored_as_nothing():
    splits = {"train": {}, "test": {"look": "flat", "image": {"occluders": 1}}}
    config = load_config({"look": "studio", "video": {"frames": 2}, "image": {"occluders": 2}, "splits": splits})
    schema = Rollout(config, jax.devices()[:1]).schema
    assert schema.fields["occluders/box"].shape(schema.sizes) == (2, 4)
    objects = {"objects/present": np.ones((3, 4), bool), "objects/color": np.zeros((3, 4, 3), np.uint8)}
    box = np.ones((3, 1, 4), np.float32)
    host = schema.host_columns({**objects, "occluders/box": box}, "test")
    assert np.isnan(host["look/azimuth"]).all()
    assert_array_equal(host["occluders/box"], np.concatenate([box, 0 * box], 1))
    assert not host["occluders/color"].any()


def test_occluders_are_stored_with_the_objects_behind_them():
    columns, stages, _ = rolled("image.occluders=3", "image.occluder_front=[0,1]", "scene.balls=6")
    assert_array_equal(columns["occluders/box"], stages.occluders.box)
    moving = np.isfinite(columns["objects/mass"])
    behind = columns["objects/depth"][:, None] < columns["occluders/depth"][..., None]
    assert_array_equal((behind & moving[:, None]).sum(-1), stages.occluders.rank)
    assert behind[:, :, ~moving[0]].all()
    assert len(np.unique(stages.occluders.rank)) > 3


def test_class_names_are_the_nouns_of_the_objects():
    columns, _, schema = rolled("annotations.classes=true", "scene.balls=[1,3]")
    moving = np.isfinite(columns["objects/mass"])
    names = np.where(moving, b"ball", b"wall").astype(schema.fields["objects/class_name"].dtype)
    assert_array_equal(columns["objects/class_name"], np.where(columns["objects/present"], names, b""))
    assert not columns["objects/present"].all()


def test_a_look_that_samples_an_option_without_saying_so_is_one_sentence(tmp_path):
    path = tmp_path / "bright.py"
    path.write_text(SILENT)
    config = load_config({"look": str(path), "video": {"frames": 2}})
    with pytest.raises(ConfigError, match=r"samples the option level, but Paint\.sampled must hold") as error:
        Rollout(config, jax.devices()[:1]).start("train", np.arange(512))
    assert "\n" not in str(error.value)


def test_a_look_whose_paint_lacks_a_part_that_it_declares_is_one_sentence(tmp_path):
    path = tmp_path / "bright.py"
    path.write_text(SILENT.replace("margin=line_margin)", 'margin=line_margin, parts=("surface",))'))
    config = load_config({"look": str(path), "video": {"frames": 2}})
    with pytest.raises(ConfigError, match=r"has 'surface' in Look\.parts, but its paint has no surface"):
        Rollout(config, jax.devices()[:1]).start("train", np.arange(512))


SILENT = '''"""Grey objects."""

import dataclasses

from gen2d.plugin import Distribution, Look, PlainOptions, line_margin, option, plain


@dataclasses.dataclass(frozen=True)
class Options(PlainOptions):
    level: Distribution = option([0, 255], float, "sRGB", "level of all objects", low=0, high=255, draw=True)


def paint(scene, layout, options, key):
    base = plain(scene, layout, options, key)
    return base._replace(color=0 * base.color + options.level.sample(key, ()))


LOOK = Look(options=Options, paint=paint, margin=line_margin)
'''
