"""Drawing for people: labels, colours from hue and saturation, and anti-aliased polygons, discs and lines."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gen2d.core.palettes import Color

FONT = 12  # px, size of labels
LINE = 17  # px, from one line of a label to the next
LEFT, TOP = 4, 10  # px, of the first line
CORNERS = 64  # of the polygons that stand for discs
FINEST, LARGEST = 4, 4096  # samples per pixel along each axis, of a picture of up to so many samples a side


def label(lines: Sequence[str], height: int, width: int) -> np.ndarray:
    """White strip [height, width, 3], uint8, with black lines of text from its top."""
    strip = Image.new("RGB", (width, height), "white")
    draw, font = ImageDraw.Draw(strip), ImageFont.load_default(FONT)
    for place, line in enumerate(lines):
        draw.text((LEFT, TOP + LINE * place), line, (0, 0, 0), font)
    return np.array(strip)


def rgb_of(hue: np.ndarray, saturation: np.ndarray | float, value: float = 1.0) -> np.ndarray:
    """Colours [..., 3], uint8 sRGB, of hues in degrees, and of saturations and a value (HSV) from 0 to 1."""
    sector = (np.asarray(hue)[..., None] / 60 + (5, 3, 1)) % 6
    distance = np.clip(np.minimum(sector, 4 - sector), 0, 1)
    return np.rint(255 * value * (1 - np.asarray(saturation)[..., None] * distance)).astype(np.uint8)


class Canvas:
    """White picture [height, width, 3] on which convex shapes are drawn, one over the other.

    Coordinates are in px, x to the right and y down, and 0, 0 is the picture's corner. Shapes may reach beyond it. They
    are about a twelfth of a pixel larger on each side, as Pillow also paints samples that an edge passes through.
    """

    def __init__(self, height: int, width: int) -> None:
        self._factor = max(1, min(FINEST, LARGEST // max(height, width)))
        self._image = Image.new("RGB", (width * self._factor, height * self._factor), "white")
        self._draw = ImageDraw.Draw(self._image)

    @property
    def image(self) -> np.ndarray:
        """The picture [H, W, 3], uint8."""
        return np.array(self._image.reduce(self._factor))

    def polygon(self, points: np.ndarray, color: Color) -> None:
        """Fill a polygon with these corners [V, 2]."""
        samples = np.clip(np.asarray(points, float) * self._factor, -(2.0**24), 2.0**24)
        self._draw.polygon([(x, y) for x, y in samples.tolist()], color)

    def disc(self, center: np.ndarray, radius: float, color: Color) -> None:
        """Fill a disc."""
        self.line(center, center, 2 * radius, color)

    def line(self, a: np.ndarray, b: np.ndarray, thickness: float, color: Color) -> None:
        """Fill a line with round ends."""
        a, b = np.asarray(a, float), np.asarray(b, float)
        along = np.arctan2(*(b - a)[::-1])
        turn = along + np.pi / 2 + np.linspace(0, np.pi, CORNERS // 2)
        cap = thickness / 2 * np.stack([np.cos(turn), np.sin(turn)], -1)
        self.polygon(np.concatenate([a + cap, b - cap]), color)

    def outline(self, points: np.ndarray, thickness: float, color: Color) -> None:
        """Draw the closed line through these points [V, 2]."""
        for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
            self.line(a, b, thickness, color)
