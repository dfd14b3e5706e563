"""Looks, one per file and named like it. A config selects one by `look: NAME`, or `look: my/NAME.py`.

A file ends with a `LOOK`, whose members `gen2d.plugin.Look` describes. The smallest one:

    from gen2d.plugin import Look, PlainOptions, line_margin, plain

    def paint(scene, layout, options, key):
        base = plain(scene, layout, options, key)
        return base._replace(color=255 - base.color)

    LOOK = Look(options=PlainOptions, paint=paint, margin=line_margin)

To add options, declare a frozen dataclass `class Options(PlainOptions)` whose fields are made by `option`.
"""
