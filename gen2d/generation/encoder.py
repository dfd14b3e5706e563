"""Compression of rendered videos in host threads.

The number of slices in flight is limited, so memory is bounded by a batch and not by the number of videos.
"""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from gen2d.core.errors import UserError
from gen2d.dataset.block import Block, encode
from gen2d.dataset.spec import DatasetSpec, Shard
from gen2d.programs.source import VideoRange, VideoSlice, VideoSource


class Encoder:
    """Compress videos in threads as they are rendered; `blocks` yields them in order."""

    def __init__(self, source: VideoSource, dataset: DatasetSpec, threads: int) -> None:
        self.source, self.dataset = source, dataset
        self.pool = ThreadPoolExecutor(threads, "encode")
        self.limit = 2 * (len(source.rollout.devices) + threads)  # slices in flight
        self.running: deque[Future[Block]] = deque()

    def encode(self, videos: VideoSlice) -> Block:
        """Encode videos as a block, once they are rendered.

        Raises NotFiniteError if a field has values that are not finite.
        """
        block = encode(videos.fields(), self.dataset.fields, self.dataset.codec, self.dataset.chunk_frames)
        _check_finite(block, int(videos.part.numbers[0]))
        return block

    def blocks(
        self, ranges: Sequence[VideoRange], rendered: Callable[[], None] = lambda: None
    ) -> Iterator[tuple[Any, Block]]:
        """Blocks of these ranges in the order of the videos, each with the tag of its range.

        `rendered` is called when all videos are rendered; the last of them are still being compressed.
        """
        waiting: dict[int, tuple[Any, Future[Block]]] = {}
        next_order = 0
        for videos in self.source.slices(ranges):
            waiting[videos.part.order] = videos.part.range.tag, self._submit(videos)
            while next_order in waiting and waiting[next_order][1].done():
                tag, future = waiting.pop(next_order)
                next_order += 1
                yield tag, future.result()
        rendered()
        for order in sorted(waiting):
            tag, future = waiting.pop(order)
            yield tag, future.result()

    def _submit(self, videos: VideoSlice) -> Future[Block]:
        while len(self.running) >= self.limit:
            self.running.popleft().result()
        self.running.append(self.pool.submit(self.encode, videos))
        return self.running[-1]

    def close(self) -> None:
        """Cancel pending tasks and wait for running ones."""
        self.pool.shutdown(wait=True, cancel_futures=True)


def shard_ranges(shards: Iterable[Shard]) -> list[VideoRange]:
    """Ranges of the videos of these shards, each tagged with its shard."""
    return [VideoRange(shard.split, shard.first, shard.first + shard.count, shard) for shard in shards]


def _check_finite(block: Block, first: int) -> None:
    """Raise NotFiniteError if a field has values that are not finite, by their sums, which the block holds anyway."""
    for name, moments in block.moments.items():
        finite = np.isfinite(moments[:, 1]).all(axis=-1)
        if not finite.all():
            number = first + int(np.argmin(finite))
            raise NotFiniteError(
                f"scene: {name} of video {number} is not finite; its speeds, sizes or masses are extreme"
            )


class NotFiniteError(UserError):
    """A simulation gave values that are not finite."""


def threads_for(cores: int) -> int:
    """Number of threads that compress: one per core, or fewer if GEN2D_THREADS says so."""
    return max(1, min(cores, int(os.environ.get("GEN2D_THREADS", cores))))
