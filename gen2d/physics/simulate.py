"""From a scene and its initial state to the state at every frame: frame 0 is the initial state, frame t is t / fps."""

import dataclasses
import math
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp

from gen2d.core.enums import DYNAMIC, STATIC
from gen2d.core.errors import ConfigError
from gen2d.physics import energy as energy_module
from gen2d.physics import joint_forces, rigid_joints
from gen2d.physics.constraint import Motion
from gen2d.physics.nearby_pairs import NearbyPairs
from gen2d.physics.params import SolverParams
from gen2d.physics.setup import build_model, moving, pad_groups, slots_of, without_empty
from gen2d.physics.state import BodyState, Model, WorldState
from gen2d.physics.step import step
from gen2d.records.axes import Array
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Energy, Quality, Trajectory
from gen2d.xla import runtime_one

MOST_STEPS = 10_000  # a frame
Forces = Callable[[State, Array], tuple[Array, Array]]


def substeps(fps: float, asked: int | None, max_step: float) -> int:
    """Steps per frame: as asked, else the smallest number that keeps a step at or under `max_step` seconds."""
    steps = asked or max(1, math.ceil(1 / (fps * max_step) - 1e-9))
    if steps > MOST_STEPS:
        raise ConfigError(f"video.fps is {fps:g}, which takes {steps:,} steps a frame, but {MOST_STEPS:,} is the most")
    return steps


@dataclasses.dataclass(frozen=True)
class SaveAt:
    """What to return beyond the states."""

    contacts: int = 0  # slots for rows of contacts; 0: none
    energy: bool = False
    between: bool = False  # whether the states at every step, too


def simulate(
    scene: Scene,
    state: State,
    layout: Layout,
    rules: SolverParams,
    frames: int,
    steps: int,
    keep: SaveAt = SaveAt(),
    forces: Forces | None = None,
    sparse: bool = False,
) -> Trajectory:
    """The trajectory of `frames` frames, `steps` steps apart; device layout, any number of scenes at once.

    Scene and state have bodies before scenes: position [2, K, n] in m, angle [K, n] in rad, and so on (types.py); the
    result has frames first: position [T, 2, K, n]. What stands in empty slots is ignored; they come back as zeros.
    `forces(state, time)` gives force [2, K, n] in N and torque [K, n] in N m on every slot, in every step.
    With `sparse` only what is near is solved (sparse.py): as exact, on a CPU much faster, but without a reverse-mode
    gradient. Raises AssertionError for records of another layout.
    """
    chex.assert_shape(state.position, (2, layout.slots, ...))
    chex.assert_equal_shape([state.angle, state.angular_velocity, scene.objects.present, scene.objects.mass])
    scene, state = without_empty(scene, state)
    hook = _hook(scene, state, layout, forces)
    scenery = build_model(scene, state, layout, rules, hook, keep.contacts > 0, sparse)
    with runtime_one(scenery.one):
        start, contacts = _start(state, layout, scenery, keep, rules), scenery.contacts

        if isinstance(contacts, NearbyPairs):
            after = jax.eval_shape(lambda world: step(world, scenery, rules).contacts, start)
            start = start._replace(contacts=contacts.with_room(start.contacts, after))

        def frame(world: WorldState, number: Array) -> tuple[WorldState, tuple]:
            world = world._replace(time=number * (steps * rules.step), contacts=contacts.frame_begins(world.contacts))
            if keep.between:
                world, way = jax.lax.scan(lambda now, _: _shown(step(now, scenery, rules)), world, length=steps)
            else:
                world, way = jax.lax.fori_loop(0, steps, lambda _, now: step(now, scenery, rules), world), None
            past, happened = contacts.frame_ends(world.contacts)
            return world._replace(contacts=past), (_shown(world)[1], way, _sums(world, scenery), happened)

        numbers = jnp.arange(frames - 1, dtype=state.angle.dtype)
        last, (bodies, way, sums, happened) = jax.lax.scan(frame, start, numbers)
        between = None if way is None else _substep_states(state, way, layout, rules.step)
        states = _states(state, bodies, layout, numbers * (steps * rules.step) + steps * rules.step)
        first = _sums(start, scenery)
        energy = None if first is None else _energy(first, sums)
        residual = None if energy is None else jnp.max(jnp.abs(energy.residual), axis=0)
        depth, begins, rows = contacts.ended(last.contacts, happened, keep.contacts, 1 / (steps * rules.step))
        return Trajectory(states, Quality(depth, begins, residual), rows, energy, between)


def _shown(world: WorldState) -> tuple[WorldState, list[BodyState]]:
    """The world, and of its bodies what is kept of an instant."""
    return world, [body._replace(rest=None) for body in world.bodies]


def _substep_states(start: State, way: list[BodyState], layout: Layout, step: float) -> State:
    """The states [T - 1, steps, ...] at the ends of steps, of bodies likewise."""
    frames, steps = way[0].angle.shape[:2]
    bodies = jax.tree.map(lambda x: x.reshape(frames * steps, *x.shape[2:]), way)
    states = _states(start, bodies, layout, (jnp.arange(frames * steps, dtype=start.angle.dtype) + 1) * step)
    return jax.tree.map(lambda x: x[1:].reshape(frames, steps, *x.shape[1:]), states)


def _energy_budget(bodies: list[BodyState], scenery: Model, rules: SolverParams) -> energy_module.Ledger:
    driven = scenery.forces is not None or any(f.motion is not None for f in scenery.fixed)

    def work(like: Array) -> energy_module.Work:
        nothing = jnp.zeros_like(like)
        return energy_module.Work(nothing, nothing if driven else None, nothing if rules.damping else None)

    groups = [work(b.angle) for b in bodies]
    if not scenery.ties:
        return energy_module.Ledger(groups, None)
    lost, put_in, damped = (jnp.zeros_like(scenery.ties[0].rest[..., :1, :]) for _ in range(3))
    return energy_module.Ledger(groups, energy_module.Work(lost, put_in, damped))


def _start(state: State, layout: Layout, scenery: Model, keep: SaveAt, rules: SolverParams) -> WorldState:
    bodies = []
    for run, first in moving(layout):
        of = slots_of(state, first, run.count, pad_groups(run.count))
        nothing = Motion(jnp.zeros_like(of.position), jnp.zeros_like(of.angle))
        bodies.append(BodyState(of.position, of.angle, Motion(of.velocity, of.angular_velocity), nothing))
    return WorldState(
        bodies=bodies,
        time=jnp.zeros((), state.angle.dtype),
        contacts=scenery.contacts.start(keep.contacts),
        ties=[joint_forces.zero_impulses(tied) for tied in scenery.ties],
        pushes=None if scenery.linkage is None else rigid_joints.zero_impulses(scenery.linkage),
        ledger=_energy_budget(bodies, scenery, rules) if keep.energy else None,
    )


def _sums(world: WorldState, scenery: Model) -> tuple | None:
    if world.ledger is None:
        return None
    fixed = [BodyState(*f.at(world.time), f.still) for f in scenery.fixed]
    springs = joint_forces.springs_energy(scenery.ties, world.bodies, fixed)
    springs = springs + jnp.zeros_like(scenery.gravity[0])
    now = energy_module.balance(scenery.groups, world.bodies, scenery.gravity, springs)
    return now, energy_module.close_balance(world.ledger, springs)


def _energy(first: tuple, later: tuple) -> Energy:
    now, book = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), first, later)
    kinetic, rotational, potential, linear, angular = now
    contact, driven, damping = (x - x[:1] for x in book)
    total = kinetic + rotational + potential
    residual = total - total[:1] + contact + damping - driven
    return Energy(kinetic, rotational, potential, contact, damping, driven, residual, linear, angular)


def _states(start: State, bodies: list[BodyState], layout: Layout, times: Array) -> State:
    """All frames of all slots: what moves from the bodies, the rest from the initial state."""
    groups, parts = iter(bodies), []
    times = times[:, None, None]
    for run, first in layout.spans:
        of = slots_of(start, first, run.count)
        if run.kind == DYNAMIC:
            body = next(groups)
            later = State(body.position, body.angle, *body.motion)
            later = jax.tree.map(lambda x, run=run: x[..., : run.count, :], later)
        else:
            moves = of.velocity, of.angular_velocity
            if run.kind == STATIC:
                moves = jax.tree.map(jnp.zeros_like, moves)
            way = times[:, None] * moves[0], times * moves[1]
            moves = (jnp.broadcast_to(x, w.shape) for x, w in zip(moves, way, strict=True))
            later = State(of.position + way[0], of.angle + way[1], *moves)
        parts.append(jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), of, later))
    return jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *parts)


def _hook(scene: Scene, start: State, layout: Layout, forces: Forces | None) -> Callable | None:
    """From bodies and time to force and torque on each group; None where there are none."""
    force, torque, mine = scene.objects.force, scene.objects.torque, moving(layout)
    if forces is None and force is None and torque is None:
        return None
    force = jnp.zeros_like(start.position) if force is None else force
    torque = jnp.zeros_like(start.angle) if torque is None else torque

    def on_groups(bodies: list[BodyState], time: Array) -> list[tuple[Array, Array]]:
        pushes = force, torque
        if forces is not None:
            now = _states(start, jax.tree.map(lambda x: x[None], bodies), layout, time[None])
            more = forces(jax.tree.map(lambda x: x[-1], now), time)
            pushes = force + more[0], torque + more[1]
        return [slots_of(pushes, first, run.count, pad_groups(run.count)) for run, first in mine]

    return on_groups
