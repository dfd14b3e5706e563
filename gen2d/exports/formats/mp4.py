"""A film per video by OpenCV (MPEG-4 part 2): always available, for desktop players, not for browsers."""

from pathlib import Path

from gen2d.plugin import Export, Source, films


def check(source: Source) -> None:
    """ConfigError for sizes and rates that it cannot have."""
    films.check_size("mp4", source.frame_size)
    films.check_rate("mp4", source.fps, films.FASTEST)


def write(target: Path, source: Source) -> None:
    """Fills the folder with KEY.mp4."""
    source.each(lambda key, video: films.mp4v(target / f"{key}.mp4", video["frames"], source.fps))


EXPORT = Export(fields=("frames",), write=write, check=check, fixed=True, loss=films.LOSS)
