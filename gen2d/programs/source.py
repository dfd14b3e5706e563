"""Videos of a config by split and number, for generation, streaming, rendering, previews and verification.

A request names the videos of one batch. The source simulates it, checks that all objects were placed, and renders it in
slices. Its users see neither batches nor slices, padding for idle devices or host-computed fields.
"""

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gen2d.config.config import Config
from gen2d.core.errors import UserError
from gen2d.programs.devices import start_transfer
from gen2d.programs.rollout import Rollout
from gen2d.programs.schema import VideoSchema
from gen2d.programs.simulation import DeviceBatch
from gen2d.records.axes import Array


class NoPlaceError(UserError):
    """The objects of a scene do not fit."""


class VideoRange(NamedTuple):
    """Videos `first` to `stop`, exclusive, of a split; `tag` is the caller's own identifier."""

    split: str
    first: int
    stop: int
    tag: Any = None


class Part(NamedTuple):
    """Videos of one range that one device renders together."""

    order: int  # index among all parts, in the order of the ranges and their videos
    range: VideoRange
    device: int
    first: int  # number of the video in row 0 of the device's batch
    start: int  # first row of the slice
    rows: slice  # of the part's videos in the device's batch

    @property
    def numbers(self) -> np.ndarray:
        """Numbers of the videos in their split, int64."""
        return np.arange(self.first + self.rows.start, self.first + self.rows.stop)


class Request(NamedTuple):
    """Videos that are simulated together."""

    split: str
    numbers: np.ndarray  # [devices * batch_size]
    wanted: np.ndarray  # bool, same shape; False for padding
    parts: Sequence[Part] = ()


class VideoSlice(NamedTuple):
    """Videos of one range that one device renders."""

    part: Part
    columns: dict[str, np.ndarray]  # of the device's whole batch
    rendered: dict[str, Array]  # of the slice
    host_columns: Callable[[dict[str, np.ndarray], str], dict[str, np.ndarray]]

    def __len__(self) -> int:
        return self.part.rows.stop - self.part.rows.start

    def fields(self, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Stored fields [m, ...] by name, by default all; waits for the device."""
        rows, start = self.part.rows, self.part.start
        fields = {name: column[rows] for name, column in self.columns.items()}
        for name, array in self.rendered.items():
            if names is None or name in names:
                fields[name] = np.asarray(array)[rows.start - start : rows.stop - start]
        fields["index"] = self.part.numbers
        if names is None or not fields.keys() >= set(names):
            fields |= self.host_columns(fields, self.part.range.split)
        return fields if names is None else {name: fields[name] for name in names}


class VideoSource:
    """Videos of one config on some devices; `schema` lists their fields, by default those of this config."""

    def __init__(self, config: Config, devices: Sequence[Any], schema: VideoSchema | None = None) -> None:
        self.config, self.rollout = config, Rollout(config, devices)
        self.schema = schema or self.rollout.schema
        self._kept: tuple[Request, list[DeviceBatch]] | None = None

    def of_splits(self, splits: Iterable[str]) -> Iterator[tuple["VideoSource", set[str]]]:
        """Sources of these splits, each with the splits that share it.

        A split with its own look or physics has its own source, whose videos have the fields of the whole config.
        """
        groups: dict[Config, set[str]] = {}
        for split in splits:
            groups.setdefault(self.config.of_split(split), set()).add(split)
        for config, group in groups.items():
            yield self if config == self.config else VideoSource(config, self.rollout.devices, self.schema), group

    def videos(self, split: str, numbers: Any, fields: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Fields [n, ...] by name of the videos of a split with these numbers [n]; by default all fields.

        Raises NoPlaceError if the objects of a video do not fit.
        """
        unique, inverse = np.unique(np.asarray(numbers), return_inverse=True)
        runs = np.split(unique, np.flatnonzero(np.diff(unique) != 1) + 1)
        ranges = [VideoRange(split, int(run[0]), int(run[-1]) + 1) for run in runs]
        parts = {videos.part.order: videos.fields(fields) for videos in self.slices(ranges)}
        ordered = [parts[order] for order in sorted(parts)]
        return {name: np.concatenate([part[name] for part in ordered])[inverse] for name in ordered[0]}

    def slices(self, ranges: Sequence[VideoRange]) -> Iterator[VideoSlice]:
        """Videos of these ranges in the order in which they are rendered; `part.order` gives the order of the ranges.

        The next batch is started when the caller has taken the last slice of the current one.
        """
        for request, batches in self.batches(self.requests(ranges)):
            columns = self.rollout.host_columns(batches)
            for start in sorted({part.start for part in request.parts}):
                drawn = self.rollout.draw(batches, start, self.rollout.slice)
                rendered = [start_transfer(arrays) for arrays in drawn]
                for part in request.parts:
                    if part.start == start:
                        at = part.device
                        yield VideoSlice(part, columns[at], rendered[at], self.schema.host_columns)

    def requests(self, ranges: Sequence[VideoRange]) -> Iterator[Request]:
        """Requests that cover these ranges, one batch for each device.

        Batch b holds the videos from b * batch_size on, whatever the ranges are, so that every video keeps its row.
        Idle devices are padded with a copy of the last batch.
        """
        size, devices, order = self.rollout.batch_size, len(self.rollout.devices), itertools.count()
        batches: dict[tuple[str, int], list[VideoRange]] = {}
        for video_range in ranges:
            for first in range(video_range.first // size * size, video_range.stop, size):
                batches.setdefault((video_range.split, first), []).append(video_range)
        for split, group in itertools.groupby(batches, key=lambda batch: batch[0]):
            firsts = [first for _, first in group]
            for position in range(0, len(firsts), devices):
                starts, step, parts = firsts[position : position + devices], self.rollout.slice, []
                for device, first in enumerate(starts):
                    for video_range in batches[split, first]:
                        low, high = max(video_range.first - first, 0), min(video_range.stop - first, size)
                        for start in range(low // step * step, high, step):
                            rows = slice(max(low, start), min(high, start + step))
                            parts.append(Part(next(order), video_range, device, first, start, rows))
                starts += starts[-1:] * (devices - len(starts))
                numbers = np.concatenate([np.arange(first, first + size) for first in starts])
                wanted = np.zeros((devices, size), bool)
                for part in parts:
                    wanted[part.device, part.rows] = True
                yield Request(split, numbers, wanted.ravel(), parts)

    def keep(self, request: Request, batches: list[DeviceBatch]) -> None:
        """Use these batches when the same videos are requested next."""
        self._kept = request, batches

    def _start(self, request: Request) -> list[DeviceBatch]:
        kept, self._kept = self._kept, None
        if kept and kept[0].split == request.split and np.array_equal(kept[0].numbers, request.numbers):
            return kept[1]
        return self.rollout.start(request.split, request.numbers)

    def batches(self, requests: Iterable[Request], ahead: int = 0) -> Iterator[tuple[Request, list[DeviceBatch]]]:
        """Simulated batches in order, one for each device; up to `ahead` more requests are in flight.

        Raises NoPlaceError if the objects of a wanted video do not fit.
        """
        started: deque[tuple[Request, list[DeviceBatch]]] = deque()
        for request in requests:
            started.append((request, self._start(request)))
            if len(started) > ahead:
                yield self._check_placed(*started.popleft())
        while started:
            yield self._check_placed(*started.popleft())

    def _check_placed(self, request: Request, batches: list[DeviceBatch]) -> tuple[Request, list[DeviceBatch]]:
        misplaced = request.wanted & ~np.concatenate([np.asarray(batch.placed) for batch in batches])
        if misplaced.any():
            options = [f"scene.{name}" for name in self.config.scene.contract.crowded_by]
            cause = f": it depends on {', '.join(options)}" if options else ""
            raise NoPlaceError(
                f"scene: video {request.numbers[np.argmax(misplaced)]} could not be placed without overlap in 100 "
                f"attempts{cause}; ask for fewer or smaller objects, or for more room"
            )
        return request, batches
