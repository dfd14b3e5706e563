"""Exports of annotations, read back by the readers of their fields: the stored masks, boxes, tracks and flow."""

import configparser
import csv
import dataclasses
import json
import pickle
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import PIL.Image
import pytest
import tiny
from caption_reader import Reader
from numpy.testing import assert_allclose, assert_array_equal
from packages import package

import gen2d
from gen2d.captions.colors import COLORS
from gen2d.captions.questions import Question
from gen2d.config import plugins
from gen2d.core.errors import ConfigError
from gen2d.exports.formats.coco import run_lengths
from gen2d.exports.formats.questions import Balance
from gen2d.exports.source import Source

VIDEOS, FRAMES, HEIGHT, WIDTH = 3, 6, 40, 48  # as many frames as in test_lerobot.py, which simulates the same
CONFIG = tiny.tiny_config(
    video={"frames": FRAMES, "height": HEIGHT, "width": WIDTH},
    scene={"balls": [2, 3], "gravity": [0, -9.8]},
    look={"name": "studio"},
    image={"occluders": 1},
    annotations={"masks": True, "boxes": True, "visibility": True, "flow": True, "tracks": 4, "contacts": 4}
    | {"depth": True, "normals": True, "shadow": True},
)
ANNOTATED = (
    "coco",
    "panoptic",
    "mot",
    "tapvid",
    "flo",
    "kitti_flow",
    "depth",
    "normals",
    "shadow",
    "objects",
    "questions",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "tiny"
    gen2d.generate(CONFIG, VIDEOS, out, seed=2, device="cpu")
    return out


@pytest.fixture(scope="module")
def fields(made: Path) -> dict[str, np.ndarray]:
    return gen2d.open(made, fields="*")[:]


def image(path: Path) -> np.ndarray:
    """RGB, or grey levels, of an image file."""
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    return stored[..., ::-1] if stored.ndim == 3 else stored


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # pycocotools with NumPy 2
def test_pycocotools_reads_masks_boxes_and_keypoints(made: Path, fields: dict, tmp_path: Path) -> None:
    coco_mask = package("pycocotools.mask")
    coco_eval = package("pycocotools.cocoeval")
    out = gen2d.export(made, "coco", tmp_path / "coco").out
    coco = package("pycocotools.coco").COCO(str(out / "annotations.json"))
    assert len(coco.imgs) == VIDEOS * FRAMES
    balls = coco.getCatIds(catNms=["ball"])
    for picture in coco.imgs.values():
        number, frame = picture["video_id"], picture["frame_id"]
        stored = fields["masks/instance"][number, frame]
        assert_array_equal(image(out / picture["file_name"]), fields["frames"][number, frame])
        found = coco.imgToAnns[picture["id"]]
        assert {entry["track_id"] for entry in found} == set(np.unique(stored).tolist()) - {0, 255}
        for entry in found:
            shown = coco.annToMask(entry)
            assert_array_equal(shown, stored == entry["track_id"])
            code = coco_mask.encode(np.asfortranarray(shown))
            assert code["counts"] == entry["segmentation"]["counts"].encode()
            assert entry["area"] == coco_mask.area(code)
            slot = entry["track_id"] - 1
            x0, y0, x1, y1 = fields["boxes/visible"][number, frame, slot].tolist()
            assert entry["bbox"] == [x0, y0, x1 - x0, y1 - y0] == coco_mask.toBbox(code).tolist()
            assert (entry["category_id"] in balls) == (fields["objects/shape"][number, slot] == 0)
            check_keypoints(entry, {name: values[number] for name, values in fields.items()}, frame, shown)
    results = [entry | {"score": 1.0} for entry in coco.dataset["annotations"]]
    for kind in ("bbox", "segm"):
        evaluation = coco_eval.COCOeval(coco, coco.loadRes(results), kind)
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
        assert evaluation.stats[0] == 1  # average precision of the truth


def check_keypoints(entry: dict, video: dict, frame: int, shown: np.ndarray) -> None:
    """The centre is that of the state; x, y of COCO are half a pixel less than gen2d's."""
    x, y, visible = entry["keypoints"][:3]
    slot = entry["track_id"] - 1
    centre, scale = video["camera/center"][frame], video["camera/scale"][frame]
    east, north = (video["states/position"][frame, slot] - centre) * scale
    place = np.array([WIDTH / 2 + east, HEIGHT / 2 - north])
    inside = (place >= 0).all() and (place < [WIDTH, HEIGHT]).all()
    assert bool(visible) == inside
    if inside:
        assert_allclose([x + 0.5, y + 0.5], place, atol=2e-3)
        assert visible == 1 + shown[int(place[1]), int(place[0])]


def test_run_lengths_are_those_of_pycocotools() -> None:
    coco_mask = package("pycocotools.mask")
    rng = np.random.default_rng(0)
    for _ in range(100):
        blocks = rng.random((rng.integers(1, 9), rng.integers(1, 9))) < rng.random()
        shown = np.kron(blocks, np.ones((rng.integers(1, 40), 7), np.uint8)).astype(np.uint8)
        assert run_lengths(shown > 0).encode() == coco_mask.encode(np.asfortranarray(shown))["counts"]


def test_panoptic_segments_cover_every_pixel(made: Path, fields: dict, tmp_path: Path) -> None:
    out = gen2d.export(made, "panoptic", tmp_path / "out").out
    about = json.loads((out / "panoptic.json").read_text())
    names = {category["id"]: category["name"] for category in about["categories"]}
    for number, annotation in enumerate(about["annotations"]):
        color = image(out / "panoptic" / annotation["file_name"]).astype(int)
        segments = color @ [1, 256, 256**2]
        stored = fields["masks/instance"].reshape(-1, HEIGHT, WIDTH)[number].astype(int)
        assert_array_equal(segments, np.where(stored == 0, 256, stored))
        assert {info["id"]: info["area"] for info in annotation["segments_info"]} == dict(
            zip(*(part.tolist() for part in np.unique(segments, return_counts=True)), strict=True)
        )
        assert {names[info["category_id"]] for info in annotation["segments_info"]} <= {
            "ball", "wall", "background", "occluder",
        }  # fmt: skip


def test_mot_files_count_from_one(made: Path, fields: dict, tmp_path: Path) -> None:
    out = gen2d.export(made, "mot", tmp_path / "mot").out
    for number in range(VIDEOS):
        folder = out / f"train-{number:09d}"
        info = configparser.ConfigParser()
        info.read(folder / "seqinfo.ini")
        assert (info.getint("Sequence", "seqLength"), info.getint("Sequence", "imWidth")) == (FRAMES, WIDTH)
        rows = np.loadtxt(folder / "gt" / "gt.txt", delimiter=",")
        moving = fields["objects/present"][number] & (fields["objects/kind"][number] == 0)
        assert len(rows) == FRAMES * moving.sum()  # the box is closed, so nothing leaves the view
        for frame, object_id, *box, considered, _, visible in rows:
            t, slot = int(frame) - 1, int(object_id) - 1
            x0, y0, x1, y1 = fields["boxes/amodal"][number, t, slot]
            assert_allclose(box, [x0 + 1, y0 + 1, x1 - x0, y1 - y0], atol=2e-3)
            assert considered == 1
            assert_allclose(visible, fields["visibility/fraction"][number, t, slot], atol=1e-4)
        assert_array_equal(image(folder / "img1" / "000002.png"), fields["frames"][number, 1])


@pytest.mark.filterwarnings("ignore:Operation with")  # motmetrics with pandas 3
def test_motmetrics_reads_boxes_and_follows_the_objects(made: Path, fields: dict, tmp_path: Path) -> None:
    """MOTChallenge's metrics by motmetrics: the stored boxes, without an error against themselves."""
    motmetrics = package("motmetrics")
    out = gen2d.export(made, "mot", tmp_path / "mot").out
    metrics = ["mota", "idf1", "num_switches", "num_unique_objects", "num_misses"]
    for number in range(VIDEOS):
        path = out / f"train-{number:09d}" / "gt" / "gt.txt"
        truth = motmetrics.io.loadtxt(str(path), fmt=motmetrics.io.Format.MOT16, min_confidence=1)
        boxes = fields["boxes/amodal"][number]
        for (frame, object_id), row in truth.iterrows():
            x0, y0, x1, y1 = boxes[frame - 1, object_id - 1]
            assert_allclose(row[["X", "Y", "Width", "Height"]].to_numpy(float), [x0, y0, x1 - x0, y1 - y0], atol=2e-3)
        moving = int((fields["objects/present"][number] & (fields["objects/kind"][number] == 0)).sum())
        swapped = truth.reset_index()
        second, ids = swapped["FrameId"] > FRAMES // 2, sorted(swapped["Id"].unique())
        swapped.loc[second, "Id"] = swapped["Id"][second].map(dict(zip(ids, ids[1:] + ids[:1], strict=True)))
        for tracked, switches in ((truth, 0), (swapped.set_index(["FrameId", "Id"]), moving)):
            compared = motmetrics.MOTAccumulator()
            for frame in range(1, FRAMES + 1):
                one, other = truth.loc[frame], tracked.loc[frame]
                corners = [part[["X", "Y"]].to_numpy() for part in (one, other)]
                distances = np.abs(corners[0][:, None] - corners[1][None]).max(-1)  # px; its own uses NumPy 1
                compared.update(one.index, other.index, np.where(distances < 1, distances, np.nan), frame)
            found = motmetrics.metrics.create().compute(compared, metrics=metrics).iloc[0]
            assert found["num_unique_objects"] == moving
            assert found["num_switches"] == switches
            assert found["num_misses"] == 0
            assert (found["mota"] == found["idf1"] == 1) == (switches == 0)


def tap_vid_queries(points: np.ndarray, occluded: np.ndarray) -> np.ndarray:
    """TAP-Vid's queries [N, 3] (t, y, x), each at the first frame that shows its point, in units of `points`."""
    first = np.argmax(~occluded, axis=1)
    x, y = points[np.arange(len(points)), first].T
    return np.stack([first, y, x], -1)


def test_a_reader_of_tap_vid_queries_points_where_their_objects_are_seen(
    made: Path, fields: dict, tmp_path: Path
) -> None:
    """By the data set's description (Doersch et al., arXiv 2211.03726): frames of a fixed size, here twice as wide."""
    (path,) = gen2d.export(made, "tapvid", tmp_path / "tap").out.glob("*.pkl")
    for number, video in enumerate(pickle.loads(path.read_bytes()).values()):
        assert (video["video"].dtype, video["points"].dtype, video["occluded"].dtype) == (np.uint8, np.float32, bool)
        wide = np.stack([cv2.resize(frame, (2 * WIDTH, HEIGHT)) for frame in video["video"]])
        points = video["points"] * np.array([wide.shape[2], wide.shape[1]])
        queries = tap_vid_queries(points, video["occluded"])
        assert len(queries)
        t, y, x = np.floor(queries).astype(int).T
        owners = np.repeat(fields["masks/instance"][number], 2, axis=2)[t, y, x]
        seen = fields["tracks/visible"][number].any(0) & (fields["tracks/object"][number] >= 0)
        assert_array_equal(owners, fields["tracks/object"][number][seen] + 1)


def test_tap_vid_has_points_first_normalised_and_occluded(made: Path, fields: dict, tmp_path: Path) -> None:
    (path,) = gen2d.export(made, "tapvid", tmp_path / "tap").out.glob("*.pkl")
    content = pickle.loads(path.read_bytes())
    assert list(content) == [f"train-{number:09d}" for number in range(VIDEOS)]
    for number, video in enumerate(content.values()):
        seen = fields["tracks/visible"][number].any(0) & (fields["tracks/object"][number] >= 0)
        count = int(seen.sum())
        assert video["video"].shape == (FRAMES, HEIGHT, WIDTH, 3)
        assert (video["points"].shape, video["occluded"].shape) == ((count, FRAMES, 2), (count, FRAMES))
        # As its readers do: times width and height, to pixels from corner to corner.
        pixels = video["points"] * np.array([WIDTH, HEIGHT])
        assert_allclose(pixels, fields["tracks/points"][number][:, seen].transpose(1, 0, 2), atol=1e-4)
        assert_array_equal(video["occluded"], ~fields["tracks/visible"][number][:, seen].T)


def test_opencv_reads_flow(made: Path, fields: dict, tmp_path: Path) -> None:
    flo = gen2d.export(made, "flo", tmp_path / "flo").out
    kitti = gen2d.export(made, "kitti_flow", tmp_path / "kitti").out
    assert len(list(flo.glob("*.flo"))) == len(list((kitti / "flow_noc").iterdir())) == VIDEOS * (FRAMES - 1)
    for number in range(VIDEOS):
        for frame in range(FRAMES - 1):
            stored = fields["flow/forward"][number, frame].astype(np.float32)
            assert_array_equal(cv2.readOpticalFlow(str(flo / f"train-{number:09d}-{frame:04d}.flo")), stored)
            coded = image(kitti / "flow_noc" / f"train-{number:09d}_{frame:04d}.png").astype(float)
            valid = coded[..., 2] > 0  # as in KITTI's development kit
            assert_array_equal(valid, fields["flow/forward_valid"][number, frame] > 0)
            assert_allclose(((coded[..., :2] - 2**15) / 64)[valid], stored[valid], atol=1 / 128)


def each_surface(folder: Path, fields: dict, name: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Image of every frame, as Pillow and OpenCV read it, beside the stored field; frames are there, too."""
    for number in range(VIDEOS):
        for frame in range(FRAMES):
            file = f"train-{number:09d}-{frame:04d}.png"
            shown = np.asarray(PIL.Image.open(folder / folder.name / file))
            assert_array_equal(shown, image(folder / folder.name / file))
            assert_array_equal(image(folder / "images" / file), fields["frames"][number, frame])
            yield shown, fields[name][number, frame]
    assert len(list((folder / folder.name).iterdir())) == VIDEOS * FRAMES


def test_depth_is_in_tenths_of_millimetres(made: Path, fields: dict, tmp_path: Path) -> None:
    out = gen2d.export(made, "depth", tmp_path / "depth").out
    for shown, height in each_surface(out, fields, "surface/height"):
        assert shown.dtype == np.uint16
        assert_allclose(shown / 1e4, height.astype(float), atol=0.5001e-4)
        assert shown.max() > 1e3  # a ball is higher than .1 m


def test_surfaces_too_high_for_depth_are_refused(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules["gen2d.exports.formats.depth"]
    monkeypatch.setattr(module, "LARGEST", 1000)
    with pytest.raises(ConfigError, match=r"m high, but depth holds at most 0\.1 m: choose npz"):
        gen2d.export(made, "depth", tmp_path / "depth")


def test_normals_are_red_to_the_right_and_green_up(made: Path, fields: dict, tmp_path: Path) -> None:
    """Unit vectors; on the side of a ball that is right of its centre, red exceeds 128, and above it, green does."""
    out = gen2d.export(made, "normals", tmp_path / "normals").out
    for shown, normal in each_surface(out, fields, "surface/normal"):
        found = shown / 255 * 2 - 1
        assert_allclose(found, normal / 127, atol=1.001 / 255)
        assert_allclose(np.linalg.norm(found, axis=-1), 1, atol=0.02)
        assert (shown != [128, 128, 255]).any()
    video, scale = {name: values[0] for name, values in fields.items()}, fields["camera/scale"][0, 0]
    ball = int(np.flatnonzero(video["objects/present"] & (video["objects/shape"] == 0))[0])
    rows, columns = np.nonzero(video["masks/instance"][0] == ball + 1)
    east, north = (video["states/position"][0, ball] - video["camera/center"][0]) * scale
    first = image(out / "normals" / "train-000000000-0000.png")[rows, columns].astype(float)
    right, above = columns + 0.5 - (WIDTH / 2 + east), HEIGHT / 2 - north - (rows + 0.5)
    assert (first[right > 1, 0] >= 128).all()
    assert (first[right < -1, 0] <= 128).all()
    assert (first[above > 1, 1] >= 128).all()
    assert (first[above < -1, 1] <= 128).all()
    assert np.ptp(first[:, 0]) > 50
    assert np.ptp(first[:, 1]) > 50


def test_shadows_are_grey_levels(made: Path, fields: dict, tmp_path: Path) -> None:
    out = gen2d.export(made, "shadow", tmp_path / "shadow").out
    for shown, shadow in each_surface(out, fields, "surface/shadow"):
        assert shown.dtype == np.uint8
        assert_array_equal(shown, shadow)
        assert shown.max() > 0


def test_the_table_of_objects_has_their_classes(made: Path, fields: dict, tmp_path: Path) -> None:
    out = gen2d.export(made, "objects", tmp_path / "objects.csv").out
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == fields["objects/present"].sum()
    for row in rows:
        number, slot = int(row["video"][-9:]), int(row["slot"])
        assert row["class"] == ("ball" if fields["objects/shape"][number, slot] == 0 else "wall")
        assert float(row["mass"]) == pytest.approx(fields["objects/mass"][number, slot], rel=1e-4)


def test_questions_are_balanced_over_their_answers(made: Path, fields: dict, tmp_path: Path) -> None:
    out = gen2d.export(made, "questions", tmp_path / "questions.jsonl").out
    asked = [json.loads(line) for line in out.read_text().splitlines()]
    assert asked
    for template in {question["template"] for question in asked}:
        answers = Counter(question["answer"] for question in asked if question["template"] == template)
        if set(answers) <= {"yes", "no"}:
            assert abs(answers["yes"] - answers["no"]) <= 1
    for question in asked:
        assert question["video"] == f"train-{question['number']:09d}"


@pytest.mark.full
def test_questions_of_a_shorter_split_end_with_it(tmp_path: Path) -> None:
    """A split that is read up to frame 12: nothing that is asked or answered happens later."""
    config = tiny.tiny_config(
        video={"frames": 24, "height": 64, "width": 64},
        annotations={"contacts": 8},
        splits={"train": {}, "short": {"videos": 12, "frames": 12, "overlaps": True}},
    )
    gen2d.generate(config, 4, tmp_path / "data", seed=3, device="cpu")
    out = gen2d.export(tmp_path / "data", "questions", tmp_path / "out.jsonl", split="short").out
    asked = [json.loads(line) for line in out.read_text().splitlines()]
    fields, size = gen2d.open(tmp_path / "data", "short", fields="*")[:], SimpleNamespace(fps=20, height=64, width=64)
    assert (fields["contacts/frame"] > 12).any()
    assert len(asked) >= 12
    for question in asked:
        video = {name: values[question["number"]] for name, values in fields.items()}
        video["contacts/kind"] = np.where(video["contacts/frame"] < 12, video["contacts/kind"], 0)
        reader = Reader(video, size, COLORS)
        answer = reader.answer(question["question"])
        assert question["answer"] == answer or f"object {reader.resolve(question['answer'])[0]}" == answer


def test_an_answer_is_not_much_more_frequent_than_the_others() -> None:
    balance, rng = Balance(), np.random.default_rng(0)
    offered = rng.choice(["1", "2", "3", "4"], 4000, p=[0.85, 0.1, 0.03, 0.02]).tolist()
    taken = Counter(a for a in offered if balance.takes(Question("descriptive", "count", "", a, ())))
    assert taken["1"] <= 2 * taken.total() / 4 + 2
    assert taken["4"] == offered.count("4")
    coins = rng.choice(["yes", "no"], 1000, p=[0.9, 0.1]).tolist()
    taken = Counter(a for a in coins if balance.takes(Question("predictive", "predict", "", a, ())))
    assert abs(taken["yes"] - taken["no"]) <= 1
    assert taken["no"] >= 0.9 * coins.count("no")


@pytest.mark.full
def test_matched_sets_answer_what_would_be(tmp_path: Path) -> None:
    """Without an object, or with a heavier one, other pairs hit each other: as the member's contacts say."""
    config = tiny.tiny_config(
        video={"frames": 24, "height": 64, "width": 64},
        annotations={"contacts": 8},
        scene={"balls": 4, "density": [1, 8]},
        matched={"change": ["remove", "density"], "members": 3},
    )
    gen2d.generate(config, 24, tmp_path / "sets", device="cpu")
    out = gen2d.export(tmp_path / "sets", "questions", tmp_path / "questions.jsonl").out
    asked = [json.loads(line) for line in out.read_text().splitlines()]
    about = [question for question in asked if question["type"] == "counterfactual"]
    answers = Counter(question["answer"] for question in about)
    assert len(answers) == 2
    assert abs(answers["yes"] - answers["no"]) <= 1
    fields, size = gen2d.open(tmp_path / "sets", fields="*")[:], SimpleNamespace(fps=20, height=64, width=64)
    readers = [Reader({n: v[i] for n, v in fields.items()}, size, COLORS) for i in range(24)]
    for question in about:
        original, member = readers[question["number"]], int(question["member_video"][-9:])
        assert question["number"] == member - fields["matched/member"][member]
        change, _, rest = question["question"].removesuffix("?").partition(", would ")
        words = re.fullmatch(r"(?:Without|If) (the .*?)(?: were (heavier|lighter))?", change)
        pair = re.fullmatch(r"(the .*?) (?:and (the .*) hit each other|hit (the .*))", rest)
        assert words
        assert pair
        changed, *two = (original.one(name) for name in (words[1], pair[1], pair[2] or pair[3]))
        assert changed == fields["matched/object"][member]
        assert fields["objects/present"][member, changed] == bool(words[2])
        if words[2]:
            mass = fields["objects/mass"][[question["number"], member], changed]
            assert (mass[1] > mass[0]) == (words[2] == "heavier")
        hit = any({a, b} == set(two) for _, a, b, *_ in readers[member].hits)
        assert question["answer"] == ("yes" if hit else "no")


@pytest.mark.parametrize("to", ANNOTATED)
def test_equal_datasets_give_equal_files(made: Path, tmp_path: Path, to: str) -> None:
    first, again = (gen2d.export(made, to, tmp_path / name).out for name in ("first", "again"))
    if first.is_file():
        assert first.read_bytes() == again.read_bytes()
        return
    trees = [
        {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()}
        for out in (first, again)
    ]
    assert trees[0] == trees[1]
    assert not [path for path in trees[0] if path.name.startswith(".")]
    about = json.loads((first / "export.json").read_text())["files"]
    assert {path.as_posix() for path in trees[0]} == {*about, "export.json"}
    gen2d.export(made, to, first)  # its own folder is replaced


@pytest.mark.parametrize("to", [name for name in ANNOTATED if plugins.load("export", name).separate])
def test_a_stopped_export_of_annotations_goes_on_where_it_was(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to: str
) -> None:
    """In parts of a video each: those before the stop are not written again, and all ids are those of one run."""
    whole = gen2d.export(made, to, tmp_path / "whole").out
    module, written = sys.modules[f"gen2d.exports.formats.{to}"], list[int]()

    def noted(target: Path, source: Source) -> None:
        if len(written) == 2:
            written.append(-1)
            raise KeyboardInterrupt
        written.append(source.places.start)
        form.write(target, source)

    form = plugins.load("export", to)
    monkeypatch.setattr(module, "part_videos", lambda source: 1, raising=False)
    monkeypatch.setattr(module, "EXPORT", dataclasses.replace(form, write=noted, part_videos=lambda source: 1))
    with pytest.raises(KeyboardInterrupt):
        gen2d.export(made, to, tmp_path / "out")
    out = gen2d.export(made, to, tmp_path / "out").out
    assert written == [0, 1, -1, 2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]
    if to == "tapvid":  # a pickle for each part
        contents = [pickle.loads(path.read_bytes()) for path in sorted(out.glob("*.pkl"))]
        assert [[*content] for content in contents] == [[f"train-{number:09d}"] for number in range(VIDEOS)]
        return
    trees = [
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (out, whole)
    ]
    assert trees[0] == trees[1]
    if to == "coco":  # what parts leave for the end is there
        content = json.loads((whole / "annotations.json").read_text())
        assert content["annotations"]
        assert {one["image_id"] for one in content["annotations"]} <= {image["id"] for image in content["images"]}


@pytest.mark.full
def test_annotations_that_are_not_stored_are_drawn(made: Path, tmp_path: Path) -> None:
    """Of a dataset with frames and without masks: the same files as where the masks are stored."""
    plain = {**CONFIG, "annotations": {"contacts": 4}}
    gen2d.generate(plain, VIDEOS, tmp_path / "tiny", seed=2, device="cpu")
    for to in ("panoptic", "depth", "shadow"):
        trees = []
        for root, out in ((made, tmp_path / f"stored-{to}"), (tmp_path / "tiny", tmp_path / f"drawn-{to}")):
            files = gen2d.export(root, to, out).out.rglob("*.png")
            trees.append({path.relative_to(out): path.read_bytes() for path in files})
        assert trees[0] == trees[1]
    with pytest.raises(ConfigError, match=r"annotations.depth is on, but look is flat"):
        gen2d.export(tmp_path / "tiny", "depth", tmp_path / "flat", render={"look": "flat"})
