"""One AV1 film (MP4) per video, encoded by PyAV: smaller than H.264, but slower to encode."""

from pathlib import Path

from gen2d.plugin import Export, Source, films

FASTEST = 240  # frames/s, the maximum of this encoder
OPTIONS = {"crf": "20", "preset": "8", "svtav1-params": "lp=1"}


def check(source: Source) -> None:
    """Raise ConfigError for unsupported frame sizes and rates, UserError without PyAV."""
    films.check_size("av1", source.frame_size)
    films.check_rate("av1", source.fps, FASTEST)
    films.pyav()


def write(target: Path, source: Source) -> None:
    """Write KEY.mp4 for each video to the folder."""

    def write_film(key: str, video: dict) -> None:
        films.encode(target / f"{key}.mp4", video["frames"], source.fps, "libsvtav1", "yuv420p", OPTIONS)

    source.each(write_film)


EXPORT = Export(fields=("frames",), write=write, separate=True, check=check, fixed=True, loss=films.LOSS)
