"""Writing of shards, each in a thread."""

import queue
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from gen2d.dataset.block import Block
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.dataset.spec import DatasetSpec, Shard


class _Dropped(BaseException):
    """Ends the thread of a shard that is abandoned."""


class ShardWriters:
    """Write blocks into shards, each in a thread, so that one is hashed and synced while the next is filled."""

    def __init__(self, dataset: DatasetSpec) -> None:
        self.writer = ShardWriter(dataset)
        self.pool = ThreadPoolExecutor(2, "write")
        self.shard: Shard | None = None
        self.line: queue.Queue[Block | _Dropped | None] = queue.Queue()
        self.futures: deque[Future[np.ndarray]] = deque()

    def put(self, shard: Shard, block: Block) -> None:
        """Add a block to its shard; blocks come in order, so a block of another shard ends the current one."""
        if shard != self.shard:
            self._end()
            while len(self.futures) > 1:
                self.futures.popleft().result()
            self.shard, self.line = shard, queue.Queue(maxsize=16)
            self.futures.append(self.pool.submit(self.writer.write, shard, _drained(self.line)))
        self._send(block)

    def _send(self, entry: Block | _Dropped | None) -> None:
        while True:
            try:
                return self.line.put(entry, timeout=0.1)
            except queue.Full:
                if self.futures[-1].done():
                    return  # the writer failed; its future raises the error

    def _end(self) -> None:
        if self.shard is not None:
            self._send(None)
        for future in [f for f in self.futures if f.done()]:
            future.result()

    def finish(self) -> None:
        """Wait until all shards are written."""
        self._end()
        for future in self.futures:
            future.result()
        self.pool.shutdown()
        self.writer.close()

    def drop(self) -> None:
        """Abandon the current shard and finish those before it."""
        if self.shard is not None:
            self._send(_Dropped())
        self.pool.shutdown(wait=True, cancel_futures=True)
        self.writer.close()


def _drained(line: queue.Queue) -> Iterator[Block]:
    while (entry := line.get()) is not None:
        if isinstance(entry, _Dropped):
            raise entry
        yield entry
