"""Plain shapes, each in one colour."""

import dataclasses

from gen2d.looks import Plain, plain
from gen2d.paint import Paint
from gen2d.types import Array, Layout, Scene


@dataclasses.dataclass(frozen=True)
class Options(Plain):
    """What plain shapes have."""


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """What one video's slots are painted with."""
    return plain(scene, layout, options, key)
