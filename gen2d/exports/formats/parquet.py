"""Parquet files with a row per video: the frames as an encoded film or as PNG images, all other fields as nested lists.

`datasets.load_dataset("parquet", ...)` decodes films and images, and gives arrays of the right shape; pandas, Polars
and DuckDB read the same files. Axes, units and meanings are metadata of the columns. README.md is a card for the Hub.
Needs PyArrow, and PyAV but for the codec png.
"""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from gen2d.plugin import Batch, ConfigError, Export, Source, films, images, tables

FILE_BYTES, FILE_VIDEOS = 2**28, 10_000  # about the maximum of a file, which holds one video at least
GROUP_BYTES = 2**26  # of videos in a row group, before compression
MOST_AXES = 5  # of an array in `datasets`


def part_videos(source: Source) -> int:
    """Number of videos in a file."""
    return max(1, min(FILE_VIDEOS, FILE_BYTES // max(1, source.stored_video_bytes)))


def check(source: Source) -> None:
    """Raise ConfigError for frames that the codec cannot store, UserError without PyArrow or PyAV."""
    tables.pyarrow()
    if "frames" in source.fields and source.codec != "png":
        films.CODECS[source.codec].check(f"parquet with the codec {source.codec}", source.frame_size, source.fps)
    for name, field in source.fields.items():
        if len(field.shape(source.sizes)) > MOST_AXES:
            raise ConfigError(
                f"{name} has more than {MOST_AXES} axes, which parquet cannot hold: leave it out of the fields"
            )


def write(target: Path, source: Source) -> None:
    """Write SPLIT-000000.parquet, or another file of these videos; equal datasets give equal bytes."""
    number = source.places.start // part_videos(source)
    fields = {name: field for name, field in source.fields.items() if name != "frames"}
    media = {"frames": "images" if source.codec == "png" else "video"} if "frames" in source.fields else {}
    rows: Iterator[Batch] = source.map(lambda _, video: _encoded(source, video))
    per_group = max(1, GROUP_BYTES // max(1, source.video_bytes))
    path = target / f"{source.ds.options.split}-{number:06d}.parquet"
    with tables.Table(path, source, fields, media) as table:
        while group := list(islice(rows, per_group)):
            table.add(group)
            source.advance(len(group))


def _encoded(source: Source, video: Batch) -> dict[str, Any]:
    """The video with encoded frames."""
    if "frames" not in video:
        return video
    if source.codec == "png":
        return {**video, "frames": [images.png(image) for image in video["frames"]]}
    return {**video, "frames": films.CODECS[source.codec].content(video["frames"], source.fps)}


def finish(target: Path, source: Source) -> None:
    """Write the card."""
    text = (
        "The column `frames` is a video or a list of images; each other field is a column of its own. Load it with\n"
        f'`datasets.load_dataset(FOLDER)["{source.ds.options.split}"]`.'
    )
    tables.write_card(target, source, [*source.fields], f"{source.ds.options.split}-*.parquet", text)


EXPORT = Export(
    fields=("frames", "*"),
    write=write,
    check=check,
    separate=True,
    part_videos=part_videos,
    finish=finish,
    codecs=("h264", "av1", "ffv1", "mp4v", "png"),
)
