"""Annotations: each obeys its law on random scenes, in several looks, with cameras that stand and that move."""

import functools
import types
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gen2d.annotations import tracks
from gen2d.annotations.boxes import visible_boxes
from gen2d.annotations.visibility import pixel_counts
from gen2d.config import plugins
from gen2d.config.config import load_config
from gen2d.core.errors import ConfigError
from gen2d.programs import redraw, render
from gen2d.programs.rollout import Rollout
from gen2d.records import keys as keys_module
from gen2d.records import scene as scene_module
from gen2d.records.layout import Layout, SlotGroup
from gen2d.renderers.primitives import BodyGeometry

CONTRACTS = {name: plugins.load("annotation", name) for name in plugins.names("annotation")}
ALL = [f"annotations.{name}={contract.usual}" for name, contract in CONTRACTS.items() if not contract.needs]
SMALL = [
    "storage.batch_size=4",
    "video.frames=12",
    "video.height=40",
    "video.width=56",
    "annotations.tracks=5",
    "seed=3",
]
CASES = {
    "still": ["look.palette=random"],
    "moving": ["camera.pan=[[-2,2],1]", "camera.turn=0.4", "camera.zoom=0.2", "look=textured"],
    "covered": ["camera.pan=[3,1]", "camera.turn=-0.5", "image.occluders=3"],
    "marked": ["look=marked", "image.occluders=2", "image.occluder_front=[0,1]"],
}


@functools.cache
def simulated():
    """Some videos' fields, and the keys of the videos; their pictures are drawn in several ways."""
    rollout = Rollout(load_config("bouncing.yaml", SMALL), jax.devices()[:1])
    (batch,) = rollout.start("train", np.arange(rollout.batch_size))
    assert np.asarray(batch.placed).all()
    words = jnp.asarray(keys_module.seed_words(3, zlib.crc32(b"train")))
    keys = keys_module.video_keys(words, jnp.arange(4, dtype=jnp.uint32))
    return rollout.host_columns([batch])[0], keys


class Made:
    """The videos, drawn and annotated as a config says."""

    def __init__(self, overrides: list[str]) -> None:
        config = load_config("bouncing.yaml", [*SMALL, *ALL, *overrides])
        self.rollout = Rollout(config, jax.devices()[:1])
        columns, keys = simulated()

        def staged(key, scene, states):
            return render.render_scene(key, config, self.rollout.plan, scene, states)

        scenes, states = redraw.scene_of(columns), redraw.from_columns(scene_module.State, columns)
        stages = jax.jit(jax.vmap(staged))(keys, scenes, states)
        drawn = jax.jit(lambda stages: render.render_frames(stages, self.rollout.plan, config.annotations))(stages)
        seen = render.camera_columns(stages.instants.view)
        self.of = columns | {name: np.asarray(a) for name, a in (drawn | seen).items()}
        self.mask, self.slots = self.of["masks/instance"], self.rollout.layout.slots
        self.stages, self.options = stages, config.annotations


FULL = [pytest.param(case, marks=pytest.mark.full) for case in ("covered", "marked")]


@pytest.fixture(scope="module", params=["still", "moving", *FULL])
def made(request):
    return drawn_as(request.param)


@functools.cache
def drawn_as(case: str) -> Made:
    return Made(CASES[case])


def test_fields_are_as_described(made):
    for name, array in made.of.items():
        field = made.rollout.schema.fields[name]
        assert array.shape[1:] == field.shape(made.rollout.schema.sizes), name
        assert array.dtype == field.dtype or name == "contacts/time", name


@pytest.mark.full
def test_the_form_for_gpus_tells_the_same(made, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    annotated = jax.jit(lambda stages: render.render_frames(stages, made.rollout.plan, made.options))(made.stages)
    assert_array_equal(annotated.pop("masks/instance"), made.mask)
    for name, array in annotated.items():
        here, there = np.asarray(array), made.of[name]
        if here.dtype in (bool, np.uint8):  # an end of a flow on a pixel's edge, half a pixel covered, a level of grey
            assert (np.abs(here.astype(int) - there) > (name == "frames")).mean() < 2e-3, name
        else:
            assert_allclose(here.astype(float), there.astype(float), rtol=2e-3, atol=2e-3, err_msg=name)


def test_visible_boxes_and_counts_are_those_of_the_mask(made):
    for v, t, k in np.ndindex(*made.mask.shape[:2], made.slots):
        rows, columns = np.nonzero(made.mask[v, t] == k + 1)
        assert made.of["visibility/pixels"][v, t, k] == len(rows)
        box = [0] * 4 if not len(rows) else [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        assert_array_equal(made.of["boxes/visible"][v, t, k], box)


@pytest.mark.parametrize(("height", "width"), [(256, 5), (257, 4)])
def test_boxes_and_counts_hold_beyond_the_bits_of_a_word_and_what_a_byte_counts(height, width):
    rng, slots = np.random.default_rng(height), 70
    masks = np.zeros((3, height, width), np.uint8)
    masks[0], masks[1] = 70, rng.integers(0, slots + 1, (height, width))
    masks[1, 100:], masks[2, 2:9, 1:3], masks[2, 0] = 0, 33, 255
    boxes = np.asarray(visible_boxes(jnp.asarray(masks), slots))
    counts = np.asarray(pixel_counts(jnp.asarray(masks), slots))
    for t, k in np.ndindex(3, slots):
        rows, columns = np.nonzero(masks[t] == k + 1)
        assert counts[t, k] == len(rows)
        box = [0] * 4 if not len(rows) else [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        assert_array_equal(boxes[t, k], box)


def test_what_is_seen_lies_in_what_is_there(made):
    boxes, amodal = (made.of[f"boxes/{kind}"] for kind in ("visible", "amodal"))
    seen = made.of["visibility/pixels"] > 0
    grown = amodal + np.array([-1, -1, 1, 1])  # a pixel may be seen most of, of which little is covered
    assert (boxes[seen][:, :2] >= grown[seen][:, :2]).all()
    assert (boxes[seen][:, 2:] <= grown[seen][:, 2:]).all()
    fraction = made.of["visibility/fraction"]
    assert ((fraction >= 0) & (fraction <= 1)).all()
    assert (fraction[~seen] == 0).all()


def test_amodal_masks_are_instance_masks_where_one_object_is_alone_and_have_its_area(made):
    height, width = made.mask.shape[2:]
    bits = np.unpackbits(made.of["masks/amodal"], axis=-1)[..., : height * width].astype(bool)
    bits = bits.reshape(*bits.shape[:3], height, width)
    y, x = np.mgrid[:height, :width][:, None, None, None] + 0.5
    x0, y0, x1, y1 = np.moveaxis(made.of["boxes/amodal"], -1, 0)[..., None, None]
    near = (x > x0 - 1) & (x < x1 + 1) & (y > y0 - 1) & (y < y1 + 1) & (x1 > x0)
    alone = (near.sum(2) == 1) & (made.mask != 255)
    for k in range(made.slots):
        mine = alone & near[:, :, k]
        assert_array_equal((made.mask == k + 1)[mine], bits[:, :, k][mine])
    balls = made.of["objects/shape"][0] == 0
    discs = bits[:, :, balls].sum((3, 4))
    areas = np.pi * (made.of["objects/radius"][:, None, balls] * made.of["camera/scale"][..., None]) ** 2
    box = made.of["boxes/amodal"][:, :, balls]
    whole = (box[..., :2] >= 0).all(-1) & (box[..., 2] <= width) & (box[..., 3] <= height) & (areas > 0)
    assert_allclose(discs[whole], areas[whole], atol=6)


@pytest.mark.full
def test_pixels_inside_an_occluder_in_front_of_all_show_it():
    made = drawn_as("marked")
    boxes, ranks = (np.asarray(part) for part in made.stages.occluders[::2])
    rows, columns = np.mgrid[: made.mask.shape[2], : made.mask.shape[3]]
    checked = 0
    for (left, top, right, bottom), rank, mask in zip(
        boxes.reshape(-1, 4), ranks.ravel(), made.mask.repeat(2, 0), strict=True
    ):
        if rank == made.rollout.plan.moving:
            inside = (columns >= left) & (columns + 1 <= right) & (rows >= top) & (rows + 1 <= bottom)
            assert (mask[:, inside] == 255).all()
            checked += inside.sum()
    assert checked > 10
    assert made.of["flow/forward"][made.mask == 255].any() == 0


def test_flow_carries_each_object_and_the_background_to_the_next_frame(made):
    height, width = made.mask.shape[2:]
    y, x = np.mgrid[:height, :width] + 0.5
    for name, step in (("forward", 1), ("backward", -1)):
        flow, valid = made.of[f"flow/{name}"].astype(float), made.of[f"flow/{name}_valid"].astype(bool)
        assert not valid[:, -1 if step > 0 else 0].any()
        checked = 0
        missed = 0
        for v, t in np.ndindex(*made.mask.shape[:2]):
            if not valid[v, t].any():
                continue
            there = np.nonzero(valid[v, t])
            to_x, to_y = x[there] + flow[v, t][there][:, 0], y[there] + flow[v, t][there][:, 1]
            missed += (made.mask[v, t + step][to_y.astype(int), to_x.astype(int)] != made.mask[v, t][there]).sum()
            checked += len(to_x)
        assert missed <= 1e-3 * checked  # stored with 11 bits, a flow may end just beyond a pixel's edge
        assert checked > 0.7 * valid[:, 1:-1].size


def turned(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points [..., 2] rotated counter-clockwise by angles [...]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * points[..., 0] - sin * points[..., 1], sin * points[..., 0] + cos * points[..., 1]], -1)


def carried(made: Made, v: int, t: int, step: int) -> np.ndarray:
    """Where the points that the pixels of a frame show lie `step` frames later [H, W, 2], columns and rows."""
    mask, size = made.mask[v, t], np.array(made.mask.shape[:1:-1])
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    pixels = np.stack([columns, rows], -1) + 0.5
    center, scale, lean = (made.of[f"camera/{name}"].astype(float)[v] for name in ("center", "scale", "angle"))
    place, angle = (made.of[f"states/{name}"].astype(float)[v] for name in ("position", "angle"))
    points = center[t] + turned((pixels - size / 2) * [1, -1] / scale[t], lean[t])
    slot, owned = np.clip(mask.astype(int) - 1, 0, made.slots - 1), ((mask > 0) & (mask < 255))[..., None]
    moved = place[t + step, slot] + turned(points - place[t, slot], (angle[t + step] - angle[t])[slot])
    points = np.where(owned, moved, points)
    ends = size / 2 + turned(points - center[t + step], -lean[t + step]) * scale[t + step] * [1, -1]
    return np.where((mask == 255)[..., None], pixels, ends)


def test_flow_is_the_way_of_the_point_that_each_pixel_shows_and_valid_where_it_is_seen_again(made):
    height, width = made.mask.shape[2:]
    rows, columns = np.mgrid[:height, :width]
    for name, step in (("forward", 1), ("backward", -1)):
        seen = {True: 0, False: 0}
        for v, t in np.ndindex(*made.mask.shape[:2]):
            flow, valid = (made.of[f"flow/{field}"][v, t] for field in (name, f"{name}_valid"))
            if not 0 <= t + step < made.mask.shape[1]:
                assert not flow.any()
                assert not valid.any()
                continue
            ends = carried(made, v, t, step)
            assert_allclose(flow, ends - np.stack([columns, rows], -1) - 0.5, rtol=2e-3, atol=5e-3)
            column, row = np.moveaxis(np.floor(ends).astype(int), -1, 0)
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            there = made.mask[v, t + step][row.clip(0, height - 1), column.clip(0, width - 1)]
            expected, clear = inside & (there == made.mask[v, t]), (np.abs(ends - np.rint(ends)) > 1e-3).all(-1)
            clear |= made.mask[v, t] == 255
            assert_array_equal(valid.astype(bool)[clear], expected[clear])
            for value in (True, False):
                seen[value] += (expected[clear] == value).sum()
        assert min(seen.values()) > 100


def test_flow_at_a_discs_centre_is_the_way_of_its_centre(made):
    boxes = made.of["boxes/amodal"]
    centers = (boxes[..., :2] + boxes[..., 2:]) / 2
    checked = 0
    for v, t, k in np.ndindex(4, 11, made.slots):
        if made.of["objects/shape"][v, k] or not made.of["objects/present"][v, k]:
            continue
        column, row = np.floor(centers[v, t, k]).astype(int)
        if not (0 <= row < made.mask.shape[2] and 0 <= column < made.mask.shape[3]):
            continue
        if made.mask[v, t, row, column] != k + 1:
            continue
        turn = made.of["states/angle"][v, t + 1, k] - made.of["states/angle"][v, t, k]
        way = centers[v, t + 1, k] - centers[v, t, k]
        assert_allclose(made.of["flow/forward"][v, t, row, column], way, atol=0.72 * abs(turn) + 0.05)
        checked += 1
    assert checked > 50


def test_a_frame_carried_by_its_flow_is_the_next_frame():
    plain = drawn_as("still")
    frames, flow, valid = (plain.of[name] for name in ("frames", "flow/backward", "flow/backward_valid"))
    y, x = np.mgrid[: frames.shape[2], : frames.shape[3]]
    for v, t in ((0, 3), (1, 7), (2, 5)):
        # Where the pixel and its neighbours show the same object in both frames: no rim is near.
        mask = plain.mask[v, t]
        same = np.ones_like(mask, bool)
        for dy, dx in np.ndindex(5, 5):
            same &= np.roll(mask, (dy - 2, dx - 2), (0, 1)) == mask
        same &= valid[v, t].astype(bool)
        from_x = np.rint(x + flow[v, t, ..., 0].astype(float)).astype(int).clip(0, frames.shape[3] - 1)
        from_y = np.rint(y + flow[v, t, ..., 1].astype(float)).astype(int).clip(0, frames.shape[2] - 1)
        carried = frames[v, t - 1][from_y, from_x]
        assert_array_equal(carried[same], frames[v, t][same])


def test_tracks_follow_their_objects_and_know_when_they_are_seen(made):
    points, seen, owner = (made.of[f"tracks/{name}"] for name in ("points", "visible", "object"))
    height, width = made.mask.shape[2:]
    boxes = made.of["boxes/amodal"]
    for v, p in np.ndindex(owner.shape):
        k = owner[v, p]
        if k < 0:
            assert not points[v, :, p].any()
            continue
        assert (points[v, :, p] >= boxes[v, :, k, :2] - 1e-2).all()
        assert (points[v, :, p] <= boxes[v, :, k, 2:] + 1e-2).all()
        column, row = np.floor(points[v, :, p]).astype(int).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        shown = made.mask[v, np.arange(len(row)), row.clip(0, height - 1), column.clip(0, width - 1)] == k + 1
        assert_array_equal(seen[v, :, p], inside & shown)
    # Points of one body stay as far from each other, in metres.
    one = points[:, :, :5] / made.of["camera/scale"][:, :, None, None]
    apart = np.linalg.norm(one[:, :, 1:] - one[:, :, :1], axis=-1)
    assert_allclose(apart, np.broadcast_to(apart[:, :1], apart.shape), atol=2e-4)


def test_tracked_points_stay_at_their_places_in_their_bodies(made):
    points, owner = (made.of[f"tracks/{name}"] for name in ("points", "object"))
    size = np.array(made.mask.shape[:1:-1])
    for v, p in zip(*np.nonzero(owner >= 0), strict=True):
        center, scale, lean = (made.of[f"camera/{name}"].astype(float)[v] for name in ("center", "scale", "angle"))
        place, angle = (made.of[f"states/{name}"].astype(float)[v, :, owner[v, p]] for name in ("position", "angle"))
        world = center + turned((points[v, :, p] - size / 2) * [1, -1] / scale[:, None], lean)
        local = turned(world - place, -angle)
        assert_allclose(local, np.broadcast_to(local[0], local.shape), atol=2e-4)


def shares_of_cells(points: np.ndarray, reach: float) -> np.ndarray:
    """Share of the points [P, 2] in each cell of a grid [6, 6] over the square of half a side `reach`."""
    counts, *_ = np.histogram2d(*points.T, bins=6, range=[[-reach, reach]] * 2)
    return counts / len(points)


def test_tracked_points_are_uniform_in_the_area_of_their_shape():
    corners = np.array([[-1.0, -0.6], [1.2, -0.4], [0.9, 0.8], [-0.2, 1.1], [-0.2, 1.1]])
    bodies = BodyGeometry(jnp.float32([1.3, 0.5, 0]), jnp.float32([0, 0.9, 0]), jnp.float32([corners] * 3))
    scene: Any = types.SimpleNamespace(seed=jnp.uint32(5), bodies=bodies)
    x, y = (a.ravel() for a in np.meshgrid(*[(np.arange(600) + 0.5) / 200 - 1.5] * 2))
    sides = np.roll(corners, -1, axis=0) - corners
    inside = {
        "circle": np.hypot(x, y) < 1.3,
        "capsule": np.hypot(x - np.clip(x, -0.9, 0.9), y) < 0.5,
        "polygon": (sides[:, :1] * (y - corners[:, 1:]) - sides[:, 1:] * (x - corners[:, :1]) >= 0).all(0),
    }
    for first, (shape, there) in enumerate(inside.items()):
        run = SlotGroup(shape, 1, vertices=5 if shape == "polygon" else 0)
        (points,) = np.asarray(tracks._random_points(scene, run, first, 20_000))
        exact = shares_of_cells(np.stack([x, y], -1)[there], 1.5)
        assert exact.max() < 0.2
        assert_allclose(shares_of_cells(points, 1.5), exact, atol=0.012, err_msg=shape)


@pytest.mark.parametrize("name", ["masks", "boxes", "visibility", "flow"])
def test_more_objects_than_a_mask_can_number_are_refused(name: str) -> None:
    config = load_config("bouncing.yaml", [f"annotations.{name}=true"])

    def layout(balls: int) -> Layout:
        return Layout((SlotGroup("circle", balls),))

    assert render.plan_of(config, layout(254)).owners
    with pytest.raises(ConfigError, match=rf"annotations\.{name} is on for 255 objects .* off for more than 254"):
        render.plan_of(config, layout(255))
