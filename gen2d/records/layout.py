"""Layouts: the slots and joints of a scene family, fixed before any video is sampled."""

import dataclasses
import itertools

import numpy as np

from gen2d.core.enums import DYNAMIC, JOINT_KINDS, STATIC


@dataclasses.dataclass(frozen=True)
class SlotGroup:
    """Consecutive slots of one shape: "circle", "segment", "capsule" or "polygon"."""

    shape: str
    count: int
    kind: int = DYNAMIC
    vertices: int = 0  # per polygon, at most
    rounded: bool = False  # whether polygons have a radius
    layer: int | None = None  # lower layers are rendered first; None: 0 for static objects, 1 for others
    collides: bool = True  # False: rendered, and joints may attach to it, but without contacts


@dataclasses.dataclass(frozen=True)
class JointSpec:
    """A joint between slots `a` and `b`: "distance" or "revolute". The two bodies collide only if `collide`.

    The slots count the objects of all groups of the layout, from 0. A revolute joint that is not `limited` has neither
    limits nor a motor, and takes less time to simulate.
    """

    kind: str
    a: int
    b: int
    collide: bool = False
    limited: bool = True

    def __post_init__(self) -> None:
        assert self.kind in JOINT_KINDS, f"a joint is {self.kind!r}, but must be one of {', '.join(JOINT_KINDS)}"


@dataclasses.dataclass(frozen=True)
class Layout:
    """Slots, joints and bounds of a scene family, the same for all videos of a config.

    groups: groups of slots, in slot order.
    bounds: region of the world that the default camera shows, (left, bottom, right, top) in m.
    reach: largest distance from the centre of a moving object to its outline, m.
    """

    groups: tuple[SlotGroup, ...]
    bounds: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    reach: float = 1.0
    joints: tuple[JointSpec, ...] = ()

    def __post_init__(self) -> None:
        for joint in self.joints:
            ends = {joint.a, joint.b} & set(range(self.slots))
            assert len(ends) == 2, f"{joint} must connect two of the layout's slots, 0 to {self.slots - 1}"

    @property
    def slots(self) -> int:
        """Number of slots, the length of the axis K."""
        return sum(group.count for group in self.groups)

    @property
    def spans(self) -> tuple[tuple[SlotGroup, int], ...]:
        """Each group of slots with its first slot."""
        starts = itertools.accumulate((group.count for group in self.groups), initial=0)
        return tuple(zip(self.groups, starts, strict=False))

    @property
    def exempt(self) -> frozenset[frozenset[int]]:
        """Pairs of slots that do not collide, as a joint connects them."""
        return frozenset(frozenset((joint.a, joint.b)) for joint in self.joints if not joint.collide)

    @property
    def back_to_front(self) -> tuple[tuple[SlotGroup, int], ...]:
        """The groups of `spans` in rendering order: by layer, then by slot."""

        def order(span: tuple[SlotGroup, int]) -> tuple[int, int]:
            group, first = span
            return int(group.kind != STATIC) if group.layer is None else group.layer, first

        return tuple(sorted(self.spans, key=order))

    @property
    def depths(self) -> np.ndarray:
        """Rank of each slot in the rendering order, int16 [K], 0 farthest back; stored as `objects/depth`."""
        order = [slot for group, first in self.back_to_front for slot in range(first, first + group.count)]
        return np.argsort(order).astype(np.int16)

    @property
    def later_links(self) -> np.ndarray:
        """Mask [K] of the links of chains but the first of each: capsules that are joined to the slot before them, of
        the same group."""
        joined = {(min(joint.a, joint.b), max(joint.a, joint.b)) for joint in self.joints}
        return np.asarray(
            [
                group.shape == "capsule" and slot > first and (slot - 1, slot) in joined
                for group, first in self.spans
                for slot in range(first, first + group.count)
            ],
            bool,
        )
