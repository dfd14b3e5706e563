"""Looks: one file each, named like the look; a config asks for one by `look: NAME`, or `look: my/NAME.py`.

A file ends with a `LOOK`, whose members `gen2d.plugin.Look` describes. The smallest one:

    from gen2d.plugin import Look, PlainOptions, line_margin, plain

    def paint(scene, layout, options, key):
        begun = plain(scene, layout, options, key)
        return begun._replace(color=255 - begun.color)

    LOOK = Look(options=PlainOptions, paint=paint, margin=line_margin)

Options of its own are those of a frozen dataclass, `class Options(PlainOptions)`, whose fields `option` makes.
"""
