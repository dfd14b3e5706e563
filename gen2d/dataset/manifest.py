"""The manifest: everything about a complete dataset, in one JSON file that carries its own hash.

It is the only entrance for what strangers write: `parse` turns bytes into a checked `Manifest`, or refuses them.
"""

import dataclasses
import functools
import json
from collections.abc import Iterator, Mapping
from typing import Any, TypeGuard

import numpy as np

from gen2d.core.errors import DamagedError, FolderError, IncompleteError
from gen2d.core.schema import Field
from gen2d.dataset.block import row_names, stored_bytes
from gen2d.dataset.manifest_parser import HASH, InvalidValueError, ManifestParser, ShardTable
from gen2d.dataset.rows import shard_type, video_type
from gen2d.dataset.spec import (
    EARLIER_SCHEMA,
    IDENTITY,
    MANIFEST,
    MARK,
    SCHEMA,
    SCHEMAS,
    DatasetSpec,
    mark_path,
    snapshot_path,
)
from gen2d.dataset.statistics import SAMPLED, Stats
from gen2d.storage.explain import reading_error
from gen2d.storage.paths import Place, Url, reading
from gen2d.storage.sealed import JSON_BYTES, as_json, parse_json, read_bytes, read_sealed, seal, sha256, unseal

# The key in each file of the hash of everything else in it.
SEAL, MARK_SEAL = "manifest_sha256", "identity_sha256"


@dataclasses.dataclass(frozen=True)
class Manifest:
    """What a complete dataset holds; every value is checked."""

    name: str
    splits: Mapping[str, int]  # number of videos of each split
    frames: Mapping[str, int]  # number of leading frames of each split's videos that readers get
    seed: int
    rng: str
    config: Mapping[str, Any]  # unchecked here; checked when it is read as a config
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
    sha256: str  # of the manifest itself; it names the snapshot
    plain: Mapping[str, Any] = dataclasses.field(repr=False)  # as in JSON

    @property
    def identity(self) -> dict[str, Any]:
        """The values that another run must share to add to this dataset."""
        return {key: self.plain[key] for key in IDENTITY}

    @property
    def schema(self) -> str:
        """The schema of its files, one of SCHEMAS."""
        return self.plain["schema"]

    @functools.cached_property
    def identity_sha256(self) -> str:
        """The sha256 of the identity."""
        return sha256(as_json(self.identity))

    @property
    def pieces(self) -> int:
        """The number of chunks of a video's image."""
        return self.sizes["T"] // self.chunk_frames if self.chunk_frames else 1

    @property
    def shard_type(self) -> np.dtype:
        """The dtype of a shard's row in a table."""
        return shard_type(self.fields)

    @property
    def video_type(self) -> np.dtype:
        """The dtype of a video's row in a shard's index."""
        return video_type(self.fields, self.pieces)

    @property
    def row_bytes(self) -> list[int]:
        """The bytes of a video in each uncompressed field, in the order of the names."""
        return [stored_bytes(self.fields[name], self.sizes) for name in row_names(self.fields)]

    @property
    def raw_bytes(self) -> int:
        """The bytes of a video in all fields before compression."""
        return sum(stored_bytes(field, self.sizes) for field in self.fields.values())

    def codec_of(self, name: str) -> str:
        """The codec of a field."""
        return self.codec if self.fields[name].is_image else "none"


def as_bytes(manifest: Manifest) -> bytes:
    """The content of the manifest's file."""
    return as_json(manifest.plain)


# ---- Reading


def read_manifest(root: Place, snapshot: str | None = None) -> Manifest:
    """The manifest of a complete dataset, or of an earlier snapshot of it.

    Raises IncompleteError if the folder holds no complete dataset, FolderError if it cannot be read or no longer has
    the snapshot, DamagedError if the manifest changed since it was written or holds impossible values, and
    UnreachableError.
    """
    current = _read(root, root / MANIFEST, snapshot is not None)
    if snapshot is None or (current is not None and current.sha256 == snapshot):
        assert current is not None
        return current
    path = snapshot_path(root, snapshot) / MANIFEST
    earlier = _read(root, path, True) if HASH.fullmatch(snapshot) else None
    if earlier is None or earlier.sha256 != snapshot:
        raise FolderError(
            f"{root} has grown since, and its snapshot {snapshot[:16]} is no longer there: open the dataset anew"
        )
    return earlier


def is_begun(root: Place) -> bool:
    """Whether the folder is marked as a dataset, finished or not."""
    return mark_path(root).exists() if isinstance(root, Url) else (root / MARK).is_dir()


def _read(root: Place, path: Place, optional: bool) -> Manifest | None:
    try:
        content = read_bytes(path, JSON_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        if optional:
            return None
        with reading(root):
            begun = is_begun(root)
        if not begun:
            raise IncompleteError(f"{root} is not a gen2d dataset: it has no {MANIFEST}") from None
        raise IncompleteError(
            f"{root} is incomplete: run the command that made it again, and it goes on where it stopped"
        ) from None
    except OSError as error:
        if isinstance(path, Url) and isinstance(error, PermissionError):
            raise FolderError(f"{path} cannot be read: permission denied") from None
        raise reading_error(path, error) from error
    return parse(content, f"{path}")


def parse(content: bytes, source: str) -> Manifest:
    """The manifest in these bytes; error messages name `source`.

    Raises DamagedError for bytes that the generator cannot have written, FolderError for another schema.
    """
    plain = unseal(content, SEAL)
    if plain is None:
        raise DamagedError(f"{source} is not what was written")
    schema = plain.get("schema")
    if schema not in SCHEMAS:
        raise FolderError(
            f"{source} has {f'the schema {schema}' if _is_schema(schema) else 'an unknown schema'}, but this gen2d "
            f"reads {SCHEMA}: make the dataset anew"
        )
    try:
        return Manifest(**ManifestParser(plain).values(), sha256=plain[SEAL], plain=plain)
    except InvalidValueError as error:
        raise DamagedError(f"{source} is not a valid manifest: {error}") from None


def identity_of(root: Place) -> dict[str, Any] | None:
    """The identity of the dataset in the folder, from its manifest or its mark; None if neither is intact."""
    for path, key in ((root / MANIFEST, SEAL), (mark_path(root), MARK_SEAL)):
        values = read_sealed(path, key)
        if values is not None:
            identity = {key: values.get(key) for key in IDENTITY}
            try:
                ManifestParser(identity).identity()
            except InvalidValueError as error:
                raise DamagedError(f"{path} holds no valid dataset identity: {error}") from None
            return identity
    return None


def schema_of(root: Place) -> str | None:
    """The schema that the folder's manifest names, whichever it is; None if there is none."""
    try:
        schema = (parse_json(read_bytes(root / MANIFEST, JSON_BYTES)) or {}).get("schema")
    except OSError:
        return None
    return schema if _is_schema(schema) else None


def folder_schema(root: Place, default: str) -> str:
    """The schema that all files of the folder's dataset have; `default` if there is none yet, or if it is damaged.

    The marks of EARLIER_SCHEMA name none.
    """
    for path, key in ((root / MANIFEST, SEAL), (mark_path(root), MARK_SEAL)):
        values = read_sealed(path, key)
        if values is not None:
            schema = values.get("schema", EARLIER_SCHEMA)
            return schema if schema in SCHEMAS else default
    return default


def _is_schema(schema: object) -> TypeGuard[str]:
    """Whether this value can be the name of a schema."""
    return isinstance(schema, str) and len(schema) < 100 and schema.isprintable()


# ---- Writing


def describe(
    spec: DatasetSpec,
    splits: Mapping[str, int],
    tables: Mapping[str, ShardTable],
    stats: Mapping[str, Stats],
    files: Mapping[str, str],
) -> Manifest:
    """The manifest of a dataset with these tables and statistics by split; `files` are the hashes of the other files.

    It contains no time, host or folder: the same dataset gives the same bytes.
    """
    plain = spec.identity | {
        "schema": folder_schema(spec.root, spec.schema),
        "name": spec.name,
        "splits": dict(splits),
        "rng": spec.rng,
        "config_sha256": sha256(as_json(spec.config)),
        "fields": {
            name: dataclasses.asdict(field)
            | {"shape": field.shape(spec.sizes), "codec": spec.codec if field.is_image else "none"}
            for name, field in spec.fields.items()
        },
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
    # As it will be read: JSON makes every key a string and every tuple a list.
    return parse(as_json(seal(json.loads(as_json(plain)), SEAL)), "the manifest")


def statistics(manifest: Manifest) -> Iterator[tuple[str, ...]]:
    """Rows of a table of the statistics: split, field, mean, standard deviation, minimum and maximum."""
    for split, fields in sorted(manifest.stats.items()):
        for name, moments in fields.items():
            parts = (moments[key] for key in ("mean", "std", "min", "max"))
            yield split, name, *(", ".join(f"{x:.4g}" for x in part) if part else "-" for part in parts)
