"""What is known of a family's slots before anything is sampled."""

import dataclasses
import itertools

import numpy as np

from gen2d.core.enums import DYNAMIC, STATIC


@dataclasses.dataclass(frozen=True)
class SlotGroup:
    """Some slots in a row that hold one shape: "circle", "segment", "capsule" or "polygon"."""

    shape: str
    count: int
    kind: int = DYNAMIC
    vertices: int = 0  # of each polygon, at most
    rounded: bool = False  # whether polygons have a radius
    layer: int | None = None  # lower layers are drawn first; None: 0 for static objects, 1 for those that move
    collides: bool = True  # False: it is drawn, and joints may hold on to it, but it meets nothing

    @property
    def painted(self) -> int:
        """The layer that it is drawn in."""
        return (0 if self.kind == STATIC else 1) if self.layer is None else self.layer


@dataclasses.dataclass(frozen=True)
class JointSpec:
    """A joint between two slots: "distance" or "revolute"; the two do not collide unless they shall."""

    kind: str
    a: int
    b: int
    collide: bool = False


@dataclasses.dataclass(frozen=True)
class Layout:
    """What is known of a family's slots before anything is drawn.

    `bounds` is the part of the world worth seeing: (left, bottom, right, top) in metres.
    `reach` is the largest distance from the centre of a moving object to its rim, in metres.
    """

    runs: tuple[SlotGroup, ...]
    bounds: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    reach: float = 1.0
    joints: tuple[JointSpec, ...] = ()

    @property
    def slots(self) -> int:
        """The length of the axis K."""
        return sum(run.count for run in self.runs)

    @property
    def spans(self) -> tuple[tuple[SlotGroup, int], ...]:
        """Each run and its first slot."""
        starts = itertools.accumulate((run.count for run in self.runs), initial=0)
        return tuple(zip(self.runs, starts, strict=False))

    @property
    def painted(self) -> tuple[tuple[SlotGroup, int], ...]:
        """The same from back to front: lower layers first, slots of one layer in their order."""
        return tuple(sorted(self.spans, key=lambda span: (span[0].painted, span[1])))

    @property
    def depths(self) -> np.ndarray:
        """Each slot's place in the drawing order, [K] int16, 0 is farthest back: what `objects/depth` holds."""
        order = [slot for run, first in self.painted for slot in range(first, first + run.count)]
        return np.argsort(order).astype(np.int16)
