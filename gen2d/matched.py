"""Matched sets: videos that share a scene and differ in one thing, and what that is.

Video i is member i % members of set i // members. All members have the set's key, so the same factors, places, look,
camera and noise; member 0 is the original. The others are counterfactuals (an object is gone, or a factor is another
one from the start) or violations (something impossible happens on the way). Every video is simulated twice, by one
loop: as the original, and as itself from where it is changed on. What comes before is the original's to the bit, and so
is all that the change does not reach.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d import factors, plugins
from gen2d.core.schema import Field
from gen2d.distributions import Distribution
from gen2d.factors import key_for
from gen2d.options import drawn_options
from gen2d.parts import Sampled
from gen2d.types import DYNAMIC, Array, Layout, Objects, Scene, State, Trajectory

CLEARANCE = 1e-3  # m around an object that has jumped
DIRECTIONS = 32  # in which a jump is tried
WIDEST = math.pi / 3  # rad, between what comes at a wall that is not there and that wall's normal
ALIKE = 0.25  # by which share the sizes of two objects may differ that swap places


# ---- Which video is which, and which is changed how


class Member(NamedTuple):
    """One video's part in its set."""

    number: Array  # in the set
    changed: Array  # whether it is not the original
    kind: Array  # place in matched.change
    frame: Array  # at which a violation happens
    set_key: Array
    own_key: Array


def keys_of(words: Array, numbers: Array, options: Any) -> Array:
    """A key per video, that of its set where there are sets."""
    return factors.video_keys(words, numbers // options.members if options.change else numbers)


def _member(key: Array, number: Array, options: Any, frames: int) -> Member:
    set_key = key_for(key, "matched")
    kind = jax.random.randint(key_for(set_key, "change"), (), 0, len(options.change))
    share = options.onset.sample(key_for(set_key, "onset"), ())
    frame = jnp.clip(jnp.round(share * frames).astype(jnp.int32), 1, frames - 1)
    return Member(number, number > 0, kind, frame, set_key, jax.random.fold_in(set_key, number))


# ---- Counterfactuals: other factors


def _other_factors(member: Member, config: Any, found: dict[str, Array], draw: Callable) -> dict[str, Array]:
    """The factors, with the one that the set is about drawn anew or scaled; `draw(key)` draws all."""
    specs, matched, again, made = drawn_options(config.scene.module), config.matched, draw(member.own_key), dict(found)
    for place, name in enumerate(matched.change):
        if name in ACTS:
            continue
        spec, new = specs[name], again[name]
        if matched.scale is not None:
            scale = matched.scale.sample(key_for(member.own_key, "scale"), ())
            new = jnp.clip(found[name] * scale, spec.low, spec.high)
        if spec.each and matched.objects == "one":
            count = jnp.maximum(found.get(spec.each, len(new)), 1)
            one = jax.random.randint(key_for(member.set_key, "one"), (), 0, count)
            new = jnp.where(_along(jnp.arange(len(new)) == one, new), new, found[name])
        made[name] = jnp.where(member.changed & (member.kind == place), new, found[name])
    return made


def _along(values: Array, like: Array) -> Array:
    """Values [K] that broadcast to those of `like` [K, ...]."""
    return values.reshape(-1, *[1] * (like.ndim - 1))


def _other_slot(one: tuple[Objects, State], other: tuple[Objects, State]) -> Array:
    """The only slot that holds something else in two scenes at their start; -1 where there are none or several."""
    differ = jnp.zeros(one[0].present.shape, bool)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        differ |= (a != b).reshape(len(differ), -1).any(axis=1)
    return jnp.where(differ.sum() == 1, jnp.argmax(differ), -1)


# ---- What else may happen to a scene


class Moment(NamedTuple):
    """A scene at one instant."""

    scene: Scene
    state: State
    free: Array  # [K] what moves in view and is on no joint


class Act(NamedTuple):
    """A scene and a state after a change; of size 0 where none was possible."""

    scene: Scene
    state: State
    size: Array
    object: Array | int = -1
    partner: Array | int = -1


def _removed(member: Member, now: Moment, options: Any, layout: Layout) -> Act:
    """One object is gone, another one in each member. Size: its mass, kg."""
    scene, state = now.scene, now.state
    slot, some = _nth(key_for(member.set_key, "object"), now.free, member.number - 1)

    def emptied(values: Array) -> Array:
        return jnp.where(_along(jnp.arange(len(values)) == slot, values), jnp.zeros_like(values), values)

    objects, state = jax.tree.map(emptied, (scene.objects, state))
    return Act(dataclasses.replace(scene, objects=objects), state, some * scene.objects.mass[slot], slot)


def _teleported(member: Member, now: Moment, options: Any, layout: Layout) -> Act:
    """One object jumps to where there is room. Size: how far, m."""
    state = now.state
    slot, some = _nth(key_for(member.set_key, "object"), now.free)
    distance = options.distance.sample(key_for(member.own_key, "distance"), ())
    turn, luck = (jax.random.uniform(key_for(member.own_key, name), (DIRECTIONS,)) for name in ("turn", "luck"))
    angle = 2 * jnp.pi * (jnp.arange(DIRECTIONS) + turn[0]) / DIRECTIONS
    way = distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    clear = jax.vmap(lambda place: _clear(place, slot, now, layout))(state.position[slot] + way)
    chosen = jnp.argmax(jnp.where(clear, luck, -1))
    position = state.position.at[slot].add(way[chosen])
    return Act(now.scene, dataclasses.replace(state, position=position), some * clear[chosen] * distance, slot)


def _swapped(member: Member, now: Moment, options: Any, layout: Layout) -> Act:
    """Two objects of one shape, as similar in size as there are, change places and motions. Size: how far apart, m."""
    free, objects, slots = now.free, now.scene.objects, jnp.arange(len(now.free))
    size = extent(objects)
    differ = jnp.abs(size[:, None] - size)
    pair = free[:, None] & free & (objects.shape[:, None] == objects.shape) & (slots[:, None] < slots)
    pair &= differ <= ALIKE * jnp.minimum(size[:, None], size)
    nearest = pair & (differ <= jnp.min(jnp.where(pair, differ, jnp.inf)) + 1e-6)  # m
    luck = jax.random.uniform(key_for(member.set_key, "object"), pair.shape)
    a, b = jnp.divmod(jnp.argmax(jnp.where(nearest, luck, -1)), len(free))
    turned = slots.at[a].set(b).at[b].set(a)
    apart = jnp.linalg.norm(now.state.position[a] - now.state.position[b])
    return Act(now.scene, jax.tree.map(lambda values: values[turned], now.state), nearest.any() * apart, a, b)


def _flipped(member: Member, now: Moment, options: Any, layout: Layout) -> Act:
    """Gravity turns round. Size: its change, m/s^2."""
    flipped = dataclasses.replace(now.scene, gravity=-now.scene.gravity)
    return Act(flipped, now.state, 2 * jnp.linalg.norm(now.scene.gravity))


def _bounced(member: Member, now: Moment, options: Any, layout: Layout) -> Act:
    """One object bounces off nothing. Size: the angle by which its velocity turns, rad."""
    state = now.state
    slot, some = _nth(key_for(member.set_key, "object"), _fast(now))
    velocity = state.velocity[slot]
    skew = WIDEST * jax.random.uniform(key_for(member.own_key, "skew"), (), minval=-1)
    normal = _turned(velocity, jnp.pi + skew)
    square = jnp.maximum((normal**2).sum(), 1e-12)
    mirrored = velocity - 2 * (velocity @ normal) / square * normal
    state = dataclasses.replace(state, velocity=state.velocity.at[slot].set(mirrored))
    return Act(now.scene, state, some * (jnp.pi - 2 * jnp.abs(skew)), slot)


def _sped_up(member: Member, now: Moment, options: Any, layout: Layout) -> Act:
    """One object moves and spins faster than it did. Size: how many times as fast."""
    state = now.state
    slot, some = _nth(key_for(member.set_key, "object"), _fast(now))
    gain = options.gain.sample(key_for(member.own_key, "gain"), ())
    velocity, spin = (rate.at[slot].multiply(gain) for rate in (state.velocity, state.angular_velocity))
    return Act(now.scene, dataclasses.replace(state, velocity=velocity, angular_velocity=spin), some * gain, slot)


# What the names in matched.change that are no factors do; codes of matched/kind are their places here.
ACTS = {
    "remove": _removed,
    "teleport": _teleported,
    "identity_swap": _swapped,
    "gravity_flip": _flipped,
    "ghost_contact": _bounced,
    "energy_gain": _sped_up,
}
VIOLATIONS = tuple(ACTS)[1:]


def _nth(key: Array, eligible: Array, number: Any = 0) -> tuple[Array, Array]:
    """The slot that comes n-th in a random order of the eligible ones, round and round, and whether there is any."""
    order = jnp.argsort(jnp.where(eligible, jax.random.uniform(key, eligible.shape), 2))
    return order[number % jnp.maximum(eligible.sum(), 1)], eligible.any()


def _fast(now: Moment) -> Array:
    """Which of the objects [K] are at least half as fast as the fastest: others would show little."""
    speed = jnp.where(now.free, jnp.linalg.norm(now.state.velocity, axis=-1), 0)
    return now.free & (speed > 0) & (speed >= jnp.max(speed) / 2)


def untied(layout: Layout) -> np.ndarray:
    """Which slots [K] hold what moves and is on no joint."""
    free = np.concatenate([np.full(run.count, run.kind == DYNAMIC) for run in layout.runs])
    free[[slot for tie in layout.joints for slot in (tie.a, tie.b)]] = False
    return free


def _turned(vector: Array, angle: Array) -> Array:
    """Vectors [..., 2] turned counter-clockwise."""
    cos, sin, (x, y) = jnp.cos(angle), jnp.sin(angle), (vector[..., 0], vector[..., 1])
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def extent(objects: Objects) -> Array:
    """The largest distance [K] m of each object's rim from its centre."""
    corner = 0.0 if objects.vertices is None else jnp.linalg.norm(objects.vertices, axis=-1).max(axis=-1)
    return objects.radius + objects.half_length + corner


def gaps(point: Array, objects: Objects, state: State) -> Array:
    """How far [K] m each object's rim is from a point [2], at least: beside a polygon's corner it may be farther."""
    local = _turned(point - state.position, -state.angle)
    along = jnp.maximum(jnp.abs(local[:, 0]) - objects.half_length, 0)
    distance = jnp.hypot(along, local[:, 1])
    if objects.vertices is not None:
        side = jnp.roll(objects.vertices, -1, axis=1) - objects.vertices
        length = jnp.linalg.norm(side, axis=-1)
        to_point = local[:, None] - objects.vertices
        beside = (to_point[..., 0] * side[..., 1] - to_point[..., 1] * side[..., 0]) / jnp.maximum(length, 1e-9)
        faces = jnp.where(length > 0, beside, -jnp.inf).max(axis=1)
        distance = jnp.where(length.max(axis=1) > 0, faces, distance)
    return distance - objects.radius


def _inside(place: Array, layout: Layout, reach: Any = 0.0) -> Array:
    """Whether discs of this reach at places [..., 2] are within what is worth seeing."""
    left, bottom, right, top = layout.bounds
    low, high = jnp.asarray([left, bottom]) + reach, jnp.asarray([right, top]) - reach
    return ((place >= low) & (place <= high)).all(axis=-1)


def _clear(place: Array, slot: Array, now: Moment, layout: Layout) -> Array:
    """Whether an object has room at a place: in view, and overlapping nothing."""
    objects = now.scene.objects
    reach, others = extent(objects)[slot] + CLEARANCE, objects.present & (jnp.arange(len(now.free)) != slot)
    return _inside(place, layout, reach) & (~others | (gaps(place, objects, now.state) >= reach)).all()


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
        if name in ACTS:
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
        if name not in ACTS:
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


# ---- What is stored


UNITS = "kg removed; m of a teleport or a swap; m/s^2; rad of a ghost contact; times as fast; a factor's own unit"


def fields(options: Any) -> dict[str, Field]:
    """What is stored of sets."""
    if not options.change:
        return {}
    codes = ", ".join(f"{code} {name}" for name, code in zip(options.change, _codes(options), strict=True))
    return {
        "matched/set": Field("int32", "n", "1", f"its members are {options.members} videos in a row"),
        "matched/member": Field("uint8", "n", "1", "the video's place in its set; 0: the original"),
        "matched/kind": Field("uint8", "n", "1", f"what the set's members differ in: {codes}"),
        "matched/onset": Field(
            "int32", "n", "1", "first frame with a state that is another than the original's; -1: none"
        ),
        "matched/object": Field("int16", "n", "object", "slot of what is changed; -1: none, or more than one"),
        "matched/partner": Field("int16", "n", "object", "slot of what the object changes places with; -1: none"),
        "matched/size": Field("float32", "n", "1", f"of the change, 0: none ({UNITS})"),
    }


def untold(options: Any) -> tuple[str, ...]:
    """What is not stored: of a video put together from two, neither tells."""
    parts = "quality/max_penetration", "quality/contacts"
    return parts if set(options.change or ()) & set(VIOLATIONS) else ()


def _codes(options: Any) -> list[int]:
    """The number that stands for each of the changes: factors come after all else."""
    named, own = list(ACTS), iter(range(len(ACTS), 256))
    return [named.index(name) if name in named else next(own) for name in options.change]


# ---- What is asked, checked


def check(options: Any, default: Any, scene: Any, video: Any, annotations: Any, camera: Any) -> None:
    """ValueError where these sets cannot be made: one sentence that begins with the option's name."""
    if not options.change:
        if options != default:
            raise ValueError("change is null, but other options are given: name what a set's members differ in")
        return
    if len(set(options.change)) < len(options.change):
        raise ValueError(f"change is {list(options.change)}, but must name each change once")
    layout = scene.module.layout(scene.options)
    for name in options.change:
        if name in ACTS:
            _check_act(name, scene, layout, video, camera)
        else:
            _check_factor(name, options, scene, layout)
    asked = [name for name in ("contacts", "energy", "predictability") if getattr(annotations, name)]
    violations = [name for name in options.change if name in VIOLATIONS]
    if asked and violations:
        raise ValueError(f"change is {violations[0]}, which has no books: annotations.{asked[0]} must be off")


def _check_act(name: str, scene: Any, layout: Layout, video: Any, camera: Any) -> None:
    least = {"gravity_flip": 0, "identity_swap": 2}.get(name, 1)
    if untied(layout).sum() < least:
        raise ValueError(f"change is {name}, but the scene has no {least} that move and are on no joint")
    if name in VIOLATIONS and video.frames < 2:
        raise ValueError(f"change is {name}, but video.frames is {video.frames}, and that happens on the way")
    if name == "remove" and camera.follow is not None:
        raise ValueError("change is remove, but camera.follow may be what is gone: it must be null")
    gravity = getattr(scene.options, "gravity", ())
    if name == "gravity_flip" and all(part.support == (0, 0) for part in gravity):
        raise ValueError("change is gravity_flip, but there is no scene.gravity")


def _check_factor(name: str, options: Any, scene: Any, layout: Layout) -> None:
    specs = drawn_options(scene.module)
    if name not in specs:
        raise ValueError(f"change is {name!r}, which is no factor; {plugins.nearest(name, [*ACTS, *specs])}")
    value = getattr(scene.options, name)
    parts = value if isinstance(value, tuple) else (value,)
    if options.scale is None:
        if all(low == high for low, high in (part.support for part in parts)):
            raise ValueError(f"change is {name}, but scene.{name} is always the same: give it a range, or scale it")
        return
    if specs[name].kind is int:
        raise ValueError(f"scale is for numbers, but scene.{name} is a whole number, which can be drawn anew only")
    scaled = tuple(_scaled(part, options.scale, specs[name]) for part in parts)
    widened = dataclasses.replace(scene.options, **{name: scaled if isinstance(value, tuple) else scaled[0]})
    if hasattr(scene.module, "check"):
        scene.module.check(widened)
    if scene.module.layout(widened) != layout:
        raise ValueError(f"scale is for what the scene is not built around, but scene.{name} is: draw it anew")


def _scaled(part: Distribution, scale: Distribution, spec: Any) -> Distribution:
    """What a part of a factor may be when it is scaled."""
    ends = [end * factor for end in part.support for factor in scale.support]
    low, high = (-math.inf if spec.low is None else spec.low), (math.inf if spec.high is None else spec.high)
    return Distribution("uniform", (max(min(ends), low), min(max(ends), high)))
