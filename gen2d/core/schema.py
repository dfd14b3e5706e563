"""What a stored field is: its type, axes, unit and meaning, said once and read by the checks, the files and the cards.

Axes are written as in the ground-truth table: ``n T K 2`` is video, frame, object slot, (x, y). A letter stands for a
size that the dataset fixes (`sizes` in its manifest), a number for itself, and ``n`` for the videos, always first
where it occurs. A field whose axes hold ``H W`` is an image: it is stored compressed, one chunk a video. Text is UTF-8
in a fixed number of bytes, padded with zeros: type ``S100`` holds 100 of them. It is never more than NumPy's bytes, as
neither torch nor jax has arrays of text.
"""

import dataclasses
from collections.abc import Mapping


@dataclasses.dataclass(frozen=True)
class Field:
    """One stored field."""

    dtype: str  # NumPy's name for it
    axes: str
    unit: str
    meaning: str

    @property
    def per_video(self) -> bool:
        """Whether each video has its own value (`time` is one for all)."""
        return self.axes.split()[:1] == ["n"]

    @property
    def is_image(self) -> bool:
        """Whether it is stored compressed, one chunk a video."""
        return "H" in self.axes.split()

    @property
    def is_text(self) -> bool:
        """Whether it is text, in bytes."""
        return self.dtype.startswith("S")

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """The shape of one video's value, without ``n``."""
        return tuple(int(axis) if axis.isdigit() else sizes[axis] for axis in self.axes.split() if axis != "n")
