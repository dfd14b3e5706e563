"""English words for colours: the nearest of a list in CIELAB, and no word where none is near."""

from collections.abc import Mapping

import numpy as np

NEAR, NEAR_PER_CHROMA = 10.0, 0.11  # CIELAB; a word is used up to this distance, as grey stops being grey sooner
DISTINCT = 15.0  # CIELAB; colours that are nearer to each other than this do not tell objects apart

# Words and their typical colours, sRGB. Lighter and darker kinds of a hue are named where English has a common word.
COLORS = {
    "red": (214, 32, 38),
    "dark red": (128, 16, 22),
    "crimson": (196, 22, 72),
    "raspberry": (172, 32, 108),
    "rose": (222, 78, 116),
    "brick red": (170, 66, 52),
    "coral": (250, 112, 92),
    "salmon": (248, 152, 128),
    "peach": (252, 202, 164),
    "pink": (250, 152, 192),
    "pale pink": (246, 206, 216),
    "dusty pink": (206, 140, 148),
    "hot pink": (246, 50, 142),
    "magenta": (214, 32, 176),
    "bright magenta": (234, 46, 240),
    "orchid": (214, 104, 206),
    "orange": (246, 132, 24),
    "rust": (184, 84, 32),
    "brown": (122, 74, 38),
    "dark brown": (66, 42, 28),
    "reddish brown": (128, 58, 46),
    "tan": (206, 168, 122),
    "beige": (226, 210, 180),
    "khaki": (188, 178, 112),
    "cream": (252, 244, 214),
    "gold": (218, 168, 36),
    "mustard": (190, 150, 32),
    "yellow": (246, 226, 44),
    "pale yellow": (246, 240, 150),
    "yellow-green": (182, 218, 50),
    "lime green": (122, 234, 50),
    "olive": (118, 116, 38),
    "olive green": (92, 110, 48),
    "green": (44, 158, 58),
    "bright green": (48, 226, 66),
    "light green": (144, 224, 130),
    "pale green": (194, 238, 186),
    "dark green": (22, 78, 38),
    "sage green": (140, 166, 118),
    "forest green": (48, 104, 60),
    "grass green": (98, 168, 42),
    "grey-green": (98, 128, 108),
    "mint": (122, 236, 186),
    "spring green": (48, 240, 150),
    "sea green": (54, 160, 122),
    "teal": (24, 122, 122),
    "turquoise": (56, 206, 192),
    "cyan": (60, 222, 238),
    "pale turquoise": (176, 232, 228),
    "light blue": (166, 204, 240),
    "sky blue": (96, 178, 232),
    "blue": (38, 84, 220),
    "steel blue": (72, 124, 168),
    "cornflower blue": (104, 144, 236),
    "bright blue": (52, 56, 250),
    "dark blue": (28, 44, 116),
    "navy": (18, 26, 68),
    "slate blue": (104, 94, 190),
    "indigo": (72, 30, 138),
    "periwinkle": (142, 142, 248),
    "violet": (140, 58, 232),
    "light violet": (176, 122, 244),
    "purple": (122, 42, 152),
    "dark purple": (62, 26, 76),
    "plum": (122, 44, 92),
    "wine red": (104, 28, 54),
    "greyish purple": (124, 108, 142),
    "lavender": (206, 186, 238),
    "lilac": (196, 154, 206),
    "light brown": (164, 114, 76),
    "greyish brown": (122, 100, 88),
    "mauve": (152, 104, 140),
    "light olive": (180, 190, 86),
    "greyish cyan": (92, 162, 182),
    "soft purple": (190, 118, 188),
    "apricot": (224, 160, 84),
    "pale teal": (164, 200, 188),
    "dusty blue": (112, 138, 200),
    "soft green": (132, 190, 120),
    "grape": (104, 66, 138),
    "dusky rose": (192, 104, 134),
    "pinkish grey": (188, 162, 162),
    "soft teal": (86, 174, 164),
    "dusky purple": (86, 70, 108),
    "slate grey": (72, 100, 104),
    "leaf green": (86, 158, 94),
    "pine green": (62, 88, 64),
    "emerald green": (46, 200, 84),
    "coral pink": (236, 110, 116),
    "dull brown": (96, 64, 60),
    "clay": (200, 132, 116),
    "stone grey": (172, 164, 142),
    "white": (250, 250, 250),
    "light grey": (202, 202, 204),
    "grey": (132, 132, 134),
    "blue-grey": (112, 130, 152),
    "dark grey": (72, 72, 76),
    "black": (18, 18, 20),
}

# sRGB (IEC 61966-2-1) to XYZ for D65, divided by the white point.
_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_TO_XYZ /= _TO_XYZ.sum(1, keepdims=True)


def cielab(color: np.ndarray) -> np.ndarray:
    """CIELAB (CIE 1976, D65) coordinates [..., 3] of sRGB colours [..., 3] from 0 to 255."""
    encoded = np.asarray(color, float) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    xyz = linear @ _TO_XYZ.T
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


_WORDS, _LAB = tuple(COLORS), cielab(np.array(list(COLORS.values())))
_NEAR = NEAR + NEAR_PER_CHROMA * np.linalg.norm(_LAB[:, 1:], axis=-1)


def nearest_word(color: np.ndarray) -> str:
    """Word of the nearest colour of the list; "" if none is near."""
    distance = np.linalg.norm(_LAB - cielab(color), axis=-1)
    nearest = int(distance.argmin())
    return _WORDS[nearest] if distance[nearest] <= _NEAR[nearest] else ""


def color_word(columns: Mapping[str, np.ndarray], slot: int) -> str:
    """Word for an object's colour: its stored name (`objects/color_name`), or else the nearest word; "" if none."""
    stored = bytes(columns["objects/color_name"][slot]).decode() if "objects/color_name" in columns else ""
    return stored or nearest_word(columns["objects/color"][slot])
