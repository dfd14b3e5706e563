"""A film per video that loses nothing: FFV1 in Matroska by PyAV, with a checksum in every frame."""

from pathlib import Path

from gen2d.plugin import Export, Source, films

FASTEST = 1000  # frames/s: Matroska tells times in milliseconds
PIXELS = "bgr0"  # the stored bytes in another order; any form of YUV would round them
OPTIONS = {"level": "3", "coder": "1", "context": "1", "slicecrc": "1"}


def check(source: Source) -> None:
    """ConfigError for rates that it cannot have, UserError without PyAV."""
    films.check_rate("ffv1", source.fps, FASTEST)
    films.pyav()


def write(target: Path, source: Source) -> None:
    """Fills the folder with KEY.mkv."""

    def one(key: str, video: dict) -> None:
        films.encode(target / f"{key}.mkv", video["frames"], source.fps, "ffv1", PIXELS, OPTIONS)

    source.each(one)


EXPORT = Export(fields=("frames",), write=write, check=check, fixed=True)
