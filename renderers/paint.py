"""Paint: the result of a look for one video.

Colours are sRGB from 0 to 255 in floats. A part that is None is not rendered and costs nothing.
"""

from typing import NamedTuple

from gen2d.records.axes import Array

NO_MATERIAL = 255  # of slots without an object, and of looks without materials


class Texture(NamedTuple):
    """Procedural noise that is fixed to an object or to the background."""

    seed: Array  # [...] uint32
    cell: Array  # [...] m, size of the coarsest spots
    color: Array  # [..., 3] where the noise is 1; where it is 0 the base colour shows
    stretch: Array | None = None  # [...] size along the y axis, over that along the x axis


class Light(NamedTuple):
    """Directional light, fixed to the world, and ambient light from above."""

    direction: Array  # [..., 3] towards the light: x right, y up, z towards the viewer; of length 1
    softness: Array  # [...] width of the transition from light to dark, as a cosine
    ambient: Array  # [...] part of the light on a surface that faces the viewer
    highlight: Array  # [..., 3] colour of highlights


class Surface(NamedTuple):
    """Relief and material of objects that are lit by a `Light`; arrays [K], of occluders []."""

    slope: Array  # [K] sine of the steepest tilt, at the rim; 0: flat
    bevel: Array  # [K] m, width of the sloping border of polygons; discs, capsules and segments are domes
    gloss: Array  # [K] strength of the highlight
    sharpness: Array  # [K] exponent of the highlight (J. Blinn, 1977)
    stripe: Array | None = None  # [K] half width of a band along the x axis of discs, over the radius; 0: none
    stripe_light: Array | None = None  # [K] 1: in the colour of highlights; -a: darker by the part a
    pattern: "Pattern | None" = None
    mirror: Array | None = None  # [K] part of the light that is a reflection of the room, as of metal; 0: none


class Pattern(NamedTuple):
    """Noise on the surfaces of objects, stretched along their x axes: grain, fibres, brush strokes."""

    seed: Array  # [K] uint32
    cell: Array  # [K] m, size of the coarsest spots along the y axis
    stretch: Array  # [K] size along the x axis, over that along the y axis
    contrast: Array  # [K] relative change of the reflected light; 0: none


class Shadow(NamedTuple):
    """Shadows of objects on everything behind them."""

    offset: Array  # [2] m, of a shadow from its object
    blur: Array  # [] m, half the width of its soft edge; at most `Look.blur` says
    opacity: Array  # []
    color: Array  # [3]


class Picture(NamedTuple):
    """Crop of one of the user's images. A look chooses it, the host decodes it."""

    number: Array  # [] of the image
    corner: Array  # [2] place of the crop, from 0, at the left and the top, to 1
    extent: Array  # [] size of the crop, over that of the largest
    pixels: Array | None = None  # [H, W, 3] uint8; None before it is decoded


class Background(NamedTuple):
    """Background: a colour, a gradient, noise or a picture; `corners` are other colours towards the view's corners."""

    color: Array  # [3]
    to_color: Array | None = None  # [3] at the end of a gradient
    direction: Array | None = None  # rad, of a gradient, from `color` to `to_color`
    texture: Texture | None = None
    corners: Array | None = None  # [3] at the corners of the view of the first frame
    picture: Picture | None = None  # instead of all others; fixed to the frame


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
    light: Light | None = None  # lights `surface`
    surface: Surface | None = None
    shadow: Shadow | None = None
    screen: Surface | None = None  # [] each, of occluders
    material: Array | None = None  # [K] int, index into `materials` of the look's options, stored as `objects/material`
    sampled: dict[str, Array] | None = None  # [] each, values of the look's sampled options, stored as `look/NAME`
