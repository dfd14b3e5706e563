"""What a run makes: the same videos in whatever way it is run, whole after any interruption, true to its config."""

import json
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import h5py
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import contents
from tiny import CONFIG, CROWDED, command, everything, run_command, run_on, same, tiny_config

import gen2d
from gen2d.config.reading import yaml_text
from gen2d.core.errors import ConfigError, FolderError, UserError
from gen2d.dataset.folder import clean
from gen2d.generation.run import generate
from gen2d.programs import shared
from gen2d.programs.rollout import Rollout

N = 21


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tiny") / "data"
    generate(CONFIG, N, out)
    return out


def test_holds_exactly_what_was_asked(tiny: Path):
    data = everything(tiny)
    assert_array_equal(data["index"], np.arange(N))
    assert data["frames"].shape == (N, 6, 16, 20, 3)
    assert data["states/position"].shape == (N, 6, 7, 2)
    ds = gen2d.open(tiny)
    assert_array_equal(ds.time, np.arange(6) / 20)
    assert gen2d.verify(tiny, "full") == []


def test_frame_zero_is_the_drawn_start(tiny: Path):
    data = everything(tiny)
    balls = data["objects/kind"][:, :3] == 0
    assert_array_equal(
        data["states/velocity"][:, 0, :3], data["factors/velocity"] * data["objects/present"][:, :3, None]
    )
    assert_array_equal(data["objects/present"][:, :3].sum(1), data["factors/balls"])
    assert balls.all()
    assert (data["states/angle"][:, 0, :3] == 0).all()


def test_an_empty_slot_is_zero_everywhere(tiny: Path):
    data = everything(tiny)
    empty = ~data["objects/present"]
    assert empty.any()
    for name, values in data.items():
        if name.startswith("objects/"):
            assert (values[empty] == 0).all(), name
        if name.startswith("states/"):
            assert (np.moveaxis(values, 2, 1)[empty] == 0).all(), name


def test_balls_start_apart_and_inside(tiny: Path):
    data = everything(tiny)
    for x, r, there in zip(
        data["states/position"][:, 0, :3], data["objects/radius"][:, :3], data["objects/present"], strict=True
    ):
        x, r = x[there[:3]].astype(float), r[there[:3]].astype(float)
        assert (x >= r[:, None]).all()
        assert (x <= [6, 5] - r[:, None]).all()
        gaps = np.hypot(*(x[:, None] - x).transpose(2, 0, 1)) - r[:, None] - r
        assert (gaps[~np.eye(len(x), dtype=bool)] > 0).all()


def test_h5py_alone_reads_every_field_with_its_unit(tiny: Path):
    manifest = json.loads((tiny / "manifest.json").read_text())
    read: dict[str, list] = {name: [] for name in manifest["fields"]}
    for path in sorted((tiny / "shards").iterdir()):
        with h5py.File(path) as file:
            for name, about in manifest["fields"].items():
                field: Any = file[name]
                assert {"axes", "unit", "meaning"} <= set(field.attrs)
                assert field.attrs["unit"] == about["unit"]
                read[name].append(field[...])
    data = everything(tiny)
    for name, values in data.items():
        assert_array_equal(np.concatenate(read[name]), values)


@pytest.mark.parametrize(
    ("n", "options"),
    [(5, {}), (40, {}), (N, {"videos_per_shard": 4}), (N, {"videos_per_shard": 7}), (N, {"codec": "zstd"})],
)
def test_a_video_does_not_depend_on_how_many_are_made_or_how_they_lie(
    tiny: Path, tmp_path: Path, n: int, options: dict
):
    generate(tiny_config(storage=options), n, tmp_path / "other")
    same(everything(tiny), everything(tmp_path / "other"), min(n, N))


def test_a_video_does_not_depend_on_the_number_of_devices(tiny: Path, tmp_path: Path):
    config = tmp_path / "tiny.yaml"
    config.write_text(yaml_text(CONFIG))
    for devices in {1, 3} - {len(jax.devices())}:  # those of this process made the other
        out = tmp_path / str(devices)
        run_on(devices, f"from gen2d.generation.run import generate; generate({str(config)!r}, {N}, {str(out)!r})")
        same(everything(tiny), everything(out))


@pytest.mark.full
def test_few_compiled_programs_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A process may have 65,530 memory maps, of which a program takes up to thousands."""

    def live_programs() -> int:
        names = [each.hlo_modules()[0].name for each in jax.devices()[0].client.live_executables()]
        return sum(name in ("jit_sample", "jit_simulate", "jit_stage", "jit_draw") for name in names)

    monkeypatch.setattr(shared, "MAX_PROGRAMS", 4)
    before = live_programs()
    for balls in (1, 2, 3):
        generate(tiny_config(scene={"balls": balls}), 4, tmp_path / str(balls))
        assert live_programs() <= before + 4 * len(jax.devices())


def test_workers_together_make_what_one_makes(tiny: Path, tmp_path: Path):
    out = tmp_path / "data"
    assert not generate(CONFIG, N, out, worker=(1, 2)).complete
    assert generate(CONFIG, N, out, worker=(0, 2)).complete
    same(everything(tiny), everything(out))
    assert (out / "manifest.json").read_bytes() == (tiny / "manifest.json").read_bytes()


def test_another_seed_or_split_gives_other_videos_and_all_seeds_are_allowed(tiny: Path, tmp_path: Path):
    starts = [everything(tiny)["factors/velocity"]]
    for seed in (1, 2**32, 2**63 - 1):
        generate(CONFIG, 4, tmp_path / str(seed), seed=seed)
        starts.append(everything(tmp_path / str(seed))["factors/velocity"])
    generate(CONFIG, 4, tmp_path / "test", split="test")
    starts.append(everything(tmp_path / "test", "test")["factors/velocity"])
    flat = np.concatenate([s.reshape(len(s), -1) for s in starts])
    assert len(np.unique(flat, axis=0)) == len(flat)


def test_running_again_does_nothing_and_a_larger_n_extends(tiny: Path, tmp_path: Path):
    out = tmp_path / "data"
    generate(CONFIG, 9, out)
    first = (out / "shards" / "train-00000.h5").stat()
    assert generate(CONFIG, 9, out).generated == 0
    assert generate(CONFIG, N, out).complete
    assert (out / "shards" / "train-00000.h5").stat().st_mtime_ns == first.st_mtime_ns
    same(everything(tiny), everything(out))


def test_another_config_or_seed_is_refused_unless_overwritten(tmp_path: Path):
    out = tmp_path / "data"
    generate(CONFIG, 4, out)
    before = everything(out)
    with pytest.raises(FolderError, match="seed"):
        generate(CONFIG, 4, out, seed=1)
    with pytest.raises(FolderError, match="elasticity"):
        generate(tiny_config(scene={"elasticity": 0.5}), 4, out)
    same(before, everything(out))
    generate(CONFIG, 4, out, seed=1, overwrite=True)
    assert not np.array_equal(before["frames"], everything(out)["frames"])


@pytest.mark.parametrize("kills", [3, pytest.param(40, marks=pytest.mark.slow)])
def test_killed_at_random_moments_it_completes_to_the_same_bytes(tiny: Path, tmp_path: Path, kills: int):
    """Killed while it starts, or after some more shards; a dataset that is complete makes room for another."""
    config, out = tmp_path / "tiny.yaml", tmp_path / "data"
    config.write_text(yaml_text(tiny_config(storage={"videos_per_shard": 4})))
    generate(str(config), 160, tmp_path / "clean")
    expected, words = contents(tmp_path / "clean"), ("--config", config, "--n", 160, "--out", out)
    argv, environment = command(*words)
    chance, killed, shards = random.Random(0), 0, out / "shards"
    while killed < kills:
        process = subprocess.Popen(argv, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        more = chance.randint(0, 8)
        enough, moment = len(list(shards.glob("*.h5"))) + more, chance.random() * (0.02 if more else 4)
        while process.poll() is None and len(list(shards.glob("*.h5"))) < enough:
            time.sleep(0.001)
        time.sleep(moment)
        process.kill()
        assert process.wait() in (0, -signal.SIGKILL)
        killed += process.returncode != 0
        for path in shards.glob("*.h5"):
            with h5py.File(path) as file:  # what has its final name is whole
                frames: Any = file["frames"]
                assert len(frames) == 4
        if process.returncode == 0:
            clean(out)
            assert contents(out) == expected
            shutil.rmtree(out)
    assert run_command(*words).returncode == 0
    same(everything(tiny), everything(out), N)
    assert gen2d.verify(out, "full") == []
    clean(out)
    assert contents(out) == expected


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_it_and_says_how_to_go_on(tmp_path: Path, number: int):
    config, out = tmp_path / "tiny.yaml", tmp_path / "data"
    config.write_text(yaml_text(tiny_config(storage={"videos_per_shard": 4})))
    arguments = ["--config", config, "--n", 40_000, "--out", out]  # enough for a process that is seldom looked at
    words, environment = command(*arguments)
    process = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and len(list((out / "shards").glob("*.h5"))) < 3:
        time.sleep(0.005)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "To go on: python -m gen2d " + " ".join(map(str, arguments)) in said
    assert "Traceback" not in said
    assert not list((out / "shards").glob("*.tmp*"))


@pytest.mark.full
def test_scenes_that_cannot_be_placed_are_an_error_with_the_options_to_change(tmp_path: Path):
    with pytest.raises(UserError, match="video 0 could not be placed"):
        generate(tiny_config(scene=CROWDED), 4, tmp_path / "data")


def test_states_that_are_no_numbers_are_an_error_not_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    columns = Rollout.host_columns

    def broken(rollout: Rollout, batch: Any) -> list[dict[str, np.ndarray]]:
        found = columns(rollout, batch)
        for own in found:
            own["states/velocity"] = own["states/velocity"].copy()
            own["states/velocity"][1, 2, 0] = np.nan
        return found

    monkeypatch.setattr(Rollout, "host_columns", broken)
    with pytest.raises(UserError, match="states/velocity of video 1 is not finite"):
        generate(CONFIG, 4, tmp_path / "data")
    assert not list((tmp_path / "data" / "shards").iterdir())


def test_splits_grow_apart_whatever_the_workers(tmp_path: Path):
    out = tmp_path / "data"
    generate(CONFIG, 4, out)
    generate(CONFIG, 32, out, split="val", worker=(0, 2))
    generate(CONFIG, 12, out, worker=(1, 2))
    generate(CONFIG, 12, out, worker=(0, 2))
    assert generate(CONFIG, 32, out, split="val", worker=(1, 2)).complete
    assert (len(gen2d.open(out, split="train")), len(gen2d.open(out, split="val"))) == (12, 32)


def test_a_disk_too_small_is_refused_before_it_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gen2d.dataset.folder.free_bytes", lambda path: 1000)
    with pytest.raises(FolderError, match="has 1.0 kB free".replace(".", "[.]")):
        generate(CONFIG, 64, tmp_path / "data")


@pytest.mark.parametrize(
    ("n", "worker"), [(0, (0, 1)), (-1, (0, 1)), (2**32, (0, 1)), (True, (0, 1)), (1, (1, 1)), (1, (0, 0))]
)
def test_impossible_runs_are_refused(tmp_path: Path, n: int, worker: tuple[int, int]):
    with pytest.raises(ConfigError):
        generate(CONFIG, n, tmp_path, worker=worker)


def test_the_licence_of_a_config_is_that_of_the_dataset(tmp_path: Path):
    """On all its cards, also after a repair; the videos are those without a licence."""
    made = tmp_path / "data"
    generate({**CONFIG, "licence": "CC-BY-4.0"}, 4, made)
    assert gen2d.open(made).manifest.licence == "CC-BY-4.0"
    assert "\nlicense: cc-by-4.0\n" in (made / "README.md").read_text()
    assert json.loads((made / "croissant.json").read_text())["license"] == "CC-BY-4.0"
    card = (made / "README.md").read_bytes()
    (made / "README.md").unlink()
    next((made / "shards").iterdir()).unlink()
    assert run_command("verify", made, "--repair").returncode == 0
    assert (made / "README.md").read_bytes() == card
    generate(CONFIG, 4, tmp_path / "plain")
    same(everything(made), everything(tmp_path / "plain"))


@pytest.mark.full
def test_the_frame_rate_does_not_change_the_motion(tmp_path: Path):
    """Frame t is the state at t / fps: two rates agree where their frames fall together, at steps of one length."""
    slow = tiny_config(
        video={"fps": 10, "frames": 4}, physics={"substeps": 24}, scene={"elasticity": 1.0, "friction": 0}
    )
    fast = tiny_config(
        video={"fps": 30, "frames": 10}, physics={"substeps": 8}, scene={"elasticity": 1.0, "friction": 0}
    )
    generate(slow, 8, tmp_path / "slow")
    generate(fast, 8, tmp_path / "fast")
    one, other = everything(tmp_path / "slow")["states/position"], everything(tmp_path / "fast")["states/position"]
    assert_allclose(one, other[:, ::3], atol=1e-4)
