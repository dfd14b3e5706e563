"""Simulation of matched sets: one compiled program simulates the original and the changed member."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.config.matched import INTERVENTIONS, VIOLATIONS, free_slots
from gen2d.config.options import factor_options
from gen2d.records.axes import Array, to_precision
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Trajectory
from gen2d.sampling.builder import SampledScene
from gen2d.sampling.matched.counterfactuals import change_factors, changed_slot
from gen2d.sampling.matched.sets import SetMember, along_slots, change_codes, fields, member_of
from gen2d.sampling.matched.violations import INTERVENTION_FUNCTIONS, Intervention, SceneInstant, inside_view

RECORD = {"object": "int32", "partner": "int32", "onset": "int32", "size": "float32"}  # of a change, by name


class MemberVideos(NamedTuple):
    """Simulated videos and records of their changes; arrays have the videos first."""

    factors: dict[str, Array]
    sampled: SampledScene
    trajectory: Trajectory
    record: dict[str, Array]


def simulate_members(
    keys: Array, numbers: Array, config: Any, layout: Layout, sample: Callable, run: Callable
) -> MemberVideos:
    """Videos with these numbers [n]; `keys` [n] are those of their sets.

    `sample(key, change)` returns a video's factors and its sampled scene (sampler.py), `run(scenes, states)` the
    trajectories. The original and the member are two iterations of one loop, and thus of one compiled program, because
    two programs would round differently. Whatever the precision of the simulation, videos are sampled in 32 bits.
    """
    options, run = config.matched, jax.jit(run)  # traced once
    membership = functools.partial(member_of, options=options, frames=config.video.frames)
    with jax.enable_x64(False):
        members = jax.vmap(membership)(keys, numbers % options.members)

    def sampled_member(key: Array, member: SetMember) -> tuple[dict[str, Array], SampledScene]:
        return sample(key, functools.partial(change_factors, member, config))

    def simulate_once(iteration: Array, before: MemberVideos) -> MemberVideos:
        now = members._replace(changed=members.changed & (iteration > 0))
        with jax.enable_x64(False):
            factors, sampled = jax.vmap(sampled_member)(keys, now)
        intervene = jax.vmap(functools.partial(_intervene, options=options, layout=layout))
        start = to_precision((sampled.scene, sampled.state), config.physics.precision)
        stored, scene, start, frame, record = intervene(now, *start, before.trajectory.states)
        trajectory = run(scene, start)
        names = ["states"] if trajectory.between is None else ["states", "between"]
        spliced = {name: _splice(frame, getattr(before.trajectory, name), getattr(trajectory, name)) for name in names}
        trajectory = dataclasses.replace(trajectory, **spliced)
        stored = to_precision(stored, "float32")
        after = MemberVideos(factors, sampled._replace(scene=stored), trajectory, record)
        return after._replace(record=jax.vmap(functools.partial(_record_change, config=config))(now, before, after))

    videos = jax.lax.fori_loop(0, 2, simulate_once, _zeros(keys, sample, run))
    kind = jnp.asarray(change_codes(options))[members.kind]
    record = {"set": numbers // options.members, "member": members.number, "kind": kind, **videos.record}
    stored = {
        name: record[name.removeprefix("matched/")].astype(field.dtype) for name, field in fields(options).items()
    }
    return videos._replace(record=stored)


def _zeros(keys: Array, sample: Callable, run: Callable) -> MemberVideos:
    """Zero-filled videos, the initial value of the loop."""

    def videos(keys: Array) -> MemberVideos:
        with jax.enable_x64(False):
            factors, sampled = jax.vmap(sample)(keys)
        record = {name: jnp.zeros(len(keys), dtype) for name, dtype in RECORD.items()}
        return MemberVideos(factors, sampled, run(sampled.scene, sampled.state), record)

    return jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), jax.eval_shape(videos, keys))


def _intervene(
    member: SetMember, scene: Scene, state: State, states: State, options: Any, layout: Layout
) -> tuple[Scene, Scene, State, Array, dict[str, Array]]:
    """Scene of a video as stored; scene, state and frame to simulate from; record of the intervention."""
    free = jnp.asarray(free_slots(layout)) & scene.objects.present
    onset_state = jax.tree.map(lambda values: values[member.frame], states)
    later = SceneInstant(scene, onset_state, free & inside_view(onset_state.position, layout))
    chosen, frame = Intervention(scene, state, jnp.zeros(()), jnp.int32(-1), jnp.int32(-1)), jnp.int32(0)
    for index, name in enumerate(options.change):
        if name in INTERVENTIONS:
            intervention = INTERVENTION_FUNCTIONS[name](
                member, later if name in VIOLATIONS else SceneInstant(scene, state, free), options, layout
            )
            on = member.changed & (member.kind == index) & (intervention.size > 0)
            chosen = jax.tree.map(lambda new, old, on=on: jnp.where(on, new, old), intervention, chosen)
            frame = jnp.where(on, member.frame, frame) if name in VIOLATIONS else frame
    stored = dataclasses.replace(chosen.scene, gravity=scene.gravity)
    record = {"object": chosen.object, "partner": chosen.partner, "size": chosen.size}
    return stored, chosen.scene, chosen.state, frame, record


def _splice(frame: Array, before: State, after: State) -> State:
    """Videos [n, T, ...] `before`, continued from their `frame` [n] on by those in `after` from frame 0 on."""

    def spliced(frame: Array, old: Array, new: Array) -> Array:
        number = jnp.arange(len(old))
        late = along_slots(number >= frame, old)
        return jnp.where(late, new[jnp.maximum(number - frame, 0)], old)

    return jax.tree.map(functools.partial(jax.vmap(spliced), frame), before, after)


def _record_change(member: SetMember, before: MemberVideos, after: MemberVideos, config: Any) -> dict[str, Array]:
    """Record of a video's intervention, or of its changed factor, with the first frame that differs."""
    record, specs = dict(after.record), factor_options(config.scene.contract)
    original, changed = ((video.sampled.scene.objects, video.sampled.state) for video in (before, after))
    present = original[0].present & changed[0].present
    for index, name in enumerate(config.matched.change):
        if name in INTERVENTIONS:
            continue
        applies = member.changed & (member.kind == index)
        record["object"] = jnp.where(applies, changed_slot(original, changed), record["object"])
        change = (after.factors[name] - before.factors[name]).astype(jnp.float32)
        size = jnp.linalg.norm(change, axis=-1) if specs[name].parts else jnp.abs(change)
        record["size"] = jnp.where(applies, jnp.max(size), record["size"])
    differ = jnp.zeros(len(after.trajectory.states.angle), bool)
    for a, b in zip(jax.tree.leaves(before.trajectory.states), jax.tree.leaves(after.trajectory.states), strict=True):
        differ |= ((a != b).reshape(*a.shape[:2], -1).any(axis=-1) & present).any(axis=-1)
    record |= {"onset": jnp.where(differ.any(), jnp.argmax(differ), -1)}
    return {name: jnp.asarray(record[name], dtype) for name, dtype in RECORD.items()}
