"""Arrangement of a space's bodies in slots, and the compiled program of their layout."""

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.core.enums import DYNAMIC
from gen2d.physics.collision import manifold
from gen2d.physics.params import SolverParams
from gen2d.physics.shapes import body_shape_of, to_world
from gen2d.physics.simulate import Forces, SaveAt, simulate
from gen2d.programs.shared import cached_jit
from gen2d.records.axes import to_device, to_stored
from gen2d.records.layout import Layout, SlotGroup
from gen2d.records.scene import Objects, Scene, State
from gen2d.records.trajectory import Contacts
from gen2d.space.bodies import GREY, Body
from gen2d.xla import on_cpu


def slots_of_span(span: tuple[SlotGroup, int]) -> range:
    """Slots of a group that starts at a slot."""
    return range(span[1], span[1] + span[0].count)


def shape_family(body: Body) -> str:
    """Shape of the slot group that holds a body; a segment counts as a capsule, whose radius may be 0."""
    return "capsule" if body.shape == "segment" else body.shape


def slot_order(body: Body) -> tuple:
    """Sort key of slots: kind, shape and, unless the body is dynamic, number of corners.

    Bodies with equal keys share a slot group.
    """
    corners = 0 if body.kind == DYNAMIC else len(body.vertices)
    return body.kind, ("circle", "capsule", "polygon").index(shape_family(body)), corners


def pad_vertices(vertices: np.ndarray, corners: int) -> np.ndarray:
    """Corners [corners, 2], padded with copies of the last; zeros if there are none."""
    if not len(vertices):
        return np.zeros((corners, 2))
    return np.concatenate([vertices, np.repeat(vertices[-1:], corners - len(vertices), axis=0)])


def world_anchor(shape: str) -> Body:
    """Body without extent at the origin, to which joints with the world are attached."""
    zero, none = np.zeros(2), np.zeros((0, 2))
    return Body(
        shape=shape, kind=DYNAMIC, position=zero, angle=0.0, velocity=zero, spin=0.0, radius=0.0, half_length=0.0,
        vertices=none, mass=math.inf, moment=math.inf, elasticity=0.0, friction=0.0, rolling_resistance=0.0, color=GREY,
        force=zero, torque=0.0,
    )  # fmt: skip


@functools.partial(jax.jit, static_argnums=0)
def closest_points(
    groups: tuple[SlotGroup, SlotGroup], objects: Objects, sides: Sequence[jax.Array], poses: Sequence
) -> list[tuple]:
    """Gap, point and normal of the closest points of pairs of bodies.

    `sides` are the slots of each pair in the two groups, `poses` the positions and angles of these.
    """
    shapes = (body_shape_of(objects, group, side) for group, side in zip(groups, sides, strict=True))
    a, b = (to_world(shape, *pose) for shape, pose in zip(shapes, poses, strict=True))
    return [(point.gap, a.centre + point.arm_a, point.normal) for point in manifold(a, b)]


@functools.lru_cache(maxsize=8)  # a program takes up to thousands of memory maps, of which a process has some 60,000
def compiled_program(
    layout: Layout, params: SolverParams, frames: int, steps: int, keep: SaveAt, forces: Any, x64: bool
) -> Callable:
    """Compiled simulation of a layout; scenes, states and trajectories have the videos first.

    It is kept on disk, unless it holds forces, which are a function of the user's.
    """
    hook = None if forces is None else _slot_forces(*forces)

    def run(scene: Scene, state: State) -> Any:
        device = to_device(scene), to_device(state)
        return to_stored(simulate(*device, layout, params, frames, steps, keep, hook, on_cpu()))

    return cached_jit(run, None if forces else (layout, params, frames, steps, keep), x64=x64)


def _slot_forces(forces: Callable, slots: tuple[int, ...]) -> Forces:
    """Forces on slots, as the solver expects them, from a function of forces on bodies by number."""
    order = np.array(slots)

    def hook(state: State, time: jax.Array) -> tuple[jax.Array, jax.Array]:
        body_state = jax.tree.map(lambda x: jnp.moveaxis(x[..., order, 0], 0, -1), state)
        force, torque = forces(body_state, time)
        zeros = jnp.zeros_like(state.position), jnp.zeros_like(state.angle)
        return zeros[0].at[:, order, 0].set(jnp.asarray(force).T), zeros[1].at[order, 0].set(torque)

    return hook


def body_numbers(slots: np.ndarray, count: int) -> np.ndarray:
    """Number of the body in each slot; -1 for the world's."""
    numbers = np.full(count, -1)
    numbers[slots] = np.arange(len(slots))
    return numbers


def filled_contacts(contacts: Contacts, slots: np.ndarray, count: int) -> Contacts:
    """Filled rows of contacts, with bodies by number; warns if rows are missing for lack of room."""
    total, capacity = int(contacts.count), contacts.time.shape[0]
    if total > capacity:
        warnings.warn(
            f"simulate: there were {total} rows of contacts, but contacts={capacity} keeps only so many", stacklevel=3
        )
    names = [f.name for f in dataclasses.fields(contacts) if f.name != "count"]
    rows = {name: getattr(contacts, name)[:total] for name in names}
    numbers = body_numbers(slots, count)
    return Contacts(**rows | {"a": numbers[rows["a"]], "b": numbers[rows["b"]], "count": contacts.count})
