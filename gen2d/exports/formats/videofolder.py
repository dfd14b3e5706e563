"""A folder of films with a table, as Hugging Face's `videofolder` reads it: SPLIT/KEY.mp4 and SPLIT/metadata.parquet.

The table has a row per video: `file_name`, and all fields but images, as nested lists. README.md is a card for the Hub.
Needs PyArrow and PyAV.
"""

from itertools import islice
from pathlib import Path

from gen2d.plugin import Export, Source, arrays, films, tables
from gen2d.plugin import dataset as loader

TABLE = "metadata.parquet"
GROUP = 256  # videos in a row group of the table


def check(source: Source) -> None:
    """Raise ConfigError for frames that the codec cannot store, UserError without PyArrow or PyAV."""
    tables.pyarrow()
    arrays.check_films(source, f"videofolder with the codec {source.codec}", films.CODECS[source.codec])


def write(target: Path, source: Source) -> None:
    """Write the films."""
    codec, folder = films.CODECS[source.codec], target / source.ds.options.split
    folder.mkdir(exist_ok=True)
    source.each(lambda key, video: codec.write(folder / f"{key}{codec.suffix}", video["frames"], source.fps))


def finish(target: Path, source: Source) -> None:
    """Write the table and the card."""
    split, suffix = source.ds.options.split, films.CODECS[source.codec].suffix
    stored = source.ds.manifest.fields
    names = [name for name in source.fields if name in stored and not stored[name].is_image]
    ds = loader.open(source.ds.root, split, names, snapshot=source.ds.snapshot)
    with tables.Table(target / split / TABLE, source, ds.fields, {}, ("file_name",)) as table:
        numbers = iter(source.numbers)
        while group := list(islice(numbers, GROUP)):
            videos = zip(group, ds.__getitems__(group), strict=True)
            table.add({**video, "file_name": f"{source.key(number)}{suffix}"} for number, video in videos)
    text = (
        "Each video is a film, and a row of the table has its other fields. Load it with\n"
        f'`datasets.load_dataset("videofolder", data_dir=FOLDER)["{split}"]`.'
    )
    tables.write_card(target, source, [*source.fields], f"{split}/*", text)


EXPORT = Export(
    fields=("frames", "*"),
    write=write,
    check=check,
    separate=True,
    finish=finish,
    codecs=("h264", "av1", "ffv1", "mp4v"),
    loss="without images other than frames",
)
