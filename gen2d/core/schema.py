"""Stored fields: type, axes, unit and meaning, declared once for checks, files and dataset cards.

Axes are written as in the ground-truth table: ``n T K 2`` means video, frame, object slot, (x, y). A letter stands for
a length fixed by the dataset (`sizes` in its manifest), a number for itself. ``n`` stands for the videos and, where it
occurs, comes first. A field with the axes ``H W`` is an image and is stored compressed, by default in one chunk per
video. Text is UTF-8, zero-padded to a fixed number of bytes: 100 for the type ``S100``. Readers get it as NumPy bytes,
because neither torch nor jax has text arrays.
"""

import dataclasses
import re
from collections.abc import Mapping


@dataclasses.dataclass(frozen=True)
class Field:
    """A stored field."""

    dtype: str  # NumPy's name of the type
    axes: str
    unit: str
    meaning: str

    @property
    def per_video(self) -> bool:
        """Whether each video has its own value; `time`, for example, is shared by all videos."""
        return self.axes.split()[:1] == ["n"]

    @property
    def is_image(self) -> bool:
        """Whether the field is an image, stored compressed."""
        return "H" in self.axes.split()

    @property
    def is_text(self) -> bool:
        """Whether the field is text, stored as bytes."""
        return self.dtype.startswith("S")

    @property
    def codes(self) -> dict[int, str]:
        """Name of each code of a field of codes, as its meaning lists them; empty for other fields."""
        listed = re.search(r": (\d+ \w+(?:, \d+ \w+)*)$", self.meaning)
        return {int(code): name for code, name in map(str.split, listed[1].split(", "))} if listed else {}

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Shape of one video's value, without ``n``."""
        return tuple(int(axis) if axis.isdigit() else sizes[axis] for axis in self.axes.split() if axis != "n")
