"""Exact path of smooth discs within walls, with and without gravity: one impact after the other, in float64.

Between impacts all discs fall alike, so two of them move in a straight line relative to each other and touch at a root
of |d + u t| = r + s; the distance to a wall is a parabola. An impact changes the normal speed v by -(1 + e) v.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from oracles import Setting

STILL = 1e-9  # m/s: slower approaches are rounding errors


class Impact(NamedTuple):
    """An impact, and the state of all discs after it."""

    time: float  # s
    pair: tuple[int, int]  # in ascending order; walls are -1, -2, ...
    approach: float  # m/s, along the normal
    positions: np.ndarray  # [K, 2] m
    after: np.ndarray  # [K, 2] m/s: velocities


def start(setting: "Setting") -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities [K, 2] of the discs at the start."""
    x, v = (np.array([getattr(thing, name) for thing in setting.things], float) for name in "xv")
    return x, v


def impacts(setting: "Setting", state: tuple[np.ndarray, np.ndarray] | None = None) -> Iterator[Impact]:
    """Impacts in order of time, from a `state` (positions and velocities) or that of the setting.

    Walls are counter-clockwise. Ends when nothing meets any more; discs that come to rest never end.
    """
    x, v = (np.array(part) for part in (start(setting) if state is None else state))
    r, mass = (np.array([getattr(thing, name) for thing in setting.things], float) for name in ("radius", "mass"))
    first, second = np.triu_indices(len(x), 1)
    begin, end = np.array(setting.walls, float).transpose(1, 0, 2)
    along = (end - begin) / np.linalg.norm(end - begin, axis=1)[:, None]
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
    fall, reach, now = np.array([0.0, -setting.gravity]), r[first] + r[second], 0.0
    while True:
        discs = _until_discs(x[second] - x[first], v[second] - v[first], reach)
        walls = _until_walls(((x[:, None] - begin) * inward).sum(2) - r[:, None], v @ inward.T, inward @ fall)
        wait = max(min(discs.min(initial=np.inf), walls.min()), 0.0)
        if wait == np.inf:
            return
        now, x, v = now + wait, x + wait * v + wait**2 / 2 * fall, v + wait * fall
        if discs.min(initial=np.inf) < walls.min():
            k = int(discs.argmin())
            i, j, normal = int(first[k]), int(second[k]), (x[second[k]] - x[first[k]]) / reach[k]
            speed, pair = float((v[i] - v[j]) @ normal), (i, j)
            push = (1 + setting.elasticity) * speed / (1 / mass[i] + 1 / mass[j]) * normal
            v[i], v[j] = v[i] - push / mass[i], v[j] + push / mass[j]
        else:
            i, wall = divmod(int(walls.argmin()), len(along))
            speed, pair = float(-v[i] @ inward[wall]), (-1 - wall, i)
            v[i] = v[i] + (1 + setting.elasticity) * speed * inward[wall]
        yield Impact(now, pair, speed, x.copy(), v.copy())


def _until_discs(offset: np.ndarray, velocity: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Time in which each pair of discs touches, s; infinite if it does not."""
    a, b, c = (velocity**2).sum(1), (offset * velocity).sum(1), (offset**2).sum(1) - reach**2
    root = np.sqrt(np.maximum(b**2 - a * c, 0))
    return np.where((b < -STILL) & (root > 0), c / np.maximum(root - b, STILL), np.inf)


def _until_walls(gap: np.ndarray, speed: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Time in which each disc arrives at each wall, s: the root of gap + speed t + pull t^2 / 2 at which it falls."""
    inside = speed**2 - 2 * pull * gap
    root = np.sqrt(np.maximum(inside, 0))
    nearing = 2 * gap / np.maximum(root - speed, STILL)
    returning = (root + speed) / np.maximum(-pull, STILL)
    time = np.where(speed < 0, nearing, np.where((pull < 0) & (root + speed > STILL), returning, np.inf))
    return np.where((inside > 0) & (root > STILL), time, np.inf)


def positions(setting: "Setting", path: list[Impact], times: np.ndarray) -> np.ndarray:
    """Positions [T, K, 2] at times in ascending order, up to the impact after the last of `path`."""
    x, v = start(setting)
    since = np.array([0.0, *(impact.time for impact in path)])
    places, speeds = np.array([x, *(i.positions for i in path)]), np.array([v, *(i.after for i in path)])
    last = np.searchsorted(since, times, side="right") - 1
    wait = (times - since[last])[:, None, None]
    return places[last] + wait * speeds[last] + wait**2 / 2 * np.array([0.0, -setting.gravity])
