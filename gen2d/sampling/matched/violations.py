"""Changes of a scene in the middle of a video: removal and impossible events."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.records.keys import key_for
from gen2d.records.layout import Layout
from gen2d.records.scene import Objects, Scene, State
from gen2d.sampling.matched.sets import SetMember, along_slots

CLEARANCE = 1e-3  # m around an object that has jumped
DIRECTIONS = 32  # in which a jump is tried
WIDEST = math.pi / 3  # rad, between what comes at a wall that is not there and that wall's normal
ALIKE = 0.25  # by which share the sizes of two objects may differ that swap places


# ---- What else may happen to a scene


class SceneInstant(NamedTuple):
    """A scene at one instant."""

    scene: Scene
    state: State
    free: Array  # [K] what moves in view and is on no joint


class Intervention(NamedTuple):
    """A scene and a state after a change; of size 0 where none was possible."""

    scene: Scene
    state: State
    size: Array
    object: Array | int = -1
    partner: Array | int = -1


def _removed(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """One object is gone, another one in each member. Size: its mass, kg."""
    scene, state = now.scene, now.state
    slot, some = _nth(key_for(member.set_key, "object"), now.free, member.number - 1)

    def emptied(values: Array) -> Array:
        return jnp.where(along_slots(jnp.arange(len(values)) == slot, values), jnp.zeros_like(values), values)

    objects, state = jax.tree.map(emptied, (scene.objects, state))
    return Intervention(dataclasses.replace(scene, objects=objects), state, some * scene.objects.mass[slot], slot)


def _teleported(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
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
    return Intervention(now.scene, dataclasses.replace(state, position=position), some * clear[chosen] * distance, slot)


def _swapped(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
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
    return Intervention(now.scene, jax.tree.map(lambda values: values[turned], now.state), nearest.any() * apart, a, b)


def _flipped(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """Gravity turns round. Size: its change, m/s^2."""
    flipped = dataclasses.replace(now.scene, gravity=-now.scene.gravity)
    return Intervention(flipped, now.state, 2 * jnp.linalg.norm(now.scene.gravity))


def _bounced(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """One object bounces off nothing. Size: the angle by which its velocity turns, rad."""
    state = now.state
    slot, some = _nth(key_for(member.set_key, "object"), _fast(now))
    velocity = state.velocity[slot]
    skew = WIDEST * jax.random.uniform(key_for(member.own_key, "skew"), (), minval=-1)
    normal = _turned(velocity, jnp.pi + skew)
    square = jnp.maximum((normal**2).sum(), 1e-12)
    mirrored = velocity - 2 * (velocity @ normal) / square * normal
    state = dataclasses.replace(state, velocity=state.velocity.at[slot].set(mirrored))
    return Intervention(now.scene, state, some * (jnp.pi - 2 * jnp.abs(skew)), slot)


def _sped_up(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """One object moves and spins faster than it did. Size: how many times as fast."""
    state = now.state
    slot, some = _nth(key_for(member.set_key, "object"), _fast(now))
    gain = options.gain.sample(key_for(member.own_key, "gain"), ())
    velocity, spin = (rate.at[slot].multiply(gain) for rate in (state.velocity, state.angular_velocity))
    return Intervention(
        now.scene, dataclasses.replace(state, velocity=velocity, angular_velocity=spin), some * gain, slot
    )


# What the names in matched.change that are no factors do; codes of matched/kind are their places here.
INTERVENTION_FUNCTIONS = {
    "remove": _removed,
    "teleport": _teleported,
    "identity_swap": _swapped,
    "gravity_flip": _flipped,
    "ghost_contact": _bounced,
    "energy_gain": _sped_up,
}


def _nth(key: Array, eligible: Array, number: Any = 0) -> tuple[Array, Array]:
    """The slot that comes n-th in a random order of the eligible ones, round and round, and whether there is any."""
    order = jnp.argsort(jnp.where(eligible, jax.random.uniform(key, eligible.shape), 2))
    return order[number % jnp.maximum(eligible.sum(), 1)], eligible.any()


def _fast(now: SceneInstant) -> Array:
    """Which of the objects [K] are at least half as fast as the fastest: others would show little."""
    speed = jnp.where(now.free, jnp.linalg.norm(now.state.velocity, axis=-1), 0)
    return now.free & (speed > 0) & (speed >= jnp.max(speed) / 2)


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


def inside_view(place: Array, layout: Layout, reach: Any = 0.0) -> Array:
    """Whether discs of this reach at places [..., 2] are within what is worth seeing."""
    left, bottom, right, top = layout.bounds
    low, high = jnp.asarray([left, bottom]) + reach, jnp.asarray([right, top]) - reach
    return ((place >= low) & (place <= high)).all(axis=-1)


def _clear(place: Array, slot: Array, now: SceneInstant, layout: Layout) -> Array:
    """Whether an object has room at a place: in view, and overlapping nothing."""
    objects = now.scene.objects
    reach, others = extent(objects)[slot] + CLEARANCE, objects.present & (jnp.arange(len(now.free)) != slot)
    return inside_view(place, layout, reach) & (~others | (gaps(place, objects, now.state) >= reach)).all()
