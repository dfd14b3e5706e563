"""Heights, normals and shadows of lit objects, against closed forms and the reference in float64."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from numpy.testing import assert_allclose, assert_array_equal
from reference import View

import gen2d
from gen2d.config.config import load_config
from gen2d.core.enums import CIRCLE
from gen2d.core.errors import ConfigError
from gen2d.programs.rollout import Rollout
from gen2d.renderers import rasterizer, surfaces
from gen2d.renderers import relief as relief_module
from gen2d.renderers.primitives import ImagePose
from gen2d.renderers.relief import Relief

HEIGHT, WIDTH = 60, 68
NAMES = ("masks", "depth", "normals", "shadow")
SMALL = ["video.frames=3", "video.fps=6", f"video.height={HEIGHT}", f"video.width={WIDTH}", "storage.batch_size=2"]
ON = [f"annotations.{name}=true" for name in NAMES]
MOVING = ("camera.pan=[2,1]", "camera.turn=0.7", "camera.zoom=0.3", "image.occluders=2", "image.occluder_front=0.5")
CASES = {
    "bouncing": ("bouncing", ("image.occluders=2", "image.occluder_front=0.5")),
    "seen by a moving camera": ("bouncing", MOVING),
    "pile": ("pile", ("look.material=metal",)),
    "seesaw": ("seesaw", MOVING),
}
TIERED = [pytest.param(case, marks=pytest.mark.full if i else ()) for i, case in enumerate(CASES)]
HALF_STEP = 1 / 254  # of a component of a normal


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Fields of the videos of a case, their stages, and what is not stored of their surfaces."""

    rollout: Rollout
    stages: Any
    columns: dict
    relief: list

    def of(self, v):
        return {name: values[v] for name, values in self.columns.items()}

    @property
    def view(self):
        return View(HEIGHT, WIDTH, wall_width=self.rollout.config.look.options.wall_width)


@functools.cache
def drawn(case):
    name, more = CASES[case]
    rollout = Rollout(load_config(f"{name}.yaml", ["look=studio", *SMALL, *ON, *more]), jax.devices()[:1])
    (batch,) = rollout.start("train", np.arange(2))
    (rendered,) = rollout.draw([batch], 0, 2)
    columns = rollout.host_columns([batch])[0] | {name: np.asarray(array) for name, array in rendered.items()}
    surface = batch.render_scenes.paint.surface
    assert surface is not None
    relief = [
        reference.Relief(np.asarray(surface.slope[v], float), np.asarray(surface.bevel[v], float)) for v in range(2)
    ]
    return Drawn(rollout, batch.render_scenes, columns, relief)


def each_object(made):
    """Video, frame, slot and mask of each object that is seen, with its relief."""
    for v in range(2):
        video = made.of(v)
        for t in range(3):
            for number in np.unique(video["masks/instance"][t]):
                if 0 < number < reference.OCCLUDER:
                    yield video, t, int(number) - 1, video["masks/instance"][t] == number, made.relief[v]


@pytest.mark.parametrize("case", TIERED)
def test_heights_are_those_of_the_reference(case):
    made, worst, seen = drawn(case), 0.0, 0
    centers = reference.pixel_centers(made.view)
    for video, t, slot, here, relief in each_object(made):
        scale = float(video["camera/scale"][t])
        expected = reference.height(video, t, slot, centers[here], relief, made.view) / scale
        stored = video["surface/height"][t][here].astype(float)
        worst = max(worst, (np.abs(stored - expected) - np.abs(expected) * 2.0**-11).max() * scale)
        seen += (stored > 0).sum()
    print(f"heights: {worst:.1e} px beyond rounding")
    assert worst < 2e-3
    assert seen > 500


@pytest.mark.parametrize("case", TIERED)
def test_normals_are_unit_vectors_across_the_slope_of_the_height(case):
    """The gradient is that of the reference's height, by differences where it has no edge."""
    made, step, checked = drawn(case), 1e-3, 0
    centers = reference.pixel_centers(made.view)
    for video, t, slot, here, relief in each_object(made):
        normal = video["surface/normal"][t][here] / 127
        assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=2 * HALF_STEP)
        ends = [centers[here] + step * np.array(way) for way in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        heights = [reference.height(video, t, slot, end, relief, made.view) for end in (centers[here], *ends)]
        middle, right, left, down, up = heights
        gradient = np.stack([right - left, up - down], -1) / (2 * step)
        bend = np.abs(np.stack([right + left, up + down], -1) - 2 * middle[:, None]).max(-1) / step
        smooth = (bend < 0.02) & (np.abs(gradient).max(-1) > 0)
        expected = np.concatenate([-gradient, np.ones((len(gradient), 1))], -1)
        expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
        assert_allclose(normal[smooth], expected[smooth], atol=HALF_STEP + 5e-3)
        checked += smooth.sum()
    assert checked > 500


@pytest.mark.parametrize("case", TIERED)
def test_what_has_no_relief_is_flat(case):
    made = drawn(case)
    bare = made.columns["masks/instance"] == 0
    assert bare.any()
    assert (made.columns["surface/height"][bare] == 0).all()
    assert_array_equal(np.unique(made.columns["surface/normal"][bare], axis=0), [[0, 0, 127]])


@pytest.mark.parametrize("case", [case for case in TIERED if "pile" not in case.values])
def test_occluders_are_boards_with_a_bevel(case):
    """In each frame as in the first one; of two in one place the last one shows."""
    made, sides, seen = drawn(case), np.array([[1, 0], [0, -1], [-1, 0], [0, 1]]), 0
    screen = made.stages.paint.screen
    x, y = np.moveaxis(reference.pixel_centers(made.view), -1, 0)
    for v in range(2):
        video, slope = made.of(v), float(screen.slope[v])
        scale = float(video["camera/scale"][0])
        bevel = max(float(screen.bevel[v]) * scale, 1)
        gaps = [np.stack([x1 - x, y1 - y, x - x0, y - y0], -1) for x0, y0, x1, y1 in video["occluders/box"]]
        assert len(gaps) == 2
        for t in range(3):
            height, normal = np.zeros(x.shape), np.tile([0.0, 0, 1], (*x.shape, 1))
            mitre = np.zeros(x.shape, bool)
            for gap in gaps:
                inside, nearest = gap.min(-1) >= 0, np.sort(gap, -1)
                tilt = slope * np.clip(1 - gap.min(-1) / bevel, 0, 1)
                cap = bevel / slope * (np.sqrt(1 - tilt**2) - np.sqrt(1 - slope**2)) / scale
                across = np.concatenate([sides[gap.argmin(-1)] * tilt[..., None], np.sqrt(1 - tilt**2)[..., None]], -1)
                height, normal = np.where(inside, cap, height), np.where(inside[..., None], across, normal)
                mitre = np.where(inside, nearest[..., 1] - nearest[..., 0] < 1e-3, mitre)
            here = video["masks/instance"][t] == reference.OCCLUDER
            assert_allclose(video["surface/height"][t][here], height[here], atol=1e-4, rtol=1e-3)
            assert_allclose(
                video["surface/normal"][t][here & ~mitre] / 127, normal[here & ~mitre], atol=HALF_STEP + 1e-3
            )
            seen += (here & (normal[..., 2] < 0.95)).sum()
    assert seen > 50


def test_the_depth_of_a_ball_is_its_dome():
    """A cap of the sphere of radius r / .95, of which .95 is the sine of the tilt of rubber at the rim."""
    made, steepest = drawn("bouncing"), 0.95
    x, y = np.moveaxis(reference.pixel_centers(made.view), -1, 0)
    for video, t, slot, here, _ in each_object(made):
        if video["objects/shape"][slot] == CIRCLE:
            r, scale = float(video["objects/radius"][slot]), float(video["camera/scale"][t])
            column, row = reference.to_pixels(video, t, video["states/position"][t, slot], made.view)
            square = np.minimum(((x - column) ** 2 + (y - row) ** 2)[here] / scale**2, r**2)
            dome = np.sqrt((r / steepest) ** 2 - square) - r / steepest * np.sqrt(1 - steepest**2)
            assert_allclose(video["surface/height"][t][here], dome, atol=1e-3, rtol=1e-3)


def test_surfaces_beyond_a_rim_are_as_at_it():
    """Of a disc, and beside the core of a capsule; pixels own such points where three objects meet."""
    one, steepest = jnp.ones(1), 0.9
    pose = ImagePose(0 * one, 0 * one, one, 0 * one, 10 * one, 5 * one)
    way = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    for half in (None, 0 * one):
        relief = Relief(5 * one, half, None, None, jnp.zeros((1, 2)))
        for x, y in 5 * np.stack([np.cos(way), np.sin(way)], -1):
            at_rim, beyond = (
                relief_module.surface_points(relief, pose, steepest * one, one, *_point(far * x, far * y))
                for far in (1 - 1e-6, 1.3)
            )
            assert_allclose(np.hypot(beyond.normal_x, beyond.normal_y), steepest, rtol=1e-4)
            jax.tree.map(lambda a, b: assert_allclose(a, b, atol=1e-4), at_rim, beyond)


def _point(x, y):
    return jnp.full((1, 1, 1), x, jnp.float32), jnp.full((1, 1, 1), y, jnp.float32)


@pytest.mark.parametrize("case", TIERED)
def test_both_forms_give_the_same_surfaces(case):
    made = drawn(case)
    owners = jnp.asarray(made.columns["masks/instance"])
    forms = [
        jax.jit(lambda stages, form=form: form(stages, owners, made.rollout.plan, lambda point: point._asdict()))
        for form in (surfaces._by_tiles, surfaces._by_pixels)
    ]
    tiles, pixels = (form(made.stages) for form in forms)
    for name in tiles:
        assert_allclose(tiles[name], pixels[name], atol=2e-5, err_msg=name)


@pytest.mark.parametrize("case", TIERED)
def test_shadows_explain_how_frames_with_and_without_them_differ(case):
    """On the background, a pixel has the part of the mask of the colour of shadows, and the rest of its own."""
    made, (name, more) = drawn(case), CASES[case]
    plain = load_config(f"{name}.yaml", ["look=studio", "look.shadow=0", *SMALL, *more, "annotations.shadow=true"])
    bare = Rollout(plain, jax.devices()[:1])
    (batch,) = bare.start("train", np.arange(2))
    (rendered,) = bare.draw([batch], 0, 2)
    assert not np.asarray(rendered["surface/shadow"]).any()
    without, share = np.asarray(rendered["frames"]).astype(float), made.columns["surface/shadow"] / 255
    dark = np.array([40.0, 28.0, 20.0])
    empty = jax.vmap(lambda stage: rasterizer.background_image(stage, stage.instants, bare.plan))
    ground = np.broadcast_to(np.asarray(empty(batch.render_scenes)), without.shape)
    alone = (np.abs(without - ground) < 1).all(-1)
    expected = without + share[..., None] * (dark - without)
    assert np.abs(expected - made.columns["frames"])[alone].max() < 2.5
    assert (share[alone] > 0.05).sum() > 100
    assert share.max() <= 0.9


def test_a_look_without_surfaces_has_none_of_these_annotations():
    for name in ("depth", "normals", "shadow"):
        with pytest.raises(ConfigError) as error:
            load_config("bouncing.yaml", ["look=flat", f"annotations.{name}=true"])
        assert "\n" not in str(error.value)
        assert f"annotations.{name} is on, but look is flat" in str(error.value)
        assert "studio" in str(error.value)
    splits = {"train": {}, "test": {"look": "marked"}}
    with pytest.raises(ConfigError, match=r"splits\.test\.look is marked"):
        load_config({"look": "studio", "splits": splits, "annotations": {"depth": True}})


@pytest.mark.full
def test_stored_surfaces_are_rendered_again(tmp_path):
    """And another look, which has none, is rendered without them."""
    stored = ("surface/height", "surface/normal", "surface/shadow")
    config = load_config("bouncing.yaml", ["look=studio", *SMALL, *ON])
    gen2d.generate(config, 2, tmp_path / "all")
    ds = gen2d.open(tmp_path / "all", fields=("frames", *stored))
    again = gen2d.render(ds, [0, 1], fields=stored)
    batch = ds.batch([0, 1])
    for name in stored:
        assert_array_equal(np.asarray(again[name]), batch[name])
    assert gen2d.render(ds, [0], look="flat").shape == (1, 3, HEIGHT, WIDTH, 3)
    with pytest.raises(ConfigError, match="paints no surface"):
        gen2d.render(ds, [0], look="flat", fields=["surface/height"])
    larger = gen2d.open(tmp_path / "all", fields=["surface/height"], render={"height": 2 * HEIGHT, "width": 2 * WIDTH})
    assert larger[0]["surface/height"].shape == (3, 2 * HEIGHT, 2 * WIDTH)
    assert_allclose(larger[0]["surface/height"].max(), batch["surface/height"][0].max(), rtol=0.02)
