"""The manifest: everything about a complete dataset, sealed with a hash, and the index of where each piece lies."""

import dataclasses
import io
import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from gen2d.core.errors import DamagedError, FolderError
from gen2d.core.schema import Field
from gen2d.dataset.block import MOMENTS_OF, image_names, merged, row_names
from gen2d.dataset.spec import IDENTITY, MARK, SCHEMA, Dataset, Shard, mark_path, record_path, table_path
from gen2d.storage.atomic import as_json, file_sha256, publishing, read_sealed, sealed, sha256, unsealed
from gen2d.storage.paths import Place, reading

Record = Mapping[str, Any]  # of a shard that is done, as shards.py writes it
Tables = dict[str, np.ndarray]

# Where each file keeps the hash of all else in it.
SEAL, MARK_SEAL, RECORD_SEAL = "manifest_sha256", "identity_sha256", "record_sha256"


def read_manifest(root: Place) -> dict[str, Any]:
    """The manifest of a complete dataset.

    Raises FolderError if the folder is no dataset or not complete, DamagedError if a byte of the manifest changed.
    """
    path = root / "manifest.json"
    try:
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        with reading(root):
            begun = (root / MARK).is_dir()
        if not begun:
            raise FolderError(f"{root} is not a gen2d dataset: it has no manifest.json") from None
        told = "run the command that made it again, and it goes on where it stopped"
        raise FolderError(f"{root} is incomplete: {told}") from None
    except OSError as error:
        raise FolderError(f"{path} cannot be read ({error.strerror or error})") from error
    manifest = unsealed(content, SEAL)
    if manifest is None:
        raise DamagedError(f"{path} is not what was written")
    if manifest["schema"] != SCHEMA:
        raise FolderError(f"{path} has schema {manifest['schema']}, but this gen2d reads {SCHEMA}")
    return manifest


def identity_of(root: Place) -> dict[str, Any] | None:
    """What the dataset in the folder was made from, as its manifest says or else its mark; None if neither is whole."""
    there = read_sealed(root / "manifest.json", SEAL) or read_sealed(mark_path(root), MARK_SEAL)
    return None if there is None else {key: there[key] for key in IDENTITY}


def read_record(root: Place, name: str) -> dict[str, Any] | None:
    """The record of the shard called `name`; None if there is none or any byte of it changed."""
    return read_sealed(record_path(root, name), RECORD_SEAL)


def field_of(about: Mapping[str, Any]) -> Field:
    """The field that an entry of the manifest's `fields` describes."""
    return Field(*(about[part.name] for part in dataclasses.fields(Field)))


def describe(
    dataset: Dataset, shards: Iterable[Shard], records: list[Record], files: Mapping[str, str]
) -> dict[str, Any]:
    """The manifest of these shards; `files` are the hashes of the other files, by name.

    No time, host or folder is in it: the same files give the same bytes.
    """
    shown = ("name", "split", "first", "count", "bytes", "sha256")
    splits = {shard.split: shard.first + shard.count for shard in shards}
    manifest = dataset.identity | {
        "schema": SCHEMA,
        "name": dataset.name,
        "splits": splits,
        "rng": dataset.rng,
        "config_sha256": sha256(as_json(dataset.config)),
        "fields": {name: _described(field, dataset) for name, field in dataset.fields.items()},
        "fps": dataset.fps,
        "constants": {name: np.asarray(values).tolist() for name, values in dataset.constants.items()},
        "conventions": dataset.conventions,
        "licence": dataset.licence,
        "stats": {split: _stats([record for record in records if record["split"] == split]) for split in splits},
        "stats_sampled": MOMENTS_OF,
        "shards": [{key: record[key] for key in shown} for record in records],
        "files": files,
        "producer": {key: value for key, value in dataset.producer.items() if key != "fingerprint"},
    }
    # As it will be read back: JSON makes every key a string and every tuple a list.
    return sealed(json.loads(as_json(manifest)), SEAL)


def _described(field: Field, dataset: Dataset) -> dict[str, Any]:
    codec = dataset.codec if field.is_image else "none"
    return dataclasses.asdict(field) | {"shape": field.shape(dataset.sizes), "codec": codec}


def _stats(records: list[Record]) -> dict[str, dict[str, list[float] | None]]:
    """Mean, standard deviation, least and largest value of each channel or component, by field."""
    stats = {}
    for name in sorted(records[0]["moments"]):
        count, total, squares, low, high = merged(np.array([record["moments"][name] for record in records]))
        with np.errstate(all="ignore"):
            mean = total / count
            spread = np.sqrt(np.maximum(squares / count - mean**2, 0))
        # JSON has no word for a value that does not exist.
        values = {"mean": mean, "std": spread, "min": low, "max": high}
        stats[name] = {key: value.tolist() if np.isfinite(value).all() else None for key, value in values.items()}
    return stats


def statistics(manifest: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """The stored statistics as rows for a person: split, field, mean, standard deviation, least and largest value."""
    for split, fields in sorted(manifest["stats"].items()):
        for name, about in fields.items():
            parts = (about[key] for key in ("mean", "std", "min", "max"))
            yield split, name, *(", ".join(f"{x:.4g}" for x in part) if part else "-" for part in parts)


# ---- The index


def write_index(dataset: Dataset, shards: list[Shard], records: list[Record]) -> dict[str, str]:
    """The sha256 of each file of the index, by its name in the folder; afterwards the files are there."""
    hashes = {}
    for field, table in _index(dataset, shards, records).items():
        name = f"index/{field}.npy"
        path = dataset.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with publishing(path) as temporary:
            with temporary.open("wb") as file:
                np.save(file, table, allow_pickle=False)
            hashes[name] = file_sha256(temporary)
    return hashes


def _index(dataset: Dataset, shards: list[Shard], records: list[Record]) -> Tables:
    """Where every piece lies and its checksum: a row per chunk or video in the order of the shards, one per shard."""
    images, rows = image_names(dataset.fields), row_names(dataset.fields)
    total, frames = sum(shard.count for shard in shards), dataset.chunk_frames
    pieces = dataset.sizes["T"] // frames if frames else 1
    chunk = np.dtype([("shard", "<u4"), ("offset", "<u8"), ("size", "<u8"), ("crc32", "<u4")])
    index: Tables = {name: np.zeros((total, pieces), chunk) for name in images}
    index["videos"] = np.zeros(total, [("shard", "<u4"), ("row", "<u4"), *((name, "<u4") for name in rows)])
    start = 0
    for shard in shards:
        own = {name: table[start : start + shard.count] for name, table in index.items()}
        _fill(own, shard, images, rows, table_path(dataset.root, shard.name))
        start += shard.count
    places = [tuple(record["rows"][name] for name in rows) for record in records]
    index |= {name: index[name].reshape(-1) for name in images}
    return index | {"shards": np.array(places, [(name, "<u8") for name in rows])}


def _fill(own: Tables, shard: Shard, images: list[str], rows: list[str], path: Place) -> None:
    """Puts a shard's tables into its rows of the index."""
    videos = own["videos"]
    videos["shard"], videos["row"] = shard.number, np.arange(shard.count)
    with np.load(io.BytesIO(path.read_bytes())) as tables:
        for name in rows:
            videos[name] = tables[f"crc/{name}"]
        for name in images:
            shape = own[name].shape
            own[name]["shard"], own[name]["crc32"] = shard.number, tables[f"crc/{name}"].reshape(shape)
            own[name]["offset"], own[name]["size"] = (part.reshape(shape) for part in tables[f"chunks/{name}"].T)
