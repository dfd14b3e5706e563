"""Frames: both forms the same image, which is the one that exact areas give, painted in NumPy in float64."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tiny import CONFIG
from worlds import outline, polygon_areas, straight_motion

from gen2d.config.config import load_config
from gen2d.core.enums import SHAPES, STATIC
from gen2d.programs import shared
from gen2d.programs.rollout import DeviceBatch, Rollout
from gen2d.records.layout import Layout, SlotGroup
from gen2d.renderers import rasterizer, tiles
from gen2d.renderers.camera import CameraView
from gen2d.renderers.compositing import OCCLUDER
from gen2d.renderers.look import LINES
from gen2d.renderers.paint import Background, Paint, Texture
from gen2d.renderers.plan import FramePlan, Occluders, RenderScene
from gen2d.renderers.primitives import BodyGeometry, Instants
from gen2d.renderers.sensor import Sensor

PATCHES, DENSE = (jax.jit(form, static_argnums=1) for form in (rasterizer.draw_tiles, rasterizer.draw_dense))
SOFT = jax.jit(jax.vmap(rasterizer.draw_soft, in_axes=(0, None)), static_argnums=1)
REACH = 1.5  # m, of all that moves


# ---- Random scenes


def shapes(rng, layout):
    """Bodies of every run, with polygons that are convex and of REACH at most, some corners given more than once."""
    slots, most = layout.slots, max(run.vertices for run in layout.groups)
    radius, half = rng.uniform(0.1, REACH / 2, slots), rng.uniform(0, REACH / 2, slots)
    vertices = np.zeros((slots, most, 2))
    for run, first in layout.spans:
        for slot in range(first, first + run.count):
            count = rng.integers(3, run.vertices + 1) if run.vertices else 0
            angle = (np.arange(count) + rng.uniform(0, 0.8, count)) * (2 * np.pi / max(count, 1))
            size = REACH / 2 * rng.uniform(0.4, 1, 2)
            corners = size * np.stack([np.cos(angle), np.sin(angle)], -1)
            corners -= corners.mean(0) if count else 0  # about a point within
            vertices[slot] = np.concatenate([corners, np.repeat(corners[-1:], most - count, 0)]) if count else 0
            if run.kind == STATIC:
                half[slot], radius[slot] = 4.0, (0.0 if run.shape == "segment" else 150.0)
        if run.shape == "polygon" and not run.rounded:
            radius[first : first + run.count] = 0
    return BodyGeometry(*map(jnp.asarray, (radius, half, vertices)))


def painted(rng, layout, plan, features):
    """Random colours, and those features of a paint that are named; a tenth of the slots is not drawn."""
    slots, line = layout.slots, np.zeros(layout.slots)
    for run, first in layout.spans:
        line[first : first + run.count] = plan.grow * (run.shape == "segment")

    def colors(*shape):
        return jnp.asarray(rng.integers(0, 256, (*shape, 3)), float)

    def seeds(*shape):
        return jnp.asarray(rng.integers(2**32, size=shape, dtype=np.uint32))

    background = Background(colors())
    if "gradient" in features:
        background = background._replace(to_color=colors(), direction=rng.uniform(0, 6))
    if "noise" in features:
        background = background._replace(texture=Texture(seeds(), jnp.asarray(1.3), colors()))
    known = {
        "rim": {"rim": rng.uniform(0, 3, slots), "rim_color": colors(slots), "fill": colors(slots)},
        "mark": {"mark": rng.uniform(0, 0.5, slots), "mark_color": colors(slots)},
        "shade": {"shade": rng.uniform(0, 1, slots)},
        "texture": {"texture": Texture(seeds(slots), jnp.full(slots, 0.7), colors(slots))},
    }
    paint = Paint(background, colors(slots), rng.random(slots) < 0.9, grow=jnp.asarray(line))
    for name in features:
        paint = paint._replace(**known.get(name, {}))
    return paint


def instants(rng, layout, plan, shape):
    """Places, also beyond the frame, angles and views at instants of some shape."""
    size = np.array([plan.width, plan.height]) / plan.scale
    places = rng.uniform(-0.6, 0.6, (*shape, layout.slots, 2)) * size
    angles = rng.uniform(-4, 4, (*shape, layout.slots))
    for run, first in layout.spans:
        slots = slice(first, first + run.count)
        if run.kind == STATIC and run.shape == "circle":  # its rim in the frame
            places[..., slots, :] = [0, -150]
        elif run.kind == STATIC and plan.still:
            places[..., slots, :], angles[..., slots] = [0.6, 0.3], np.arange(run.count) * np.pi / 2
    still = jnp.zeros(shape)
    if plan.still:
        return Instants(places, angles, CameraView(jnp.zeros((*shape, 2)), still + plan.scale, still))
    view = CameraView(
        rng.uniform(-1, 1, (*shape, 2)), rng.uniform(0.6, 1, shape) * plan.scale, rng.uniform(-3, 3, shape)
    )
    return Instants(places, angles, view)


def stages(plan, videos, frames, features=(), occluders=0, noise=None, seed=0):
    """Random videos of a plan's layout."""
    made = []
    for video in range(videos):
        rng = np.random.default_rng([seed, video])
        low = rng.uniform(0, 0.8, (occluders, 2)) * [plan.width, plan.height]
        box = np.concatenate([low, low + rng.uniform(1, 9, (occluders, 2))], -1)
        moving = plan.moving
        color, rank = rng.integers(0, 256, (occluders, 3)) * 1.0, np.sort(rng.integers(0, moving + 1, occluders))
        some = Occluders(*map(jnp.asarray, (box, color, rank)))
        exposed = instants(rng, plan.layout, plan, (frames, plan.exposed)) if plan.exposed else None
        made.append(
            RenderScene(
                shapes(rng, plan.layout),
                instants(rng, plan.layout, plan, (frames,)),
                exposed,
                painted(rng, plan.layout, plan, features),
                some if occluders else None,
                None if noise is None else Sensor(noise=jnp.float32(noise)),
                jnp.uint32(video),
            )
        )
    return jax.tree.map(lambda *a: _single(np.stack(a)), *made)


def _single(array):
    return array.astype({"f": np.float32, "i": np.int32}.get(array.dtype.kind, array.dtype))


# ---- The same in NumPy


def layers(stage, plan, t):
    """Names, exact coverages [H, W] and colours [3] of all that one video shows at frame t, from back to front."""
    order = sorted(
        plan.layout.spans, key=lambda span: span[0].layer if span[0].layer is not None else span[0].kind != STATIC
    )
    found, behind = [], len(order)
    for number, (run, _) in enumerate(order):
        if not plan.still or run.kind != STATIC:
            behind = min(behind, number)
    standing = [] if stage.occluders is None else list(zip(*stage.occluders, strict=True))
    rank = 0

    def stand(until):
        while standing and standing[0][2] <= until:
            box, color, _ = standing.pop(0)
            left, top, right, bottom = np.asarray(box, float)
            corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
            found.append((OCCLUDER, polygon_areas(corners, plan.height, plan.width), np.asarray(color, float)))

    for number, (run, first) in enumerate(order):
        for slot in range(first, first + run.count):
            if number >= behind:
                stand(rank)
                rank += 1
            if not stage.paint.drawn[slot]:
                continue
            core, radius = placed(stage, plan, t, run, slot)
            edge = outline(core, radius, 2**15 if radius > 99 else 4096)
            found.append((slot + 1, polygon_areas(edge, plan.height, plan.width), np.float64(stage.paint.color[slot])))
    stand(np.inf)
    return found


def placed(stage, plan, t, run, slot):
    """The corners [V, 2] of a slot's core and its radius, px."""
    bodies, at = stage.bodies, stage.instants
    center, scale, turn = (np.asarray(part[t], float) for part in at.view)
    half = bodies.half_length[slot]
    core = {"circle": [[0, 0]], "polygon": bodies.vertices[slot]}.get(run.shape, [[-half, 0], [half, 0]])
    world = turned(np.float64(core), at.angle[t, slot]) + at.position[t, slot]
    x, y = (scale * turned(world - center, -turn)).T
    sharp = run.shape == "polygon" and not run.rounded
    radius = 0.0 if sharp else float(bodies.radius[slot] * scale + stage.paint.grow[slot])
    return np.stack([plan.width / 2 + x, plan.height / 2 - y], -1), radius


def turned(points, angle):
    """Points [..., 2] turned counter-clockwise."""
    cos, sin = np.cos(np.float64(angle)), np.sin(np.float64(angle))
    return points @ np.array([[cos, sin], [-sin, cos]])


def exact_frame(stage, plan, t):
    """One frame [H, W, 3] of plain paint, in float64."""
    image = np.broadcast_to(np.float64(stage.paint.background.color), (plan.height, plan.width, 3))
    for _, cover, color in layers(stage, plan, t):
        image = image + cover[..., None] * (color - image)
    return image


def shares(stage, plan, t):
    """How much of each pixel shows each name [256, H, W]."""
    found = np.zeros((256, plan.height, plan.width))
    found[0] = 1
    for name, cover, _ in layers(stage, plan, t):
        found *= 1 - cover
        found[name] += cover
    return found


def video(stages, i):
    """One video of some, as NumPy arrays."""
    return jax.tree.map(lambda a: np.asarray(a[i]), stages)


# ---- Both forms, and exact areas

ROUNDED = SlotGroup("polygon", 2, vertices=4, rounded=True)
MIXED = (
    SlotGroup("circle", 2, layer=3),  # drawn last
    SlotGroup("circle", 1, STATIC),
    SlotGroup("capsule", 2),
    SlotGroup("polygon", 2, vertices=5),
)
ALL = ("gradient", "rim", "mark", "shade", "texture")


def plan_for(runs, height, width, **options):
    return FramePlan(Layout(runs, reach=REACH), height, width, 3.7, grow=0.75, **options)


CASES = {
    "plain": (plan_for(MIXED, 24, 40, owners=True), {"videos": 6, "occluders": 2}),
    "painted": (
        plan_for((SlotGroup("circle", 6),), 6, 50, still=False, owners=True),
        {"videos": 3, "features": ALL, "occluders": 3},
    ),
    "blurred": (
        plan_for((SlotGroup("circle", 2), SlotGroup("circle", 1, STATIC)), 33, 29, still=False, linear=True, exposed=3),
        {"videos": 3, "features": ("gradient", "noise"), "noise": 5.0},
    ),
    "everything": (
        plan_for((*MIXED, SlotGroup("segment", 2, STATIC), ROUNDED), 33, 40, still=False, linear=True, owners=True),
        {"videos": 4, "features": (*ALL, "noise"), "occluders": 3},
    ),
}
TIERS = {"everything": pytest.mark.slow, "painted": pytest.mark.full}
TIERED = [pytest.param(case, marks=TIERS.get(case, ())) for case in CASES]


def drawn_as(form, some, plan):
    """The frames in one form, and the owners if they are wanted."""
    frames, owners = form(some, plan)
    return np.asarray(frames), None if owners is None else np.asarray(owners)


@functools.cache
def drawn(case, seed=0):
    """A case's stages, and its frames and owners in both forms."""
    plan, options = CASES[case]
    some = stages(plan, frames=2, seed=seed, **options)
    return some, drawn_as(PATCHES, some, plan), drawn_as(DENSE, some, plan)


def difference_of_forms(case, seed):
    """Differences [n, T, H, W, 3] of the frames of both forms in grey levels; fails if owners differ but for ties."""
    some, (frames, owners), (dense_frames, dense_owners) = drawn(case, seed)
    assert frames.std() > 20
    if owners is not None:
        assert dense_owners is not None
        plan = CASES[case][0]
        for v, t, row, column in np.argwhere(owners != dense_owners):
            share = shares(video(some, v), plan, t)[:, row, column]
            assert_allclose(share[owners[v, t, row, column]], share[dense_owners[v, t, row, column]], atol=1e-3)
    return np.abs(frames.astype(int) - dense_frames)


@pytest.mark.parametrize("case", TIERED)
def test_patches_and_dense_are_one_image(case):
    apart = difference_of_forms(case, 0)
    print(f"{case}: frames differ by {apart.max()} at most, in {(apart > 0).mean():.1e} of all values")
    assert apart.max() <= 1


def test_patches_of_a_video_longer_than_a_block_are_those_of_its_frames():
    plan = plan_for((SlotGroup("circle", 4), SlotGroup("circle", 1, STATIC)), 20, 36)
    some = stages(plan, frames=tiles.BLOCK + 3, seed=0, videos=4)
    (frames, _), (dense, _) = (drawn_as(form, some, plan) for form in (PATCHES, DENSE))
    assert frames.std() > 20
    assert np.abs(np.diff(frames.astype(int), axis=1)).max((2, 3, 4)).min() > 20
    assert np.abs(frames.astype(int) - dense).max() <= 1


def test_a_patch_holds_what_a_look_adds_to_the_rims_of_these_shapes():
    disc, line = SlotGroup("circle", 1), SlotGroup("segment", 1)
    for grown, added in ((SHAPES, (0.75, 0.75)), (LINES, (0.0, 0.75)), ((), (0.0, 0.0))):
        plan = plan_for((disc, line), 24, 40, grown=grown)
        assert [plan.largest(run) - REACH * plan.scale for run in (disc, line)] == pytest.approx(added)


@pytest.mark.slow
def test_patches_and_dense_are_one_image_in_a_thousand_frames():
    count, differ, most = 0, [], 0
    for seed in itertools.count(1):
        for case in CASES:
            apart = difference_of_forms(case, seed)
            drawn.cache_clear()
            count, most = count + apart.shape[0] * apart.shape[1], max(most, apart.max())
            differ.append((apart > 0).mean())
        if count >= 1000:
            break
    print(f"{count} frames differ by {most} at most, in {np.mean(differ):.1e} of all values")
    assert most <= 1


def test_frames_are_those_of_exact_areas():
    plan, _ = CASES["plain"]
    some, (frames, _), _ = drawn("plain")
    soft = np.asarray(SOFT(some, plan))
    exact = np.array([[exact_frame(video(some, v), plan, t) for t in range(2)] for v in range(len(frames))])
    rounding = 1 + plan.layout.slots / 2  # half a level of each layer
    for name, made, most in (("soft", soft, 0.1), ("hard", frames, rounding)):
        error = np.abs(made - exact)
        print(f"{name} frames: mean {error.mean():.4f}, most {error.max():.3f} of 255")
        assert error.max() <= most
    assert np.abs(frames - soft).max() <= rounding


@pytest.mark.parametrize("case", ["plain", "painted"])
def test_a_pixel_is_owned_by_what_is_seen_most_of(case):
    plan, options = CASES[case]
    some, (_, owners), _ = drawn(case)
    assert owners is not None
    ties = 0
    for v, t in np.ndindex(options["videos"], 2):
        share = shares(video(some, v), plan, t)
        own = np.take_along_axis(share, owners[v, t][None].astype(int), 0)[0]
        assert_allclose(own, share.max(0), atol=2e-3)
        ties += (owners[v, t] != share.argmax(0)).sum()
    print(f"{case}: {ties} of {owners.size} owners are others of ties; {len(np.unique(owners))} owners")
    assert ties <= 1e-3 * owners.size
    assert len(np.unique(owners)) > 5


def inset(corners, width):
    """The points of a convex polygon that are so far from its sides, as corners [V, 2], without an area one point; and
    whether the rim leaves out the centre, or a side."""
    kept = corners = np.unique(corners, axis=0)
    kept = corners = corners[np.argsort(np.arctan2(*(corners - corners.mean(0)).T[::-1]))]
    sides = np.roll(corners, -1, axis=0) - corners
    normals = np.stack([-sides[:, 1], sides[:, 0]], -1) / np.hypot(*sides.T)[:, None]
    middle = ((corners.mean(0) - corners) * normals).sum(-1).min()
    for begin, normal in zip(corners, normals, strict=True):
        depth, found = (kept - begin) @ normal - width, []
        for i in range(len(kept)):
            if depth[i - 1] * depth[i] < 0:
                found.append(kept[i - 1] + (kept[i] - kept[i - 1]) * depth[i - 1] / (depth[i - 1] - depth[i]))
            if depth[i] >= 0:
                found.append(kept[i])
        if len(found) < 3:
            return corners[:1], True
        kept = np.array(found)
    return kept, width > 0.99 * middle or len(kept) < len(corners)


RIMMED = {"circle": SlotGroup("circle", 1), "polygon": SlotGroup("polygon", 1, vertices=4)}
RIMMED |= {"capsule": SlotGroup("capsule", 1), "rounded polygon": SlotGroup("polygon", 1, vertices=4, rounded=True)}


@pytest.mark.parametrize(
    "shape", [*list(RIMMED)[:2], *(pytest.param(shape, marks=pytest.mark.slow) for shape in list(RIMMED)[2:])]
)
def test_a_rim_is_what_lies_within_a_width_of_the_edge(shape):
    run, size = RIMMED[shape], 32
    plan = plan_for((run,), size, size)
    made = stages(plan, 32, 1, ("rim",), seed=7)
    paint = made.paint._replace(
        background=Background(jnp.zeros((32, 3))),
        fill=jnp.zeros((32, 1, 3)),
        rim_color=jnp.full((32, 1, 3), 255.0),
        drawn=jnp.ones((32, 1), bool),
    )
    made = made._replace(paint=paint)
    found = np.asarray(SOFT(made, plan))[:, 0, :, :, 0] / 255
    worst = {True: 0.0, False: 0.0}
    for v in range(32):
        one = video(made, v)
        ((_, whole, _),) = layers(one, plan, 0)
        core, radius = placed(one, plan, 0, run, 0)
        rim = float(one.paint.rim[0])
        inner, wide = (outline(core, radius - rim) if radius > rim else core[:1]), False
        if run.shape == "polygon" and radius <= rim:
            inner, wide = inset(core, rim - radius)
        error = np.abs(found[v] - (whole - polygon_areas(inner, size, size))).max()
        worst[wide] = max(worst[wide], error)
    print(
        f"{shape}: a rim is off by {255 * worst[False]:.3f} of 255 at most, by {255 * worst[True]:.0f} where it is wide"
    )
    assert worst[False] < 1e-3
    assert worst[True] < 0.3  # a polygon's centre, or a short side, lies in its rim: less exact


# ---- How colours mix, noise, motion blur


@pytest.mark.parametrize("form", ["patches", "dense"])
@pytest.mark.parametrize(("linear", "half", "light"), [(False, 128, 64), (True, 188, 137)])
def test_a_pixel_half_of_white_is_half_of_its_values_or_half_of_its_light(form, linear, half, light):
    plan = plan_for((SlotGroup("polygon", 1, vertices=4),), 16, 16, linear=linear)
    corners = np.array([[-1, -1], [0.5, -1], [0.5, 1], [-1, 1]]) / plan.scale  # its right side in the middle of a pixel
    some = video(stages(plan, 1, 1), 0)
    some = some._replace(
        bodies=some.bodies._replace(vertices=corners.astype(np.float32)[None]),
        instants=some.instants._replace(position=np.zeros((1, 1, 2), np.float32), angle=np.zeros((1, 1), np.float32)),
        paint=some.paint._replace(
            color=np.full((1, 3), 255, np.float32),
            background=Background(jnp.zeros(3)),
            drawn=np.ones(1, bool),
        ),
    )
    lower = jax.tree.map(lambda a: a.copy(), some)  # half a pixel lower, its corner covers a quarter of one
    lower.instants.position[..., 1] = -0.5 / plan.scale
    frames, _ = {"patches": PATCHES, "dense": DENSE}[form](jax.tree.map(lambda *a: np.stack(a), some, lower), plan)
    assert_allclose(frames[0, 0, 7, 6:10, 0], [0, 255, half, 0], atol=1)
    assert_allclose(frames[1, 0, 9, 8, 0], light, atol=1)


def test_noise_is_as_strong_as_asked_and_another_in_each_frame():
    plan = plan_for((SlotGroup("circle", 1),), 48, 64)
    some = stages(plan, 4, 3, noise=6.0)
    some = some._replace(
        paint=some.paint._replace(drawn=np.zeros((4, 1), bool), background=Background(jnp.full((4, 3), 100.0))),
        sensor=Sensor(noise=jnp.float32([6, 6, 6, 0.8])),
        seed=np.asarray([1, 1, 2, 3], np.uint32),
    )
    noise = np.asarray(PATCHES(some, plan)[0]).astype(float) - 100
    values = noise[0].size
    for v, deviation in enumerate([6, 6, 6, 0.8]):
        spread = np.sqrt(deviation**2 + 1 / 12)  # rounded to whole levels
        assert abs(noise[v].mean()) < 4 * spread / np.sqrt(values)
        assert_allclose(noise[v].std(), spread, rtol=4 / np.sqrt(2 * values))
    assert_array_equal(noise[0], noise[1])
    flat = noise[[0, 2]].reshape(6, -1)  # six frames
    limit = 5 / np.sqrt(values / 3)
    assert np.abs(np.corrcoef(flat) - np.eye(6)).max() < limit
    for axis in (1, 2, 3):  # rows, columns, colours
        one, other = (
            noise[0].take(range(noise[0].shape[axis] - 1), axis),
            noise[0].take(range(1, noise[0].shape[axis]), axis),
        )
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < limit


BALL = {
    "video": {"frames": 6, "fps": 20, "height": 48, "width": 64},
    "scene": {"name": "bouncing", "balls": 1, "radius": 0.8, "velocity": [[-6, 6], [-6, 6]], "gravity": [0, 0],
              "color": [255, 255, 255]},
    "look": {"name": "flat", "background": [0, 0, 0], "wall_width": 0},
}  # fmt: skip


def centroids(frames):
    """The centroids [n, T, 2] of light, columns and rows in px."""
    light = np.asarray(frames)[..., 0].astype(float)
    total = light.sum((-2, -1))
    columns, rows = (
        light.sum(axis) @ (np.arange(size) + 0.5) for axis, size in ((-2, light.shape[-1]), (-1, light.shape[-2]))
    )
    return np.stack([columns, rows], -1) / total[..., None]


@pytest.mark.full
@pytest.mark.parametrize(("shutter", "exposure", "lag"), [("end", 1, 0.5), ("centre", 0.6, 0.0)])
def test_a_moving_ball_is_blurred_along_its_path(shutter, exposure, lag):
    """The centroid of its blur is at the annotated centre, or half an exposure behind it, in all frames."""
    image = {"exposure": exposure, "exposure_samples": 8, "shutter": shutter}
    blurred, plan, _, _ = straight_motion({**BALL, "image": image}, 16)
    frames = np.asarray(PATCHES(blurred, plan)[0])
    at = jax.tree.map(np.asarray, blurred.instants)
    inside = (np.abs(at.position[:, :, 0] - 5) < 5 - 0.8).all((1, 2))  # all of it in all frames, before and after
    step = at.position[:, 1, 0] - at.position[:, 0, 0]  # m/frame
    for beyond in (at.position[:, 0, 0] - step, at.position[:, -1, 0] + step):
        inside &= (np.abs(beyond - 5) < 5 - 0.8).all(1)
    assert inside.sum() >= 5
    scale = at.view.scale[..., None]
    middle = at.position[:, :, 0] - lag * exposure * step[:, None]
    expected = np.array([32, 24]) + (middle - 5) * scale * [1, -1]
    off = np.abs(centroids(frames) - expected)[inside].max()
    print(f"{shutter}: a blurred ball is off by {off:.4f} px from the middle of its path, {inside.sum()} videos")
    assert off < 0.02
    # The mean of sharp frames at the instants of its exposures.
    assert blurred.exposed is not None
    shape = blurred.exposed.angle.shape
    sharp = blurred._replace(
        instants=jax.tree.map(lambda a: a.reshape(len(a), -1, *a.shape[3:]), blurred.exposed), exposed=None
    )
    drawn, _ = PATCHES(sharp, dataclasses.replace(plan, exposed=0))
    assert_allclose(frames, np.asarray(drawn, float).reshape(*shape[:3], *frames.shape[2:]).mean(2), atol=0.51)


def test_a_centred_exposure_is_symmetric_about_its_frame_also_for_the_camera():
    """Instants before and after a frame; the motion of ball and camera is uniform, and its zoom linear in between."""
    image = {"exposure": 0.5, "exposure_samples": 4, "shutter": "centre"}
    camera = {"pan": [1.5, -0.5], "turn": 0.7, "zoom": 3}
    scenes, _, _, states = straight_motion({**BALL, "image": image, "camera": camera}, 2)
    assert scenes.exposed is not None
    apart = np.array([-0.1875, -0.0625, 0.0625, 0.1875]) / BALL["video"]["fps"]  # s
    time = np.arange(BALL["video"]["frames"])[:, None] / BALL["video"]["fps"] + apart
    start, velocity = (np.asarray(a)[:, None, None, 0] for a in (states.position[:, :1], states.velocity[:, :1]))
    assert_allclose(scenes.exposed.position, start + velocity * time[..., None, None], atol=1e-5)
    center = 5 + np.array(camera["pan"]) * time[..., None]
    assert_allclose(scenes.exposed.view.center, np.broadcast_to(center, (2, *center.shape)), atol=1e-5)
    assert_allclose(scenes.exposed.view.angle, np.broadcast_to(camera["turn"] * time, (2, *time.shape)), atol=1e-6)
    scale = np.asarray(scenes.instants.view.scale, float)
    scale = np.concatenate([2 * scale[:, :1] - scale[:, 1:2], scale, 2 * scale[:, -1:] - scale[:, -2:-1]], 1)
    frames = np.arange(-1, scale.shape[1] - 1) / BALL["video"]["fps"]
    assert_allclose(scenes.exposed.view.scale, [np.interp(time, frames, own) for own in scale], rtol=1e-5)


@pytest.mark.full
def test_a_parser_of_colours_measures_the_speed_of_a_ball():
    """As in PhyWorld (Kang et al., arXiv 2411.02385); frames aligned by their corners would be off by 1/255 of it."""
    scene = {**BALL["scene"], "radius": [0.7, 1.4], "velocity": [[-3, 3], [-3, 3]], "color": [255, 0, 0]}
    config = {**BALL, "scene": scene, "video": {"frames": 32, "fps": 30, "height": 256, "width": 256}}
    some, plan, _, states = straight_motion(config, 24)
    room = 5 - np.asarray(some.bodies.radius)[:, :1, None]
    inside = np.flatnonzero((np.abs(np.asarray(states.position)[:, :, 0] - 5) < room).all((1, 2)))[:8]
    assert len(inside) == 8
    some = jax.tree.map(lambda a: a[inside], some)
    red = np.asarray(PATCHES(some, plan)[0])[..., 0] / 255
    true = np.linalg.norm(np.asarray(states.velocity)[inside, 0, 0], axis=-1)
    time = np.arange(32) / 30
    for kind, weight in (("weighted", red), ("thresholded", (red > 0.5).astype(float))):
        places = centroids(weight[..., None]) / 256 * 10
        velocity = np.polyfit(time, np.moveaxis(places, 1, 0).reshape(32, -1), 1)[0].reshape(-1, 2)
        error = np.abs(np.linalg.norm(velocity, axis=-1) - true)
        print(
            f"{kind}: speeds off by {error.mean():.5f} m/s on the mean, {error.max():.5f} at most, of {true.mean():.1f}"
        )
        assert error.mean() < 1e-3


# ---- Programs


def test_batches_share_one_program():
    config = load_config(CONFIG)
    shared.clear()
    rollout = Rollout(config, jax.devices()[:1])
    count = config.storage.batch_size
    assert count is not None
    every, *_ = straight_motion(config, 3 * count)
    for first in range(0, 3 * count, count):
        batch = DeviceBatch(
            {}, jax.tree.map(lambda a, first=first: a[first : first + count], every), jnp.ones(count, bool)
        )
        for start in (0, 2):
            (made,) = rollout.draw([batch], start, 2)
            assert made["frames"].shape[0] == 2
    loaded = [key for key, program in shared._programs if program._loaded]
    assert sum("draw_program" in key for key in loaded) == 1


# ---- Derivatives


def test_frames_change_as_their_slopes_say():
    plan = plan_for((SlotGroup("circle", 1), SlotGroup("polygon", 1, vertices=4)), 20, 24, still=False)
    made, weight = stages(plan, 1, 2, seed=5), np.random.default_rng(6).uniform(-1, 1, (2, 20, 24, 3))
    made = video(made, 0)._replace(seed=None)
    made = made._replace(paint=made.paint._replace(drawn=np.ones(2, bool)))
    at = made.instants._replace(position=made.instants.position / 4)  # all of it in the frame
    real = {"bodies": made.bodies, "instants": at, "color": made.paint.color, "behind": made.paint.background.color}

    def staged(real):
        paint = made.paint._replace(color=real["color"], background=Background(real["behind"]))
        return made._replace(bodies=real["bodies"], instants=real["instants"], paint=paint)

    def soft(real):
        return (np.float32(weight) * rasterizer.draw_soft(staged(real), plan)).sum()

    def exact(real):
        return sum((weight[t] * exact_frame(staged(real), plan, t)).sum() for t in range(2))

    slopes = jax.jit(jax.grad(soft))(real)
    wide = jax.tree.map(np.float64, real)
    leaves, tree = jax.tree.flatten(wide)
    for (path, slope), leaf, number in zip(jax.tree.leaves_with_path(slopes), leaves, range(len(leaves)), strict=True):
        expected = np.zeros(leaf.shape)
        for place in np.ndindex(leaf.shape):
            ends = []
            for step in (1e-4, -1e-4):
                moved = leaf.copy()
                moved[place] += step
                ends.append(exact(jax.tree.unflatten(tree, [*leaves[:number], moved, *leaves[number + 1 :]])))
            expected[place] = (ends[0] - ends[1]) / 2e-4
        error = np.abs(slope - expected).max() / max(np.abs(expected).max(), 1)
        print(f"{jax.tree_util.keystr(path)}: off by {error:.1e} of the largest slope, {np.abs(expected).max():.1f}")
        assert error < 5e-3
