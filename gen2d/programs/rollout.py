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
    stages: RenderScene
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
        self.sampler, self.wanted = Sampler(config), quality.ranges(config.quality)
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
        self._draws: dict[int, Any] = {}  # by number of videos
        self._drawn: set[int] = set()  # those numbers whose program is compiled
        program = self._simulated_batch
        if len(self.devices) > 1:
            specs = PartitionSpec(), PartitionSpec(), VIDEOS, VIDEOS, VIDEOS
            program = jax.shard_map(program, mesh=self.mesh, in_specs=specs, out_specs=VIDEOS, check_vma=False)
        self._simulate: Any = jax.jit(program)

    def start(self, split: str, numbers: np.ndarray) -> DeviceBatch:
        """Start to simulate the videos of a split with these numbers [devices * batch_size].

        Raises NoVideoError if no attempt at some video lies in the ranges that the config requires.
        """
        root, row = keys_module.seed_words(self.config.seed, zlib.crc32(split.encode())), self.config.row(split)
        numbers = numbers.astype(np.uint32)
        given = self.sampler.combination(row, root, numbers)

        def make(rows: np.ndarray, attempts: np.ndarray) -> DeviceBatch:
            of_videos = given[rows], numbers[rows], attempts.astype(np.uint32)
            return self._simulate(root, np.int32(row), *self._shares(of_videos))

        if not self.wanted:
            return make(np.arange(len(numbers)), np.zeros(len(numbers)))
        if quality.VISIBILITY not in self.wanted:
            batch, attempts = rejection.accepted_batch(make, numbers, self.config.quality)
        else:
            batch, attempts = rejection.accepted_batch(lambda *of: self._seen(make(*of)), numbers, self.config.quality)
            del batch.columns[quality.VISIBILITY]  # `draw` returns it
        return batch._replace(
            columns=batch.columns | {"quality/rejected_videos": self._shares(attempts.astype(np.int32))}
        )

    def _shares(self, arrays: Any) -> Any:
        """Arrays [n, ...], sharded over the devices."""
        return jax.device_put(arrays, NamedSharding(self.mesh, VIDEOS))

    def _seen(self, batch: DeviceBatch) -> DeviceBatch:
        """The batch with its visibility, which is only known once it is rendered."""
        slices = [self.draw(batch, start, self.slice) for start in range(0, self.batch_size, self.slice)]
        of_devices = zip(*slices, strict=True)
        visibility = np.concatenate([np.asarray(part[quality.VISIBILITY]) for parts in of_devices for part in parts])
        return batch._replace(columns=batch.columns | {quality.VISIBILITY: self._shares(visibility)})

    def draw(self, batch: DeviceBatch, start: int, count: int) -> list[dict[str, Array]]:
        """Start to render `count` videos of each device, from row `start` on.

        Returns each device's frames [count, T, H, W, 3] and annotations by stored name. Each device runs a separate
        program, because a program for several devices would round differently.
        """
        stages_of = [
            jax.tree.map(lambda array, d=d: _pieces(array)[d].data, batch.stages) for d in range(len(self.devices))
        ]
        draw = functools.partial(self._draw(count), start=np.int32(start))
        if count in self._drawn:
            return [draw(stages) for stages in stages_of]
        self._drawn.add(count)
        with ThreadPoolExecutor(len(stages_of)) as pool:  # compiles for all devices in parallel
            return list(pool.map(draw, stages_of))

    def close(self) -> None:
        """Free the compiled programs, which jax would keep; each takes up to thousands of memory maps."""
        for program in (self._simulate, *self._draws.values()):
            program.clear_cache()

    def lowered(self) -> dict[str, str]:
        """Text of each program, lowered for one device."""
        numbers, scalar = jax.ShapeDtypeStruct((self.batch_size,), np.uint32), jax.ShapeDtypeStruct((), np.int32)
        given = jax.ShapeDtypeStruct((self.batch_size, len(self.sampler.gridded)), np.float32)
        simulate = self._simulate if len(self.devices) == 1 else jax.jit(self._simulated_batch)
        with jax.default_device(self.devices[0]):
            simulated = simulate.lower(jax.ShapeDtypeStruct((3,), np.uint32), scalar, given, numbers, numbers)
            drawn = self._draw(self.slice).lower(simulated.out_info.stages, start=scalar)
        return {"simulate": simulated.as_text(), "draw": drawn.as_text()}

    def _draw(self, count: int) -> Any:
        def render_slice(stages: RenderScene, start: Array) -> dict[str, Array]:
            part = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, count), stages)
            return render.render_frames(part, self.plan, self.config.annotations)

        if count not in self._draws:
            self._draws[count] = jax.jit(render_slice)
        return self._draws[count]

    def _simulated_batch(self, root: Array, row: Array, given: Array, numbers: Array, attempts: Array) -> DeviceBatch:
        """One device's part of a batch: everything but the frames, from video numbers."""
        config = self.config
        keys, matched_columns = sets.keys_of(root, numbers, config.matched), {}
        if config.matched.change:

            def member(key: Array, change: FactorChange | None = None) -> tuple[dict[str, Array], SampledScene]:
                return self.sampler.sampled(key, row, change=change)

            factors, sampled, trajectory, matched_columns = simulate_module.simulate_members(
                keys, numbers, config, self.layout, member, self._run
            )
        else:
            own_keys = rejection.attempt_keys(keys, attempts) if self.wanted else keys
            factors, sampled = jax.vmap(self.sampler.sampled, (0, None, 0))(own_keys, row, given)
            trajectory = self._run(sampled.scene, sampled.state)
        scene, between, trajectory = sampled.scene, trajectory.between, dataclasses.replace(trajectory, between=None)

        def staged(key: Array, scene: Scene, states: State, between: State | None) -> tuple[RenderScene, Array]:
            stage = render.render_scene(key, config, self.plan, scene, states, between=between)
            return stage, render.painted_colors(stage.paint, scene)

        stages, colors = jax.vmap(staged)(keys, scene, trajectory.states, between)
        columns = axes_module.columns(scene) | axes_module.columns(trajectory)
        columns["objects/color"] = colors
        columns |= render.camera_columns(stages.instants.view)
        columns |= {f"factors/{name}": values.astype(jnp.float32) for name, values in factors.items()}
        columns |= jax.vmap(self.sampler.outside)(factors)
        columns["quality/rejected_draws"] = sampled.rejected
        if config.annotations.simulated.lyapunov:
            columns["quality/lyapunov"] = self._growth(keys, sampled)
        columns = {name: values for name, values in columns.items() if name not in sets.omitted_fields(config.matched)}
        return DeviceBatch(columns | matched_columns, stages, sampled.fits)

    def _simulated(self, scene: Scene, state: State, keep: SaveAt) -> Trajectory:
        """Trajectories from these initial states, in the device's layout."""
        config, sparse = self.config, self.devices[0].platform == "cpu"
        rules = solver_params(config.physics, config.video.fps, self.steps)
        return simulate(scene, state, self.layout, rules, config.video.frames, self.steps, keep, sparse=sparse)

    def _run(self, scene: Scene, state: State) -> Trajectory:
        """Trajectories from these initial states, with the videos first."""
        trajectory = self._simulated(axes_module.to_device(scene), axes_module.to_device(state), self.save_at)
        between = None if trajectory.between is None else _videos_first(trajectory.between)
        return dataclasses.replace(
            axes_module.to_stored(dataclasses.replace(trajectory, between=None)), between=between
        )

    def _growth(self, keys: Array, own: SampledScene) -> Array:
        rerun = functools.partial(self._simulated, keep=SaveAt())
        start = axes_module.to_device(own.scene), axes_module.to_device(own.state)
        return lyapunov.lyapunov_exponent(keys, *start, rerun, float(self.schema.time[-1]))

    def host_columns(self, batch: DeviceBatch) -> list[dict[str, np.ndarray]]:
        """Each device's columns as NumPy arrays; waits for the devices."""
        pieces = {name: per_device(array) for name, array in batch.columns.items()}
        if "contacts/time" in pieces:  # a device may have no float64
            pieces["contacts/time"] = [array.astype(np.float64) for array in pieces["contacts/time"]]
        return [{name: arrays[d] for name, arrays in pieces.items()} for d in range(len(self.devices))]


def _videos_first(between: State) -> State:
    """States [T - 1, steps, (2,) K, n] as [n, T - 1, steps, K(, 2)]."""
    return jax.tree.map(lambda x: jnp.moveaxis(jnp.moveaxis(x, -1, 0), -1, 3), between)


def _pieces(array: Array) -> list[Any]:
    return sorted(array.addressable_shards, key=lambda piece: piece.index[0].start or 0)


def per_device(array: Array) -> list[np.ndarray]:
    """Each device's part of an array, as NumPy arrays."""
    return [np.asarray(piece.data) for piece in _pieces(array)]


def save_at(config: Config, layout: layout_module.Layout) -> SaveAt:
    """What to record of a simulation besides its states."""
    rows = config.annotations.simulated.contacts * math.ceil(config.video.frames / 16) * layout.slots
    return SaveAt(rows, config.annotations.simulated.energy, between=config.image.exposure > 0)
