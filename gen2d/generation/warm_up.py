"""Before a run: compile, measure a slice, estimate, and refuse what cannot be."""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from gen2d.core.errors import FolderError, UserError
from gen2d.core.humanize import in_bytes, in_time
from gen2d.dataset import folder as shards
from gen2d.dataset.block import Block
from gen2d.dataset.spec import DatasetSpec
from gen2d.generation.encoder import Encoder, EncodeTask, encode_tasks, threads_for
from gen2d.programs import devices
from gen2d.programs.rollout import DeviceBatch, Rollout, divisor


class DeviceMemoryError(UserError):
    """A batch that does not fit the device."""


def warm_up(rollout: Rollout, encoder: Encoder, work: list, count: int, say: Callable[[str], None]) -> None:
    """Compiles, measures a slice, says how much and how long it will be, and refuses what the disk cannot hold."""
    name = f"{len(rollout.devices)} {rollout.devices[0].platform} device{'s' if len(rollout.devices) > 1 else ''}"
    say(f"Compiling for {name} (seconds; up to a minute for dozens of objects; kept for the next run) ...")
    began = time.perf_counter()
    split, first, pieces = work[0]
    firsts = [first] * len(rollout.devices)
    batch = _fitted(lambda: jax.block_until_ready(rollout.begin(split, firsts)))
    _fit_slice(rollout, batch)
    compiled = time.perf_counter() - began
    job = encode_tasks(firsts, [pieces, *([] for _ in firsts[1:])], rollout.batch_size, rollout.slice)[0]
    block, seconds = _measured(rollout, encoder, batch, split, firsts, job)
    size, duration = block.nbytes / len(block) * count, seconds * count
    say(f"Compiled in {compiled:.1f} s. {count:,} videos will take about {in_bytes(size)} and {in_time(duration)}.")
    _warn_of_ratio(encoder.dataset, block, say)
    free = shards.free_bytes(encoder.dataset.root)
    if size > free:
        raise FolderError(
            f"{encoder.dataset.root} would need about {in_bytes(size)}, but its disk has {in_bytes(free)} free; "
            "ask for fewer videos, or name another disk with --out"
        )


def _fit_slice(rollout: Rollout, batch: DeviceBatch) -> None:
    """Returns nothing; compiles the drawing, of fewer videos at once where the device has no memory for more."""
    while True:
        try:
            jax.block_until_ready(rollout.draw(batch, 0, rollout.slice))
            return
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or rollout.slice == 1:
                raise _explained(error) from None
            rollout.slice = divisor(rollout.batch_size, rollout.slice // 2)


def _measured(
    rollout: Rollout, encoder: Encoder, batch: DeviceBatch, split: str, firsts: list[int], job: EncodeTask
) -> tuple[Block, float]:
    """The first block, and about how many seconds a video takes."""
    marks = [time.perf_counter()]
    jax.block_until_ready(rollout.begin(split, firsts))
    marks.append(time.perf_counter())
    drawn = jax.block_until_ready(rollout.draw(batch, job.start, rollout.slice))
    marks.append(time.perf_counter())
    block = encoder.encode(job, rollout.host_columns(batch)[0], drawn[0])
    marks.append(time.perf_counter())
    count, threads = len(rollout.devices), threads_for(devices.cores())
    videos = rollout.batch_size * count, rollout.slice * count, len(block) * threads
    return block, sum((b - a) / n for a, b, n in zip(marks, marks[1:], videos, strict=False))


def _warn_of_ratio(dataset: DatasetSpec, block: Block, say: Callable[[str], None]) -> None:
    """Says so, once, where gzip does not suit the frames."""
    if "frames" not in dataset.fields:
        return
    raw = len(block) * int(np.prod(dataset.fields["frames"].shape(dataset.sizes)))
    ratio = raw / sum(map(len, block.chunks["frames"]))
    if dataset.codec == "gzip" and ratio < 3:
        say(f"gzip makes these frames only {ratio:.1f} times smaller; --set storage.codec=zstd may do better.")


def _fitted(call: Callable[[], Any]) -> Any:
    try:
        return call()
    except jax.errors.JaxRuntimeError as error:
        raise _explained(error) from None


def _explained(error: Exception) -> Exception:
    if "RESOURCE_EXHAUSTED" in str(error):
        return DeviceMemoryError(
            "the device has too little memory for a batch: lower storage.batch_size, or use --device cpu"
        )
    return error
