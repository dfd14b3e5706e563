"""One lossless film per video: FFV1 in Matroska, encoded by PyAV, with a checksum in every frame.

The other fields of a video are in a NumPy archive beside its film, KEY.npz, as `--to npz` writes them.
"""

from functools import partial

from gen2d.plugin import Export, arrays, films

CODEC = films.CODECS["ffv1"]
EXPORT = Export(
    fields=("frames", "*"),
    write=partial(arrays.write_films, codec=CODEC),
    separate=True,
    check=partial(arrays.check_films, name="ffv1", codec=CODEC),
    loss=CODEC.loss,
)
