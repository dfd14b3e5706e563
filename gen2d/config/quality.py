"""Which videos are asked for: ranges of their quality measures, checked."""

from collections.abc import Set
from typing import Any

import numpy as np

VISIBILITY = "quality/min_visibility"  # the one that is known only when a video is drawn
# Options of a config's section `quality`: the field that each is about, and the option that makes it be stored.
MEASURES = {
    "contacts": ("quality/contacts", ""),
    "penetration": ("quality/max_penetration", ""),
    "lyapunov": ("quality/lyapunov", "annotations.lyapunov"),
    "energy_residual": ("quality/energy_residual", "annotations.energy"),
    "visibility": (VISIBILITY, "annotations.visibility"),
}


def ranges(options: Any) -> dict[str, tuple[float, float]]:
    """The least and the largest value of each field that is asked for, by its stored name."""
    asked = {name: tuple(getattr(options, f"{end}_{name}") for end in ("min", "max")) for name in MEASURES}
    return {
        MEASURES[name][0]: (-np.inf if low is None else low, np.inf if high is None else high)
        for name, (low, high) in asked.items()
        if (low, high) != (None, None)
    }


def check(options: Any, enabled: Set[str]) -> None:
    """ValueError where a range holds nothing, or is of what is not stored; `enabled` names the options that are on."""
    for name, (_, needed) in MEASURES.items():
        low, high = (getattr(options, f"{end}_{name}") for end in ("min", "max"))
        if low is not None and high is not None and low > high:
            raise ValueError(f"min_{name} is {low:g}, but must be max_{name}, {high:g}, or less")
        if needed and (low, high) != (None, None) and needed not in enabled:
            raise ValueError(f"{'min' if high is None else 'max'}_{name} is asked for, but needs {needed}: true")
