"""Captions and answers of every family are true: an independent reader parses them and looks at the stored fields.

A dozen videos of a family in the first tier, of every family in the second, and 1,000 of every family in the
third (`pytest -m slow tests/captions`; CAPTION_VIDEOS sets their number).
"""

import json
import os
from collections import Counter

import jax
import numpy as np
import pytest
from caption_reader import Reader

from gen2d.captions import caption, colors, questions
from gen2d.config import plugins
from gen2d.config.config import load_config
from gen2d.programs.source import VideoSource

FAMILIES = plugins.names("scene")
FEW, MANY = 12, int(os.environ.get("CAPTION_VIDEOS", "1000"))
QUICK = ("ramp",)  # in the first tier
TOLD_APART = 0.95  # of captions, at least
OVERRIDES = [
    "annotations.contacts=8",
    "annotations.captions=true",
    "storage.frames=none",
    "annotations.visibility=false",
]


MATERIALS = ("look=studio", "look.material=[rubber,wood,metal,paper]")  # named in captions, too


def check(family: str, count: int, *overrides: str) -> None:
    config = load_config(f"{family}.yaml", [*OVERRIDES, *overrides])
    source = VideoSource(config, jax.devices()[:1])
    videos = source.videos("train", np.arange(count))
    constants = {name: values for name, values in source.schema.constants.items() if name.startswith("joints/")}
    answers: Counter[str] = Counter()
    ambiguous = 0
    for number in range(count):
        video = {name: values[number] for name, values in videos.items()} | constants
        reader = Reader(video, config.video, colors.COLORS)
        texts = [bytes(video[f"text/{name}"]).decode() for name in ("caption", "short_caption")]
        for text, complete in zip(texts, (True, False), strict=True):
            assert reader.problems(text, complete) == [], (family, number, text)
        ambiguous += bool(reader.ambiguous)
        story = caption.story_of(video, config.video)
        for question in json.loads(bytes(video["text/questions"])):
            answer = reader.answer(question["question"])
            stated = question["answer"]
            found = reader.resolve(stated) == [int(answer[7:])] if answer.startswith("object ") else answer == stated
            assert found, (family, number, question, answer)
            assert questions.run(question["program"], story) == stated
            answers[stated] += 1
    assert ambiguous <= (1 - TOLD_APART) * count + 1
    yes, no = answers["yes"], answers["no"]
    assert abs(yes - no) <= 5 * np.sqrt(yes + no)  # each is as likely


@pytest.mark.parametrize("family", [x if x in QUICK else pytest.param(x, marks=pytest.mark.full) for x in FAMILIES])
def test_what_captions_and_answers_say_is_true(family: str) -> None:
    check(family, FEW)


@pytest.mark.full
def test_what_captions_and_answers_say_of_materials_is_true() -> None:
    check("bouncing", FEW, *MATERIALS)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["bouncing", "tower"])
def test_what_many_captions_and_answers_say_of_materials_is_true(family: str) -> None:
    check(family, MANY, *MATERIALS)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_what_many_captions_and_answers_say_is_true(family: str) -> None:
    check(family, MANY)


def test_the_reader_notices_what_is_false() -> None:
    """Sentences that are true of a video, and the same with another colour, number, side, verb or time."""
    source = VideoSource(load_config("ramp.yaml", OVERRIDES), jax.devices()[:1])
    videos = source.videos("train", np.arange(FEW))
    readers = [
        Reader({name: values[i] for name, values in videos.items()}, source.config.video, colors.COLORS)
        for i in range(FEW)
    ]
    texts = [bytes(text).decode() for text in videos["text/caption"]]
    swaps = [
        ("to the right", "to the left"), ("under gravity", "under gravity upwards"), ("the floor", "the slope"),
        (" roll ", " slide "), ("bounces off", "hits"), ("0.", "1."), ("speeding up", "slowing down"),
        ("more", "other"), ("hit", "miss"), ("with a slope", "with two slopes"), (" ball", " block"),
    ]  # fmt: skip
    noticed = 0
    for reader, text in zip(readers, texts, strict=True):
        assert reader.problems(text) == []
        for old, new in swaps:
            if old in text and text.replace(old, new) != text:
                noticed += 1
                assert reader.problems(text.replace(old, new)), (text, old, new)
    assert noticed > FEW
