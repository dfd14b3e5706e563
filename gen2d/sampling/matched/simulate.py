"""Matched sets: videos that share a scene and differ in one thing, and what that is.

Video i is member i % members of set i // members. All members have the set's key, so the same factors, places, look,
camera and noise; member 0 is the original. The others are counterfactuals (an object is gone, or a factor is another
one from the start) or violations (something impossible happens on the way). Every video is simulated twice, by one
loop: as the original, and as itself from where it is changed on. What comes before is the original's to the bit, and so
is all that the change does not reach.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.config.matched import INTERVENTIONS, VIOLATIONS, untied
from gen2d.config.options import drawn_options
from gen2d.records.axes import Array
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Trajectory
from gen2d.sampling.builder import Sampled
from gen2d.sampling.matched.counterfactuals import _other_factors, _other_slot
from gen2d.sampling.matched.sets import Member, _along, _codes, _member, fields
from gen2d.sampling.matched.violations import ACTS, Act, Moment, _inside

# ---- Both together


class Videos(NamedTuple):
    """Some videos before they are drawn, and what is told of their sets; videos come first."""

    drawn: dict[str, Array]
    sampled: Sampled
    made: Trajectory
    told: dict[str, Array]


def simulated(keys: Array, numbers: Array, config: Any, layout: Layout, sample: Callable, run: Callable) -> Videos:
    """The videos with these numbers, and their sets' keys.

    `sample(key, change)` gives a video's factors and what its family makes of them (sampling.py), `run(scenes, states)`
    the trajectories. Both turns, the original's and the member's own, are of one loop and so of one program: two would
    round differently.
    """
    options, run = config.matched, jax.jit(run)  # so that it is traced once
    member_of = functools.partial(_member, options=options, frames=config.video.frames)
    members = jax.vmap(member_of)(keys, numbers % options.members)

    def own(key: Array, member: Member) -> tuple[dict[str, Array], Sampled]:
        return sample(key, functools.partial(_other_factors, member, config))

    def once(turn: Array, before: Videos) -> Videos:
        now = members._replace(changed=members.changed & (turn > 0))
        drawn, found = jax.vmap(own)(keys, now)
        act = functools.partial(_acted, options=options, layout=layout)
        stored, scene, start, frame, told = jax.vmap(act)(now, found.scene, found.state, before.made.states)
        made = run(scene, start)
        ways = {"states": made.states} | ({} if made.between is None else {"between": made.between})
        joined = {name: _joined(frame, getattr(before.made, name), way) for name, way in ways.items()}
        after = Videos(drawn, found._replace(scene=stored), dataclasses.replace(made, **joined), told)
        return after._replace(told=jax.vmap(functools.partial(_told, config=config))(now, before, after))

    made = jax.lax.fori_loop(0, 2, once, _blank(keys, sample, run))
    kind = jnp.asarray(_codes(options))[members.kind]
    told = {"set": numbers // options.members, "member": members.number, "kind": kind, **made.told}
    stored = {name: told[name.removeprefix("matched/")].astype(field.dtype) for name, field in fields(options).items()}
    return made._replace(told=stored)


def _blank(keys: Array, sample: Callable, run: Callable) -> Videos:
    """Videos of zeros, to begin with."""

    def made(keys: Array) -> Videos:
        drawn, found = jax.vmap(sample)(keys)
        counts = {name: jnp.zeros(len(keys), jnp.int32) for name in ("object", "partner", "onset")}
        return Videos(drawn, found, run(found.scene, found.state), counts | {"size": jnp.zeros(len(keys))})

    return jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), jax.eval_shape(made, keys))


def _acted(
    member: Member, scene: Scene, state: State, states: State, options: Any, layout: Layout
) -> tuple[Scene, Scene, State, Array, dict[str, Array]]:
    """One video's scene as it is stored, the scene, state and frame to simulate it from, and what is told of that."""
    free = jnp.asarray(untied(layout)) & scene.objects.present
    here = jax.tree.map(lambda values: values[member.frame], states)
    later = Moment(scene, here, free & _inside(here.position, layout))
    chosen, frame = Act(scene, state, jnp.zeros(()), jnp.int32(-1), jnp.int32(-1)), jnp.int32(0)
    for place, name in enumerate(options.change):
        if name in INTERVENTIONS:
            act = ACTS[name](member, later if name in VIOLATIONS else Moment(scene, state, free), options, layout)
            on = member.changed & (member.kind == place) & (act.size > 0)
            chosen = jax.tree.map(lambda new, old, on=on: jnp.where(on, new, old), act, chosen)
            frame = jnp.where(on, member.frame, frame) if name in VIOLATIONS else frame
    stored = dataclasses.replace(chosen.scene, gravity=scene.gravity)
    told = {"object": chosen.object, "partner": chosen.partner, "size": chosen.size}
    return stored, chosen.scene, chosen.state, frame, told


def _joined(frame: Array, before: State, after: State) -> State:
    """Videos [n, T, ...] that go on with the first frame of others at a frame [n] of their own."""

    def joined(frame: Array, old: Array, new: Array) -> Array:
        number = jnp.arange(len(old))
        late = _along(number >= frame, old)
        return jnp.where(late, new[jnp.maximum(number - frame, 0)], old)

    return jax.tree.map(functools.partial(jax.vmap(joined), frame), before, after)


def _told(member: Member, before: Videos, after: Videos, config: Any) -> dict[str, Array]:
    """What is told of one video's change, of a factor's too, and the first frame that shows it."""
    one, other = before.sampled, after.sampled
    told, both = dict(after.told), one.scene.objects.present & other.scene.objects.present
    for place, name in enumerate(config.matched.change):
        if name not in INTERVENTIONS:
            on = member.changed & (member.kind == place)
            slot = _other_slot((one.scene.objects, one.state), (other.scene.objects, other.state))
            told["object"] = jnp.where(on, slot, told["object"])
            change = (after.drawn[name] - before.drawn[name]).astype(jnp.float32)
            size = (
                jnp.linalg.norm(change, axis=-1) if drawn_options(config.scene.module)[name].parts else jnp.abs(change)
            )
            told["size"] = jnp.where(on, jnp.max(size), told["size"])
    differ = jnp.zeros(len(after.made.states.angle), bool)
    for a, b in zip(jax.tree.leaves(before.made.states), jax.tree.leaves(after.made.states), strict=True):
        differ |= ((a != b).reshape(*a.shape[:2], -1).any(axis=-1) & both).any(axis=-1)
    return told | {"onset": jnp.where(differ.any(), jnp.argmax(differ), -1).astype(jnp.int32)}
