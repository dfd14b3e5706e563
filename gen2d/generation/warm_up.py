"""Start of a run: compile, time a slice, estimate size and duration, and refuse what does not fit the disk."""

import time
from collections.abc import Callable, Sequence

import jax
import numpy as np

from gen2d.core.errors import FolderError, UserError, argument
from gen2d.core.humanize import in_bytes, in_time, with_noun
from gen2d.core.progress import waiting
from gen2d.core.sizes import divisor
from gen2d.dataset import folder as shards
from gen2d.dataset.block import Block
from gen2d.dataset.spec import DatasetSpec
from gen2d.generation.encoder import Encoder, threads_for
from gen2d.programs import devices
from gen2d.programs.rollout import DeviceBatch, Rollout
from gen2d.programs.source import Request, VideoRange, VideoSlice, VideoSource
from gen2d.storage.paths import Place


class DeviceMemoryError(UserError):
    """A batch does not fit the memory of the device."""


def warm_up(
    source: VideoSource, encoder: Encoder, ranges: Sequence[VideoRange], count: int, log: Callable[[str], None]
) -> float:
    """Compile, and report the estimated size and duration of a run of `count` videos; return the seconds of compiling.

    The source keeps the first batch, so that a run of a single one simulates no more. Raises FolderError if the disk
    is too small, and DeviceMemoryError if a batch does not fit the device.
    """
    began = time.perf_counter()
    request, batches = compile_for(source, ranges, log)
    compiled = time.perf_counter() - began
    single = count <= len(request.numbers)
    with waiting("Measuring the speed", log):
        block, seconds = _measure(source, encoder, batches, next(source.requests(ranges[:1])), single)
    size, duration = block.nbytes / len(block) * count, "" if single else f" and {in_time(seconds * count)}"
    log(f"Compiled in {compiled:.1f} s. {count:,} videos will take about {in_bytes(size)}{duration}.")
    _warn_of_low_compression(encoder.dataset, block, log)
    check_disk(encoder.dataset.root, size)
    return compiled


def compile_for(
    source: VideoSource, ranges: Sequence[VideoRange], log: Callable[[str], None]
) -> tuple[Request, list[DeviceBatch]]:
    """Compile the programs of these videos; return the first request and its batches, which the source keeps.

    Raises DeviceMemoryError if a batch does not fit the device.
    """
    rollout = source.rollout
    name = with_noun(len(rollout.devices), f"{rollout.devices[0].platform} device")
    request = next(source.requests(ranges[:1]))
    try:
        with waiting(f"Compiling for {name} (seconds; up to a minute for dozens of objects; kept for later runs)", log):
            rollout.compile()
        with waiting("Simulating the first batch", log):
            batches = jax.block_until_ready(rollout.start(request.split, request.numbers))
    except jax.errors.JaxRuntimeError as error:
        raise _device_error(error) from None
    with waiting("Rendering its first videos", log):
        _fit_slice(rollout, batches)
    source.keep(request, batches)
    return request, batches


def check_disk(root: Place, size: float) -> None:
    """Raise FolderError if the disk of the dataset has less space than these bytes."""
    free = shards.free_bytes(root)
    if size > free:
        raise FolderError(
            f"{root} would need about {in_bytes(size)}, but its disk has {in_bytes(free)} free; "
            f"ask for fewer videos, or name another disk with {argument('out')}"
        )


def _fit_slice(rollout: Rollout, batches: list[DeviceBatch]) -> None:
    """Compile the rendering, and halve the slice until it fits the memory of the device."""
    while True:
        try:
            jax.block_until_ready(rollout.draw(batches, 0, rollout.slice))
            return
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or rollout.slice == 1:
                raise _device_error(error) from None
            rollout.slice = divisor(rollout.batch_size, rollout.slice // 2)


def _measure(
    source: VideoSource, encoder: Encoder, batches: list[DeviceBatch], request: Request, single: bool
) -> tuple[Block, float]:
    """The first block, and the estimated time for a video in s, without that of the simulation in a `single` batch."""
    rollout, part, marks = source.rollout, request.parts[0], [time.perf_counter()]
    if not single:
        jax.block_until_ready(rollout.start(request.split, request.numbers))
    marks.append(time.perf_counter())
    drawn = jax.block_until_ready(rollout.draw(batches, part.start, rollout.slice))
    marks.append(time.perf_counter())
    columns, rendered = rollout.host_columns(batches)[part.device], devices.start_transfer(drawn[part.device])
    block = encoder.encode(VideoSlice(part, columns, rendered, source.schema.host_columns))
    marks.append(time.perf_counter())
    count, threads = len(rollout.devices), threads_for(devices.cores())
    videos = rollout.batch_size * count, rollout.slice * count, len(block) * threads
    return block, sum((b - a) / n for a, b, n in zip(marks, marks[1:], videos, strict=False))


def _warn_of_low_compression(dataset: DatasetSpec, block: Block, log: Callable[[str], None]) -> None:
    """Report if gzip compresses the frames badly."""
    if "frames" not in dataset.fields:
        return
    raw = len(block) * int(np.prod(dataset.fields["frames"].shape(dataset.sizes)))
    ratio = raw / sum(map(len, block.chunks["frames"]))
    if dataset.codec == "gzip" and ratio < 3:
        log(
            f"gzip makes these frames only {ratio:.1f} times smaller; {argument('set', 'storage.codec=zstd')} may do "
            "better."
        )


def _device_error(error: Exception) -> Exception:
    if "RESOURCE_EXHAUSTED" in str(error):
        return DeviceMemoryError(
            "the device has too little memory for a batch: lower storage.batch_size, or use "
            f"{argument('device', 'cpu')}"
        )
    return error
