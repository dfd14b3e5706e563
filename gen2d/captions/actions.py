"""What the objects of a video do, found in its states and contacts by rules with thresholds.

The page of captions lists the rules; the tests apply them again to the stored fields.
"""

from typing import NamedTuple

import numpy as np

from gen2d.captions.events import REST_SECONDS, REST_SPEED, SIDES, view_events
from gen2d.captions.facts import VideoFacts
from gen2d.core.enums import CIRCLE, POLYGON, STATIC

RUN_SECONDS = 0.25  # s; shorter rolling and sliding is not mentioned
RUN_SPEED = 0.1  # m/s; slower objects neither roll nor slide
ROLL_SLIP, SLIDE_SLIP = 0.1, 0.5  # speed of the touching point over that of the centre: at most, at least
SLIDE_TURN = 0.2  # a body without a round rim slides if turning moves its outline at most by this share of its speed
SPEED_UP = 1.5  # ratio of speeds between the ends of a run that speeds up
BOUNCE_SPEED, BOUNCE_SHARE = 0.2, 0.3  # m/s of approach, and separation over approach, of a bounce; at least
TOPPLE = np.pi / 4  # rad
STAY = 0.05  # of its reach, and rad: an object that moves and turns less than this stays in place
SWING, TILT = 0.3, 0.05  # rad
SAG = 0.2  # m
DIRECTIONS = (
    "to the right", "up to the right", "up", "up to the left", "to the left", "down to the left", "down",
    "down to the right",
)  # fmt: skip


class Action(NamedTuple):
    """Something that an object does."""

    kind: str  # starts, falls, peaks, rolls, slides, hits, bounces, topples, swings, tilts, sags, passes, leaves, ...
    slot: int  # of the object
    time: float  # s
    other: int = -1  # slot of the other object
    way: str = ""  # direction, side, or for rolls and slides "speeding up" or "slowing down" after a comma
    number: float = 0.0  # m/s


def actions_of(facts: VideoFacts) -> list[Action]:
    """All actions of a video, by time."""
    found = [*_hits(facts), *_view(facts)]
    for slot in facts.moving:
        found += _rest(facts, slot)
        if slot in facts.joined:
            found += _swing(facts, slot)
        else:
            found += [*_start(facts, slot), *_free_flight(facts, slot), *_runs(facts, slot), *_topple(facts, slot)]
            found += _stay(facts, slot)
        found += _passes(facts, slot)
    stay = {action.slot for action in found if action.kind == "stays"}
    found = [action for action in found if action.kind != "rests" or action.slot not in stay]
    return sorted(found, key=lambda action: action.time)  # stable at equal times


def direction(facts: VideoFacts, frame: int, vector: np.ndarray) -> str:
    """One of eight directions in the picture, for a vector [2] in the world."""
    turn = np.arctan2(vector[1], vector[0]) - float(facts.columns["camera/angle"][frame])
    return DIRECTIONS[round(turn / (np.pi / 4)) % 8]


def _start(facts: VideoFacts, slot: int) -> list[Action]:
    """Motion of an object in frame 0."""
    velocity = facts.velocity[0, slot]
    speed = float(np.linalg.norm(velocity))
    if speed < RUN_SPEED:
        return []
    return [Action("starts", slot, 0.0, way=direction(facts, 0, velocity), number=speed)]


def _runs_of(labels: list) -> list[tuple[int, int]]:
    """First and last index of each run of equal labels that are not None."""
    ends = [i for i in range(1, len(labels)) if labels[i] != labels[i - 1]]
    runs = zip([0, *ends], [end - 1 for end in [*ends, len(labels)]], strict=True)
    return [(first, last) for first, last in runs if labels[first] is not None]


def _free_flight(facts: VideoFacts, slot: int) -> list[Action]:
    """Falls, and highest points, of an object between contacts under gravity."""
    if not facts.gravity.any():
        return []
    down = facts.gravity / np.linalg.norm(facts.gravity)
    fall = facts.velocity[:, slot] @ down
    touched, size, found = facts.touches.get(slot, {}), 2 * facts.reach[slot], []
    free = [frame not in touched for frame in range(min(len(fall), facts.known_frames))]
    for first, last in _runs_of([True if one else None for one in free]):
        first = max(first - 1, 0)  # a contact in the interval before a frame is over at the frame, or the next has one
        height = facts.position[first : last + 1, slot] @ down
        top = int(height.argmin())
        if height[-1] - height[top] >= size and (fall[first + top + 1 : last + 1] > 0).all():
            found.append(Action("falls", slot, (first + top) / facts.video.fps))
            across = np.ptp(facts.position[first : last + 1, slot] @ np.array([-down[1], down[0]]))
            if height[0] - height[top] >= size / 2 and across >= size:
                found[-1] = found[-1]._replace(kind="peaks")
    return found


def _runs(facts: VideoFacts, slot: int) -> list[Action]:
    """Rolling and sliding on static objects."""
    touched, found = facts.touches.get(slot, {}), []
    labels = [_run_label(facts, slot, frame, touched.get(frame, {})) for frame in range(len(facts.position))]
    for first, last in _runs_of(labels):
        if (last - first) / facts.video.fps < RUN_SECONDS:
            continue
        way = facts.position[last, slot] - facts.position[first, slot]
        if np.linalg.norm(way) < facts.reach[slot]:
            continue
        kind, other = labels[first] or ("", -1)
        before, after = (float(np.linalg.norm(facts.velocity[frame, slot])) for frame in (first, last))
        change = (
            ", speeding up" if after >= SPEED_UP * before else ", slowing down" if before >= SPEED_UP * after else ""
        )
        text = direction(facts, first, way) + change
        found.append(Action(kind, slot, first / facts.video.fps, other, text))
    return found


def _run_label(facts: VideoFacts, slot: int, frame: int, rows: dict[int, int]) -> tuple[str, int] | None:
    """Whether an object rolls or slides in a frame, and on which static object."""
    static = [other for other in rows if facts.columns["objects/kind"][other] == STATIC]
    if len(rows) != 1 or not static:
        return None
    velocity = facts.velocity[frame, slot]
    speed = np.linalg.norm(velocity)
    if speed < RUN_SPEED:
        return None
    if facts.columns["objects/shape"][slot] != CIRCLE:
        turning = np.abs(facts.spin[frame, slot]) * facts.reach[slot]
        return ("slides", static[0]) if turning <= SLIDE_TURN * speed else None
    row = rows[static[0]]
    towards = facts.columns["contacts/normal"][row].astype(float)
    towards = towards if facts.columns["contacts/a"][row] == slot else -towards
    arm = float(facts.columns["objects/radius"][slot]) * towards
    slip = np.linalg.norm(velocity + facts.spin[frame, slot] * np.array([-arm[1], arm[0]])) / speed
    return ("rolls", static[0]) if slip <= ROLL_SLIP else ("slides", static[0]) if slip >= SLIDE_SLIP else None


def _hits(facts: VideoFacts) -> list[Action]:
    """Hits; of a hit off which an object bounces, the slower one is `other`."""
    columns, found = facts.columns, []
    for hit in facts.hits:
        pair = [hit.a, hit.b]
        speed = np.linalg.norm(facts.velocity[hit.frame - 1, pair], axis=-1)
        speed[columns["objects/kind"][pair] == STATIC] = -1  # static objects never hit
        hitter, target = pair if speed[0] >= speed[1] else pair[::-1]
        approach, separation = (
            float(columns[f"contacts/{name}_speed"][hit.row]) for name in ("approach", "separation")
        )
        bounces = (
            columns["objects/kind"][target] == STATIC
            and approach >= BOUNCE_SPEED
            and separation >= BOUNCE_SHARE * approach
        )
        found.append(Action("bounces" if bounces else "hits", hitter, hit.time, target))
    return found


def _view(facts: VideoFacts) -> list[Action]:
    """Objects that leave and enter the view."""
    events = view_events(facts.columns, facts.video)
    return [Action(event.kind, event.about["a"], event.time, way=event.about["side"]) for event in events]


def _rest(facts: VideoFacts, slot: int) -> list[Action]:
    """An object that comes to rest after some motion, and stays at rest until the end."""
    fast = np.flatnonzero(facts.point_speed[:, slot] >= REST_SPEED)
    frame = int(fast[-1]) + 1 if len(fast) else 0
    if frame == 0 or len(facts.position) - 1 - frame < REST_SECONDS * facts.video.fps:
        return []
    return [Action("rests", slot, frame / facts.video.fps)]


def _topple(facts: VideoFacts, slot: int) -> list[Action]:
    """A standing polygon that turns by 45 degrees or more."""
    gravity = float(np.linalg.norm(facts.gravity))
    if facts.columns["objects/shape"][slot] != POLYGON or not gravity or len(facts.position) < 2:
        return []
    turned = facts.angle[:, slot] - facts.angle[0, slot]
    far = np.flatnonzero(np.abs(turned) >= TOPPLE)
    speeds = np.linalg.norm(facts.velocity[:2, slot], axis=-1)
    falls_free = speeds[1] >= gravity / facts.video.fps / 2
    if not len(far) or speeds[0] >= REST_SPEED or falls_free:
        return []
    return [Action("topples", slot, int(far[0]) / facts.video.fps, way=SIDES[int(turned[far[0]] < 0)])]


def _stay(facts: VideoFacts, slot: int) -> list[Action]:
    """An object that stays in place during the whole video, although gravity acts."""
    moved = np.linalg.norm(facts.position[:, slot] - facts.position[0, slot], axis=-1).max()
    turned = np.abs(facts.angle[:, slot] - facts.angle[0, slot]).max()
    stays = facts.gravity.any() and moved < STAY * facts.reach[slot] and turned < STAY
    return [Action("stays", slot, 0.0)] if stays else []


def _swing(facts: VideoFacts, slot: int) -> list[Action]:
    """Swinging, tilting and sagging of objects on joints."""
    pins, chain = facts.pins_of(slot), facts.chain_of(slot)
    shape, balls = facts.columns["objects/shape"], facts.columns["objects/shape"] == CIRCLE
    if shape[slot] == POLYGON:
        turned = facts.angle[:, slot] - facts.angle[0, slot]
        far = int(np.abs(turned).argmax())
        first = int(np.flatnonzero(np.abs(turned) >= TILT)[0]) if abs(turned[far]) >= TILT else -1
        way = SIDES[int(turned[first] < 0)]
        return [Action("tilts", slot, first / facts.video.fps, way=way)] if first >= 0 and len(pins) == 1 else []
    hanging = [s for s in facts.joined[slot] if balls[s] and s not in pins]
    if len(pins) == 2 and chain and slot == chain[0] and not hanging and facts.gravity.any():
        height = -(facts.position[:, chain].mean(1) @ facts.gravity) / np.linalg.norm(facts.gravity)
        lowest = int(height.argmin())
        return [Action("sags", slot, lowest / facts.video.fps)] if height[0] - height[lowest] >= SAG else []
    if len(pins) != 1 or not (balls[slot] or (chain and slot == chain[-1] and not hanging)):
        return []
    arm = facts.position[:, slot] - facts.position[:, pins[0]]
    bearing = np.unwrap(np.arctan2(arm[:, 1], arm[:, 0]))
    if np.ptp(bearing) < SWING:
        return []
    far = np.maximum.accumulate(bearing) - bearing, bearing - np.minimum.accumulate(bearing)
    back = min(x.max() for x in far) >= SWING  # it has turned by as much in both directions
    first = int(np.flatnonzero(np.abs(bearing - bearing[0]) >= SWING / 2)[0])
    return [Action("swings", slot, first / facts.video.fps, way="back and forth" if back else "")]


def _passes(facts: VideoFacts, slot: int) -> list[Action]:
    """Balls that pass behind a screen: all of a ball is hidden by it, and comes out again or not."""
    if facts.columns["objects/shape"][slot] != CIRCLE:
        return []
    radius, found = float(facts.columns["objects/radius"][slot]), []
    depth = facts.columns.get("objects/depth", np.zeros(len(facts.reach)))
    for screen in facts.screens:
        if depth[screen] <= depth[slot]:
            continue
        hidden = facts.depth_inside(slot, screen) >= radius
        for first, last in _runs_of([True if one else None for one in hidden]):
            if first == 0:
                continue
            kind = "passes" if last + 1 < len(hidden) else "vanishes"
            found.append(Action(kind, slot, first / facts.video.fps, screen))
    return found
