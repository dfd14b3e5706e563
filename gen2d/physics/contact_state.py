"""What contacts hand from pass to pass and from step to step."""

from typing import NamedTuple

from gen2d.physics.constraint import ActiveContact, Impulse, Motion
from gen2d.records.axes import Array


class PassSetup(NamedTuple):
    """What the passes need to know of a video."""

    gravity: Array  # [2, 1, ...] m/s^2
    threshold: Array  # [...] m/s: slower impacts do not bounce
    contacts: bool  # whether touches shall say where they are


class Displacement(NamedTuple):
    """What a pass changes in where a body goes, beyond its new velocity."""

    way: Motion  # m, rad: impacts act at their time, not at the start of the step
    push: Array  # [N, ...] m/s: what pushing overlaps apart may have added to its speed; 0: no contact holds it


class WarmStart(NamedTuple):
    """What a row leaves to the next step."""

    impulses: list[Impulse]  # at its points; `kept` says what of them counts
    roll: Array | None  # N m s, against rolling


class SolvedPair(NamedTuple):
    """A row before or after a pass."""

    touches: list[ActiveContact]
    impulses: list[Impulse]
    roll: Array | None
