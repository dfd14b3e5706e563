"""Text is stored whole and read by everything; words tell what the contacts and states hold, once each, in order."""

import io
import itertools
import json
import tarfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import synthetic
import tiny
from caption_reader import Reader
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from packages import package

import gen2d
from gen2d.captions import caption, colors, questions
from gen2d.captions import events as events_module
from gen2d.captions.actions import actions_of
from gen2d.captions.facts import VideoFacts
from gen2d.captions.sentences import grammar_of
from gen2d.config.config import load_config
from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field

TEXT = {
    "text/name": Field("S24", "n", "UTF-8", "of the video"),
    "text/list": Field("S16", "n", "JSON", "of numbers"),
}


# ---- Text in files


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = synthetic.dataset(tmp_path_factory.mktemp("data") / "toy", train=20, fields=synthetic.FIELDS | TEXT)
    with pytest.MonkeyPatch.context() as patch:
        plain = synthetic.video
        patch.setattr(synthetic, "video", lambda *of: plain(*of) | said(of[2]))
        return synthetic.folder(synthetic.make(made))


def said(number: int) -> dict[str, np.ndarray]:
    """The text of a video, some of it empty or as long as it may be."""
    names = ["", "caf\u00e9", "x" * 24, f"video {number}"]
    return {
        "text/name": np.array(names[number % 4].encode(), "S24"),
        "text/list": np.array(json.dumps(list(range(number % 4))).encode(), "S16"),
    }


def expected(name: str, count: int = 20) -> np.ndarray:
    return np.array([said(number)[name] for number in range(count)])


def test_text_is_what_was_written_for_the_loader_and_for_plain_h5py(toy: Path) -> None:
    ds = gen2d.open(toy, "train", "text/*")
    assert ds.fields == TEXT
    for name in TEXT:
        assert_array_equal(ds[:][name], expected(name))
        assert ds[2][name] == expected(name)[2]
    with h5py.File(toy / "shards" / "train-00000.h5") as file:
        field = file["text/name"]
        assert isinstance(field, h5py.Dataset)
        assert np.asarray(field.asstr()[:]).tolist() == [text.decode() for text in expected("text/name", 8).tolist()]
        assert field.attrs["unit"] == "UTF-8"


def test_a_damaged_letter_is_found(toy: Path, tmp_path: Path) -> None:
    assert gen2d.verify(toy, "full") == []
    made = synthetic.dataset(tmp_path, train=3, fields=synthetic.FIELDS | TEXT)
    path = synthetic.folder(synthetic.make(made)) / "shards" / "train-00000-n3.h5"
    with h5py.File(path, "r+") as file:
        file["text/name"][1] = b"another"  # pyright: ignore[reportIndexIssue]
    assert any("text/name of train video 1" in sentence for sentence in gen2d.verify(tmp_path, "full"))


@pytest.mark.parametrize("to", ["numpy", "torch", "jax"])
def test_text_stays_bytes_in_batches_of_any_kind(toy: Path, to: Any) -> None:
    if to == "torch":
        package("torch")
    ds = gen2d.open(toy, "train", ["text/name", "states/angle"])
    for number, batch in enumerate(gen2d.DataLoader(ds, 5, shuffle=False, epochs=1, to=to)):
        assert_array_equal(batch["text/name"], expected("text/name")[5 * number : 5 * number + 5])
        assert isinstance(batch["text/name"], np.ndarray)
        assert to in str(type(batch["states/angle"])) or (to == "jax" and hasattr(batch["states/angle"], "devices"))


def test_torchs_own_loader_lists_it(toy: Path) -> None:
    torch = package("torch")
    batch = next(iter(torch.utils.data.DataLoader(gen2d.open(toy, "train", ["text/name", "index"]), batch_size=6)))
    assert batch["text/name"] == expected("text/name", 6).tolist()


def test_exports_hold_text_as_other_programs_read_it(toy: Path, tmp_path: Path) -> None:
    archives = gen2d.export(toy, "npz", tmp_path / "npz", split="train").out
    tars = gen2d.export(toy, "webdataset", tmp_path / "tars", split="train").out
    with tarfile.open(next(tars.glob("*.tar"))) as tar:
        files = {member.name: tar.extractfile(member) for member in tar}
        content = {name: file.read() for name, file in files.items() if file}
    for number in range(20):
        text, key = said(number), f"train-{number:09d}"
        with np.load(archives / f"{key}.npz") as archive:
            assert archive["text/name"] == text["text/name"]
        assert content[f"{key}.text.name.txt"] == text["text/name"].item()
        assert json.loads(content[f"{key}.text.list.json"]) == list(range(number % 4))
        with np.load(io.BytesIO(content[f"{key}.npz"])) as archive:
            assert archive["states/angle"].dtype == np.float32


def test_cards_say_that_it_is_text(toy: Path) -> None:
    about = json.loads((toy / "croissant.json").read_text())["variableMeasured"]
    assert {entry["name"] for entry in about if entry.get("valueReference") == "sc:Text"} == TEXT.keys()


# ---- Events


VIDEO = SimpleNamespace(frames=32, fps=20.0, height=60, width=80)
BALLS, ROWS = 3, 60


def seen(seed: int, **changes: Any) -> dict[str, np.ndarray]:
    """The fields of a video in which anything happens: three balls and a box of 8 x 6 m, which is seen."""
    rng = np.random.default_rng(seed)
    frames = VIDEO.frames
    wall = {"a": [[0, 0], [8, 0], [8, 6], [0, 6]], "b": [[8, 0], [8, 6], [0, 6], [0, 0]]}
    a, b = (np.array(wall[end], float) for end in "ab")
    slots = np.arange(BALLS + 4)
    ball = slots < BALLS
    place = np.cumsum(rng.normal(0, 0.7, (frames, BALLS, 2)), 0) + rng.uniform(1, 5, (BALLS, 2))
    made = {
        "objects/present": np.ones(len(slots), bool),
        "objects/kind": np.where(ball, 0, 1).astype(np.uint8),
        "objects/shape": np.where(ball, 0, 1).astype(np.uint8),
        "objects/radius": np.where(ball, 0.5, 0).astype(np.float32),
        "objects/half_length": np.append(np.zeros(BALLS), np.hypot(*(b - a).T) / 2).astype(np.float32),
        "objects/color": np.where(ball[:, None], rng.integers(0, 256, (len(slots), 3)), 128).astype(np.uint8),
        "world/gravity": np.array([0, -9.8]),
        "states/position": np.concatenate([place, np.broadcast_to((a + b) / 2, (frames, 4, 2))], 1),
        "states/angle": np.append(np.zeros(BALLS), np.arctan2(*(b - a).T[::-1])) * np.ones((frames, 1)),
        "states/velocity": np.where(ball[:, None], rng.normal(0, 2, (frames, len(slots), 2)), 0),
        "states/angular_velocity": np.zeros((frames, len(slots))),
        "camera/center": np.full((frames, 2), [4.0, 3.0]),
        "camera/scale": np.full(frames, 10.0),
        "camera/angle": np.zeros(frames),
        **touches(rng),
    }
    return {**{name: v.astype(np.float32) if v.dtype == float else v for name, v in made.items()}, **changes}


def touches(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Rows of contacts, at most one for a pair and frame, in time's order."""
    pairs = [(a, b) for a, b in itertools.combinations(range(BALLS + 4), 2) if a < BALLS]
    frames = np.flatnonzero(rng.random((VIDEO.frames - 1) * len(pairs)) < 0.1)[:ROWS]
    count = len(frames)
    frame, pair = frames // len(pairs) + 1, np.array(pairs)[frames % len(pairs)]
    time = (frame - rng.random(count)) / VIDEO.fps
    order = np.argsort(time)

    def rows(values: Any, dtype: Any) -> np.ndarray:
        values = np.asarray(values, dtype)[order]
        return np.concatenate([values, np.zeros((ROWS - count, *values.shape[1:]), dtype)])

    return {
        "contacts/time": rows(time, np.float64),
        "contacts/frame": rows(frame, np.int32),
        "contacts/a": rows(pair[:, 0], np.int16),
        "contacts/b": rows(pair[:, 1], np.int16),
        "contacts/point": rows(rng.uniform(0, 6, (count, 2)), np.float32),
        "contacts/normal": rows(np.tile([0.0, 1.0], (count, 1)), np.float32),
        "contacts/approach_speed": rows(rng.exponential(2, count), np.float32),
        "contacts/separation_speed": rows(rng.exponential(1, count), np.float32),
        "contacts/kind": rows(rng.integers(1, 5, count), np.uint8),
        "contacts/count": np.array(count, np.int32),
    }


def rows_of(made: dict[str, np.ndarray]) -> list[tuple[int, ...]]:
    """Kind, frame, slots and time of each row of contacts."""
    names = ("kind", "frame", "a", "b", "time")
    return [row for row in zip(*(made[f"contacts/{n}"].tolist() for n in names), strict=True) if row[0]]


@pytest.mark.parametrize("seed", range(20))
def test_every_impact_is_an_event_once_unless_the_pair_was_in_touch(seed: int) -> None:
    made = seen(seed)
    stated = [(e.frame, e.about["a"], e.about["b"]) for e in events_module.video_events(made, VIDEO) if e.kind == "hit"]
    rows, impacts = rows_of(made), []
    for kind, frame, a, b, time in rows:
        before = [r for r in rows if r[1:4] == (frame - 1, a, b)]
        held = before and (before[0][0] in (2, 3) or (before[0][0] == 1 and time - before[0][4] < 0.1))
        if kind == 1 and not held:
            impacts.append((frame, a, b))
    assert len(stated) == len(set(stated))
    assert sorted(stated) == sorted(impacts)


@pytest.mark.parametrize(("seconds", "hits"), [(0.09, 1), (0.11, 2)])
def test_impacts_of_a_pair_in_successive_frames_are_two_hits_if_they_are_a_tenth_of_a_second_apart(
    seconds: float, hits: int
) -> None:
    made = still()
    for row, time in enumerate((0.5, 0.5 + seconds)):
        for name, value in (("kind", 1), ("frame", 4 + row), ("a", 0), ("b", 3), ("time", time)):
            made[f"contacts/{name}"][row] = value
    assert len(events_module.hit_events(made)) == hits


@pytest.mark.parametrize("seed", range(20))
def test_events_are_in_times_order_and_each_lies_in_the_interval_before_its_frame(seed: int) -> None:
    events = json.loads(events_module.events_json(events_module.video_events(seen(seed), VIDEO), 10**6))
    times, frames = (np.array([event[name] for event in events]) for name in ("time", "frame"))
    assert (np.diff(times) >= 0).all()
    assert (times <= frames / VIDEO.fps + 1e-5).all()
    assert (times >= (frames - 1) / VIDEO.fps - 1e-5).all()
    made = seen(seed)
    places = [row[:4] for row in rows_of(made)]
    for event in (event for event in events if event["event"] == "hit"):
        row = places.index((1, event["frame"], event["a"], event["b"]))
        for name, column in (("time", "time"), ("point", "point"), ("speed", "approach_speed")):
            assert_allclose(event[name], made[f"contacts/{column}"][row], rtol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_a_ball_leaves_when_its_rim_crosses_the_edge_and_comes_back_when_it_does_again(angle: float) -> None:
    time = np.arange(VIDEO.frames) / VIDEO.fps
    made = seen(0, **{"objects/present": np.arange(BALLS + 4) == 0, "contacts/kind": np.zeros(ROWS, np.uint8)})
    to_right, up = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    way = np.where(time < 0.8, 3 + 6 * time, 7.8 - 6 * (time - 0.8))  # along the picture's columns, from its middle, m
    made["camera/angle"] = np.full(VIDEO.frames, angle, np.float32)
    for direction, side in ((to_right, "right"), (-to_right, "left")):
        made["states/position"][:, 0] = np.array([4, 3]) + way[:, None] * direction
        left, entered = events_module.view_events(made, VIDEO)
        assert (left.kind, entered.kind) == ("leaves", "enters")
        assert left.about == entered.about == {"a": 0, "side": side}
        assert_allclose([left.time, entered.time], [0.25, 0.8 + 3.3 / 6], atol=1e-5)
    made["states/position"][:, 0] = np.array([4, 3]) + (way[:, None] - 1) * up
    assert [event.about["side"] for event in events_module.view_events(made, VIDEO)] == ["top", "top"]


def test_rest_is_an_event_where_all_is_still_to_the_end() -> None:
    made = seen(0)
    made["states/velocity"][11:] = 0
    assert [(event.frame, event.time) for event in events_module.rest_events(made, VIDEO.fps)] == [(11, 0.55)]
    made["states/velocity"][-1, 1] = 1
    assert events_module.rest_events(made, VIDEO.fps) == []
    made["states/velocity"][:] = 0  # it never moved
    assert events_module.rest_events(made, VIDEO.fps) == []
    made["states/angular_velocity"][:5, 2] = 3
    assert [event.frame for event in events_module.rest_events(made, VIDEO.fps)] == [5]


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 1000), width=st.integers(2, 3000))
def test_events_that_do_not_fit_are_left_out_whole(seed: int, width: int) -> None:
    events = events_module.video_events(seen(seed), VIDEO)
    text = events_module.events_json(events, width)
    assert len(text) <= width
    found = json.loads(text)
    assert found == json.loads(events_module.events_json(events, 10**6))[: len(found)]
    assert len(found) == len(events) or len(text) + 1 + len(events[len(found)].text) > width


# ---- Captions


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_texts_fit_are_ascii_and_follow_from_the_video_alone(seed: int) -> None:
    made, other = seen(seed), seen(seed + 1)
    both = {name: np.stack([other[name], made[name]]) for name in made}
    alone = {name: made[name][None] for name in made}
    one, two = caption.caption_fields(alone, VIDEO), caption.caption_fields(both, VIDEO)
    for name, field in caption.fields(BALLS + 4, VIDEO.frames).items():
        assert one[name].dtype == two[name].dtype == np.dtype(field.dtype)
        assert one[name][0] == two[name][1]
    assert one["text/events"].dtype.itemsize == 2 + 128 * (BALLS + 4) * (VIDEO.frames // 16)
    for name in ("text/caption", "text/short_caption"):
        text = one[name][0].decode("ascii")
        assert 0 < len(text) < one[name].dtype.itemsize
        assert text[0].isupper()
        assert text.endswith(".")
    assert "in a box under gravity." in one["text/caption"][0].decode()
    assert one["text/event_count"][0] == len(events_module.video_events(made, VIDEO))
    json.loads(one["text/questions"][0])


def still(**changes: Any) -> dict[str, np.ndarray]:
    """A video in which nothing happens: a red, a blue and a green ball."""
    made = seen(1, **changes)
    made["states/position"][:, :BALLS] = [[2, 2], [4, 4], [6, 2]]
    made["states/velocity"][:] = 0
    made["objects/color"][:BALLS] = [[214, 32, 38], [38, 84, 220], [44, 158, 58]]
    made["world/gravity"] = changes.get("world/gravity", np.zeros(2))
    return made | {"contacts/kind": np.zeros(ROWS, np.uint8), "contacts/count": np.array(0, np.int32)}


def long(made: dict[str, np.ndarray]) -> str:
    return caption.story_of(made, VIDEO).long(512)


def touch(made: dict[str, np.ndarray], *rows: dict[str, Any]) -> None:
    """Write rows of contacts."""
    for number, row in enumerate(rows):
        for name, value in row.items():
            made[f"contacts/{name}"][number] = value
    made["contacts/count"] = np.array(len(rows), np.int32)


def test_a_video_without_events() -> None:
    made = still()
    found = caption.caption_fields({name: values[None] for name, values in made.items()}, VIDEO)
    assert found["text/events"].tolist() == [b"[]"]
    assert found["text/event_count"].tolist() == [0]
    opening = found["text/caption"][0].decode().removeprefix("There are ")
    assert opening.lower() == "a red ball, a blue ball and a green ball in a box."
    assert found["text/short_caption"] == found["text/caption"]


def test_colors_of_the_list_have_their_own_words_and_none_is_near_another() -> None:
    for word, color in colors.COLORS.items():
        assert colors.nearest_word(np.array(color, np.uint8)) == word
    lab = colors.cielab(np.array(list(colors.COLORS.values())))
    apart = np.linalg.norm(lab[:, None] - lab, axis=-1) + 100 * np.eye(len(lab))
    assert apart.min() > 8


def test_cielab_is_that_of_the_standard() -> None:
    """Values of the primaries and of a grey, by CIE 15 with the matrix of IEC 61966-2-1."""
    expected = {
        (255, 255, 255): (100, 0, 0), (0, 0, 0): (0, 0, 0), (255, 0, 0): (53.24, 80.09, 67.20),
        (0, 255, 0): (87.73, -86.18, 83.18), (0, 0, 255): (32.30, 79.19, -107.86), (119, 119, 119): (50.03, 0, 0),
    }  # fmt: skip
    for color, values in expected.items():
        assert_allclose(colors.cielab(np.array(color)), values, atol=0.02)


def test_a_color_that_no_word_is_near_has_none() -> None:
    assert colors.nearest_word(np.array([150, 80, 80])) != ""
    random = np.random.default_rng(0).integers(0, 256, (3000, 3))
    words = [colors.nearest_word(color) for color in random]
    assert 0.1 < np.mean([not word for word in words]) < 0.3
    for color, word in zip(random, words, strict=True):
        away = np.linalg.norm(colors.cielab(np.array(list(colors.COLORS.values()))) - colors.cielab(color), axis=-1)
        assert not word or list(colors.COLORS)[int(away.argmin())] == word
        assert not word or away.min() <= 10 + 0.11 * 140  # the chroma of the strongest colour of a display


def test_a_stored_name_of_a_color_is_used() -> None:
    made = still() | {"objects/color_name": np.array([b"terracotta", b"", b"teal", b"", b"", b"", b""])}
    story = caption.story_of(made, VIDEO)
    assert [story.references.all[slot].text for slot in range(BALLS)] == [
        "the terracotta ball", "the blue ball", "the teal ball",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({}, ["the red ball", "the blue ball", "the green ball"]),
        ({"color": [[214, 32, 38], [38, 84, 220], [214, 32, 38]]},
         ["the ball on the left", "the blue ball", "the ball on the right"]),
        ({"color": [[214, 32, 38]] * 3}, ["the ball on the left", "the ball at the top", "the ball on the right"]),
        ({"color": [[214, 32, 38]] * 3, "radius": [0.3, 0.3, 0.6]},
         ["the ball on the left", "the ball at the top", "the large ball"]),
        ({"color": [[214, 32, 38]] * 3, "place": [[4, 3], [4, 3], [4, 3.05]]}, ["one of three red balls"] * 3),
        ({"color": [[214, 32, 38], [216, 30, 40], [222, 40, 44]], "place": [[3, 3], [4, 3], [5, 3]]},
         ["the leftmost ball", "the second ball from the left", "the rightmost ball"]),
    ],
    ids=["colour", "place", "places", "size", "nothing", "alike"],
)  # fmt: skip
def test_objects_are_told_apart_by_the_shortest_phrase_that_fits_one(changes: dict, names: list[str]) -> None:
    made = still()
    made["objects/color"][:BALLS] = changes.get("color", made["objects/color"][:BALLS])
    made["objects/radius"][:BALLS] = changes.get("radius", 0.5)
    made["states/position"][:, :BALLS] = changes.get("place", [[1, 2], [4, 4], [7, 2]])
    story = caption.story_of(made, VIDEO)
    assert [story.references.all[slot].text for slot in range(BALLS)] == names
    assert [story.references.all[slot].unique for slot in range(BALLS)] == ["one of" not in name for name in names]


def test_materials_tell_apart_what_has_one_colour_and_follow_it() -> None:
    made = still() | {"objects/material_name": np.array([b"rubber", b"metal", b"rubber", *[b"wood"] * 4])}
    made["objects/color"][:BALLS] = [[214, 32, 38], [214, 32, 38], [38, 84, 220]]
    story = caption.story_of(made, VIDEO)
    assert [story.references.all[slot].text for slot in range(BALLS)] == [
        "the red rubber ball", "the metal ball", "the blue ball",
    ]  # fmt: skip
    assert long(made).startswith(
        ("A red rubber ball, a red metal ball", "There are a red rubber ball, a red metal ball")
    )


def test_colors_that_look_alike_do_not_tell_apart_although_their_words_differ() -> None:
    made = still()
    coral, salmon = (np.array(colors.COLORS[word], float) for word in ("coral", "salmon"))
    between = [np.round(coral + share * (salmon - coral)).astype(np.uint8) for share in np.linspace(0, 1, 100)]
    at = next(i for i in range(99) if colors.nearest_word(between[i]) != colors.nearest_word(between[i + 1]))
    made["objects/color"][:2] = between[at], between[at + 1]
    made["states/position"][:, :2] = [[3, 3], [5, 3]]
    story = caption.story_of(made, VIDEO)
    assert [story.references.colors[slot] for slot in range(2)] == ["coral", "salmon"]
    assert [story.references.all[slot].text for slot in range(2)] == [
        "the leftmost ball",
        "the second ball from the left",
    ]


def test_places_are_those_of_the_picture() -> None:
    """The camera turned by half a turn: left is right."""
    made = still(**{"camera/angle": np.full(VIDEO.frames, np.pi, np.float32)})
    made["objects/color"][:BALLS] = 200
    made["states/position"][:, :BALLS] = [[1, 2], [4, 4], [7, 2]]
    story = caption.story_of(made, VIDEO)
    assert [story.references.all[slot].text for slot in range(BALLS)] == [
        "the ball on the right", "the lowest ball", "the ball on the left",
    ]  # fmt: skip


@pytest.mark.parametrize("frame", [1, 2, 9])
def test_the_one_that_was_faster_a_frame_before_the_hit_hits_the_other(frame: int) -> None:
    made = still()
    speeds = np.where(np.arange(VIDEO.frames) == frame - 1, 3, 1)
    made["states/velocity"][:, :2] = 2
    made["states/velocity"][:, 1] *= speeds[:, None] / 2  # blue: 3 to red's 2 in that frame, 1 in all others
    touch(made, {"kind": 1, "frame": frame, "a": 0, "b": 1, "time": 0.1})
    (hit,) = (action for action in actions_of(VideoFacts(made, VIDEO)) if action.kind == "hits")
    assert (hit.slot, hit.other) == (1, 0)


def test_what_is_static_never_hits() -> None:
    made = still()
    touch(made, {"kind": 1, "frame": 2, "a": 3, "b": 0, "time": 0.1})
    (hit,) = actions_of(VideoFacts(made, VIDEO))
    assert (hit.slot, hit.other) == (0, 3)


@pytest.mark.parametrize(("separation", "kind"), [(0.0, "hits"), (0.29, "hits"), (0.31, "bounces")])
def test_what_comes_back_bounces(separation: float, kind: str) -> None:
    made = still()
    touch(
        made, {"kind": 1, "frame": 2, "a": 0, "b": 3, "time": 0.1, "approach_speed": 1, "separation_speed": separation}
    )
    assert [action.kind for action in actions_of(VideoFacts(made, VIDEO))] == [kind]


def test_a_disc_rolls_or_slides_by_the_speed_of_the_point_that_touches() -> None:
    made = still(**{"world/gravity": np.array([0, -9.8])})
    made["states/velocity"][:, 0] = [1, 0]
    made["states/position"][:, 0, 0] = 1 + np.arange(VIDEO.frames) / VIDEO.fps
    made["objects/radius"][0] = 0.5
    rows = [{"kind": 3, "frame": t, "a": 0, "b": 3, "time": t / 20, "normal": (0, -1)} for t in range(1, VIDEO.frames)]
    touch(made, *rows)
    for spin, kind in ((-2.0, "rolls"), (0.0, "slides"), (2.0, "slides"), (-1.5, None)):
        made["states/angular_velocity"][:, 0] = spin
        found = [action for action in actions_of(VideoFacts(made, VIDEO)) if action.kind in ("rolls", "slides")]
        assert [(action.kind, action.other, action.way) for action in found] == (
            [(kind, 3, "to the right")] if kind else []
        )


@pytest.mark.parametrize(
    ("gravity", "phrase"),
    [
        ((0, 0), ""),
        ((0, -9.8), " under gravity"),
        ((0, 3), " under gravity upwards"),
        ((2, -2), " under gravity"),
        ((2, 1), " under gravity to the right"),
        ((-2, -1), " under gravity to the left"),
    ],
)
def test_gravity_has_its_direction(gravity: tuple[float, float], phrase: str) -> None:
    made = still(**{"world/gravity": np.array(gravity)})
    assert caption.story_of(made, VIDEO).opening().endswith(f" in a box{phrase}.")


@pytest.mark.parametrize(("count", "amount"), [(ROWS, "are "), (ROWS + 1, "are at least ")])
def test_more_contacts_than_are_stored_are_at_least_so_many(count: int, amount: str) -> None:
    made = still()
    rows = np.arange(ROWS)
    made |= {"contacts/a": rows % 3, "contacts/b": 3 + rows % 4, "contacts/frame": 1 + rows // 2}
    made["contacts/time"] = 0.2 * rows
    made |= {"contacts/count": np.array(count, np.int32), "contacts/kind": np.ones(ROWS, np.uint8)}
    texts = caption.caption_fields({name: values[None] for name, values in made.items()}, VIDEO)
    assert texts["text/event_count"].tolist() == [ROWS]
    assert f"There {amount}54 more hits." in texts["text/caption"][0].decode()


def test_shapes_have_their_nouns() -> None:
    made = still()
    made["objects/shape"][:BALLS] = [2, 3, 3]
    made |= {"objects/vertices": np.zeros((BALLS + 4, 4, 2)), "objects/vertex_count": np.array([0, 4, 3, 0, 0, 0, 0])}
    made["objects/vertices"][1] = [[0, 0], [1, 0], [1, 1], [0, 1]]
    assert long(made).endswith(" red capsule, a blue block and a green triangle in a box.")
    made["objects/kind"][1] = 1
    assert long(made).endswith(" red capsule and a green triangle in a box with an obstacle.")
    made["objects/present"][BALLS + 1 :] = False
    assert long(made).endswith(" red capsule and a green triangle with an obstacle and a floor.")
    assert caption.story_of(made, VIDEO).references.all[BALLS].text == "the floor"


def test_words_differ_between_videos_and_not_between_runs() -> None:
    grammars = [grammar_of(VideoFacts(seen(seed), VIDEO)) for seed in range(60)]
    picks = [grammar.pick("hits", "abc") for grammar in grammars]
    assert picks == [grammar_of(VideoFacts(seen(seed), VIDEO)).pick("hits", "abc") for seed in range(60)]
    assert min(picks.count(letter) for letter in "abc") >= 8


# ---- Questions


def test_programs_name_what_is_wrong_with_them() -> None:
    story = caption.story_of(still(), VIDEO)
    assert questions.run(("objects", "ball", "filter_shape", "count"), story) == "3"
    for program, message in [
        (("objects", "unique"), "3 objects are meant"),
        (("count",), "count needs 1 values"),
        (("objects", "objects"), "must leave one value, but left 2"),
    ]:
        with pytest.raises(ValueError, match=message):
            questions.run(program, story)


def test_programs_look_at_what_happens_after_a_time() -> None:
    made = still()
    touch(made, *({"kind": 1, "frame": 2 * t, "a": 0, "b": 2 + t, "time": t / 10} for t in (1, 2)))
    story = caption.story_of(made, VIDEO)
    for time, count in (("0.05", "2"), ("0.15", "1"), ("0.25", "0")):
        assert questions.run(("events", "hit", "filter_event", time, "filter_after", "count"), story) == count
    red = ("objects", "red", "filter_color", "unique")
    first = ("events", "hit", "filter_event", *red, "filter_object", "first", *red, "partner", "describe")
    assert questions.run(first, story) == "floor"


def test_questions_of_yes_and_no_need_both() -> None:
    """Whether something is said about a video in which all answers are 'no' is not asked."""
    asked = questions.questions_of(caption.story_of(still(), VIDEO))
    assert {question.template for question in asked} == {"count", "color"}


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 1000), width=st.integers(2, 3000))
def test_questions_that_do_not_fit_are_left_out_whole(seed: int, width: int) -> None:
    asked = questions.questions_of(caption.story_of(seen(seed), VIDEO))
    text = questions.questions_json(asked, width)
    assert len(text) <= width
    assert json.loads(text) == [question.json for question in asked][: len(json.loads(text))]
    assert len({question.template for question in asked}) == len(asked)


# ---- In a dataset


ASKED = {"captions": True, "contacts": 8, "visibility": True}
WORDY = tiny.tiny_config(annotations=ASKED, video={"frames": 16})


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "tiny"
    gen2d.generate(WORDY, 8, out, seed=5, device="cpu")
    return out


def test_words_are_stored_and_made_again(made: Path) -> None:
    videos = gen2d.open(made, fields="*")[:]
    found = caption.caption_fields(videos, load_config(WORDY).video)
    for name, values in found.items():
        assert_array_equal(videos[name], values)
    assert videos["text/event_count"].sum() > 0
    assert gen2d.verify(made, "regen", videos=2) == []


def test_words_of_a_dataset_are_true(made: Path) -> None:
    ds = gen2d.open(made, fields="*")
    for video in (ds[number] for number in range(len(ds))):
        reader = Reader(video, load_config(WORDY).video, colors.COLORS)
        for name in ("caption", "short_caption"):
            assert reader.problems(bytes(video[f"text/{name}"]).decode()) == []
        for question in json.loads(bytes(video["text/questions"])):
            answer = reader.answer(question["question"])
            assert question["answer"] == answer or f"object {reader.resolve(question['answer'])[0]}" == answer


def test_the_least_visibility_is_that_of_what_moves(made: Path) -> None:
    videos = gen2d.open(made, fields=["visibility/*", "objects/*", "quality/*"])[:]
    there = (videos["objects/present"] & (videos["objects/kind"] == 0))[:, None]
    assert_array_equal(videos["quality/min_visibility"], np.where(there, videos["visibility/fraction"], 1).min((1, 2)))


@pytest.mark.full
def test_growth_is_a_number_that_each_video_has_for_itself(tmp_path: Path) -> None:
    gen2d.generate(tiny.tiny_config(annotations={"lyapunov": True}), 8, tmp_path / "tiny", device="cpu")
    growth = gen2d.open(tmp_path / "tiny", fields="quality/lyapunov")[:]["quality/lyapunov"]
    assert np.isfinite(growth).all()
    assert len(np.unique(growth)) == 8


@pytest.mark.parametrize("to", ["jax", "torch"])
def test_a_stream_tells_the_same(made: Path, to: str) -> None:
    if to == "torch":
        package("torch")
    names = ["text/*", "index", "quality/*"]
    stream = gen2d.stream(WORDY, 5, 3, n=8, fields=names, epochs=1, to=to)
    loader = gen2d.DataLoader(gen2d.open(made, fields=names), 3, shuffle=False, epochs=1)
    for here, there in zip(stream, loader, strict=True):
        assert here.keys() == there.keys()
        for name, values in there.items():
            assert_array_equal(np.asarray(here[name]), values)


def test_frames_are_drawn_again_beside_words(made: Path) -> None:
    ds = gen2d.open(made, fields="frames")
    assert_array_equal(gen2d.render(ds, [1]), ds[1:2]["frames"])


def test_words_need_contacts() -> None:
    with pytest.raises(ConfigError, match=r"annotations\.contacts is 0, but annotations\.captions needs them"):
        load_config(tiny.tiny_config(annotations={"captions": True}))
