"""From a scene and its initial state to the state at every frame: frame 0 is the initial state, frame t is t / fps."""

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp

from gen2d.contacts import Segments
from gen2d.errors import ConfigError
from gen2d.solver import Discs, Impulse, Memory, Motion, Row, Rules, Setup, row, step
from gen2d.tournament import tournament
from gen2d.types import Array, Layout, Objects, Quality, Record, Scene, State, Trajectory

MOST_STEPS = 10_000  # a frame


def substeps(fps: float, asked: int | None, max_step: float) -> int:
    """Steps per frame: as asked, else the smallest number that keeps a step at or under `max_step` seconds."""
    steps = asked or max(1, math.ceil(1 / (fps * max_step) - 1e-9))
    if steps > MOST_STEPS:
        raise ConfigError(f"video.fps is {fps:g}, which takes {steps:,} steps a frame, but {MOST_STEPS:,} is the most")
    return steps


def _inverse(value: Array, present: Array) -> Array:
    usable = present & jnp.isfinite(value) & (value > 0)
    return jnp.where(usable, 1 / jnp.where(usable, value, 1.0), 0.0)


def _clean(values: Record, present: Array) -> Record:
    """The record with nothing in its empty slots, so that whatever stood there (NaN, too) cannot matter."""
    return jax.tree.map(lambda x: jnp.where(present, x, jnp.zeros_like(x)), values)


def _discs(objects: Objects, count: int, padded: int) -> Discs:
    def first(x: Array) -> Array:
        return jnp.pad(x[:count], [(0, padded - count)] + [(0, 0)] * (x.ndim - 1))

    inverse_mass, inverse_moment = (_inverse(x, objects.present) for x in (objects.mass, objects.moment))
    return Discs(*map(first, (objects.radius, inverse_mass, inverse_moment, objects.elasticity, objects.friction)))


def _pair_rows(discs: Discs, mixing: str) -> list[Row]:
    def play(_: int, a: Discs, b: Discs) -> tuple[Discs, Discs, Row]:
        return a, b, row(a, b, (a.inverse_mass > 0) & (b.inverse_mass > 0), mixing)

    return tournament(discs, discs.radius.shape[0] - 1, play)[1]


def _setup(scene: Scene, state: State, layout: Layout, rules: Rules) -> Setup:
    discs = _discs(scene.objects, layout.discs, layout.discs + layout.discs % 2)
    segments, walls = [], []
    for k in range(layout.discs, layout.slots):
        angle = state.angle[k]
        direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        nothing = jnp.zeros_like(discs.radius)
        e, mu = (jnp.broadcast_to(x[k], nothing.shape) for x in (scene.objects.elasticity, scene.objects.friction))
        fixed = Discs(nothing, nothing, nothing, e, mu)
        present = scene.objects.present[k] & (discs.inverse_mass > 0)
        walls.append(row(fixed, discs, present, rules.mixing))
        size = scene.objects.half_length[k], scene.objects.radius[k]
        segments.append(Segments(state.position[:, k, None], direction[:, None], *size))
    one = 1.0 + jnp.maximum(-jnp.max(discs.radius), 0.0)  # no radius is negative, but the compiler cannot know
    # In a pile at rest, what has to be stopped anew each step is what gravity gave: that must not count as a bounce.
    at_rest = 2 * rules.step * jnp.sqrt(jnp.sum(scene.gravity**2, axis=0))
    threshold = jnp.maximum(rules.bounce_threshold, at_rest)
    fall = scene.gravity[:, None] * (discs.inverse_mass > 0)
    return Setup(scene.gravity, fall, threshold, _pair_rows(discs, rules.mixing), walls, segments, discs.radius, one)


def _nothing_yet(setup: Setup) -> Memory:
    def zero(rows: list[Row]) -> list[Impulse]:
        return [Impulse(jnp.zeros_like(r.normal_mass), jnp.zeros_like(r.normal_mass)) for r in rows]

    lanes, count = setup.radius.shape[1:], setup.radius.shape[0]
    pairs, walls = (count // 2, *lanes), (count, *lanes)
    seen = [jnp.zeros(shape, kind) for shape in (pairs, walls) for kind in (setup.radius.dtype, jnp.int32)]
    return Memory(zero(setup.pairs), zero(setup.walls), *seen)


def simulate(scene: Scene, state: State, layout: Layout, rules: Rules, frames: int, steps: int) -> Trajectory:
    """The trajectory of `frames` frames, `steps` steps apart; device layout, any number of scenes at once.

    Scene and state have bodies before scenes: position [2, K, n] in m, angle [K, n] in rad, and so on (types.py); the
    result has frames first: position [T, 2, K, n]. What stands in empty slots is ignored; they come back as zeros.
    Raises AssertionError for records of another layout.
    """
    chex.assert_shape(state.position, (2, layout.slots, ...))
    chex.assert_equal_shape([state.angle, state.angular_velocity, scene.objects.present, scene.objects.mass])
    scene = dataclasses.replace(scene, objects=_clean(scene.objects, scene.objects.present))
    state = _clean(state, scene.objects.present)
    setup = _setup(scene, state, layout, rules)
    discs, padding = layout.discs, layout.discs % 2

    def moving(x: Array) -> Array:
        widths = [(0, 0)] * (x.ndim - 2) + [(0, padding), (0, 0)]
        return jnp.pad(x[..., :discs, :], widths)

    start = (
        *map(moving, (state.position, state.angle)),
        Motion(*map(moving, (state.velocity, state.angular_velocity))),
        _nothing_yet(setup),
    )

    def frame(carry: tuple, _: None) -> tuple:
        def once(_: int, now: tuple) -> tuple:
            position, angle, motion, memory = now
            return step(position, angle, motion, memory, setup, rules)

        carry = jax.lax.fori_loop(0, steps, once, carry)
        position, angle, motion, _ = carry
        return carry, tuple(x[..., :discs, :] for x in (position, angle, *motion))

    (*_, memory), later = jax.lax.scan(frame, start, None, length=frames - 1)
    return Trajectory(_states(state, later, layout), _quality(memory))


def _states(start: State, later: tuple, layout: Layout) -> State:
    """All frames of all slots: the first from the initial state, of what is fixed throughout."""

    def joined(first: Array, moved: Array) -> Array:
        fixed = jnp.broadcast_to(first[..., layout.discs :, :], (*moved.shape[:-2], layout.segments, moved.shape[-1]))
        return jnp.concatenate([first[None], jnp.concatenate([moved, fixed], axis=-2)], axis=0)

    position, angle, velocity, spin = later
    return State(
        position=joined(start.position, position),
        angle=joined(start.angle, angle),
        velocity=joined(start.velocity, velocity),
        angular_velocity=joined(start.angular_velocity, spin),
    )


def _quality(memory: Memory) -> Quality:
    depth = jnp.maximum(jnp.max(memory.pair_depth, axis=0), jnp.max(memory.wall_depth, axis=0))
    begins = jnp.sum(memory.pair_begins, axis=0) + jnp.sum(memory.wall_begins, axis=0)
    return Quality(depth, begins)
