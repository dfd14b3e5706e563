"""Caption and event list of a video, computed from its stored fields: a JSON list and a text in English.

    [{"event":"hit","time":0.42,"frame":13,"a":0,"b":3,"point":[2.1,0.0],"speed":4.1}, ...]
    Two balls in a box under gravity. The red ball hits the floor at 0.42 s, then the blue ball at 0.8 s.

A video's texts depend on its own fields alone. NumPy computes them on the host, in parallel with the device; jax is not
imported.
"""

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from gen2d.captions.events import (
    CAPTION_BYTES,
    EVENT_BYTES,
    MAX_EVENTS,
    EventColumns,
    VideoEvent,
    core_points,
    events_json,
    moving_slots,
    video_events,
)
from gen2d.core.enums import SEGMENT, STATIC
from gen2d.core.schema import Field

COLORS = {
    "red": (220, 40, 40),
    "orange": (245, 140, 30),
    "yellow": (240, 225, 50),
    "green": (60, 170, 60),
    "turquoise": (60, 205, 195),
    "blue": (50, 80, 220),
    "purple": (140, 60, 180),
    "pink": (245, 130, 190),
    "brown": (130, 80, 40),
    "white": (245, 245, 245),
    "grey": (128, 128, 128),
    "black": (20, 20, 20),
}
NOUNS = ("ball", "rod", "capsule", "polygon")  # by objects/shape
FIXED_NOUNS = ("peg", "wall", "bar", "block")  # of static bodies, by objects/shape
CORNERS = {3: "triangle", 4: "box"}
NUMBERS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
BOX = ("floor", "ceiling", "left wall", "right wall")


def fields(slots: int, frames: int) -> dict[str, Field]:
    """Stored text fields; the numbers of slots and frames alone determine their widths."""
    width = 2 + EVENT_BYTES * slots * math.ceil(frames / 16)
    return {
        "text/caption": Field(f"S{CAPTION_BYTES}", "n", "UTF-8", "description of the objects and of the first events"),
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


def caption_fields(batch: EventColumns, video: Any) -> dict[str, np.ndarray]:
    """Text fields [n] of videos, from their other fields [n, ...]; `video` has frames, fps, height and width (px)."""
    stored = fields(batch["objects/present"].shape[1], video.frames)
    rows = [
        video_texts({name: batch[name][i] for name in REQUIRED_FIELDS if name in batch}, video, stored)
        for i in range(len(batch["objects/present"]))
    ]
    return {name: np.array([row[name] for row in rows], field.dtype) for name, field in stored.items()}


REQUIRED_FIELDS = (
    *(f"objects/{name}" for name in ("present", "kind", "shape", "radius", "half_length", "color")),
    *("objects/vertices", "objects/vertex_count", "world/gravity"),
    *(f"states/{name}" for name in ("position", "angle", "velocity", "angular_velocity")),
    *(f"camera/{name}" for name in ("center", "scale", "angle")),
    *(f"contacts/{name}" for name in ("time", "frame", "a", "b", "point", "approach_speed", "kind", "count")),
)


def video_texts(columns: EventColumns, video: Any, stored: Mapping[str, Field]) -> dict[str, Any]:
    """Text fields of one video, from its other fields."""
    events = video_events(columns, video)
    missed = int(columns["contacts/count"]) > len(columns["contacts/kind"])
    width = np.dtype(stored["text/events"].dtype).itemsize
    return {
        "text/caption": caption(columns, events, video.fps, missed).encode(),
        "text/events": events_json(events, width).encode(),
        "text/event_count": len(events),
    }


# ---- The caption


def caption(columns: EventColumns, events: list[VideoEvent], fps: float, missed: bool = False) -> str:
    """Caption of the objects and the first events; `missed` says that there were more contacts than are stored."""
    names, decimals = object_names(columns), max(2, math.ceil(math.log10(fps)))

    def text_of(shown: int) -> str:
        extra = len(events) - shown
        more = [f"{'At least' if missed else 'And'} {extra} more event{'s' if extra > 1 else ''}."] if extra else []
        return " ".join([opening(columns, names), *sentences(columns, names, events[:shown], decimals), *more])

    texts = (text_of(shown) for shown in range(min(MAX_EVENTS, len(events)), -1, -1))
    return next(text for text in texts if len(text) <= CAPTION_BYTES)


def opening(columns: EventColumns, names: Mapping[int, str]) -> str:
    """First sentence: the objects, the box and gravity."""
    kinds = object_nouns(columns)
    moving = [kinds[slot] for slot in moving_slots(columns)]
    obstacles = [noun for slot, noun in kinds.items() if noun in FIXED_NOUNS and noun != "wall"]
    box = " in a box" if all(f"the {side}" in names.values() for side in BOX) else ""
    among = f" among {count_phrase(obstacles)}" if obstacles else ""
    return f"{count_phrase(moving)}{box}{among}{gravity_phrase(columns['world/gravity'])}.".capitalize()


def count_phrase(things: list[str]) -> str:
    """Nouns with their counts, such as: two balls and one box."""
    plural = {"box": "boxes"}
    parts = [
        f"{NUMBERS[n] if n < len(NUMBERS) else n} {noun if n == 1 else plural.get(noun, f'{noun}s')}"
        for noun, n in Counter(things).items()
    ]
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if parts[1:] else parts or ["nothing that moves"])


def gravity_phrase(gravity: np.ndarray) -> str:
    """Phrase for the direction of gravity, for the end of the first sentence."""
    x, y = gravity.tolist()
    if not (x or y):
        return ""
    if abs(y) >= abs(x):
        return " under gravity" if y < 0 else " under gravity upwards"
    return f" under gravity to the {'right' if x > 0 else 'left'}"


def object_nouns(columns: EventColumns) -> dict[int, str]:
    """Noun of each object, by slot."""
    by_slot = {}
    for slot in np.flatnonzero(columns["objects/present"]).tolist():
        shape = int(columns["objects/shape"][slot])
        if columns["objects/kind"][slot] == STATIC:
            by_slot[slot] = FIXED_NOUNS[shape]
        else:
            corners = int(columns["objects/vertex_count"][slot]) if NOUNS[shape] == "polygon" else 0
            by_slot[slot] = CORNERS.get(corners, NOUNS[shape])
    return by_slot


def object_names(columns: EventColumns) -> dict[int, str]:
    """Name of each object, by slot, with its colour, and with a number if several would have the same name."""
    kinds, walls = object_nouns(columns), wall_names(columns)
    bare = {
        slot: walls.get(slot, noun) if noun in FIXED_NOUNS else f"{color_name(columns['objects/color'][slot])} {noun}"
        for slot, noun in kinds.items()
    }
    counts, seen, names = Counter(bare.values()), Counter(), {}
    for slot, name in bare.items():
        seen[name] += 1
        names[slot] = f"the {name}" if counts[name] == 1 else f"{name} {seen[name]}"
    return names


def wall_names(columns: EventColumns) -> dict[int, str]:
    """Names of static segments, by slot: slopes, and otherwise by their side of the bounding box of all of them."""
    static = columns["objects/present"] & (columns["objects/kind"] == STATIC) & (columns["objects/shape"] == SEGMENT)
    slots = np.flatnonzero(static)
    if not len(slots):
        return {}
    ends = core_points(columns, slots)[0, :, :2]
    low, high = ends.min((0, 1)), ends.max((0, 1))
    margin, names = (high - low) / 10, {}
    for slot, (a, b) in zip(slots.tolist(), ends, strict=True):
        (width, height), (x, y) = abs(b - a), (a + b) / 2
        if height <= width / 10:  # a single level segment is the floor
            names[slot] = "floor" if y - low[1] <= margin[1] else "ceiling" if high[1] - y <= margin[1] else "wall"
        elif width <= height / 10:
            names[slot] = (
                "left wall" if x - low[0] <= margin[0] else "right wall" if high[0] - x <= margin[0] else "wall"
            )
        else:
            names[slot] = "slope"
    return names


def color_name(color: np.ndarray) -> str:
    """Name of the nearest colour, by squared distance weighted 3 : 4 : 2, as the eye is most sensitive to green."""
    difference = np.array(list(COLORS.values())) - color.astype(int)
    return list(COLORS)[int((difference**2 @ np.array([3, 4, 2])).argmin())]


def sentences(columns: EventColumns, names: Mapping[int, str], events: list[VideoEvent], decimals: int) -> list[str]:
    """Sentences for the events, with times in s; successive hits by one object share a sentence."""
    lines: list[str] = []
    last_hitter = -1  # slot of the object that hits in the last sentence
    for event in events:
        at = f"at {event.time:.{decimals}f} s"
        if event.kind == "rest":
            lines, last_hitter = [*lines, f"All is at rest {at}."], -1
        elif event.kind != "hit":
            action = f"{event.kind} the view {'at' if event.kind == 'leaves' else 'from'} the {event.about['side']}"
            lines, last_hitter = [*lines, f"{names[event.about['a']]} {action} {at}.".capitalize()], -1
        else:
            hitter, target = _hitter_and_target(columns, event)
            if hitter == last_hitter:
                lines[-1] = f"{lines[-1][:-1]}, then {names[target]} {at}."
            else:
                lines.append(f"{names[hitter]} hits {names[target]} {at}.".capitalize())
            last_hitter = hitter
    return lines


def _hitter_and_target(columns: EventColumns, event: VideoEvent) -> tuple[int, int]:
    """Slots of the hitting object, which was faster one frame earlier, and of its target; static bodies never hit."""
    a, b = event.about["a"], event.about["b"]
    speed = np.linalg.norm(columns["states/velocity"][event.frame - 1, [a, b]], axis=-1)
    speed[columns["objects/kind"][[a, b]] == STATIC] = -1
    return (a, b) if speed[0] >= speed[1] else (b, a)
