"""Tar files for WebDataset, with three files per video: KEY.json, a film, and KEY.npz with all other arrays.

The film is KEY.mp4, or KEY.mkv with `--codec ffv1`, which is lossless. With `--codec npz` the frames are in KEY.npz,
lossless, and no film is written. Text fields are KEY.text.caption.txt and KEY.text.events.json: slashes in field names
become dots, because all files of a key must be in one folder. export.json describes the fields.
"""

import io
import tarfile
from pathlib import Path

from gen2d.plugin import Batch, Export, Source, arrays, as_json, films, tables

TAR_BYTES, TAR_VIDEOS = 2**28, 1000  # about the maximum of a tar file, which holds one video at least
ARRAYS = "npz"  # instead of a codec


def part_videos(source: Source) -> int:
    """Number of videos in a tar file."""
    return max(1, min(TAR_VIDEOS, TAR_BYTES // max(1, source.stored_video_bytes)))


def check(source: Source) -> None:
    """Raise ConfigError for frame sizes and rates that the codec cannot store, UserError without PyAV."""
    if "frames" in source.fields and source.codec != ARRAYS:
        films.CODECS[source.codec].check(f"webdataset with the codec {source.codec}", source.frame_size, source.fps)


def write(target: Path, source: Source) -> None:
    """Write SPLIT-000000.tar, or another tar file of these videos; equal datasets give equal bytes."""
    places = source.places
    with tarfile.open(target / f"{source.ds.options.split}-{places.start // part_videos(source):06d}.tar", "w") as tar:
        for number, files in zip(source.numbers, source.map(lambda _, video: _files(source, video)), strict=True):
            for suffix, content in {"json": _description(source, number), **files}.items():
                member = tarfile.TarInfo(f"{source.key(number)}.{suffix}")  # time and owner are 0
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
            source.advance(1)


def finish(target: Path, source: Source) -> None:
    """Write the card."""
    split = source.ds.options.split
    text = "Each video is a group of files in a tar file, for `webdataset` and for\n`datasets.load_dataset(FOLDER)`."
    tables.write_card(target, source, [*source.fields], f"{split}-*.tar", text)


def _files(source: Source, video: Batch) -> dict[str, bytes]:
    """Files of a video, by suffix."""
    files, values = {}, dict(video)
    if "frames" in values and source.codec != ARRAYS:
        codec = films.CODECS[source.codec]
        files[codec.suffix.removeprefix(".")] = codec.content(values.pop("frames"), source.fps)
    for name, field in source.fields.items():
        if field.is_text:
            ending = "json" if field.unit == "JSON" else "txt"
            if not values[name].ndim:
                files[f"{name.replace('/', '.')}.{ending}"] = bytes(values.pop(name))
    if values:
        files["npz"] = arrays.archive(values)
    return files


def _description(source: Source, number: int) -> bytes:
    """Contents of a video's JSON: its origin."""
    origin = {key: source.ds.manifest.plain[key] for key in ("name", "seed", "fps")}
    return as_json(origin | {"split": source.ds.options.split, "number": number})


EXPORT = Export(
    fields=("frames", "*"),
    write=write,
    check=check,
    separate=True,
    part_videos=part_videos,
    finish=finish,
    codecs=("h264", "av1", "ffv1", "mp4v", ARRAYS),
)
