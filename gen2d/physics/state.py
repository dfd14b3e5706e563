"""Bodies, groups, static bodies and the state that the solver carries between steps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gen2d.physics import limits_motors, rigid_joints, springs
from gen2d.physics.collision import Shape
from gen2d.physics.constraint import Inertia, Motion
from gen2d.physics.energy import Ledger
from gen2d.physics.shapes import BodyShape, to_world
from gen2d.physics.solver_protocol import ContactSolver
from gen2d.physics.tunnelling import Barrier
from gen2d.records.axes import Array


class BodyState(NamedTuple):
    """State of some moving bodies."""

    position: Array  # [2, N, ...] m
    angle: Array  # [N, ...] rad
    motion: Motion
    remainder: Motion | None = None  # m, rad: what rounding has kept back of the displacements so far


class BodyGroupState(NamedTuple):
    """Constants of a slot group of moving bodies; an empty slot has neither mass nor inverse mass."""

    body_shape: BodyShape
    inverse: Inertia
    mass: Array  # [N, ...] kg
    moment: Array  # [N, ...] kg m^2
    collides: bool = True  # whether they collide with anything
    jointed: np.ndarray | None = None  # [N, 1] whether a joint holds a body; None: no joints


class StaticBody(NamedTuple):
    """A static or kinematic body at the start; the motion of a static one is None."""

    body_shape: BodyShape
    position: Array  # [2, 1, ...] m
    angle: Array  # [1, ...] rad
    motion: Motion | None
    shape: Shape  # in the world at the start

    def at(self, time: Array) -> BodyState:
        """State at a time."""
        if self.motion is None:
            rest = Motion(jnp.zeros_like(self.position), jnp.zeros_like(self.angle))
            return BodyState(self.position, self.angle, rest)
        position, angle = self.position + time * self.motion.velocity, self.angle + time * self.motion.spin
        return BodyState(position, angle, self.motion)

    def shape_at(self, now: BodyState) -> Shape:
        """Shape in the world in a state."""
        return self.shape if self.motion is None else to_world(self.body_shape, now.position, now.angle)


class Model(NamedTuple):
    """Constants of a video."""

    groups: list[BodyGroupState]
    statics: list[StaticBody]
    barriers: list[Barrier]  # of static bodies at rest
    gravity: Array  # [2, ...] m/s^2
    solver: ContactSolver
    springs: list[springs.JointBatch]
    joint_system: rigid_joints.JointSystem | None
    limit_system: limits_motors.LimitSystem | None
    forces: Callable | None  # (bodies, time) -> for each group force [2, N, ...] N and torque [N, ...] N m
    one: Array  # see `xla.runtime_one`


class WorldState(NamedTuple):
    """State carried between steps."""

    bodies: list[BodyState]
    time: Array  # s
    contacts: Any  # carry of the contact solver
    twists: Array | None  # N m s [H, ...]: of limits and motors in the last step
    ledger: Ledger | None
