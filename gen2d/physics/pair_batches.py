"""Pairs in batches that are solved by the same operations, and a pass over chunks of them.

Bodies are rows of packed tables (packing.py): the rows of a chunk are gathered, solved and put back.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.broad_phase import BITS, ActivePairs, RoundRobin, RowLookup
from gen2d.physics.constraint import ContactConstraint
from gen2d.physics.contact_state import BodySide, PassSetup, WarmStart
from gen2d.physics.packing import SAFE, PackedTable, TableSpec, get_row, make_table, unpack
from gen2d.physics.params import SolverParams
from gen2d.physics.segment_lines import Neighbours
from gen2d.records.axes import Array, take_scenes

CONSTANTS = "shape", "acceleration", "displacement", "schur"  # of a `BodySide`: no pass changes them


class StaticSide(NamedTuple):
    """Constants of a static or kinematic body; leaves [..., 1, n]."""

    material: Any
    neighbours: Neighbours | None
    present: Array


class DynamicSide(NamedTuple):
    """Constants of a group of bodies; leaves [..., N, n]."""

    material: Any
    gravity: Array
    threshold: Array


@dataclasses.dataclass(frozen=True)
class PairBatch:
    """Pairs that are solved by the same operations: of two groups, or of some static bodies with a group."""

    first: int | None  # a group; None: static bodies
    statics: dict[int, StaticSide]  # by number
    second: int
    a: np.ndarray  # [R, P] the pairs of R rounds, by number in the group or place among the statics
    b: np.ndarray
    slots: tuple[np.ndarray, np.ndarray]  # [R, P] of the objects
    round_robin: RoundRobin | None  # of a group with itself
    constraint: Callable[[Any, Any], ContactConstraint]  # from the materials of both sides
    points: int

    @property
    def groups(self) -> list[int]:
        """Groups whose bodies move."""
        return [self.second] if self.first in (None, self.second) else [self.first, self.second]

    @property
    def pairs_in_order(self) -> np.ndarray:
        """The pair [R, P] that each bit of a round stands for, unless bits are in the order of a round robin."""
        return np.broadcast_to(np.arange(self.a.shape[1]), self.a.shape)

    @property
    def pair_of_bit(self) -> np.ndarray:
        """The pair [R, bits] that each bit of a round stands for."""
        return self.pairs_in_order if self.round_robin is None else self.round_robin.pair


class GatherIndices(NamedTuple):
    """Table rows of the pairs of a chunk, each [C]; the last row of a table where there is no pair."""

    a: Array  # of the bodies
    b: Array
    pair: Array  # of the pairs
    scene: Array


class ListedPairs(NamedTuple):
    """Near pairs of each batch, and their contacts after the warm start."""

    near: list[ActivePairs]
    chunks: list[Array]  # how many there are
    indices: list[Array]  # [K, 4, C] `GatherIndices` of each chunk
    packed: list[Array]  # [K, F, C]
    specs: dict[int, TableSpec]  # of the packed contacts
    crushed: Array  # whether any pair is


class SolvedChunk(NamedTuple):
    """Contacts of each batch after the first pass."""

    listed: ListedPairs
    packed: list[Array]
    specs: dict[int, TableSpec]
    overlaps: list[Array]  # [n + 1] m, the deepest


class BodyTables(NamedTuple):
    """Packed bodies of a pass."""

    constants: tuple[str, ...]  # fields of the sides that the pass does not change
    changing: list[PackedTable]  # by group: what a pass changes
    constant: list[PackedTable]
    fixed: list[PackedTable | None]  # static bodies of each batch that has any
    sides: list[BodySide]  # with the constant part alone
    supports: list[PackedTable]  # by group; empty in passes that do not change them

    @property
    def tables(self) -> list[PackedTable]:
        """The tables that a pass changes: those of the groups, then those of their supports."""
        return [*self.changing, *self.supports]

    @property
    def rows(self) -> list[Array]:
        """Rows of `tables`."""
        return [table.rows for table in self.tables]


@dataclasses.dataclass(frozen=True)
class PairBatches:
    """All pairs of some scenes, in batches."""

    batches: list[PairBatch]
    groups: list[DynamicSide]
    rolling: bool  # whether anything resists rolling
    setup: PassSetup
    params: SolverParams
    chunk: int  # pairs that are solved at once

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return self.setup.threshold.shape[-1]

    @property
    def dtype(self) -> Any:
        """Type of the solver's numbers."""
        return self.setup.threshold.dtype

    def chunk_indices(self, batch: PairBatch, lookup: RowLookup, pair_of_bit: np.ndarray) -> GatherIndices:
        """Table rows of the pairs of a chunk."""
        n, (_, pairs), bits = self.scenes, batch.a.shape, pair_of_bit.shape[1]
        # Words are not negative: `%` and `//` would take the sign into account.
        scene, group = jax.lax.rem(lookup.word, np.int32(n)), jax.lax.div(lookup.word, np.int32(n))
        bit = jnp.minimum(group * BITS + lookup.bit, bits - 1)

        def entry(values: np.ndarray, where: Array) -> Array:
            return jnp.asarray(values.reshape(-1), jnp.int32).at[where].get(mode=SAFE)

        pair = lookup.round * pairs + entry(pair_of_bit, lookup.round * bits + bit)
        a, b = entry(batch.a, pair), entry(batch.b, pair)
        count = len(batch.statics) if batch.first is None else self._size(batch.first)
        ends = count, self._size(batch.second), batch.a.size
        rows = (jnp.where(lookup.there, x * n + scene, end * n) for x, end in zip((a, b, pair), ends, strict=True))
        return GatherIndices(*rows, scene=jnp.where(lookup.there, scene, n))

    def _size(self, group: int) -> int:
        return self.groups[group].threshold.shape[0]

    def _table(self, tree: Any, count: int) -> PackedTable:
        return make_table(tree, (count, self.scenes), self.dtype)

    def _static_table(self, trees: list[Any]) -> PackedTable:
        """Table of static bodies, from trees with leaves [..., 1, n]."""
        return self._table(jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *trees), len(trees))

    def bodies(self, sides: list[BodySide], statics: list[BodySide], constants: tuple[str, ...]) -> BodyTables:
        """Tables of the bodies, and of the static bodies of each batch."""
        changing, constant = zip(*(_split(side, constants) for side in sides), strict=True)
        supports = [side.support for side in changing if side.support is not None]  # only static bodies change them
        changing = [side._replace(support=None) for side in changing]
        tables, inputs, borne = (
            [self._table(x, self._size(g)) for g, x in enumerate(of)] for of in (changing, constant, supports)
        )
        fixed = [self._static_table([statics[j] for j in b.statics]) if b.first is None else None for b in self.batches]
        return BodyTables(constants, tables, inputs, fixed, list(constant), borne)

    def unpacked(self, bodies: BodyTables, rows: list[Array]) -> list[BodySide]:
        """Sides with the rows of tables in which a pass has changed them."""
        count, trees = len(self.groups), []
        for number, (table, of) in enumerate(zip(bodies.tables, rows, strict=True)):
            trees.append(table._replace(rows=of).unpack((self._size(number % count), self.scenes)))
        sides = [_merge(*of, bodies.constants) for of in zip(trees[:count], bodies.sides, strict=True)]
        if not bodies.supports:
            return sides
        return [side._replace(support=support) for side, support in zip(sides, trees[count:], strict=True)]

    def sides_of(
        self, bodies: BodyTables, rows: Mapping[int, Array], batch: int, first: Array, second: Array
    ) -> tuple[BodySide, BodySide]:
        """Both sides of a chunk of pairs: these rows of the tables, of which the changing ones are given by group."""

        def side(group: int, where: Array) -> BodySide:
            changing = _current(bodies, rows, group)
            return _merge(changing.at(where), bodies.constant[group].at(where), bodies.constants)

        of, fixed = self.batches[batch], bodies.fixed[batch]
        if of.first == of.second:
            tables = _current(bodies, rows, of.second), bodies.constant[of.second]
            changing, constant = (table.at_both(first, second) for table in tables)
            a, b = (_merge(*parts, bodies.constants) for parts in zip(changing, constant, strict=True))
            return a, b
        if of.first is not None:
            return side(of.first, first), side(of.second, second)
        assert fixed is not None, "a batch without a first group has static bodies"
        b = side(of.second, second)
        if bodies.supports:
            b = b._replace(support=_current(bodies, rows, self._support(of.second)).at(second))
        return fixed.at(first), b

    def _support(self, group: int) -> int:
        """Number of the table of a group's supports."""
        return len(self.groups) + group

    def _changed(self, bodies: BodyTables, batch: PairBatch) -> list[int]:
        """Numbers of the tables that a batch changes; those of supports are changed by static bodies alone."""
        return batch.groups + ([self._support(batch.second)] if batch.first is None and bodies.supports else [])

    def put_sides(
        self,
        bodies: BodyTables,
        rows: Mapping[int, Array],
        batch: int,
        first: Array,
        second: Array,
        a: BodySide,
        b: BodySide,
    ) -> dict[int, Array]:
        """Rows of the tables that a batch changes, by number, with both sides of a chunk of pairs in these rows."""
        of, new = self.batches[batch], {}
        if of.first == of.second:
            of_a, of_b = (_split(side, bodies.constants)[0] for side in (a, b))
            return {of.second: _current(bodies, rows, of.second).put_both(first, of_a, second, of_b).rows}
        if of.first is not None:
            new[of.first] = self.put(bodies, rows[of.first], of.first, first, a)
        elif bodies.supports:
            number = self._support(of.second)
            new[number] = _current(bodies, rows, number).put(second, b.support).rows
            b = b._replace(support=None)
        return new | {of.second: self.put(bodies, rows[of.second], of.second, second, b)}

    def play(
        self,
        bodies: BodyTables,
        rows: list[Array],
        listed: ListedPairs,
        carries: list[Any],
        play: Callable,
    ) -> tuple[list[Array], list[Any]]:
        """Rows of the bodies' tables and carries after `play` of all chunks of all batches.

        `play(i, k, indices, a, b, carry)` returns both sides and the carry after chunk k of batch i. A carry with a
        None has no buffer yet; one chunk is then played to find its shape.
        """
        rows, carries = list(rows), list(carries)
        for i, batch in enumerate(self.batches):

            def chunk(k: Array, state: tuple, i: int = i) -> tuple:
                rows, carry = state
                own = GatherIndices(*get_row(listed.indices[i], k))
                a, b, carry = play(i, k, own, *self.sides_of(bodies, rows, i, own.a, own.b), carry)
                return self.put_sides(bodies, rows, i, own.a, own.b, a, b), carry

            start = {number: rows[number] for number in self._changed(bodies, batch)}, carries[i]
            if any(x is None for x in jax.tree.leaves(carries[i], is_leaf=lambda x: x is None)):
                new, carries[i] = chunk(jnp.zeros((), jnp.int32), start)
            else:
                new, carries[i] = jax.lax.fori_loop(0, listed.chunks[i], chunk, start)
            for g, x in new.items():
                rows[g] = x
        return rows, carries

    def put(self, bodies: BodyTables, rows: Array, group: int, where: Array, side: BodySide) -> Array:
        """Rows of the changing table of a group with some replaced."""
        return bodies.changing[group]._replace(rows=rows).put(where, _split(side, bodies.constants)[0]).rows

    def of_scenes(self, scenes: Array) -> Self:
        """The same pairs in some scenes; their constraints stay packed (`ListedPairs`)."""
        gravity, threshold = take_scenes((self.setup.gravity, self.setup.threshold), scenes)
        return dataclasses.replace(self, setup=self.setup._replace(gravity=gravity, threshold=threshold))

    def unpack_contacts(
        self, columns: Sequence[Array], spec: TableSpec
    ) -> tuple[ContactConstraint, WarmStart, list, PassSetup]:
        """Constraint, impulses, points and setup of packed contacts, as the warm start stored them."""
        constraint, warm, points, threshold, gravity = unpack(columns, spec)
        return constraint, warm, points, self.setup._replace(threshold=threshold, gravity=gravity)


def _current(bodies: BodyTables, rows: Mapping[int, Array], number: int) -> PackedTable:
    """A table that the pass changes, with its present rows."""
    return bodies.tables[number]._replace(rows=rows[number])


def _split(side: BodySide, constants: tuple[str, ...]) -> tuple[BodySide, BodySide]:
    """What a pass changes of a side, and the rest."""
    rest = {name: getattr(side, name) for name in constants}
    return side._replace(**dict.fromkeys(constants)), BodySide(**rest)


def _merge(changing: BodySide, constant: BodySide, constants: tuple[str, ...]) -> BodySide:
    """A side from its two parts."""
    return changing._replace(**{name: getattr(constant, name) for name in constants})
