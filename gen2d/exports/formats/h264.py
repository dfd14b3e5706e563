"""One H.264 film (MP4) per video, encoded by PyAV; browsers play it."""

from pathlib import Path

from gen2d.plugin import Export, Source, films

# Flat discs need a better quality than camera images, for which the default crf of 23 is meant. With mbtree (x264 in
# PyAV 18) encoding is not reproducible: 1 in 5 videos of 64 px and 32 frames had other bytes in another run.
OPTIONS = {"crf": "12", "x264-params": "no-mbtree=1", "movflags": "+faststart"}


def check(source: Source) -> None:
    """Raise ConfigError for unsupported frame sizes and rates, UserError without PyAV."""
    films.check_size("h264", source.frame_size)
    films.check_rate("h264", source.fps, films.FASTEST)
    films.pyav()


def write(target: Path, source: Source) -> None:
    """Write KEY.mp4 for each video to the folder."""

    def write_film(key: str, video: dict) -> None:
        films.encode(target / f"{key}.mp4", video["frames"], source.fps, "libx264", "yuv420p", OPTIONS)

    source.each(write_film)


EXPORT = Export(fields=("frames",), write=write, separate=True, check=check, fixed=True, loss=films.LOSS)
