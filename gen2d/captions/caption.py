"""Texts of a video, computed from its stored fields: two captions, a list of events, and questions with answers.

    A red ball and a blue ball in a box under gravity. The red ball starts to fall at 0.00 s, then bounces off the
    floor at 0.42 s.
    [{"event":"hit","time":0.42,"frame":13,"a":0,"b":3,"point":[2.1,0.0],"speed":4.1}, ...]

A video's texts depend on its own fields alone. NumPy computes them on the host, in parallel with the device; jax is not
imported.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from gen2d.captions.actions import actions_of
from gen2d.captions.colors import color_word as color_word
from gen2d.captions.events import CAPTION_BYTES, EVENT_BYTES, EventColumns, events_json, video_events
from gen2d.captions.facts import VideoFacts
from gen2d.captions.questions import QUESTIONS, questions_json, questions_of
from gen2d.captions.references import References
from gen2d.captions.sentences import Story, grammar_of
from gen2d.core.schema import Field

SHORT_BYTES = 128
QUESTION_BYTES = 384  # of a question with its answer and its program


def fields(slots: int, frames: int) -> dict[str, Field]:
    """Stored text fields; the numbers of slots and frames alone determine their widths."""
    width = 2 + EVENT_BYTES * slots * math.ceil(frames / 16)
    return {
        "text/caption": Field(f"S{CAPTION_BYTES}", "n", "UTF-8", "description of the objects and of what they do"),
        "text/short_caption": Field(f"S{SHORT_BYTES}", "n", "UTF-8", "one sentence about what happens"),
        "text/questions": Field(
            f"S{2 + QUESTIONS * QUESTION_BYTES}",
            "n",
            "JSON",
            "list of questions with their answers and programs, as many as fit",
        ),
        "text/events": Field(
            f"S{width}",
            "n",
            "JSON",
            "list of events by time (hits, objects leaving and entering the view, rest), as many as fit",
        ),
        "text/event_count": Field(
            "int32", "n", "1", "number of events, including those that did not fit into text/events"
        ),
    }


OPTIONAL_FIELDS = (  # not every dataset stores these
    *(f"objects/{name}" for name in ("vertices", "vertex_count", "color_name", "material_name")),
    *("joints/a", "joints/b"),
)
REQUIRED_FIELDS = (
    *(f"objects/{name}" for name in ("present", "kind", "shape", "radius", "half_length", "color", "depth")),
    "world/gravity",
    *(f"states/{name}" for name in ("position", "angle", "velocity", "angular_velocity")),
    *(f"camera/{name}" for name in ("center", "scale", "angle")),
    *(f"contacts/{name}" for name in ("time", "frame", "a", "b", "point", "normal", "kind", "count")),
    *(f"contacts/{name}_speed" for name in ("approach", "separation")),
)


def caption_fields(
    batch: EventColumns, video: Any, constants: Mapping[str, np.ndarray] | None = None
) -> dict[str, np.ndarray]:
    """Text fields [n] of videos, from their other fields [n, ...]; `video` has frames, fps, height and width (px).

    `constants` are fields that all videos share, such as joints/a.
    """
    stored = fields(batch["objects/present"].shape[1], video.frames)
    names = REQUIRED_FIELDS + OPTIONAL_FIELDS
    shared = {name: values for name, values in (constants or {}).items() if name in names}
    rows = [
        video_texts({name: batch[name][i] for name in names if name in batch} | shared, video, stored)
        for i in range(len(batch["objects/present"]))
    ]
    return {name: np.array([row[name] for row in rows], field.dtype) for name, field in stored.items()}


def video_texts(columns: EventColumns, video: Any, stored: Mapping[str, Field]) -> dict[str, Any]:
    """Text fields of one video, from its other fields."""
    events, story = video_events(columns, video), story_of(columns, video)
    width = {name: np.dtype(field.dtype).itemsize for name, field in stored.items()}
    return {
        "text/caption": story.long(width["text/caption"]).encode(),
        "text/short_caption": story.short(width["text/short_caption"]).encode(),
        "text/questions": questions_json(questions_of(story), width["text/questions"]).encode(),
        "text/events": events_json(events, width["text/events"]).encode(),
        "text/event_count": len(events),
    }


def story_of(columns: EventColumns, video: Any) -> Story:
    """Sentences about one video, from its fields."""
    facts = VideoFacts(columns, video)
    return Story(facts, actions_of(facts), grammar_of(facts), References(facts))
