"""Options that scene families have in common, with the same unit and range in each.

    density: Distribution = common.density("each ball", each="balls")

`of` says whose option it is and completes the meaning: 'density of each ball'. `each` names the objects of which each
has a draw of its own; without it, there is one draw a video. Defaults are written as in a config.
"""

from collections.abc import Sequence
from typing import Any

from gen2d.config.distributions import Distribution
from gen2d.config.options import option

BRIGHT = ([90, 254],) * 3  # sRGB: colors that stand out from a dark background


def count(unit: str, default: Any, meaning: str = "", *, low: int = 1, high: int = 64) -> Distribution:
    """A number of objects; its unit is their plural."""
    return option(default, int, unit, meaning or f"number of {unit} in a video", low=low, high=high, draw=True)


def size(meaning: str, default: float) -> float:
    """A fixed length of the view or the box, m."""
    return option(default, float, "m", meaning, above=0, high=1000)


def length(
    meaning: str, default: Any, *, each: str = "", low: float | None = 0, high: float | None = None
) -> Distribution:
    """A length, m."""
    return option(default, float, "m", meaning, low=low, high=high, draw=True, each=each)


def radius(of: str, default: Any, *, each: str = "", low: float = 1e-3, high: float | None = None) -> Distribution:
    """A radius, m."""
    return length(f"radius of {of}", default, each=each, low=low, high=high)


def density(of: str, default: Any = 1.0, *, each: str = "") -> Distribution:
    """A mass per area, kg/m^2."""
    return option(default, float, "kg/m^2", f"density of {of}", low=1e-6, high=1e6, draw=True, each=each)


def elasticity(of: str, default: Any, *, each: str = "") -> Distribution:
    """A coefficient of restitution."""
    return option(default, float, "1", f"coefficient of restitution of {of}", low=0, high=1, draw=True, each=each)


def friction(of: str, default: Any, *, each: str = "") -> Distribution:
    """A coefficient of friction."""
    return option(default, float, "1", f"coefficient of friction of {of}", low=0, high=100, draw=True, each=each)


def speed(of: str, default: Any, *, each: str = "", high: float | None = None) -> Distribution:
    """A speed at the start, m/s."""
    return option(default, float, "m/s", f"speed of {of}", low=0, high=high, draw=True, each=each)


def spin(of: str, default: Any = 0.0, *, each: str = "") -> Distribution:
    """An angular velocity at the start, rad/s."""
    return option(default, float, "rad/s", f"spin of {of}", draw=True, each=each)


def angle(
    meaning: str, default: Any, *, each: str = "", low: float | None = None, high: float | None = None
) -> Distribution:
    """An angle, rad."""
    return option(default, float, "rad", meaning, low=low, high=high, draw=True, each=each)


def fraction(meaning: str, default: Any = (0, 1), *, each: str = "") -> Distribution:
    """A number from 0 to 1."""
    return option(list(default), float, "1", meaning, low=0, high=1, draw=True, each=each)


def fractions(meaning: str, *, each: str = "") -> tuple[Distribution, ...]:
    """Two numbers from 0 to 1, across and up, uniformly distributed."""
    return option([[0, 1], [0, 1]], float, "1", meaning, parts=2, low=0, high=1, draw=True, each=each)


def position(of: str) -> tuple[Distribution, ...]:
    """A position in the view, relative to what is possible."""
    return fractions(f"position of {of} among those possible; 0, 0: lowest and leftmost")


def gravity(default: Sequence[Any] = (0, -9.8)) -> tuple[Distribution, ...]:
    """The acceleration of gravity, m/s^2."""
    return option(default, float, "m/s^2", "acceleration of gravity; x right, y up", parts=2, draw=True)


def color(of: str, default: Sequence[Any] = BRIGHT, *, each: str = "") -> tuple[Distribution, ...]:
    """An sRGB color."""
    return option(default, int, "sRGB", f"color of {of}", parts=3, low=0, high=255, draw=True, each=each)
