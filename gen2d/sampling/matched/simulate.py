"""Members of matched sets simulated: the original and the changed member by one compiled program."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.config.matched import INTERVENTIONS, VIOLATIONS, free_slots
from gen2d.config.options import drawn_options
from gen2d.records.axes import Array
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Trajectory
from gen2d.sampling.builder import SampledScene
from gen2d.sampling.matched.counterfactuals import changed_factors, changed_slot
from gen2d.sampling.matched.sets import SetMember, along_slots, change_codes, fields, member_of
from gen2d.sampling.matched.violations import INTERVENTION_FUNCTIONS, Intervention, SceneInstant, inside_view

# ---- Both together


class MemberVideos(NamedTuple):
    """Videos before they are rendered, and the record of their sets; videos come first."""

    drawn: dict[str, Array]
    sampled: SampledScene
    made: Trajectory
    record: dict[str, Array]


def simulate_members(
    keys: Array, numbers: Array, config: Any, layout: Layout, sample: Callable, run: Callable
) -> MemberVideos:
    """The videos with these numbers, and their sets' keys.

    `sample(key, change)` gives a video's factors and what its family makes of them (sampling.py), `run(scenes, states)`
    the trajectories. Both turns, the original's and the member's own, are of one loop and so of one program: two would
    round differently.
    """
    options, run = config.matched, jax.jit(run)  # so that it is traced once
    numbered = functools.partial(member_of, options=options, frames=config.video.frames)
    members = jax.vmap(numbered)(keys, numbers % options.members)

    def own(key: Array, member: SetMember) -> tuple[dict[str, Array], SampledScene]:
        return sample(key, functools.partial(changed_factors, member, config))

    def once(turn: Array, before: MemberVideos) -> MemberVideos:
        now = members._replace(changed=members.changed & (turn > 0))
        drawn, found = jax.vmap(own)(keys, now)
        act = functools.partial(_intervene, options=options, layout=layout)
        stored, scene, start, frame, record = jax.vmap(act)(now, found.scene, found.state, before.made.states)
        made = run(scene, start)
        ways = {"states": made.states} | ({} if made.between is None else {"between": made.between})
        joined = {name: _spliced(frame, getattr(before.made, name), way) for name, way in ways.items()}
        after = MemberVideos(drawn, found._replace(scene=stored), dataclasses.replace(made, **joined), record)
        return after._replace(record=jax.vmap(functools.partial(_record_change, config=config))(now, before, after))

    made = jax.lax.fori_loop(0, 2, once, _blank(keys, sample, run))
    kind = jnp.asarray(change_codes(options))[members.kind]
    record = {"set": numbers // options.members, "member": members.number, "kind": kind, **made.record}
    stored = {
        name: record[name.removeprefix("matched/")].astype(field.dtype) for name, field in fields(options).items()
    }
    return made._replace(record=stored)


def _blank(keys: Array, sample: Callable, run: Callable) -> MemberVideos:
    """Videos of zeros, to begin with."""

    def sampled(keys: Array) -> MemberVideos:
        drawn, found = jax.vmap(sample)(keys)
        counts = {name: jnp.zeros(len(keys), jnp.int32) for name in ("object", "partner", "onset")}
        return MemberVideos(drawn, found, run(found.scene, found.state), counts | {"size": jnp.zeros(len(keys))})

    return jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), jax.eval_shape(sampled, keys))


def _intervene(
    member: SetMember, scene: Scene, state: State, states: State, options: Any, layout: Layout
) -> tuple[Scene, Scene, State, Array, dict[str, Array]]:
    """One video's scene as stored; the scene, state and frame to simulate from; the record of the intervention."""
    free = jnp.asarray(free_slots(layout)) & scene.objects.present
    here = jax.tree.map(lambda values: values[member.frame], states)
    later = SceneInstant(scene, here, free & inside_view(here.position, layout))
    chosen, frame = Intervention(scene, state, jnp.zeros(()), jnp.int32(-1), jnp.int32(-1)), jnp.int32(0)
    for place, name in enumerate(options.change):
        if name in INTERVENTIONS:
            act = INTERVENTION_FUNCTIONS[name](
                member, later if name in VIOLATIONS else SceneInstant(scene, state, free), options, layout
            )
            on = member.changed & (member.kind == place) & (act.size > 0)
            chosen = jax.tree.map(lambda new, old, on=on: jnp.where(on, new, old), act, chosen)
            frame = jnp.where(on, member.frame, frame) if name in VIOLATIONS else frame
    stored = dataclasses.replace(chosen.scene, gravity=scene.gravity)
    record = {"object": chosen.object, "partner": chosen.partner, "size": chosen.size}
    return stored, chosen.scene, chosen.state, frame, record


def _spliced(frame: Array, before: State, after: State) -> State:
    """Videos [n, T, ...] that go on with the first frame of others at a frame [n] of their own."""

    def joined(frame: Array, old: Array, new: Array) -> Array:
        number = jnp.arange(len(old))
        late = along_slots(number >= frame, old)
        return jnp.where(late, new[jnp.maximum(number - frame, 0)], old)

    return jax.tree.map(functools.partial(jax.vmap(joined), frame), before, after)


def _record_change(member: SetMember, before: MemberVideos, after: MemberVideos, config: Any) -> dict[str, Array]:
    """The record of one video's change, also of a factor's, with the first frame that shows it."""
    one, other = before.sampled, after.sampled
    record, both = dict(after.record), one.scene.objects.present & other.scene.objects.present
    for place, name in enumerate(config.matched.change):
        if name not in INTERVENTIONS:
            on = member.changed & (member.kind == place)
            slot = changed_slot((one.scene.objects, one.state), (other.scene.objects, other.state))
            record["object"] = jnp.where(on, slot, record["object"])
            change = (after.drawn[name] - before.drawn[name]).astype(jnp.float32)
            size = (
                jnp.linalg.norm(change, axis=-1)
                if drawn_options(config.scene.contract)[name].parts
                else jnp.abs(change)
            )
            record["size"] = jnp.where(on, jnp.max(size), record["size"])
    differ = jnp.zeros(len(after.made.states.angle), bool)
    for a, b in zip(jax.tree.leaves(before.made.states), jax.tree.leaves(after.made.states), strict=True):
        differ |= ((a != b).reshape(*a.shape[:2], -1).any(axis=-1) & both).any(axis=-1)
    return record | {"onset": jnp.where(differ.any(), jnp.argmax(differ), -1).astype(jnp.int32)}
