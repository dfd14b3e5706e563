"""The device's side of generation: video numbers in, ground truth and frames out, a fixed number of videos at a time.

Two programs. `simulate` samples and simulates `batch_size` videos on every device; `draw` renders slices of them, small
enough for its frames to stay in the cache until they are compressed. `batch_size` comes from the config, never from the
machine, so more devices mean more batches, not wider ones. Video i is always in row i % batch_size of the same program:
its bits do not depend on how many videos are made, or where.
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

SLICE_BYTES = 16 * 2**20  # of raw frames drawn at once; larger buffers cost page faults
SHARD_BYTES = 2**30  # of raw frames in a shard
SHARD_VIDEOS = 1024  # at most, unless the config says otherwise
BATCH_SIZE, PAIRS = 512, 2**20  # videos simulated at once, and pairs that can meet in all of them; 300 bytes for each
VIDEOS = PartitionSpec("videos")


class DeviceBatch(NamedTuple):
    """`batch_size` simulated videos on each device, ready to be drawn."""

    columns: dict[str, Array]  # stored fields but for those that are drawn, [n, ...]
    stages: RenderScene
    placed: Array  # [n] whether the sampler found a scene


def _power_of_two(limit: int) -> int:
    return 1 << max(0, limit.bit_length() - 1)


def divisor(number: int, limit: int) -> int:
    """The largest divisor of a number up to a limit."""
    return next(d for d in range(min(number, limit), 0, -1) if number % d == 0)


class Rollout:
    """The compiled programs of one config on some devices."""

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
        auto = min(SHARD_VIDEOS, _power_of_two(SHARD_BYTES // frame_bytes))
        self.videos_per_shard = config.storage.videos_per_shard or auto
        moving = sum(run.count for run in self.layout.runs if run.kind == enums.DYNAMIC)
        rows = moving * (self.layout.slots - moving) + moving * (moving - 1) // 2
        together = min(BATCH_SIZE, _power_of_two(PAIRS // max(rows, 1)))
        # The shard size must not change a video.
        self.batch_size = config.storage.batch_size or min(together, auto)
        self.slice = divisor(self.batch_size, max(1, SLICE_BYTES // frame_bytes))
        self.mesh = Mesh(np.array(self.devices), ("videos",))
        self._draws: dict[int, Any] = {}  # by how many videos are drawn together
        self._drawn: set[int] = set()  # those that have run, and so are compiled
        of_each = (
            self._simulated_batch
            if len(self.devices) == 1
            else self._shared(self._simulated_batch, (*[PartitionSpec()] * 2, *[VIDEOS] * 3))
        )
        self._simulate: Any = jax.jit(of_each)

    def _shared(self, function: Any, specs: tuple) -> Any:
        return jax.shard_map(function, mesh=self.mesh, in_specs=specs, out_specs=VIDEOS, check_vma=False)

    def start(self, split: str, numbers: np.ndarray) -> DeviceBatch:
        """The batch of the videos of a split with these numbers [devices * batch_size] uint32, being simulated."""
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
            del batch.columns[quality.VISIBILITY]  # it comes with the pictures
        return batch._replace(
            columns=batch.columns | {"quality/rejected_videos": self._shares(attempts.astype(np.int32))}
        )

    def _shares(self, arrays: Any) -> Any:
        """Arrays over videos, each device with its part."""
        return jax.device_put(arrays, NamedSharding(self.mesh, VIDEOS))

    def _seen(self, batch: DeviceBatch) -> DeviceBatch:
        """The batch with what is known of its visibility when it is drawn."""
        drawn = [self.draw(batch, start, self.slice) for start in range(0, self.batch_size, self.slice)]
        of_devices = zip(*drawn, strict=True)
        seen = np.concatenate([np.asarray(part[quality.VISIBILITY]) for parts in of_devices for part in parts])
        return batch._replace(columns=batch.columns | {quality.VISIBILITY: self._shares(seen)})

    def draw(self, batch: DeviceBatch, start: int, count: int) -> list[dict[str, Array]]:
        """For each device the frames [count, T, H, W, 3] and annotations of `count` of its videos, from row `start` on,
        by their stored names, being rendered.

        Each device runs a program of its own: compiled for several at once, another rounding would differ.
        """
        own = [jax.tree.map(lambda array, d=d: _pieces(array)[d].data, batch.stages) for d in range(len(self.devices))]
        draw = functools.partial(self._draw(count), start=np.int32(start))
        if count in self._drawn:
            return [draw(stages) for stages in own]
        self._drawn.add(count)
        with ThreadPoolExecutor(len(own)) as pool:  # compiles for all devices at once
            return list(pool.map(draw, own))

    def close(self) -> None:
        """Frees the compiled programs, which jax would keep, thousands of memory maps each."""
        for program in (self._simulate, *self._draws.values()):
            program.clear_cache()

    def lowered(self) -> dict[str, str]:
        """The text of the programs, each for one device, whatever their number."""
        numbers, word = jax.ShapeDtypeStruct((self.batch_size,), np.uint32), jax.ShapeDtypeStruct((), np.int32)
        given = jax.ShapeDtypeStruct((self.batch_size, len(self.sampler.gridded)), np.float32)
        simulate = self._simulate if len(self.devices) == 1 else jax.jit(self._simulated_batch)
        with jax.default_device(self.devices[0]):
            made = simulate.lower(jax.ShapeDtypeStruct((3,), np.uint32), word, given, numbers, numbers)
            drawn = self._draw(self.slice).lower(made.out_info.stages, start=word)
        return {"simulate": made.as_text(), "draw": drawn.as_text()}

    def _draw(self, count: int) -> Any:
        def drawn(stages: RenderScene, start: Array) -> dict[str, Array]:
            cut = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, count), stages)
            return render.render_frames(cut, self.plan, self.config.annotations)

        if count not in self._draws:
            self._draws[count] = jax.jit(drawn)
        return self._draws[count]

    def _simulated_batch(self, root: Array, row: Array, given: Array, numbers: Array, attempts: Array) -> DeviceBatch:
        """One device's share: from numbers to everything but the frames."""
        config = self.config
        keys, told = sets.keys_of(root, numbers, config.matched), {}
        if config.matched.change:

            def member(key: Array, change: FactorChange | None = None) -> tuple[dict[str, Array], SampledScene]:
                return self.sampler.sampled(key, row, change=change)

            drawn, own, made, told = simulate_module.simulate_members(
                keys, numbers, config, self.layout, member, self._run
            )
        else:
            own_keys = rejection.attempt_keys(keys, attempts) if self.wanted else keys
            drawn, own = jax.vmap(self.sampler.sampled, (0, None, 0))(own_keys, row, given)
            made = self._run(own.scene, own.state)
        scene, between, made = own.scene, made.between, dataclasses.replace(made, between=None)

        def staged(key: Array, scene: Scene, states: State, between: State | None) -> tuple[RenderScene, Array]:
            stage = render.render_scene(key, config, self.plan, scene, states, between=between)
            return stage, render.painted_colors(stage.paint, scene)

        stages, colors = jax.vmap(staged)(keys, scene, made.states, between)
        columns = axes_module.columns(scene) | axes_module.columns(made)
        columns["objects/color"] = colors
        columns |= render.camera_columns(stages.instants.view)
        columns |= {f"factors/{name}": values.astype(jnp.float32) for name, values in drawn.items()}
        columns |= jax.vmap(self.sampler.outside)(drawn)
        columns["quality/rejected_draws"] = own.rejected
        if config.annotations.simulated.lyapunov:
            columns["quality/lyapunov"] = self._growth(keys, own)
        columns = {name: values for name, values in columns.items() if name not in sets.omitted_fields(config.matched)}
        return DeviceBatch(columns | told, stages, own.fits)

    def _simulated(self, scene: Scene, state: State, keep: SaveAt) -> Trajectory:
        """What becomes of these starts, in the device's layout."""
        config, sparse = self.config, self.devices[0].platform == "cpu"
        rules = solver_params(config.physics, config.video.fps, self.steps)
        return simulate(scene, state, self.layout, rules, config.video.frames, self.steps, keep, sparse=sparse)

    def _run(self, scene: Scene, state: State) -> Trajectory:
        """What becomes of these starts; videos first."""
        made = self._simulated(axes_module.to_device(scene), axes_module.to_device(state), self.save_at)
        between = None if made.between is None else _videos_first(made.between)
        return dataclasses.replace(axes_module.to_stored(dataclasses.replace(made, between=None)), between=between)

    def _growth(self, keys: Array, own: SampledScene) -> Array:
        again = functools.partial(self._simulated, keep=SaveAt())
        starts = axes_module.to_device(own.scene), axes_module.to_device(own.state)
        return lyapunov.lyapunov_exponent(keys, *starts, again, float(self.schema.time[-1]))

    def host_columns(self, batch: DeviceBatch) -> list[dict[str, np.ndarray]]:
        """For each device its columns as NumPy arrays; waits until they are there."""
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
    """Each device's part of an array."""
    return [np.asarray(piece.data) for piece in _pieces(array)]


def save_at(config: Config, layout: layout_module.Layout) -> SaveAt:
    """What is kept of a simulation beyond its states."""
    rows = config.annotations.simulated.contacts * math.ceil(config.video.frames / 16) * layout.slots
    return SaveAt(rows, config.annotations.simulated.energy, between=config.image.exposure > 0)
