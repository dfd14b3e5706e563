"""The peer renders the scene of the benchmark's config, and every measurement of the benchmark works."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bench
import bench_demos
import bench_physics
import bench_render
import bench_storage
import charts
import cv2
import h5py
import numpy as np
import peer
import pytest
from timing import first_batch

from gen2d.config.config import load_config

TINY = ("video.frames=3", "video.height=16", "video.width=16", "scene.balls=2")
TINY += ("storage.batch_size=4", "storage.videos_per_shard=8")


def test_the_peer_makes_the_scene_of_the_config() -> None:
    config = load_config(bench.CONFIG).plain()
    video, scene, look = config["video"], config["scene"], config["look"]
    assert (video["frames"], video["fps"]) == (peer.FRAMES, peer.FPS)
    assert video["height"] == video["width"] == peer.SIZE
    assert (scene["balls"], scene["width"], scene["height"]) == (peer.BALLS, peer.SIDE, peer.SIDE)
    assert scene["radius"] == {"uniform": list(peer.RADIUS)}
    assert scene["velocity"] == [{"normal": [0, peer.SPEED]}] * 2
    assert scene["elasticity"] == scene["wall_elasticity"] == peer.ELASTICITY
    assert scene["friction"] == scene["wall_friction"] == peer.FRICTION
    assert (scene["gravity"], scene["spin"], scene["density"]) == ([0, peer.GRAVITY], 0, 1)
    assert scene["color"] == [{"integer": [peer.COLORS[0], peer.COLORS[1] - 1]}] * 3
    assert (config["physics"]["substeps"], config["physics"]["mixing"]) == (peer.SUBSTEPS, "product")
    assert (look["background"], look["wall_width"]) == ([peer.BACKGROUND] * 3, 0)
    assert peer.FRAMES * peer.SIZE**2 * 3 == bench.FRAMES_BYTES


@pytest.mark.parametrize("demo", bench_demos.DEMOS, ids=lambda demo: demo.build.__name__)
def test_a_demonstration_begins_alike_in_all_engines(demo: bench_demos.Demo) -> None:
    space = bench_demos.Space(gravity=(0, -bench_demos.GRAVITY))
    demo.build(space)
    moving = [k for k, body in enumerate(space.bodies) if body.kind == bench_demos.DYNAMIC]
    own = np.array([(*b.position, b.angle, *b.velocity, b.spin, b.mass) for b in space.bodies])[moving]
    for engine in (bench_demos.in_box2d, bench_demos.in_chipmunk):
        world = engine(space)  # Box2D's bodies end with their world
        np.testing.assert_allclose(np.array(world.state())[moving], own, atol=1e-5, rtol=1e-5)


@pytest.mark.slow
def test_every_stage_is_timed(tmp_path: Path) -> None:
    turns = bench.stages(tmp_path, turns=1, peer_videos=1, overrides=TINY)
    assert {"sampler", "simulate", "render", "transfer", "compress", "write", "peer body", "peer draw"} <= turns.keys()
    assert all(seconds > 0 for (seconds,) in turns.values())


@pytest.mark.slow
def test_states_are_made_and_loaded(tmp_path: Path) -> None:
    turns = bench.states(tmp_path, videos=8, turns=1, window=2, overrides=TINY)
    assert all(seconds > 0 for values in turns.values() for seconds in values)
    assert turns["bytes states"][0] < turns["bytes frames"][0]


@pytest.mark.slow
def test_an_option_of_physics_is_timed_and_its_overlaps_are_measured(tmp_path: Path) -> None:
    values = "float32", "float64"
    turns = bench.physics_option(tmp_path, 1, "bouncing.yaml", "precision", values, overrides=TINY)
    assert turns.keys() == {*values, *(f"overlap {value}" for value in values)}
    assert all(seconds > 0 for (seconds,) in (turns[value] for value in values))


def test_every_way_to_store_is_timed(tmp_path: Path) -> None:
    case = bench_storage.Case(16, 4, 8, 1, 1, 1, 1)
    code = f"""
import json
from pathlib import Path
from bench_storage import Case, works
print(json.dumps({{name: work() for name, work in works({case}, Path({str(tmp_path)!r})).items()}}))
"""
    path = os.pathsep.join([str(bench.HERE.parent), str(bench.SUPPORT)])
    process = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path}, capture_output=True, check=True
    )
    seconds = json.loads(process.stdout)
    names = {f"{what} {codec}" for what in ("loader", "h5py") for codec in ("gzip", "zstd", "none")}
    assert names | {"copy", "h5py gzip-4", "codec zstd", "write zstd", "codec gzip", "write gzip"} == seconds.keys()
    assert all(value > 0 for value in seconds.values())
    assert bench_storage.table([bench_storage.stored_of(case, seconds)])


@pytest.mark.full
def test_bounds_counts_whole_videos_only(tmp_path: Path) -> None:
    bench.make(bench.source_of(TINY), 8, tmp_path)
    checks = bench.bounds(tmp_path)
    assert (checks["videos"], checks["bad"]) == (8, 0)
    assert checks["walls"] < 0.25


def test_the_peer_makes_a_readable_shard(tmp_path: Path) -> None:
    peer.write_shard(tmp_path / "shard.h5", range(2))
    with h5py.File(tmp_path / "shard.h5") as file:
        frames, states = file["frames"], file["states"]
        assert isinstance(frames, h5py.Dataset)
        assert isinstance(states, h5py.Dataset)
        assert (frames.shape, frames.chunks) == ((2, 64, 64, 64, 3), (1, 64, 64, 64, 3))
        assert frames[0, 0].max() > peer.BACKGROUND
        assert ((states[..., :2] > 0) & (states[..., :2] < peer.SIDE)).all()


def test_both_ways_of_reading_pymunk_agree() -> None:
    start = peer.sample(0)
    by_body, by_batch = (peer.simulate(peer.space_of(start), read) for read in peer.READERS)
    assert (by_body == by_batch).all()


@pytest.mark.parametrize("shape", ["discs", "boxes"])
def test_the_engines_of_the_physics_section_start_from_the_same_scene(shape: str) -> None:
    start = bench_physics.sample(bench_physics.Case(shape, 5, 1, (1, 0), 1), 0)
    (scene, state, layout), space = bench_physics.gen2d_scene(start), bench_physics.chipmunk_space(start)
    assert [run.count for run in layout.groups] == [5, 4]
    chipmunk = np.array([(*b.position, b.angle, *b.velocity, b.mass, b.moment) for b in space.bodies])
    columns = state.position, state.angle, state.velocity, scene.objects.mass, scene.objects.moment
    np.testing.assert_allclose(np.column_stack([x[:5] for x in columns]), chipmunk, rtol=1e-6)


@pytest.mark.slow
def test_every_engine_of_the_physics_section_is_timed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    case = bench_physics.Case("discs", 2, 2, (1, 0), 1)
    monkeypatch.setitem(bench_physics.CASES, case.name, case)
    turns = bench.physics(tmp_path, case.name, turns=1)
    assert {"states", "all", "time", "pymunk"} | {f"compile {x}" for x in ("states", "all", "time")} == turns.keys()
    assert all(seconds > 0 for (seconds,) in turns.values())
    cost = bench_physics.cost_of(case, {name: seconds for name, (seconds,) in turns.items()})
    assert cost.pairs == 9
    assert "2 discs" in bench.text_of({}, [cost])


def has_color(image: np.ndarray, color: str) -> bool:
    """Whether a pixel of a BGR image has a colour such as '#114499'."""
    return bool((image[..., ::-1] == list(bytes.fromhex(color[1:]))).all(-1).any())


def test_the_chart_of_the_physics_section_draws_what_was_measured(tmp_path: Path) -> None:
    costs = [bench_physics.Cost(f"{n} discs", n, n * n, {"all": n / 2, "pymunk": n}, {}) for n in (4, 8)]
    bench_physics.chart(costs, tmp_path / "chart.png")
    image = cv2.imread(str(tmp_path / "chart.png"))
    assert image is not None
    assert image.shape == (charts.HEIGHT, charts.WIDTH, 3)
    drawn = {name: has_color(image, color) for name, color in bench_physics.COLORS.items()}
    assert drawn == {"states": False, "all": True, "pymunk": True, "phyjax2d": False}


SMALL = bench_render.Case(32, 2, 4)


@pytest.mark.full
def test_opencv_draws_the_pictures_of_gen2d() -> None:
    rollout = bench.source_of(SMALL.overrides).rollout
    batch = first_batch(rollout)
    ours, columns = np.asarray(rollout.draw(batch, 0, 4)[0]["frames"])[0], rollout.host_columns(batch)[0]
    theirs = np.empty_like(ours)
    bench_render.draw_discs(columns, 0, theirs)
    scale, middle = SMALL.pixels / peer.SIDE, np.arange(SMALL.pixels) + 0.5
    position, radius = columns["states/position"][0, :, :2] * scale, columns["objects/radius"][0, :2] * scale
    x, y = (position[..., i, None, None] for i in (0, 1))
    rim_distance = np.hypot(middle - x, SMALL.pixels - middle[:, None] - y) - radius[:, None, None]
    inside = (np.abs(rim_distance) > 3).all(1)  # px from the rims; OpenCV's discs are about 1 px too large
    assert 0.5 < inside.mean() < 1
    assert (ours[inside] == theirs[inside]).all()
    assert (ours != peer.BACKGROUND).any()


@pytest.mark.full
def test_every_way_of_drawing_is_timed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(bench_render.CASES, SMALL.name, SMALL)
    turns = bench.render(tmp_path, SMALL.name, turns=1)
    assert turns.keys() == bench_render.LINES.keys()
    assert all(seconds > 0 for (seconds,) in turns.values())
    drawing = bench_render.drawing_of(SMALL, {name: seconds for name, (seconds,) in turns.items()})
    assert "32 px, 2 discs" in bench.text_of({}, [drawing])


@pytest.mark.full
def test_every_look_is_timed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(bench_render.CASES, SMALL.name, SMALL)
    turns = bench.looks(tmp_path, SMALL.name, turns=1)
    assert turns.keys() == bench_render.LOOKS.keys()
    assert all(seconds > 0 for (seconds,) in turns.values())


@pytest.mark.full
def test_sensors_and_surfaces_are_timed_by_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(bench_render.CASES, SMALL.name, SMALL)
    monkeypatch.setattr(bench_render, "SENSORS", {"no sensor": (), "noise": ("noise=2",)})
    monkeypatch.setattr(bench_render, "SURFACES", {"studio": (), "shadow": ("shadow=true",)})
    assert bench.sensors(tmp_path, SMALL.name, turns=1).keys() == {"no sensor", "noise"}
    assert bench.surfaces(tmp_path, SMALL.name, turns=1).keys() == {"studio", "shadow"}
    assert {"looks", "sensors", "surfaces", "lit"} <= bench.MEASUREMENTS.keys()


@pytest.mark.full
def test_what_annotations_add_is_timed_and_weighed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bench_render, "ANNOTATED", SMALL)
    monkeypatch.setattr(bench_render, "ANNOTATIONS", {"frames": (), "flow": ("flow=true",)})
    turns = bench.annotated(tmp_path, turns=1)
    assert all(seconds > 0 for name in ("frames", "flow") for seconds in turns[name])
    assert (turns["bytes frames"], turns["bytes flow"]) == ([0], [32 * 32 * 2 * (2 * 2 + 1)])
    assert "flow" in bench.text_of({}, list(bench.annotation_results(turns)))


def test_the_chart_of_the_render_section_draws_what_was_measured(tmp_path: Path) -> None:
    both = [({"gen2d": n / 9, "opencv": n / 3}, n) for n in (64, 128)]
    drawings = [bench_render.Drawing(f"{n} px", n, 8, micros, {}) for micros, n in both]
    bench_render.chart(drawings, tmp_path / "chart.png")
    image = cv2.imread(str(tmp_path / "chart.png"))
    assert image is not None
    assert image.shape == (charts.HEIGHT, charts.WIDTH, 3)
    assert all(has_color(image, color) for color in bench_render.COLORS.values())


@pytest.mark.full
def test_the_benchmark_of_gpus_runs_on_a_cpu() -> None:
    command = [
        sys.executable,
        Path(__file__).with_name("bench_gpu.py"),
        "--small",
        "--only",
        "agreement,draw,host",
    ]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "Traceback" not in text
    assert "bouncing" in text
    assert "0 levels" in text
