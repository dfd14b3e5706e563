"""Relaxing passes over near pairs that find late impacts (relaxing.py), in the scenes that have any."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics.contact_passes import relax_late
from gen2d.physics.contact_state import BodySide
from gen2d.physics.packing import get_row, pack, put_row, unpack
from gen2d.physics.pair_batches import CONSTANTS, BodyTables, PairBatches, SolvedChunk
from gen2d.physics.relaxing import unsolved_scenes
from gen2d.physics.scene_pairs import CHUNK, SceneChunk, SceneList, ScenePairs
from gen2d.records.axes import Array, put_scenes, take_scenes
from gen2d.xla import materialize

GROUP = 16  # scenes that are listed at once: few have late impacts in a step
LATE_CONSTANTS = *(name for name in CONSTANTS if name != "displacement"), "resting", "push"


class LateBuffers(NamedTuple):
    """Listed pairs of a batch, by chunk; kept from step to step, as to fill them with zeros would take longer."""

    indices: Array  # [K, 7, C] see `SceneList`
    contacts: Array  # [K, F, C]
    pairs: Array


class _Group(NamedTuple):
    """Scenes that are solved together, and their bodies."""

    solver: PairBatches  # of these scenes
    bodies: BodyTables
    contacts: Sequence[Array]  # see `LateBuffers`


class LatePasses:
    """The passes over all pairs of some scenes.

    `clamp(sides, scenes)` returns the sides of some scenes after the passes with displacements that nothing forbids,
    `remember(i, memory, chunk, contacts, pair)` the memory of batch i with a chunk of pairs.
    """

    def __init__(
        self,
        solver: PairBatches,
        sides: list[BodySide],
        statics: list[BodySide],
        solved: SolvedChunk,
        clamp: Callable,
        remember: Callable,
    ) -> None:
        self._solver, self._sides, self._statics, self._solved = solver, sides, statics, solved
        self._clamp, self._remember = clamp, remember
        everywhere = solver.params.relax_iterations is not None
        sizes = (solver.scenes, solver.chunk) if everywhere else (min(GROUP, solver.scenes), CHUNK)
        self._pairs = ScenePairs(solver, solved.listed, *sizes, in_rounds=True)

    def solve(
        self, scenes: Array, buffers: list[LateBuffers], sides: list[BodySide], memories: list[Any]
    ) -> tuple[list[LateBuffers], list[BodySide], list[Any]]:
        """Buffers, sides and memories; the latter are those of these scenes [n] after the passes."""
        buffers = buffers or [self._empty(i) for i in range(len(memories))]
        listed = [[of.contacts, of.pairs] for of in buffers]
        indices, (listed, sides, memories) = self._pairs.run(
            scenes, dict(enumerate(of.indices for of in buffers)), self._solve_group, (listed, sides, memories)
        )
        return [LateBuffers(indices[i], *of) for i, of in enumerate(listed)], sides, memories

    def _empty(self, i: int) -> LateBuffers:
        indices = self._pairs.empty(i)
        packed = self._solved.listed.packed[i], self._solved.packed[i]
        return LateBuffers(
            indices, *[jnp.zeros((len(indices), of.shape[1], indices.shape[2]), of.dtype) for of in packed]
        )

    def _solve_group(self, lists: dict[int, SceneList], scenes: Array, state: tuple) -> tuple:
        """Buffers, sides and memories after all passes over a group of scenes."""
        (listed, sides, memories), solver = state, self._solver.of_scenes(scenes)
        params = solver.params
        own, statics = (take_scenes(of, scenes) for of in (self._sides, self._statics))
        bodies = solver.bodies(own, statics, LATE_CONSTANTS)
        contacts, buffers = zip(*(self._gathered(i, lists[i], of) for i, of in enumerate(listed)), strict=True)
        group = _Group(solver, bodies, contacts)

        def one(state: tuple) -> tuple:
            number, unsolved, rows, buffers = state
            rows, buffers, late = dict(enumerate(rows)), list(buffers), jnp.zeros_like(unsolved)
            for i, pairs in lists.items():

                def chunk(k: Array, own: SceneChunk, carry: tuple, i: int = i) -> tuple:
                    rows, pairs, late = carry
                    solves = (own.scene < self._solver.scenes) & unsolved[own.member]
                    rows, pairs, happened = self._solve_chunk(group, i, k, own, solves, rows, pairs)
                    return rows, pairs, late.at[own.member].max(happened & solves)

                rows, buffers[i], late = pairs.run(chunk, (rows, buffers[i], late))
            unsolved = unsolved_scenes(unsolved, late, number, params)
            return number + 1, unsolved, list(rows.values()), buffers

        def goes_on(state: tuple) -> Array:
            number, unsolved, *_ = state
            return (number <= params.late_passes) & jnp.any(unsolved)

        start = jnp.ones((), jnp.int32), scenes < self._solver.scenes, bodies.rows, list(buffers)
        *_, rows, buffers = jax.lax.while_loop(goes_on, one, start)
        memories = list(memories)
        for i, pairs in lists.items():

            def end(k: Array, own: SceneChunk, memory: Any, i: int = i) -> Any:
                contacts = self._contacts(i, k, group.contacts[i])
                return self._remember(i, memory, own, contacts, self._pair(i, k, buffers[i]))

            memories[i] = pairs.run(end, memories[i])
        sides = put_scenes(sides, scenes, self._clamp(solver.unpacked(bodies, rows), scenes))
        return [list(of) for of in zip(contacts, buffers, strict=True)], sides, memories

    def _gathered(self, i: int, pairs: SceneList, buffers: list[Array]) -> list[Array]:
        """Buffers with the listed pairs: to put these back where they were in each pass would take longer."""
        packed = self._solved.listed.packed[i], self._solved.packed[i]

        def gather(k: Array, own: SceneChunk, buffers: list[Array]) -> list[Array]:
            of = zip(buffers, packed, strict=True)
            return [put_row(new, k, materialize(jnp.stack(own.columns(old)))) for new, old in of]

        return pairs.run(gather, buffers)

    def _contacts(self, i: int, k: Array, contacts: Array) -> tuple[Any, ...]:
        return self._solver.unpack_contacts(list(get_row(contacts, k)), self._solved.listed.specs[i])

    def _pair(self, i: int, k: Array, pairs: Array) -> Any:
        return unpack(list(materialize(get_row(pairs, k))), self._solved.specs[i])

    def _solve_chunk(
        self,
        group: _Group,
        i: int,
        k: Array,
        own: SceneChunk,
        solves: Array,
        rows: dict[int, Array],
        pairs: Array,
    ) -> tuple[dict[int, Array], Array, Array]:
        """Rows and pairs after a pass over those pairs [C] of a chunk that `solves` says, and which bounce late."""
        solver, bodies = group.solver, group.bodies
        places = own.bodies(self._solver.scenes, solver.scenes)
        old_a, old_b = solver.sides_of(bodies, rows, i, *places)
        constraint, _, points, setup = self._contacts(i, k, group.contacts[i])
        old = self._pair(i, k, pairs)
        a, b, pair, happened = relax_late(constraint, points, old, old_a, old_b, setup, solver.params)
        of_both = (a, b, pair), (old_a, old_b, old)
        a, b, pair = jax.tree.map(lambda x, y: jnp.where(solves, x, y), *of_both)
        values, _ = pack(pair, own.a.shape, pairs.dtype, once=True)
        rows = rows | solver.put_sides(bodies, rows, i, *places, a, b)
        return rows, put_row(pairs, k, materialize(jnp.stack(values))), happened
