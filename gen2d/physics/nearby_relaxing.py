"""Relaxing passes over near pairs that find late impacts (relaxing.py), in the scenes that have any."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics.contact_passes import relax_late
from gen2d.physics.packing import get_row, pack, put_row, unpack
from gen2d.physics.pair_batches import BodyTables, PairBatches, SolvedChunk
from gen2d.physics.scene_pairs import CHUNK, SceneChunk, SceneList, ScenePairs
from gen2d.records.axes import Array
from gen2d.xla import materialize

GROUP = 4  # scenes that are listed at once: few have late impacts in a step


class _Buffers(NamedTuple):
    """Listed pairs of a batch, by chunk."""

    contacts: Array  # [K, F, C]
    pairs: Array


class LatePasses:
    """The passes over all pairs of some scenes.

    `remember(i, memory, chunk, contacts, pair)` returns the memory of batch i with a chunk of pairs after the passes.
    """

    def __init__(self, solver: PairBatches, bodies: BodyTables, solved: SolvedChunk, remember: Callable) -> None:
        self._solver, self._bodies, self._solved, self._remember = solver, bodies, solved, remember
        everywhere = solver.params.relax_iterations is not None
        sizes = (solver.scenes, solver.chunk) if everywhere else (min(GROUP, solver.scenes), CHUNK)
        self._pairs = ScenePairs(solver, solved.listed, *sizes)

    def solve(self, scenes: Array, rows: list[Array], memories: list[Any]) -> tuple[list[Array], list[Any]]:
        """Rows of the bodies' tables and memories after the passes over these scenes [n]."""
        return self._pairs.run(
            scenes, list(range(len(self._solver.batches))), True, self._solve_group, (rows, memories)
        )

    def _solve_group(self, lists: dict[int, SceneList], state: tuple) -> tuple:
        """Rows and memories after all passes over a group of scenes."""
        start, memories = state
        listed = {i: self._gathered(i, pairs) for i, pairs in lists.items()}

        def one(_: Array, state: tuple) -> tuple:
            rows, buffers = dict(enumerate(state[0])), dict(state[1])
            for i, pairs in lists.items():

                def chunk(k: Array, own: SceneChunk, carry: tuple, i: int = i) -> tuple:
                    return self._solve_chunk(i, k, own, listed[i].contacts, *carry)

                rows, buffers[i] = pairs.run(chunk, (rows, buffers[i]))
            return list(rows.values()), buffers

        start = start, {i: of.pairs for i, of in listed.items()}
        rows, buffers = jax.lax.fori_loop(0, self._solver.params.late_passes, one, start)
        memories = list(memories)
        for i, pairs in lists.items():

            def end(k: Array, own: SceneChunk, memory: Any, i: int = i) -> Any:
                contacts = self._contacts(i, k, listed[i].contacts)
                return self._remember(i, memory, own, contacts, self._pair(i, k, buffers[i]))

            memories[i] = pairs.run(end, memories[i])
        return rows, memories

    def _gathered(self, i: int, pairs: SceneList) -> _Buffers:
        """Listed pairs in buffers of their own: to put them back where they were in each pass would take longer."""
        packed = self._solved.listed.packed[i], self._solved.packed[i]

        def gather(k: Array, own: SceneChunk, buffers: _Buffers) -> _Buffers:
            of = zip(buffers, packed, strict=True)
            return _Buffers(*[put_row(new, k, materialize(jnp.stack(own.columns(old)))) for new, old in of])

        shape = pairs.indices.shape
        none = _Buffers(*[jnp.zeros((shape[0], old.shape[1], shape[2]), old.dtype) for old in packed])
        return pairs.run(gather, none)

    def _contacts(self, i: int, k: Array, contacts: Array) -> tuple[Any, ...]:
        return self._solver.unpack_contacts(list(get_row(contacts, k)), self._solved.listed.specs[i])

    def _pair(self, i: int, k: Array, pairs: Array) -> Any:
        return unpack(list(materialize(get_row(pairs, k))), self._solved.specs[i])

    def _solve_chunk(
        self, i: int, k: Array, own: SceneChunk, contacts: Array, rows: dict[int, Array], pairs: Array
    ) -> tuple[dict[int, Array], Array]:
        solver, bodies = self._solver, self._bodies
        a, b = solver.sides_of(bodies, rows, i, own.a, own.b)
        constraint, _, points, setup = self._contacts(i, k, contacts)
        pair = self._pair(i, k, pairs)
        a, b, pair = relax_late(constraint, points, pair, a, b, setup, solver.params)
        values, _ = pack(pair, own.a.shape, pairs.dtype, once=True)
        rows = rows | solver.put_sides(bodies, rows, i, own.a, own.b, a, b)
        return rows, put_row(pairs, k, materialize(jnp.stack(values)))
