"""What is exported, read back by programs that know nothing of gen2d, is what the dataset holds."""

import dataclasses
import importlib.util
import io
import json
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import h5py
import numpy as np
import pytest
import synthetic
import tiny
from numpy.testing import assert_allclose, assert_array_equal

import gen2d
from gen2d.config import plugins
from gen2d.core.errors import ConfigError, FolderError, UserError
from gen2d.core.schema import Field
from gen2d.exports import export
from gen2d.exports import parts as parts_module
from gen2d.exports import source as source_module
from gen2d.exports.partial import PartialExport
from gen2d.loading.dataset import RenderOptions
from gen2d.media import films

SIZES = {"T": 6, "H": 64, "W": 48, "K": 3}
TRAIN = 10
FILMS = {"mp4": ".mp4", "h264": ".mp4", "av1": ".mp4", "ffv1": ".mkv"}
TABLES = ["parquet", "videofolder", "lerobot"] if importlib.util.find_spec("pyarrow") else []
ZARR = ["zarr"] if importlib.util.find_spec("zarr") else []
FOLDERS = [*FILMS, "npz", "webdataset", *TABLES, *ZARR]


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Discs with hard rims and random colours: as hard for a lossy codec as a small picture can be."""
    made = synthetic.dataset(tmp_path_factory.mktemp("data") / "toy", train=TRAIN, sizes=SIZES)
    return synthetic.folder(synthetic.make(made))


def decoded(path: Path) -> tuple[np.ndarray, Fraction]:
    """Frames [T, H, W, 3] and frames/s of a film."""
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(stream)]
        assert stream.average_rate is not None
        return np.stack(frames), stream.average_rate


def noise_ratio(found: np.ndarray, expected: np.ndarray) -> float:
    """How little they differ, PSNR in dB."""
    return float(10 * np.log10(255**2 / max(np.mean((found.astype(float) - expected) ** 2), 1e-9)))


def tree(root: Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


# ---- Films


@pytest.mark.parametrize("to", FILMS)
def test_a_film_per_video_has_its_frames_at_its_rate(toy: Path, tmp_path: Path, to: str) -> None:
    made = gen2d.export(toy, to, tmp_path / to)
    files = sorted(path for path in made.out.iterdir() if path.name != "export.json")
    films, stored = [path for path in files if path.suffix == FILMS[to]], synthetic.stored(toy)
    assert [path.name for path in films] == [f"train-{number:09d}{FILMS[to]}" for number in range(TRAIN)]
    assert made.videos == TRAIN
    assert made.bytes == sum(path.stat().st_size for path in files)
    for number, path in enumerate(path for path in files if path not in films):
        with np.load(path) as archive:
            found = dict(archive)
        assert_array_equal(found.pop("time"), np.arange(6) / 10)
        same(found, {name: values for name, values in stored.items() if name != "frames"}, number)
    assert len(files) == 2 * TRAIN
    for path, frames in zip(films, stored["frames"], strict=True):
        found, rate = decoded(path)
        assert rate == 10
        assert found.shape == frames.shape
        if made.loss:
            assert noise_ratio(found, frames) > 22
        else:
            assert_array_equal(found, frames)


def test_films_alone_have_no_archives(toy: Path, tmp_path: Path) -> None:
    out = gen2d.export(toy, "mp4", tmp_path / "films", fields="frames").out
    assert {path.suffix for path in out.iterdir()} == {".mp4", ".json"}


def test_what_opencv_reads_is_in_the_right_colours(toy: Path, tmp_path: Path) -> None:
    for to in ("mp4", "h264", "ffv1"):
        path = next(gen2d.export(toy, to, tmp_path / to).out.glob("train-000000003.m*"))
        film, frames = cv2.VideoCapture(str(path)), []
        assert film.get(cv2.CAP_PROP_FPS) == 10
        while (read := film.read())[0]:
            frames.append(read[1][..., ::-1])
        assert noise_ratio(np.stack(frames), synthetic.stored(toy)["frames"][3]) > 22


@pytest.mark.parametrize("fps", [0.5, 12.5, 24000 / 1001, 29.97, 240.0])
@pytest.mark.parametrize("to", FILMS)
def test_the_rate_is_kept(tmp_path: Path, to: str, fps: float) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path / "toy", train=1, fps=fps, sizes=SIZES))
    out = gen2d.export(synthetic.folder(made), to, tmp_path / "out").out
    assert float(decoded(next(out.glob("train-*.m*")))[1]) == pytest.approx(fps, rel=1e-4)


# ---- Arrays


def same(found: dict[str, np.ndarray], stored: dict[str, np.ndarray], number: int) -> None:
    """Fails unless one video's fields are those stored, to the bit."""
    tiny.same({name: value[None] for name, value in found.items()}, {n: v[number][None] for n, v in stored.items()})


def test_an_archive_per_video_has_every_field_bit_by_bit(toy: Path, tmp_path: Path) -> None:
    out, expected = gen2d.export(toy, "npz", tmp_path / "npz").out, synthetic.stored(toy)
    for number in range(TRAIN):
        with zipfile.ZipFile(out / f"train-{number:09d}.npz") as archive:
            assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        with np.load(out / f"train-{number:09d}.npz") as archive:
            found = dict(archive)
        assert_array_equal(found.pop("time"), np.arange(6) / 10)
        same(found, expected, number)


def samples(folder: Path) -> Iterator[dict[str, bytes]]:
    """The videos as WebDataset finds them: files in a row whose names agree up to the first dot."""
    for path in sorted(folder.glob("*.tar")):
        sample: dict[str, bytes] = {}
        with tarfile.open(path) as tar:
            for member in tar:
                assert (member.mtime, member.uid, member.gid, member.uname) == (0, 0, 0, "")
                key, _, ending = member.name.partition(".")
                if sample and key != sample["__key__"].decode():
                    yield sample
                    sample = {}
                file = tar.extractfile(member)
                assert file is not None
                assert ending not in sample
                sample |= {"__key__": key.encode(), ending: file.read()}
        yield sample


@pytest.mark.parametrize("codec", ["h264", "ffv1", "npz"])
def test_tar_files_have_every_field_bit_by_bit(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codec: str
) -> None:
    monkeypatch.setattr("gen2d.exports.formats.webdataset.TAR_VIDEOS", 4)
    made, expected = gen2d.export(toy, "webdataset", tmp_path / "tars", codec=codec), synthetic.stored(toy)
    out = made.out
    assert bool(made.loss) == (codec == "h264")
    fields = json.loads((out / "export.json").read_text())["fields"]
    assert fields["states/position"]["unit"] == "m"
    assert sorted(path.name for path in out.glob("*.tar")) == [f"train-{number:06d}.tar" for number in range(3)]
    found = list(samples(out))
    assert [sample["__key__"].decode() for sample in found] == [f"train-{number:09d}" for number in range(TRAIN)]
    for number, sample in enumerate(found):
        about = json.loads(sample["json"])
        assert (about["name"], about["split"], about["number"], about["fps"]) == ("toy", "train", number, 10)
        with np.load(io.BytesIO(sample["npz"])) as archive:
            arrays = dict(archive)
        if codec != "npz":
            suffix = {"h264": "mp4", "ffv1": "mkv"}[codec]
            (tmp_path / f"film.{suffix}").write_bytes(sample[suffix])
            frames = decoded(tmp_path / f"film.{suffix}")[0]
            assert noise_ratio(frames, expected["frames"][number]) > 22
            arrays["frames"] = frames if codec == "ffv1" else expected["frames"][number]
        same(arrays, expected, number)
        assert len(sample) == 3 + (codec != "npz")


@pytest.mark.full
def test_exports_are_not_much_larger_than_the_dataset(tmp_path: Path) -> None:
    """Of videos as they are usually made, as discs of hard rims on few pixels are no measure for codecs."""
    made = gen2d.generate(tiny.tiny_config(video={"frames": 32, "height": 64, "width": 64}), 8, tmp_path / "data")
    size = sum(path.stat().st_size for path in (made.out / "shards").iterdir())
    for to in FOLDERS:
        assert gen2d.export(made.out, to, tmp_path / to).bytes <= 1.5 * size, to
    for codec in ("ffv1", "npz"):
        assert gen2d.export(made.out, "webdataset", tmp_path / f"tars-{codec}", codec=codec).bytes <= 1.5 * size, codec


# ---- Selections, threads, codecs


def test_selected_videos_alone_are_exported(toy: Path, tmp_path: Path) -> None:
    """Whichever part of the split they are in; what no video is like is an error."""
    present = synthetic.stored(toy)["objects/present"]
    conditions = "objects/present[1]==true and index > 3 and objects/present[2] != True"
    numbers = np.flatnonzero(present[:, 1] & (np.arange(TRAIN) > 3) & ~present[:, 2]).tolist()
    made = gen2d.export(toy, "npz", tmp_path / "npz", select=conditions)
    assert sorted(path.name for path in made.out.glob("*.npz")) == [f"train-{number:09d}.npz" for number in numbers]
    assert 0 < len(numbers) == made.videos < TRAIN
    for number in numbers:
        with np.load(made.out / f"train-{number:09d}.npz") as archive:
            assert archive["index"] == number
    assert json.loads((made.out / "export.json").read_text())["select"] == conditions
    with pytest.raises(FolderError, match="another export"):
        gen2d.export(toy, "npz", made.out)


@pytest.mark.parametrize(
    ("select", "message"),
    [
        ("index", "must compare values with <=, >=, ==, !=, <, >, as 'factors/balls > 3"),
        ("index > many", "compares a number with 'many', which must be a number or a field"),
        ("index > 99", "no video of the split train is like that"),
        ("inedx > 3", "has no field 'inedx': did you mean 'index'?"),
        ("index[0] > 3", "index has one value per video, and takes no index"),
        ("objects/mass > 3", "objects/mass has 3 values per video: choose one, such as objects/mass[0]"),
        ("objects/mass[3] > 3", "objects/mass has 3 values per video: choose one"),
    ],
)
def test_a_selection_that_means_nothing_is_an_error(toy: Path, tmp_path: Path, select: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        gen2d.export(toy, "npz", tmp_path / "out", select=select)
    assert message in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("to", [to for to in FOLDERS if to != "av1"])
def test_the_number_of_threads_changes_no_byte(toy: Path, tmp_path: Path, to: str) -> None:
    one, many = (tree(gen2d.export(toy, to, tmp_path / f"{jobs}", jobs=jobs).out) for jobs in (1, 5))
    assert one == many


@pytest.mark.parametrize("codec", ["ffv1", "mp4v"])
def test_a_codec_can_be_chosen(toy: Path, tmp_path: Path, codec: str) -> None:
    made = gen2d.export(toy, "webdataset", tmp_path / "out", codec=codec)
    suffix = films.CODECS[codec].suffix.removeprefix(".")
    assert all(suffix in sample for sample in samples(made.out))


def test_fields_and_split_can_be_chosen(toy: Path, tmp_path: Path) -> None:
    out = gen2d.export(toy, "npz", tmp_path / "npz", split="test", fields=("states/*",)).out
    assert sorted(path.name for path in out.glob("*.npz")) == [f"test-{number:09d}.npz" for number in range(3)]
    with np.load(out / "test-000000002.npz") as archive:
        assert set(archive) == {"states/position", "states/angle", "time"}


@pytest.mark.skipif(not TABLES, reason="needs pyarrow")
def test_a_split_of_fewer_frames_than_are_stored_is_declared_as_it_is(tmp_path: Path) -> None:
    config = {"scene": {"name": "toy"}, "fps": 10, "splits": {"train": {}, "test": {"frames": 4}}}
    made = synthetic.make(synthetic.dataset(tmp_path / "toy", train=1, sizes=SIZES, config=config))
    (path,) = gen2d.export(made.root, "parquet", tmp_path / "table", split="test").out.glob("*.parquet")
    about = json.loads(importlib.import_module("pyarrow.parquet").read_schema(path).metadata[b"huggingface"])
    assert about["info"]["features"]["states/position"]["shape"] == [4, 3, 2]
    out = gen2d.export(made.root, "lerobot", tmp_path / "lerobot", split="test").out
    info = json.loads((out / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"]) == (3, 12)


def test_a_part_of_an_export_is_of_its_own_videos(toy: Path, tmp_path: Path) -> None:
    source = source_module.source_of(toy, "train", ["index"])
    part = dataclasses.replace(source, part=range(6, 9))
    assert [int(video["index"]) for video in part.videos()] == [6, 7, 8]
    plugins.load("export", "npz").write(tmp_path, part)
    for number in (6, 7, 8):
        with np.load(tmp_path / f"train-{number:09d}.npz") as archive:
            assert archive["index"] == number
    assert len(list(tmp_path.iterdir())) == 3


# ---- phyworld


def arrays(path: Path) -> dict[str, np.ndarray]:
    """Every dataset of an HDF5 file."""
    found: dict[str, np.ndarray] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, of: found.update({name: of[()]}) if isinstance(of, h5py.Dataset) else None)
    return found


def centre(frame: np.ndarray) -> np.ndarray:
    """The middle (x, y) of all balls' area in a frame, in tenths of its width from its lower left corner."""
    cover = 255.0 - frame[..., 1]  # all balls have as little green
    cover[cover < 40] = 0  # what the codec adds to the background
    height, width = cover.shape
    x, y = np.arange(width) + 0.5, height - np.arange(height) - 0.5
    return np.array([(cover.sum(0) * x).sum(), (cover.sum(1) * y).sum()]) / cover.sum() * 10 / width


@pytest.fixture(scope="module", params=[pytest.param(1, marks=pytest.mark.full), 2])
def balls(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One ball with its frames stored, or two whose frames are yet to be drawn."""
    colors = {1: [230, 20, 20], 2: [[20, 230], 20, 20]}[request.param]
    config = tiny.tiny_config(
        video={"width": 96, "height": 64, "frames": 4},
        scene={"balls": request.param, "radius": [0.7, 0.8], "color": colors},
        look={"background": [255, 255, 255], "wall_width": 0},
        storage={"frames": {1: "video", 2: "none"}[request.param]},
        annotations={"masks": True, "boxes": True, "visibility": True, "flow": True, "tracks": 2, "contacts": 4},
    )
    folder = tmp_path_factory.mktemp("balls") / "balls"
    gen2d.generate(config, 6, folder, device="cpu")
    return folder


def test_phyworld_has_films_positions_and_what_was_drawn(
    balls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gen2d.exports.formats.phyworld.GROUP", 4)
    found = arrays(gen2d.export(balls, "phyworld", tmp_path / "train.hdf5").out)
    names = {"init_streams", "position_streams", "video_streams"}
    assert found.keys() == {f"{name}/{group}" for name in names for group in ("00000", "00001")}
    ds = gen2d.open(balls, fields="*")
    count = int(ds[0]["factors/balls"])
    for number in range(len(ds)):
        group, row, video = f"{number // 4:05d}", number % 4, ds[number]
        position, init = (found[f"{name}_streams/{group}"][row] for name in ("position", "init"))
        assert position.dtype == init.dtype == np.float64
        assert position.shape == ((4, 2) if count == 1 else (4, 2, 2))
        metre = video["camera/scale"][0] * 10 / 96
        radius, speed = video["objects/radius"][:count], np.hypot(*video["states/velocity"][0, :count].T)
        assert_allclose(init, np.concatenate([radius, speed]) * metre, rtol=1e-6)
        moved = np.diff(position.reshape(4, count, 2), axis=0)
        assert_allclose(moved, np.diff(video["states/position"][:, :count], axis=0) * metre, atol=1e-5)
        (tmp_path / "film.mp4").write_bytes(found[f"video_streams/{group}"][row].tobytes())
        frames, rate = decoded(tmp_path / "film.mp4")
        assert (rate, frames.shape) == (20, (4, 64, 96, 3))
        middle = np.average(position.reshape(4, count, 2), axis=1, weights=radius**2)
        assert_allclose([centre(frame) for frame in frames], middle, atol=0.1)


def two_balls(folder: Path, monkeypatch: pytest.MonkeyPatch, **changes: Any) -> Path:
    """Three videos of two balls, a wall and an empty slot; in video 1 some fields are changed."""
    position = np.array([[[3, 2], [1, 0], [9, 9], [0, 0]], [[4, 2.5], [3, 4], [9, 9], [0, 0]]], np.float32)
    values = {
        "frames": np.full((2, 64, 48, 3), 200),
        "states/position": position,
        "states/velocity": position * 0 + np.array([3, 4]),
        "objects/present": np.array([True, True, True, False]),
        "objects/kind": np.array([0, 0, 1, 0]),
        "objects/shape": np.array([0, 0, 1, 0]),
        "objects/radius": np.array([0.5, 0.25, 0, 0]),
        "camera/center": np.full((2, 2), [3, 2]),
        "camera/scale": np.full(2, 12),
        "camera/angle": np.zeros(2),
    }
    fields = {
        name: Field(dtype, axes, "", "")
        for dtype, axes, *names in [
            ("uint8", "n T H W 3", "frames"),
            ("float32", "n T K 2", "states/position", "states/velocity"),
            ("bool", "n K", "objects/present"),
            ("uint8", "n K", "objects/kind", "objects/shape"),
            ("float32", "n K", "objects/radius"),
            ("float32", "n T 2", "camera/center"),
            ("float32", "n T", "camera/scale", "camera/angle"),
        ]
        for name in names
    }
    fields |= {name: synthetic.FIELDS[name] for name in ("index", "time")}
    monkeypatch.setattr(
        synthetic, "video", lambda made, split, n: {**values, "index": np.array(n), **(changes if n == 1 else {})}
    )
    sizes = {"T": 2, "H": 64, "W": 48, "K": 4}
    return synthetic.folder(synthetic.make(synthetic.dataset(folder, 3, fields=fields, sizes=sizes)))


def test_phyworld_s_frame_is_ten_units_wide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = two_balls(tmp_path / "balls", monkeypatch)
    found = arrays(gen2d.export(root, "phyworld", tmp_path / "out.hdf5").out)
    # 48 px are 4 m and 10 units, 64 px above each other are 13.3 units.
    half = np.array([5, 20 / 3])
    expected = [[half, half - 5], [half + np.array([2.5, 1.25]), half + np.array([0, 5])]]
    assert_allclose(found["position_streams/00000"], np.array([expected] * 3), rtol=1e-12)
    assert_allclose(found["init_streams/00000"], [[1.25, 0.625, 12.5, 12.5]] * 3, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"objects/kind": np.zeros(4)}, "something else than a ball moves in it"),
        ({"objects/present": np.ones(4)}, "the number of balls that move in it is 3, but must be 2"),
        ({"objects/present": np.array([1, 0, 1, 0])}, "the number of balls that move in it is 1, but must be 2"),
        ({"camera/angle": np.full(2, 0.1)}, "its camera moves or is turned, but must stand still and upright"),
        ({"camera/center": np.eye(2)}, "its camera moves or is turned, but must stand still and upright"),
    ],
)
def test_phyworld_refuses_what_its_layout_cannot_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, np.ndarray], message: str
) -> None:
    root = two_balls(tmp_path / "balls", monkeypatch, **changes)
    with pytest.raises(ConfigError) as caught:
        gen2d.export(root, "phyworld", tmp_path / "out.hdf5")
    assert str(caught.value) == f"phyworld cannot hold train video 1 of {root}: {message}"
    assert [path.name for path in tmp_path.iterdir()] == ["balls"]


def test_frames_that_are_not_stored_are_drawn(balls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ds = gen2d.open(balls)
    if "frames" in ds.manifest.fields:
        return  # the case of one ball
    monkeypatch.setattr(
        "gen2d.exports.source.BATCH_BYTES", 5 * 4 * 64 * 96 * 3
    )  # four videos at a time: the last are two
    out, expected = gen2d.export(balls, "npz", tmp_path / "npz").out, np.asarray(gen2d.render(ds, range(6)))
    for number in range(6):
        with np.load(out / f"train-{number:09d}.npz") as archive:
            assert_array_equal(archive["frames"], expected[number])


# ---- Whole or not at all


@pytest.mark.parametrize("to", FOLDERS)
def test_equal_datasets_give_equal_bytes(toy: Path, tmp_path: Path, to: str) -> None:
    first, again = (tree(gen2d.export(toy, to, tmp_path / name).out) for name in ("first", "again"))
    assert first == again


KILLED = """
import os, signal, sys
from gen2d.exports import export, source
videos = source.Source.videos
def few(source):
    for number, video in enumerate(videos(source)):
        if number == 7:
            os.kill(os.getpid(), int(sys.argv[4]))
        yield video
source.Source.videos = few
export.export(*sys.argv[1:4])
"""


@pytest.mark.parametrize("number", [9, 15], ids=["killed", "terminated"])
@pytest.mark.parametrize("to", ["npz", "webdataset"])
def test_a_killed_export_leaves_nothing_under_its_name(toy: Path, tmp_path: Path, to: str, number: int) -> None:
    out = tmp_path / "out"
    words = [sys.executable, "-c", KILLED, str(toy), to, str(out), str(number)]
    assert subprocess.run(words, check=False, capture_output=True).returncode
    assert not out.exists()
    gen2d.export(toy, to, out)
    assert list(tmp_path.iterdir()) == [out]


def test_an_export_that_is_stopped_leaves_what_was_there(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = tree(gen2d.export(toy, "npz", tmp_path / "out").out)

    def stopped(source: source_module.Source) -> Iterator[Any]:
        yield source.ds[0]
        raise KeyboardInterrupt

    monkeypatch.setattr(source_module.Source, "videos", stopped)
    with pytest.raises(KeyboardInterrupt):
        gen2d.export(toy, "npz", tmp_path / "out")
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]
    assert tree(tmp_path / "out") == before


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The first places of the parts that are written; with each, its four videos."""
    written: list[int] = []
    write = parts_module.write_part

    def noted(format_: Any, source: source_module.Source, target: Path) -> None:
        if source.places.start == 8 and not written.count(-1):
            written.append(-1)
            raise KeyboardInterrupt
        write(format_, source, target)
        written.append(source.places.start)

    monkeypatch.setattr(export, "write_part", noted)
    for name in ("npz", "webdataset", *TABLES, *ZARR):
        form = dataclasses.replace(plugins.load("export", name), part_videos=lambda source: 4)
        monkeypatch.setattr(sys.modules[f"gen2d.exports.formats.{name}"], "EXPORT", form)
    for name in ("webdataset", *ZARR, *(name for name in TABLES if name != "videofolder")):
        monkeypatch.setattr(f"gen2d.exports.formats.{name}.part_videos", lambda source: 4)
    return written


@pytest.mark.parametrize("to", ["npz", "webdataset", *TABLES, *ZARR])
def test_a_stopped_export_goes_on_where_it_was(toy: Path, tmp_path: Path, parts: list[int], to: str) -> None:
    lines: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        gen2d.export(toy, to, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert parts == [0, 4, -1]
    gen2d.export(toy, to, tmp_path / "out", log=lines.append)
    assert parts == [0, 4, -1, 8]
    assert lines[0] == "8 of 10 videos are written already"
    gen2d.export(toy, to, tmp_path / "whole")
    assert parts == [0, 4, -1, 8, 0, 4, 8]
    assert tree(tmp_path / "out") == tree(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]


def test_parts_of_another_export_are_not_used(toy: Path, tmp_path: Path, parts: list[int]) -> None:
    with pytest.raises(KeyboardInterrupt):
        gen2d.export(toy, "npz", tmp_path / "out")
    out = gen2d.export(toy, "npz", tmp_path / "out", fields="index").out
    assert parts == [0, 4, -1, 0, 4, 8]
    with np.load(out / "train-000000000.npz") as archive:
        assert set(archive) == {"index", "time"}


def test_two_exports_do_not_write_one_folder(toy: Path, tmp_path: Path) -> None:
    with (
        PartialExport(tmp_path / "out", "one"),
        pytest.raises(FolderError, match="is being written by another process"),
    ):
        gen2d.export(toy, "npz", tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_its_own_is_replaced_and_what_others_made_is_not(toy: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()  # an empty folder is as good as none
    gen2d.export(toy, "webdataset", out, codec="npz")
    gen2d.export(toy, "webdataset", out, fields="index")
    with pytest.raises(FolderError, match="another export: choose another out, or overwrite=True"):
        gen2d.export(toy, "mp4", out)
    gen2d.export(toy, "mp4", out, overwrite=True)
    assert not list(out.glob("*.tar"))
    (out / "mine.txt").write_text("keep me")
    for overwrite in (False, True):
        with pytest.raises(FolderError, match=r"holds mine\.txt, which no export made"):
            gen2d.export(toy, "mp4", out, overwrite=overwrite)
    assert (out / "mine.txt").read_text() == "keep me"
    assert list(tmp_path.iterdir()) == [out]


def test_an_export_of_another_dataset_stays(toy: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    other = synthetic.make(synthetic.dataset(tmp_path / "toy", train=TRAIN, sizes=SIZES, seed=8))
    before = tree(gen2d.export(synthetic.folder(other), "npz", out).out)
    with pytest.raises(FolderError, match="holds another export: choose another out, or overwrite=True"):
        gen2d.export(toy, "npz", out)
    with pytest.raises(FolderError, match="holds another export"):
        gen2d.export(synthetic.folder(other), "npz", out, split="test")
    assert tree(out) == before


def test_a_file_is_replaced_only_when_asked(balls: Path, tmp_path: Path) -> None:
    out = tmp_path / "train.hdf5"
    out.write_text("mine")
    with pytest.raises(FolderError, match="is there already: choose another out, or overwrite=True"):
        gen2d.export(balls, "phyworld", out)
    assert out.read_text() == "mine"
    gen2d.export(balls, "phyworld", out, overwrite=True)
    assert h5py.is_hdf5(out)
    with pytest.raises(FolderError, match="is a file, but npz makes a folder"):
        gen2d.export(balls, "npz", out, overwrite=True)


# ---- Bad input


SURFACES = "depth", "normals", "shadow"  # of one look, with which frames are rendered again
TIERED = [pytest.param(name, marks=[pytest.mark.full] * (name in SURFACES)) for name in plugins.names("export")]


@pytest.mark.parametrize("name", TIERED)
def test_every_format_keeps_the_contract(name: str, balls: Path, tmp_path: Path) -> None:
    """It makes the folder or the file that it declares, and tells what is lost."""
    form, look = plugins.load("export", name), RenderOptions(look="studio") if name in SURFACES else None
    done = gen2d.export(balls, name, tmp_path / f"out{form.suffix}", render=look)
    assert done.loss.endswith(form.loss)
    assert form.codecs or done.loss == form.loss
    assert done.out.is_file() == bool(form.suffix)
    assert done.bytes > 0
    assert form.suffix or (done.out / export.DESCRIPTION).is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--to", "mp3"],
            "--to is 'mp3', but must be one of av1, coco, depth, ffv1, flo, h264, kitti_flow, lerobot, mot, mp4, n",
        ),
        ([], "required: --to"),
        (["--to", "npz", "--split", "tran"], "has no split 'tran': did you mean 'train'?"),
        (
            ["--to", "npz", "--fields", "state/position"],
            "has no field 'state/position': did you mean 'states/position'",
        ),
        (["--to", "mot", "--fields", "index"], "--fields is index, but mot has its own: choose av1 or ffv1 or h264"),
        (["--to", "mp4", "--fields", "index"], "--fields is index, but must contain frames for mp4"),
        (["--to", "webdataset", "--codec", "gif"], "--codec is 'gif', but must be one of h264, av1, ffv1, mp4v, npz"),
        (
            ["--to", "mp4", "--codec", "ffv1"],
            "--codec is 'ffv1', but mp4 has one encoding only: choose lerobot or parquet",
        ),
        (["--to", "npz", "--jobs", "0"], "--jobs is 0, but must be from 1 to 256"),
        (["--to", "npz", "--select", "index > 99"], "no video of the split train is like that"),
        (["--to", "npz", "--out", "."], ". is the current folder, or holds it: choose another --out"),
        (["--to", "npz", "--out", ".."], ".. is the current folder, or holds it: choose another --out"),
        (["--to", "npz", "--out", "file/child"], "is a file, not a folder"),
        (["--to", "phyworld"], "has no field 'states/velocity'"),
    ],
)
def test_bad_input_gets_one_line_and_code_2(toy: Path, tmp_path: Path, words: list[str], message: str) -> None:
    (tmp_path / "file").write_text("")
    done = tiny.run_main("export", toy, *words, cwd=tmp_path)
    assert done.returncode == 2, done
    assert message in done.stderr
    assert len(tiny.sentences(done.stderr)) == 1
    assert not done.stdout


def test_a_folder_that_is_no_dataset_is_an_error(tmp_path: Path) -> None:
    done = tiny.run_command("export", tmp_path, "--to", "npz")
    assert (done.returncode, len(tiny.sentences(done.stderr))) == (2, 1)
    assert "is not a gen2d dataset" in done.stderr


def test_the_command_says_what_it_made_and_what_was_lost(toy: Path, tmp_path: Path) -> None:
    done = tiny.run_command("export", toy, "--to", "mp4", "--out", tmp_path / "films")
    assert done.returncode == 0, done.stderr
    assert f"{TRAIN} videos in" in done.stdout
    assert "mp4 is lossy" in done.stdout
    words = "--to", "npz", "--split", "test", "--fields", "index", "states/*"
    exact = tiny.run_main("export", toy, *words, cwd=tmp_path)
    assert "lossy" not in exact.stdout
    assert (toy.parent / "toy-npz" / "test-000000002.npz").is_file()  # beside the dataset


@pytest.mark.parametrize(
    ("to", "changes", "message"),
    [
        ("mp4", {"sizes": SIZES | {"W": 47}}, "video.width is 47, but must be even for mp4"),
        ("h264", {"sizes": SIZES | {"H": 63}}, "video.height is 63, but must be even for h264"),
        ("av1", {"fps": 1000.0}, "video.fps is 1000, but must be from 0.1 to 240 for av1"),
        ("ffv1", {"fps": 2000.0}, "video.fps is 2000, but must be from 0.1 to 1000 for ffv1"),
        ("mp4", {"fps": 0.01}, "video.fps is 0.01, but must be from 0.1 to 65535 for mp4"),
    ],
)
def test_what_a_format_cannot_hold_is_an_error_first(
    tmp_path: Path, to: str, changes: dict[str, Any], message: str
) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path / "toy", train=1, **changes))
    with pytest.raises(ConfigError) as caught:
        gen2d.export(synthetic.folder(made), to, tmp_path / "out")
    assert message in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_missing_extra_is_named(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    for to in ("mp4", "h264", "av1", "ffv1", "webdataset", "videofolder", "lerobot", "parquet"):
        with pytest.raises(UserError, match=r"pip install 'gen2d\[video\]'"):
            gen2d.export(toy, to, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_no_jax_is_imported_where_frames_are_stored(toy: Path, tmp_path: Path) -> None:
    code = (
        "import sys, gen2d\nfor to in sys.argv[2:]: gen2d.export(sys.argv[1], to, to)\nassert 'jax' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code, str(toy), *FOLDERS], check=True, cwd=tmp_path)
