"""Plain shapes, each in one colour."""

import dataclasses

from gen2d.records.axes import Array
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene
from gen2d.renderers.look import PlainOptions, plain
from gen2d.renderers.paint import Paint


@dataclasses.dataclass(frozen=True)
class Options(PlainOptions):
    """What plain shapes have."""


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """What one video's slots are painted with."""
    return plain(scene, layout, options, key)
