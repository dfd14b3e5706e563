"""Bodies, groups, static bodies and the state that the solver carries between steps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from gen2d.physics import joint_forces, rigid_joints
from gen2d.physics.collision import Shape, Stadium
from gen2d.physics.constraint import Inertia, Motion
from gen2d.physics.energy import Ledger
from gen2d.physics.shapes import BodyShape, to_world
from gen2d.records.axes import Array


class BodyState(NamedTuple):
    """Some moving bodies as they are now."""

    position: Array  # [2, N, ...] m
    angle: Array  # [N, ...] rad
    motion: Motion
    rest: Motion | None = None  # m, rad: what rounding has kept back of the ways so far


class BodyGroupState(NamedTuple):
    """What stays the same of the moving bodies of one run; an empty slot has no mass, and no inverse of it."""

    form: BodyShape
    inverse: Inertia
    mass: Array  # [N, ...] kg
    moment: Array  # [N, ...] kg m^2
    collides: bool = True  # whether they meet anything


class StaticBody(NamedTuple):
    """A body that nothing can push, at the start. `motion` is None where it stands still."""

    form: BodyShape
    position: Array  # [2, 1, ...] m
    angle: Array  # [1, ...] rad
    motion: Motion | None
    shape: Shape  # as it lies at the start

    @property
    def still(self) -> Motion:
        """Its motion, zero where it stands still."""
        return self.motion or Motion(jnp.zeros_like(self.position), jnp.zeros_like(self.angle))

    def at(self, time: Array) -> tuple[Array, Array]:
        """Where it is by then."""
        if self.motion is None:
            return self.position, self.angle
        return self.position + time * self.motion.velocity, self.angle + time * self.motion.spin

    def shape_at(self, now: BodyState) -> Shape:
        """Its shape where it is now."""
        return self.shape if self.motion is None else to_world(self.form, now.position, now.angle)


class Model(NamedTuple):
    """What stays the same for a whole video."""

    groups: list[BodyGroupState]
    fixed: list[StaticBody]
    rails: list[Stadium]  # fixed segments that stand still; where there is none, of negative length
    gravity: Array  # [2, ...] m/s^2
    contacts: Any  # how pairs are solved: Dense or Sparse
    ties: list[joint_forces.JointBatch]
    linkage: rigid_joints.JointSystem | None
    forces: Callable | None  # (bodies, time) -> for each group force [2, N, ...] N and torque [N, ...] N m
    one: Array  # see `xla.runtime_one`


class WorldState(NamedTuple):
    """All that changes from one step to the next."""

    bodies: list[BodyState]
    time: Array  # s
    contacts: Any  # what the contacts hand on from step to step
    ties: list[Any]  # of each round of joints: its impulses
    pushes: Array | None  # of the linkage's rows
    ledger: Ledger | None
