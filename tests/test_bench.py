"""The benchmark measures what it says: the peer makes the same scene, and every measurement works."""

from pathlib import Path

import bench
import bench_physics
import cv2
import h5py
import numpy as np
import peer
import pytest

from gen2d.config import load_config

TINY = ("video.frames=3", "video.height=16", "video.width=16", "scene.balls=2")
TINY += ("storage.lanes=4", "storage.videos_per_shard=8")


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


def test_every_stage_is_timed(tmp_path: Path) -> None:
    turns = bench.stages(tmp_path, turns=1, peer_videos=1, sets=TINY)
    assert {"sampler", "simulate", "render", "transfer", "compress", "write", "peer body", "peer draw"} <= turns.keys()
    assert all(seconds > 0 for (seconds,) in turns.values())


def test_bounds_counts_whole_videos_only(tmp_path: Path) -> None:
    bench.make(bench.rollout_of(TINY), 8, tmp_path)
    found = bench.bounds(tmp_path)
    assert (found["videos"], found["bad"]) == (8, 0)
    assert found["walls"] < 0.25


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
    start = peer.sampled(0)
    by_body, by_batch = (peer.stepped(peer.space_of(start), read) for read in peer.READERS)
    assert (by_body == by_batch).all()


@pytest.mark.parametrize("shape", ["discs", "boxes"])
def test_the_engines_of_the_physics_section_start_from_the_same_scene(shape: str) -> None:
    start = bench_physics.sampled(bench_physics.Case(shape, 5, 1, (1, 0), 1), 0)
    (scene, state, layout), space = bench_physics.gen2d_scene(start), bench_physics.chipmunk_space(start)
    assert [run.count for run in layout.runs] == [5, 4]
    own = np.array([(*b.position, b.angle, *b.velocity, b.mass, b.moment) for b in space.bodies])
    columns = state.position, state.angle, state.velocity, scene.objects.mass, scene.objects.moment
    np.testing.assert_allclose(np.column_stack([x[:5] for x in columns]), own, rtol=1e-6)


def test_every_engine_of_the_physics_section_is_timed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    case = bench_physics.Case("discs", 2, 2, (1, 0), 1)
    monkeypatch.setitem(bench_physics.CASES, case.name, case)
    turns = bench.physics(tmp_path, case.name, turns=1)
    assert {"states", "all", "pymunk", "compile states", "compile all"} == turns.keys()
    assert all(seconds > 0 for (seconds,) in turns.values())
    cost = bench_physics.cost_of(case, {name: seconds for name, (seconds,) in turns.items()})
    assert cost.pairs == 9
    assert "2 discs" in bench.text_of({}, [cost])


def test_the_chart_of_the_physics_section_draws_what_was_measured(tmp_path: Path) -> None:
    costs = [bench_physics.Cost(f"{n} discs", n, n * n, {"all": n / 2, "pymunk": n}, {}) for n in (4, 8)]
    bench_physics.chart(costs, tmp_path / "chart.png")
    image = cv2.imread(str(tmp_path / "chart.png"))
    assert image is not None
    assert image.shape == (bench_physics.HEIGHT, bench_physics.WIDTH, 3)
    drawn = {name: (image == color).all(-1).any() for name, color in bench_physics.COLORS.items()}
    assert drawn == {"states": False, "all": True, "pymunk": True, "phyjax2d": False}
