"""One lossless film per video: FFV1 in Matroska, encoded by PyAV, with a checksum in every frame."""

from pathlib import Path

from gen2d.plugin import Export, Source, films

FASTEST = 1000  # frames/s; Matroska stores times in milliseconds
PIXELS = "bgr0"  # the stored bytes in another order; every YUV format would round them
OPTIONS = {"level": "3", "coder": "1", "context": "1", "slicecrc": "1"}


def check(source: Source) -> None:
    """Raise ConfigError for unsupported frame rates, UserError without PyAV."""
    films.check_rate("ffv1", source.fps, FASTEST)
    films.pyav()


def write(target: Path, source: Source) -> None:
    """Write KEY.mkv for each video to the folder."""

    def write_film(key: str, video: dict) -> None:
        films.encode(target / f"{key}.mkv", video["frames"], source.fps, "ffv1", PIXELS, OPTIONS)

    source.each(write_film)


EXPORT = Export(fields=("frames",), write=write, separate=True, check=check, fixed=True)
