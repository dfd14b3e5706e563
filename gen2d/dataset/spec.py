"""What a dataset folder is to hold, the shards that it is divided into, and the names of its files."""

import dataclasses
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.core.schema import Field
from gen2d.storage.paths import Place
from gen2d.storage.sealed import as_json, sha256

SCHEMA = "gen2d.dataset/3"
MARK = Path(".gen2d")  # the folder, inside a dataset's, of what only the program needs
RECORDS = MARK / "records"  # shards that are done, and not in the manifest yet
SNAPSHOTS = MARK / "snapshots"  # what the manifest before the last one names, and this one does not
LOCK = MARK / "lock"  # held by who changes what the folder holds
NEXT = MARK / "next.json"  # the manifest that is about to replace the present one
STAGED = MARK / "staged"  # before a temporary name's end: shards made again, yet to be verified

# What must agree before shards of two runs may stand in one folder; the manifest has the same keys.
IDENTITY = ("config", "seed", "fingerprint", "codec", "chunk_frames", "videos_per_shard", "sizes")

# What datasets and splits may be called, everywhere: such names stand in paths.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
SPLIT = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
FILE_NAME = re.compile(r"(?P<split>[A-Za-z0-9][A-Za-z0-9._-]{0,63})-(?P<place>\d{5,10})(-n(?P<count>\d{1,6}))?\.h5")
TABLE_NAME = re.compile(r"(?P<split>[A-Za-z0-9][A-Za-z0-9._-]{0,63})-(?P<count>\d{1,15})\.npy")


@dataclasses.dataclass(frozen=True)
class DatasetSpec:
    """What a folder is to hold."""

    root: Place
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
    chunk_frames: int | None = None  # of an image's chunk, a divisor of T; None: a chunk holds a whole video
    conventions: str = ""
    rng: str = "threefry2x32"
    command: str = ""
    licence: str = ""
    copies: Mapping[str, bytes] = dataclasses.field(default_factory=dict)  # the user's own files, by name in the folder

    @property
    def identity(self) -> dict[str, Any]:
        """What another run must share to add to this folder."""
        values = vars(self) | {"fingerprint": self.producer["fingerprint"]}
        return json.loads(as_json({key: values[key] for key in IDENTITY}))

    @property
    def identity_sha256(self) -> str:
        """A hash of the identity."""
        return sha256(as_json(self.identity))


@dataclasses.dataclass(frozen=True)
class Shard:
    """`count` videos of one split from number `first` on; `place` is its place in the split."""

    split: str
    place: int
    first: int
    count: int
    name: str  # of its file, without the ending


def shard_of(split: str, first: int, count: int, videos_per_shard: int) -> Shard:
    """The shard with these videos. A part of a shard has its count in its name: when a split grows, another file takes
    its place, and none is ever written twice."""
    place = first // videos_per_shard
    part = "" if count == videos_per_shard else f"-n{count}"
    return Shard(split, place, first, count, f"{split}-{place:05d}{part}")


def plan(counts: Mapping[str, int], videos_per_shard: int) -> list[Shard]:
    """All shards of a dataset with these many videos in each split."""
    return [
        shard_of(split, first, min(videos_per_shard, count - first), videos_per_shard)
        for split, count in sorted(counts.items())
        for first in range(0, count, videos_per_shard)
    ]


def mine(shards: Iterable[Shard], worker: int, workers: int) -> list[Shard]:
    """The shards that worker number `worker` of `workers` makes, whatever the others have done so far."""
    return [shard for shard in shards if shard.place % workers == worker]


def shard_name(name: str) -> str:
    """A shard's file in the folder."""
    return f"shards/{name}.h5"


def table_name(split: str, count: int) -> str:
    """The table of a split's shards in the folder; its name changes as the split grows."""
    return f"index/{split}-{count}.npy"


def shard_path(root: Place, name: str) -> Place:
    """The file of the shard called `name`."""
    return root / shard_name(name)


def mark_path(root: Place) -> Place:
    """What says which dataset the folder is of, from the start on."""
    return root / MARK / "dataset.json"


def snapshot_path(root: Place, manifest_sha256: str) -> Place:
    """The folder of what only an earlier manifest names."""
    return root / SNAPSHOTS / manifest_sha256[:16]
