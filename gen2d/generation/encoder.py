"""Between the device and the disk: host threads that compress, and writers that fill one shard after the other.

The device is never waited for by the threads that write, nor they by it, beyond a fixed number of slices in flight, so
memory is bounded by a batch and not by the number of videos.
"""

import dataclasses
import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from gen2d.core.errors import UserError
from gen2d.dataset.block import Block, encode
from gen2d.dataset.spec import DatasetSpec, Shard
from gen2d.programs.batches import ShardSlice, check_block_placed
from gen2d.programs.rollout import DeviceBatch, Rollout
from gen2d.records.axes import Array


def batches(todo: Sequence[Shard], batch_size: int) -> list[tuple[str, int, list[ShardSlice]]]:
    """The batches that hold these shards' videos, in order: split, number of the first video, and the shards' pieces.

    Batch b holds the videos from b * batch_size on, whatever the shards are, so that every video keeps its row.
    """
    found: dict[tuple[str, int], list[ShardSlice]] = {}
    for shard in todo:
        end = shard.first + shard.count
        for first in range(shard.first // batch_size * batch_size, end, batch_size):
            piece = shard, max(shard.first - first, 0), min(end - first, batch_size)
            found.setdefault((shard.split, first), []).append(piece)
    return [(split, first, pieces) for (split, first), pieces in found.items()]


def groups(
    work: Sequence[tuple[str, int, list[ShardSlice]]], devices: int
) -> Iterator[tuple[str, list[int], list[list[ShardSlice]]]]:
    """The batches, as many at a time as there are devices; a device left over repeats the last batch for nothing."""
    place = 0
    while place < len(work):
        split = work[place][0]
        taken = [entry for entry in work[place : place + devices] if entry[0] == split]
        place += len(taken)
        idle = devices - len(taken)
        yield split, [e[1] for e in taken] + [taken[-1][1]] * idle, [e[2] for e in taken] + [[]] * idle


@dataclasses.dataclass(eq=False)
class EncodeTask:
    """Videos of one shard that are drawn and compressed together: `rows` of a device's batch."""

    shard: Shard
    device: int
    first: int  # number of the video in the batch's row 0
    start: int  # row of the slice's first video
    rows: slice
    future: Future[Block] | None = None


def encode_tasks(firsts: list[int], pieces: list[list[ShardSlice]], batch_size: int, size: int) -> list[EncodeTask]:
    """The jobs of a group of batches in the order of their videos, in slices of `size` batch_size."""
    return [
        EncodeTask(shard, device, firsts[device], start, slice(max(low, start), min(high, start + size)))
        for device, own in enumerate(pieces)
        for shard, low, high in own
        for start in range(0, batch_size, size)
        if max(low, start) < min(high, start + size)
    ]


class Encoder:
    """Draws batches slice by slice and compresses them in threads; `blocks` gives them back in order."""

    def __init__(self, rollout: Rollout, dataset: DatasetSpec, threads: int) -> None:
        self.rollout, self.dataset = rollout, dataset
        self.pool = ThreadPoolExecutor(threads, "encode")
        self.limit = 2 * (len(rollout.devices) + threads)  # jobs in flight
        self.running: deque[Future[Block]] = deque()

    def encode(self, job: EncodeTask, columns: dict[str, np.ndarray], drawn: dict[str, Array]) -> Block:
        """The block of a job, from its device's columns and what was drawn of its slice there."""
        rows, start = job.rows, job.start
        own = {name: column[rows] for name, column in columns.items()}
        for name, array in drawn.items():
            own[name] = np.asarray(array)[rows.start - start : rows.stop - start]
        own["index"] = np.arange(job.first + rows.start, job.first + rows.stop, dtype=np.int64)
        own |= self.rollout.host_fields(own, job.shard.split)
        block = encode(own, self.dataset.fields, self.dataset.codec, self.dataset.chunk_frames)
        _check_finite(block, job.first + rows.start)
        return block

    def blocks(self, work: Sequence[tuple[str, int, list[ShardSlice]]]) -> Iterator[tuple[Shard, Block]]:
        """Every block of these batches with its shard, in the order of the videos.

        The next batch is begun before the last slices of this one are compressed, so neither waits for the other.
        """
        line: deque[EncodeTask] = deque()
        waiting = list(groups(work, len(self.rollout.devices)))
        batch = self.rollout.begin(*waiting[0][:2]) if waiting else None
        for place, (_, firsts, pieces) in enumerate(waiting):
            assert batch is not None
            check_block_placed(self.rollout, batch, firsts, pieces)
            jobs = encode_tasks(firsts, pieces, self.rollout.batch_size, self.rollout.slice)
            line.extend(jobs)
            for _ in self._submitted(jobs, batch):
                while line and line[0].future is not None and line[0].future.done():
                    yield _result(line.popleft())
            batch = self.rollout.begin(*waiting[place + 1][:2]) if place + 1 < len(waiting) else None
        while line:
            yield _result(line.popleft())

    def _submitted(self, jobs: list[EncodeTask], batch: DeviceBatch) -> Iterator[int]:
        columns = self.rollout.host_columns(batch)
        for start in sorted({job.start for job in jobs}):
            drawn = self.rollout.draw(batch, start, self.rollout.slice)
            for job in jobs:
                if job.start == start:
                    job.future = self._submit(job, columns[job.device], drawn[job.device])
            yield start

    def _submit(self, job: EncodeTask, columns: dict[str, np.ndarray], drawn: dict[str, Array]) -> Future[Block]:
        while len(self.running) >= self.limit:
            self.running.popleft().result()
        self.running.append(self.pool.submit(self.encode, job, columns, drawn))
        return self.running[-1]

    def close(self) -> None:
        """Drops what has not begun and waits for the rest."""
        self.pool.shutdown(wait=True, cancel_futures=True)


def _result(job: EncodeTask) -> tuple[Shard, Block]:
    assert job.future is not None
    return job.shard, job.future.result()


def _check_finite(block: Block, first: int) -> None:
    """Returns nothing; raises where the sums of a state's values, which the block holds anyway, are not numbers."""
    for name, moments in block.moments.items():
        finite = np.isfinite(moments[:, 1]).all(axis=-1)
        if not finite.all():
            number = first + int(np.argmin(finite))
            raise NotFiniteError(
                f"scene: {name} of video {number} is not finite; its speeds, sizes or masses are extreme"
            )


class NotFiniteError(UserError):
    """A scene with numbers that a simulation cannot take."""


def threads_for(cores: int) -> int:
    """How many host threads compress."""
    return max(1, min(cores, int(os.environ.get("GEN2D_THREADS", cores))))
