"""Compiled programs of a config: video numbers in, ground truth and frames out, in batches of a fixed size.

There are two programs. `simulate` samples and simulates `batch_size` videos on every device. `draw` renders slices of
them, small enough that the frames stay in the cache until they are compressed. `batch_size` comes from the config, not
from the machine: more devices run more batches, not larger ones. Video i is always in row i % batch_size of the same
program, so its bits do not depend on how many videos are generated, or where.
"""

import dataclasses
import functools
import math
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from gen2d.config import quality
from gen2d.config.config import Config
from gen2d.core import enums
from gen2d.physics import lyapunov
from gen2d.physics.params import solver_params
from gen2d.physics.simulate import SaveAt, simulate, substeps
from gen2d.programs import render
from gen2d.programs.schema import VideoSchema
from gen2d.records import axes as axes_module
from gen2d.records import keys as keys_module
from gen2d.records import layout as layout_module
from gen2d.records.axes import Array
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Trajectory
from gen2d.renderers.plan import RenderScene
from gen2d.sampling import rejection
from gen2d.sampling.builder import SampledScene
from gen2d.sampling.matched import sets
from gen2d.sampling.matched import simulate as simulate_module
from gen2d.sampling.sampler import FactorChange, Sampler

SLICE_BYTES = 16 * 2**20  # of raw frames rendered at once; larger buffers cost page faults
SHARD_BYTES = 2**30  # of raw frames in a shard
SHARD_VIDEOS = 1024  # largest default number of videos in a shard
# Limits of a default batch: videos, and pairs of their bodies, which take 300 bytes each.
BATCH_SIZE, PAIRS = 512, 2**20
VIDEOS = PartitionSpec("videos")


class DeviceBatch(NamedTuple):
    """`batch_size` simulated videos on each device, ready to be rendered."""

    columns: dict[str, Array]  # stored fields [n, ...] except rendered ones
    render_scenes: RenderScene
    placed: Array  # [n] whether all objects could be placed


def _power_of_two(limit: int) -> int:
    return 1 << max(0, limit.bit_length() - 1)


def divisor(number: int, limit: int) -> int:
    """Largest divisor of a number that does not exceed the limit."""
    return next(d for d in range(min(number, limit), 0, -1) if number % d == 0)


class Rollout:
    """Compiled programs of one config on some devices."""

    def __init__(self, config: Config, devices: Sequence[Any]) -> None:
        self.config, self.devices = config, list(devices)
        video = config.video
        self.layout = config.scene.contract.layout(config.scene.options)
        self.sampler, self.quality_ranges = Sampler(config), quality.ranges(config.quality)
        self.plan = render.plan_of(config, self.layout)
        self.steps = substeps(video.fps, config.physics.substeps, config.physics.max_step)
        self.save_at = save_at(config, self.layout)
        self.schema = VideoSchema(config, self.layout, self.plan, self.save_at, self.sampler)
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
        self._draw_programs: dict[int, Any] = {}  # by number of videos
        self._compiled_draws: set[int] = set()  # keys of `_draw_programs` whose program is compiled
        program = self._simulate_batch
        if len(self.devices) > 1:
            specs = PartitionSpec(), PartitionSpec(), VIDEOS, VIDEOS, VIDEOS
            program = jax.shard_map(program, mesh=self.mesh, in_specs=specs, out_specs=VIDEOS, check_vma=False)
        self._simulate: Any = jax.jit(program)

    def start(self, split: str, numbers: np.ndarray) -> DeviceBatch:
        """Start to simulate the videos of a split with these numbers [devices * batch_size].

        Raises NoVideoError if no attempt at some video lies in the ranges that the config requires.
        """
        root, row = keys_module.seed_words(self.config.seed, zlib.crc32(split.encode())), self.config.split_index(split)
        numbers = numbers.astype(np.uint32)
        grid = self.sampler.grid_values(row, root, numbers)

        def simulate_rows(rows: np.ndarray, attempts: np.ndarray) -> DeviceBatch:
            sharded = self._shard_over_devices((grid[rows], numbers[rows], attempts.astype(np.uint32)))
            batch = self._simulate(root, np.int32(row), *sharded)
            return self._with_visibility(batch) if quality.VISIBILITY in self.quality_ranges else batch

        if not self.quality_ranges:
            return simulate_rows(np.arange(len(numbers)), np.zeros(len(numbers)))
        batch, attempts = rejection.accepted_batch(simulate_rows, numbers, self.config.quality)
        batch.columns.pop(quality.VISIBILITY, None)  # `draw` returns it
        rejected = self._shard_over_devices(attempts.astype(np.int32))
        return batch._replace(columns=batch.columns | {"quality/rejected_videos": rejected})

    def _shard_over_devices(self, arrays: Any) -> Any:
        """Arrays [n, ...], sharded over the devices."""
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
        draw = functools.partial(self._draw_program(count), start=np.int32(start))
        if count in self._compiled_draws:
            return [draw(scenes) for scenes in scenes_by_device]
        self._compiled_draws.add(count)
        with ThreadPoolExecutor(len(scenes_by_device)) as pool:  # compiles for all devices in parallel
            return list(pool.map(draw, scenes_by_device))

    def close(self) -> None:
        """Free the compiled programs, which jax would keep; each takes up to thousands of memory maps."""
        for program in (self._simulate, *self._draw_programs.values()):
            program.clear_cache()

    def lowered(self) -> dict[str, str]:
        """Text of each program, lowered for one device."""
        numbers, scalar = jax.ShapeDtypeStruct((self.batch_size,), np.uint32), jax.ShapeDtypeStruct((), np.int32)
        grid = jax.ShapeDtypeStruct((self.batch_size, len(self.sampler.gridded)), np.float32)
        simulate = self._simulate if len(self.devices) == 1 else jax.jit(self._simulate_batch)
        with jax.default_device(self.devices[0]):
            simulation = simulate.lower(jax.ShapeDtypeStruct((3,), np.uint32), scalar, grid, numbers, numbers)
            rendering = self._draw_program(self.slice).lower(simulation.out_info.render_scenes, start=scalar)
        return {"simulate": simulation.as_text(), "draw": rendering.as_text()}

    def _draw_program(self, count: int) -> Any:
        def render_slice(render_scenes: RenderScene, start: Array) -> dict[str, Array]:
            part = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, count), render_scenes)
            return render.render_frames(part, self.plan, self.config.annotations)

        if count not in self._draw_programs:
            self._draw_programs[count] = jax.jit(render_slice)
        return self._draw_programs[count]

    def _simulate_batch(self, root: Array, row: Array, grid: Array, numbers: Array, attempts: Array) -> DeviceBatch:
        """One device's part of a batch: everything but the frames, from video numbers."""
        config = self.config
        keys, matched_columns = sets.keys_of(root, numbers, config.matched), {}
        if config.matched.change:

            def member(key: Array, change: FactorChange | None = None) -> tuple[dict[str, Array], SampledScene]:
                return self.sampler.sample(key, row, change=change)

            factors, sampled, trajectory, matched_columns = simulate_module.simulate_members(
                keys, numbers, config, self.layout, member, self._trajectory
            )
        else:
            own_keys = rejection.attempt_keys(keys, attempts) if self.quality_ranges else keys
            factors, sampled = jax.vmap(self.sampler.sample, (0, None, 0))(own_keys, row, grid)
            trajectory = self._trajectory(sampled.scene, sampled.state)
        scene, between, trajectory = sampled.scene, trajectory.between, dataclasses.replace(trajectory, between=None)

        def build(key: Array, scene: Scene, states: State, between: State | None) -> tuple[RenderScene, Array]:
            render_scene = render.render_scene(key, config, self.plan, scene, states, between=between)
            return render_scene, render.painted_colors(render_scene.paint, scene)

        render_scenes, colors = jax.vmap(build)(keys, scene, trajectory.states, between)
        columns = axes_module.columns(scene) | axes_module.columns(trajectory)
        columns["objects/color"] = colors
        columns |= render.camera_columns(render_scenes.instants.view)
        columns |= {f"factors/{name}": values.astype(jnp.float32) for name, values in factors.items()}
        columns |= jax.vmap(self.sampler.ood_distances)(factors)
        columns["quality/rejected_draws"] = sampled.rejected
        if config.annotations.simulated.lyapunov:
            columns["quality/lyapunov"] = self._lyapunov(keys, sampled)
        columns = {name: values for name, values in columns.items() if name not in sets.omitted_fields(config.matched)}
        return DeviceBatch(columns | matched_columns, render_scenes, sampled.fits)

    def _device_trajectory(self, scene: Scene, state: State, keep: SaveAt) -> Trajectory:
        """Trajectories from these initial states, in the device's layout."""
        config, sparse = self.config, self.devices[0].platform == "cpu"
        rules = solver_params(config.physics, config.video.fps, self.steps)
        return simulate(scene, state, self.layout, rules, config.video.frames, self.steps, keep, sparse=sparse)

    def _trajectory(self, scene: Scene, state: State) -> Trajectory:
        """Trajectories from these initial states, with the videos first."""
        trajectory = self._device_trajectory(axes_module.to_device(scene), axes_module.to_device(state), self.save_at)
        between = trajectory.between
        if between is not None:  # from [T - 1, steps, (2,) K, n] to [n, T - 1, steps, K(, 2)]
            between = jax.tree.map(lambda x: jnp.moveaxis(jnp.moveaxis(x, -1, 0), -1, 3), between)
        stored = axes_module.to_stored(dataclasses.replace(trajectory, between=None))
        return dataclasses.replace(stored, between=between)

    def _lyapunov(self, keys: Array, sampled: SampledScene) -> Array:
        rerun = functools.partial(self._device_trajectory, keep=SaveAt())
        start = axes_module.to_device(sampled.scene), axes_module.to_device(sampled.state)
        return lyapunov.lyapunov_exponent(keys, *start, rerun, float(self.schema.time[-1]))

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


def save_at(config: Config, layout: layout_module.Layout) -> SaveAt:
    """What to record of a simulation besides its states."""
    rows = config.annotations.simulated.contacts * math.ceil(config.video.frames / 16) * layout.slots
    return SaveAt(rows, config.annotations.simulated.energy, between=config.image.exposure > 0)
