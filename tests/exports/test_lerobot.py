"""Episodes for LeRobot hold what the dataset holds, by their files and as `lerobot` itself reads them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import tiny
from numpy.testing import assert_allclose, assert_array_equal
from packages import package

import gen2d
from gen2d.core.errors import ConfigError
from gen2d.exports.formats import lerobot

parquet = package("pyarrow.parquet")
VIDEOS, FRAMES = 5, 6
CAMERA = "observation.images.frames"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = tiny.tiny_config(
        video={"frames": FRAMES, "height": 64, "width": 64, "fps": 20},
        annotations={"contacts": 4, "captions": True, "masks": True},
    )
    folder = tmp_path_factory.mktemp("made") / "tiny"
    gen2d.generate(config, VIDEOS, folder, device="cpu")
    return folder


@pytest.fixture(scope="module")
def exported(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return gen2d.export(made, "lerobot", tmp_path_factory.mktemp("exported") / "out").out


@pytest.fixture(scope="module")
def stored(made: Path) -> dict[str, np.ndarray]:
    return gen2d.open(made, fields="*")[:]


def test_rows_are_frames_with_all_that_frames_have(exported: Path, stored: dict[str, np.ndarray]) -> None:
    about = json.loads((exported / "meta" / "info.json").read_text())
    assert (about["codebase_version"], about["fps"], about["total_episodes"]) == ("v3.0", 20, VIDEOS)
    table = parquet.read_table(exported / about["data_path"].format(chunk_index=0, file_index=0))
    assert {CAMERA, *table.column_names} == about["features"].keys()
    columns: dict[str, np.ndarray] = {name: np.array(table[name].to_pylist()) for name in table.column_names}
    for name in ("states/position", "states/velocity", "states/angle", "camera/scale", "camera/center"):
        values = stored[name].reshape(VIDEOS * FRAMES, *stored[name].shape[2:])
        assert_array_equal(columns[f"observation.{name.replace('/', '.')}"].astype(np.float32), values)
    names = about["features"]["observation.state"]["names"]
    assert columns["observation.state"].shape == (VIDEOS * FRAMES, len(names))
    at = names.index("velocity.1.y")
    assert_array_equal(columns["observation.state"][:, at], stored["states/velocity"][:, :, 1, 1].ravel())
    assert columns["index"].tolist() == list(range(VIDEOS * FRAMES))
    assert columns["frame_index"].tolist() == list(range(FRAMES)) * VIDEOS
    assert_allclose(columns["timestamp"], columns["frame_index"] / 20, rtol=1e-6)


def test_episodes_have_factors_captions_and_their_places(exported: Path, stored: dict[str, np.ndarray]) -> None:
    rows: list[dict[str, Any]] = parquet.read_table(exported / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    tasks = parquet.read_table(exported / "meta/tasks.parquet").to_pydict()
    data = parquet.read_table(exported / "data/chunk-000/file-000.parquet").to_pydict()
    for number, row in enumerate(rows):
        assert (row["episode_index"], row["length"], row["gen2d/index"]) == (number, FRAMES, number)
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (number * FRAMES, (number + 1) * FRAMES)
        assert row["gen2d/factors/balls"] == stored["factors/balls"][number]
        assert row["tasks"] == [stored["text/short_caption"][number].decode()]
        task = data["task_index"][number * FRAMES]
        assert tasks["__index_level_0__"][tasks["task_index"].index(task)] == row["tasks"][0]
        film = f"chunk-{row[f'videos/{CAMERA}/chunk_index']:03d}/file-{row[f'videos/{CAMERA}/file_index']:03d}.mp4"
        assert (exported / "videos" / CAMERA / film).is_file()
    assert len(rows) == VIDEOS


def test_statistics_are_those_of_the_frames(exported: Path, stored: dict[str, np.ndarray]) -> None:
    stats = json.loads((exported / "meta" / "stats.json").read_text())
    position = stored["states/position"].reshape(VIDEOS * FRAMES, -1, 2).astype(float)
    found = stats["observation.states.position"]
    for name, expected in [("min", position.min(0)), ("max", position.max(0)), ("mean", position.mean(0))]:
        assert_allclose(found[name], expected, rtol=1e-6, atol=1e-9)
    assert_allclose(found["std"], position.std(0), rtol=1e-5, atol=1e-6)
    assert found["count"] == [VIDEOS * FRAMES]
    assert np.array(stats[CAMERA]["mean"]).shape == (3, 1, 1)
    assert 0 < np.mean(stats[CAMERA]["mean"]) < 1


def test_each_episode_has_statistics_of_its_own(exported: Path, stored: dict[str, np.ndarray]) -> None:
    rows = parquet.read_table(exported / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for number, row in enumerate(rows):
        frames, angle = stored["frames"][number] / 255, stored["states/angle"][number].astype(float)
        for name, least in [("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std)]:
            channels = np.array(row[f"stats/{CAMERA}/{name}"])
            assert channels.shape == (3, 1, 1)
            assert_allclose(channels.ravel(), least(frames, (0, 1, 2)), rtol=1e-9, atol=1e-12)
            assert_allclose(row[f"stats/observation.states.angle/{name}"], least(angle, 0), rtol=1e-6, atol=1e-6)
        assert len(row["stats/observation.state/mean"]) == stored["states/position"].shape[2] * 6
        assert row[f"stats/{CAMERA}/count"] == row["stats/observation.state/count"] == [FRAMES]


def test_episodes_of_many_files_name_theirs(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot, "FILE_VIDEOS", 2)
    out = gen2d.export(made, "lerobot", tmp_path / "out", fields=("frames", "index")).out
    numbers = []
    for path in sorted((out / "meta/episodes").rglob("*.parquet")):
        for row in parquet.read_table(path).to_pylist():
            chunk, file = row["meta/episodes/chunk_index"], row["meta/episodes/file_index"]
            assert path == out / f"meta/episodes/chunk-{chunk:03d}/file-{file:03d}.parquet"
            numbers.append((row["episode_index"], row["gen2d/index"]))
    assert numbers == [(n, n) for n in range(VIDEOS)]


@pytest.mark.filterwarnings("ignore")  # of lerobot and what it imports
def test_lerobot_removes_an_episode(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It needs the statistics of the other episodes, and columns of one axis."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    tools, reader = package("lerobot.datasets.dataset_tools"), package("lerobot.datasets.lerobot_dataset")
    out = gen2d.export(made, "lerobot", tmp_path / "out", fields=("frames", "states/*angle*", "index")).out
    ds = reader.LeRobotDataset("me/tiny", root=out, video_backend="pyav")
    left = tools.delete_episodes(ds, [1], output_dir=tmp_path / "left", repo_id="me/left")
    assert left.meta.total_episodes == VIDEOS - 1
    assert left.meta.stats["observation.state"]["count"] == [(VIDEOS - 1) * FRAMES]
    assert left.meta.stats[CAMERA]["mean"].shape == (3, 1, 1)


def test_selected_videos_are_episodes_from_0_on(made: Path, tmp_path: Path, stored: dict[str, np.ndarray]) -> None:
    out = gen2d.export(made, "lerobot", tmp_path / "out", select="index > 2").out
    rows = parquet.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["episode_index"], row["gen2d/index"]) for row in rows] == [(0, 3), (1, 4)]
    data = parquet.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()
    assert_array_equal(np.array(data["observation.states.angle"][FRAMES], np.float32), stored["states/angle"][4, 0])


def test_a_rate_that_is_no_whole_number_is_refused(tmp_path: Path) -> None:
    root = synthetic.folder(synthetic.make(synthetic.dataset(tmp_path / "toy", train=1, fps=12.5)))
    with pytest.raises(ConfigError, match=r"video.fps is 12.5, but must be a whole number for lerobot"):
        gen2d.export(root, "lerobot", tmp_path / "out")


@pytest.mark.filterwarnings("ignore")  # of lerobot and what it imports
def test_lerobot_reads_episodes(exported: Path, stored: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    reader = package("lerobot.datasets.lerobot_dataset")
    ds = reader.LeRobotDataset("me/tiny", root=exported, video_backend="pyav")
    assert (ds.num_episodes, ds.num_frames, ds.fps) == (VIDEOS, VIDEOS * FRAMES, 20)
    for row in (0, 7, 29):
        item, number, frame = ds[row], row // FRAMES, row % FRAMES
        assert_array_equal(item["observation.states.position"].numpy(), stored["states/position"][number, frame])
        shown = item[CAMERA].numpy().transpose(1, 2, 0) * 255
        assert np.abs(shown - stored["frames"][number, frame]).mean() < 8
        assert item["task"] == stored["text/short_caption"][number].decode()
    assert ds.meta.episodes[3]["gen2d/factors/balls"] == stored["factors/balls"][3]
