"""A film per video in H.264 by PyAV, which browsers play."""

from pathlib import Path

from gen2d.plugin import Export, Source, films

# Flat discs need a better quality than the camera's pictures that the usual 23 is meant for. With mbtree (x264 as in
# PyAV 18) small videos come out otherwise from run to run: 1 in 5 of 64 px and 32 frames.
OPTIONS = {"crf": "12", "x264-params": "no-mbtree=1", "movflags": "+faststart"}


def check(source: Source) -> None:
    """ConfigError for sizes and rates that it cannot have, UserError without PyAV."""
    films.check_size("h264", source.frame_size)
    films.check_rate("h264", source.fps, films.FASTEST)
    films.pyav()


def write(target: Path, source: Source) -> None:
    """Fills the folder with KEY.mp4."""

    def one(key: str, video: dict) -> None:
        films.encode(target / f"{key}.mp4", video["frames"], source.fps, "libx264", "yuv420p", OPTIONS)

    source.each(one)


EXPORT = Export(fields=("frames",), write=write, check=check, fixed=True, loss=films.LOSS)
