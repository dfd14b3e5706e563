"""Simulation of a batch of videos from their numbers: everything but the frames."""

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
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Trajectory
from gen2d.renderers.plan import RenderScene
from gen2d.sampling import rejection
from gen2d.sampling.builder import SampledScene
from gen2d.sampling.matched import sets
from gen2d.sampling.matched import simulate as simulate_module
from gen2d.sampling.sampler import FactorChange, Sampler


class DeviceBatch(NamedTuple):
    """`batch_size` simulated videos on each device, ready to be rendered."""

    columns: dict[str, Array]  # stored fields [n, ...] except rendered ones
    render_scenes: RenderScene
    placed: Array  # [n] whether all objects could be placed


class BatchSimulation:
    """Sampling, simulation and render scenes of a config's videos; numbers of the config may be parameters.

    `sparse` selects the solver of nearby pairs, for CPUs.
    """

    def __init__(self, config: Config, sparse: bool) -> None:
        self.config, self.sparse = config, sparse
        self.layout = config.scene.contract.layout(config.scene.options)
        self.sampler, self.quality_ranges = Sampler(config), quality.ranges(config.quality)
        self.plan = render.plan_of(config, self.layout)
        self.steps = substeps(config.video.fps, config.physics.substeps, config.physics.max_step)
        self.save_at = save_at(config, self.layout)

    def __call__(self, root: Array, row: Array, grid: Array, numbers: Array, attempts: Array) -> DeviceBatch:
        """One device's part of a batch, from video numbers [batch_size]."""
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
        columns = axes.columns(scene) | axes.columns(trajectory)
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
        video, rules = self.config.video, solver_params(self.config.physics, self.config.video.fps, self.steps)
        return simulate(scene, state, self.layout, rules, video.frames, self.steps, keep, sparse=self.sparse)

    def _trajectory(self, scene: Scene, state: State) -> Trajectory:
        """Trajectories from these initial states, with the videos first."""
        trajectory = self._device_trajectory(axes.to_device(scene), axes.to_device(state), self.save_at)
        between = trajectory.between
        if between is not None:  # from [T - 1, steps, (2,) K, n] to [n, T - 1, steps, K(, 2)]
            between = jax.tree.map(lambda x: jnp.moveaxis(jnp.moveaxis(x, -1, 0), -1, 3), between)
        stored = axes.to_stored(dataclasses.replace(trajectory, between=None))
        return dataclasses.replace(stored, between=between)

    def _lyapunov(self, keys: Array, sampled: SampledScene) -> Array:
        rerun = functools.partial(self._device_trajectory, keep=SaveAt())
        start = axes.to_device(sampled.scene), axes.to_device(sampled.state)
        video = self.config.video
        return lyapunov.lyapunov_exponent(keys, *start, rerun, (video.frames - 1) / video.fps)


def save_at(config: Config, layout: Layout) -> SaveAt:
    """What to record of a simulation besides its states."""
    rows = config.annotations.simulated.contacts * math.ceil(config.video.frames / 16) * layout.slots
    return SaveAt(rows, config.annotations.simulated.energy, between=config.image.exposure > 0)
