"""One MPEG-4 part 2 film (MP4) per video, encoded by OpenCV: needs no extra package; browsers do not play it."""

from pathlib import Path

from gen2d.plugin import Export, Source, films


def check(source: Source) -> None:
    """Raise ConfigError for unsupported frame sizes and rates."""
    films.check_size("mp4", source.frame_size)
    films.check_rate("mp4", source.fps, films.FASTEST)


def write(target: Path, source: Source) -> None:
    """Write KEY.mp4 for each video to the folder."""
    source.each(lambda key, video: films.mp4v(target / f"{key}.mp4", video["frames"], source.fps))


EXPORT = Export(fields=("frames",), write=write, separate=True, check=check, fixed=True, loss=films.LOSS)
