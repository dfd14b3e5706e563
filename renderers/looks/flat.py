"""Plain shapes, each in one colour."""

import dataclasses

from gen2d.plugin import LINES, Array, Layout, Look, Paint, PlainOptions, Scene, line_margin, plain


@dataclasses.dataclass(frozen=True)
class Options(PlainOptions):
    """Options of plain shapes."""


def paint(scene: Scene, layout: Layout, options: Options, key: Array) -> Paint:
    """Paint of one video: one colour per slot."""
    return plain(scene, layout, options, key)


LOOK = Look(options=Options, paint=paint, margin=line_margin, grown=LINES)
