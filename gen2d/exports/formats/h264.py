"""One H.264 film (MP4) per video, encoded by PyAV; browsers play it.

The other fields of a video are in a NumPy archive beside its film, KEY.npz, as `--to npz` writes them.
"""

from functools import partial

from gen2d.plugin import Export, arrays, films

CODEC = films.CODECS["h264"]
EXPORT = Export(
    fields=("frames", "*"),
    write=partial(arrays.write_films, codec=CODEC),
    separate=True,
    check=partial(arrays.check_films, name="h264", codec=CODEC),
    loss=CODEC.loss,
)
