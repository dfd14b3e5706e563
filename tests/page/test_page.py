"""The page of a dataset holds its first videos, is bounded in size, and treats every string as text."""

import base64
import colorsys
import dataclasses
import io
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import gen2d
from gen2d.core.schema import Field
from gen2d.dataset.manifest import Manifest, read_manifest
from gen2d.media.sprites import reduced, sprite_rows, sprite_sheet
from gen2d.page.arrays import packed
from gen2d.page.page import index_page, page, shown_videos
from gen2d.page.video import Detail, Videos, energies, flow_colors

DETAIL = Detail(frames=100, side=512, mask_side=512, quality=90, objects=100, contacts=100)
CAMERA = {
    "camera/center": Field("float32", "n T 2", "m", "world point at the centre of the frame"),
    "camera/scale": Field("float32", "n T", "px/m", "pixels per metre"),
}


def data_of(content: bytes) -> dict[str, Any]:
    """The data of a page, as its script reads them."""
    text = re.search(rb'<script id="data"[^>]*>([^<]*)</script>', content)
    assert text
    return json.loads(zlib.decompress(base64.b64decode(text[1])))


def unpacked(plain: dict[str, Any]) -> dict[str, np.ndarray]:
    """Arrays in a page, as its script reads them."""
    content, arrays, begin = zlib.decompress(base64.b64decode(plain["content"])), {}, 0
    for column in plain["columns"]:
        frames, *rest = column["shape"]
        size = int(np.prod(column["shape"]))
        planes = np.frombuffer(content, np.uint8, 2 * size, begin).reshape(2, size).astype(np.uint16)
        series = (planes[0] + 256 * planes[1]).reshape(*rest, frames).cumsum(-1, dtype=np.uint16)
        arrays[column["name"]] = column["low"] + column["step"] * np.moveaxis(series.astype(float), -1, 0)
        begin += 2 * size
    return arrays


def pictures(sprite: dict[str, Any], frames: int) -> np.ndarray:
    """Frames of a sprite sheet."""
    sheet = np.asarray(Image.open(io.BytesIO(base64.b64decode(sprite["content"]))))
    height, width, rows = sprite["height"], sprite["width"], sprite["rows"]
    places = (((t // rows) * width, (t % rows) * height) for t in range(frames))
    return np.stack([sheet[y : y + height, x : x + width] for x, y in places])


@given(st.integers(1, 9), st.integers(0, 3), st.floats(1e-3, 1e6), st.integers(0, 2**32))
def test_packed_arrays_are_right_to_a_step(frames: int, slots: int, size: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    arrays = {"a": rng.normal(0, size, (frames, slots, 2)), "b": np.full((frames,), size), "c": rng.random((frames, 1))}
    found = unpacked(packed(arrays))
    for name, values in arrays.items():
        assert found[name].shape == values.shape
        span = np.ptp(values) if values.size else 0
        assert_allclose(found[name], values, rtol=1e-12, atol=span / 2**16)


def test_what_is_not_finite_is_packed_as_a_finite_number() -> None:
    values = np.array([0, np.nan, np.inf, -np.inf, 3, -2.0])[:, None]
    assert_allclose(unpacked(packed({"a": values}))["a"][:, 0], [0, 0, 3, -2, 3, -2], atol=1e-4)
    huge = np.array([-1.7e308, 1.7e308])[:, None]  # the range overflows
    assert np.isfinite(unpacked(packed({"a": huge}))["a"]).all()


@pytest.mark.parametrize(("frames", "height"), [(1, 5), (7, 5), (7, 5000)])
def test_a_sprite_sheet_holds_every_frame(frames: int, height: int) -> None:
    images = np.random.default_rng(0).integers(0, 256, (frames, height, 6, 3), np.uint8)
    sprite = {"content": base64.b64encode(sprite_sheet(images, None)), "height": height, "width": 6}
    assert_array_equal(pictures({**sprite, "rows": sprite_rows(frames, height)}, frames), images)


def test_plain_grounds_have_no_noise() -> None:
    """A box with a soft rim moves over paper and a white wall; frames of many colours are lossy."""
    frames = np.full((9, 64, 64, 3), (239, 228, 207), np.uint8)
    frames[:, :, :3] = 255
    for t, frame in enumerate(frames):
        frame[20 + 3 * t : 30 + 3 * t, 9 + 4 * t : 19 + 4 * t] = 209, 73, 91
        frame[20 + 3 * t, 9 + 4 * t : 19 + 4 * t] = 224 + t, 150 + t, 149
        frame[5, 5] = 251
    content, lossy = sprite_sheet(frames, 80), io.BytesIO()
    Image.fromarray(frames.reshape(-1, 64, 3)).save(lossy, "WEBP", quality=80, method=4)
    sprite = {"content": base64.b64encode(content), "height": 64, "width": 64, "rows": sprite_rows(9, 64)}
    found = np.asarray(pictures(sprite, 9)).astype(int)
    apart, rare = abs(found - frames), (frames[..., 2] == 149) | (frames[..., 2] == 251)
    assert 0 < apart[rare].max() <= 16
    assert (apart[~rare] == 0).all()
    assert len(content) < len(lossy.getvalue())
    noise = np.random.default_rng(0).integers(0, 256, frames.shape, np.uint8)
    assert len(sprite_sheet(noise, 80)) < 0.7 * noise.size


def test_shades_on_a_plain_ground_are_not_rounded():
    y, x = np.mgrid[:64, :64]
    inside = np.hypot(x - 30, y - 30) < 9
    shades = np.stack([5 * x, 5 * y, np.full_like(x, 100)], axis=-1)
    frame = np.where(inside[..., None], shades, 240).astype(np.uint8)
    frames = np.broadcast_to(frame, (4, 64, 64, 3))
    sheet = np.array(Image.open(io.BytesIO(sprite_sheet(frames, 80))).convert("RGB"), int)[:64]
    assert len(np.unique(sheet[inside], axis=0)) > 0.5 * inside.sum()


def test_reduced_frames_are_averages_of_blocks() -> None:
    frames = np.random.default_rng(1).integers(0, 256, (2, 30, 65, 3), np.uint8)
    found = reduced(frames, 16)
    assert found.shape == (2, 10, 21, 3)
    assert abs(found[1, 4, 7] - frames[1, 12:15, 21:24].mean((0, 1))).max() <= 0.5
    assert reduced(frames, 45) is frames
    assert reduced(np.zeros((1, 1, 3000, 3), np.uint8), 16).shape == (1, 1, 3000, 3)


def test_the_page_holds_the_first_videos_of_all_splits(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path))
    data = data_of((tmp_path / "index.html").read_bytes())
    assert [(video["split"], video["number"]) for video in data["videos"]] == [
        *(("train", number) for number in range(20)),
        *(("test", number) for number in range(3)),
    ]
    for video in data["videos"][:3]:
        truth = synthetic.video(made, video["split"], video["number"])
        slots = np.flatnonzero(truth["objects/present"])
        assert_array_equal(video["objects"]["slot"], slots)
        assert video["objects"]["color"] == truth["objects/color"][slots].tolist()
        position = truth["states/position"][:, slots]
        assert_allclose(unpacked(video["arrays"])["states/position"], position, atol=np.ptp(position) / 2**16)
        masks = pictures(video["masks"], made.sizes["T"])
        assert_array_equal(masks[..., 3] > 0, truth["masks/instance"] > 0)
        flow = truth["flow/forward"].astype(float)
        speed = np.hypot(flow[..., 0], flow[..., 1])
        opacity = pictures(video["flow"], made.sizes["T"])[..., 3]
        assert_array_equal(opacity > 0, speed > speed.max() / 16)
        assert_array_equal(pictures(video["sprite"], made.sizes["T"]), truth["frames"])  # small ones are lossless


@settings(deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(0.1, 1), st.floats(1e-2, 1e3))
def test_colours_of_flow_tell_direction_and_speed(angle: float, part: float, fastest: float) -> None:
    flow = fastest * np.array([[1, 0], [part * np.cos(angle), part * np.sin(angle)]])
    colors = flow_colors(flow.reshape(1, 1, 2, 2))[0, 0].astype(float)
    assert abs(colors[1, 3] / colors[0, 3] - part) <= 1 / 16 + 1e-5
    hues = [colorsys.rgb_to_hsv(*color[:3] / 255)[0] * 360 for color in colors]
    assert hues[0] == 0
    assert abs((hues[1] - np.degrees(angle) + 180) % 360 - 180) < 5 + 2


def test_a_page_is_the_same_however_the_dataset_was_made(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path / "once"), size=3)
    synthetic.make(synthetic.dataset(tmp_path / "grown", splits={"train": 9, "test": 1}), size=2)
    first = (tmp_path / "grown" / "index.html").read_bytes()
    synthetic.make(synthetic.dataset(tmp_path / "grown"), size=1)
    assert (tmp_path / "grown" / "index.html").read_bytes() == (tmp_path / "once" / "index.html").read_bytes() != first
    named = read_manifest(tmp_path / "once").files
    assert named["index.html"] == read_manifest(tmp_path / "grown").files["index.html"]


def test_a_page_of_noise_in_large_frames_stays_below_a_megabyte(tmp_path: Path) -> None:
    fields = {
        name: synthetic.FIELDS[name]
        for name in ("frames", "objects/mass", "objects/present", "masks/instance", "index", "time")
    }
    spec = synthetic.dataset(tmp_path, fields=fields, sizes={"T": 70, "H": 200, "W": 300, "K": 3}, splits={"train": 6})
    video = synthetic.video
    rng = np.random.default_rng(0)
    noise = {name: rng.integers(0, 256, (70, 200, 300, *channels), np.uint8) for name, channels in CHANNELS.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "video", lambda *which: video(*which) | noise)
        synthetic.make(spec)
    content = (tmp_path / "index.html").read_bytes()
    assert len(content) < 1e6
    videos = data_of(content)["videos"]
    assert videos
    for video in videos:
        assert video["sprite"]["height"] * video["sprite"]["width"] <= 128**2
        assert -(-video["frames"] // video["stride"]) <= 64


CHANNELS = {"frames": (3,), "masks/instance": ()}


def test_a_dataset_without_frames_has_a_page(tmp_path: Path) -> None:
    fields = {name: field for name, field in synthetic.FIELDS.items() if "H" not in field.axes.split()} | CAMERA
    synthetic.make(synthetic.dataset(tmp_path, fields=fields))
    video = data_of((tmp_path / "index.html").read_bytes())["videos"][0]
    assert "sprite" not in video
    assert {"states/position", "camera/scale"} <= unpacked(video["arrays"]).keys()


HOSTILE = "</script><script>hacked=1</script><img src=x onerror=hacked=1>\"'&amp;{{data}}"


def hostile(manifest: Manifest) -> Manifest:
    """The manifest with hostile text wherever it may hold any."""
    fields = {
        name: dataclasses.replace(field, unit=HOSTILE, meaning=HOSTILE) for name, field in manifest.fields.items()
    }
    return dataclasses.replace(manifest, fields=fields, licence=HOSTILE, name=HOSTILE)


def test_every_string_of_a_dataset_is_text(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path))
    manifest = hostile(read_manifest(tmp_path))
    content = page(manifest, [{"values": {"text/caption": HOSTILE}}])
    plain = page(read_manifest(tmp_path), [])
    for mark in (b"<script", b"</script", b"<img", b"hacked=1<"):
        assert content.count(mark) == plain.count(mark)
    assert data_of(content)["videos"][0]["values"]["text/caption"] == HOSTILE
    policy = re.search(rb'Content-Security-Policy" content="([^"]*)"', content)
    assert policy
    assert b"default-src &#x27;none&#x27;" in policy[1]
    assert b"unsafe" not in policy[1]


def test_whole_matched_sets_are_shown(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path))
    manifest = read_manifest(tmp_path)
    fields = {**manifest.fields, "matched/set": Field("int32", "n", "1", "number of the set")}
    for members in (1, 2, 5, 7, 16):
        matched = dataclasses.replace(
            manifest, fields=fields, config={"matched": {"members": members}}, splits={"train": 70, "test": 40}
        )
        numbers = shown_videos(matched)
        assert 0 < len(numbers) <= 24
        for split in ("train", "test"):
            own = [number for name, number in numbers if name == split]
            assert own == list(range(len(own)))
            assert len(own) % members == 0 or members > 12


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("page") / "tiny"
    annotations = {"energy": True, "contacts": 4}
    gen2d.generate(tiny.tiny_config(annotations=annotations), n=6, out=root)
    return root


@pytest.mark.full
def test_energies_of_states_are_those_that_are_stored(simulated: Path) -> None:
    manifest = read_manifest(simulated)
    videos = Videos(simulated, manifest, "train")
    names = "kinetic", "rotational", "potential"
    for number in range(6):
        values = dict(videos.dataset[number])
        stored = energies(values)
        bare = {name: own for name, own in values.items() if not name.startswith(("energy/", "momentum/"))}
        found = energies(bare)
        for name in (*(f"energy/{name}" for name in names), "momentum/linear"):
            assert_allclose(found[name], stored[name], rtol=1e-4, atol=1e-3)


@pytest.mark.full
def test_contacts_are_beginnings_at_their_frames(simulated: Path) -> None:
    manifest, batch = read_manifest(simulated), tiny.everything(simulated)
    videos = Videos(simulated, manifest, "train")
    shown = [videos.video(number, DETAIL)["contacts"] for number in range(6)]
    assert any(shown)
    for number, contacts in enumerate(shown):
        begins = np.isin(batch["contacts/kind"][number], (1, 2))
        expected = sorted(
            zip(batch["contacts/frame"][number][begins], batch["contacts/a"][number][begins], strict=True)
        )
        assert sorted((frame, a) for frame, a, *_ in contacts) == expected


def test_a_page_is_made_again_to_the_byte(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path))
    assert index_page(tmp_path, read_manifest(tmp_path)) == (tmp_path / "index.html").read_bytes()
