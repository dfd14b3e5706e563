"""What happens in a video, in words: a list of events as JSON, and a caption in English, both from the stored fields.

    [{"event":"hit","time":0.42,"frame":13,"a":0,"b":3,"point":[2.1,0.0],"speed":4.1}, ...]
    Two balls in a box under gravity. The red ball hits the floor at 0.42 s, then the blue ball at 0.8 s.

A video's words depend on its own fields alone. NumPy, on the host, while the device goes on; jax is not imported.
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
    as_json,
    events_of,
    moving_slots,
    view_corners,
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
FIXED_NOUNS = ("peg", "wall", "bar", "block")  # of what is static
CORNERS = {3: "triangle", 4: "box"}
NUMBERS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
BOX = ("floor", "ceiling", "left wall", "right wall")


def fields(slots: int, frames: int) -> dict[str, Field]:
    """What is stored, for so many objects and frames; this alone decides how wide the text is."""
    width = 2 + EVENT_BYTES * slots * math.ceil(frames / 16)
    return {
        "text/caption": Field(f"S{CAPTION_BYTES}", "n", "UTF-8", "what is there and what happens first"),
        "text/events": Field(
            f"S{width}", "n", "JSON", "hits, what leaves and enters the view, and rest, in time's order, as many as fit"
        ),
        "text/event_count": Field(
            "int32", "n", "1", "events there were; those that did not fit are not in text/events"
        ),
    }


def caption_fields(columns: EventColumns, video: Any) -> dict[str, np.ndarray]:
    """The fields of some videos, from their others [n, ...]; `video` has frames, fps, and height and width in px."""
    stored = fields(columns["objects/present"].shape[1], video.frames)
    rows = [
        captions_of({name: columns[name][i] for name in NEEDED if name in columns}, video, stored)
        for i in range(len(columns["objects/present"]))
    ]
    return {name: np.array([row[name] for row in rows], field.dtype) for name, field in stored.items()}


NEEDED = (
    *(f"objects/{name}" for name in ("present", "kind", "shape", "radius", "half_length", "color")),
    *("objects/vertices", "objects/vertex_count", "world/gravity"),
    *(f"states/{name}" for name in ("position", "angle", "velocity", "angular_velocity")),
    *(f"camera/{name}" for name in ("center", "scale", "angle")),
    *(f"contacts/{name}" for name in ("time", "frame", "a", "b", "point", "approach_speed", "kind", "count")),
)


def captions_of(made: EventColumns, video: Any, stored: Mapping[str, Field]) -> dict[str, Any]:
    """One video's fields, from its others."""
    events = events_of(made, video)
    missed = int(made["contacts/count"]) > len(made["contacts/kind"])
    width = np.dtype(stored["text/events"].dtype).itemsize
    return {
        "text/caption": caption(made, events, video.fps, missed).encode(),
        "text/events": as_json(events, width).encode(),
        "text/event_count": len(events),
    }


# ---- The caption


def caption(made: EventColumns, events: list[VideoEvent], fps: float, missed: bool = False) -> str:
    """What is there and what happens first, in English; `missed`: whether there were more hits than are known."""
    names, decimals = names_of(made), max(2, math.ceil(math.log10(fps)))

    def telling(shown: int) -> str:
        left = len(events) - shown
        more = [f"{'At least' if missed else 'And'} {left} more event{'s' if left > 1 else ''}."] if left else []
        return " ".join([opening(made, names), *sentences(made, names, events[:shown], decimals), *more])

    texts = (telling(shown) for shown in range(min(MAX_EVENTS, len(events)), -1, -1))
    return next(text for text in texts if len(text) <= CAPTION_BYTES)


def opening(made: EventColumns, names: Mapping[int, str]) -> str:
    """The sentence that says what is there."""
    kinds = nouns(made)
    ours = [kinds[slot] for slot in moving_slots(made)]
    obstacles = [noun for slot, noun in kinds.items() if noun in FIXED_NOUNS and noun != "wall"]
    box = " in a box" if all(f"the {side}" in names.values() for side in BOX) else ""
    among = f" among {counted(obstacles)}" if obstacles else ""
    text = f"{counted(ours)}{box}{among}{pulled(made['world/gravity'])}."
    return text[0].upper() + text[1:]


def counted(things: list[str]) -> str:
    """Nouns with their numbers, such as: two balls and one box."""
    plural = {"box": "boxes"}
    parts = [
        f"{NUMBERS[n] if n < len(NUMBERS) else n} {noun if n == 1 else plural.get(noun, f'{noun}s')}"
        for noun, n in Counter(things).items()
    ]
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if parts[1:] else parts or ["nothing that moves"])


def pulled(gravity: np.ndarray) -> str:
    """How gravity pulls, to end the first sentence with."""
    x, y = gravity.tolist()
    if not (x or y):
        return ""
    if abs(y) >= abs(x):
        return " under gravity" if y < 0 else " under gravity upwards"
    return f" under gravity to the {'right' if x > 0 else 'left'}"


def nouns(made: EventColumns) -> dict[int, str]:
    """What each object is, by slot."""
    found = {}
    for slot in np.flatnonzero(made["objects/present"]).tolist():
        shape = int(made["objects/shape"][slot])
        if made["objects/kind"][slot] == STATIC:
            found[slot] = FIXED_NOUNS[shape]
        else:
            corners = int(made["objects/vertex_count"][slot]) if NOUNS[shape] == "polygon" else 0
            found[slot] = CORNERS.get(corners, NOUNS[shape])
    return found


def names_of(made: EventColumns) -> dict[int, str]:
    """What each object is called, by slot: with a colour, and with a number where two are alike."""
    kinds, walls = nouns(made), walls_of(made)
    bare = {
        slot: walls.get(slot, noun) if noun in FIXED_NOUNS else f"{color_name(made['objects/color'][slot])} {noun}"
        for slot, noun in kinds.items()
    }
    many, seen, found = Counter(bare.values()), Counter(), {}
    for slot, name in bare.items():
        seen[name] += 1
        found[slot] = f"the {name}" if many[name] == 1 else f"{name} {seen[name]}"
    return found


def walls_of(made: EventColumns) -> dict[int, str]:
    """What static segments are called, by slot: those level or upright by the side of all of them that they are on."""
    static = made["objects/present"] & (made["objects/kind"] == STATIC) & (made["objects/shape"] == SEGMENT)
    slots = np.flatnonzero(static)
    if not len(slots):
        return {}
    ends = view_corners(made, slots)[0, :, :2]
    low, high = ends.min((0, 1)), ends.max((0, 1))
    found = {}
    for slot, (a, b) in zip(slots.tolist(), ends, strict=True):
        (width, height), (x, y) = abs(b - a), (a + b) / 2
        if height <= width / 10:  # the floor, where it is alone
            found[slot] = "floor" if y - low[1] <= (high - low)[1] / 10 else _either(y, high, low, 1, "ceiling")
        elif width <= height / 10:
            found[slot] = "left wall" if x - low[0] <= (high - low)[0] / 10 else _either(x, high, low, 0, "right wall")
        else:
            found[slot] = "slope"
    return found


def _either(place: float, high: np.ndarray, low: np.ndarray, axis: int, name: str) -> str:
    return name if high[axis] - place <= (high - low)[axis] / 10 else "wall"


def color_name(color: np.ndarray) -> str:
    """The name of the nearest colour; red and blue count for less than green, of which eyes see most."""
    apart = np.array(list(COLORS.values())) - color.astype(int)
    return list(COLORS)[int((apart**2 @ np.array([3, 4, 2])).argmin())]


def sentences(made: EventColumns, names: Mapping[int, str], events: list[VideoEvent], decimals: int) -> list[str]:
    """The events in English, with times in s; hits of one object in a row are one sentence."""
    found: list[str] = []
    hitting = -1  # the slot that the last sentence is about
    for event in events:
        at = f"at {event.time:.{decimals}f} s"
        if event.kind == "rest":
            found, hitting = [*found, f"All is at rest {at}."], -1
        elif event.kind != "hit":
            way = f"{event.kind} the view {'at' if event.kind == 'leaves' else 'from'} the {event.about['side']}"
            found, hitting = [*found, _capitalized(f"{names[event.about['a']]} {way} {at}.")], -1
        else:
            who, whom = _who(made, event)
            if who == hitting:
                found[-1] = f"{found[-1][:-1]}, then {names[whom]} {at}."
            else:
                found.append(_capitalized(f"{names[who]} hits {names[whom]} {at}."))
            hitting = who
    return found


def _capitalized(sentence: str) -> str:
    return sentence[0].upper() + sentence[1:]


def _who(made: EventColumns, event: VideoEvent) -> tuple[int, int]:
    """Who hits whom: what was faster in the frame before; what is static hits nothing."""
    a, b = event.about["a"], event.about["b"]
    speed = np.linalg.norm(made["states/velocity"][event.frame - 1, [a, b]], axis=-1)
    speed[made["objects/kind"][[a, b]] == STATIC] = -1
    return (a, b) if speed[0] >= speed[1] else (b, a)
