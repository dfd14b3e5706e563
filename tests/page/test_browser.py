"""The page in a real browser: it loads from a file, plays, draws overlays, keeps twins in step and filters."""

import dataclasses
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tiny
from browser import Tab, browser, chromium
from numpy.testing import assert_allclose
from test_page import hostile

import gen2d
from gen2d.dataset.manifest import read_manifest
from gen2d.page.page import page
from gen2d.page.video import Videos, flow_colors
from gen2d.tools.view import DETAIL, Library, serving

pytestmark = pytest.mark.full
ONSET = 6  # frames that the videos of a set share, at least
OVERLAYS = ("Outlines", "Velocities", "Trails", "Boxes", "Masks", "Numbers", "Flow", "Depth", "Normals", "Shadow")
PIXELS = "JSON.stringify([...document.querySelectorAll('#views canvas')].map((canvas) => canvas.toDataURL()))"

# Mean difference of the pixels of two shown videos, in grey levels.
APART = """(() => {
  const [one, other] = state.shown.map(({ canvas }) =>
    canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data);
  return one.reduce((sum, value, i) => sum + Math.abs(value - other[i]), 0) / one.length;
})()"""
# Pixels of the second video in the size in which it is stored.
SMALL = """(() => {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [60, 48];
  drawFrame(canvas, state.shown[1], state.step, new Set());
  return [...canvas.getContext("2d").getImageData(0, 0, 60, 48).data];
})()"""
TIMES = """Array.from({ length: 48 }, (_, i) => {
  const from = performance.now();
  go(i % 24);
  return performance.now() - from;
})"""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Violations of 12 sets: a ball jumps half-way through the video."""
    chromium()
    config = tiny.tiny_config(
        video={"frames": 24, "height": 48, "width": 60},
        matched={"change": ["teleport"], "onset": 0.5, "distance": [1, 2]},
        look={"name": "studio", "palette": "scene"},
        annotations=dict.fromkeys(("masks", "boxes", "flow", "depth", "normals", "shadow"), True),
    )
    folder = tmp_path_factory.mktemp("browser") / "twins"
    gen2d.generate(config, n=30, out=folder)
    return folder


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture
def opened(root: Path, tab: Tab) -> Tab:
    """The page of the dataset, stopped at its first frame."""
    tab.events.clear()
    tab.open((root / "index.html").as_uri())
    tab.evaluate("play(false), go(0)")
    return tab


def test_the_page_loads_from_a_file_without_an_error_or_a_request(opened: Tab, root: Path) -> None:
    assert opened.errors() == []
    assert opened.requests() == [(root / "index.html").as_uri()]
    assert opened.evaluate("document.querySelectorAll('#gallery canvas').length") == 24
    assert opened.evaluate("getComputedStyle(document.querySelector('main')).display") == "grid"


def test_the_page_plays(opened: Tab) -> None:
    opened.press(" ")
    opened.wait_for("state.step > 3")
    assert opened.evaluate("$('play').textContent") == "Pause"
    opened.press(" ")
    opened.press("Home")
    opened.press("ArrowRight")
    assert opened.evaluate("[state.playing, state.step, $('scrubber').value]") == [False, 1, "1"]
    assert "frame 1 of 24, 0.050 s" in opened.evaluate("$('clock').textContent")
    assert opened.evaluate("$('scrubber').getAttribute('aria-valuetext')") == "frame 1 of 24, 0.050 s"
    opened.press("End")
    assert opened.evaluate("state.step") == 23
    times = opened.evaluate(TIMES)
    assert np.median(times) < 16  # ms, of a drawn frame with the gallery


def test_the_page_never_shows_a_time_before_the_first_frame(opened: Tab) -> None:
    early = "(play(true), tick(performance.now() - 100), play(false), [state.time, $('clock').textContent])"
    time, text = opened.evaluate(early)
    assert time >= 0
    assert text.startswith("frame 0 of ")


@pytest.mark.parametrize("name", OVERLAYS)
def test_an_overlay_changes_pixels(opened: Tab, name: str) -> None:
    opened.evaluate("go(8)")
    before = opened.evaluate(PIXELS)
    opened.evaluate(f"$('show-{name}').click()")
    assert opened.evaluate(PIXELS) != before
    opened.press(opened.evaluate(f"KEYS[Object.keys(OVERLAYS).indexOf('{name}')]"))
    assert opened.evaluate(PIXELS) == before


def test_twins_stay_in_step(opened: Tab, root: Path) -> None:
    onset = gen2d.open(root, fields=["matched/onset"])[1]["matched/onset"]
    assert opened.evaluate("state.shown.length") == 2
    apart = [opened.evaluate(f"go({step}), {APART}") for step in (0, 3, ONSET, int(onset))]
    assert onset > ONSET
    assert max(apart[:3]) < 2  # grey levels: each video is encoded alone
    assert apart[3] > 2 * max(apart[:3]), apart


def test_the_drawn_frame_is_the_stored_one(opened: Tab, root: Path) -> None:
    frames = gen2d.open(root, fields=["frames"])[1]["frames"].astype(float)
    for step in (0, 11, 23):
        pixels = opened.evaluate(f"go({step}), {SMALL}")
        drawn = np.reshape(pixels, (*frames.shape[1:3], 4))[..., :3]
        assert abs(frames - drawn).mean((1, 2, 3)).argmin() == step
        assert abs(frames[step] - drawn).mean() < 8


def test_filters_filter(opened: Tab, root: Path) -> None:
    values = gen2d.open(root, fields=["factors/balls", "matched/member"])[:24]
    expected = np.flatnonzero((values["factors/balls"] >= 2) & (values["matched/member"] == 0)).tolist()
    assert 0 < len(expected) < 12
    for name, low, high in (("factors/balls", 2, ""), ("matched/member", "", 0)):
        opened.evaluate(
            f"$('add').click(); (([name, low, high]) => {{ name.value = '{name}'; low.value = '{low}'; "
            f"high.value = '{high}'; high.dispatchEvent(new Event('change', {{bubbles: true}})); }})"
            "([...$('rules').lastChild.querySelectorAll('select, input')])"
        )
    opened.wait_for(f"gallery.length === {len(expected)}")
    assert opened.evaluate("gallery.map((entry) => entry.number)") == expected


def test_the_script_reads_what_was_stored(opened: Tab, root: Path) -> None:
    video = gen2d.open(root, fields=["states/position", "objects/present"])[0]
    expected = video["states/position"][:, video["objects/present"]]
    found = opened.evaluate("[...state.shown[0].arrays['states/position'].values]")
    assert_allclose(np.reshape(found, expected.shape), expected, atol=np.ptp(expected) / 2**15)
    shape = "state.shown[0].arrays['states/position'].shape"
    assert opened.evaluate(shape) == list(expected.shape)


def test_the_wheel_of_flow_has_the_colours_of_flow(opened: Tab) -> None:
    """A frame that moves as a whole, in each of four directions, has the colour of that side of the wheel."""
    for column, row in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        expected = flow_colors(np.array([column, row], float).reshape(1, 1, 1, 2))[0, 0, 0, :3]
        pixel = opened.evaluate(f"""(() => {{
          const canvas = document.createElement("canvas");
          [canvas.width, canvas.height] = [400, 400];
          const video = {{ width: 400, height: 400, flow: {{ image: new Image(), rows: 1, width: 1, height: 1 }} }};
          drawFlow(canvas.getContext("2d"), video, 0, 1);
          return [...canvas.getContext("2d").getImageData({376 + 12 * column}, {23 + 12 * row}, 1, 1).data];
        }})()""")
        assert_allclose(pixel[:3], expected, atol=2)


def test_colours_of_a_palette_are_shown_instead_of_the_scenes(opened: Tab) -> None:
    assert "not drawn" not in opened.evaluate("$('others').textContent")
    shown = opened.evaluate("""(() => {
      for (const { objects } of state.shown) objects.color = objects.color.map((_, k) => [k, 2, 3]);
      fillValues();
      return [$("values").textContent, $("others").textContent];
    })()""")
    assert "colors drawn" in shown[0]
    assert "not drawn: color" in shown[1]
    chips = opened.evaluate("[...$('values').querySelectorAll('.chip')].map((chip) => chip.title)")
    moving = opened.evaluate("state.shown.flatMap(({ objects }) => objects.color.filter((_, k) => !fixed(objects, k)))")
    assert chips == [", ".join(map(str, color)) for color in moving]


def test_occluders_are_drawn_before_the_objects_behind_them(opened: Tab) -> None:
    """Without frames: an occluder of the whole picture, behind the first moving ball and before it."""
    pixel = """(depth) => {
      const video = { ...state.shown[0], sprite: null, occluders: [[0, 0, 60, 48, 1, 2, 3, depth]] };
      const k = video.objects.slot.findIndex((_, k) => !fixed(video.objects, k));
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height] = [60, 48];
      drawFrame(canvas, video, 0, new Set());
      const position = video.arrays["states/position"];
      const [x, y] = camera(video, 0).point(at(position, 0, k, 0, 2), at(position, 0, k, 1, 2));
      const seen = [...canvas.getContext("2d").getImageData(x, y, 1, 1).data].slice(0, 3);
      return [seen, video.objects.color[k], video.objects["objects/depth"][k]];
    }"""
    _, color, depth = opened.evaluate(f"({pixel})(0)")
    assert opened.evaluate(f"({pixel})({depth})")[0] == color
    assert opened.evaluate(f"({pixel})({depth + 1})")[0] == [1, 2, 3]


def test_hostile_strings_are_shown_and_do_nothing(tab: Tab, root: Path, tmp_path: Path) -> None:
    manifest = hostile(read_manifest(root))
    video = Videos(root, read_manifest(root), "train").video(0, DETAIL)
    evil = manifest.licence
    video["values"] |= {"text/caption": evil, f"factors/{evil}": evil}
    manifest = dataclasses.replace(manifest, fields={**manifest.fields, f"factors/{evil}": manifest.fields["index"]})
    (tmp_path / "evil.html").write_bytes(page(manifest, [video]))
    tab.events.clear()
    tab.open((tmp_path / "evil.html").as_uri())
    assert tab.evaluate("typeof hacked") == "undefined"
    assert tab.evaluate("document.querySelectorAll('body img, main script').length") == 0
    assert evil in tab.evaluate("$('texts').textContent")
    assert evil in tab.evaluate("$('values').textContent")
    assert tab.errors() == []
    # Even a script that got into the page would not run.
    tab.evaluate("document.body.append(Object.assign(document.createElement('script'), {textContent: 'hacked = 1'}))")
    assert tab.evaluate("typeof hacked") == "undefined"


def test_all_videos_are_shown_by_the_server(tab: Tab, root: Path) -> None:
    with serving(Library(root), 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            tab.events.clear()
            tab.open(f"http://127.0.0.1:{server.server_port}/")
            tab.evaluate("play(false), $('next').click()")
            tab.wait_for("gallery.length === 6 && gallery.every((entry) => entry.video)")
            assert "25 to 30 of 30 videos" in tab.evaluate("$('count').textContent")
            tab.evaluate("gallery[5].button.click()")
            tab.wait_for("state.chosen.number === 29")
            assert tab.errors() == []
            assert all(url.startswith(f"http://127.0.0.1:{server.server_port}/") for url in tab.requests())
        finally:
            server.shutdown()
            thread.join()
