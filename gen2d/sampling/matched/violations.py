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
from gen2d.sampling.builder import rotate
from gen2d.sampling.matched.sets import SetMember, along_slots

CLEARANCE = 1e-3  # m around an object that has jumped
DIRECTIONS = 32  # tried for a jump
MAX_INCIDENCE = math.pi / 3  # rad, angle of incidence on an invisible wall
MAX_SIZE_DIFFERENCE = 0.25  # of two objects that swap places, over the smaller size


class SceneInstant(NamedTuple):
    """A scene at one instant."""

    scene: Scene
    state: State
    free: Array  # [K] objects that move, in view and without joints


class Intervention(NamedTuple):
    """Scene and state after a change; size 0 means that none was possible."""

    scene: Scene
    state: State
    size: Array
    object: Array | int = -1
    partner: Array | int = -1


def _remove(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """Remove one object, a different one in each member. Size: its mass in kg."""
    scene, state = now.scene, now.state
    slot, possible = _random_slot(key_for(member.set_key, "object"), now.free, member.number - 1)

    def emptied(values: Array) -> Array:
        return jnp.where(along_slots(jnp.arange(len(values)) == slot, values), jnp.zeros_like(values), values)

    objects, state = jax.tree.map(emptied, (scene.objects, state))
    return Intervention(dataclasses.replace(scene, objects=objects), state, possible * scene.objects.mass[slot], slot)


def _teleport(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """Move one object to a free position. Size: the distance in m."""
    state = now.state
    slot, possible = _random_slot(key_for(member.set_key, "object"), now.free)
    distance = options.distance.sample(key_for(member.own_key, "distance"), ())
    turn, priority = (_uniform(key_for(member.own_key, name), (DIRECTIONS,)) for name in ("turn", "luck"))
    angle = 2 * jnp.pi * (jnp.arange(DIRECTIONS) + turn[0]) / DIRECTIONS
    jump = distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    clear = jax.vmap(lambda position: _is_free(position, slot, now, layout))(state.position[slot] + jump)
    chosen = jnp.argmax(jnp.where(clear, priority, -1))
    position = state.position.at[slot].add(jump[chosen])
    return Intervention(
        now.scene, dataclasses.replace(state, position=position), possible * clear[chosen] * distance, slot
    )


def _swap(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """Swap positions and motions of two objects of the same shape and the most similar size. Size: distance in m."""
    free, objects, slots = now.free, now.scene.objects, jnp.arange(len(now.free))
    size = extent(objects)
    differ = jnp.abs(size[:, None] - size)
    pair = free[:, None] & free & (objects.shape[:, None] == objects.shape) & (slots[:, None] < slots)
    pair &= differ <= MAX_SIZE_DIFFERENCE * jnp.minimum(size[:, None], size)
    nearest = pair & (differ <= jnp.min(jnp.where(pair, differ, jnp.inf)) + 1e-6)  # m
    priority = _uniform(key_for(member.set_key, "object"), pair.shape)
    a, b = jnp.divmod(jnp.argmax(jnp.where(nearest, priority, -1)), len(free))
    permutation = slots.at[a].set(b).at[b].set(a)
    distance = jnp.linalg.norm(now.state.position[a] - now.state.position[b])
    return Intervention(
        now.scene, jax.tree.map(lambda values: values[permutation], now.state), nearest.any() * distance, a, b
    )


def _flip_gravity(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """Reverse gravity. Size: its change in m/s^2."""
    flipped = dataclasses.replace(now.scene, gravity=-now.scene.gravity)
    return Intervention(flipped, now.state, 2 * jnp.linalg.norm(now.scene.gravity))


def _ghost_contact(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """Bounce one object off an invisible wall. Size: the angle in rad by which its velocity turns."""
    state = now.state
    slot, possible = _random_slot(key_for(member.set_key, "object"), _fast_objects(now))
    velocity = state.velocity[slot]
    skew = MAX_INCIDENCE * _uniform(key_for(member.own_key, "skew"), (), -1.0)
    normal = rotate(velocity, jnp.pi + skew)
    square = jnp.maximum((normal**2).sum(), 1e-12)
    mirrored = velocity - 2 * (velocity @ normal) / square * normal
    state = dataclasses.replace(state, velocity=state.velocity.at[slot].set(mirrored))
    return Intervention(now.scene, state, possible * (jnp.pi - 2 * jnp.abs(skew)), slot)


def _gain_energy(member: SetMember, now: SceneInstant, options: Any, layout: Layout) -> Intervention:
    """Speed up one object, in motion and spin. Size: the factor of its speed."""
    state = now.state
    slot, possible = _random_slot(key_for(member.set_key, "object"), _fast_objects(now))
    gain = options.gain.sample(key_for(member.own_key, "gain"), ())
    velocity, spin = (rate.at[slot].multiply(gain) for rate in (state.velocity, state.angular_velocity))
    return Intervention(
        now.scene, dataclasses.replace(state, velocity=velocity, angular_velocity=spin), possible * gain, slot
    )


# By name in matched.change; the order is that of the codes in matched/kind.
INTERVENTION_FUNCTIONS = {
    "remove": _remove,
    "teleport": _teleport,
    "identity_swap": _swap,
    "gravity_flip": _flip_gravity,
    "ghost_contact": _ghost_contact,
    "energy_gain": _gain_energy,
}


def _uniform(key: Array, shape: tuple[int, ...], low: float = 0.0) -> Array:
    """Samples from low to 1, the same in any precision of the simulation."""
    return jax.random.uniform(key, shape, jnp.float32, low)


def _random_slot(key: Array, eligible: Array, index: Any = 0) -> tuple[Array, Array]:
    """Slot at `index`, modulo their number, in a random order of the eligible slots, and whether there are any."""
    order = jnp.argsort(jnp.where(eligible, _uniform(key, eligible.shape), 2))
    return order[index % jnp.maximum(eligible.sum(), 1)], eligible.any()


def _fast_objects(now: SceneInstant) -> Array:
    """Whether each object [K] has at least half the largest speed; changes of slower ones would hardly be visible."""
    speed = jnp.where(now.free, jnp.linalg.norm(now.state.velocity, axis=-1), 0)
    return now.free & (speed > 0) & (speed >= jnp.max(speed) / 2)


def extent(objects: Objects) -> Array:
    """Largest distance [K] m of each object's boundary from its centre."""
    corner = 0.0 if objects.vertices is None else jnp.linalg.norm(objects.vertices, axis=-1).max(axis=-1)
    return objects.radius + objects.half_length + corner


def gaps(point: Array, objects: Objects, state: State) -> Array:
    """Distance [K] m of a point [2] from each object's boundary, negative inside; a lower bound near corners."""
    local = rotate(point - state.position, -state.angle)
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


def inside_view(position: Array, layout: Layout, radius: Any = 0.0) -> Array:
    """Whether discs of this radius at positions [..., 2] lie within the layout's bounds."""
    left, bottom, right, top = layout.bounds
    low, high = jnp.asarray([left, bottom]) + radius, jnp.asarray([right, top]) - radius
    return ((position >= low) & (position <= high)).all(axis=-1)


def _is_free(position: Array, slot: Array, now: SceneInstant, layout: Layout) -> Array:
    """Whether an object at this position would be in view and overlap nothing."""
    objects = now.scene.objects
    reach, others = extent(objects)[slot] + CLEARANCE, objects.present & (jnp.arange(len(now.free)) != slot)
    return inside_view(position, layout, reach) & (~others | (gaps(position, objects, now.state) >= reach)).all()
