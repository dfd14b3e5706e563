"""Between the device and the disk: host threads that compress, and writers that fill one shard after the other.

The device is never waited for by the threads that write, nor they by it, beyond a fixed number of slices in flight, so
memory is bounded by a batch and not by the number of videos.
"""

import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from gen2d.core.errors import UserError
from gen2d.dataset.block import Block, encode
from gen2d.dataset.spec import DatasetSpec, Shard
from gen2d.programs.source import VideoRange, VideoSlice, VideoSource


class Encoder:
    """Compresses videos in threads, as they are rendered; `blocks` gives them in order."""

    def __init__(self, source: VideoSource, dataset: DatasetSpec, threads: int) -> None:
        self.source, self.dataset = source, dataset
        self.pool = ThreadPoolExecutor(threads, "encode")
        self.limit = 2 * (len(source.rollout.devices) + threads)  # slices in flight
        self.running: deque[Future[Block]] = deque()

    def encode(self, videos: VideoSlice) -> Block:
        """The block of some videos; waits until they are rendered."""
        block = encode(videos.fields(), self.dataset.fields, self.dataset.codec, self.dataset.chunk_frames)
        _check_finite(block, int(videos.part.numbers[0]))
        return block

    def blocks(self, ranges: Sequence[VideoRange]) -> Iterator[tuple[Any, Block]]:
        """Every block of these ranges with the range's tag, in the order of the videos."""
        waiting: dict[int, tuple[Any, Future[Block]]] = {}
        following = 0
        for videos in self.source.slices(ranges):
            waiting[videos.part.order] = videos.part.range.tag, self._submit(videos)
            while following in waiting and waiting[following][1].done():
                tag, future = waiting.pop(following)
                following += 1
                yield tag, future.result()
        for order in sorted(waiting):
            tag, future = waiting.pop(order)
            yield tag, future.result()

    def _submit(self, videos: VideoSlice) -> Future[Block]:
        while len(self.running) >= self.limit:
            self.running.popleft().result()
        self.running.append(self.pool.submit(self.encode, videos))
        return self.running[-1]

    def close(self) -> None:
        """Drops what has not begun and waits for the rest."""
        self.pool.shutdown(wait=True, cancel_futures=True)


def shard_ranges(shards: Iterable[Shard]) -> list[VideoRange]:
    """The videos of each shard, which is their tag."""
    return [VideoRange(shard.split, shard.first, shard.first + shard.count, shard) for shard in shards]


def _check_finite(block: Block, first: int) -> None:
    """Raises NotFiniteError where the sums of a field's values, which the block holds anyway, are not finite."""
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
