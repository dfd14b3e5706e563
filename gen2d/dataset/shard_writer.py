"""One shard on its way to the disk: written under a temporary name, hashed, renamed, and then recorded as done."""

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from gen2d.core.errors import FolderError, UnreachableError, UserError
from gen2d.dataset import hdf5
from gen2d.dataset.block import Block, stored_bytes
from gen2d.dataset.records import RecordLog
from gen2d.dataset.rows import origin, sealed_rows, shard_type
from gen2d.dataset.spec import SCHEMA, DatasetSpec, Shard, shard_path
from gen2d.dataset.statistics import merged, packed
from gen2d.storage.atomic import publishing, work_folder
from gen2d.storage.explain import FULL, writing_error
from gen2d.storage.paths import Url
from gen2d.storage.sealed import file_sha256

AGAIN = "run the same command again, and it goes on where it stopped"


class ShardWriter:
    """Writes shards of a dataset, each from its blocks; several threads may, each a shard of its own."""

    def __init__(self, spec: DatasetSpec) -> None:
        self.spec, self.log = spec, RecordLog(spec.root)

    def write(self, shard: Shard, blocks: Iterable[Block]) -> np.ndarray:
        """The row [1] of the shard that `blocks` became; afterwards it is done, whatever happens to the machine.

        Raises FolderError where the disk is full or fails, UnreachableError where a server does. Whatever is raised,
        here or by `blocks`, nothing half-written stays.
        """
        spec, seen = self.spec, _Seen()
        begin = origin(spec.identity_sha256, shard.split)
        about = {"schema": SCHEMA, "name": spec.name, "split": shard.split, "first": shard.first}
        about |= {"fps": spec.fps, "seed": spec.seed, "conventions": spec.conventions}
        videos = range(shard.first, shard.first + shard.count)
        try:
            with publishing(shard_path(spec.root, shard.name)) as temporary:
                stored = spec.fields, spec.sizes, videos, seen.passing(blocks), spec.codec, spec.chunk_frames
                offsets = hdf5.write(temporary, *stored, about, spec.constants, begin)
                row = np.zeros(1, shard_type(spec.fields))
                row["first"], row["count"], row["data_bytes"] = shard.first, shard.count, seen.bytes
                row["bytes"], row["index"], row["offsets"] = temporary.stat().st_size, offsets.index, offsets.rows
                row["sha256"] = np.frombuffer(bytes.fromhex(file_sha256(temporary)), np.uint8)
                row["moments"] = packed({name: merged(np.concatenate(own)) for name, own in seen.moments.items()})
            row = sealed_rows(row, begin, [shard.first])
            self.log.add(shard.split, row)
        except UnreachableError as error:
            raise UnreachableError(f"{error}: once it can, {AGAIN}") from None
        except OSError as error:
            if error.errno in FULL:
                raise self._full(shard, seen, error) from error
            if isinstance(spec.root, Url):
                raise FolderError(
                    f"{error.filename or spec.root} cannot be written ({error.strerror or error})"
                ) from error
            raise writing_error(spec.root, error, AGAIN) from error
        return row

    def close(self) -> None:
        """Ends the records; they stay."""
        self.log.close()

    def __enter__(self) -> "ShardWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _full(self, shard: Shard, seen: "_Seen", error: OSError) -> UserError:
        """What to say of a full disk: how much is missing, as far as that is known."""
        spec = self.spec
        raw = sum(stored_bytes(field, spec.sizes) for field in spec.fields.values())
        need = shard.count * (seen.bytes / seen.videos if seen.videos else raw)
        return writing_error(work_folder(spec.root), error, AGAIN, f"{shard.name} needs about {need / 1e6:.1f} MB")


@dataclasses.dataclass
class _Seen:
    """What is kept of the blocks that pass on their way into a file."""

    moments: dict[str, list[np.ndarray]] = dataclasses.field(default_factory=dict)
    videos: int = 0
    bytes: int = 0

    def passing(self, blocks: Iterable[Block]) -> Iterator[Block]:
        for block in blocks:
            for name, values in block.moments.items():
                self.moments.setdefault(name, []).append(values)
            self.videos += len(block)
            self.bytes += block.nbytes
            yield block
