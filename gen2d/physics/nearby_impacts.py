"""Impacts of near pairs that follow others in a step (impact_order.py).

Few scenes of a thousand have any in most steps, so the near pairs of these are listed anew, `GROUP` scenes at a time:
those of all rounds together, in small chunks. A chunk may have a body twice, but a body has one next impact.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics.contact_passes import solve_impact
from gen2d.physics.impact_order import TURNS, first_time, in_order, later_impact, ordered
from gen2d.physics.packing import SAFE, pack, unpack
from gen2d.physics.pair_batches import BodyTables, ListedPairs, PairBatches, SolvedChunk
from gen2d.physics.scene_pairs import CHUNK, SceneChunk, SceneList, ScenePairs
from gen2d.physics.time_of_impact import NONE
from gen2d.records.axes import Array

GROUP = 16  # scenes that are listed at once


class _Turn(NamedTuple):
    rows: list[Array]
    packed: list[Array]
    firsts: list[Array]  # s: times of the next impacts of the bodies, by rows of their tables
    acts: Array  # whether the next impacts are known and act; else they are found
    more: Array  # whether to go on
    turns: Array  # so far


def ordered_batches(listed: ListedPairs) -> list[int]:
    """Numbers of the batches whose impacts can act in the order of their times."""
    points = [unpack(list(packed[0]), listed.specs[i])[2] for i, packed in enumerate(listed.packed)]
    return [i for i, of in enumerate(points) if ordered(of)]


class LaterImpacts:
    """Impacts that follow others, of some batches."""

    def __init__(self, solver: PairBatches, bodies: BodyTables, solved: SolvedChunk, batches: list[int]) -> None:
        self._solver, self._bodies, self._solved, self._batches = solver, bodies, solved, batches
        self._pairs = ScenePairs(solver, solved.listed, min(GROUP, solver.scenes))

    def solve(self, rows: list[Array], follow: Array) -> tuple[list[Array], list[Array]]:
        """Rows of the bodies' tables and packed contacts after these impacts, in scenes [n] where any may `follow`."""
        start, buffers = (rows, self._solved.packed), {i: self._pairs.empty(i) for i in self._batches}
        return self._pairs.run(follow, buffers, lambda lists, _, state: self._solve_group(lists, *state), start)[1]

    def _solve_group(
        self, lists: dict[int, SceneList], rows: list[Array], packed: list[Array]
    ) -> tuple[list[Array], list[Array]]:
        """Rows and packed contacts after the impacts of a group of scenes."""

        def turn(now: _Turn) -> _Turn:
            """State after the next impacts of all bodies have been found, or have acted: one after the other."""
            firsts = [jnp.where(now.acts, x, jnp.inf).astype(x.dtype) for x in now.firsts]
            state, packed = (now.rows, firsts, now.acts), list(now.packed)
            for i, pairs in lists.items():

                def chunk(_: Array, own: SceneChunk, carry: tuple, i: int = i) -> tuple:
                    return self._solve_chunk(i, own, now.acts, carry)

                state, packed[i] = pairs.run(chunk, (state, packed[i]))
            rows, firsts, more = state
            return _Turn(rows, packed, firsts, ~now.acts, more, now.turns + 1)

        none, zero = [jnp.full(len(x), jnp.inf, x.dtype) for x in rows], jnp.zeros((), jnp.int32)
        start = _Turn(rows, packed, none, zero > 0, zero == 0, zero)
        end = jax.lax.while_loop(lambda now: now.more & (now.turns < 2 * TURNS), turn, start)
        return end.rows, end.packed

    def _solve_chunk(self, i: int, own: SceneChunk, acts: Array, carry: tuple) -> tuple:
        """Rows, times and whether to go on, and packed contacts after the impacts of a chunk are found or act."""
        (rows, firsts, more), buffer = carry
        rows, firsts, solver, bodies = list(rows), list(firsts), self._solver, self._bodies
        batch, groups = solver.batches[i], self._groups(i, own)
        a, b = solver.sides_of(bodies, dict(enumerate(rows)), i, own.a, own.b)
        b = b._replace(first=firsts[batch.second].at[own.b].get(mode=SAFE))
        if batch.first is not None:
            a = a._replace(first=firsts[batch.first].at[own.a].get(mode=SAFE))
        constraint, _, (point, *_), setup = self._pairs.contacts(i, own)
        pair = unpack(own.columns(buffer), self._solved.specs[i])
        tau = later_impact(point, pair.contacts[0], a, b, setup, solver.params.step)
        more = more | jnp.any(tau >= 0)
        for group, where in groups:
            found = jnp.where(acts, jnp.inf, first_time(tau)).astype(tau.dtype)
            firsts[group] = firsts[group].at[where].min(found, mode=SAFE)
        tau = in_order(point, tau, a, b)
        tau = jnp.where(acts & _leading(groups, rows, tau >= 0), tau, NONE)
        a, b, pair = solve_impact(constraint, point, pair, tau, a, b, solver.params)
        for (group, where), side in zip(groups, (a, b)[-len(groups) :], strict=True):
            where = jnp.where(tau >= 0, where, len(rows[group]) - 1)
            rows[group] = solver.put(bodies, rows[group], group, where, side)
        values, _ = pack(pair, (CHUNK,), buffer.dtype, once=True)
        return (rows, firsts, more), own.put(buffer, values)

    def _groups(self, i: int, own: SceneChunk) -> list[tuple[int, Array]]:
        """Groups of moving bodies of a chunk's sides, with their rows."""
        batch = self._solver.batches[i]
        sides = (batch.first, own.a), (batch.second, own.b)
        return [(group, where) for group, where in sides if group is not None]


def _leading(groups: list[tuple[int, Array]], rows: list[Array], some: Array) -> Array:
    """Some of the pairs of a chunk [C]: of those with a common body, as two walls of a corner, the first."""
    lanes = jnp.arange(len(some), dtype=jnp.int32)
    leads = {group: jnp.full(len(rows[group]), len(some), jnp.int32) for group, _ in groups}
    for group, where in groups:
        leads[group] = leads[group].at[where].min(jnp.where(some, lanes, len(some)), mode=SAFE)
    for group, where in groups:
        some = some & (leads[group].at[where].get(mode=SAFE) == lanes)
    return some
