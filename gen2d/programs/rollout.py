"""Compiled programs of a config: video numbers in, ground truth and frames out, in batches of a fixed size.

There are two programs. `simulate` samples and simulates `batch_size` videos on every device. `draw` renders slices of
them, small enough that the frames stay in the cache until they are compressed. `batch_size` comes from the config, not
from the machine: more devices run more batches, not larger ones. Video i is always in row i % batch_size of the same
program, so its bits do not depend on how many videos are generated, or where.
"""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

from gen2d.config import quality
from gen2d.config.config import Config
from gen2d.config.sections import MatchedOptions, PhysicsOptions, QualityOptions
from gen2d.core import enums
from gen2d.programs import render
from gen2d.programs.schema import VideoSchema
from gen2d.programs.shared import BoundProgram, program_for
from gen2d.programs.simulation import BatchSimulation, DeviceBatch
from gen2d.records import keys as keys_module
from gen2d.records.axes import Array
from gen2d.renderers.plan import RenderScene
from gen2d.sampling import rejection

SLICE_BYTES = 16 * 2**20  # of raw frames rendered at once; larger buffers cost page faults
SHARD_BYTES = 2**30  # of raw frames in a shard
SHARD_VIDEOS = 1024  # largest default number of videos in a shard
# Limits of a default batch: videos, and pairs of their bodies, which take 300 bytes each.
BATCH_SIZE, PAIRS = 512, 2**20
VIDEOS = PartitionSpec("videos")


def _power_of_two(limit: int) -> int:
    return 1 << max(0, limit.bit_length() - 1)


def divisor(number: int, limit: int) -> int:
    """Largest divisor of a number that does not exceed the limit."""
    return next(d for d in range(min(number, limit), 0, -1) if number % d == 0)


class Rollout:
    """Compiled programs of one config on some devices."""

    def __init__(self, config: Config, devices: Sequence[Any]) -> None:
        self.config, self.devices = config, list(devices)
        video, self.sparse = config.video, self.devices[0].platform == "cpu"
        self.simulation = BatchSimulation(config, self.sparse)
        self.layout, self.plan, self.sampler = self.simulation.layout, self.simulation.plan, self.simulation.sampler
        self.steps, self.quality_ranges = self.simulation.steps, self.simulation.quality_ranges
        self.schema = VideoSchema(config, self.layout, self.plan, self.simulation.save_at, self.sampler)
        frame_bytes = video.frames * video.height * video.width * 3
        default_shard = min(SHARD_VIDEOS, _power_of_two(SHARD_BYTES // frame_bytes))
        self.videos_per_shard = config.storage.videos_per_shard or default_shard
        moving = sum(run.count for run in self.layout.groups if run.kind == enums.DYNAMIC)
        pairs = moving * (self.layout.slots - moving) + moving * (moving - 1) // 2
        default_batch = min(BATCH_SIZE, _power_of_two(PAIRS // max(pairs, 1)))
        # A shard size in the config must not change the videos.
        self.batch_size = config.storage.batch_size or min(default_batch, default_shard)
        self.slice = divisor(self.batch_size, max(1, SLICE_BYTES // frame_bytes))
        self.mesh = Mesh(np.array(self.devices), ("videos",))
        self._simulate: BoundProgram | None = None
        self._draws: dict[int, BoundProgram] = {}  # by number of videos
        self._compiled: set[int] = set()  # keys of `_draws` that are compiled

    def start(self, split: str, numbers: np.ndarray) -> DeviceBatch:
        """Start to simulate the videos of a split with these numbers [devices * batch_size].

        Raises NoVideoError if no attempt at some video lies in the ranges that the config requires.
        """
        root, row = keys_module.seed_words(self.config.seed, zlib.crc32(split.encode())), self.config.split_index(split)
        numbers = numbers.astype(np.uint32)
        grid = self.sampler.grid_values(row, root, numbers)

        def simulate_rows(rows: np.ndarray, attempts: np.ndarray) -> DeviceBatch:
            sharded = self._shard_over_devices((grid[rows], numbers[rows], attempts.astype(np.uint32)))
            args = root, np.int32(row), *sharded
            if self._simulate is None:
                self._simulate = self._simulation_program(self.devices, args)
            batch = self._simulate(*args)
            return self._with_visibility(batch) if quality.VISIBILITY in self.quality_ranges else batch

        if not self.quality_ranges:
            return simulate_rows(np.arange(len(numbers)), np.zeros(len(numbers)))
        batch, attempts = rejection.accepted_batch(simulate_rows, numbers, self.config.quality)
        batch.columns.pop(quality.VISIBILITY, None)  # `draw` returns it
        rejected = self._shard_over_devices(attempts.astype(np.int32))
        return batch._replace(columns=batch.columns | {"quality/rejected_videos": rejected})

    def _shard_over_devices(self, arrays: Any) -> Any:
        """Arrays [n, ...], sharded over the devices."""
        if len(self.devices) == 1:  # without a mesh, as in `lowered`, so that the program is traced only once
            return jax.device_put(arrays, self.devices[0])
        return jax.device_put(arrays, NamedSharding(self.mesh, VIDEOS))

    def _with_visibility(self, batch: DeviceBatch) -> DeviceBatch:
        """The batch with its visibility, which only rendering gives."""
        slices = [self.draw(batch, start, self.slice) for start in range(0, self.batch_size, self.slice)]
        visibility = [np.asarray(part[quality.VISIBILITY]) for parts in zip(*slices, strict=True) for part in parts]
        sharded = self._shard_over_devices(np.concatenate(visibility))  # devices first, then their slices
        return batch._replace(columns=batch.columns | {quality.VISIBILITY: sharded})

    def draw(self, batch: DeviceBatch, start: int, count: int) -> list[dict[str, Array]]:
        """Start to render `count` videos of each device, from row `start` on.

        Returns each device's frames [count, T, H, W, 3] and annotations by stored name. Each device runs a separate
        program, because a program for several devices would round differently.
        """
        scenes_by_device = [
            jax.tree.map(lambda array, d=d: _device_shards(array)[d].data, batch.render_scenes)
            for d in range(len(self.devices))
        ]
        if count not in self._draws:
            self._draws[count] = self._draw_program(count, (scenes_by_device[0], np.int32(start)))
        draw = functools.partial(self._draws[count], start=np.int32(start))
        if count in self._compiled:
            return [draw(scenes) for scenes in scenes_by_device]
        self._compiled.add(count)
        with ThreadPoolExecutor(len(scenes_by_device)) as pool:  # compiles for all devices in parallel
            return list(pool.map(draw, scenes_by_device))

    def lowered(self) -> dict[str, str]:
        """Text of each program, lowered for one device, and its arguments that come from the numbers of the config."""
        one = SingleDeviceSharding(self.devices[0])
        numbers = jax.ShapeDtypeStruct((self.batch_size,), np.uint32, sharding=one)
        grid = jax.ShapeDtypeStruct((self.batch_size, len(self.sampler.gridded)), np.float32, sharding=one)
        scalar = jax.ShapeDtypeStruct((), np.int32)
        args = jax.ShapeDtypeStruct((3,), np.uint32), scalar, grid, numbers, numbers
        simulate = self._simulation_program(self.devices[:1], args)
        simulation = simulate.lower(*args)
        scenes = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=one), simulation.out_info.render_scenes
        )
        draw = self._draw_program(self.slice, (scenes, scalar))
        rendering = draw.lower(scenes, scalar)
        return {
            "simulate": f"{simulation.as_text()}{simulate.values}",
            "draw": f"{rendering.as_text()}{draw.values}",
        }

    def _simulation_program(self, devices: Sequence[Any], args: tuple) -> BoundProgram:
        """Program that samples and simulates `batch_size` videos on each device."""
        annotations = dataclasses.replace(self.config.annotations, pixels=())
        config, mesh = dataclasses.replace(self.config, annotations=annotations), Mesh(np.array(devices), ("videos",))

        def simulate_batch(config: Config) -> BatchSimulation:
            return BatchSimulation(config, self.sparse)

        def over_devices(run: Any) -> Any:
            specs = PartitionSpec(), PartitionSpec(), PartitionSpec(), VIDEOS, VIDEOS, VIDEOS
            return jax.shard_map(run, mesh=mesh, in_specs=specs, out_specs=VIDEOS, check_vma=False)

        wrap = over_devices if len(devices) > 1 else None
        return program_for(config, (tuple(devices), self.batch_size), simulate_batch, args, wrap)

    def _draw_program(self, count: int, args: tuple) -> BoundProgram:
        """Program that renders `count` videos."""
        config = dataclasses.replace(
            self.config, physics=PhysicsOptions(), matched=MatchedOptions(), quality=QualityOptions(), splits=()
        )

        def render_slice(config: Config) -> Callable[[RenderScene, Array], dict[str, Array]]:
            plan = render.plan_of(config, config.scene.contract.layout(config.scene.options))

            def run(render_scenes: RenderScene, start: Array) -> dict[str, Array]:
                part = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, count), render_scenes)
                return render.render_frames(part, plan, config.annotations)

            return run

        return program_for(config, (count, self.batch_size), render_slice, args)

    def host_columns(self, batch: DeviceBatch) -> list[dict[str, np.ndarray]]:
        """Each device's columns as NumPy arrays; waits for the devices."""
        columns = {name: per_device(array) for name, array in batch.columns.items()}
        if "contacts/time" in columns:  # a device may have no float64
            columns["contacts/time"] = [array.astype(np.float64) for array in columns["contacts/time"]]
        return [{name: arrays[d] for name, arrays in columns.items()} for d in range(len(self.devices))]


def _device_shards(array: Array) -> list[Any]:
    return sorted(array.addressable_shards, key=lambda shard: shard.index[0].start or 0)


def per_device(array: Array) -> list[np.ndarray]:
    """Each device's part of an array, as NumPy arrays."""
    return [np.asarray(shard.data) for shard in _device_shards(array)]
