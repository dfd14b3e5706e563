"""Simulations in float64: exact to its rounding, stored as computed, and without an effect on those in float32."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import holds
from numpy.testing import assert_array_equal
from synthetic import contents
from tiny import command, everything, same

import gen2d
from gen2d.config.matched import INTERVENTIONS

FPS, FRAMES = 10, 16
CONFIG: dict[str, Any] = {
    "video": {"frames": FRAMES, "fps": FPS, "height": 16, "width": 16},
    "scene": {"name": "collision", "contact_frames": [3, 9], "density": [1, 3]},
    "annotations": {"contacts": 4, "energy": True},
    "storage": {"batch_size": 8, "videos_per_shard": 8},
}
BOUNDS = {"float32": 3e-6, "float64": 1e-12}
OF_THE_SIMULATION = ("states/", "contacts/", "energy/", "momentum/", "quality/")


def made(root: Path, precision: str, count: int = 16, **sections: Any) -> Path:
    """A dataset with a simulation in this precision."""
    physics = {"substeps": 5} | ({} if precision == "float32" else {"precision": precision})
    gen2d.generate(CONFIG | {"physics": physics} | sections, count, root, device="cpu")
    return root


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Datasets of the same scenes, the one in float64 first."""
    folder = tmp_path_factory.mktemp("precision")
    return {precision: made(folder / precision, precision) for precision in ("float64", "float32")}


def exact_collision(video: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Positions [n, T, 2] and velocities of two balls on a line that collide without loss, from their first frame."""
    mass, radius = (video[f"objects/{name}"].astype(float) for name in ("mass", "radius"))
    x, v = (video[f"states/{name}"][:, :1, :, 0].astype(float) for name in ("position", "velocity"))
    hit = ((x[..., 1] - x[..., 0] - radius.sum(1)[:, None]) / (v[..., 0] - v[..., 1]))[..., None]
    after = 2 * (mass[:, None] * v).sum(-1, keepdims=True) / mass.sum(1)[:, None, None] - v
    time = np.arange(FRAMES)[:, None] / FPS
    before = np.minimum(time, hit)
    return x + before * v + (time - before) * after, np.where(time < hit, v, after)


@pytest.mark.parametrize("precision", BOUNDS)
def test_an_elastic_collision_is_exact_in_the_precision_asked_for(roots: dict[str, Path], precision: str) -> None:
    videos = everything(roots[precision])
    x, v = exact_collision(videos)
    speed = np.abs(v).max((1, 2))[:, None, None]
    assert (videos["contacts/count"] == 1).all()
    holds(f"{precision}: path, over the view", (videos["states/position"][..., 0] - x) / 10, BOUNDS[precision])
    holds(f"{precision}: velocity, relative", (videos["states/velocity"][..., 0] - v) / speed, BOUNDS[precision])
    kinetic = videos["energy/kinetic"]
    holds(f"{precision}: energy, relative", kinetic / kinetic[:, :1] - 1, BOUNDS[precision])


def test_what_is_simulated_is_stored_as_computed_and_the_scenes_are_the_same(roots: dict[str, Path]) -> None:
    narrow, wide = (gen2d.open(roots[precision], fields="*") for precision in ("float32", "float64"))
    assert narrow.fields.keys() == wide.fields.keys()
    for name, field in wide.fields.items():
        simulated = name.startswith(OF_THE_SIMULATION) and field.dtype == "float64" and name != "contacts/time"
        assert narrow.fields[name].dtype == ("float32" if simulated else field.dtype), name
        assert field.dtype != "float32" or not name.startswith(OF_THE_SIMULATION), name
    one, other = everything(roots["float32"]), everything(roots["float64"])
    drawn = [name for name in one if name.split("/")[0] in ("factors", "objects", "world", "camera", "index")]
    same({name: one[name] for name in drawn}, {name: other[name] for name in drawn})
    assert_array_equal(one["states/position"][:, 0], other["states/position"][:, 0])
    rounded = other["states/position"].astype(np.float32)
    assert (rounded != other["states/position"]).any()
    assert np.abs(one["frames"].astype(int) - other["frames"]).max() <= 1


def test_videos_made_again_have_the_bits_of_those_stored(roots: dict[str, Path]) -> None:
    assert gen2d.verify(roots["float64"], "regen", videos=16) == []


@pytest.mark.full
def test_simulated_and_drawn_again_they_are_those_stored(roots: dict[str, Path]) -> None:
    ds = gen2d.open(roots["float64"])
    stored, again = everything(roots["float64"]), gen2d.simulate_again(ds, [0, 5])
    assert {str(again[name].dtype) for name in again if name.startswith("states/")} == {"float64"}
    holds("simulated again, m", np.asarray(again["states/position"]) - stored["states/position"][[0, 5]], 1e-13)
    for name in ("camera/center", "camera/scale", "camera/angle"):
        same({name: np.asarray(again[name])}, {name: stored[name][[0, 5]]})
    assert_array_equal(gen2d.render(ds, [0, 5]), stored["frames"][[0, 5]])
    assert_array_equal(gen2d.render(ds, [0, 5], states=again), stored["frames"][[0, 5]])
    narrow = gen2d.simulate_again(ds, [0], overrides=["physics.precision=float32"])
    assert narrow["states/position"].dtype == np.float32


def test_loaders_give_float64_and_jax_float32_unless_its_64_bit_mode_is_on(roots: dict[str, Path]) -> None:
    torch = pytest.importorskip("torch")
    ds = gen2d.open(roots["float64"], fields=["states/position", "frames"])
    stored = ds[:8]["states/position"]

    def first(to: Any) -> Any:
        with gen2d.DataLoader(ds, batch_size=8, epochs=1, shuffle=False, to=to) as loader:
            return next(iter(loader))["states/position"]

    def streamed(to: str) -> Any:
        config = CONFIG | {"physics": {"substeps": 5, "precision": "float64"}}
        videos = gen2d.stream(config, batch_size=8, n=8, fields=["states/position"], to=to, device="cpu")
        return next(iter(videos))["states/position"]

    for source in (first, streamed):
        assert source("torch").dtype == torch.float64
        assert_array_equal(source("torch").numpy(), stored)
        assert source("jax").dtype == jnp.float32
        assert_array_equal(source("jax"), stored.astype(np.float32))
    assert_array_equal(first("numpy"), stored)
    with jax.enable_x64(True):
        assert_array_equal(first("jax"), stored)
        assert first("jax").dtype == jnp.float64


@pytest.mark.full
def test_states_alone_are_drawn_as_the_frames_of_a_dataset_with_frames(roots: dict[str, Path], tmp_path: Path) -> None:
    alone = gen2d.open(made(tmp_path / "alone", "float64", storage=CONFIG["storage"] | {"frames": "none"}), fields="*")
    drawn = gen2d.open(alone.root, fields=["frames", "states/velocity"])
    assert drawn.exact
    stored = everything(roots["float64"])
    assert_array_equal(drawn[:]["frames"], stored["frames"])
    assert_array_equal(drawn[:]["states/velocity"], stored["states/velocity"])


@pytest.mark.full
def test_a_float32_dataset_has_the_bytes_of_one_from_a_process_without_float64(
    roots: dict[str, Path], tmp_path: Path
) -> None:
    code = f"import test_precision as t; t.made(t.Path({str(tmp_path / 'fresh')!r}), 'float32')"
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent / "support"), *sys.path])
    argv, environment = command(JAX_COMPILATION_CACHE_DIR=str(tmp_path / "cache"), PYTHONPATH=path)
    done = subprocess.run([argv[0], "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "fresh") == contents(roots["float32"])


@pytest.mark.full
def test_motion_blur_and_annotations_of_pixels_are_drawn(roots: dict[str, Path], tmp_path: Path) -> None:
    pixels = {"annotations": {"masks": True, "flow": True}, "image": {"exposure": 0.5, "exposure_samples": 4}}
    one, other = (everything(made(tmp_path / precision, precision, 8, **pixels)) for precision in BOUNDS)
    for name, values in other.items():
        wide = name.startswith(OF_THE_SIMULATION) and values.dtype.kind == "f"
        assert values.dtype == ("float64" if wide else one[name].dtype), name
    assert np.abs(one["frames"].astype(int) - other["frames"]).max() <= 2
    assert (one["masks/instance"] != other["masks/instance"]).mean() < 1e-3


MATCHED = {
    "scene": {"name": "bouncing", "balls": 3, "width": 6, "height": 5, "radius": [0.3, 0.6], "density": [1, 5]},
    "matched": {"change": [*INTERVENTIONS, "density"], "members": 3, "distance": [1, 2]},
    "annotations": {},
    "storage": {"batch_size": 48, "videos_per_shard": 48},
}


@pytest.mark.slow
def test_matched_sets_have_the_same_changes_and_share_all_bits_before_them(tmp_path: Path) -> None:
    one, other = (everything(made(tmp_path / precision, precision, 144, **MATCHED)) for precision in BOUNDS)
    for name in one:
        if name.startswith(("matched/", "objects/", "factors/", "world/")):
            assert one[name].dtype == other[name].dtype
            assert name in ("matched/onset", "matched/size") or (one[name] == other[name]).mean() > 0.97, name
    np.testing.assert_allclose(one["matched/size"], other["matched/size"], rtol=2e-3)
    assert (one["matched/onset"] == other["matched/onset"]).mean() > 0.9
    assert other["states/position"].dtype == np.float64
    unchanged = []
    for i in np.flatnonzero((other["matched/onset"] > 0) & (other["matched/object"] >= 0)):
        original, onset, here = i // 3 * 3, other["matched/onset"][i], other["objects/present"][i]
        before, after = (other["states/position"][k, : onset + 1][:, here] for k in (original, i))
        assert_array_equal(before[:onset], after[:onset])
        unchanged.append((before[onset] == after[onset]).all(-1).sum())
    assert np.mean(unchanged) > 3  # walls, and the balls that the change does not concern
    assert gen2d.verify(tmp_path / "float64", "regen", videos=12) == []


@pytest.mark.full
def test_videos_that_quality_asks_for_are_in_float64(tmp_path: Path) -> None:
    limits = {"quality": {"min_energy_residual": 1e-16}, "scene": MATCHED["scene"]}
    limits["annotations"] = {"energy": True, "lyapunov": True}
    videos = everything(made(tmp_path / "ds", "float64", **limits))
    assert (videos["quality/energy_residual"] >= 1e-16).all()
    holds("accepted: residual, J", videos["quality/energy_residual"], 1e-9)
    assert videos["quality/energy_residual"].dtype == videos["quality/lyapunov"].dtype == np.float64
    assert np.isfinite(videos["quality/lyapunov"]).all()


@pytest.mark.full
def test_a_space_in_float64_is_exact() -> None:
    def thrown(**options: Any) -> Any:
        space = gen2d.Space(gravity=(0, -9.8), **options)
        space.add_circle((0.1, 5), 0.3, velocity=(0.7, 1.3))
        return space, space.simulate(1.0)

    space, video = thrown(precision="float64")
    path = np.stack([0.1 + 0.7 * video.time, 5 + 1.3 * video.time - 4.9 * video.time**2], -1)
    holds("space: path, m", video.position[:, 0] - path, 1e-12)
    assert {x.dtype for x in (video.angle, video.energy.kinetic, video.quality.max_penetration)} == {np.dtype("f8")}
    assert space.scene()[1].position.dtype == np.float64
    drag = space.simulate(1.0, forces=lambda state, time: (-0.0 * state.velocity, 0.0 * state.angular_velocity))
    holds("space: path with forces, m", drag.position[:, 0] - path, 1e-12)
    _, narrow = thrown()
    assert narrow.position.dtype == np.float32
    assert np.abs(narrow.position[:, 0] - path).max() > 1e-9
