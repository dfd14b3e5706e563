"""The manifest: everything about a complete dataset, sealed with a hash, and the only way in for what strangers write.

`parse` makes a Manifest of bytes and refuses, with one sentence, whatever the generator could not have written: types,
names, sizes and numbers are checked here, once, before any of them meets a path, an array or a screen.
"""

import contextlib
import dataclasses
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from gen2d.core.errors import DamagedError, FolderError, IncompleteError
from gen2d.core.schema import Field
from gen2d.dataset.block import image_names, row_names, stored_bytes
from gen2d.dataset.rows import CHUNK, shard_type, video_type
from gen2d.dataset.spec import (
    IDENTITY,
    MARK,
    NAME,
    SCHEMA,
    SPLIT,
    DatasetSpec,
    mark_path,
    snapshot_path,
    table_name,
)
from gen2d.dataset.statistics import MOMENTS, SAMPLED, Stats, measured
from gen2d.storage.codecs import CODECS
from gen2d.storage.explain import reading_error
from gen2d.storage.paths import Place, Url, reading
from gen2d.storage.sealed import JSON_BYTES, as_json, parsed, read_bytes, read_sealed, sealed, sha256, unsealed

# Where each file keeps the hash of all else in it.
SEAL, MARK_SEAL = "manifest_sha256", "identity_sha256"

MANIFEST, SHEET, CONFIG = "manifest.json", "sheet.png", "config.yaml"
FILE_BYTES = 2**26  # of a file beside shards and tables, at most

# ---- What may stand in a manifest

REQUIRED = {"index": ("int64", "n"), "time": ("float64", "T")}  # fields that every dataset has
DTYPES = ("bool", *(f"{kind}{bits}" for kind in ("uint", "int") for bits in (8, 16, 32, 64)))
DTYPES += ("float16", "float32", "float64")
TEXT_BYTES = 2**20  # of a field that is text
VIDEO_BYTES = 2**36  # of one video's value of a field, before compression
FIELDS, SPLITS, SHARDS = 1000, 1000, 2**20  # at most; shards of all splits together
ROW_BYTES = 2**24  # of a shard in a table, or of a video in an index
DEPTH = 64  # levels of a config
FIELD = re.compile(r"[a-z][a-z0-9_]{0,63}(/[a-z][a-z0-9_]{0,99}){0,2}")
AXIS = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
HASH = re.compile(r"[0-9a-f]{64}")
PLUGIN = re.compile(rf"plugins/(scene|look|annotation|splits/{SPLIT.pattern}/look)/[^/\x00-\x1f\x7f]{{1,200}}\.py")


@dataclasses.dataclass(frozen=True)
class ShardTable:
    """The table of a split's shards."""

    file: str  # its name in the folder
    sha256: str
    shards: int
    bytes: int  # of all shards' files
    largest: int  # shard's file, bytes


@dataclasses.dataclass(frozen=True)
class Manifest:
    """What a complete dataset holds; every value is checked."""

    name: str
    splits: Mapping[str, int]  # videos of each
    frames: Mapping[str, int]  # of each split's videos that readers get, the first ones
    seed: int
    rng: str
    config: Mapping[str, Any]  # not checked: what reads it as a config does that
    config_sha256: str
    fields: Mapping[str, Field]
    sizes: Mapping[str, int]  # of the axes that are letters
    codec: str
    chunk_frames: int | None
    videos_per_shard: int
    fps: float
    constants: Mapping[str, np.ndarray]
    conventions: str
    licence: str
    stats: Mapping[str, Stats]  # by split
    stats_sampled: str
    tables: Mapping[str, ShardTable]  # by split
    files: Mapping[str, str]  # sha256 of the other files, by name in the folder
    fingerprint: Mapping[str, Any]
    producer: Mapping[str, Any]
    sha256: str  # the manifest's own, which names the snapshot
    plain: Mapping[str, Any] = dataclasses.field(repr=False)  # as JSON has it

    @property
    def identity(self) -> dict[str, Any]:
        """What another run must share to add to this dataset."""
        return {key: self.plain[key] for key in IDENTITY}

    @property
    def identity_sha256(self) -> str:
        """A hash of the identity."""
        return sha256(as_json(self.identity))

    @property
    def pieces(self) -> int:
        """The number of chunks that a video's image has."""
        return self.sizes["T"] // self.chunk_frames if self.chunk_frames else 1

    @property
    def shard_type(self) -> np.dtype:
        """The row of a shard in a table."""
        return shard_type(self.fields)

    @property
    def video_type(self) -> np.dtype:
        """The row of a video in a shard's index."""
        return video_type(self.fields, self.pieces)

    @property
    def row_bytes(self) -> list[int]:
        """What a video takes in each field that is not compressed, in the order of the names."""
        return [stored_bytes(self.fields[name], self.sizes) for name in row_names(self.fields)]

    @property
    def raw_bytes(self) -> int:
        """What a video takes in all fields, before compression."""
        return sum(stored_bytes(field, self.sizes) for field in self.fields.values())

    def codec_of(self, name: str) -> str:
        """How a field is compressed."""
        return self.codec if self.fields[name].is_image else "none"


def as_bytes(manifest: Manifest) -> bytes:
    """What stands in the manifest's file."""
    return as_json(manifest.plain)


# ---- Reading


def read_manifest(root: Place, snapshot: str | None = None) -> Manifest:
    """The manifest of a complete dataset, or of an earlier snapshot of it.

    Raises IncompleteError if the folder is no dataset or not complete, FolderError if it no longer has the snapshot or
    cannot be read, DamagedError if a byte of the manifest changed or it says what cannot be, UnreachableError.
    """
    current = _read(root, root / MANIFEST, snapshot is not None)
    if snapshot is None or (current is not None and current.sha256 == snapshot):
        assert current is not None
        return current
    path = snapshot_path(root, snapshot) / MANIFEST
    found = _read(root, path, True) if HASH.fullmatch(snapshot) else None
    if found is None or found.sha256 != snapshot:
        raise FolderError(
            f"{root} has grown since, and its snapshot {snapshot[:16]} is no longer there: open the dataset anew"
        )
    return found


def _read(root: Place, path: Place, optional: bool) -> Manifest | None:
    try:
        content = read_bytes(path, JSON_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        if optional:
            return None
        raise _absent(root) from None
    except OSError as error:
        if isinstance(path, Url) and isinstance(error, PermissionError):
            raise FolderError(f"{path} cannot be read: permission denied") from None
        raise reading_error(path, error) from error
    return parse(content, f"{path}")


def _absent(root: Place) -> IncompleteError:
    with reading(root):
        begun = mark_path(root).exists() if isinstance(root, Url) else (root / MARK).is_dir()
    if not begun:
        return IncompleteError(f"{root} is not a gen2d dataset: it has no {MANIFEST}")
    return IncompleteError(f"{root} is incomplete: run the command that made it again, and it goes on where it stopped")


def parse(content: bytes, source: str) -> Manifest:
    """The manifest that these bytes are; errors name `source`."""
    plain = unsealed(content, SEAL)
    if plain is None:
        raise DamagedError(f"{source} is not what was written")
    schema = plain.get("schema")
    if schema != SCHEMA:
        told = schema if isinstance(schema, str) and len(schema) < 100 and schema.isprintable() else "of no known kind"
        raise FolderError(f"{source} has the schema {told}, but this gen2d reads {SCHEMA}: make the dataset anew")
    try:
        return _Parser(plain).manifest()
    except _Wrong as error:
        raise DamagedError(f"{source} is no manifest that gen2d writes: {error}") from None


def identity_of(root: Place) -> dict[str, Any] | None:
    """What the dataset in the folder was made from, as its manifest says or else its mark; None if neither is whole."""
    for path, seal in ((root / MANIFEST, SEAL), (mark_path(root), MARK_SEAL)):
        there = read_sealed(path, seal)
        if there is not None:
            return _checked_identity({key: there.get(key) for key in IDENTITY}, f"{path}")
    return None


def _checked_identity(identity: dict[str, Any], source: str) -> dict[str, Any]:
    try:
        _Parser(identity).identity()
    except _Wrong as error:
        raise DamagedError(f"{source} is nothing that gen2d writes: {error}") from None
    return identity


def schema_of(root: Place) -> str | None:
    """The schema that the folder's manifest names, whichever it is; None if there is none."""
    try:
        schema = (parsed(read_bytes(root / MANIFEST, JSON_BYTES)) or {}).get("schema")
    except OSError:
        return None
    return schema if isinstance(schema, str) and len(schema) < 100 and schema.isprintable() else None


class _Wrong(Exception):
    """A value that no manifest has; the sentence says where it stands and what is allowed."""


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _refuse(where: str, value: Any, allowed: str) -> NoReturn:
    raise _Wrong(f"{where} is {_shown(value)}, but must be {allowed}")


def _text(value: Any, where: str, pattern: re.Pattern[str] | None = None, longest: int = 4096) -> str:
    if not isinstance(value, str) or len(value) > longest or not all(c.isprintable() for c in value):
        _refuse(where, value, f"printable text of {longest} characters at most")
    if pattern is not None and not pattern.fullmatch(value):
        _refuse(where, value, f"text such as {pattern.pattern}")
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
    """Whether nested lists have this shape, and numbers in them."""
    if not shape:
        return isinstance(value, bool | int | float)
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(own, shape[1:]) for own in value)


@dataclasses.dataclass
class _Parser:
    """Reads the parts of a manifest, those first on which others depend."""

    plain: Mapping[str, Any]

    def part(self, name: str) -> Any:
        if name not in self.plain:
            raise _Wrong(f"it has no {name}")
        return self.plain[name]

    def identity(self) -> dict[str, Any]:
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
            "fingerprint": self.about("fingerprint"),
        }

    def manifest(self) -> Manifest:
        base = self.identity()
        sizes, videos_per_shard = base["sizes"], base["videos_per_shard"]
        splits = {
            _text(split, "a split's name", SPLIT): _whole(count, f"splits.{split}", 1, 2**40)
            for split, count in _mapping(self.part("splits"), "splits", SPLITS, 1).items()
        }
        if sum(-(-count // videos_per_shard) for count in splits.values()) > SHARDS:
            _refuse("splits", dict(splits), f"{SHARDS:,} shards at most, of {videos_per_shard} videos each")
        fields = self.fields(sizes)
        return Manifest(
            **base,
            name=_text(self.part("name"), "name", NAME),
            splits=splits,
            frames={split: self.frames(split, sizes) for split in splits},
            rng=_text(self.part("rng"), "rng"),
            config_sha256=_text(self.part("config_sha256"), "config_sha256", HASH),
            fields=fields,
            fps=self.fps(),
            constants=self.constants(fields, sizes),
            conventions=_text(self.part("conventions"), "conventions"),
            licence=_text(self.part("licence"), "licence"),
            stats={split: self.stats(split, fields) for split in self.same(splits, "stats")},
            stats_sampled=_text(self.part("stats_sampled"), "stats_sampled"),
            tables={s: self.table(s, splits[s], videos_per_shard) for s in self.same(splits, "tables")},
            files=self.files(),
            producer=self.about("producer"),
            sha256=self.plain[SEAL],
            plain=self.plain,
        )

    def nested(self, part: str) -> dict[str, Any]:
        """A mapping of anything, of bounded depth."""
        level: list[Any] = [_mapping(self.part(part), part, 1000)]
        for _ in range(DEPTH):
            level = [v for value in level for v in (value.values() if isinstance(value, dict) else value)]
            level = [value for value in level if isinstance(value, dict | list)]
            if not level:
                return self.plain[part]
        raise _Wrong(f"{part} is nested deeper than {DEPTH} levels")

    def same(self, splits: Mapping[str, int], part: str) -> Mapping[str, int]:
        """The splits, which a part must have, too."""
        if _mapping(self.part(part), part, SPLITS).keys() != splits.keys():
            _refuse(f"the splits of {part}", sorted(self.part(part)), f"those of the dataset, {_shown(sorted(splits))}")
        return splits

    def about(self, part: str) -> Mapping[str, Any]:
        """Versions and the like: text and numbers, one level of mappings deep."""
        found: dict[str, Any] = {}
        for key, value in _mapping(self.part(part), part, 100).items():
            name = _text(key, f"a name in {part}", None, 200)
            if isinstance(value, dict):
                own = _mapping(value, f"{part}.{name}", 1000)
                found[name] = {
                    _text(k, f"a name in {part}.{name}", None, 400): self.word(v, name) for k, v in own.items()
                }
            else:
                found[name] = self.word(value, f"{part}.{name}")
        return found

    def word(self, value: Any, where: str) -> Any:
        return _text(value, where) if isinstance(value, str) else value if value is None else _number(value, where)

    def frames(self, split: str, sizes: Mapping[str, int]) -> int:
        own = self.plain["config"].get("splits")
        own = own.get(split) if isinstance(own, dict) else None
        frames = own.get("frames") if isinstance(own, dict) else None
        whole = sizes.get("T", 0)
        return whole if frames is None else _whole(frames, f"config.splits.{split}.frames", 1, whole)

    def fps(self) -> float:
        fps = _number(self.part("fps"), "fps")
        return fps if 0 < fps <= 1e6 else _refuse("fps", fps, "above 0 and 1e6 at most")

    def fields(self, sizes: Mapping[str, int]) -> dict[str, Field]:
        listed = _mapping(self.part("fields"), "fields", FIELDS, 1)
        fields = {
            _text(name, "a field's name", FIELD): self.field(name, value, sizes) for name, value in listed.items()
        }
        for name, kind in REQUIRED.items():
            own = fields.get(name)
            if own is None or (own.dtype, own.axes) != kind:
                _refuse(f"fields.{name}", own and f"{own.dtype} {own.axes}", " ".join(kind))
        pieces = sizes["T"] // (self.part("chunk_frames") or sizes["T"] or 1)
        video = pieces * len(image_names(fields)) * CHUNK.itemsize
        shard = 8 * MOMENTS * sum(measured(fields).values())
        if max(video, shard) > ROW_BYTES:
            _refuse("the size of an index", max(video, shard), f"{ROW_BYTES} bytes a row at most")
        return fields

    def field(self, name: str, value: Any, sizes: Mapping[str, int]) -> Field:
        where = f"fields.{name}"
        about = _mapping(value, where, 20)
        for part in ("dtype", "axes", "unit", "meaning", "shape", "codec"):
            if part not in about:
                raise _Wrong(f"{where} has no {part}")
        dtype = _text(about["dtype"], f"{where}.dtype", None, 20)
        if dtype not in DTYPES and not (re.fullmatch(r"S\d{1,7}", dtype) and 1 <= int(dtype[1:]) <= TEXT_BYTES):
            _refuse(f"{where}.dtype", dtype, f"one of {', '.join(DTYPES)}, or S and a number of bytes")
        axes = _text(about["axes"], f"{where}.axes", None, 200)
        for axis in axes.split(" ") if axes else []:
            if axis.isdigit():
                _whole(int(axis) if len(axis) < 8 else axis, f"{where}.axes", 1, 10**6)
            elif axis != "n" and axis not in sizes:
                _refuse(f"{where}.axes", axes, f"of the sizes {', '.join(sizes)}")
        if "n" in axes.split(" ")[1:]:
            _refuse(f"{where}.axes", axes, "with n first")
        field = Field(dtype, axes, _text(about["unit"], f"{where}.unit"), _text(about["meaning"], f"{where}.meaning"))
        if field.is_image and (axes.split()[:4] != ["n", "T", "H", "W"] or dtype.startswith("S")):
            _refuse(f"{where}.axes", axes, "n T H W, and more, where it is an image")
        if stored_bytes(field, sizes) > VIDEO_BYTES:
            _refuse(where, field.shape(sizes), f"of {VIDEO_BYTES} bytes at most")
        if about["shape"] != list(field.shape(sizes)):
            _refuse(f"{where}.shape", about["shape"], f"{list(field.shape(sizes))}, as its axes say")
        _one_of(about["codec"], f"{where}.codec", (self.plain["codec"] if field.is_image else "none",))
        if name == "frames" and (dtype != "uint8" or axes != "n T H W 3"):
            _refuse(where, f"{dtype} {axes}", "uint8 n T H W 3")
        if name == "objects/present" and (dtype != "bool" or axes != "n K"):
            _refuse(where, f"{dtype} {axes}", "bool n K")
        return field

    def constants(self, fields: Mapping[str, Field], sizes: Mapping[str, int]) -> dict[str, np.ndarray]:
        given = _mapping(self.part("constants"), "constants", FIELDS)
        names = {name for name, field in fields.items() if not field.per_video}
        if given.keys() != names:
            _refuse("the names of constants", sorted(given), f"those of the fields without n, {_shown(sorted(names))}")
        return {name: self.constant(name, fields[name], fields[name].shape(sizes)) for name in names}

    def constant(self, name: str, field: Field, shape: tuple[int, ...]) -> np.ndarray:
        value, dtype = self.plain["constants"][name], np.dtype(field.dtype)
        if dtype.kind not in "biuf" or math.prod(shape) > 10**6:
            _refuse(f"constants.{name}", value, "numbers, a million at most")
        if _has_shape(value, shape):
            with contextlib.suppress(ValueError, TypeError, OverflowError):
                found = np.array(value)
                fits = found.shape == shape and found.dtype.kind in ("b" if dtype.kind == "b" else "iuf")
                if fits and (found.astype(dtype) == found).all():
                    return found.astype(dtype)
        _refuse(f"constants.{name}", value, f"{dtype} {list(shape)}")

    def stats(self, split: str, fields: Mapping[str, Field]) -> Stats:
        where, known = f"stats.{split}", measured(fields)
        own = _mapping(self.part("stats")[split], where, FIELDS)
        if own.keys() != known.keys():
            _refuse(f"the fields of {where}", sorted(own), f"{_shown(sorted(known))}")
        found: Stats = {}
        for name, length in known.items():
            about = _mapping(own[name], f"{where}.{name}", 4, 4)
            found[name] = {
                key: self.moments(about, key, f"{where}.{name}", length) for key in ("mean", "std", "min", "max")
            }
        return found

    def moments(self, about: Mapping[str, Any], key: str, where: str, length: int) -> list[float] | None:
        if key not in about:
            raise _Wrong(f"{where} has no {key}")
        if about[key] is None:
            return None
        return [_number(value, f"{where}.{key}") for value in _list(about[key], f"{where}.{key}", length)]

    def table(self, split: str, videos: int, videos_per_shard: int) -> ShardTable:
        where = f"tables.{split}"
        about = _mapping(self.part("tables")[split], where, 5, 5)
        shards = -(-videos // videos_per_shard)
        return ShardTable(
            file=_one_of(about.get("file"), f"{where}.file", (table_name(split, videos),)),
            sha256=_text(about.get("sha256"), f"{where}.sha256", HASH),
            shards=_whole(about.get("shards"), f"{where}.shards", shards, shards),
            bytes=_whole(about.get("bytes"), f"{where}.bytes", 1, 2**62),
            largest=_whole(about.get("largest"), f"{where}.largest", 1, 2**50),
        )

    def files(self) -> dict[str, str]:
        found = {}
        for name, digest in _mapping(self.part("files"), "files", 2 * SPLITS).items():
            if name not in (CONFIG, SHEET) and not PLUGIN.fullmatch(name):
                _refuse("a name in files", name, f"{CONFIG}, {SHEET} or plugins/KIND/NAME.py")
            found[name] = _text(digest, f"files.{name}", HASH)
        return found


# ---- Writing


def describe(
    spec: DatasetSpec,
    splits: Mapping[str, int],
    tables: Mapping[str, ShardTable],
    stats: Mapping[str, Stats],
    files: Mapping[str, str],
) -> Manifest:
    """The manifest of a dataset with these tables and statistics by split; `files` are the hashes of the other files.

    No time, host or folder is in it: the same files give the same bytes.
    """
    plain = spec.identity | {
        "schema": SCHEMA,
        "name": spec.name,
        "splits": dict(splits),
        "rng": spec.rng,
        "config_sha256": sha256(as_json(spec.config)),
        "fields": {name: _described(field, spec) for name, field in spec.fields.items()},
        "fps": spec.fps,
        "constants": {name: np.asarray(values).tolist() for name, values in spec.constants.items()},
        "conventions": spec.conventions,
        "licence": spec.licence,
        "stats": stats,
        "stats_sampled": SAMPLED,
        "tables": {split: dataclasses.asdict(table) for split, table in tables.items()},
        "files": dict(files),
        "producer": {key: value for key, value in spec.producer.items() if key != "fingerprint"},
    }
    # As it will be read back: JSON makes every key a string and every tuple a list.
    return parse(as_json(sealed(json.loads(as_json(plain)), SEAL)), "the manifest")


def _described(field: Field, spec: DatasetSpec) -> dict[str, Any]:
    codec = spec.codec if field.is_image else "none"
    return dataclasses.asdict(field) | {"shape": field.shape(spec.sizes), "codec": codec}


def statistics(manifest: Manifest) -> Iterator[tuple[str, ...]]:
    """The stored statistics as rows for a person: split, field, mean, standard deviation, least and largest value."""
    for split, fields in sorted(manifest.stats.items()):
        for name, about in fields.items():
            parts = (about[key] for key in ("mean", "std", "min", "max"))
            yield split, name, *(", ".join(f"{x:.4g}" for x in part) if part else "-" for part in parts)
