"""What a dataset folder holds, the shards that it is divided into, and the names of its files."""

import dataclasses
import functools
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.core.schema import Field
from gen2d.storage.paths import Place
from gen2d.storage.sealed import as_json, sha256

SCHEMA = "gen2d.dataset/4"
# In its shards, fields that all videos share have no leading axis of videos, and the index has rows with named columns:
# programs that expect the same number of rows in all HDF5 datasets, such as Hugging Face's, cannot read it.
EARLIER_SCHEMA = "gen2d.dataset/3"
SCHEMAS = (EARLIER_SCHEMA, SCHEMA)  # those that gen2d reads, and writes into folders that have them
MANIFEST, SHEET, PAGE, CONFIG = "manifest.json", "sheet.png", "index.html", "config.yaml"
MARK = Path(".gen2d")  # the subfolder of files that only gen2d needs
RECORDS = MARK / "records"  # logs of the shards that are done and not in the manifest yet
SNAPSHOTS = MARK / "snapshots"  # files that earlier manifests name and the present one does not
LOCK = MARK / "lock"  # held by the process that changes what the folder holds
NEXT = MARK / "next.json"  # the manifest that is about to replace the present one
STAGED = MARK / "staged"  # prefix of the temporary folders in which a repair makes shards

# The values that two runs must share to write into one folder; the manifest has the same keys.
IDENTITY = ("config", "seed", "fingerprint", "codec", "chunk_frames", "videos_per_shard", "sizes")

# Allowed names of datasets, splits and files: they are parts of paths.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
SPLIT = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
FILE_NAME = re.compile(r"(?P<split>[A-Za-z0-9][A-Za-z0-9._-]{0,63})-(?P<place>\d{5,10})(-n(?P<count>\d{1,6}))?\.h5")
TABLE_NAME = re.compile(r"(?P<split>[A-Za-z0-9][A-Za-z0-9._-]{0,63})-(?P<count>\d{1,15})\.npy")
PLUGIN = re.compile(rf"plugins/(scene|look|annotation|splits/{SPLIT.pattern}/look)/[^/\x00-\x1f\x7f]{{1,200}}\.py")


@dataclasses.dataclass(frozen=True)
class DatasetSpec:
    """What a dataset folder is to hold."""

    root: Place
    name: str
    fields: Mapping[str, Field]
    sizes: Mapping[str, int]  # of the axes that are letters
    seed: int
    config: Mapping[str, Any]  # plain values, as in JSON
    config_text: str  # the same, resolved, as YAML
    producer: Mapping[str, Any]  # versions; 'fingerprint' holds everything that decides the simulated bits
    splits: Mapping[str, int]  # number of videos of each split
    videos_per_shard: int
    codec: str
    fps: float
    constants: Mapping[str, np.ndarray]  # values of the fields that all videos share
    chunk_frames: int | None = None  # frames of an image's chunk, a divisor of T; None: a chunk holds a whole video
    conventions: str = ""
    rng: str = "threefry2x32"
    command: str = ""
    licence: str = ""
    copies: Mapping[str, bytes] = dataclasses.field(default_factory=dict)  # the user's own files, by name in the folder
    schema: str = SCHEMA  # of a new folder; one that is there keeps its own

    @property
    def identity(self) -> dict[str, Any]:
        """The values that another run must share to add to this folder."""
        values = vars(self) | {"fingerprint": self.producer["fingerprint"]}
        return json.loads(as_json({key: values[key] for key in IDENTITY}))

    @functools.cached_property
    def identity_sha256(self) -> str:
        """The sha256 of the identity."""
        return sha256(as_json(self.identity))

    @property
    def recipe_files(self) -> dict[str, bytes]:
        """The config and the user's own files, by name in the folder."""
        return {CONFIG: self.config_text.encode(), **self.copies}


@dataclasses.dataclass(frozen=True)
class Shard:
    """`count` consecutive videos of one split, starting at video `first`."""

    split: str
    place: int  # number of the shard in its split
    first: int
    count: int
    name: str  # file name without its ending


def shard_of(split: str, first: int, count: int, videos_per_shard: int) -> Shard:
    """The shard with these videos.

    The name of a partial shard contains its number of videos: when the split grows, a file with another name replaces
    it, so that no file is ever written twice.
    """
    place = first // videos_per_shard
    part = "" if count == videos_per_shard else f"-n{count}"
    return Shard(split, place, first, count, f"{split}-{place:05d}{part}")


def shard_count(videos: int, videos_per_shard: int) -> int:
    """The number of shards that hold so many videos of a split."""
    return -(-videos // videos_per_shard)


def plan(counts: Mapping[str, int], videos_per_shard: int) -> list[Shard]:
    """All shards of a dataset with `counts` videos in each split."""
    return [
        shard_of(split, first, min(videos_per_shard, count - first), videos_per_shard)
        for split, count in sorted(counts.items())
        for first in range(0, count, videos_per_shard)
    ]


def shards_of_worker(shards: Iterable[Shard], worker: int, workers: int) -> list[Shard]:
    """The shards that worker number `worker` of `workers` makes, independent of what the others have done."""
    return [shard for shard in shards if shard.place % workers == worker]


def stored_axes(field: Field, schema: str) -> str:
    """The axes of a field in the shards of a dataset with this schema."""
    return field.axes if field.per_video or schema == EARLIER_SCHEMA else f"n {field.axes}".rstrip()


def shard_name(name: str) -> str:
    """The path of a shard's file in the folder."""
    return f"shards/{name}.h5"


def table_name(split: str, count: int) -> str:
    """The path in the folder of the shard table of a split with `count` videos."""
    return f"index/{split}-{count}.npy"


def shard_path(root: Place, name: str) -> Place:
    """The file of the shard called `name`."""
    return root / shard_name(name)


def mark_path(root: Place) -> Place:
    """The file that holds the identity of the dataset from the start on."""
    return root / MARK / "dataset.json"


def snapshot_path(root: Place, manifest_sha256: str) -> Place:
    """The folder of the files that only an earlier manifest names."""
    return root / SNAPSHOTS / manifest_sha256[:16]
