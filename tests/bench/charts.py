"""Charts of costs, both axes in logarithms, for the benchmark: drawn four times as large and then made smaller, which
smooths text and lines."""

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

# In pixels.
WIDTH, HEIGHT, ZOOM = 640, 420, 4
LEFT, RIGHT, TOP, BOTTOM = 74, 18, 40, 52
INK, FAINT, GRID = (51, 51, 51), (153, 153, 153), (238, 238, 238)  # blue, green, red, as cv2 has it
Color = Sequence[int]
Point = tuple[float, float]


class Chart:
    """A picture in the making: costs from `low` to `high` against numbers from `first` to `last`."""

    def __init__(self, first: float, last: float, low: float, high: float) -> None:
        self.first, self.last, self.low, self.high = first, last, low, high
        self.image = np.full((HEIGHT * ZOOM, WIDTH * ZOOM, 3), 255, np.uint8)

    def place(self, number: float, cost: float) -> Point:
        """Where in the picture a cost stands."""
        x = math.log(number / self.first) / math.log(self.last / self.first)
        y = math.log(cost / self.low) / math.log(self.high / self.low)
        return LEFT + x * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - y * (HEIGHT - TOP - BOTTOM)

    def grid(self, numbers: Sequence[int]) -> None:
        """Lines for costs of one digit, and for these numbers."""
        for power in range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))):
            for cost in (k * 10.0**power for k in range(1, 10)):
                if self.low < cost < self.high:
                    ends, whole = (self.place(self.first, cost), self.place(self.last, cost)), cost == 10.0**power
                    self.line(ends, GRID, 1 if whole else 0.5)
                    self.text(f"{cost:g}" if whole else "", (LEFT - 8, ends[0][1] + 4), align=1)
        for number in numbers:
            self.line((self.place(number, self.low), self.place(number, self.high)), GRID, 1)
            self.text(str(number), (self.place(number, self.low)[0], HEIGHT - BOTTOM + 18), align=0.5)

    def line(self, points: Sequence[Point], color: Color, width: float) -> None:
        at = np.rint(np.array(points) * ZOOM).astype(np.int32)
        cv2.polylines(self.image, [at], False, color, round(width * ZOOM), cv2.LINE_AA)

    def dot(self, at: Point, color: Color) -> None:
        cv2.circle(self.image, (round(at[0] * ZOOM), round(at[1] * ZOOM)), 4 * ZOOM, color, -1, cv2.LINE_AA)

    def text(self, text: str, at: Point, align: float = 0, size: float = 0.42) -> None:
        """Writes with its baseline there, to the right (align 0), around (0.5) or to the left (1)."""
        _write(self.image, text, at, align, size)

    def legend(self, rows: Sequence[tuple[str, Color, float]], width: int, dots: bool) -> None:
        """What the lines are: name, colour and width of each."""
        self.image[(TOP + 4) * ZOOM : (TOP + 10 + 18 * len(rows)) * ZOOM, (LEFT + 8) * ZOOM : width * ZOOM] = 255
        for i, (name, color, thick) in enumerate(rows):
            y = TOP + 16 + 18 * i
            self.line([(LEFT + 14, y), (LEFT + 42, y)], color, thick)
            if dots and thick > 1:
                self.dot((LEFT + 28, y), color)
            self.text(name, (LEFT + 50, y + 4))

    def axes(self) -> None:
        self.line([(LEFT, TOP), (LEFT, HEIGHT - BOTTOM), (WIDTH - RIGHT, HEIGHT - BOTTOM)], INK, 1)

    def save(self, path: Path, title: str, across: str, upwards: str) -> None:
        """Returns nothing; writes the chart with its title and what its axes are as a PNG file."""
        self.text(title, (LEFT, 24), size=0.52)
        self.text(across, (LEFT + (WIDTH - LEFT - RIGHT) / 2, HEIGHT - 12), align=0.5)
        side = np.ascontiguousarray(cv2.rotate(self.image, cv2.ROTATE_90_CLOCKWISE))  # so that the text runs upwards
        _write(side, upwards, (TOP + (HEIGHT - TOP - BOTTOM) / 2 + BOTTOM - TOP, 20), align=0.5)
        image = cv2.rotate(side, cv2.ROTATE_90_COUNTERCLOCKWISE)
        small = np.asarray(cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)
        cv2.imwrite(str(path), small // 17 * 17, [cv2.IMWRITE_PNG_COMPRESSION, 9])  # fewer shades make a smaller file


def _write(image: np.ndarray, text: str, at: Point, align: float = 0, size: float = 0.42) -> None:
    font, scale, thick = cv2.FONT_HERSHEY_SIMPLEX, size * ZOOM, ZOOM
    (width, _), _ = cv2.getTextSize(text, font, scale, thick)
    place = round(at[0] * ZOOM - align * width), round(at[1] * ZOOM)
    cv2.putText(image, text, place, font, scale, INK, thick, cv2.LINE_AA)
