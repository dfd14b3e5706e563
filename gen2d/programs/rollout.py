"""Compiled programs of a config: video numbers in, ground truth and frames out, in batches of a fixed size.

Four programs follow each other: `sample`, `simulate` and `stage` (programs/simulation.py) for a batch, and `draw` for
slices of it, small enough that the frames stay in the cache until they are compressed. Every device runs the same
executables on its own batches. `batch_size` comes from the config, not from the machine: more devices run more batches,
not larger ones. Video i is always in row i % batch_size of the same program, so its bits do not depend on how many
videos are generated, or where.
"""

import functools
import zlib
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from gen2d.config import quality
from gen2d.config.config import Config
from gen2d.config.parameters import only_sections
from gen2d.core import enums
from gen2d.core.sizes import divisor, power_of_two
from gen2d.programs import render
from gen2d.programs.devices import Device, start_transfer
from gen2d.programs.schema import VideoSchema
from gen2d.programs.shared import BoundProgram, Build, program_for
from gen2d.programs.simulation import (
    DeviceBatch,
    Members,
    Sampling,
    Simulation,
    Staging,
    device_batch,
    save_at,
    steps_of,
)
from gen2d.records import keys as keys_module
from gen2d.records.axes import Array
from gen2d.records.layout import Layout
from gen2d.renderers.plan import RenderScene
from gen2d.sampling import rejection
from gen2d.sampling.sampler import Sampler

# Raw frames rendered at once, in bytes. On a CPU, larger buffers cost page faults. A GPU renders 2**27 bytes 2.3 to 3.7
# times as fast as 2**24, and 2**30 little faster (measured on an H200).
CPU_SLICE, GPU_SLICE = 2**24, 2**27
SHARD_BYTES = 2**30  # of raw frames in a shard
SHARD_VIDEOS = 1024  # largest default number of videos in a shard
# Limits of a default batch: videos, and pairs of their bodies, which take 300 bytes each.
BATCH_SIZE, PAIRS = 512, 2**20


class Lane(NamedTuple):
    """A device, and the thread that starts programs on it."""

    device: Device
    thread: ThreadPoolExecutor

    def start(self, program: Callable[..., Any], *args: Any) -> Future[Any]:
        """Start a program, called with the device and these arguments, after those started before it."""
        return self.thread.submit(program, self.device, *args)


class Rollout:
    """Compiled programs of one config on some devices.

    Devices are lanes: each runs one program at a time, and all run at once. CPU devices are lanes of the first of them,
    as jax runs programs from several threads at once on one CPU device. So an executable is loaded only once; it takes
    up to thousands of the memory maps that a process may have.
    """

    def __init__(self, config: Config, devices: Sequence[Device]) -> None:
        self.config, self.devices = config, list(devices)
        video, self.sparse = config.video, self.devices[0].platform == "cpu"
        self.layout = config.scene.contract.layout(config.scene.options)
        self.plan, self.sampler = render.plan_of(config, self.layout), Sampler(config)
        self.steps, self.quality_ranges = steps_of(config), quality.ranges(config.quality)
        self.save_at = save_at(config, self.layout)
        self.schema = VideoSchema(config, self.layout, self.plan, self.save_at, self.sampler)
        frame_bytes = video.frames * video.height * video.width * 3
        default_shard = min(SHARD_VIDEOS, power_of_two(SHARD_BYTES // frame_bytes))
        self.videos_per_shard = config.storage.videos_per_shard or default_shard
        moving = sum(run.count for run in self.layout.groups if run.kind == enums.DYNAMIC)
        pairs = moving * (self.layout.slots - moving) + moving * (moving - 1) // 2
        default_batch = min(BATCH_SIZE, power_of_two(PAIRS // max(pairs, 1)))
        # A shard size in the config must not change the videos.
        self.batch_size = config.storage.batch_size or min(default_batch, default_shard)
        slice_bytes = CPU_SLICE if self.sparse else GPU_SLICE
        rendered = self.plan.frames or config.annotations.wanted
        self.slice = divisor(self.batch_size, max(1, slice_bytes // frame_bytes)) if rendered else self.batch_size
        lanes = [self.devices[0] if self.sparse else device for device in self.devices]
        self._lanes = [Lane(device, ThreadPoolExecutor(1, "lane")) for device in lanes]
        self._draws: dict[int, BoundProgram] = {}  # by number of videos

    def start(self, split: str, numbers: np.ndarray) -> list[DeviceBatch]:
        """Start to simulate the videos of a split with these numbers [devices * batch_size]; each device's batch.

        Raises NoVideoError if no attempt at some video lies in the ranges that the config requires.
        """
        parts = list(zip(self._lanes, numbers.astype(np.uint32).reshape(len(self._lanes), -1), strict=True))
        if not self.quality_ranges:
            futures = [self._start_on(lane, split, part) for lane, part in parts]
            return [future.result() for future in futures]
        with ThreadPoolExecutor(len(parts)) as pool:  # each lane may need another number of attempts
            return list(pool.map(lambda part: self._accept_on(part[0], split, part[1]), parts))

    def _start_on(
        self, lane: Lane, split: str, numbers: np.ndarray, attempts: np.ndarray | None = None
    ) -> Future[DeviceBatch]:
        """Start to simulate videos [batch_size] with these attempts, by default the first."""
        root, row = keys_module.seed_words(self.config.seed, zlib.crc32(split.encode())), self.config.split_index(split)
        grid = self.sampler.grid_values(row, root, numbers)
        attempts = np.zeros_like(numbers) if attempts is None else attempts.astype(np.uint32)
        return lane.start(self._simulate_on, root, np.int32(row), grid, numbers, attempts)

    def _simulate_on(self, device: Device, *args: Any) -> DeviceBatch:
        """A batch, from programs that are started one after the other."""
        if self.config.matched.change:
            sampled, simulated = self.programs["members"](device, *args)
        else:
            sampled = self.programs["sample"](device, *args)
            simulated = self.programs["simulate"](device, sampled.keys, sampled.scene, sampled.state)
        states, between = simulated.trajectory.states, simulated.trajectory.between
        staged = self.programs["stage"](device, sampled.keys, sampled.scene, states, between)
        staged = staged._replace(render_scenes=render.with_pictures(staged.render_scenes, self.config))
        return device_batch(self.config, sampled, simulated, staged)

    def _accept_on(self, lane: Lane, split: str, numbers: np.ndarray) -> DeviceBatch:
        """Batch of videos that lie in the ranges that the config requires."""

        def attempt(rows: np.ndarray, attempts: np.ndarray) -> DeviceBatch:
            batch = self._start_on(lane, split, numbers[rows], attempts).result()
            if quality.VISIBILITY not in self.quality_ranges:
                return batch
            starts = range(0, self.batch_size, self.slice)  # only rendering gives the visibility
            slices = [self._draw_on(lane, batch, start, self.slice).result() for start in starts]
            visibility = np.concatenate([np.asarray(part[quality.VISIBILITY]) for part in slices])
            column = jax.device_put(visibility, lane.device)
            return batch._replace(columns=batch.columns | {quality.VISIBILITY: column})

        batch, attempts = rejection.accepted_batch(attempt, numbers, self.config.quality)
        batch.columns.pop(quality.VISIBILITY, None)  # `draw` returns it
        rejected = jax.device_put(attempts.astype(np.int32), lane.device)
        return batch._replace(columns=batch.columns | {"quality/rejected_videos": rejected})

    def draw(self, batches: Sequence[DeviceBatch], start: int, count: int) -> list[dict[str, Array]]:
        """Start to render `count` videos of each device's batch, from row `start` on.

        Returns each device's frames [count, T, H, W, 3] and annotations by stored name.
        """
        parts = zip(self._lanes, batches, strict=True)
        futures = [self._draw_on(lane, batch, start, count) for lane, batch in parts]
        return [future.result() for future in futures]

    def _draw_on(self, lane: Lane, batch: DeviceBatch, start: int, count: int) -> Future[dict[str, Array]]:
        return lane.start(self.draw_program(count), batch.render_scenes, np.int32(start))

    # ---- Programs

    def compile(self) -> None:
        """Compile the programs, at the same time, and load them on all devices."""
        programs = [*self.programs.values(), self.draw_program(self.slice)]
        with ThreadPoolExecutor(len(programs)) as pool:
            for _ in pool.map(lambda bound: [bound.program.load(lane.device) for lane in self._lanes], programs):
                pass

    @functools.cached_property
    def programs(self) -> dict[str, BoundProgram]:
        """Programs from video numbers to render scenes, by name."""
        config, size, programs = self.config, self.batch_size, {}
        numbers, grid = np.zeros(size, np.uint32), np.zeros((size, len(self.sampler.gridded)), np.float32)
        args, x64 = (np.zeros(3, np.uint32), np.int32(0), grid, numbers, numbers), config.physics.x64
        keep, sparse, physical = self.save_at, self.sparse, Layout(self.layout.groups, joints=self.layout.joints)

        def members(config: Config, layout: Layout) -> Members:
            return Members(config, layout, keep, sparse)

        def sample(config: Config, layout: Layout) -> Sampling:
            return Sampling(config)

        def simulate(config: Config, layout: Layout) -> Simulation:
            return Simulation(config, layout, keep, sparse)

        def stage(config: Config, layout: Layout) -> Staging:
            return Staging(config, layout)

        if config.matched.change:
            sections = "scene", "splits", "quality", "matched", "video", "physics"
            members_config = only_sections(config, *sections, simulated=True)
            programs["members"] = self._program(members_config, self.layout, keep, members, args, x64)
            sampled, simulated = programs["members"].results
        else:
            sample_config = only_sections(config, "scene", "splits", "quality", "matched")
            programs["sample"] = self._program(sample_config, physical, None, sample, args)
            sampled = programs["sample"].results
            args = sampled.keys, sampled.scene, sampled.state
            simulate_config = only_sections(config, "video", "physics", simulated=True)
            programs["simulate"] = self._program(simulate_config, physical, keep, simulate, args, x64)
            simulated = programs["simulate"].results
        args = sampled.keys, sampled.scene, simulated.trajectory.states, simulated.trajectory.between
        stage_config = only_sections(config, "video", "camera", "image", "look")
        programs["stage"] = self._program(stage_config, self.layout, None, stage, args)
        return programs

    def draw_program(self, count: int) -> BoundProgram:
        """Program that renders `count` videos of a batch."""
        if count not in self._draws:

            def draw(config: Config, layout: Layout) -> Callable[[RenderScene, Array], dict[str, Array]]:
                plan = render.plan_of(config, layout)

                def run(render_scenes: RenderScene, start: Array) -> dict[str, Array]:
                    part = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, count), render_scenes)
                    return render.render_frames(part, plan, config.annotations)

                return run

            config = only_sections(self.config, "video", "camera", "image", "look", "storage", pixels=True)
            staged = render.with_pictures(self.programs["stage"].results.render_scenes, self.config)
            args = staged, np.int32(0)
            self._draws[count] = self._program(config, self.layout, count, draw, args)
        return self._draws[count]

    def _program(
        self, config: Config, layout: Layout, key: Hashable, build: Build, args: tuple, x64: bool = False
    ) -> BoundProgram:
        return program_for(config, layout, key, build, args, self.devices[0], x64)

    def host_columns(self, batches: Sequence[DeviceBatch]) -> list[dict[str, np.ndarray]]:
        """Each device's columns as NumPy arrays; waits for the devices."""
        on_host = [start_transfer(batch.columns) for batch in batches]
        columns = [{name: np.asarray(array) for name, array in arrays.items()} for arrays in on_host]
        for arrays in columns:
            if "contacts/time" in arrays:  # a device may have no float64
                arrays["contacts/time"] = arrays["contacts/time"].astype(np.float64)
        return columns
