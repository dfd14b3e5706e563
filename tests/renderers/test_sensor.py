"""Lens, sensor and JPEG: each stage by its law, in the stated order; the numbers that a dataset stores."""

import io
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.fft import dctn, idctn
from tiny import everything, tiny_config
from worlds import straight_motion

import gen2d
from gen2d.config.config import load_config
from gen2d.core.errors import ConfigError
from gen2d.generation.run import generate
from gen2d.page.video import Detail, Videos
from gen2d.programs.render import render_frames
from gen2d.renderers import jpeg
from gen2d.renderers import sensor as sensor_module
from gen2d.renderers.color import light_of, scaled_values, to_linear, values_of
from gen2d.renderers.jpeg import TABLES, round_trip
from gen2d.renderers.sensor import Sensor

SIZE = 40, 64
GREY = 150


def recorded(frames, seed=0, **numbers) -> np.ndarray:
    """One video's frames [T, H, W, 3] as a sensor of these numbers records them."""
    sensor = Sensor(**{name: jnp.float32([value]) for name, value in numbers.items()})
    frames = jnp.asarray(np.asarray(frames, np.uint8))[None]
    new, _ = sensor_module.record(sensor, jnp.uint32([seed]), frames, None, *frames.shape[2:4])
    assert new is not None, "frames are given"
    return np.asarray(new[0])


def light(frames) -> np.ndarray:
    """Linear light of frames, in float64."""
    return np.asarray(to_linear(jnp.asarray(frames, float)), np.float64)


def grey(value=GREY, frames=1) -> np.ndarray:
    return np.full((frames, *SIZE, 3), value, np.uint8)


def distances() -> np.ndarray:
    """Distances [H, W] of pixel centres from the middle, over half of the diagonal."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    return np.hypot(columns - SIZE[1] / 2, rows - SIZE[0] / 2) / (np.hypot(*SIZE) / 2)


# ---- Light


def test_a_vignette_takes_its_part_of_the_light_in_the_corners_and_none_in_the_middle():
    seen = light(recorded(grey(), vignette=0.6))[0]
    assert_allclose(seen, (light(GREY) * (1 - 0.6 * distances() ** 2))[..., None].repeat(3, -1), atol=0.004)


@pytest.mark.parametrize("stops", [-2.0, 1.0])
def test_each_stop_doubles_the_light_until_it_is_white(stops):
    values = np.arange(256, dtype=np.uint8).repeat(3).reshape(1, 16, 16, 3)
    expected = np.minimum(light(values) * 2**stops, 1)
    error = np.abs(recorded(values, exposure_gain=stops) - 255 * _encoded(expected))
    assert error.max() <= 0.501


def _encoded(linear):
    """sRGB from 0 to 1 of linear light (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def test_the_curves_of_the_sensor_are_those_of_the_standard():
    """Within 0.03 display values; all bytes, and light scaled from 1/16 to 4."""
    values, scale = np.arange(256), 2.0 ** np.arange(-4, 2.1, 0.25)[:, None]
    slope = np.gradient(light(np.linspace(0, 255, 25501)), 0.01)[::100]
    assert (np.abs(np.asarray(light_of(jnp.float32(values))) - light(values)) < 0.03 * slope).all()
    shades = np.linspace(0, 1, 100_001)
    assert np.abs(np.asarray(values_of(jnp.float32(shades))) - 255 * _encoded(shades)).max() < 0.03
    scaled = np.asarray(scaled_values(jnp.float32(values), jnp.float32(scale ** (1 / 2.4))))
    exact = 255 * _encoded(light(values) * scale)
    assert np.abs(scaled - exact)[exact < 255].max() < 0.03


def test_white_balance_is_the_ratio_of_red_to_blue_and_leaves_green():
    red, green, blue = light(recorded(grey(), white_balance=0.7)).mean((0, 1, 2))
    assert_allclose(red / blue, 2**0.7, rtol=0.01)
    assert_allclose([red * blue, green], [light(GREY) ** 2, light(GREY)], rtol=0.01)


@pytest.mark.parametrize("value", [60, 150, 220])
def test_shot_noise_has_a_variance_in_proportion_to_the_light(value):
    seen = light(recorded(grey(value, 4), shot_noise=0.05))
    assert_allclose(seen.std(), 0.05 * np.sqrt(light(value)), rtol=0.03)
    assert_allclose(seen.mean(), light(value), rtol=0.01)
    frames = seen.reshape(4, -1)
    assert np.abs(np.corrcoef(frames) - np.eye(4)).max() < 0.05


def test_white_balance_amplifies_shot_noise_and_not_that_of_the_sensor():
    plain = light(recorded(grey(), shot_noise=0.05))
    warm = light(recorded(grey(), shot_noise=0.05, white_balance=1.0))
    assert_allclose(warm[..., 0].std() / plain[..., 0].std(), np.sqrt(2), rtol=0.02)
    both = [recorded(grey(), noise=4.0, white_balance=balance) for balance in (0.001, 1.0)]
    assert_allclose(both[0][..., 0].std(), both[1][..., 0].std(), rtol=0.03)


def test_the_two_noises_of_a_value_are_independent():
    shot, own = recorded(grey(), shot_noise=0.05), recorded(grey(), noise=5.0)
    assert abs(np.corrcoef(shot.ravel(), own.ravel())[0, 1]) < 0.05


# ---- Lens


@pytest.mark.parametrize("distortion", [0.5, 0.2, -0.15, -0.3])
def test_distorted_frames_show_nothing_from_beyond_the_frame_and_touch_its_border(distortion):
    height, width = 41, 65  # with a pixel in the middle of each border
    column, row = map(np.asarray, sensor_module.undistorted_centers(jnp.float32(distortion), height, width))
    assert (np.abs(column - width / 2) <= width / 2).all()
    assert (np.abs(row - height / 2) <= height / 2).all()
    assert_allclose([column[20, 32], row[20, 32]], [width / 2, height / 2])
    if distortion > 0:
        assert_allclose([column[0, 0], row[0, 0]], [0.5, 0.5], atol=0.4)
    else:
        assert_allclose(row[0, 32], 0.5, atol=0.1)
    drawn = np.stack([column, row], -1).astype(np.float32)  # and points are distorted as pixels are
    there = np.asarray(sensor_module.distorted_points(jnp.asarray(drawn), jnp.float32(distortion), height, width))
    centers = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    assert_allclose(there, centers, atol=2e-3)


BALL = {
    "video": {"frames": 4, "fps": 20, "height": 96, "width": 128},
    "scene": {"name": "bouncing", "balls": 1, "radius": 0.5, "velocity": [[-6, 6], [-6, 6]], "gravity": [0, 0],
              "color": [255, 255, 255]},
    "look": {"name": "flat", "background": [0, 0, 0], "wall_width": 0},
}  # fmt: skip


@pytest.mark.parametrize("distortion", [0.4, -0.3])
def test_a_distorted_ball_is_where_the_cubic_puts_it(distortion):
    """In frames, masks and tracks, against the root of Brown's polynomial in float64."""
    changes = {"image": {"distortion": distortion}, "annotations": {"masks": True, "tracks": 4}}
    config = load_config({**BALL, **changes})
    scenes, plan, _, states = straight_motion(config, 12)
    rendered = jax.jit(lambda scenes: render_frames(scenes, plan, config.annotations))(scenes)
    view, place = scenes.instants.view, np.asarray(states.position, np.float64)[:, :, 0]
    away = (place - np.asarray(view.center)) * np.asarray(view.scale)[..., None] * [1, -1]
    half, border = np.hypot(96, 128) / 2, 96 / np.hypot(96, 128)
    widening = 1 + max(distortion, distortion * border**2)
    length = np.hypot(*np.moveaxis(away, -1, 0)) / half
    radius = np.array([_root(distortion, value * widening) for value in length.ravel()]).reshape(length.shape)
    expected = away / length[..., None] * radius[..., None]
    inside = (np.abs(expected) < np.array([64, 48]) - 12).all(-1)
    assert inside.sum() > 15
    for name, weight in (("frames", light(rendered["frames"])[..., 0]), ("masks", rendered["masks/instance"] == 1)):
        weight = np.asarray(weight, float) * (np.asarray(weight) > 0.02)
        rows, columns = np.mgrid[:96, :128] + 0.5
        total = weight.sum((-2, -1))
        found = np.stack([(weight * part).sum((-2, -1)) / total for part in (columns, rows)], -1) - [64, 48]
        # The centroid of a distorted disc of 6 px is not its distorted centre: by 0.4 px at most.
        error = np.abs(found - expected)[inside].max()
        print(f"{name}: off by {error:.3f} px")
        assert error < 0.6
    points = np.asarray(rendered["tracks/points"])
    from_center = points - (expected + np.array([64, 48]))[:, :, None]
    distance, own = np.hypot(*np.moveaxis(from_center, -1, 0)), np.asarray(rendered["tracks/object"] == 0)[:, None]
    own = own & inside[..., None]
    assert distance[own].max() < 7.5  # a radius of 4.8 px, magnified by 1.4 at most
    n, t, p = np.nonzero((distance < 3) & own)  # not at the ball's rim
    pixel = np.floor(points[n, t, p]).astype(int)
    assert len(n) > 15
    assert (np.asarray(rendered["masks/instance"])[n, t, pixel[:, 1], pixel[:, 0]] == 1).all()
    assert np.asarray(rendered["tracks/visible"])[n, t, p].all()


def _root(distortion, target):
    """The smallest positive root r of r + k r^3 = target."""
    roots = np.roots([distortion, 0, 1, -target])
    return min(root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0)


# ---- JPEG


def picture(height=60, width=76) -> np.ndarray:
    """A frame with gradients, edges and noise, whose sides are no multiples of 8."""
    rows, columns = np.mgrid[:height, :width]
    image = np.stack([127 + 100 * np.sin(columns / 9 + rows / 13), 127 + 90 * np.cos(columns / 5), 40 + 2 * rows], -1)
    image[20:40, 20:50] = [209, 73, 91]
    noise = np.random.default_rng(0).normal(0, 4, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def exact_round_trip(image, quality) -> np.ndarray:
    """The same loss in float64, from the definitions of ITU-T T.81 and JFIF."""
    height, width = image.shape[:2]
    padded = np.pad(image.astype(float), [(0, -height % 8), (0, -width % 8), (0, 0)], mode="edge")
    to_ycc = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]])
    planes = np.round(padded @ to_ycc.T) - [128, 0, 0]
    scale = 5000 // quality if quality < 50 else 200 - 2 * quality
    for plane, table in zip(np.moveaxis(planes, -1, 0), TABLES, strict=True):
        divisors = np.clip((table * scale + 50) // 100, 1, 255)
        blocks = plane.reshape(len(plane) // 8, 8, -1, 8).swapaxes(1, 2)
        sizes = np.round(dctn(blocks, axes=(2, 3), norm="ortho") / divisors) * divisors
        plane[:] = (
            np.clip(np.round(np.asarray(idctn(sizes, axes=(2, 3), norm="ortho"))), -128, 127)
            .swapaxes(1, 2)
            .reshape(plane.shape)
        )
    rgb = (planes + np.array([128, 0, 0])) @ np.linalg.inv(to_ycc).T
    return np.clip(np.round(rgb), 0, 255)[:height, :width]


@pytest.mark.parametrize("quality", [3, 20, 75, 95])
def test_a_jpeg_round_trip_loses_what_the_standard_loses(quality):
    image = picture()
    own = np.asarray(jax.jit(round_trip)(image[None], jnp.float32(quality)))[0].astype(float)
    error = np.abs(own - exact_round_trip(image, quality))
    loss = np.abs(own - image).mean()
    print(f"quality {quality}: loses {loss:.2f} levels; off by {error.mean():.3f} of those of float64")
    assert error.mean() < 0.06 * loss  # coefficients halfway between two steps may be rounded to either
    assert np.median(error) == 0


@pytest.mark.parametrize("quality", [10, 50, 90])
def test_a_jpeg_round_trip_loses_what_a_codec_loses(quality):
    image, file = picture(), io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality, subsampling=0)
    own = np.asarray(jax.jit(round_trip)(image[None], jnp.float32(quality)))[0].astype(float)
    error, loss = np.abs(own - np.asarray(Image.open(file), float)), np.abs(own - image).mean()
    print(f"quality {quality}: loses {loss:.2f} levels; off by {error.mean():.3f} of those of a codec")
    assert error.mean() < 0.25 * loss


def test_quotients_are_those_of_whole_numbers():
    rng = np.random.default_rng(0)
    divisors = rng.integers(1, 256, 100_000) << 19
    numbers = rng.integers(0, 2**31 - 1, 100_000) // rng.choice([1, 7, 900], 100_000)
    numbers[::2] = numbers[::2] // divisors[::2] * divisors[::2] - rng.integers(0, 2, 50_000)
    numbers = np.maximum(numbers, 0)
    own = jpeg._quotient(jnp.asarray(numbers, jnp.int32), jnp.asarray(divisors, jnp.int32))
    assert_array_equal(own, numbers // divisors)


def test_a_jpeg_round_trip_is_the_last_stage():
    frames = picture()[None]
    before = recorded(frames, vignette=0.3, noise=4.0, shot_noise=0.02)
    expected = np.asarray(round_trip(jnp.asarray(before), jnp.float32(30)))
    assert_array_equal(recorded(frames, vignette=0.3, noise=4.0, shot_noise=0.02, jpeg_quality=30), expected)


# ---- Datasets

EFFECTS = {
    "vignette": [0.1, 0.5], "exposure_gain": [-1, 0], "shot_noise": [0.01, 0.05], "white_balance": [-0.5, 0.5],
    "noise": [1, 4], "jpeg_quality": [20, 90], "distortion": [-0.2, 0.3],
}  # fmt: skip


def test_sampled_numbers_are_stored_and_frames_can_be_rendered_again(tmp_path: Path):
    config = tiny_config(image=EFFECTS, video={"frames": 2}) | {
        "splits": {"train": {"videos": 4}, "clean": {"videos": 4, "image": dict.fromkeys(EFFECTS, 0)}}
    }
    config["splits"]["clean"]["image"]["jpeg_quality"] = None
    for split in ("train", "clean"):
        generate(config, 4, tmp_path / "data", split=split)
    stored = everything(tmp_path / "data")
    for name, (low, high) in EFFECTS.items():
        values = stored[f"image/{name}"]
        assert values.dtype == np.float32
        assert ((low <= values) & (values <= high)).all(), name
        assert len(set(values.tolist())) > 1, name
    ds = gen2d.open(tmp_path / "data", split="train")
    assert_array_equal(np.asarray(gen2d.render(ds, range(4))), stored["frames"])
    again = np.asarray(gen2d.render(ds, range(4), overrides=["image.jpeg_quality=null", "image.noise=0"]))
    assert not np.array_equal(again, stored["frames"])
    clean = everything(tmp_path / "data", "clean")
    assert not any(clean[f"image/{name}"].any() for name in EFFECTS)
    with pytest.raises(ConfigError, match=r"frames are distorted .* but objects holds places without distortion"):
        gen2d.export(tmp_path / "data", "objects", tmp_path / "objects.csv")
    for split, outlined in (("train", False), ("clean", True)):  # on the dataset's page
        shown = Videos(ds.root, ds.manifest, split).video(0, Detail(2, 32, 32, None, 8, 8))
        assert ("camera/scale" in {column["name"] for column in shown["arrays"]["columns"]}) == outlined


def test_windows_are_those_of_the_whole_video(tmp_path: Path):
    config = tiny_config(image={"shot_noise": 0.05, "jpeg_quality": 60}, storage={"frames": "none"})
    generate(config, 2, tmp_path / "data")
    whole = gen2d.open(tmp_path / "data", fields="frames").batch([0, 1])["frames"]
    window = gen2d.open(tmp_path / "data", fields="frames", window=2, start=3).batch([0, 1])["frames"]
    assert_array_equal(window, whole[:, 3:5])


@pytest.mark.parametrize("name", ["boxes", "flow", "visibility", "amodal"])
def test_an_annotation_of_undistorted_frames_is_refused_where_frames_are_distorted(name):
    for config in (
        tiny_config(image={"distortion": 0.1}, annotations={name: True}),
        tiny_config(annotations={name: True}) | {"splits": {"a": {}, "b": {"image": {"distortion": [0, 0.1]}}}},
    ):
        with pytest.raises(ConfigError, match=rf"annotations\.{name} is on, but describes frames without image\.dist"):
            load_config(config)
    load_config(tiny_config(image={"distortion": 0.1}, annotations={"masks": True, "tracks": 2}))
