"""Programs from the numbers of a batch's videos to their render scenes: sample, simulate, stage.

Each program depends on few sections of a config, whose numbers may be parameters: another look compiles `stage` alone,
another distribution `sample` alone. The members of a matched set are sampled and simulated by one program, `members`,
because two programs would round differently.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.config import quality
from gen2d.config.config import Config
from gen2d.physics import lyapunov
from gen2d.physics.params import solver_params
from gen2d.physics.simulate import SaveAt, simulate, substeps
from gen2d.programs import render
from gen2d.records import axes
from gen2d.records.axes import Array
from gen2d.records.keys import unwrapped, wrapped
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Trajectory
from gen2d.renderers.plan import RenderScene
from gen2d.sampling import rejection
from gen2d.sampling.builder import SampledScene
from gen2d.sampling.matched import sets
from gen2d.sampling.matched import simulate as simulate_module
from gen2d.sampling.sampler import FactorChange, SampledFactors, Sampler

Columns = dict[str, Array]  # stored fields [n, ...], by name


class DeviceBatch(NamedTuple):
    """`batch_size` simulated videos on one device, ready to be rendered."""

    columns: Columns  # except rendered ones
    render_scenes: RenderScene
    placed: Array  # [n] whether all objects could be placed


class SampledBatch(NamedTuple):
    """Sampled videos of a batch."""

    keys: Array  # uint32 [n, 2]
    scene: Scene
    state: State
    columns: Columns
    placed: Array  # [n] whether all objects could be placed


class SimulatedBatch(NamedTuple):
    """Simulated videos of a batch."""

    trajectory: Trajectory
    lyapunov: Array | None  # [n] 1/s


class StagedBatch(NamedTuple):
    """Videos of a batch, ready to be rendered."""

    render_scenes: RenderScene
    columns: Columns  # colours and camera


class Sampling:
    """Sampled videos of a batch from their numbers [n]."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.sampler, self.quality_ranges = Sampler(config), quality.ranges(config.quality)

    def __call__(self, root: Array, row: Array, grid: Array, numbers: Array, attempts: Array) -> SampledBatch:
        """Videos of the split `row`; `grid` [n, G] are their `Sampler.grid_values`."""
        keys = sets.keys_of(root, numbers, self.config.matched)
        own_keys = rejection.attempt_keys(keys, attempts) if self.quality_ranges else keys
        factors, sampled = jax.vmap(self.sampler.sample, (0, None, 0))(own_keys, row, grid)
        return self.batch(keys, factors, sampled)

    def batch(self, keys: Array, factors: SampledFactors, sampled: SampledScene) -> SampledBatch:
        """The batch of sampled factors and scenes."""
        columns = axes.columns(sampled.scene)
        columns |= {f"factors/{name}": values.astype(jnp.float32) for name, values in factors.items()}
        columns |= jax.vmap(self.sampler.ood_distances)(factors)
        columns["quality/rejected_draws"] = sampled.rejected
        return SampledBatch(unwrapped(keys), sampled.scene, sampled.state, columns, sampled.fits)


class Simulation:
    """Trajectories of a batch. `sparse` selects the solver of nearby pairs, for CPUs."""

    def __init__(self, config: Config, layout: Layout, keep: SaveAt, sparse: bool) -> None:
        self.config, self.layout, self.keep, self.sparse = config, layout, keep, sparse
        self.steps = steps_of(config)

    def __call__(self, keys: Array, scene: Scene, state: State) -> SimulatedBatch:
        """Trajectories from these initial states [n, ...]."""
        return SimulatedBatch(self.trajectory(scene, state), self.exponents(keys, scene, state))

    def trajectory(self, scene: Scene, state: State) -> Trajectory:
        """Trajectories with the videos first."""
        trajectory = self._device_trajectory(*self._start(scene, state), self.keep)
        between = trajectory.between
        if between is not None:  # from [T - 1, steps, (2,) K, n] to [n, T - 1, steps, K(, 2)]
            between = jax.tree.map(lambda x: jnp.moveaxis(jnp.moveaxis(x, -1, 0), -1, 3), between)
        stored = axes.to_stored(dataclasses.replace(trajectory, between=None))
        return dataclasses.replace(stored, between=between)

    def exponents(self, keys: Array, scene: Scene, state: State) -> Array | None:
        """Lyapunov exponents [n] of the videos, in 1/s; None if the config does not enable them."""
        if not self.config.annotations.simulated.lyapunov:
            return None
        video, rerun = self.config.video, functools.partial(self._device_trajectory, keep=SaveAt())
        seconds = (video.frames - 1) / video.fps
        return lyapunov.lyapunov_exponent(wrapped(keys), *self._start(scene, state), rerun, seconds)

    def _start(self, scene: Scene, state: State) -> tuple[Scene, State]:
        """Scene and initial state in the precision of the simulation, in the device's layout."""
        scene, state = axes.to_precision((scene, state), self.config.physics.precision)
        return axes.to_device(scene), axes.to_device(state)

    def _device_trajectory(self, scene: Scene, state: State, keep: SaveAt) -> Trajectory:
        """Trajectories from these initial states, in the device's layout."""
        video, rules = self.config.video, solver_params(self.config.physics, self.config.video.fps, self.steps)
        return simulate(scene, state, self.layout, rules, video.frames, self.steps, keep, sparse=self.sparse)


class Members:
    """Sampled and simulated members of matched sets."""

    def __init__(self, config: Config, layout: Layout, keep: SaveAt, sparse: bool) -> None:
        self.config, self.layout = config, layout
        self.sampling, self.simulation = Sampling(config), Simulation(config, self.layout, keep, sparse)

    def __call__(
        self, root: Array, row: Array, grid: Array, numbers: Array, attempts: Array
    ) -> tuple[SampledBatch, SimulatedBatch]:
        """Videos with these numbers [n]; sampled in 32 bits, whatever the precision of the simulation."""
        keys = sets.keys_of(root, numbers, self.config.matched)

        def member(key: Array, change: FactorChange | None = None) -> tuple[SampledFactors, SampledScene]:
            return self.sampling.sampler.sample(key, row, change=change)

        factors, sampled, trajectory, record = simulate_module.simulate_members(
            keys, numbers, self.config, self.layout, member, self.simulation.trajectory
        )
        with jax.enable_x64(False):
            batch = self.sampling.batch(keys, factors, sampled)
        exponents = self.simulation.exponents(batch.keys, batch.scene, batch.state)
        return batch._replace(columns=batch.columns | record), SimulatedBatch(trajectory, exponents)


class Staging:
    """Render scenes of a batch."""

    def __init__(self, config: Config, layout: Layout) -> None:
        self.config, self.plan = config, render.plan_of(config, layout)

    def __call__(self, keys: Array, scene: Scene, states: State, between: State | None) -> StagedBatch:
        """Render scenes of these videos [n, ...]."""

        def build(
            key: Array, scene: Scene, states: State, between: State | None
        ) -> tuple[RenderScene, dict[str, Array]]:
            render_scene = render.render_scene(key, self.config, self.plan, scene, states, between=between)
            columns = {"objects/color": render.painted_colors(render_scene.paint, scene)}
            columns |= render.material_columns(render_scene.paint, scene)
            columns |= render.look_columns(render_scene.paint, self.config)
            columns |= render.sensor_columns(render_scene.sensor)
            return render_scene, columns | render.occluder_columns(render_scene.occluders, self.plan)

        render_scenes, columns = jax.vmap(build)(wrapped(keys), scene, states, between)
        return StagedBatch(render_scenes, columns | render.camera_columns(render_scenes.instants.view))


def device_batch(config: Config, sampled: SampledBatch, simulated: SimulatedBatch, staged: StagedBatch) -> DeviceBatch:
    """The stored fields and render scenes of a batch."""
    columns = sampled.columns | axes.columns(dataclasses.replace(simulated.trajectory, between=None)) | staged.columns
    if simulated.lyapunov is not None:
        columns["quality/lyapunov"] = simulated.lyapunov
    omitted = sets.omitted_fields(config.matched)
    kept = {name: values for name, values in columns.items() if name not in omitted}
    return DeviceBatch(kept, staged.render_scenes, sampled.placed)


def steps_of(config: Config) -> int:
    """Number of steps of a frame."""
    return substeps(config.video.fps, config.physics.substeps, config.physics.max_step)


def save_at(config: Config, layout: Layout) -> SaveAt:
    """What to record of a simulation besides its states."""
    rows = config.annotations.simulated.contacts * math.ceil(config.video.frames / 16) * layout.slots
    return SaveAt(rows, config.annotations.simulated.energy, between=config.image.exposure > 0)
