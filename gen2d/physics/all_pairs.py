"""Contact solver over every pair of bodies, round by round (schedule.py), near or not.

It has no branch and no gather, which suits GPUs, and has a reverse-mode gradient. Its cost grows with the square of the
number of bodies.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics import contact_passes
from gen2d.physics.constraint import ContactConstraint, ContactPoint, Impulse
from gen2d.physics.contact_log import (
    ContactEvent,
    PairEvent,
    compact,
    empty_events,
    next_frame_event,
    pair_event,
    record_event,
)
from gen2d.physics.contact_state import BodySide, PassSetup, RelaxedPair, SolvedPair, WarmStart
from gen2d.physics.impact_order import TURNS, in_order, later_impact, not_hit, takes_part, with_first
from gen2d.physics.params import SolverParams
from gen2d.physics.relaxing import late_scenes, unsolved_scenes
from gen2d.physics.schedule import Match, run_schedule
from gen2d.physics.solver_protocol import ContactSolver
from gen2d.physics.support import is_crushed
from gen2d.records.axes import Array
from gen2d.records.trajectory import Contacts


class Observed(NamedTuple):
    """Contact quality so far, of pairs by their place in a round."""

    depth: Array  # m: deepest overlap
    begins: Array  # contacts that began


class AllPairsCarry(NamedTuple):
    """Solver state carried between steps."""

    warm: list[WarmStart]
    observed: dict[int, Observed]  # by number of pairs in a round
    events: list[ContactEvent] | None


class SolvedRounds(NamedTuple):
    """Pairs of each round after the passes so far, and their contact points at the start of the step."""

    points: list[list[ContactPoint]]
    pairs: list[SolvedPair]


@dataclasses.dataclass(frozen=True)
class AllPairs(ContactSolver):
    """Contact solver over the constraints of all rounds, in their order."""

    constraints: list[ContactConstraint]
    points: list[int]  # contact points of a pair, by round
    slots: list[tuple[Array, Array]]  # of the objects, by round
    order: list[Match]
    setup: PassSetup
    params: SolverParams

    def start(self, slots: int) -> AllPairsCarry:
        shapes, dtype = [c.present.shape for c in self.constraints], self.setup.threshold.dtype

        def zero_warm_start(constraint: ContactConstraint, points: int) -> WarmStart:
            zero = jnp.zeros(constraint.present.shape, dtype)
            return WarmStart([Impulse(zero, zero)] * points, None if constraint.rolling is None else zero)

        return AllPairsCarry(
            warm=[zero_warm_start(*of) for of in zip(self.constraints, self.points, strict=True)],
            observed={shape[0]: Observed(jnp.zeros(shape, dtype), jnp.zeros(shape, jnp.int32)) for shape in shapes},
            events=[empty_events(shape, dtype) for shape in shapes] if slots else None,
        )

    def allocate(self, carry: AllPairsCarry, step: Callable) -> AllPairsCarry:
        return carry

    def begin_frame(self, carry: AllPairsCarry) -> AllPairsCarry:
        events = None if carry.events is None else [next_frame_event(event) for event in carry.events]
        return carry._replace(events=events)

    def warm_start(
        self, carry: AllPairsCarry, sides: list[BodySide], statics: list[BodySide], pulls: list[Array] | None
    ) -> tuple[list[BodySide], list[list[ContactPoint]]]:
        del pulls  # every pair is solved, near or not

        def play(k: int, a: BodySide, b: BodySide) -> tuple[BodySide, BodySide, list[ContactPoint]]:
            return contact_passes.warm_start(self.constraints[k], carry.warm[k], a, b, self.setup, self.params)

        return run_schedule(sides, statics, self.order, play)

    def _find_obstacles(
        self, carry: AllPairsCarry, contacts: list[list[ContactPoint]], sides: list[BodySide], statics: list[BodySide]
    ) -> tuple[list[BodySide], list[list[ContactPoint]]]:
        """Sides and contacts with the obstacles of bodies, in a step with pairs that are crushed."""
        if not self.params.extreme_mass_ratios:
            return sides, contacts

        def play(k: int, a: BodySide, b: BodySide) -> tuple[BodySide, BodySide, list[Array | None]]:
            of = self.constraints[k], carry.warm[k], contacts[k]
            a, b, points = contact_passes.find_obstacles(*of, a, b, self.params.step)
            return a, b, [point.stop for point in points]

        crushed = jnp.zeros((), bool)
        for constraint, points in zip(self.constraints, contacts, strict=True):
            if constraint.a is not None:
                crushed = crushed | jnp.any(is_crushed(constraint, points))
        none = [[point.stop for point in points] for points in contacts]
        sides, stops = jax.lax.cond(
            crushed, lambda: run_schedule(sides, statics, self.order, play), lambda: (sides, none)
        )
        of_rounds = zip(contacts, stops, strict=True)
        return sides, [[p._replace(stop=x) for p, x in zip(*of, strict=True)] for of in of_rounds]

    def solve(
        self, carry: AllPairsCarry, contacts: list[list[ContactPoint]], sides: list[BodySide], statics: list[BodySide]
    ) -> tuple[list[BodySide], SolvedRounds]:
        sides, contacts = self._find_obstacles(carry, contacts, sides, statics)

        def play(k: int, a: BodySide, b: BodySide) -> tuple[BodySide, BodySide, SolvedPair]:
            warm = carry.warm[k]
            return contact_passes.solve(self.constraints[k], warm, contacts[k], a, b, self.setup, self.params)

        sides, pairs = run_schedule(sides, statics, self.order, play)
        sides, pairs = self._later_impacts(contacts, pairs, sides, statics)
        return sides, SolvedRounds(contacts, pairs)

    def _later_impacts(
        self,
        points: list[list[ContactPoint]],
        pairs: list[SolvedPair],
        sides: list[BodySide],
        statics: list[BodySide],
    ) -> tuple[list[BodySide], list[SolvedPair]]:
        """Sides and pairs after the impacts that follow others of their bodies in this step."""
        if not self.params.by_time:
            return sides, pairs
        round_pairs = [takes_part(of, sides[0]) for of in points]
        if not any(round_pairs):
            return sides, pairs

        def find(sides: list[BodySide], pairs: list[SolvedPair]) -> tuple[list[BodySide], Array]:
            def play(k: int, a: BodySide, b: BodySide) -> tuple[BodySide, BodySide, Array | bool]:
                if not round_pairs[k]:
                    return a, b, False
                tau = later_impact(points[k][0], pairs[k].contacts[0], a, b, self.setup, self.params.step)
                return *with_first(points[k][0], a, b, tau), jnp.any(tau >= 0)

            sides, follow = run_schedule(not_hit(sides), statics, self.order, play)
            return sides, functools.reduce(jnp.logical_or, follow)

        def impacts(state: tuple) -> tuple:
            sides, follow = find(*state[:2])
            pairs = state[1]

            def play(k: int, a: BodySide, b: BodySide) -> tuple[BodySide, BodySide, SolvedPair]:
                if not round_pairs[k]:
                    return a, b, pairs[k]
                point = points[k][0]
                tau = later_impact(point, pairs[k].contacts[0], a, b, self.setup, self.params.step)
                tau = in_order(point, tau, a, b)
                return contact_passes.solve_impact(self.constraints[k], point, pairs[k], tau, a, b, self.params)

            return *run_schedule(sides, statics, self.order, play), follow

        def turn(state: tuple, _: None) -> tuple[tuple, None]:
            return jax.lax.cond(state[-1], impacts, lambda x: x, state), None

        (sides, pairs, _), _ = jax.lax.scan(turn, (sides, pairs, jnp.ones((), bool)), length=TURNS)
        return sides, pairs

    def relax(
        self,
        carry: AllPairsCarry,
        solved: SolvedRounds,
        sides: list[BodySide],
        statics: list[BodySide],
        time: Array,
        clamp: Callable,
    ) -> tuple[list[BodySide], AllPairsCarry]:
        def play(k: int, a: BodySide, b: BodySide) -> tuple[BodySide, BodySide, RelaxedPair]:
            of = self.constraints[k], carry.warm[k], solved.points[k], solved.pairs[k]
            return contact_passes.relax(*of, a, b, self.setup, self.params)

        new, relaxed = run_schedule(sides, statics, self.order, play)
        ended = self._relaxed(carry, solved.pairs, relaxed, time)
        if self.params.late_passes and self.constraints:
            scenes = late_scenes(new, self.setup.threshold.shape)

            @functools.partial(jax.checkpoint, prevent_cse=False)  # gradients would keep all passes in memory
            def again(*others: Any) -> tuple:
                late, pairs = self._late_passes(scenes, solved, sides, statics)
                of_pairs = zip(self.constraints, carry.warm, pairs, strict=True)
                relaxed = [contact_passes.relaxed_pair(*of, self.setup, self.params.step) for of in of_pairs]
                state = clamp(late), self._relaxed(carry, pairs, relaxed, time)
                return jax.tree.map(lambda x, y: jnp.where(scenes, x, y), state, others)

            new, ended = jax.lax.cond(jnp.any(scenes), again, lambda *x: x, new, ended)
        warm, events, begins = ended
        observed = dict(carry.observed)
        for pair, began in zip(solved.pairs, begins, strict=True):
            old = observed[size := began.shape[0]]
            observed[size] = Observed(jnp.maximum(old.depth, contact_passes.overlap(pair)), old.begins + began)
        return new, AllPairsCarry(warm, observed, events)

    def _relaxed(
        self, carry: AllPairsCarry, pairs: list[SolvedPair], relaxed: list[RelaxedPair], time: Array
    ) -> tuple[list[WarmStart], list[ContactEvent] | None, list[Array]]:
        """What the next step starts with, the events after this one, and whether a contact of each pair began."""
        events = carry.events
        if events is not None:
            of = zip(events, pairs, relaxed, strict=True)
            events = [record_event(event, pair, last.pair, time) for event, pair, last in of]
        return [last.warm for last in relaxed], events, [last.began for last in relaxed]

    def _late_passes(
        self, scenes: Array, solved: SolvedRounds, sides: list[BodySide], statics: list[BodySide]
    ) -> tuple[list[BodySide], list[SolvedPair]]:
        """Sides and pairs after relaxing passes with late impacts in these scenes."""
        params = self.params

        def one(number: Array, unsolved: Array, sides: list[BodySide], pairs: list[SolvedPair]) -> tuple:
            def play(k: int, a: BodySide, b: BodySide) -> tuple[BodySide, BodySide, tuple[SolvedPair, Array]]:
                of = self.constraints[k], solved.points[k], pairs[k]
                a, b, pair, happened = contact_passes.relax_late(*of, a, b, self.setup, params)
                return a, b, (pair, happened)

            new, of_pairs = run_schedule(sides, statics, self.order, play)
            solved_again, happened = (list(of) for of in zip(*of_pairs, strict=True))
            late = functools.reduce(jnp.logical_or, [jnp.any(of, axis=0) for of in happened])
            of_both = (new, solved_again), (sides, pairs)
            state = jax.tree.map(lambda x, y: jnp.where(unsolved, x, y), *of_both)
            return unsolved_scenes(unsolved, late, number, params), *state

        def one_if_unsolved(state: tuple, number: Array) -> tuple[tuple, None]:
            return jax.lax.cond(jnp.any(state[0]), one, lambda _, *x: x, number, *state), None

        start = scenes, sides, solved.pairs
        (_, sides, pairs), _ = jax.lax.scan(one_if_unsolved, start, 1 + jnp.arange(params.late_passes))
        return sides, pairs

    def end_frame(self, carry: AllPairsCarry) -> tuple[AllPairsCarry, PairEvent | None]:
        if carry.events is None:
            return carry, None
        events = [pair_event(event, c.elasticity) for event, c in zip(carry.events, self.constraints, strict=True)]
        return carry, jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *events)

    def results(
        self, carry: AllPairsCarry, events: PairEvent | None, slots: int, fps: float
    ) -> tuple[Array, Array, Contacts | None]:
        scenes = self.setup.threshold.shape
        depth, begins = jnp.zeros(scenes, self.setup.threshold.dtype), jnp.zeros(scenes, jnp.int32)
        for observed in carry.observed.values():
            depth = jnp.maximum(depth, jnp.max(observed.depth, axis=0))
            begins = begins + jnp.sum(observed.begins, axis=0)
        if events is None:
            return depth, begins, None
        a, b = (jnp.concatenate(side, axis=0) for side in zip(*self.slots, strict=True))
        return depth, begins, compact(events, a, b, fps, slots)
