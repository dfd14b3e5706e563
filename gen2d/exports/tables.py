"""Tables of videos for Arrow and Parquet, typed so that Hugging Face's `datasets` gives arrays, images and films."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from gen2d.core.errors import UserError
from gen2d.core.schema import Field
from gen2d.dataset.hub import metadata, split_names
from gen2d.exports.source import Source

TIME = Field("float64", "T", "s", "time of each frame; frame 0 is the initial state")


def pyarrow() -> ModuleType:
    """The module of Arrow; raises UserError if it is not installed."""
    try:
        import pyarrow as arrow
        import pyarrow.parquet
    except ImportError:
        raise UserError("this format needs PyArrow: pip install 'gen2d[hub]'") from None
    return arrow


class Table:
    """A Parquet file of videos, written a few rows at a time.

    `media` are the columns of encoded files by name: "video" for one, or "images" for a list of them. All other columns
    are fields, as nested lists, with their axes, units and meanings as metadata.
    """

    def __init__(
        self,
        path: Path,
        source: Source,
        fields: Mapping[str, Field],
        media: Mapping[str, str],
        first: Sequence[str] = (),
    ) -> None:
        self.arrow, self.fields, self.media, self.first = pyarrow(), {**fields, "time": TIME}, media, first
        arrow, sizes = self.arrow, source.sizes
        columns, features = [arrow.field(name, arrow.string()) for name in first], dict[str, Any]()
        features |= {name: _value("string") for name in first}
        file = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
        for name, kind in media.items():
            columns.append(arrow.field(name, file if kind == "video" else arrow.list_(file)))
            features[name] = {"_type": "Video"} if kind == "video" else {"feature": {"_type": "Image"}, "_type": "List"}
        for name, field in self.fields.items():
            about = {key: getattr(field, key) for key in ("axes", "unit", "meaning")}
            features[name] = _feature(field, field.shape(sizes))
            columns.append(arrow.field(name, self._type(field), metadata=about | _extension(features[name])))
        origin = {key: source.ds.manifest.plain[key] for key in ("name", "seed", "fps", "conventions", "licence")}
        about = {"huggingface": json.dumps({"info": {"features": features}}), "gen2d": json.dumps(origin)}
        self.schema = arrow.schema(columns, metadata=about)
        self.writer = arrow.parquet.ParquetWriter(path, self.schema, compression="zstd")
        self.time = source.ds.time

    def add(self, videos: Iterable[Mapping[str, Any]]) -> None:
        """Write rows, as one group: the fields of each video, and the contents of its files."""
        rows = list(videos)
        if not rows:
            return
        arrays = [self._column(name, [row[name] for row in rows]) for name in (*self.first, *self.media)]
        for name in self.fields:
            values = [self.time if name == "time" else row[name] for row in rows]
            arrays.append(nested(np.stack(values)))
        self.writer.write_table(self.arrow.Table.from_arrays(arrays, schema=self.schema))

    def __enter__(self) -> "Table":
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def _column(self, name: str, values: Sequence[Any]) -> Any:
        if name in self.first:
            return self.arrow.array(values, self.arrow.string())
        single = self.media[name] == "video"
        files = [_file(value) if single else [_file(each) for each in value] for value in values]
        return self.arrow.array(files, self.schema.field(name).type)

    def _type(self, field: Field) -> Any:
        kind = self.arrow.string() if field.is_text else self.arrow.from_numpy_dtype(np.dtype(field.dtype))
        for _ in field.axes.replace("n", "", 1).split() if field.per_video else field.axes.split():
            kind = self.arrow.list_(kind)
        return kind


def nested(values: np.ndarray) -> Any:
    """Arrow's array of nested lists with these values [rows, ...]; bytes become text."""
    arrow, flat = pyarrow(), values.reshape(-1)
    is_text = values.dtype.kind == "S"
    leaf = arrow.array([text.decode() for text in flat.tolist()], arrow.string()) if is_text else arrow.array(flat)
    for axis in range(values.ndim - 1, 0, -1):
        count = int(np.prod(values.shape[:axis]))
        offsets = np.arange(count + 1, dtype=np.int32) * values.shape[axis]
        leaf = arrow.ListArray.from_arrays(arrow.array(offsets), leaf)
    return leaf


def write_card(
    target: Path, source: Source, names: Sequence[str], pattern: str, text: str, tags: Sequence[str] = ()
) -> None:
    """Write the dataset card, README.md, with the Hub's metadata: one split, whose files match `pattern`."""
    manifest, split = source.ds.manifest, source.ds.options.split
    files = {split_names([split])[split]: [pattern]}
    head = metadata(manifest.name, len(source), manifest.licence, names, files, tags)
    body = f"""# {manifest.name}

{len(source)} videos of two-dimensional rigid bodies, of the split {split}, {manifest.fps:g} frames per second, made by
gen2d. {text}

{manifest.conventions}
"""
    (target / "README.md").write_text(head + body, encoding="utf-8", newline="\n")


def _file(content: bytes) -> dict[str, Any]:
    return {"bytes": content, "path": None}


def _value(dtype: str) -> dict[str, Any]:
    return {"dtype": dtype, "_type": "Value"}


def _extension(feature: Mapping[str, Any]) -> dict[str, str]:
    """Metadata that make `datasets` read a column as arrays of a fixed shape; others read nested lists."""
    kind = feature["_type"]
    if not kind.startswith("Array"):
        return {}
    name = f"datasets.features.features.{kind}ExtensionType"
    shape = json.dumps([feature["shape"], feature["dtype"]])
    return {"ARROW:extension:name": name, "ARROW:extension:metadata": shape}


def _feature(field: Field, shape: tuple[int, ...]) -> dict[str, Any]:
    """Description of a column for `datasets`."""
    dtype = "string" if field.is_text else field.dtype
    if field.is_text or len(shape) < 2 or 0 in shape:
        feature = _value(dtype)
        for _ in shape:
            feature = {"feature": feature, "_type": "List"}
        return feature
    return {"shape": list(shape), "dtype": dtype, "_type": f"Array{len(shape)}D"}
