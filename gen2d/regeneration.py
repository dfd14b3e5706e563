"""A stored dataset against its recipe: some of its videos made again and compared, its bad shards made again."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from gen2d import devices
from gen2d.config import Config
from gen2d.core.errors import DamagedError, FolderError
from gen2d.dataset import folder as shards
from gen2d.dataset.folder import Block, Dataset
from gen2d.dataset.manifest import SEAL, identity_of, read_manifest
from gen2d.generation import dataset_of, make, rollouts_of
from gen2d.loading import dataset as loader
from gen2d.pipeline import Encoder, Piece, threads_for
from gen2d.redraw import config_from
from gen2d.rollout import Rollout
from gen2d.storage.atomic import read_sealed
from gen2d.storage.codecs import decode_into
from gen2d.storage.paths import Place, place

Identity = Mapping[str, Any]  # of a dataset; its manifest has the same keys


def rollout_of(root: Place, identity: Identity) -> Rollout:
    """The programs that made the dataset in the folder. Raises ConfigError where its config cannot be used here."""
    return _rollout(config_from(root, identity), identity["fingerprint"]["device"].startswith("cpu"))


@functools.lru_cache(maxsize=1)  # a check, a repair and the check that follows compile once
def _rollout(config: Config, on_cpu: bool) -> Rollout:
    return Rollout(config, devices.prepare("cpu" if on_cpu else "auto"))


def check_fingerprint(root: Place, rollout: Rollout, identity: Identity) -> None:
    """Raises FolderError where this machine and these versions would make other bits."""
    here = devices.fingerprint(rollout.devices[0], rollout.lanes)
    differing = list(shards.differences(identity["fingerprint"], here, "fingerprint"))
    if differing:
        told = " and ".join(differing)
        raise FolderError(f"{root}: its videos can be neither judged nor repaired here, as bits would differ: {told}")


def differing(
    rollout: Rollout, root: Place, manifest: Mapping[str, Any], chosen: Sequence[tuple[str, int]]
) -> Iterator[tuple[str, str]]:
    """For each field of the videos (split, number) that is another when made again: its shard and a sentence.

    Videos that cannot be read are passed over: the level "full" names them.
    """
    dataset = dataset_of(rollout, root, manifest["splits"])
    constants = {name: values.tolist() for name, values in dataset.constants.items()}
    if constants != manifest["constants"]:
        raise FolderError(f"{root}: its constants {', '.join(constants)} are not those that its recipe gives")
    try:
        stored = {split: loader.open(root, split, fields=("*",)) for split in manifest["splits"]}
    except DamagedError:
        return
    for own, splits in rollouts_of(rollout, [split for split, _ in chosen]):
        encoder = Encoder(own, dataset, threads_for(devices.cores()))
        try:
            for shard, block in encoder.blocks(_work(dataset, own.lanes, [c for c in chosen if c[0] in splits])):
                number = int(block.arrays["index"][0])
                for name in _other(stored[shard.split], number, _values(block, dataset)):
                    yield shard.name, f"{name} of {shard.split} video {number} is not what its recipe makes"
        finally:
            encoder.close()


def _work(dataset: Dataset, lanes: int, chosen: Sequence[tuple[str, int]]) -> list[tuple[str, int, list[Piece]]]:
    """The batches that hold the chosen videos, each video a piece of its own."""
    owner = {
        (s.split, s.first // dataset.videos_per_shard): s for s in shards.plan(dataset.splits, dataset.videos_per_shard)
    }
    found: dict[tuple[str, int], list[Piece]] = {}
    for split, number in sorted(chosen):
        shard, lane = owner[split, number // dataset.videos_per_shard], number % lanes
        found.setdefault((split, number - lane), []).append((shard, lane, lane + 1))
    return [(split, first, pieces) for (split, first), pieces in found.items()]


def _values(block: Block, dataset: Dataset) -> dict[str, np.ndarray]:
    """The fields of the block's only video."""
    found = {name: values[0] for name, values in block.arrays.items()}
    for name, chunks in block.chunks.items():
        field = dataset.fields[name]
        found[name] = np.empty(field.shape(dataset.sizes), field.dtype)
        for piece, chunk in zip(np.split(found[name], len(chunks)), chunks, strict=True):
            decode_into(dataset.codec, chunk, piece)
    return found


def _other(stored: loader.Dataset, number: int, made: Mapping[str, np.ndarray]) -> list[str]:
    """The names of the fields that are stored otherwise, to the bit."""
    try:
        video = stored[number]
    except DamagedError:
        return []
    return [name for name, values in made.items() if video[name].tobytes() != values.tobytes()]


def repair(root: str | Place, bad: Sequence[str], say: Callable[[str], None] | None = None) -> list[str]:
    """The names of the shards that were made again: those called `bad`, and all whose record is damaged.

    Afterwards index, cards, config and manifest are written anew. Where the manifest is damaged, the folder's own
    records say what it held. Raises FolderError, before anything is changed, where a shard cannot be made again here.
    """
    root = place(root)
    if not (root / "manifest.json").exists():
        read_manifest(root)  # says that it is incomplete, or no dataset
    identity = identity_of(root)
    if identity is None:
        raise FolderError(
            f"{root}: manifest.json and .gen2d/dataset.json are both damaged, so nothing says what it held"
        )
    rollout = rollout_of(root, identity)
    dataset, lost = shards.lost(_as_made(rollout, root, identity), bad)
    if lost:
        check_fingerprint(root, rollout, identity)
    for name in lost:
        shards.forget(root, name)
    todo = shards.open_folder(dataset)
    if todo:
        make(rollout, dataset, todo, say or (lambda line: None))
    shards.finish(dataset)
    return [shard.name for shard in todo]


def _as_made(rollout: Rollout, root: Place, identity: Identity) -> Dataset:
    """What the folder is to hold, by the versions that its manifest names, if that is whole."""
    manifest = read_sealed(root / "manifest.json", SEAL) or {}
    dataset = dataset_of(rollout, root, manifest.get("splits", {}))
    producer = manifest.get("producer", dataset.producer)
    return dataclasses.replace(dataset, producer={**producer, "fingerprint": identity["fingerprint"]})
