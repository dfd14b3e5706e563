"""The list of a video's events, from its stored fields."""

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from gen2d.core.enums import END, IMPACT, STATIC

EventColumns = Mapping[str, np.ndarray]

CAPTION_BYTES, EVENT_BYTES = 512, 128  # the second for each object and 16 frames
MAX_EVENTS = 4  # events that a caption tells at most
TOGETHER = 0.1  # s: impacts of a pair in frames that follow one another, and no further apart, are one hit
STILL, STILL_SECONDS = 0.02, 0.1  # m/s of the fastest point; all is at rest if it stays below, for so long at least
DIGITS = 6  # of the numbers in events
SIDES = ("left", "right", "top", "bottom")


class VideoEvent(NamedTuple):
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


def as_json(events: list[VideoEvent], width: int) -> str:
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


def events_of(made: EventColumns, video: Any) -> list[VideoEvent]:
    """All events of a video, in time's order."""
    found = [*hit_events(made), *view_events(made, video), *rest_events(made, video.fps)]
    return sorted(found, key=lambda event: event.time)  # of equal times as they come


def hit_events(made: EventColumns) -> list[VideoEvent]:
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
            found.append(VideoEvent(time, "hit", frame, about))
        last[a, b] = kind, frame, time
    return found


def _still_touch(last: tuple[int, int, float] | None, frame: int, time: float) -> bool:
    """Whether a pair with this last row is in touch until an impact."""
    if last is None or last[0] == END or last[1] < frame - 1:
        return False
    # After an impact it may have left or not. At a few frames a second, it has.
    return last[0] != IMPACT or time - last[2] < TOGETHER


def moving_slots(made: EventColumns) -> np.ndarray:
    """The slots of what moves."""
    return np.flatnonzero(made["objects/present"] & (made["objects/kind"] != STATIC))


def view_events(made: EventColumns, video: Any) -> list[VideoEvent]:
    """What leaves the view, or comes into it: the box around it lies outside, or no more."""
    slots = moving_slots(made)
    beyond = _beyond(made, slots, video)  # [4, T, M] px, of the sides in their order
    most = beyond.max(0)
    out = most >= 0
    found = []
    for frame, k in zip(*np.nonzero(out[1:] != out[:-1]), strict=True):
        before, after = most[frame, k], most[frame + 1, k]
        time = (frame + before / (before - after)) / video.fps  # as if it moved evenly between frames
        kind, outside = ("leaves", frame + 1) if out[frame + 1, k] else ("enters", frame)
        side = SIDES[int(beyond[:, outside, k].argmax())]
        found.append(VideoEvent(float(time), kind, int(frame) + 1, {"a": int(slots[k]), "side": side}))
    return found


def _beyond(made: EventColumns, slots: np.ndarray, video: Any) -> np.ndarray:
    """How far each object's box lies beyond each side of the view, px [4, T, M]; negative where it does not."""
    scale, angle = (made[f"camera/{name}"].astype(float)[:, None, None] for name in ("scale", "angle"))
    away = view_corners(made, slots) - made["camera/center"].astype(float)[:, None, None]  # [T, M, P, 2]
    cos, sin = np.cos(angle), np.sin(angle)
    column = video.width / 2 + scale * (away[..., 0] * cos + away[..., 1] * sin)
    row = video.height / 2 - scale * (away[..., 1] * cos - away[..., 0] * sin)
    radius = scale[..., 0] * made["objects/radius"][slots]
    left, right, top, bottom = (f(-1) for f in (column.min, column.max, row.min, row.max))
    return np.stack([-(right + radius), left - radius - video.width, -(bottom + radius), top - radius - video.height])


def view_corners(made: EventColumns, slots: np.ndarray) -> np.ndarray:
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


def rest_events(made: EventColumns, fps: float) -> list[VideoEvent]:
    """That all has come to rest, if it does so and moved before."""
    slots = moving_slots(made)
    reach = np.linalg.norm(view_corners(made, slots)[0] - made["states/position"][0, slots, None], axis=-1).max(
        -1, initial=0
    )
    reach = reach + made["objects/radius"][slots]
    speed = np.linalg.norm(made["states/velocity"][:, slots].astype(float), axis=-1)
    speed = speed + np.abs(made["states/angular_velocity"][:, slots]) * reach
    fast = np.flatnonzero((speed >= STILL).any(1))
    frame = int(fast[-1]) + 1 if len(fast) else 0
    if frame == 0 or len(speed) - 1 - frame < STILL_SECONDS * fps:
        return []
    return [VideoEvent(frame / fps, "rest", frame, {})]
