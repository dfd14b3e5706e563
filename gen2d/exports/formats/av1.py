"""A film per video in AV1 by PyAV: smaller than H.264, slower to make."""

from pathlib import Path

from gen2d.plugin import Export, Source, films

FASTEST = 240  # frames/s, of this encoder
OPTIONS = {"crf": "20", "preset": "8", "svtav1-params": "lp=1"}


def check(source: Source) -> None:
    """ConfigError for sizes and rates that it cannot have, UserError without PyAV."""
    films.check_size("av1", source.frame_size)
    films.check_rate("av1", source.fps, FASTEST)
    films.pyav()


def write(target: Path, source: Source) -> None:
    """Fills the folder with KEY.mp4."""

    def one(key: str, video: dict) -> None:
        films.encode(target / f"{key}.mp4", video["frames"], source.fps, "libsvtav1", "yuv420p", OPTIONS)

    source.each(one)


EXPORT = Export(fields=("frames",), write=write, check=check, fixed=True, loss=films.LOSS)
