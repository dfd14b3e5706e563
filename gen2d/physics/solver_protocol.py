"""The contract of the contact solvers."""

from collections.abc import Callable
from typing import Any, Protocol

from gen2d.physics.contact_state import BodySide
from gen2d.records.axes import Array
from gen2d.records.trajectory import Contacts


class ContactSolver(Protocol):
    """Sequential impulses over all contacts of a video, in the three passes of a step.

    `sides` are the groups of moving bodies, `statics` the static and kinematic bodies. The carry, the values that one
    pass hands to the next and a frame's events belong to the solver; its callers only pass them on.
    """

    def start(self, slots: int) -> Any:
        """Carry before the first step; `slots` rows are reserved for logged contacts."""
        ...

    def allocate(self, carry: Any, step: Callable[[Any], Any]) -> Any:
        """Carry with the buffers that `step`, from carry to carry, fills."""
        ...

    def begin_frame(self, carry: Any) -> Any:
        """Carry at the start of a frame."""
        ...

    def warm_start(
        self, carry: Any, sides: list[BodySide], statics: list[BodySide], pulls: list[Array] | None
    ) -> tuple[list[BodySide], Any]:
        """Sides with the impulses of the last step, and the contacts; uses shape, motion, acceleration and work.

        `pulls` [N, ...] are bounds, m/s, on what springs will add to the speeds of each group.
        """
        ...

    def solve(
        self, carry: Any, contacts: Any, sides: list[BodySide], statics: list[BodySide]
    ) -> tuple[list[BodySide], Any]:
        """Sides after the first pass, and the solved contacts; uses motion, drift, resting, push, pending and work."""
        ...

    def relax(
        self,
        carry: Any,
        solved: Any,
        sides: list[BodySide],
        statics: list[BodySide],
        time: Array,
        clamp: Callable[..., list[BodySide]],
    ) -> tuple[list[BodySide], Any]:
        """Sides after the relaxing passes of the step that began at `time`, and the carry.

        Uses motion, displacement, resting, push, work and late. Where late impacts have displaced sides of all scenes,
        or of some, `clamp(sides)` or `clamp(sides, scenes)` returns them with displacements that nothing forbids.
        """
        ...

    def end_frame(self, carry: Any) -> tuple[Any, Any]:
        """Carry at the end of a frame, and the frame's events."""
        ...

    def results(self, carry: Any, events: Any, slots: int, fps: float) -> tuple[Array, Array, Contacts | None]:
        """Deepest overlap in m [n], number of contacts that began [n], and up to `slots` logged contacts of a video."""
        ...
