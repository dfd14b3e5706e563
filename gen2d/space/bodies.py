"""Bodies, joints and poses of a scene by hand."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypedDict

import numpy as np

from gen2d.core.enums import DYNAMIC, KINEMATIC, STATIC

KINDS = {"dynamic": DYNAMIC, "static": STATIC, "kinematic": KINEMATIC}
MOST_CORNERS = 8
GREY = (110, 110, 110)  # what does not move of itself
Pair = Sequence[float] | np.ndarray


class BodyOptions(TypedDict, total=False):
    """What every `add_` of a body takes besides its shape."""

    kind: str  # "dynamic", "static" or "kinematic" (moves at its velocity, whatever it meets)
    velocity: Pair  # m/s, of the centre of mass; default 0
    spin: float  # rad/s; default 0
    density: float  # kg/m^2; default 1
    mass: float | None  # kg; default: area times density. Of a dynamic body only, as is the moment
    moment: float | None  # kg m^2; default: of a solid body of this mass; infinite: it does not turn
    elasticity: float  # coefficient of restitution, 0 to 1; default 0. Space(mixing=...) makes one of two
    friction: float  # Coulomb coefficient; default 0.7
    rolling_resistance: float  # torque over normal force and radius; default 0
    color: Sequence[int] | None  # red, green, blue, 0 to 255; default: by number, grey if it is not dynamic
    force: Pair | None  # N, constant, at the centre of mass
    torque: float | None  # N m, constant


@dataclasses.dataclass(frozen=True)
class Body:
    """A body as it is at the start."""

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
    """A joint between two bodies by number; -1 is the world. Anchors are in the bodies' frames."""

    kind: str
    a: int
    b: int
    anchor_a: np.ndarray
    anchor_b: np.ndarray
    collide: bool
    numbers: dict[str, float]


class Overlaps(NamedTuple):
    """Where bodies overlap, a row for each of R points, in order of frames."""

    frame: np.ndarray
    a: np.ndarray  # number of the body that the normal leaves
    b: np.ndarray  # number of the body that the normal enters
    point: np.ndarray  # [R, 2] m
    normal: np.ndarray  # [R, 2], unit
    depth: np.ndarray  # m


class Poses(NamedTuple):
    """Bodies that are where they are told to be; a video as far as it can be drawn."""

    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    position: np.ndarray  # [T, K, 2] m
    angle: np.ndarray  # [T, K] rad
    contacts: Overlaps


class Drawable(Protocol):
    """What can be plotted: bodies and joints, and where they are at T instants."""

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The K bodies, in the order in which they were added."""
        ...

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The joints between them."""
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
    """A drawable whose instants are frames."""

    @property
    def fps(self) -> float:
        """Frames per second."""
        ...
