"""Crash-safe writing of shards: each is written under a temporary name, hashed, renamed and then recorded as done."""

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from gen2d.core.errors import FolderError, UnreachableError, UserError
from gen2d.dataset import hdf5
from gen2d.dataset.block import Block, stored_bytes
from gen2d.dataset.manifest import folder_schema
from gen2d.dataset.records import RecordLog
from gen2d.dataset.rows import origin, seal_rows, shard_type
from gen2d.dataset.spec import DatasetSpec, Shard, shard_path
from gen2d.dataset.statistics import merge_moments, pack_moments
from gen2d.storage.atomic import publishing, work_folder
from gen2d.storage.explain import FULL, writing_error
from gen2d.storage.paths import Url
from gen2d.storage.sealed import file_sha256

AGAIN = "run the same command again, and it goes on where it stopped"


class ShardWriter:
    """Writes shards of a dataset; several threads may use it, each for a shard of its own."""

    def __init__(self, spec: DatasetSpec) -> None:
        self.spec, self.log = spec, RecordLog(spec.root)
        self.schema = folder_schema(spec.root, spec.schema)

    def write(self, shard: Shard, blocks: Iterable[Block]) -> np.ndarray:
        """Write a shard from its blocks and record it; returns its row [1].

        On return the shard is done, whatever happens to the machine. Raises FolderError if the disk is full or fails,
        UnreachableError if a server fails. After any error, also of `blocks`, nothing half-written stays.
        """
        spec, totals = self.spec, _Totals()
        begin = origin(spec.identity_sha256, shard.split)
        attributes = {"schema": self.schema, "name": spec.name, "split": shard.split, "first": shard.first}
        attributes |= {"fps": spec.fps, "seed": spec.seed, "conventions": spec.conventions}
        videos = range(shard.first, shard.first + shard.count)
        try:
            with publishing(shard_path(spec.root, shard.name)) as temporary:
                stored = spec.fields, spec.sizes, videos, totals.count(blocks), spec.codec, spec.chunk_frames
                offsets = hdf5.write(temporary, *stored, attributes, spec.constants, begin, self.schema)
                row = np.zeros(1, shard_type(spec.fields))
                row["first"], row["count"], row["data_bytes"] = shard.first, shard.count, totals.bytes
                row["bytes"], row["index"], row["offsets"] = temporary.stat().st_size, offsets.index, offsets.rows
                row["sha256"] = np.frombuffer(bytes.fromhex(file_sha256(temporary)), np.uint8)
                row["moments"] = pack_moments(
                    {name: merge_moments(np.concatenate(own)) for name, own in totals.moments.items()}
                )
            row = seal_rows(row, begin, [shard.first])
            self.log.add(shard.split, row)
        except UnreachableError as error:
            raise UnreachableError(f"{error}: once it can, {AGAIN}") from None
        except OSError as error:
            if error.errno in FULL:
                raise self._full(shard, totals, error) from error
            if isinstance(spec.root, Url):
                raise FolderError(
                    f"{error.filename or spec.root} cannot be written ({error.strerror or error})"
                ) from error
            raise writing_error(spec.root, error, AGAIN) from error
        return row

    def close(self) -> None:
        """Close the logs of the records; their rows stay."""
        self.log.close()

    def __enter__(self) -> "ShardWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _full(self, shard: Shard, totals: "_Totals", error: OSError) -> UserError:
        """The error of a full disk, with an estimate of the shard's size."""
        spec = self.spec
        raw = sum(stored_bytes(field, spec.sizes) for field in spec.fields.values())
        need = shard.count * (totals.bytes / totals.videos if totals.videos else raw)
        return writing_error(work_folder(spec.root), error, AGAIN, f"{shard.name} needs about {need / 1e6:.1f} MB")


@dataclasses.dataclass
class _Totals:
    """Moments, number of videos and bytes of the blocks that are written into a file."""

    moments: dict[str, list[np.ndarray]] = dataclasses.field(default_factory=dict)
    videos: int = 0
    bytes: int = 0

    def count(self, blocks: Iterable[Block]) -> Iterator[Block]:
        for block in blocks:
            for name, values in block.moments.items():
                self.moments.setdefault(name, []).append(values)
            self.videos += len(block)
            self.bytes += block.nbytes
            yield block
