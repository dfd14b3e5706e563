"""Formats of other programs, one file each: `--to NAME` selects NAME.py in this folder, `--to my/NAME.py` any file.

Each file ends with an `EXPORT`; `gen2d.plugin.Export` describes its members. The smallest example:

    import numpy as np
    from gen2d.plugin import Export

    def write(target, source):
        for number, video in enumerate(source.videos()):
            np.save(target / f"{source.key(number)}.npy", video["frames"])
            source.advance(1)

    EXPORT = Export(fields=("frames",), write=write, fixed=True)

`source.each(function)` calls `function(key, video)` for every video in several threads, and reports the progress.
`source.map(function)` gives the results in the order of the videos. With `separate=True`, `write` is called for parts
of the videos, so that a stopped export goes on.
"""
