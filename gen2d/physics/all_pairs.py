"""Every row in every step: all pairs that can meet, round by round (tournament.py), whether they are near or not.

No branch, no gather: what a GPU likes, and what has a gradient. The work grows with the square of the number of bodies.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics import contact_passes, tunnelling
from gen2d.physics.constraint import ContactConstraint, ContactPoint, Impulse, Motion
from gen2d.physics.contact_log import (
    ContactEvent,
    PairEvent,
    began_touching,
    compact,
    empty_events,
    pair_event,
    record_event,
)
from gen2d.physics.contact_state import Displacement, PassSetup, SolvedPair, WarmStart
from gen2d.physics.params import SolverParams
from gen2d.physics.schedule import Match, run_schedule
from gen2d.records.axes import Array
from gen2d.records.trajectory import Contacts


class Observed(NamedTuple):
    """What has been seen so far in rows of one size."""

    depth: Array  # m: deepest overlap
    begins: Array  # contacts that began


class AllPairsCarry(NamedTuple):
    """What all rows hand on from step to step."""

    rows: list[WarmStart]
    seen: dict[int, Observed]  # by size of row
    events: list[ContactEvent] | None


@dataclasses.dataclass(frozen=True)
class AllPairs:
    """All rows of a video, in the order in which they are played."""

    rows: list[ContactConstraint]
    points: list[int]  # of each row: how many points of contact it has
    slots: list[tuple[Array, Array]]  # of each row: those of its objects
    order: list[Match]
    setup: PassSetup
    rules: SolverParams

    def start(self, contacts: int) -> AllPairsCarry:
        """What the first step begins with."""
        shapes, dtype = [row.present.shape for row in self.rows], self.setup.threshold.dtype

        def nothing(row: ContactConstraint, points: int) -> WarmStart:
            zero = jnp.zeros(row.present.shape, dtype)
            return WarmStart([Impulse(zero, zero)] * points, None if row.rolling is None else zero)

        return AllPairsCarry(
            rows=[nothing(*of) for of in zip(self.rows, self.points, strict=True)],
            seen={shape[0]: Observed(jnp.zeros(shape, dtype), jnp.zeros(shape, jnp.int32)) for shape in shapes},
            events=[empty_events(shape, dtype) for shape in shapes] if contacts else None,
        )

    def warm(
        self, past: AllPairsCarry, bodies: list[tuple], walls: list[tuple], motions: list[Motion], works: list
    ) -> tuple[list[Motion], list, list[list[ContactPoint]]]:
        """Motions and works with the last step's impulses, and the points of every row.

        `bodies` are shapes and accelerations, the latter None where all fall alike; `walls` are shapes and motions,
        the latter None where they stand still.
        """

        def play(k: int, a: tuple, b: tuple) -> tuple:
            return contact_passes.warm_start(self.rows[k], past.rows[k], a, b, self.setup)

        groups = [(shape, m, fall, w) for (shape, fall), m, w in zip(bodies, motions, works, strict=True)]
        groups, found = run_schedule(groups, [(*wall, None, None) for wall in walls], self.order, play)
        return [motion for _, motion, *_ in groups], [work for *_, work in groups], found

    def solve(
        self,
        past: AllPairsCarry,
        found: list[list[ContactPoint]],
        walls: list[tuple],
        motions: list[Motion],
        drifts: list,
        works: list,
    ) -> tuple[list[Motion], list[Displacement], list, list[SolvedPair]]:
        """Motions, drifts and works after the biased pass, and every row."""

        def play(k: int, a: tuple, b: tuple) -> tuple:
            return contact_passes.solve(self.rows[k], past.rows[k], found[k], a, b, self.setup, self.rules)

        groups = list(zip(motions, drifts, works, strict=True))
        groups, rows = run_schedule(groups, [(motion, None, None) for _, motion in walls], self.order, play)
        motions, drifts, works = (list(values) for values in zip(*groups, strict=True))
        return motions, drifts, works, rows

    def relax(
        self,
        past: AllPairsCarry,
        rows: list[SolvedPair],
        walls: list[tuple],
        motions: list[Motion],
        drifts: list,
        works: list,
        time: Array,
    ) -> tuple[list[Motion], list, AllPairsCarry]:
        """Motions and works after the relaxing pass, and what all rows hand on; the step began at `time`."""

        def play(k: int, a: tuple, b: tuple) -> tuple:
            return contact_passes.relax(self.rows[k], rows[k], a, b, self.setup)

        groups = [(motion, drift.push, work) for motion, drift, work in zip(motions, drifts, works, strict=True)]
        groups, outs = run_schedule(groups, [(motion, None, None) for _, motion in walls], self.order, play)
        events = past.events
        if events is not None:
            of = zip(events, rows, outs, strict=True)
            events = [record_event(event, row, last, time) for event, row, (last, _) in of]
        now = AllPairsCarry([memory for _, memory in outs], self._seen(past, rows), events)
        return [motion for motion, *_ in groups], [work for *_, work in groups], now

    def _seen(self, past: AllPairsCarry, rows: list[SolvedPair]) -> dict[int, Observed]:
        seen = dict(past.seen)
        for row, solved, memory in zip(self.rows, rows, past.rows, strict=True):
            depth, began = tunnelling.visible_motion(solved, memory)
            old = seen[size := row.present.shape[0]]
            seen[size] = Observed(jnp.maximum(old.depth, depth), old.begins + began)
        return seen

    def frame_begins(self, past: AllPairsCarry) -> AllPairsCarry:
        """The same, with nothing seen in the frame yet."""
        return past if past.events is None else past._replace(events=[began_touching(event) for event in past.events])

    def frame_ends(self, past: AllPairsCarry) -> tuple[AllPairsCarry, PairEvent | None]:
        """The same, and what happened in the frame."""
        if past.events is None:
            return past, None
        rows = [pair_event(event, row.elasticity) for event, row in zip(past.events, self.rows, strict=True)]
        return past, jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *rows)

    def ended(self, past: AllPairsCarry, happened: Any, slots: int, fps: float) -> tuple[Array, Array, Contacts | None]:
        """Of the whole video: the deepest overlap, m, how many contacts began, and up to `slots` rows of contacts."""
        lanes = self.setup.threshold.shape
        depth, begins = jnp.zeros(lanes, self.setup.threshold.dtype), jnp.zeros(lanes, jnp.int32)
        for seen in past.seen.values():
            depth = jnp.maximum(depth, jnp.max(seen.depth, axis=0))
            begins = begins + jnp.sum(seen.begins, axis=0)
        if happened is None:
            return depth, begins, None
        a, b = (jnp.concatenate(side, axis=0) for side in zip(*self.slots, strict=True))
        return depth, begins, compact(happened, a, b, fps, slots)
