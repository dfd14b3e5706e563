"""One MPEG-4 part 2 film (MP4) per video, encoded by PyAV, for old programs; browsers do not play it.

The other fields of a video are in a NumPy archive beside its film, KEY.npz, as `--to npz` writes them.
"""

from functools import partial

from gen2d.plugin import Export, arrays, films

CODEC = films.CODECS["mp4v"]
EXPORT = Export(
    fields=("frames", "*"),
    write=partial(arrays.write_films, codec=CODEC),
    separate=True,
    check=partial(arrays.check_films, name="mp4", codec=CODEC),
    loss=CODEC.loss,
)
