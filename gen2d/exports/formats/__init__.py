"""Formats of other programs: one file each, named like the format: `--to NAME`, or `--to my/NAME.py`.

A file ends with an `EXPORT`, whose members `gen2d.plugin.Export` describes. The smallest one:

    import numpy as np
    from gen2d.plugin import Export

    def write(target, source):
        for number, video in enumerate(source.videos()):
            np.save(target / f"{source.key(number)}.npy", video["frames"])
            source.advance(1)

    EXPORT = Export(fields=("frames",), write=write, fixed=True)

`source.each(one)` calls `one(key, video)` for every video in several threads, and counts them itself.
"""

import pkgutil


def names() -> list[str]:
    """The names of the formats."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))
