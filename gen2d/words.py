"""What happens in a video, in words: a list of events as JSON, and a caption in English, both from the stored fields.

    [{"event":"hit","time":0.42,"frame":13,"a":0,"b":3,"point":[2.1,0.0],"speed":4.1}, ...]
    Two balls in a box under gravity. The red ball hits the floor at 0.42 s, then the blue ball at 0.8 s.

A video's words depend on its own fields alone. NumPy, on the host, while the device goes on; jax is not imported.
"""

import json
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from gen2d.core.schema import Field

Columns = Mapping[str, np.ndarray]

CAPTION_BYTES, EVENT_BYTES = 512, 128  # the second for each object and 16 frames
SHOWN = 4  # events that a caption tells at most
STATIC = 1  # objects/kind
IMPACT, END = 1, 4  # contacts/kind
TOGETHER = 0.1  # s: impacts of a pair in frames that follow one another, and no further apart, are one hit
STILL, STILL_SECONDS = 0.02, 0.1  # m/s of the fastest point; all is at rest if it stays below, for so long at least
DIGITS = 6  # of the numbers in events

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
SIDES = ("left", "right", "top", "bottom")
BOX = ("floor", "ceiling", "left wall", "right wall")


class Event(NamedTuple):
    """Something that happens, at a time in s; `about` is what else there is to say of it, as JSON has it."""

    time: float
    kind: str
    frame: int  # at which, or in the interval before which, it happens
    about: dict[str, Any]

    @property
    def text(self) -> str:
        """The event as JSON."""
        found = {"event": self.kind, "time": rounded(self.time), "frame": self.frame, **self.about}
        return json.dumps(found, separators=(",", ":"))


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


def told(columns: Columns, video: Any) -> dict[str, np.ndarray]:
    """The fields of some videos, from their others [n, ...]; `video` has frames, fps, and height and width in px."""
    stored = fields(columns["objects/present"].shape[1], video.frames)
    rows = [
        told_of({name: columns[name][i] for name in NEEDED if name in columns}, video, stored)
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


def told_of(made: Columns, video: Any, stored: Mapping[str, Field]) -> dict[str, Any]:
    """One video's fields, from its others."""
    events = events_of(made, video)
    missed = int(made["contacts/count"]) > len(made["contacts/kind"])
    width = np.dtype(stored["text/events"].dtype).itemsize
    return {
        "text/caption": caption(made, events, video.fps, missed).encode(),
        "text/events": as_json(events, width).encode(),
        "text/event_count": len(events),
    }


def as_json(events: list[Event], width: int) -> str:
    """The first of the events as JSON, as many as fit the width in bytes."""
    texts, used = [], 2
    for event in events:
        used += len(event.text) + (1 if texts else 0)
        if used > width:
            break
        texts.append(event.text)
    return f"[{','.join(texts)}]"


def rounded(number: float) -> float:
    """The number with few digits."""
    return float(f"{number:.{DIGITS}g}")


# ---- Events


def events_of(made: Columns, video: Any) -> list[Event]:
    """All events of a video, in time's order."""
    found = [*hits(made), *passages(made, video), *rests(made, video.fps)]
    return sorted(found, key=lambda event: event.time)  # of equal times as they come


def hits(made: Columns) -> list[Event]:
    """Every impact that begins a touch."""
    rows = zip(*(made[f"contacts/{name}"].tolist() for name in ("kind", "frame", "time", "a", "b")), strict=True)
    last: dict[tuple[int, int], tuple[int, int, float]] = {}  # of each pair its last row
    found = []
    for row, (kind, frame, time, a, b) in enumerate(rows):
        if not kind:
            break
        if kind == IMPACT and not _still_touch(last.get((a, b)), frame, time):
            point, speed = made["contacts/point"][row].tolist(), float(made["contacts/approach_speed"][row])
            about = {"a": a, "b": b, "point": [rounded(x) for x in point], "speed": rounded(speed)}
            found.append(Event(time, "hit", frame, about))
        last[a, b] = kind, frame, time
    return found


def _still_touch(last: tuple[int, int, float] | None, frame: int, time: float) -> bool:
    """Whether a pair with this last row is in touch until an impact."""
    if last is None or last[0] == END or last[1] < frame - 1:
        return False
    # After an impact it may have left or not. At a few frames a second, it has.
    return last[0] != IMPACT or time - last[2] < TOGETHER


def moving(made: Columns) -> np.ndarray:
    """The slots of what moves."""
    return np.flatnonzero(made["objects/present"] & (made["objects/kind"] != STATIC))


def passages(made: Columns, video: Any) -> list[Event]:
    """What leaves the view, or comes into it: the box around it lies outside, or no more."""
    slots = moving(made)
    beyond = _beyond(made, slots, video)  # [4, T, M] px, of the sides in their order
    most = beyond.max(0)
    out = most >= 0
    found = []
    for frame, k in zip(*np.nonzero(out[1:] != out[:-1]), strict=True):
        before, after = most[frame, k], most[frame + 1, k]
        time = (frame + before / (before - after)) / video.fps  # as if it moved evenly between frames
        kind, outside = ("leaves", frame + 1) if out[frame + 1, k] else ("enters", frame)
        side = SIDES[int(beyond[:, outside, k].argmax())]
        found.append(Event(float(time), kind, int(frame) + 1, {"a": int(slots[k]), "side": side}))
    return found


def _beyond(made: Columns, slots: np.ndarray, video: Any) -> np.ndarray:
    """How far each object's box lies beyond each side of the view, px [4, T, M]; negative where it does not."""
    scale, angle = (made[f"camera/{name}"].astype(float)[:, None, None] for name in ("scale", "angle"))
    away = corners(made, slots) - made["camera/center"].astype(float)[:, None, None]  # [T, M, P, 2]
    cos, sin = np.cos(angle), np.sin(angle)
    column = video.width / 2 + scale * (away[..., 0] * cos + away[..., 1] * sin)
    row = video.height / 2 - scale * (away[..., 1] * cos - away[..., 0] * sin)
    radius = scale[..., 0] * made["objects/radius"][slots]
    left, right, top, bottom = (f(-1) for f in (column.min, column.max, row.min, row.max))
    return np.stack([-(right + radius), left - radius - video.width, -(bottom + radius), top - radius - video.height])


def corners(made: Columns, slots: np.ndarray) -> np.ndarray:
    """The corners of the objects' cores, m [T, M, P, 2]: a centre, two ends or a polygon's corners, some repeated."""
    half = made["objects/half_length"][slots].astype(float)
    own = np.stack([np.stack([-half, 0 * half], -1), np.stack([half, 0 * half], -1)], axis=1)
    if "objects/vertices" in made:
        vertices = made["objects/vertices"][slots].astype(float)
        own = np.concatenate(
            [own, np.where((made["objects/shape"][slots] == 3)[:, None, None], vertices, own[:, :1])], 1
        )
    angle = made["states/angle"][:, slots, None].astype(float)
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack([cos * own[..., 0] - sin * own[..., 1], sin * own[..., 0] + cos * own[..., 1]], -1)
    return made["states/position"][:, slots, None].astype(float) + turned


def rests(made: Columns, fps: float) -> list[Event]:
    """That all has come to rest, if it does so and moved before."""
    slots = moving(made)
    reach = np.linalg.norm(corners(made, slots)[0] - made["states/position"][0, slots, None], axis=-1).max(
        -1, initial=0
    )
    reach = reach + made["objects/radius"][slots]
    speed = np.linalg.norm(made["states/velocity"][:, slots].astype(float), axis=-1)
    speed = speed + np.abs(made["states/angular_velocity"][:, slots]) * reach
    fast = np.flatnonzero((speed >= STILL).any(1))
    frame = int(fast[-1]) + 1 if len(fast) else 0
    if frame == 0 or len(speed) - 1 - frame < STILL_SECONDS * fps:
        return []
    return [Event(frame / fps, "rest", frame, {})]


# ---- The caption


def caption(made: Columns, events: list[Event], fps: float, missed: bool = False) -> str:
    """What is there and what happens first, in English; `missed`: whether there were more hits than are known."""
    names, decimals = names_of(made), max(2, math.ceil(math.log10(fps)))

    def telling(shown: int) -> str:
        left = len(events) - shown
        more = [f"{'At least' if missed else 'And'} {left} more event{'s' if left > 1 else ''}."] if left else []
        return " ".join([opening(made, names), *sentences(made, names, events[:shown], decimals), *more])

    texts = (telling(shown) for shown in range(min(SHOWN, len(events)), -1, -1))
    return next(text for text in texts if len(text) <= CAPTION_BYTES)


def opening(made: Columns, names: Mapping[int, str]) -> str:
    """The sentence that says what is there."""
    kinds = nouns(made)
    ours = [kinds[slot] for slot in moving(made)]
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


def nouns(made: Columns) -> dict[int, str]:
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


def names_of(made: Columns) -> dict[int, str]:
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


def walls_of(made: Columns) -> dict[int, str]:
    """What static segments are called, by slot: those level or upright by the side of all of them that they are on."""
    static = made["objects/present"] & (made["objects/kind"] == STATIC) & (made["objects/shape"] == 1)
    slots = np.flatnonzero(static)
    if not len(slots):
        return {}
    ends = corners(made, slots)[0, :, :2]
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


def sentences(made: Columns, names: Mapping[int, str], events: list[Event], decimals: int) -> list[str]:
    """The events in English, with times in s; hits of one object in a row are one sentence."""
    found: list[str] = []
    hitting = -1  # the slot that the last sentence is about
    for event in events:
        at = f"at {event.time:.{decimals}f} s"
        if event.kind == "rest":
            found, hitting = [*found, f"All is at rest {at}."], -1
        elif event.kind != "hit":
            way = f"{event.kind} the view {'at' if event.kind == 'leaves' else 'from'} the {event.about['side']}"
            found, hitting = [*found, _begun(f"{names[event.about['a']]} {way} {at}.")], -1
        else:
            who, whom = _who(made, event)
            if who == hitting:
                found[-1] = f"{found[-1][:-1]}, then {names[whom]} {at}."
            else:
                found.append(_begun(f"{names[who]} hits {names[whom]} {at}."))
            hitting = who
    return found


def _begun(sentence: str) -> str:
    return sentence[0].upper() + sentence[1:]


def _who(made: Columns, event: Event) -> tuple[int, int]:
    """Who hits whom: what was faster in the frame before; what is static hits nothing."""
    a, b = event.about["a"], event.about["b"]
    speed = np.linalg.norm(made["states/velocity"][event.frame - 1, [a, b]], axis=-1)
    speed[made["objects/kind"][[a, b]] == STATIC] = -1
    return (a, b) if speed[0] >= speed[1] else (b, a)
