"""Paint: the result of a look for one video.

Colours are sRGB from 0 to 255 in floats. A part that is None is not rendered and costs nothing.
"""

from typing import NamedTuple

from gen2d.records.axes import Array


class Texture(NamedTuple):
    """Procedural noise that is fixed to an object or to the background."""

    seed: Array  # [...] uint32
    cell: Array  # [...] m, size of the coarsest spots
    color: Array  # [..., 3] where the noise is 1; where it is 0 the base colour shows


class Background(NamedTuple):
    """Background: a colour, a gradient, or noise."""

    color: Array  # [3]
    to_color: Array | None = None  # [3] at the end of a gradient
    direction: Array | None = None  # rad, of a gradient, from `color` to `to_color`
    texture: Texture | None = None


class Paint(NamedTuple):
    """Paint of one video's slots and background."""

    background: Background
    color: Array  # [K, 3]
    drawn: Array  # [K] bool, whether the slot is rendered
    grow: Array | None = None  # [K] px, added to the object's radius: half a line's width
    fill: Array | None = None  # [K, 3] of the interior, instead of `color`
    rim: Array | None = None  # [K] px, width of a line along the inside of the rim
    rim_color: Array | None = None  # [K, 3]
    mark: Array | None = None  # [K] half width of a bar from centre to rim, over the distance of the nearest rim
    mark_color: Array | None = None  # [K, 3]
    shade: Array | None = None  # [K] relative darkening opposite the light, 0 to 1
    texture: Texture | None = None  # arrays [K, ...]
