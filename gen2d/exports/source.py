"""Videos to export, read one at a time, so that memory does not grow with the size of the dataset."""

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

FRAMES = Field("uint8", "n T H W 3", "sRGB", "frames of the video")  # equal to the field of stored frames
RENDERED_BYTES = 2**26  # size of a batch of rendered frames


@dataclasses.dataclass(frozen=True)
class Source:
    """Videos of one split to export, in their order."""

    ds: Dataset
    renders: bool  # whether frames are rendered, because they are not stored
    trust: Sequence[str]  # sha256 of code that came with the dataset and may run to render
    advance: Callable[[int], None]  # to be called with the number of videos just written

    def __len__(self) -> int:
        return len(self.ds)

    @property
    def fields(self) -> dict[str, Field]:
        """The fields of each video, by name."""
        return ({"frames": FRAMES} if self.renders else {}) | self.ds.fields

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.ds.manifest.fps

    @property
    def frame_size(self) -> tuple[int, int]:
        """Height and width of frames, px."""
        return self.ds.manifest.sizes["H"], self.ds.manifest.sizes["W"]

    @property
    def video_bytes(self) -> int:
        """Size of one video before compression, bytes."""
        return sum(stored_bytes(field, self.ds.manifest.sizes) for field in self.fields.values())

    def key(self, number: int) -> str:
        """File name of a video, without suffix: the split and the index, padded so that names sort by index."""
        return f"{self.ds.options.split}-{number:09d}"

    def videos(self) -> Iterator[Batch]:
        """Videos one at a time, as dictionaries of arrays by field name."""
        frames = self._rendered_frames() if self.renders else iter(())
        for number in range(len(self)):
            yield ({"frames": next(frames)} if self.renders else {}) | self.ds[number]

    def each(self, write: Callable[[str, Batch], None]) -> None:
        """Call `write(key, video)` for every video in several threads, and report the progress to `advance`."""
        threads = min(os.cpu_count() or 1, 8)
        running: deque[Future[None]] = deque()
        with ThreadPoolExecutor(threads) as pool:
            for number, video in enumerate(self.videos()):
                running.append(pool.submit(write, self.key(number), video))
                if len(running) > threads:
                    running.popleft().result()
                    self.advance(1)
            for future in running:
                future.result()
                self.advance(1)

    def _rendered_frames(self) -> Iterator[np.ndarray]:
        """Rendered frames [T, H, W, 3] of each video; batches have equal sizes, so one program is compiled."""
        from gen2d.programs.redraw import render  # imports jax

        count = max(1, min(128, len(self), RENDERED_BYTES // stored_bytes(FRAMES, self.ds.manifest.sizes)))
        for first in range(0, len(self), count):
            numbers = np.minimum(np.arange(first, first + count), len(self) - 1)
            yield from np.asarray(render(self.ds, numbers, trust=self.trust))[: len(self) - first]


def source_of(root: str | Place, split: str | None, patterns: Sequence[str], trust: Sequence[str] = ()) -> Source:
    """Videos of a split with the fields that match `patterns`; frames that match but are not stored are rendered.

    Raises the errors of `open`.
    """
    ds = loader.open(root, split, fields=())
    renders = "frames" not in ds.manifest.fields and any(fnmatch.fnmatch("frames", p) for p in patterns)
    stored = [pattern for pattern in patterns if pattern != "frames"] if renders else patterns
    return Source(loader.open(root, ds.options.split, stored), renders, trust, lambda videos: None)
