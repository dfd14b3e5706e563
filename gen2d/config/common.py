"""Options shared by scene families, with the same unit and range in each.

    density: Distribution = common.density("each ball", each="balls")

`of` names the object and completes the meaning: 'density of each ball'. With `each`, the number is sampled once per
object of that plural; without it, once per video. Defaults are written as in a config.
"""

from collections.abc import Sequence
from typing import Any

from gen2d.config.distributions import Distribution
from gen2d.config.options import option

BRIGHT = ([90, 254],) * 3  # sRGB: colors that stand out from a dark background


def count(unit: str, default: Any, meaning: str = "", *, low: int = 1, high: int = 64) -> Distribution:
    """Number of objects; the unit is their plural."""
    return option(default, int, unit, meaning or f"number of {unit} in a video", low=low, high=high, draw=True)


def size(meaning: str, default: float) -> float:
    """Length of the view or the box, m; the same in every video."""
    return option(default, float, "m", meaning, above=0, high=1000)


def length(
    meaning: str, default: Any, *, each: str = "", low: float | None = 0, high: float | None = None
) -> Distribution:
    """Length, m."""
    return option(default, float, "m", meaning, low=low, high=high, draw=True, each=each)


def radius(of: str, default: Any, *, each: str = "", low: float = 1e-3, high: float | None = None) -> Distribution:
    """Radius, m."""
    return length(f"radius of {of}", default, each=each, low=low, high=high)


def density(of: str, default: Any = 1.0, *, each: str = "") -> Distribution:
    """Density (mass per area), kg/m^2."""
    return option(default, float, "kg/m^2", f"density of {of}", low=1e-6, high=1e6, draw=True, each=each)


def elasticity(of: str, default: Any, *, each: str = "") -> Distribution:
    """Coefficient of restitution."""
    return option(default, float, "1", f"coefficient of restitution of {of}", low=0, high=1, draw=True, each=each)


def friction(of: str, default: Any, *, each: str = "") -> Distribution:
    """Coefficient of friction."""
    return option(default, float, "1", f"coefficient of friction of {of}", low=0, high=100, draw=True, each=each)


def speed(of: str, default: Any, *, each: str = "", high: float | None = None) -> Distribution:
    """Initial speed, m/s."""
    return option(default, float, "m/s", f"speed of {of}", low=0, high=high, draw=True, each=each)


def spin(of: str, default: Any = 0.0, *, each: str = "") -> Distribution:
    """Initial angular velocity, rad/s."""
    return option(default, float, "rad/s", f"spin of {of}", draw=True, each=each)


def angle(
    meaning: str, default: Any, *, each: str = "", low: float | None = None, high: float | None = None
) -> Distribution:
    """Angle, rad."""
    return option(default, float, "rad", meaning, low=low, high=high, draw=True, each=each)


def fraction(meaning: str, default: Any = (0, 1), *, each: str = "") -> Distribution:
    """Number from 0 to 1."""
    return option(list(default), float, "1", meaning, low=0, high=1, draw=True, each=each)


def fractions(meaning: str, *, each: str = "") -> tuple[Distribution, ...]:
    """Two uniform numbers from 0 to 1, horizontal and vertical."""
    return option([[0, 1], [0, 1]], float, "1", meaning, parts=2, low=0, high=1, draw=True, each=each)


def position(of: str) -> tuple[Distribution, ...]:
    """Position in the view, relative to the positions possible there."""
    return fractions(f"position of {of} among those possible; 0, 0: lowest and leftmost")


def gravity(default: Sequence[Any] = (0, -9.8)) -> tuple[Distribution, ...]:
    """Acceleration of gravity (x right, y up), m/s^2."""
    return option(default, float, "m/s^2", "acceleration of gravity; x right, y up", parts=2, draw=True)


def color(of: str, default: Sequence[Any] = BRIGHT, *, each: str = "") -> tuple[Distribution, ...]:
    """sRGB color."""
    return option(default, int, "sRGB", f"color of {of}", parts=3, low=0, high=255, draw=True, each=each)
