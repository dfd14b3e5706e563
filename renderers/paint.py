"""What a look gives for a video: what each slot is painted with, and what is behind everything. Colours are sRGB, 0 to
255 as floats; what a look leaves None does not exist and costs nothing.
"""

from typing import NamedTuple

from gen2d.records.axes import Array


class Texture(NamedTuple):
    """A pattern of procedural noise that sticks to what it is on."""

    seed: Array  # [...] uint32
    cell: Array  # [...] m, size of the coarsest spots
    color: Array  # [..., 3] of the brightest spots; the darkest have the colour of what it is on


class Background(NamedTuple):
    """Behind everything."""

    color: Array  # [3]
    to_color: Array | None = None  # [3] of a gradient's other end
    direction: Array | None = None  # rad, in which a gradient goes
    texture: Texture | None = None


class Paint(NamedTuple):
    """What a look gives for one video."""

    background: Background
    color: Array  # [K, 3]
    drawn: Array  # [K] bool
    grow: Array | None = None  # [K] px, beyond the object's own rim: the width of a line without one
    fill: Array | None = None  # [K, 3] of the inside, where that is not of the object's colour
    rim: Array | None = None  # [K] px, width of a line along the inside of the rim
    rim_color: Array | None = None  # [K, 3]
    mark: Array | None = None  # [K] half the width of a bar from the centre to the rim, over the way to the nearest rim
    mark_color: Array | None = None  # [K, 3]
    shade: Array | None = None  # [K] how much darker the rim is than the middle, 0 to 1
    texture: Texture | None = None  # of [K]
