"""Impacts of near pairs that follow others in a step (impact_order.py).

Few scenes of a thousand have any in most steps, so the near pairs of these are listed anew, `GROUP` scenes at a time:
those of all rounds together, in small chunks. A chunk may have a body twice, but a body has one next impact.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics.broad_phase import active_pairs, row_lookup
from gen2d.physics.contact_passes import solve_impact
from gen2d.physics.impact_order import TURNS, first_time, in_order, later_impact, ordered
from gen2d.physics.packing import SAFE, get_row, pack, put_row, unpack
from gen2d.physics.pair_batches import BodyTables, ListedPairs, PairBatches, SolvedChunk
from gen2d.physics.time_of_impact import NONE
from gen2d.records.axes import Array
from gen2d.xla import materialize

GROUP = 16  # scenes that are listed at once
CHUNK = 16  # pairs of them that are solved at once


class _Turn(NamedTuple):
    rows: list[Array]
    packed: list[Array]
    firsts: list[Array]  # s: times of the next impacts of the bodies, by rows of their tables
    acts: Array  # whether the next impacts are known and act; else they are found
    more: Array  # whether to go on
    turns: Array  # so far


class _List(NamedTuple):
    """Pairs of a batch in some scenes."""

    chunks: Array  # how many there are
    indices: Array  # [K, 4, C] `_Chunk` of each


class _Chunk(NamedTuple):
    """Pairs of a chunk, each [C]."""

    a: Array  # rows of the bodies' tables; the last ones where there is no pair
    b: Array
    chunk: Array  # place in the buffers of the passes; beyond the end where there is no pair
    lane: Array

    def columns(self, buffer: Array) -> list[Array]:
        """Columns of a buffer [K, F, C]."""
        return list(buffer.at[self.chunk, :, self.lane].get(mode="clip").T)

    def put(self, buffer: Array, values: list[Array]) -> Array:
        """Buffer with these columns."""
        return buffer.at[self.chunk, :, self.lane].set(materialize(jnp.stack(values)).T, mode="drop")


def ordered_batches(listed: ListedPairs) -> list[int]:
    """Numbers of the batches whose impacts can act in the order of their times."""
    points = [unpack(list(packed[0]), listed.specs[i])[2] for i, packed in enumerate(listed.packed)]
    return [i for i, of in enumerate(points) if ordered(of)]


class LaterImpacts:
    """Impacts that follow others, of some batches."""

    def __init__(self, solver: PairBatches, bodies: BodyTables, solved: SolvedChunk, batches: list[int]) -> None:
        self._solver, self._bodies, self._solved, self._batches = solver, bodies, solved, batches

    def solve(self, rows: list[Array], follow: Array) -> tuple[list[Array], list[Array]]:
        """Rows of the bodies' tables and packed contacts after these impacts, in scenes [n] where any may `follow`."""
        scenes = self._solver.scenes
        size = min(GROUP, scenes)
        groups = active_pairs(follow[None].astype(jnp.uint32), size)

        def group(k: Array, state: tuple) -> tuple:
            lookup = row_lookup(groups, k, size)
            lists = {i: self._list(i, jnp.where(lookup.there, lookup.word, scenes)) for i in self._batches}
            return self._solve_group(lists, *state)

        return jax.lax.fori_loop(0, groups.starts[-1], group, (rows, self._solved.packed))

    def _solve_group(
        self, lists: dict[int, _List], rows: list[Array], packed: list[Array]
    ) -> tuple[list[Array], list[Array]]:
        """Rows and packed contacts after the impacts of a group of scenes."""

        def turn(now: _Turn) -> _Turn:
            """State after the next impacts of all bodies have been found, or have acted: one after the other."""
            firsts = [jnp.where(now.acts, x, jnp.inf).astype(x.dtype) for x in now.firsts]
            state, packed = (now.rows, firsts, now.acts), list(now.packed)
            for i, pairs in lists.items():

                def chunk(k: Array, carry: tuple, i: int = i, pairs: _List = pairs) -> tuple:
                    return self._solve_chunk(i, _Chunk(*get_row(pairs.indices, k)), now.acts, carry)

                state, packed[i] = jax.lax.fori_loop(0, pairs.chunks, chunk, (state, packed[i]))
            rows, firsts, more = state
            return _Turn(rows, packed, firsts, ~now.acts, more, now.turns + 1)

        none, zero = [jnp.full(len(x), jnp.inf, x.dtype) for x in rows], jnp.zeros((), jnp.int32)
        start = _Turn(rows, packed, none, zero > 0, zero == 0, zero)
        end = jax.lax.while_loop(lambda now: now.more & (now.turns < 2 * TURNS), turn, start)
        return end.rows, end.packed

    def _solve_chunk(self, i: int, own: _Chunk, acts: Array, carry: tuple) -> tuple:
        """Rows, times and whether to go on, and packed contacts after the impacts of a chunk are found or act."""
        (rows, firsts, more), buffer = carry
        rows, firsts, solver, bodies = list(rows), list(firsts), self._solver, self._bodies
        batch, groups = solver.batches[i], self._groups(i, own)
        a, b = solver.sides_of(bodies, dict(enumerate(rows)), i, own.a, own.b)
        b = b._replace(first=firsts[batch.second].at[own.b].get(mode=SAFE))
        if batch.first is not None:
            a = a._replace(first=firsts[batch.first].at[own.a].get(mode=SAFE))
        constraint, _, (point, *_), setup = self._contacts(i, own)
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

    @property
    def _listed(self) -> ListedPairs:
        return self._solved.listed

    def _list(self, i: int, chosen: Array) -> _List:
        """Near pairs of a batch in chosen scenes; numbers beyond the last scene are of none."""
        near, batch, solver = self._listed.near[i], self._solver.batches[i], self._solver
        scenes, size, (rounds, pairs) = solver.scenes, len(chosen), batch.a.shape
        words = near.words[:, : near.words.shape[1] // scenes * scenes].reshape(rounds, -1, scenes)
        words = jnp.where(chosen < scenes, words.at[..., chosen].get(mode="clip"), jnp.uint32(0))
        width = words.shape[1] * size
        merged = active_pairs(words.reshape(1, -1), CHUNK)

        def chunk(k: Array, listed: Array) -> Array:
            lookup = row_lookup(merged, k, CHUNK)
            place = jnp.minimum(lookup.word, rounds * width - 1)
            scene = jnp.minimum(chosen[place % size], scenes - 1)
            lookup = lookup._replace(round=place // width, word=place % width // size * scenes + scene)
            rank = near.before.at[lookup.round, lookup.word].get(mode=SAFE) + lookup.rank
            first = near.starts.at[lookup.round].get(mode=SAFE)
            buffer = jnp.where(lookup.there, first + rank // solver.chunk, len(self._listed.packed[i]))
            indices = solver.chunk_indices(batch, lookup, batch.pair_of_bit)
            return put_row(listed, k, jnp.stack(_Chunk(indices.a, indices.b, buffer, rank % solver.chunk)))

        none = jnp.zeros((-(-rounds * pairs * size // CHUNK), len(_Chunk._fields), CHUNK), jnp.int32)
        return _List(merged.starts[-1], jax.lax.fori_loop(0, merged.starts[-1], chunk, none))

    def _groups(self, i: int, own: _Chunk) -> list[tuple[int, Array]]:
        """Groups of moving bodies of a chunk's sides, with their rows."""
        batch = self._solver.batches[i]
        sides = (batch.first, own.a), (batch.second, own.b)
        return [(group, where) for group, where in sides if group is not None]

    def _contacts(self, i: int, own: _Chunk) -> tuple[Any, ...]:
        """Constraint, impulses, points and setup of a chunk of pairs."""
        return self._solver.unpack_contacts(own.columns(self._listed.packed[i]), self._listed.specs[i])


def _leading(groups: list[tuple[int, Array]], rows: list[Array], some: Array) -> Array:
    """Some of the pairs of a chunk [C]: of those with a common body, as two walls of a corner, the first."""
    lanes = jnp.arange(len(some), dtype=jnp.int32)
    leads = {group: jnp.full(len(rows[group]), len(some), jnp.int32) for group, _ in groups}
    for group, where in groups:
        leads[group] = leads[group].at[where].min(jnp.where(some, lanes, len(some)), mode=SAFE)
    for group, where in groups:
        some = some & (leads[group].at[where].get(mode=SAFE) == lanes)
    return some
