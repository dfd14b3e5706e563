"""Simulation of a scene from its initial state, which is frame 0; frame t is at t / fps."""

import dataclasses
import math
import operator
from collections.abc import Callable

import jax
import jax.numpy as jnp

from gen2d.core.enums import DYNAMIC, STATIC
from gen2d.core.errors import ConfigError
from gen2d.physics import limits_motors, springs
from gen2d.physics.constraint import Motion
from gen2d.physics.energy import Ledger, Work, balance, close_balance
from gen2d.physics.params import SolverParams
from gen2d.physics.setup import build_model, dynamic_groups, padded_size, slots_of, without_empty
from gen2d.physics.state import BodyState, Model, WorldState
from gen2d.physics.step import step
from gen2d.records.axes import Array, check_shapes
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Energy, Quality, Trajectory
from gen2d.xla import runtime_one

MOST_STEPS = 10_000  # a frame
Forces = Callable[[State, Array], tuple[Array, Array]]


def substeps(fps: float, asked: int | None, max_step: float) -> int:
    """Steps per frame: as asked, else the smallest number whose steps are at most `max_step` seconds long.

    Raises ConfigError if there are more than MOST_STEPS.
    """
    steps = asked or max(1, operator.index(math.ceil(1 / (fps * max_step) - 1e-9)))
    if steps > MOST_STEPS:
        raise ConfigError(f"video.fps is {fps:g}, which takes {steps:,} steps a frame, but {MOST_STEPS:,} is the most")
    return steps


@dataclasses.dataclass(frozen=True)
class SaveAt:
    """What a trajectory holds beyond the states."""

    contacts: int = 0  # slots for logged contacts; 0: none
    energy: bool = False
    between: bool = False  # whether to keep the states after every step


def simulate(
    scene: Scene,
    state: State,
    layout: Layout,
    params: SolverParams,
    frames: int,
    steps: int,
    keep: SaveAt = SaveAt(),
    forces: Forces | None = None,
    sparse: bool = False,
) -> Trajectory:
    """Trajectory of `frames` frames, `steps` steps apart, of any number of scenes at once, in the device layout.

    Scene and state have bodies before scenes: position [2, K, n] in m, angle [K, n] in rad, and so on; the result has
    frames first: position [T, 2, K, n]. Values in empty slots are ignored and come back as zeros.
    `forces(state, time)` returns a force [2, K, n] in N and a torque [K, n] in N m on every slot, in every step.
    `sparse` solves only near pairs (nearby_pairs.py): as exact, on a CPU much faster, but without a reverse-mode
    gradient. Raises AssertionError for records of another layout.
    """
    for record in (scene, state):
        check_shapes(record, absent="T", device=True, K=layout.slots, J=len(layout.joints))
    scene, state = without_empty(scene, state)
    hook = _group_forces(scene, state, layout, forces)
    model = build_model(scene, state, layout, params, hook, keep.contacts > 0, sparse)
    solver, seconds = model.solver, steps * params.step

    def substep(world: WorldState, _: None) -> tuple[WorldState, list[BodyState]]:
        world = step(world, model, params)
        return world, _bodies(world)

    def frame(world: WorldState, number: Array) -> tuple[WorldState, tuple]:
        world = world._replace(time=number * seconds, contacts=solver.begin_frame(world.contacts))
        if keep.between:
            world, every = jax.lax.scan(substep, world, length=steps)
        else:
            world, every = jax.lax.fori_loop(0, steps, lambda _, now: step(now, model, params), world), None
        carry, events = solver.end_frame(world.contacts)
        return world._replace(contacts=carry), (_bodies(world), every, _balance(world, model), events)

    with runtime_one(model.one):
        start = _start(state, layout, model, keep, params)
        contacts = solver.allocate(
            start.contacts, lambda carry: step(start._replace(contacts=carry), model, params).contacts
        )
        start = start._replace(contacts=contacts)
        numbers = jnp.arange(frames - 1, dtype=state.angle.dtype)
        last, (bodies, every, balances, events) = jax.lax.scan(frame, start, numbers)
        between = None if every is None else _substep_states(state, every, layout, params.step)
        states = _states(state, bodies, layout, numbers * seconds + seconds)
        first = _balance(start, model)
        energy = None if first is None else _energy(first, balances)
        residual = None if energy is None else jnp.max(jnp.abs(energy.residual), axis=0)
        depth, begins, contacts = solver.results(last.contacts, events, keep.contacts, 1 / seconds)
    return Trajectory(states, Quality(depth, begins, residual), contacts, energy, between)


def _bodies(world: WorldState) -> list[BodyState]:
    """Bodies as stored, without the remainders of their positions."""
    return [body._replace(remainder=None) for body in world.bodies]


def _substep_states(start: State, every: list[BodyState], layout: Layout, step: float) -> State:
    """States [T - 1, steps, ...] at the ends of steps, from bodies likewise."""
    frames, steps = every[0].angle.shape[:2]
    bodies = jax.tree.map(lambda x: x.reshape(frames * steps, *x.shape[2:]), every)
    states = _states(start, bodies, layout, (jnp.arange(frames * steps, dtype=start.angle.dtype) + 1) * step)
    return jax.tree.map(lambda x: x[1:].reshape(frames, steps, *x.shape[1:]), states)


def _start(state: State, layout: Layout, model: Model, keep: SaveAt, params: SolverParams) -> WorldState:
    bodies, ledger = [], None
    for group, first in dynamic_groups(layout):
        own = slots_of(state, first, group.count, padded_size(group.count))
        zero = Motion(jnp.zeros_like(own.position), jnp.zeros_like(own.angle))
        bodies.append(BodyState(own.position, own.angle, Motion(own.velocity, own.angular_velocity), zero))
    time, contacts = jnp.zeros((), state.angle.dtype), model.solver.start(keep.contacts)
    system = model.joint_system
    if keep.energy:
        driven = model.forces is not None or any(f.motion is not None for f in model.statics)
        works = []
        for body in bodies:
            zero = jnp.zeros_like(body.angle)
            works.append(Work(zero, zero if driven else None, zero if params.damping else None))
        by_joints = None if system is None else Work(*[jnp.zeros_like(system.rest[..., :1, :])] * 3)
        ledger = Ledger(works, by_joints)
    twists = limits_motors.zero_twists(model.limit_system)
    return WorldState(bodies, time, contacts, twists, ledger)


def _balance(world: WorldState, model: Model) -> tuple | None:
    """Energies and momenta of all bodies, and the closed ledger; None without one."""
    if world.ledger is None:
        return None
    statics = [body.at(world.time) for body in model.statics]
    stored = springs.springs_energy(model.springs, world.bodies, statics) + jnp.zeros_like(model.gravity[0])
    return balance(model.groups, world.bodies, model.gravity, stored), close_balance(world.ledger, stored)


def _energy(first: tuple, later: tuple) -> Energy:
    now, ledger = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), first, later)
    kinetic, rotational, potential, linear, angular = now
    contact, driven, damping = (x - x[:1] for x in ledger)
    total = kinetic + rotational + potential
    residual = total - total[:1] + contact + damping - driven
    return Energy(kinetic, rotational, potential, contact, damping, driven, residual, linear, angular)


def _states(start: State, bodies: list[BodyState], layout: Layout, times: Array) -> State:
    """States of all slots at frame 0 and at later times: of moving bodies as given, of others in closed form."""
    groups, parts = iter(bodies), []
    times = times[:, None, None]
    for group, first in layout.spans:
        own = slots_of(start, first, group.count)
        if group.kind == DYNAMIC:
            body = next(groups)
            later = State(body.position, body.angle, *body.motion)
            later = jax.tree.map(lambda x, group=group: x[..., : group.count, :], later)
        else:
            motion = own.velocity, own.angular_velocity
            if group.kind == STATIC:
                motion = jax.tree.map(jnp.zeros_like, motion)
            moved = times[:, None] * motion[0], times * motion[1]
            motion = (jnp.broadcast_to(x, m.shape) for x, m in zip(motion, moved, strict=True))
            later = State(own.position + moved[0], own.angle + moved[1], *motion)
        parts.append(jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), own, later))
    return jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *parts)


def _group_forces(scene: Scene, start: State, layout: Layout, forces: Forces | None) -> Callable | None:
    """Function from bodies and time to force and torque on each group; None without forces."""
    force, torque, groups = scene.objects.force, scene.objects.torque, dynamic_groups(layout)
    if forces is None and force is None and torque is None:
        return None
    force = jnp.zeros_like(start.position) if force is None else force
    torque = jnp.zeros_like(start.angle) if torque is None else torque

    def on_groups(bodies: list[BodyState], time: Array) -> list[tuple[Array, Array]]:
        total = force, torque
        if forces is not None:
            now = _states(start, jax.tree.map(lambda x: x[None], bodies), layout, time[None])
            more = forces(jax.tree.map(lambda x: x[-1], now), time)
            total = force + more[0], torque + more[1]
        return [slots_of(total, first, group.count, padded_size(group.count)) for group, first in groups]

    return on_groups
