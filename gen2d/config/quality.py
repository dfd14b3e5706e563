"""The section `quality`: accepted ranges of the videos' quality measures."""

from collections.abc import Set
from typing import Any

import numpy as np

VISIBILITY = "quality/min_visibility"  # the only measure that needs rendering
# For each measure (options min_NAME and max_NAME): its stored field, and the option that switches the field on.
MEASURES = {
    "contacts": ("quality/contacts", ""),
    "penetration": ("quality/max_penetration", ""),
    "lyapunov": ("quality/lyapunov", "annotations.lyapunov"),
    "energy_residual": ("quality/energy_residual", "annotations.energy"),
    "visibility": (VISIBILITY, "annotations.visibility"),
}


def ranges(options: Any) -> dict[str, tuple[float, float]]:
    """Accepted interval (low, high) of each restricted measure, by its stored field."""
    limits = {name: tuple(getattr(options, f"{end}_{name}") for end in ("min", "max")) for name in MEASURES}
    return {
        MEASURES[name][0]: (-np.inf if low is None else low, np.inf if high is None else high)
        for name, (low, high) in limits.items()
        if (low, high) != (None, None)
    }


def check(options: Any, enabled: Set[str]) -> None:
    """Raise ValueError if a range is empty or its measure is not stored. `enabled` names the options that are on."""
    for name, (_, needed) in MEASURES.items():
        low, high = (getattr(options, f"{end}_{name}") for end in ("min", "max"))
        if low is not None and high is not None and low > high:
            raise ValueError(f"min_{name} is {low:g}, but must be max_{name}, {high:g}, or less")
        if needed and (low, high) != (None, None) and needed not in enabled:
            raise ValueError(f"{'min' if high is None else 'max'}_{name} is asked for, but needs {needed}: true")
