"""A dataset folder: which shards it has, how one is written so that a crash cannot hurt it, and what completes it.

    plan -> open_folder -> (encode -> write) for each shard -> finish

A shard is written under a temporary name, hashed, and renamed; its record under ``.gen2d/done`` follows. A shard is
done if its record fits and its file has the recorded size, so whatever a crash leaves is made again. Workers share
nothing: each takes its shards by their number, and whoever finds all records writes the index, the cards and, last, the
manifest.
"""

import contextlib
import dataclasses
import errno
import hashlib
import io
import json
import os
import shutil
import socket
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.errors import DamagedError, FolderError
from gen2d.fields import Field
from gen2d.formats import MOMENTS_OF, Block, encode, hdf5, head, merged

__all__ = [
    "Block", "Dataset", "Shard", "encode", "file_sha256", "finish", "forget", "free_bytes", "head", "log", "mine",
    "open_folder", "plan", "read_manifest", "write",
]  # fmt: skip

SCHEMA = "gen2d.dataset/1"

_HOST = socket.gethostname()
_MARK = Path(".gen2d")
# What must agree before shards of two runs may stand in one folder; the manifest has the same keys.
_IDENTITY = ("config", "seed", "fingerprint", "codec", "videos_per_shard", "sizes")


# ---- Which shards there are


@dataclasses.dataclass(frozen=True)
class Shard:
    """`count` videos of one split from number `first` on; `number` is the shard's place in the whole plan."""

    name: str
    split: str
    first: int
    count: int
    number: int


def plan(counts: Mapping[str, int], videos_per_shard: int) -> list[Shard]:
    """All shards of a dataset with these many videos in each split."""
    shards: list[Shard] = []
    for split, count in sorted(counts.items()):
        for place, first in enumerate(range(0, count, videos_per_shard)):
            size = min(videos_per_shard, count - first)
            shards.append(Shard(f"{split}-{place:05d}", split, first, size, number=len(shards)))
    return shards


def mine(shards: Iterable[Shard], worker: int, workers: int) -> list[Shard]:
    """The shards that worker number `worker` of `workers` makes, whatever the others have done so far."""
    return [shard for shard in shards if shard.number % workers == worker]


# ---- The folder


@dataclasses.dataclass(frozen=True)
class Dataset:
    """What a folder is to hold."""

    root: Path
    name: str
    fields: Mapping[str, Field]
    sizes: Mapping[str, int]  # of the axes that are letters
    seed: int
    config: Mapping[str, Any]  # plain values, as JSON has them
    config_text: str  # the same, resolved, as YAML
    producer: Mapping[str, Any]  # versions and the like; under 'fingerprint' what decides the simulated bits
    splits: Mapping[str, int]  # how many videos of each
    videos_per_shard: int
    codec: str
    fps: float
    constants: Mapping[str, np.ndarray]  # the fields that are one for all videos
    conventions: str = ""
    rng: str = "threefry2x32"
    command: str = ""
    licence: str = ""

    @property
    def identity(self) -> dict[str, Any]:
        """What another run must share to add to this folder."""
        values = vars(self) | {"fingerprint": self.producer["fingerprint"]}
        return json.loads(_dumps({key: values[key] for key in _IDENTITY}))


def open_folder(dataset: Dataset, overwrite: bool = False) -> list[Shard]:
    """The shards that remain to be made, in a folder that is ready for them.

    Videos that are there already stay, also those beyond what was asked. While shards remain, the folder has no
    manifest. Raises FolderError for a folder that is not this dataset's, or cannot be written.
    """
    root = dataset.root
    with _explained(root):
        if overwrite and _is_dataset(root):
            _clear(root)
        _claim(dataset)
        _sweep(root)
        records = _records(dataset)
        remaining = [shard for shard in _whole_plan(dataset, records) if not _is_done(dataset, shard, records)]
        if remaining:
            (root / "manifest.json").unlink(missing_ok=True)
        return remaining


def forget(root: Path, name: str) -> None:
    """Returns nothing; the shard called `name` counts as not made, so that the next run makes it again."""
    (root / _MARK / "done" / f"{name}.json").unlink(missing_ok=True)


def free_bytes(path: Path) -> int:
    """How much the disk that holds `path`, or will, can take."""
    path = path.absolute()
    return shutil.disk_usage(next(place for place in (path, *path.parents) if place.exists())).free


def log(root: Path, entry: Mapping[str, Any]) -> None:
    """Returns nothing; adds a line to the folder's run log, which is where times and hosts belong."""
    with (root / _MARK / "run.jsonl").open("a") as file:
        file.write(json.dumps(dict(entry), sort_keys=True) + "\n")


def _is_dataset(root: Path) -> bool:
    return (root / _MARK).is_dir() or (_parsed(root / "manifest.json") or {}).get("schema") == SCHEMA


def _clear(root: Path) -> None:
    """Removes what this module writes and no more; the mark stays, so that a crash here leaves a dataset's folder."""
    (root / _MARK).mkdir(exist_ok=True)
    for name in ("manifest.json", "croissant.json", "README.md", "config.yaml", _MARK / "dataset.json"):
        (root / name).unlink(missing_ok=True)
    for name in ("shards", "index", _MARK / "done"):
        shutil.rmtree(root / name, ignore_errors=True)


def _claim(dataset: Dataset) -> None:
    root = dataset.root
    if root.is_dir() and not _is_dataset(root) and any(root.iterdir()):
        raise FolderError(f"{root} holds something else than a gen2d dataset: choose another --out")
    for folder in (_MARK / "done", "shards", "index"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    mark = root / _MARK / "dataset.json"
    there = _parsed(root / "manifest.json") or _parsed(mark)
    if there is None and mark.exists():
        raise FolderError(f"{mark} is damaged: choose another --out, or --overwrite to make the dataset anew")
    if there is None:
        return _publish(mark, _dumps(dataset.identity))
    differing = list(_differences({key: there.get(key) for key in _IDENTITY}, dataset.identity))
    if differing:
        told = " and ".join(differing[:3])
        raise FolderError(f"{root} holds another dataset ({told}): choose another --out, or --overwrite to replace it")


def _differences(there: Any, here: Any, name: str = "") -> Iterator[str]:
    if isinstance(there, dict) and isinstance(here, dict):
        for key in sorted(there.keys() | here.keys()):
            yield from _differences(there.get(key), here.get(key), f"{name}.{key}".lstrip("."))
    elif there != here:
        yield f"{name} is {there} there and {here} here"


def _sweep(root: Path) -> None:
    """Removes what dead processes of this host left behind; of other hosts nothing is known."""
    for path in root.rglob(f"*.tmp.{_HOST}.*"):
        process = path.name.rpartition(".")[2]
        if process.isdigit() and not _is_alive(int(process)):
            path.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # someone else's, so it lives
    return True


@contextlib.contextmanager
def _explained(root: Path) -> Iterator[None]:
    try:
        yield
    except (FileExistsError, NotADirectoryError) as error:
        raise FolderError(f"{error.filename} is a file, not a folder: choose another --out") from error
    except PermissionError as error:
        raise FolderError(f"you have no permission to write in {error.filename}: choose another --out") from error
    except OSError as error:
        if error.errno != errno.EROFS:
            raise
        raise FolderError(f"{root} is on a disk that is read-only: choose another --out") from error


# ---- One shard


def write(dataset: Dataset, shard: Shard, blocks: Iterable[Block]) -> dict[str, Any]:
    """The record of the shard that `blocks` became; afterwards it is done, whatever happens to the machine.

    Raises FolderError when the disk is full. Whatever is raised, here or by `blocks`, nothing half-written stays.
    """
    seen = _Seen()
    try:
        return _write(dataset, shard, seen.passing(blocks), seen)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise _full(dataset, shard, seen) from error


class _Seen:
    """What is kept of the blocks that pass on their way into a file."""

    def __init__(self) -> None:
        self.crc: dict[str, list[np.ndarray]] = {}
        self.moments: dict[str, list[np.ndarray]] = {}
        self.videos = self.bytes = 0

    def passing(self, blocks: Iterable[Block]) -> Iterator[Block]:
        for block in blocks:
            for name, values in block.crc.items():
                self.crc.setdefault(name, []).append(values)
            for name, values in block.moments.items():
                self.moments.setdefault(name, []).append(values)
            self.videos += len(block)
            self.bytes += block.nbytes
            yield block


def _write(dataset: Dataset, shard: Shard, blocks: Iterable[Block], seen: _Seen) -> dict[str, Any]:
    about = {"schema": SCHEMA, "name": dataset.name, "split": shard.split, "first": shard.first}
    about |= {"fps": dataset.fps, "seed": dataset.seed, "conventions": dataset.conventions}
    layout = dataset.fields, dataset.sizes, shard.count
    with _publishing(_shard_path(dataset.root, shard.name)) as temporary:
        places = hdf5.write(temporary, *layout, blocks, dataset.codec, about, dataset.constants)
        size, digest = temporary.stat().st_size, file_sha256(temporary)
    tables = {f"crc/{name}": np.concatenate(values) for name, values in seen.crc.items()}
    tables |= {f"chunks/{name}": values for name, values in places.chunks.items()}
    packed = io.BytesIO()
    np.savez(packed, **tables)  # pyright: ignore[reportArgumentType]
    _publish(_table_path(dataset.root, shard.name), packed.getvalue())
    record = dataclasses.asdict(shard) | {
        "bytes": size,
        "sha256": digest,
        "identity": _sha256(_dumps(dataset.identity)),
        "config_sha256": _sha256(_dumps(dataset.config)),
        "seed": dataset.seed,
        "fingerprint": dict(dataset.producer["fingerprint"]),
        "data_bytes": seen.bytes,
        "tables_sha256": _sha256(packed.getvalue()),
        "rows": dict(places.rows),
        "moments": {name: merged(np.concatenate(parts)).tolist() for name, parts in seen.moments.items()},
    }
    _publish(dataset.root / _MARK / "done" / f"{shard.name}.json", _dumps(record))
    return record


def _full(dataset: Dataset, shard: Shard, seen: _Seen) -> FolderError:
    raw = sum(
        np.dtype(field.dtype).itemsize * int(np.prod(field.shape(dataset.sizes))) for field in dataset.fields.values()
    )
    need = shard.count * (seen.bytes / seen.videos if seen.videos else raw)
    free = free_bytes(dataset.root)
    error = FolderError(
        f"no space left for {dataset.root}: {shard.name} needs about {need / 1e6:.1f} MB and {free / 1e6:.1f} MB are "
        f"free, so at least {max(need - free, 0) / 1e6:.1f} MB are missing: make room and run the same command again"
    )
    error.exit_code = 1
    return error


def _shard_path(root: Path, name: str) -> Path:
    return root / "shards" / f"{name}.h5"


def _table_path(root: Path, name: str) -> Path:
    return root / _MARK / "done" / f"{name}.npz"


def _records(dataset: Dataset) -> dict[str, dict[str, Any]]:
    """The records in the folder that are of this dataset, by shard."""
    identity = _sha256(_dumps(dataset.identity))
    parsed = (_parsed(path) for path in sorted((dataset.root / _MARK / "done").glob("*.json")))
    return {record["name"]: record for record in parsed if record and record.get("identity") == identity}


def _whole_plan(dataset: Dataset, records: Mapping[str, Mapping[str, Any]]) -> list[Shard]:
    """The plan for what was asked and for all that is there."""
    counts = dict(dataset.splits)
    for record in records.values():
        counts[record["split"]] = max(counts.get(record["split"], 0), record["first"] + record["count"])
    return plan(counts, dataset.videos_per_shard)


def _is_done(dataset: Dataset, shard: Shard, records: Mapping[str, Mapping[str, Any]]) -> bool:
    record = records.get(shard.name, {})
    file, tables = _shard_path(dataset.root, shard.name), _table_path(dataset.root, shard.name)
    return (
        all(record.get(key) == getattr(shard, key) for key in ("split", "first", "count"))
        and file.is_file()
        and file.stat().st_size == record["bytes"]
        and tables.is_file()
        and file_sha256(tables) == record["tables_sha256"]
    )


# ---- The whole


def finish(dataset: Dataset) -> bool:
    """Whether the dataset is complete; if it is, its index, cards and manifest are written.

    False while shards are missing that other workers still make.
    """
    records = _records(dataset)
    shards = _whole_plan(dataset, records)
    if not all(_is_done(dataset, shard, records) for shard in shards):
        return False
    with _explained(dataset.root):
        done = [records[shard.name] for shard in shards]
        index = _index(dataset, shards, done)
        files = dict(_write_index(dataset.root, name, table) for name, table in index.items())
        _publish(dataset.root / "config.yaml", dataset.config_text.encode())
        files["config.yaml"] = _sha256(dataset.config_text.encode())
        manifest = _manifest(dataset, shards, done, files)
        _publish(dataset.root / "README.md", _card(dataset, manifest).encode())
        _publish(dataset.root / "croissant.json", _dumps(_croissant(dataset, manifest)))
        _publish(dataset.root / "manifest.json", _dumps(manifest))
    return True


def read_manifest(root: Path) -> dict[str, Any]:
    """The manifest of a complete dataset.

    Raises FolderError if the folder is no dataset or not complete, DamagedError if a byte of the manifest changed.
    """
    path = root / "manifest.json"
    if not path.is_file():
        if not (root / _MARK).is_dir():
            raise FolderError(f"{root} is not a gen2d dataset: it has no manifest.json")
        raise FolderError(f"{root} is incomplete: run the command that made it again, and it goes on where it stopped")
    manifest = _parsed(path)
    if manifest is None or path.read_bytes() != _dumps(_sealed(manifest)):
        raise DamagedError(f"{path} is not what was written")
    if manifest["schema"] != SCHEMA:
        raise FolderError(f"{path} has schema {manifest['schema']}, but this gen2d reads {SCHEMA}")
    return manifest


def _sealed(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest with the hash of all else in it."""
    rest = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return rest | {"manifest_sha256": _sha256(_dumps(rest))}


def _manifest(
    dataset: Dataset, shards: Iterable[Shard], records: list[dict[str, Any]], files: Mapping[str, str]
) -> dict[str, Any]:
    """No time, host or folder is in it: the same files give the same bytes."""
    shown = ("name", "split", "first", "count", "bytes", "sha256")
    splits: dict[str, int] = {}
    for shard in shards:
        splits[shard.split] = shard.first + shard.count
    manifest = dataset.identity | {
        "schema": SCHEMA,
        "name": dataset.name,
        "splits": splits,
        "rng": dataset.rng,
        "config_sha256": _sha256(_dumps(dataset.config)),
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
    return _sealed(json.loads(_dumps(manifest)))


def _described(field: Field, dataset: Dataset) -> dict[str, Any]:
    codec = dataset.codec if field.is_image else "none"
    return dataclasses.asdict(field) | {"shape": field.shape(dataset.sizes), "codec": codec}


def _stats(records: list[dict[str, Any]]) -> dict[str, dict[str, list[float] | None]]:
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


def _index(dataset: Dataset, shards: list[Shard], records: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Where every piece lies and its checksum: a row per video in the order of the shards, and one per shard."""
    images = sorted(name for name, field in dataset.fields.items() if field.is_image)
    rows = sorted(name for name, field in dataset.fields.items() if field.per_video and not field.is_image)
    total = sum(shard.count for shard in shards)
    chunk = np.dtype([("shard", "<u4"), ("offset", "<u8"), ("size", "<u8"), ("crc32", "<u4")])
    index = {name: np.zeros(total, chunk) for name in images}
    index["videos"] = np.zeros(total, [("shard", "<u4"), ("row", "<u4"), *((name, "<u4") for name in rows)])
    index["shards"] = np.zeros(len(shards), [(name, "<u8") for name in rows])
    start = 0
    for shard, record in zip(shards, records, strict=True):
        here = slice(start, start + shard.count)
        start += shard.count
        index["shards"][shard.number] = tuple(record["rows"][name] for name in rows)
        index["videos"]["shard"][here] = shard.number
        index["videos"]["row"][here] = np.arange(shard.count)
        with np.load(_table_path(dataset.root, shard.name)) as tables:
            for name in rows:
                index["videos"][name][here] = tables[f"crc/{name}"]
            for name in images:
                index[name]["shard"][here] = shard.number
                index[name]["offset"][here], index[name]["size"][here] = tables[f"chunks/{name}"].T
                index[name]["crc32"][here] = tables[f"crc/{name}"]
    return index


def _write_index(root: Path, name: str, table: np.ndarray) -> tuple[str, str]:
    """The file's name in the folder, and its sha256."""
    path = root / "index" / f"{name}.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    with _publishing(path) as temporary:
        with temporary.open("wb") as file:
            np.save(file, table, allow_pickle=False)
        return path.relative_to(root).as_posix(), file_sha256(temporary)


# ---- The cards


def _card(dataset: Dataset, manifest: Mapping[str, Any]) -> str:
    """The README of the dataset."""
    splits, fields = manifest["splits"], manifest["fields"]
    lines = (f"| {name} | {a['dtype']} | {a['axes']} | {a['unit']} | {a['meaning']} |" for name, a in fields.items())
    return _CARD.format(
        name=dataset.name,
        counts=", ".join(f"{count} {split}" for split, count in splits.items()),
        fps=dataset.fps,
        rows="\n".join(lines),
        sizes=", ".join(f"{axis} = {size}" for axis, size in sorted(dataset.sizes.items())),
        conventions=dataset.conventions,
        split="train" if "train" in splits else min(splits),
        field="frames" if "frames" in fields else min(fields),
        plugin=", hdf5plugin" if dataset.codec == "zstd" else "",
        command=dataset.command or "gen2d",
        seed=dataset.seed,
        licence=dataset.licence or "None was chosen: choose one before publishing.",
    )


_CARD = """# {name}

Rendered videos of two-dimensional rigid bodies with everything that is true about them: {counts} videos,
{fps:g} frames per second.

## What it holds

| field | dtype | axes | unit | meaning |
|---|---|---|---|---|
{rows}

Sizes: n videos, {sizes}. {conventions}

## How to load it

With gen2d, as NumPy arrays:

```python
import gen2d
dataset = gen2d.open("{name}", split="{split}")
video = dataset[0]
```

With PyTorch:

```python
import gen2d, torch
dataset = gen2d.open("{name}", split="{split}")
loader = torch.utils.data.DataLoader(dataset, batch_size=32, shuffle=True, num_workers=2)
```

With h5py alone:

```python
import h5py{plugin}
file = h5py.File("{name}/shards/{split}-00000.h5")
video = file["{field}"][0]
```

`manifest.json` describes every field and file, with checksums; `config.yaml` is the recipe.

## How it was made

By `{command}` with seed {seed}. The same recipe, seed and versions make the same videos.

## Licence

{licence}
"""


def _croissant(dataset: Dataset, manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The dataset in Croissant 1.0 (https://docs.mlcommons.org/croissant/docs/croissant-spec.html)."""
    columns = {"name": "sc:Text", "split": "sc:Text", "first": "sc:Integer", "count": "sc:Integer"}
    shards = [
        _file_object(f"shards/{shard['name']}.h5", "application/x-hdf5", shard["bytes"], shard["sha256"])
        for shard in manifest["shards"]
    ]
    text = _dumps(manifest)
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": dataset.name,
        "description": "Rendered videos of two-dimensional rigid bodies with full ground truth, made by gen2d.",
        "license": dataset.licence,
        "version": "1.0.0",
        "variableMeasured": [
            {"@type": "sc:PropertyValue", "name": name, "unitText": about["unit"], "description": about["meaning"]}
            for name, about in manifest["fields"].items()
        ],
        "distribution": [_file_object("manifest.json", "application/json", len(text), _sha256(text)), *shards],
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": "shards",
                "name": "shards",
                "description": "The HDF5 files, each with consecutive videos of one split.",
                "field": [_croissant_field(name, kind) for name, kind in columns.items()],
            }
        ],
    }


def _file_object(path: str, kind: str, size: int, sha256: str) -> dict[str, Any]:
    about = {"@type": "cr:FileObject", "@id": path, "name": path, "contentUrl": path, "encodingFormat": kind}
    return about | {"contentSize": f"{size} B", "sha256": sha256}


def _croissant_field(name: str, kind: str) -> dict[str, Any]:
    source = {"fileObject": {"@id": "manifest.json"}, "extract": {"jsonPath": f"$.shards[*].{name}"}}
    return {"@type": "cr:Field", "@id": f"shards/{name}", "name": name, "dataType": kind, "source": source}


# The names that Croissant takes from its own and other vocabularies.
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
} | {name: f"cr:{name}" for name in ("extract", "field", "fileObject", "fileSet", "jsonPath", "recordSet", "source")}


# ---- Files


@contextlib.contextmanager
def _publishing(path: Path) -> Iterator[Path]:
    """A temporary name to write under; the file appears as `path` when the block ends well, and never otherwise."""
    temporary = path.with_name(f"{path.name}.tmp.{_HOST}.{os.getpid()}")
    try:
        yield temporary
        _sync(temporary)
        temporary.replace(path)
    except BaseException:  # also an interrupt
        temporary.unlink(missing_ok=True)
        raise
    _sync(path.parent)


def _publish(path: Path, content: bytes) -> None:
    with _publishing(path) as temporary:
        temporary.write_bytes(content)


def _sync(path: Path) -> None:
    """Returns when the disk has the file, or the folder's list of names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _dumps(value: Any) -> bytes:
    """The one way JSON is written here, so that equal values have equal bytes."""
    return json.dumps(value, sort_keys=True, indent=1, ensure_ascii=False).encode()


def _parsed(path: Path) -> dict[str, Any] | None:
    """The JSON object in the file; None if there is none."""
    try:
        value = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return value if isinstance(value, dict) else None


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def file_sha256(path: Path) -> str:
    """The file's sha256, read piece by piece."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
