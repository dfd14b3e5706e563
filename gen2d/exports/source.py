"""Videos to export, one at a time, so that a dataset of any size is exported in little memory."""

import dataclasses
import fnmatch
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from gen2d.core.schema import Field
from gen2d.dataset.block import stored_bytes
from gen2d.loading import dataset as loader
from gen2d.loading.dataset import Dataset
from gen2d.loading.protocols import Batch
from gen2d.storage.paths import Place

FRAMES = Field("uint8", "n T H W 3", "sRGB", "the video")  # as they are where they are stored
DRAWN_BYTES = 2**26  # frames that are not stored are drawn so many at a time


@dataclasses.dataclass(frozen=True)
class Source:
    """The videos to export, in their order."""

    ds: Dataset
    draws: bool  # frames, which are not stored
    trust: Sequence[str]  # sha256 of code that came with the dataset and may run, if it draws
    advance: Callable[[int], None]  # told of each video that is done

    def __len__(self) -> int:
        return len(self.ds)

    @property
    def fields(self) -> dict[str, Field]:
        """What each video has, by name."""
        return ({"frames": FRAMES} if self.draws else {}) | self.ds.fields

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.ds.manifest.fps

    @property
    def frame_size(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.ds.manifest.sizes["H"], self.ds.manifest.sizes["W"]

    @property
    def video_bytes(self) -> int:
        """What one video takes before compression."""
        return sum(stored_bytes(field, self.ds.manifest.sizes) for field in self.fields.values())

    def key(self, number: int) -> str:
        """A video's name in files: split and number, so that names sort as numbers do."""
        return f"{self.ds.options.split}-{number:09d}"

    def videos(self) -> Iterator[Batch]:
        """The videos one by one, arrays by field."""
        frames = self._drawn() if self.draws else iter(())
        for number in range(len(self)):
            drawn = {"frames": next(frames)} if self.draws else {}
            yield drawn | self.ds[number]

    def each(self, write: Callable[[str, Batch], None]) -> None:
        """Returns nothing; calls `write(key, video)` for every video, several at once."""
        threads = min(os.cpu_count() or 1, 8)
        running: deque[Future[None]] = deque()
        with ThreadPoolExecutor(threads) as pool:
            for number, video in enumerate(self.videos()):
                running.append(pool.submit(write, self.key(number), video))
                if len(running) > threads:
                    running.popleft().result()
                    self.advance(1)
            for left in running:
                left.result()
                self.advance(1)

    def _drawn(self) -> Iterator[np.ndarray]:
        """Frames of one video after the other, drawn several at a time, always as many: one program is compiled."""
        from gen2d.programs.redraw import render  # imports jax: only now

        count = max(1, min(128, len(self), DRAWN_BYTES // stored_bytes(FRAMES, self.ds.manifest.sizes)))
        for first in range(0, len(self), count):
            numbers = np.minimum(np.arange(first, first + count), len(self) - 1)
            yield from np.asarray(render(self.ds, numbers, trust=self.trust))[: len(self) - first]


def source_of(root: str | Place, split: str | None, patterns: Sequence[str], trust: Sequence[str] = ()) -> Source:
    """The videos of a dataset's split with these fields; frames are drawn where they are asked for but not stored."""
    ds = loader.open(root, split, fields=())
    draws = "frames" not in ds.manifest.fields and any(fnmatch.fnmatch("frames", p) for p in patterns)
    stored = [pattern for pattern in patterns if pattern != "frames"] if draws else patterns
    return Source(loader.open(root, ds.options.split, stored), draws, trust, lambda videos: None)
