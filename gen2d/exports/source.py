"""Videos to export, read one at a time, so that memory does not grow with the size of the dataset."""

import dataclasses
import fnmatch
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np

from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.dataset.block import stored_bytes
from gen2d.loading import dataset as loader
from gen2d.loading.dataset import Dataset, RenderOptions
from gen2d.loading.fields import RENDERED
from gen2d.loading.protocols import Batch, unbatch
from gen2d.storage.paths import Place

BATCH_BYTES = 2**26  # of videos that are read, or rendered, at once
Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True)
class Source:
    """Videos of one split to export, in their order."""

    ds: Dataset
    advance: Callable[[int], None]  # to be called with the number of videos just written
    part: range | None = None  # of the selected videos, by their places, if these are not all
    selection: np.ndarray | None = None  # numbers of the selected videos, ascending, if these are not all of the split
    codec: str = ""  # encoding of the frames; "" where the format has one only
    notes: Path = Path()  # folder of the files that `write` leaves for `finish`, those of all parts
    jobs: int = 0  # number of threads; 0: one for each core, but at most 8

    @property
    def places(self) -> range:
        """Places of these videos among those that are selected."""
        return range(self.total) if self.part is None else self.part

    @property
    def numbers(self) -> range | list[int]:
        """Numbers of the videos in the dataset."""
        places = self.places
        return places if self.selection is None else [int(n) for n in self.selection[places.start : places.stop]]

    def __len__(self) -> int:
        return len(self.places)

    @property
    def total(self) -> int:
        """Number of videos of the whole export, of which these may be a part."""
        return len(self.ds) if self.selection is None else len(self.selection)

    @property
    def fields(self) -> dict[str, Field]:
        """The fields of each video, by name."""
        return self.ds.fields

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of the axes of the fields; T are the frames of this split, of which more may be stored."""
        return {**self.ds.sizes, "T": len(self.ds.time)} if "T" in self.ds.sizes else self.ds.sizes

    @property
    def threads(self) -> int:
        """Number of threads that encode videos."""
        return self.jobs or min(os.cpu_count() or 1, 8)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.ds.manifest.fps

    @property
    def frame_size(self) -> tuple[int, int]:
        """Height and width of frames, px."""
        return self.ds.sizes["H"], self.ds.sizes["W"]

    @property
    def video_bytes(self) -> int:
        """Size of one video before compression, bytes."""
        return sum(stored_bytes(field, self.ds.sizes) for field in self.fields.values())

    @property
    def stored_video_bytes(self) -> int:
        """Size of one video of the split in its shards, with all fields, bytes."""
        split = self.ds.options.split
        return -(-self.ds.manifest.tables[split].bytes // max(1, self.ds.manifest.splits[split]))

    def key(self, number: int) -> str:
        """File name of a video, without suffix: the split and the index, padded so that names sort by index."""
        return f"{self.ds.options.split}-{number:09d}"

    def videos(self) -> Iterator[Batch]:
        """Videos one at a time, as dictionaries of arrays by field name."""
        count, numbers = max(1, BATCH_BYTES // max(1, self.video_bytes)), self.numbers
        for first in range(0, len(numbers), count):
            yield from unbatch(self.ds.batch(numbers[first : first + count]))

    def each(self, write: Callable[[str, Batch], None]) -> None:
        """Call `write(key, video)` for every video in several threads, and report the progress to `advance`."""
        for _ in self.map(write):
            self.advance(1)

    def map(self, function: Callable[[str, Batch], Result]) -> Iterator[Result]:
        """Results of `function(key, video)` of every video, in their order, from several threads."""
        running: deque[Future[Result]] = deque()
        with ThreadPoolExecutor(self.threads) as pool:
            for number, video in zip(self.numbers, self.videos(), strict=True):
                running.append(pool.submit(function, self.key(number), video))
                if len(running) > self.threads:
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()


def source_of(
    root: str | Place,
    split: str | None,
    patterns: Sequence[str],
    trust: Sequence[str] = (),
    render: RenderOptions | None = None,
) -> Source:
    """Videos of a split with the fields that match `patterns`.

    Frames that match but are not stored are rendered, and so are annotations that are named beside frames.

    Raises the errors of `open`.
    """
    ds = loader.open(root, split, fields=())
    if any(fnmatch.fnmatch("frames", pattern) for pattern in patterns):
        missing = [
            name for name in ("frames", *patterns) if name.startswith(RENDERED) and name not in ds.manifest.fields
        ]
        if render is not None or missing:
            render, patterns = {"trust": trust, **(render or {})}, ["frames", *patterns]
    elif render is not None:
        raise ConfigError(f"render is {render!r}, but must be None where no frames are exported")
    return Source(loader.open(root, ds.options.split, patterns, render=render), lambda videos: None)
