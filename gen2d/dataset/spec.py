"""What a dataset folder is to hold, the shards that it is divided into, and where their files lie."""

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.core.schema import Field
from gen2d.storage.atomic import as_json
from gen2d.storage.paths import Place

SCHEMA = "gen2d.dataset/1"
MARK = Path(".gen2d")  # the folder, inside a dataset's, of what only the program needs

# What must agree before shards of two runs may stand in one folder; the manifest has the same keys.
IDENTITY = ("config", "seed", "fingerprint", "codec", "chunk_frames", "videos_per_shard", "sizes")


@dataclasses.dataclass(frozen=True)
class Dataset:
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


@dataclasses.dataclass(frozen=True)
class Shard:
    """`count` videos of one split from number `first` on; `number` is the shard's place in the whole plan."""

    name: str
    split: str
    first: int
    count: int
    number: int

    @property
    def place(self) -> int:
        """Its place within its split, which stays the same when another split grows."""
        return int(self.name.rpartition("-")[2])


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
    return [shard for shard in shards if shard.place % workers == worker]


def shard_path(root: Place, name: str) -> Place:
    """The file of the shard called `name`."""
    return root / "shards" / f"{name}.h5"


def mark_path(root: Place) -> Place:
    """What says which dataset the folder is of, from the start on."""
    return root / MARK / "dataset.json"


def record_path(root: Place, name: str) -> Place:
    """What says that the shard is done, and what went into it."""
    return root / MARK / "done" / f"{name}.json"


def table_path(root: Place, name: str) -> Place:
    """Where in the shard its pieces lie and their checksums, kept until all go into the index."""
    return root / MARK / "done" / f"{name}.npz"
