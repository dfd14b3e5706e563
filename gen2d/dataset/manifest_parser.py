"""The checks of a manifest: types, names, sizes and numbers, before any of them meets a path, an array or a screen.

Every value that the generator could not have written is refused with one sentence.
"""

import contextlib
import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from gen2d.core.schema import Field
from gen2d.dataset.block import image_names, stored_bytes
from gen2d.dataset.rows import CHUNK
from gen2d.dataset.spec import CONFIG, NAME, PAGE, PLUGIN, SHEET, SPLIT, shard_count, table_name
from gen2d.dataset.statistics import MOMENTS, Stats, component_counts
from gen2d.storage.codecs import CODECS

FILE_BYTES = 2**26  # maximum size of a file other than shards and tables
REQUIRED = {"index": ("int64", "n"), "time": ("float64", "T")}  # fields that every dataset has
DTYPES = ("bool", *(f"{kind}{bits}" for kind in ("uint", "int") for bits in (8, 16, 32, 64)))
DTYPES += ("float16", "float32", "float64")
TEXT_BYTES = 2**20  # maximum size of a text field
VIDEO_BYTES = 2**36  # maximum size of one video's value of a field, before compression
FIELDS, SPLITS, SHARDS = 1000, 1000, 2**20  # maximum numbers; shards of all splits together
ROW_BYTES = 2**24  # maximum size of a shard's row in a table, or a video's in an index
DEPTH = 64  # maximum levels of a config
FIELD = re.compile(r"[a-z][a-z0-9_]{0,63}(/[a-z][a-z0-9_]{0,99}){0,2}")
AXIS = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
HASH = re.compile(r"[0-9a-f]{64}")


@dataclasses.dataclass(frozen=True)
class ShardTable:
    """The manifest's entry on the shard table of a split."""

    file: str  # its path in the folder
    sha256: str
    shards: int
    bytes: int  # of all shards' files
    largest: int  # size of the largest shard's file, bytes


class InvalidValueError(Exception):
    """A value that no manifest has; the sentence names the entry and what is allowed."""


def _quote(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _refuse(where: str, value: Any, allowed: str) -> NoReturn:
    raise InvalidValueError(f"{where} is {_quote(value)}, but must be {allowed}")


def _text(value: Any, where: str, pattern: re.Pattern[str] | None = None, longest: int = 4096) -> str:
    if not isinstance(value, str) or len(value) > longest or not all(c.isprintable() for c in value):
        _refuse(where, value, f"printable text of at most {longest} characters")
    if pattern is not None and not pattern.fullmatch(value):
        _refuse(where, value, f"text that matches {pattern.pattern}")
    return value


def _whole(value: Any, where: str, low: int, high: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        _refuse(where, value, f"a whole number from {low} to {high}")
    return value


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e300:
        _refuse(where, value, "a finite number")
    return float(value)


def _one_of(value: Any, where: str, allowed: tuple[Any, ...]) -> Any:
    if not any(value == one and type(value) is type(one) for one in allowed):
        _refuse(where, value, f"one of {', '.join(map(str, allowed))}")
    return value


def _mapping(value: Any, where: str, most: int, least: int = 0) -> dict[str, Any]:
    if not isinstance(value, dict) or not least <= len(value) <= most:
        _refuse(where, value, f"a mapping of {least} to {most} entries")
    return value


def _list(value: Any, where: str, length: int) -> list[Any]:
    if not isinstance(value, list) or len(value) != length:
        _refuse(where, value, f"a list of {length}")
    return value


def _has_shape(value: Any, shape: Sequence[int]) -> bool:
    """Whether nested lists of numbers have this shape."""
    if not shape:
        return isinstance(value, bool | int | float)
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(own, shape[1:]) for own in value)


@dataclasses.dataclass
class ManifestParser:
    """Checks the entries of a manifest; each method raises InvalidValueError."""

    plain: Mapping[str, Any]  # as in JSON

    def part(self, name: str) -> Any:
        if name not in self.plain:
            raise InvalidValueError(f"it has no {name}")
        return self.plain[name]

    def identity(self) -> dict[str, Any]:
        """The checked values of the dataset's identity."""
        sizes = {
            _text(axis, "an axis of sizes", AXIS): _whole(size, f"sizes.{axis}", 0, 2**31)
            for axis, size in _mapping(self.part("sizes"), "sizes", 100).items()
        }
        chunk = self.part("chunk_frames")
        if chunk is not None:
            _whole(chunk, "chunk_frames", 1, 100_000)
            if not sizes.get("T") or sizes["T"] % chunk:
                _refuse("chunk_frames", chunk, f"a divisor of the {sizes.get('T', 0)} frames")
        return {
            "seed": _whole(self.part("seed"), "seed", 0, 2**63 - 1),
            "config": self.nested("config"),
            "codec": _one_of(self.part("codec"), "codec", CODECS),
            "chunk_frames": chunk,
            "videos_per_shard": _whole(self.part("videos_per_shard"), "videos_per_shard", 1, 65536),
            "sizes": sizes,
            "fingerprint": self.versions("fingerprint"),
        }

    def values(self) -> dict[str, Any]:
        """The checked values of a Manifest, by attribute."""
        base = self.identity()
        sizes, videos_per_shard = base["sizes"], base["videos_per_shard"]
        splits = {
            _text(split, "a split's name", SPLIT): _whole(count, f"splits.{split}", 1, 2**40)
            for split, count in _mapping(self.part("splits"), "splits", SPLITS, 1).items()
        }
        if sum(shard_count(count, videos_per_shard) for count in splits.values()) > SHARDS:
            _refuse("splits", dict(splits), f"at most {SHARDS:,} shards of {videos_per_shard} videos each")
        fields = self.fields(sizes)
        return base | {
            "name": _text(self.part("name"), "name", NAME),
            "splits": splits,
            "frames": {split: self.frames(split, sizes) for split in splits},
            "rng": _text(self.part("rng"), "rng"),
            "config_sha256": _text(self.part("config_sha256"), "config_sha256", HASH),
            "fields": fields,
            "fps": self.fps(),
            "constants": self.constants(fields, sizes),
            "conventions": _text(self.part("conventions"), "conventions"),
            "licence": _text(self.part("licence"), "licence"),
            "stats": {split: self.stats(split, fields) for split in self.check_splits(splits, "stats")},
            "stats_sampled": _text(self.part("stats_sampled"), "stats_sampled"),
            "tables": {s: self.table(s, splits[s], videos_per_shard) for s in self.check_splits(splits, "tables")},
            "files": self.files(),
            "producer": self.versions("producer"),
        }

    def nested(self, part: str) -> dict[str, Any]:
        """A mapping of any values, of bounded depth."""
        level: list[Any] = [_mapping(self.part(part), part, 1000)]
        for _ in range(DEPTH):
            level = [v for value in level for v in (value.values() if isinstance(value, dict) else value)]
            level = [value for value in level if isinstance(value, dict | list)]
            if not level:
                return self.plain[part]
        raise InvalidValueError(f"{part} is nested deeper than {DEPTH} levels")

    def check_splits(self, splits: Mapping[str, int], part: str) -> Mapping[str, int]:
        """The dataset's splits, if this part has exactly these."""
        if _mapping(self.part(part), part, SPLITS).keys() != splits.keys():
            _refuse(f"the splits of {part}", sorted(self.part(part)), f"those of the dataset, {_quote(sorted(splits))}")
        return splits

    def versions(self, part: str) -> Mapping[str, Any]:
        """A mapping of text and numbers, or of mappings of these."""
        values: dict[str, Any] = {}
        for key, value in _mapping(self.part(part), part, 100).items():
            name = _text(key, f"a name in {part}", None, 200)
            if isinstance(value, dict):
                own = _mapping(value, f"{part}.{name}", 1000)
                values[name] = {
                    _text(k, f"a name in {part}.{name}", None, 400): self.version(v, name) for k, v in own.items()
                }
            else:
                values[name] = self.version(value, f"{part}.{name}")
        return values

    def version(self, value: Any, where: str) -> Any:
        return _text(value, where) if isinstance(value, str) else value if value is None else _number(value, where)

    def frames(self, split: str, sizes: Mapping[str, int]) -> int:
        own = self.plain["config"].get("splits")
        own = own.get(split) if isinstance(own, dict) else None
        frames = own.get("frames") if isinstance(own, dict) else None
        whole = sizes.get("T", 0)
        return whole if frames is None else _whole(frames, f"config.splits.{split}.frames", 1, whole)

    def fps(self) -> float:
        fps = _number(self.part("fps"), "fps")
        return fps if 0 < fps <= 1e6 else _refuse("fps", fps, "above 0 and at most 1e6")

    def fields(self, sizes: Mapping[str, int]) -> dict[str, Field]:
        listed = _mapping(self.part("fields"), "fields", FIELDS, 1)
        fields = {
            _text(name, "a field's name", FIELD): self.field(name, value, sizes) for name, value in listed.items()
        }
        for name, required in REQUIRED.items():
            own = fields.get(name)
            if own is None or (own.dtype, own.axes) != required:
                _refuse(f"fields.{name}", own and f"{own.dtype} {own.axes}", " ".join(required))
        chunks = sizes["T"] // (self.part("chunk_frames") or sizes["T"] or 1)
        video = chunks * len(image_names(fields)) * CHUNK.itemsize
        shard = 8 * MOMENTS * sum(component_counts(fields).values())
        if max(video, shard) > ROW_BYTES:
            _refuse("the size of a row", max(video, shard), f"at most {ROW_BYTES} bytes")
        return fields

    def field(self, name: str, value: Any, sizes: Mapping[str, int]) -> Field:
        where = f"fields.{name}"
        entry = _mapping(value, where, 20)
        for part in ("dtype", "axes", "unit", "meaning", "shape", "codec"):
            if part not in entry:
                raise InvalidValueError(f"{where} has no {part}")
        dtype = _text(entry["dtype"], f"{where}.dtype", None, 20)
        if dtype not in DTYPES and not (re.fullmatch(r"S\d{1,7}", dtype) and 1 <= int(dtype[1:]) <= TEXT_BYTES):
            _refuse(f"{where}.dtype", dtype, f"one of {', '.join(DTYPES)}, or S and a number of bytes")
        axes = _text(entry["axes"], f"{where}.axes", None, 200)
        for axis in axes.split(" ") if axes else []:
            if axis.isdigit():
                _whole(int(axis) if len(axis) < 8 else axis, f"{where}.axes", 1, 10**6)
            elif axis != "n" and axis not in sizes:
                _refuse(f"{where}.axes", axes, f"made of n, numbers and {', '.join(sizes)}")
        if "n" in axes.split(" ")[1:]:
            _refuse(f"{where}.axes", axes, "axes with n in the first place alone")
        field = Field(dtype, axes, _text(entry["unit"], f"{where}.unit"), _text(entry["meaning"], f"{where}.meaning"))
        if field.is_image and (axes.split()[:4] != ["n", "T", "H", "W"] or dtype.startswith("S")):
            _refuse(f"{where}.axes", axes, "n T H W, alone or with more axes, in an image")
        if stored_bytes(field, sizes) > VIDEO_BYTES:
            _refuse(where, field.shape(sizes), f"at most {VIDEO_BYTES} bytes a video")
        if entry["shape"] != list(field.shape(sizes)):
            _refuse(f"{where}.shape", entry["shape"], f"{list(field.shape(sizes))}, as its axes say")
        _one_of(entry["codec"], f"{where}.codec", (self.plain["codec"] if field.is_image else "none",))
        if name == "frames" and (dtype != "uint8" or axes != "n T H W 3"):
            _refuse(where, f"{dtype} {axes}", "uint8 n T H W 3")
        if name == "objects/present" and (dtype != "bool" or axes != "n K"):
            _refuse(where, f"{dtype} {axes}", "bool n K")
        return field

    def constants(self, fields: Mapping[str, Field], sizes: Mapping[str, int]) -> dict[str, np.ndarray]:
        given = _mapping(self.part("constants"), "constants", FIELDS)
        names = {name for name, field in fields.items() if not field.per_video}
        if given.keys() != names:
            _refuse("the names of constants", sorted(given), f"those of the fields without n, {_quote(sorted(names))}")
        return {name: self.constant(name, fields[name], fields[name].shape(sizes)) for name in names}

    def constant(self, name: str, field: Field, shape: tuple[int, ...]) -> np.ndarray:
        value, dtype = self.plain["constants"][name], np.dtype(field.dtype)
        if dtype.kind not in "biuf" or math.prod(shape) > 10**6:
            _refuse(f"constants.{name}", value, "at most a million numbers")
        if _has_shape(value, shape):
            with contextlib.suppress(ValueError, TypeError, OverflowError):
                array = np.array(value)
                fits = array.shape == shape and array.dtype.kind in ("b" if dtype.kind == "b" else "iuf")
                if fits and (array.astype(dtype) == array).all():
                    return array.astype(dtype)
        _refuse(f"constants.{name}", value, f"{dtype} {list(shape)}")

    def stats(self, split: str, fields: Mapping[str, Field]) -> Stats:
        where, known = f"stats.{split}", component_counts(fields)
        own = _mapping(self.part("stats")[split], where, FIELDS)
        if own.keys() != known.keys():
            _refuse(f"the fields of {where}", sorted(own), f"{_quote(sorted(known))}")
        stats: Stats = {}
        for name, length in known.items():
            entry = _mapping(own[name], f"{where}.{name}", 4, 4)
            stats[name] = {
                key: self.moments(entry, key, f"{where}.{name}", length) for key in ("mean", "std", "min", "max")
            }
        return stats

    def moments(self, entry: Mapping[str, Any], key: str, where: str, length: int) -> list[float] | None:
        if key not in entry:
            raise InvalidValueError(f"{where} has no {key}")
        if entry[key] is None:
            return None
        return [_number(value, f"{where}.{key}") for value in _list(entry[key], f"{where}.{key}", length)]

    def table(self, split: str, videos: int, videos_per_shard: int) -> ShardTable:
        where = f"tables.{split}"
        entry = _mapping(self.part("tables")[split], where, 5, 5)
        shards = shard_count(videos, videos_per_shard)
        return ShardTable(
            file=_one_of(entry.get("file"), f"{where}.file", (table_name(split, videos),)),
            sha256=_text(entry.get("sha256"), f"{where}.sha256", HASH),
            shards=_whole(entry.get("shards"), f"{where}.shards", shards, shards),
            bytes=_whole(entry.get("bytes"), f"{where}.bytes", 1, 2**62),
            largest=_whole(entry.get("largest"), f"{where}.largest", 1, 2**50),
        )

    def files(self) -> dict[str, str]:
        hashes = {}
        for name, digest in _mapping(self.part("files"), "files", 2 * SPLITS).items():
            if name not in (CONFIG, SHEET, PAGE) and not PLUGIN.fullmatch(name):
                _refuse("a name in files", name, f"{CONFIG}, {SHEET}, {PAGE} or plugins/KIND/NAME.py")
            hashes[name] = _text(digest, f"files.{name}", HASH)
        return hashes
