"""Named palettes: colours of objects, walls and background that go together, with an English name for each.

The colours of a palette's objects and its ground are at least 20 apart in CIELAB (CIE 1976, D65).
"""

from typing import Any, NamedTuple

Color = tuple[int, int, int]  # sRGB


class Grain(NamedTuple):
    """Noise of a backdrop."""

    cell: float  # size of the coarsest spots along the x axis, over the shorter side of the scene
    stretch: float  # size along the y axis, over that along the x axis
    color: Color  # where the noise is 1


class Palette(NamedTuple):
    """Colours of a palette; names are unique within it."""

    ground: tuple[Color, Color, Color]  # of the background: top, bottom, and corners
    wall: tuple[str, Color]  # of static objects
    objects: dict[str, Color]  # of all other objects, by name
    light: Color = (255, 255, 255)
    grain: Grain | None = None


def palette_of(options: Any) -> Palette | None:
    """The palette that the options of a look name; None if they name none, or the look has no palettes."""
    return getattr(options, "named_palette", None)


def _color(digits: str) -> Color:
    red, green, blue = bytes.fromhex(digits)
    return red, green, blue


def _palette(
    ground: str,
    wall: str,
    wall_color: str,
    objects: dict[str, str],
    light: str = "ffffff",
    grain: tuple[float, float, str] | None = None,
) -> Palette:
    top, bottom, corners = map(_color, ground.split())
    colors = {name: _color(digits) for name, digits in objects.items()}
    own_grain = None if grain is None else Grain(*grain[:2], _color(grain[2]))
    return Palette((top, bottom, corners), (wall, _color(wall_color)), colors, _color(light), own_grain)


PALETTES = {
    "paper": _palette(
        "f7f1e3 efe4cf d8c7a5",
        "brown",
        "7a5c3e",
        {
            "red": "d1495b",
            "yellow": "edae49",
            "teal": "007f95",
            "blue": "2f68ad",
            "green": "6aa67e",
            "purple": "9467a8",
            "orange": "e8835a",
            "navy": "33354f",
        },
        light="fffaf0",
    ),
    "dusk": _palette(
        "8f6a58 544668 363450",
        "lilac",
        "9a87b8",
        {
            "red": "ff5d6c",
            "yellow": "ffd166",
            "emerald": "06d6a0",
            "sky blue": "4cc9f0",
            "orange": "f4923e",
            "violet": "c77dff",
            "olive": "8fb35a",
            "cream": "f4f1de",
        },
        light="ffe8d0",
    ),
    "lab": _palette(
        "dfe7ee c3d0db 9fb2c1",
        "slate",
        "66798a",
        {
            "red": "e63946",
            "orange": "f2994a",
            "teal": "2a9d8f",
            "navy": "23404d",
            "yellow": "efd35a",
            "green": "8ab17d",
            "blue": "3f78a8",
            "pink": "b5838d",
        },
    ),
    "chalkboard": _palette(
        "35524a 2c463f 1d302b",
        "wood",
        "a97c50",
        {
            "white": "f2f0e6",
            "yellow": "f2d95c",
            "pink": "f08fa8",
            "sky blue": "7fc4ea",
            "mint": "8fe0b0",
            "orange": "f0914a",
            "lilac": "b9a0e8",
            "red": "e2574c",
        },
        light="fffdf4",
        grain=(0.3, 0.3, "44635a"),
    ),
    "grass": _palette(
        "7fae54 6a9a45 4d7a34",
        "brown",
        "6b4a2f",
        {
            "white": "f7f5ee",
            "red": "d43d3d",
            "yellow": "f7dc4a",
            "blue": "2b5fb8",
            "orange": "f08a2c",
            "purple": "7d3f98",
            "pink": "f2a3c0",
            "navy": "232a4d",
        },
        light="fffbe6",
        grain=(0.035, 4.0, "55843a"),
    ),
    # Distinguishable with any colour vision (M. Okabe, K. Ito, 'Color Universal Design', 2008).
    "okabe_ito": _palette(
        "f6f6f6 ececec d4d4d4",
        "grey",
        "6a6a6a",
        {
            "black": "000000",
            "orange": "e69f00",
            "sky blue": "56b4e9",
            "green": "009e73",
            "yellow": "f0e442",
            "blue": "0072b2",
            "vermilion": "d55e00",
            "pink": "cc79a7",
        },
    ),
    "grey": _palette(
        "fcfcfc f7f7f7 efefef",
        "mid-grey",
        "929292",
        {"black": "101010", "dark grey": "424242", "grey": "787878", "light grey": "b2b2b2"},
    ),
}

NAME_BYTES = max(len(name) for palette in PALETTES.values() for name in (*palette.objects, palette.wall[0]))
