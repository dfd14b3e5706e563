"""Checks of the arguments of `Space`; each raises ConfigError."""

import colorsys
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gen2d.core.enums import DYNAMIC
from gen2d.core.errors import ConfigError
from gen2d.space.bodies import GREY, MOST_CORNERS


def checked_number(
    name: str, value: Any, low: float | None = None, above: float | None = None, infinite: bool = False
) -> float:
    """The value as a float in these bounds; finite unless `infinite` allows otherwise."""
    allowed = " and ".join(
        [
            "a number",
            *([f"{low:g} or more"] if low is not None else []),
            *([f"above {above:g}"] if above is not None else []),
        ]
    )
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    fits = (low is None or number >= low) and (above is None or number > above)
    if math.isnan(number) or (math.isinf(number) and not infinite) or not fits:
        raise ConfigError(f"{name} is {value!r}, but must be {allowed}")
    return number


def _floats(value: Any) -> np.ndarray:
    """The value as an array of floats; empty if that is impossible."""
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        return np.empty(0)


def checked_pair(name: str, value: Any) -> np.ndarray:
    """Two finite numbers."""
    pair = _floats(value)
    if pair.shape != (2,) or not np.isfinite(pair).all():
        raise ConfigError(f"{name} is {value!r}, but must be two numbers, x and y")
    return pair


def checked_corners(name: str, value: Any) -> np.ndarray:
    """Counter-clockwise corners [V, 2] of a convex polygon."""
    corners = _floats(value)
    if corners.ndim != 2 or corners.shape[-1] != 2 or not 3 <= len(corners) <= MOST_CORNERS:
        raise ConfigError(f"{name} has shape {list(corners.shape)}, but must be 3 to {MOST_CORNERS} corners (x, y)")
    if not np.isfinite(corners).all():
        raise ConfigError(f"{name} has a corner that is not a number, but all must be finite")
    edges = np.roll(corners, -1, axis=0) - corners
    next_edges = np.roll(edges, -1, axis=0)
    turns = np.arctan2(edges[:, 0] * next_edges[:, 1] - edges[:, 1] * next_edges[:, 0], (edges * next_edges).sum(1))
    orientation = np.sign(turns.sum())
    simple = abs(abs(turns.sum()) - 2 * math.pi) < 1e-6  # a star turns twice
    if not simple or (orientation * turns < 1e-6).any() or (np.hypot(*edges.T) == 0).any():
        raise ConfigError(f"{name} is {corners.tolist()}, but must be convex, its corners in order and none in line")
    return corners if orientation > 0 else corners[::-1].copy()


def checked_color(name: str, value: Any, number: int, kind: int) -> tuple[int, int, int]:
    """Red, green and blue; without a value, grey or a hue by the number of the body."""
    if value is None:
        hue = 0.03 + 0.618034 * number  # golden ratio: consecutive hues differ, and none repeats
        red, green, blue = (round(255 * part) for part in colorsys.hls_to_rgb(hue % 1, 0.55, 0.6))
        return (red, green, blue) if kind == DYNAMIC else GREY
    parts = tuple(value) if isinstance(value, Sequence | np.ndarray) else ()
    if len(parts) != 3 or not all(isinstance(p, int | np.integer) and 0 <= p <= 255 for p in parts):
        raise ConfigError(f"{name} is {value!r}, but must be three whole numbers from 0 to 255: red, green, blue")
    return int(parts[0]), int(parts[1]), int(parts[2])


def rotate(vector: np.ndarray, angle: float) -> np.ndarray:
    """The vector, turned counter-clockwise."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])
