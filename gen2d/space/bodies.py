"""Bodies, joints and poses of a `Space`."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypedDict

import numpy as np

from gen2d.core.enums import DYNAMIC, KINEMATIC, STATIC

KINDS = {"dynamic": DYNAMIC, "static": STATIC, "kinematic": KINEMATIC}
MOST_CORNERS = 8
GREY = (110, 110, 110)  # of static and kinematic bodies
Pair = Sequence[float] | np.ndarray


class BodyOptions(TypedDict, total=False):
    """Options of all methods of `Space` that add a body."""

    kind: str  # "dynamic", "static" or "kinematic" (moves at its velocity, whatever it touches)
    velocity: Pair  # m/s, of the centre of mass; default 0
    spin: float  # rad/s; default 0
    density: float  # kg/m^2; default 1
    mass: float | None  # kg; default: area times density. Dynamic bodies only, as is the moment
    moment: float | None  # kg m^2; default: that of a solid body of this mass; infinite: no rotation
    elasticity: float  # coefficient of restitution, 0 to 1; default 0. Space(mixing=...) combines those of two bodies
    friction: float  # Coulomb coefficient; default 0.7
    rolling_resistance: float  # torque over normal force and radius; default 0
    color: Sequence[int] | None  # red, green, blue, 0 to 255; default: by number, grey if not dynamic
    force: Pair | None  # N, constant, at the centre of mass
    torque: float | None  # N m, constant


@dataclasses.dataclass(frozen=True)
class Body:
    """A body in its initial state."""

    shape: str
    position: np.ndarray  # [2] m, of the centre of mass
    angle: float  # rad
    kind: int
    radius: float  # m
    half_length: float  # m
    vertices: np.ndarray  # [V, 2] m, from the centre of mass, counter-clockwise
    velocity: np.ndarray  # [2] m/s
    spin: float
    mass: float
    moment: float
    elasticity: float
    friction: float
    rolling_resistance: float
    color: tuple[int, int, int]
    force: np.ndarray
    torque: float


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint between two bodies by number, where -1 is the world; anchors are in the bodies' frames."""

    kind: str
    a: int
    b: int
    anchor_a: np.ndarray
    anchor_b: np.ndarray
    collide: bool
    numbers: dict[str, float]

    @property
    def limited(self) -> bool:
        """Whether it has a limit or a motor."""
        limits = self.numbers["lower"], self.numbers["upper"]
        return any(map(math.isfinite, limits)) or self.numbers["motor_torque"] > 0


def hinge_gap(joints: Sequence[Joint], position: np.ndarray, angle: np.ndarray) -> float:
    """Largest distance in m of the anchors of a hinge, of bodies at `position` [T, K, 2] and `angle` [T, K]."""

    def anchor(body: int, point: np.ndarray) -> np.ndarray:
        if body < 0:
            return np.broadcast_to(point, position[:, 0].shape)
        cos, sin = np.cos(angle[:, body]), np.sin(angle[:, body])
        turned = np.stack([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]], axis=-1)
        return position[:, body] + turned

    hinges = [joint for joint in joints if joint.kind == "revolute"]
    gaps = [anchor(joint.a, joint.anchor_a) - anchor(joint.b, joint.anchor_b) for joint in hinges]
    return float(np.max(np.linalg.norm(gaps, axis=-1))) if gaps else 0.0


class Overlaps(NamedTuple):
    """Overlaps of bodies, a row for each of R points, ordered by frame."""

    frame: np.ndarray
    a: np.ndarray  # number of the body that the normal leaves
    b: np.ndarray  # number of the body that the normal enters
    point: np.ndarray  # [R, 2] m
    normal: np.ndarray  # [R, 2], unit
    depth: np.ndarray  # m


class Poses(NamedTuple):
    """Bodies at given positions and angles, with their overlaps; can be plotted like a video."""

    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    position: np.ndarray  # [T, K, 2] m
    angle: np.ndarray  # [T, K] rad
    contacts: Overlaps


class Drawable(Protocol):
    """Anything that can be plotted: bodies and joints with their poses at T instants."""

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The K bodies, in the order in which they were added."""
        ...

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Joints between the bodies."""
        ...

    @property
    def position(self) -> np.ndarray:
        """Centres of mass, [T, K, 2] m."""
        ...

    @property
    def angle(self) -> np.ndarray:
        """Angles, [T, K] rad."""
        ...

    @property
    def contacts(self) -> Any:
        """Contact rows: arrays `frame`, `a`, `b`, `point` and `normal`."""
        ...


class Film(Drawable, Protocol):
    """A drawable with a frame rate."""

    @property
    def fps(self) -> float:
        """Frames per second."""
        ...
