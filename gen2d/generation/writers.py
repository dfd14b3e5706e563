"""Writing of shards, each in a thread."""

import queue
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from gen2d.dataset.block import Block
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.dataset.spec import Shard


class _Aborted(BaseException):
    """Ends the thread of a shard that is abandoned."""


class ShardWriters:
    """Write blocks into shards, each in a thread, so that one is hashed and synced while the next is filled."""

    def __init__(self, writer: ShardWriter) -> None:
        self.writer = writer
        self.pool = ThreadPoolExecutor(2, "write")
        self.shard: Shard | None = None
        self.blocks: queue.Queue[Block | _Aborted | None] = queue.Queue()
        self.futures: deque[Future[np.ndarray]] = deque()

    def put(self, shard: Shard, block: Block) -> None:
        """Add a block to its shard; blocks come in order, so a block of another shard ends the current one."""
        if shard != self.shard:
            self._end_shard()
            while len(self.futures) > 1:
                self.futures.popleft().result()
            self.shard, self.blocks = shard, queue.Queue(maxsize=16)
            self.futures.append(self.pool.submit(self.writer.write, shard, _drain(self.blocks)))
        self._send(block)

    def _send(self, entry: Block | _Aborted | None) -> None:
        while True:
            try:
                return self.blocks.put(entry, timeout=0.1)
            except queue.Full:
                if self.futures[-1].done():
                    return  # the writer failed; its future raises the error

    def _end_shard(self) -> None:
        if self.shard is not None:
            self._send(None)
        for future in [f for f in self.futures if f.done()]:
            future.result()

    def finish(self) -> None:
        """Wait until all shards are written."""
        self._end_shard()
        for future in self.futures:
            future.result()
        self.pool.shutdown()

    def abort(self) -> None:
        """Abandon the current shard and finish those before it."""
        if self.shard is not None:
            self._send(_Aborted())
        self.pool.shutdown(wait=True, cancel_futures=True)


def _drain(blocks: queue.Queue) -> Iterator[Block]:
    while (entry := blocks.get()) is not None:
        if isinstance(entry, _Aborted):
            raise entry
        yield entry
