"""Small datasets for the tests of storage: all kinds of fields, and moving discs, so that images compress."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.core.schema import Field
from gen2d.dataset import hdf5
from gen2d.dataset.block import Block, encode
from gen2d.dataset.folder import open_folder
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.dataset.spec import DatasetSpec, Shard
from gen2d.generation.complete import complete
from gen2d.storage.paths import Place

FIELDS = {
    "frames": Field("uint8", "n T H W 3", "sRGB", "what is seen"),
    "index": Field("int64", "n", "", "the video's number in its split"),
    "time": Field("float64", "T", "s", "of each frame"),
    "states/position": Field("float32", "n T K 2", "m", "of the centre of mass"),
    "states/angle": Field("float32", "n T K", "rad", "unwrapped"),
    "objects/present": Field("bool", "n K", "", "whether the slot is used"),
    "objects/mass": Field("float32", "n K", "kg", "infinite for static bodies"),
    "objects/color": Field("uint8", "n K 3", "sRGB", "of the fill"),
    "masks/instance": Field("uint8", "n T H W", "id", "what is seen"),
    "flow/forward": Field("float16", "n T H W 2", "px/frame", "to the next frame"),
    "quality/contacts": Field("int32", "n", "1", "how many there were"),
}


def dataset(root: Place, train: int = 20, codec: str = "gzip", **changes: object) -> DatasetSpec:
    """Spec of a dataset in shards of 8: `train` videos in the split train, 3 in the split test."""
    values: dict[str, object] = {
        "root": root,
        "name": "toy",
        "fields": FIELDS,
        "sizes": {"T": 5, "H": 8, "W": 8, "K": 3},
        "seed": 7,
        "config": {"scene": {"name": "toy", "balls": 3}, "fps": 10},
        "config_text": "scene: {name: toy, balls: 3}\nfps: 10\n",
        "producer": {"gen2d": "0", "fingerprint": {"jaxlib": "0", "batch_size": 8}},
        "splits": {"train": train, "test": 3},
        "videos_per_shard": 8,
        "codec": codec,
        "fps": 10.0,
        "constants": {"time": np.arange(5) / 10},
        "conventions": "Pixel centres at (j + 0.5) — y up.",
        "command": "gen2d --config toy.yaml",
        "licence": "CC0-1.0",
    }
    values |= changes
    sizes, fields = values["sizes"], values["fields"]
    assert isinstance(sizes, dict)
    assert isinstance(fields, dict)
    if "constants" not in changes:
        values["constants"] = {"time": np.arange(sizes["T"]) / 10} if "time" in fields else {}
    return DatasetSpec(**values)  # pyright: ignore[reportArgumentType]


def small(root: Place, splits: Mapping[str, int], **changes: Any) -> DatasetSpec:
    """Spec of a dataset with these splits and only four fields, for tests that write many."""
    fields = {name: FIELDS[name] for name in ("frames", "index", "objects/mass", "time")}
    return dataset(root, fields=fields, splits=splits, **changes)


def video(spec: DatasetSpec, split: str, number: int) -> dict[str, np.ndarray]:
    """All fields of one video, a function of (seed, split, number) only."""
    rng = np.random.default_rng([spec.seed, len(split), number])
    frames, height, width, slots = (spec.sizes[axis] for axis in "THWK")
    values: dict[str, np.ndarray] = {}
    for name, field in spec.fields.items():
        shape = field.shape(spec.sizes)
        values[name] = (rng.random(shape) * 100).astype(field.dtype)
    position = rng.random((slots, 2)) * (height, width) + np.arange(frames)[:, None, None] * rng.random((slots, 2))
    rows, columns = np.mgrid[:height, :width] + 0.5
    mask = np.zeros((frames, height, width), np.uint8)
    for slot in range(slots):
        row, column = np.moveaxis(position[:, slot, :, None, None], 1, 0)
        mask[(rows - row % height) ** 2 + (columns - column % width) ** 2 < (height / 6) ** 2] = slot + 1
    colors = rng.integers(0, 256, (slots + 1, 3), np.uint8)
    present = np.arange(slots) <= number % slots
    values |= {
        "index": np.full(spec.fields["index"].shape(spec.sizes), number),
        "objects/present": present,
        "masks/instance": mask,
        "frames": colors[mask],
    }
    values["objects/mass"][0] = np.inf
    return values


def columns(spec: DatasetSpec, shard: Shard, rows: range | None = None) -> dict[str, np.ndarray]:
    """Stacked fields of the shard's videos, or of some `rows`."""
    rows = range(shard.count) if rows is None else rows
    videos = [video(spec, shard.split, shard.first + row) for row in rows]
    names = [name for name, field in spec.fields.items() if field.per_video]
    return {name: np.stack([values[name] for values in videos]).astype(spec.fields[name].dtype) for name in names}


def blocks(spec: DatasetSpec, shard: Shard, size: int = 3) -> Iterator[Block]:
    """The shard in encoded blocks of `size` videos, one at a time."""
    for first in range(0, shard.count, size):
        rows = range(first, min(first + size, shard.count))
        yield encode(columns(spec, shard, rows), spec.fields, spec.codec, spec.chunk_frames)


def make(spec: DatasetSpec, size: int = 3, **options: bool) -> DatasetSpec:
    """Write the complete dataset and return its spec."""
    remaining = open_folder(spec, **options)
    with ShardWriter(spec) as writer:
        for shard in remaining:
            writer.write(shard, blocks(spec, shard, size))
    assert complete(spec)
    return spec


def write(spec: DatasetSpec, shard: Shard, blocks: Iterable[Block]) -> None:
    """Write the shard from these blocks."""
    with ShardWriter(spec) as writer:
        writer.write(shard, blocks)


def folder(spec: DatasetSpec) -> Path:
    """Local folder of the dataset."""
    assert isinstance(spec.root, Path)
    return spec.root


def stored(root: Path, split: str = "train") -> dict[str, np.ndarray]:
    """Fields of all videos of a split, read by h5py."""
    files = [hdf5.read(path) for path in sorted((root / "shards").glob(f"{split}-*.h5"))]
    return {name: np.concatenate([file[name] for file in files]) for name in files[0] if name != "time"}


def tree(root: Path) -> Mapping[str, bytes]:
    """Bytes of every published file, by relative path."""
    files = (path for path in root.rglob("*") if path.is_file() and ".gen2d" not in path.parts)
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def flip(path: Path, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[bit // 8 % len(data)] ^= 1 << bit % 8
    path.write_bytes(data)


def contents(root: Path) -> dict[str, bytes]:
    """Bytes of every file, including .gen2d, but without the run log, which holds times."""
    files = (path for path in root.rglob("*") if path.is_file() and path.name != "run.jsonl")
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def discs(count: int, frames: int = 64, size: int = 64, bodies: int = 8, seed: int = 0) -> np.ndarray:
    """Videos of moving discs with soft edges, uint8 [count, frames, size, size, 3], for the benchmark."""
    rng = np.random.default_rng(seed)
    rows, columns_ = np.mgrid[:size, :size] + 0.5
    videos = np.full((count, frames, size, size, 3), 230, np.uint8)
    for clip in videos:
        position, speed = rng.uniform(0, size, (bodies, 2)), rng.uniform(-2, 2, (bodies, 2))
        color, radius = rng.integers(0, 256, (bodies, 3)), rng.uniform(size / 20, size / 8, bodies)
        for step, image in enumerate(clip):
            for body in range(bodies):
                row, column = abs((position[body] + speed[body] * step) % (2 * size) - size)
                coverage = np.clip(radius[body] + 0.5 - np.hypot(rows - row, columns_ - column), 0, 1)[..., None]
                image[...] = np.round(image * (1 - coverage) + color[body] * coverage)
    return videos
