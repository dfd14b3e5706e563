"""Events of a video (hits, leaving and entering the view, rest), computed from its stored fields."""

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from gen2d.core.enums import END, IMPACT, SEGMENT, STATIC

EventColumns = Mapping[str, np.ndarray]

CAPTION_BYTES, EVENT_BYTES = 512, 128  # the second per object and 16 frames
MAX_EVENTS = 4  # maximum number of events in a caption
SAME_HIT_SECONDS = 0.1  # s; impacts of a pair in successive frames are one hit if they are closer than this
REST_SPEED, REST_SECONDS = 0.02, 0.1  # rest: all points stay slower than 0.02 m/s until the end, for 0.1 s at least
DIGITS = 6  # significant digits of numbers in events
SIDES = ("left", "right", "top", "bottom")
BOX_SIDES = ("floor", "ceiling", "left wall", "right wall")


class Hit(NamedTuple):
    """Impact that begins a contact of two objects."""

    time: float  # s
    frame: int  # the impact is in the interval before it
    a: int  # slots
    b: int
    row: int  # of contacts


class VideoEvent(NamedTuple):
    """Event of a video."""

    time: float  # s
    kind: str  # hit, leaves, enters or rest
    frame: int  # the event is at this frame, or in the interval before it
    about: dict[str, Any]  # the other entries of its JSON

    @property
    def text(self) -> str:
        """The event as JSON."""
        entries = {"event": self.kind, "time": round_number(self.time), "frame": self.frame, **self.about}
        return json.dumps(entries, separators=(",", ":"))


def events_json(events: list[VideoEvent], width: int) -> str:
    """JSON list of the first events, as many as fit in `width` bytes."""
    texts, used = [], 2
    for event in events:
        used += len(event.text) + (1 if texts else 0)
        if used > width:
            break
        texts.append(event.text)
    return f"[{','.join(texts)}]"


def round_number(number: float) -> float:
    """The number, rounded to DIGITS significant digits."""
    return float(f"{number:.{DIGITS}g}")


# ---- Events


def video_events(columns: EventColumns, video: Any) -> list[VideoEvent]:
    """All events of a video, sorted by time."""
    events = [*hit_events(columns), *view_events(columns, video), *rest_events(columns, video.fps)]
    return sorted(events, key=lambda event: event.time)  # stable at equal times


def hits(columns: EventColumns) -> list[Hit]:
    """Impacts that begin a contact, by time."""
    rows = zip(*(columns[f"contacts/{name}"].tolist() for name in ("kind", "frame", "time", "a", "b")), strict=True)
    last: dict[tuple[int, int], tuple[int, int, float]] = {}  # kind, frame and time of each pair's last row
    impacts = []
    for row, (kind, frame, time, a, b) in enumerate(rows):
        if not kind:
            break
        if kind == IMPACT and not _in_contact_since(last.get((a, b)), frame, time):
            impacts.append(Hit(time, frame, a, b, row))
        last[a, b] = kind, frame, time
    return impacts


def hit_events(columns: EventColumns) -> list[VideoEvent]:
    """Hits as events."""
    events = []
    for hit in hits(columns):
        point = [round_number(x) for x in columns["contacts/point"][hit.row].tolist()]
        speed = round_number(float(columns["contacts/approach_speed"][hit.row]))
        events.append(VideoEvent(hit.time, "hit", hit.frame, {"a": hit.a, "b": hit.b, "point": point, "speed": speed}))
    return events


def _in_contact_since(last: tuple[int, int, float] | None, frame: int, time: float) -> bool:
    """Whether a pair has stayed in contact from its `last` row until an impact at this frame and time."""
    if last is None or last[0] == END or last[1] < frame - 1:
        return False
    # After an impact the pair may have separated. At low frame rates it has.
    return last[0] != IMPACT or time - last[2] < SAME_HIT_SECONDS


def moving_slots(columns: EventColumns) -> np.ndarray:
    """Slots of the bodies that are not static."""
    return np.flatnonzero(columns["objects/present"] & (columns["objects/kind"] != STATIC))


def view_events(columns: EventColumns, video: Any) -> list[VideoEvent]:
    """Objects that leave or enter the view: their bounding boxes begin or cease to lie outside it."""
    slots = moving_slots(columns)
    distance = _distance_outside_view(columns, slots, video)  # px [4, T, M], by SIDES
    farthest = distance.max(0)
    is_outside = farthest >= 0
    events = []
    for frame, k in zip(*np.nonzero(is_outside[1:] != is_outside[:-1]), strict=True):
        before, after = farthest[frame, k], farthest[frame + 1, k]
        time = (frame + before / (before - after)) / video.fps  # linear between frames
        kind, outside_frame = ("leaves", frame + 1) if is_outside[frame + 1, k] else ("enters", frame)
        side = SIDES[int(distance[:, outside_frame, k].argmax())]
        events.append(VideoEvent(float(time), kind, int(frame) + 1, {"a": int(slots[k]), "side": side}))
    return events


def _distance_outside_view(columns: EventColumns, slots: np.ndarray, video: Any) -> np.ndarray:
    """Distance of each object's bounding box beyond each side of the view, px [4, T, M]; negative if not beyond."""
    scale, angle = (columns[f"camera/{name}"].astype(float)[:, None, None] for name in ("scale", "angle"))
    offset = core_points(columns, slots) - columns["camera/center"].astype(float)[:, None, None]  # [T, M, P, 2]
    cos, sin = np.cos(angle), np.sin(angle)
    column = video.width / 2 + scale * (offset[..., 0] * cos + offset[..., 1] * sin)
    row = video.height / 2 - scale * (offset[..., 1] * cos - offset[..., 0] * sin)
    radius = scale[..., 0] * columns["objects/radius"][slots]
    left, right, top, bottom = (f(-1) for f in (column.min, column.max, row.min, row.max))
    return np.stack([-(right + radius), left - radius - video.width, -(bottom + radius), top - radius - video.height])


def core_points(columns: EventColumns, slots: np.ndarray) -> np.ndarray:
    """Core points of the objects, m [T, M, P, 2]: centre, ends or vertices, with some of them repeated."""
    half = columns["objects/half_length"][slots].astype(float)
    local = np.stack([np.stack([-half, 0 * half], -1), np.stack([half, 0 * half], -1)], axis=1)
    if "objects/vertices" in columns:
        vertices = columns["objects/vertices"][slots].astype(float)
        local = np.concatenate(
            [local, np.where((columns["objects/shape"][slots] == 3)[:, None, None], vertices, local[:, :1])], 1
        )
    angle = columns["states/angle"][:, slots, None].astype(float)
    cos, sin = np.cos(angle), np.sin(angle)
    rotated = np.stack([cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]], -1)
    return columns["states/position"][:, slots, None].astype(float) + rotated


def rest_events(columns: EventColumns, fps: float) -> list[VideoEvent]:
    """Rest event, if all objects come to rest after some motion and stay at rest until the end."""
    slots = moving_slots(columns)
    reach = np.linalg.norm(core_points(columns, slots)[0] - columns["states/position"][0, slots, None], axis=-1).max(
        -1, initial=0
    )
    reach = reach + columns["objects/radius"][slots]
    speed = np.linalg.norm(columns["states/velocity"][:, slots].astype(float), axis=-1)
    speed = speed + np.abs(columns["states/angular_velocity"][:, slots]) * reach
    fast = np.flatnonzero((speed >= REST_SPEED).any(1))
    frame = int(fast[-1]) + 1 if len(fast) else 0
    if frame == 0 or len(speed) - 1 - frame < REST_SECONDS * fps:
        return []
    return [VideoEvent(frame / fps, "rest", frame, {})]


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
            names[slot] = "floor" if y - low[1] <= margin[1] else "ceiling" if high[1] - y <= margin[1] else "shelf"
        elif width <= height / 10:
            names[slot] = (
                "left wall" if x - low[0] <= margin[0] else "right wall" if high[0] - x <= margin[0] else "divider"
            )
        else:
            names[slot] = "slope"
    return names
