"""A Zarr v3 group per split, SPLIT.zarr, with an array [n, ...] per field in sharded chunks, and `time` and `index`.

`zarr.open_group("FOLDER/train.zarr")["states/position"][2:5]` are the positions of three videos. Attributes of an array
are its unit, axes and meaning, and the names of its codes if it has some. The axes are also the names of its
dimensions, so `xarray.open_datatree("FOLDER/train.zarr", engine="zarr")` reads the group. Text is an array of strings.
Every array is lossless, frames too. Needs zarr.
"""

import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from gen2d.plugin import Export, Field, Source, UserError, power_of_two, tables

PART_BYTES, PART_VIDEOS = 2**28, 1024  # about the maximum of a part, compressed; at least one video
SHARD_BYTES, CHUNK_BYTES = 2**26, 2**16  # about the maximum of several videos in a shard and in a chunk, uncompressed
INDEX = Field("int64", "n", "", "number of the video in its split")


def part_videos(source: Source) -> int:
    """Number of videos in a part: a power of two, which whole shards and chunks fill."""
    return power_of_two(min(PART_VIDEOS, PART_BYTES // max(1, source.stored_video_bytes)))


def check(source: Source) -> None:
    """Raise UserError without zarr."""
    _zarr()


def write(target: Path, source: Source) -> None:
    """Write the shards of these videos, and the metadata of the group, which are the same for every part."""
    zarr = _zarr()
    with zarr.config.set({"async.concurrency": source.threads}):
        group = zarr.create_group(_store(target, source), zarr_format=3, attributes=_origin(source))
        group.create_array("time", data=source.ds.time, dimension_names=["T"], attributes=_about(tables.TIME))
        fields = {"index": INDEX, **source.fields}
        arrays = {name: _Array(group, name, field, source) for name, field in fields.items()}
        for number, video in zip(source.numbers, source.videos(), strict=True):
            for name, array in arrays.items():
                array.add(video[name] if name in video else np.array(number))
            source.advance(1)
        for array in arrays.values():
            array.flush()


def finish(target: Path, source: Source) -> None:
    """Copy the metadata of all arrays to the group's, so that one request opens it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that Zarr's specification does not have this copy, which readers may ignore
        _zarr().consolidate_metadata(_store(target, source), zarr_format=3)


def _store(target: Path, source: Source) -> Path:
    return target / f"{source.ds.options.split}.zarr"


class _Array:
    """A field's array in the group, of which the shards of some videos are written one after the other."""

    def __init__(self, group: Any, name: str, field: Field, source: Source) -> None:
        shape, part = field.shape(source.sizes), part_videos(source)
        size = max(1, int(np.prod(shape)) * np.dtype(field.dtype).itemsize)
        self.per_shard = min(part, power_of_two(SHARD_BYTES // size))
        per_chunk = min(self.per_shard, power_of_two(CHUNK_BYTES // size))
        others = [max(1, length) for length in shape]
        self.array = group.create_array(
            name,
            shape=(source.total, *shape),
            dtype=str if field.is_text else field.dtype,
            chunks=(per_chunk, *others),
            shards=(self.per_shard, *others),
            compressors=_compressor(source.codec),
            dimension_names=field.axes.split(),
            attributes=_about(field),
        )
        self.is_text, self.first, self.values = field.is_text, source.places.start, list[np.ndarray]()

    def add(self, value: np.ndarray) -> None:
        """The value of the next video."""
        self.values.append(value)
        if len(self.values) == self.per_shard:
            self.flush()

    def flush(self) -> None:
        """Write the shard of the values that are waiting, if there are some."""
        if self.values:
            values, end = np.stack(self.values), self.first + len(self.values)
            self.array[self.first : end] = np.char.decode(values, "utf-8") if self.is_text else values
            self.first, self.values = end, []


def _zarr() -> ModuleType:
    """The package zarr; raises UserError if it is not installed."""
    try:
        import zarr
        import zarr.codecs
    except ImportError:
        raise UserError("this format needs zarr 3: pip install 'gen2d[zarr]'") from None
    return zarr


def _compressor(codec: str) -> Any:
    codecs = _zarr().codecs
    return codecs.ZstdCodec(level=5) if codec == "zstd" else codecs.GzipCodec(level=6)


def _origin(source: Source) -> dict[str, Any]:
    """Attributes of the group."""
    keys = ("name", "seed", "fps", "conventions", "licence")
    return {key: source.ds.manifest.plain[key] for key in keys} | {"split": source.ds.options.split}


def _about(field: Field) -> dict[str, Any]:
    """Attributes of an array."""
    about = {key: getattr(field, key) for key in ("unit", "axes", "meaning")}
    return about | ({"codes": {str(code): name for code, name in field.codes.items()}} if field.codes else {})


EXPORT = Export(
    fields=("frames", "*"),
    write=write,
    check=check,
    separate=True,
    part_videos=part_videos,
    finish=finish,
    codecs=("zstd", "gzip"),
)
