"""Records that the contact solver hands from pass to pass and from step to step."""

from typing import NamedTuple

from gen2d.physics.collision import Shape
from gen2d.physics.constraint import ActiveContact, Impulse, Motion
from gen2d.physics.energy import Work
from gen2d.physics.support import Obstacles, Support
from gen2d.records.axes import Array


class PassSetup(NamedTuple):
    """Inputs of the passes that are constant over a video."""

    gravity: Array  # [2, 1, ...] m/s^2
    threshold: Array  # [...] m/s: slower impacts do not bounce
    log: bool  # whether contacts store their positions


class BodySide(NamedTuple):
    """Bodies on one side of a batch of contacts; values that a pass does not need are None."""

    shape: Shape | None = None  # in the world
    motion: Motion | None = None  # None: static bodies at rest
    acceleration: Array | None = None  # [2, N, ...] m/s^2; None: gravity's
    pull: Array | None = None  # [2, N, ...] m/s^2: of springs, in the first pass; None: no springs
    drift: Motion | None = None  # m, rad: displacement beyond h times the new velocity, as impulses act at their time
    displacement: Motion | None = None  # m, rad: where the impulses of a pass act; None: of static bodies
    resting: Motion | None = None  # m/s, rad/s: what contacts at rest have added in the step; None: discs, static
    push: Array | None = None  # [N, ...] m/s: bound on what warm starting added; None: not discs
    pending: Motion | None = None  # m/s, rad/s: what static bodies are to take up (support.py); None: in other passes
    work: Work | None = None
    schur: Array | None = None  # [6, N, ...] what rigid joints take from the inverse mass (jointed.py)
    joint_motion: Motion | None = None  # m/s, rad/s: what they take from the motion in a pass
    joint_drift: Motion | None = None  # m, rad: what they take from the drift
    support: Support | None = None  # None: static bodies, and after the first pass
    obstacles: Obstacles | None = None  # None: static bodies, and but for the first pass
    first: Array | None = None  # [N, ...] s: least time of impact of a body in the step; infinite without one
    clock: Array | None = None  # [N, ...] s: of a body's last impact in the step so far; 0 without one
    clearance: Array | None = None  # [N, ...] m: least way that leads a body to what it has met in the pass so far
    late: Array | None = None  # [N, ...] whether its scene takes more passes (relaxing.py); None: all scenes alike


class WarmStart(NamedTuple):
    """Impulses of a contact that the next step starts with."""

    impulses: list[Impulse]  # at its points; see `warm_start_impulses`
    roll: Array | None  # N m s, against rolling


class SolvedPair(NamedTuple):
    """A contact before or after a pass."""

    contacts: list[ActiveContact]
    impulses: list[Impulse]
    roll: Array | None
    vectors: Impulse | None = None  # N s [2, ...]: those of a logged round contact, where its normal changes by pass


class RelaxedPair(NamedTuple):
    """A contact after a relaxing pass."""

    pair: SolvedPair
    warm: WarmStart  # what the next step starts with
    began: Array  # whether a contact began in this step, as a bounce does
