"""Contact solver over the pairs that are near each other, found again in every step; for CPUs.

A step looks at every pair once, for a bit: whether the two may meet in it (broad_phase.py). The three passes then run
over the near pairs of all scenes in chunks, in the order of all_pairs.py. Bodies and cache entries of pairs are rows
of packed tables (packing.py): a chunk's rows are gathered, solved and put back. A pair that is not near would change
nothing, so the result equals that of all_pairs.py up to rounding.

The loops end with the last near pair, so there is no reverse-mode gradient; all_pairs.py has one.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics import contact_passes
from gen2d.physics.broad_phase import (
    BITS,
    ActivePairs,
    RoundRobin,
    RowLookup,
    active_pairs,
    bits_in_round_robin,
    bits_of,
    bounding_radius,
    count_active,
    row_lookup,
    signed_distance,
)
from gen2d.physics.collision import Shape, dot
from gen2d.physics.constraint import ContactConstraint, Impulse
from gen2d.physics.contact_log import (
    ON,
    ContactEvent,
    PairEvent,
    contacts_of,
    empty_events,
    next_frame_event,
    pair_event,
    record_event,
    sort_order,
)
from gen2d.physics.contact_state import BodySide, PassSetup, WarmStart
from gen2d.physics.impact_order import TURNS, later_impact, may_follow, takes_part, with_first
from gen2d.physics.packing import SAFE, PackedTable, TableSpec, make_table, pack, repeat_rows, table_of_rows, unpack
from gen2d.physics.params import SolverParams
from gen2d.physics.schedule import bipartite_rounds
from gen2d.physics.segment_lines import Neighbours
from gen2d.physics.solver_protocol import ContactSolver
from gen2d.records.axes import Array
from gen2d.records.trajectory import Contacts
from gen2d.xla import materialize, max_bodies

CONSTANTS = "shape", "acceleration", "displacement", "schur"  # of a `BodySide`: no pass changes them
NEVER = -2  # the step of an event that has not happened


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


class PassBuffers(NamedTuple):
    """Data of the pairs of a batch that one pass hands to the next, by chunk."""

    indices: Array  # [K, 4, C]
    contacts: Array  # [K, F, C]
    solved: Array


class ListedPairs(NamedTuple):
    """Near pairs of each batch, and their contacts after the warm start."""

    chunks: list[Array]  # how many there are
    indices: list[Array]
    packed: list[Array]
    specs: dict[int, TableSpec]  # of the packed contacts


class SolvedChunk(NamedTuple):
    """Contacts of each batch after the first pass."""

    listed: ListedPairs
    packed: list[Array]
    specs: dict[int, TableSpec]
    observed: list[tuple[Array, Array]]  # [n + 1] each: deepest overlap, m, and contacts that began


class BodyTables(NamedTuple):
    """Packed bodies of a pass."""

    constants: tuple[str, ...]  # fields of the sides that the pass does not change
    changing: list[PackedTable]  # by group: what a pass changes
    constant: list[PackedTable]
    fixed: list[PackedTable | None]  # static bodies of each batch that has any
    sides: list[BodySide]  # with the constant part alone

    @property
    def rows(self) -> list[Array]:
        """Rows of the changing tables."""
        return [table.rows for table in self.changing]


class CachedConstraint(NamedTuple):
    """Cache entry of a pair."""

    warm: WarmStart  # counts if it is of the last step
    stamp: Array  # the step that wrote it
    event: ContactEvent | None
    elasticity: Array | None


class NearbyCarry(NamedTuple):
    """Solver state carried between steps."""

    cache: list[Array]  # of each batch, a row per pair: see `CachedConstraint`
    last_touch: list[Array]  # [R P n + 1] twice the last step in which a pair touched, plus 1 if it still touches
    buffers: list[PassBuffers] | None  # None: not allocated yet
    depth: Array  # [n + 1] m
    begins: Array  # [n + 1]
    step: Array
    first: Array  # the frame's first step
    log: Array | None  # packed rows of logged contacts, of all scenes
    log_count: Array | None  # [n + 1] contacts logged so far


class ContactRow(NamedTuple):
    """A logged contact."""

    pair_event: PairEvent
    frame: Array
    a: Array
    b: Array


@dataclasses.dataclass(frozen=True)
class NearbyPairs(ContactSolver):
    """Contact solver over all pairs of a video, of which each step solves those that are near."""

    batches: list[PairBatch]
    groups: list[DynamicSide]
    rolling: bool  # whether anything resists rolling
    setup: PassSetup
    params: SolverParams
    chunk: int  # pairs that are solved at once

    @property
    def _scenes(self) -> int:
        return self.setup.threshold.shape[-1]

    @property
    def _dtype(self) -> Any:
        return self.setup.threshold.dtype

    def start(self, slots: int) -> NearbyCarry:
        n, count = self._scenes, jnp.zeros(self._scenes + 1, jnp.int32)
        return NearbyCarry(
            cache=[repeat_rows(self._empty_entry(b), b.a.size * n, self._dtype) for b in self.batches],
            last_touch=[jnp.full(b.a.size * n + 1, NEVER, jnp.int32) for b in self.batches] if slots else [],
            buffers=None,
            depth=count.astype(self._dtype),
            begins=count,
            step=jnp.zeros((), jnp.int32),
            first=jnp.zeros((), jnp.int32),
            log=repeat_rows(_empty_row(self._dtype), slots * n, self._dtype) if slots else None,
            log_count=count if slots else None,
        )

    def allocate(self, carry: NearbyCarry, step: Callable) -> NearbyCarry:
        buffers = jax.eval_shape(step, carry).buffers
        return carry._replace(buffers=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), buffers))

    def _empty_entry(self, batch: PairBatch) -> CachedConstraint:
        """Cache entry of a pair before its first contact."""
        zero = jnp.zeros(1, self._dtype)
        warm = WarmStart([Impulse(zero, zero)] * batch.points, zero if self.rolling else None)
        if not self.setup.log:
            return CachedConstraint(warm, zero + NEVER, None, None)
        return CachedConstraint(warm, zero + NEVER, empty_events((1,), self._dtype), zero)

    def _cache_tables(self, carry: NearbyCarry) -> list[PackedTable]:
        entries = [self._empty_entry(batch) for batch in self.batches]
        return [table_of_rows(*of) for of in zip(carry.cache, entries, strict=True)]

    # ---- Broad phase

    def _find_near_pairs(self, sides: list[BodySide], statics: list[BodySide]) -> list[ActivePairs]:
        """Pairs of each batch that may meet in this step."""
        motions = [side.motion for side in sides if side.motion is not None]
        squares = [dot(motion.velocity, motion.velocity) for motion in motions]
        fastest = jnp.zeros(self._scenes, self._dtype)
        for square in squares:
            fastest = jnp.maximum(fastest, jnp.sqrt(max_bodies(square)))
        for side in statics:
            if side.motion is not None and side.shape is not None:
                velocity, spin = side.motion
                speed = jnp.sqrt(dot(velocity, velocity)) + jnp.abs(spin) * bounding_radius(side.shape)
                fastest = jnp.maximum(fastest, speed[0])
        # A body moves as fast as it does now, or as the fastest of all may hit it on its way.
        half = 0.5 * self.params.step * fastest
        distances = [self.params.step * jnp.sqrt(square) + half for square in squares]
        shapes = [side.shape for side in sides if side.shape is not None]
        reaches = [
            jnp.where(group.material.present, bounding_radius(shape) + distance, jnp.nan)  # no pair has an absent body
            for shape, group, distance in zip(shapes, self.groups, distances, strict=True)
        ]
        bodies = [(shape.centre, reach) for shape, reach in zip(shapes, reaches, strict=True)]
        walls = [side.shape for side in statics if side.shape is not None]
        return [active_pairs(self._near_bits(batch, bodies, walls, half), self.chunk) for batch in self.batches]

    def _near_bits(self, batch: PairBatch, bodies: list[tuple], walls: list[Shape], half: Array) -> Array:
        """A bit for each pair that is near, in words [R, W n]."""
        centre, reach = bodies[batch.second]
        if batch.first is None:
            # The distance to an absent body is not a number, so that it is near nothing.
            absent = [jnp.where(static.present, 0.0, jnp.nan) for static in batch.statics.values()]
            near = zip(batch.statics, absent, strict=True)
            gaps = [signed_distance(walls[i], centre) - reach - half + x for i, x in near]
            return bits_of(jnp.stack(materialize(gaps)) < 0)
        if batch.round_robin is not None:
            return bits_in_round_robin(centre, reach, batch.round_robin)

        def play(_: int, a: tuple, b: tuple) -> tuple[tuple, tuple, Array]:
            offset, both = b[0] - a[0], a[1] + b[1]
            return a, b, materialize(dot(offset, offset) - both * both)

        *_, gaps = bipartite_rounds(bodies[batch.first], (centre, reach), play)
        return bits_of(jnp.stack(gaps) < 0)

    def _chunk_indices(self, batch: PairBatch, lookup: RowLookup, pair_of_bit: np.ndarray) -> GatherIndices:
        """Table rows of the pairs of a chunk."""
        n, (_, pairs), bits = self._scenes, batch.a.shape, pair_of_bit.shape[1]
        scene, bit = lookup.word % n, jnp.minimum(lookup.word // n * BITS + lookup.bit, bits - 1)

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

    def _all_indices(self, near: list[ActivePairs], buffers: list[PassBuffers] | None) -> list[Array]:
        """Table rows of the pairs of all chunks, in loops of their own, or each gather would compute them again."""
        if buffers is None:
            fields = len(GatherIndices._fields)
            return [jnp.zeros((self._most_chunks(batch), fields, self.chunk), jnp.int32) for batch in self.batches]

        def of_batch(batch: PairBatch, active: ActivePairs, buffer: PassBuffers) -> Array:
            def chunk(k: Array, indices: Array) -> Array:
                new = self._chunk_indices(batch, row_lookup(active, k, self.chunk), batch.pair_of_bit)
                return indices.at[k].set(jnp.stack(new), mode=SAFE)

            return jax.lax.fori_loop(0, active.starts[-1], chunk, buffer.indices)

        return [of_batch(*of) for of in zip(self.batches, near, buffers, strict=True)]

    def _most_chunks(self, batch: PairBatch) -> int:
        rounds, pairs = batch.a.shape
        return rounds * -(-pairs * self._scenes // self.chunk)

    # ---- The passes

    def _table(self, tree: Any, count: int) -> PackedTable:
        return make_table(tree, (count, self._scenes), self._dtype)

    def _static_table(self, trees: list[Any]) -> PackedTable:
        """Table of static bodies, from trees with leaves [..., 1, n]."""
        return self._table(jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *trees), len(trees))

    def _pass(
        self,
        sides: list[BodySide],
        statics: list[BodySide],
        listed: ListedPairs,
        carries: list[Any],
        play: Callable,
        constants: tuple[str, ...],
    ) -> tuple[list[BodySide], list[Any]]:
        """Sides and carries of all batches after a pass over the near pairs.

        `play(i, k, indices, a, b, carry)` returns both sides and the carry after chunk k of batch i. A carry with a
        None has no buffer yet; one chunk is then played to find its shape.
        """
        bodies = self._bodies(sides, statics, constants)
        rows, carries = self._play(bodies, bodies.rows, listed, carries, play, range(len(self.batches)))
        return self._unpacked(bodies, rows), carries

    def _bodies(self, sides: list[BodySide], statics: list[BodySide], constants: tuple[str, ...]) -> BodyTables:
        """Tables of the bodies, and of the static bodies of each batch."""
        changing, constant = zip(*(_split(side, constants) for side in sides), strict=True)
        tables, inputs = ([self._table(x, self._size(g)) for g, x in enumerate(of)] for of in (changing, constant))
        fixed = [self._static_table([statics[j] for j in b.statics]) if b.first is None else None for b in self.batches]
        return BodyTables(constants, tables, inputs, fixed, list(constant))

    def _unpacked(self, bodies: BodyTables, rows: list[Array]) -> list[BodySide]:
        """Sides with the rows of tables in which a pass has changed them."""
        shapes = [(self._size(g), self._scenes) for g in range(len(rows))]
        of = zip(bodies.changing, rows, shapes, bodies.sides, strict=True)
        return [
            _merge(table._replace(rows=x).unpack(shape), constant, bodies.constants) for table, x, shape, constant in of
        ]

    def _play(
        self,
        bodies: BodyTables,
        rows: list[Array],
        listed: ListedPairs,
        carries: list[Any],
        play: Callable,
        numbers: Sequence[int],
        skip: Callable | None = None,
    ) -> tuple[list[Array], list[Any]]:
        """Rows of the bodies' tables and carries after `play` of all chunks of some batches.

        `skip(i, k, indices, rows, carry)` returns whether a chunk is left out.
        """
        rows, carries = list(rows), list(carries)

        def side(rows: dict[int, Array], group: int, where: Array) -> BodySide:
            changing = bodies.changing[group]._replace(rows=rows[group])
            return _merge(changing.at(where), bodies.constant[group].at(where), bodies.constants)

        for i in numbers:
            batch = self.batches[i]

            def chunk(k: Array, state: tuple, i: int = i, batch: PairBatch = batch) -> tuple:
                rows, carry = state
                indices, fixed = GatherIndices(*listed.indices[i][k]), bodies.fixed[i]
                if batch.first is not None:
                    a = side(rows, batch.first, indices.a)
                else:
                    assert fixed is not None, "a batch without a first group has static bodies"
                    a = fixed.at(indices.a)
                a, b, carry = play(i, k, indices, a, side(rows, batch.second, indices.b), carry)
                new = dict(rows)
                if batch.first is not None:
                    new[batch.first] = self._put(bodies, new, batch.first, indices.a, a)
                new[batch.second] = self._put(bodies, new, batch.second, indices.b, b)
                return new, carry

            def chunk_if_needed(k: Array, state: tuple, i: int = i, chunk: Callable = chunk) -> tuple:
                assert skip is not None, "without it no chunk is skipped"
                idle = skip(i, k, GatherIndices(*listed.indices[i][k]), *state)
                # A loop of one turn, as XLA copies the tables that a branch changes.
                return jax.lax.fori_loop(0, jnp.where(idle, 0, 1), lambda _, state: chunk(k, state), state)

            start = {g: rows[g] for g in batch.groups}, carries[i]
            if any(x is None for x in jax.tree.leaves(carries[i], is_leaf=lambda x: x is None)):
                new, carries[i] = chunk(jnp.zeros((), jnp.int32), start)
            else:
                body = chunk if skip is None else chunk_if_needed
                new, carries[i] = jax.lax.fori_loop(0, listed.chunks[i], body, start)
            for g, x in new.items():
                rows[g] = x
        return rows, carries

    def _put(self, bodies: BodyTables, rows: dict[int, Array], group: int, where: Array, side: BodySide) -> Array:
        return bodies.changing[group]._replace(rows=rows[group]).put(where, _split(side, bodies.constants)[0]).rows

    def _store(self, batch: PairBatch, buffer: Array | None, k: Array, values: list[Array]) -> Array:
        """Buffer with the values of chunk k; a new one if there is none."""
        if buffer is None:
            return jnp.zeros((self._most_chunks(batch), len(values), self.chunk), self._dtype)
        return buffer.at[k].set(materialize(jnp.stack(values)), mode=SAFE)

    def warm_start(
        self, carry: NearbyCarry, sides: list[BodySide], statics: list[BodySide]
    ) -> tuple[list[BodySide], ListedPairs]:
        near = self._find_near_pairs(sides, statics)
        listed = ListedPairs([active.starts[-1] for active in near], self._all_indices(near, carry.buffers), [], {})
        groups = [self._table(group, self._size(g)) for g, group in enumerate(self.groups)]
        firsts = [
            self._static_table(list(b.statics.values())) if b.first is None else groups[b.first] for b in self.batches
        ]
        caches = self._cache_tables(carry)
        specs: dict[int, TableSpec] = {}

        def play(
            i: int, k: Array, indices: GatherIndices, a: BodySide, b: BodySide, buffer: Array | None
        ) -> tuple[BodySide, BodySide, Array]:
            batch = self.batches[i]
            first, second = firsts[i].at(indices.a), groups[batch.second].at(indices.b)
            cached = caches[i].at(indices.pair)
            fresh = cached.stamp == (carry.step - 1).astype(self._dtype)
            warm = jax.tree.map(lambda x: jnp.where(fresh, x, 0.0), cached.warm)
            constraint = batch.constraint(first.material, second.material)
            if isinstance(first, StaticSide):
                constraint = constraint._replace(neighbours=first.neighbours)
            setup = self.setup._replace(gravity=second.gravity, threshold=second.threshold)
            a, b, points = contact_passes.warm_start(constraint, warm, a, b, setup, self.params.step)
            gravity = None if batch.first is None else second.gravity  # of impacts on supported bodies
            packed = (constraint, warm, points, second.threshold, gravity)
            values, specs[i] = pack(packed, (self.chunk,), self._dtype, once=True)
            return a, b, self._store(batch, buffer, k, values)

        buffers = [None] * len(self.batches) if carry.buffers is None else [b.contacts for b in carry.buffers]
        sides, packed = self._pass(sides, statics, listed, buffers, play, CONSTANTS)
        return sides, listed._replace(packed=packed, specs=specs)

    def _unpack_contacts(
        self, listed: ListedPairs, i: int, k: Array
    ) -> tuple[ContactConstraint, WarmStart, list, PassSetup]:
        """Constraint, impulses, points and setup of chunk k of batch i, as the warm start stored them."""
        constraint, warm, points, threshold, gravity = unpack(list(listed.packed[i][k]), listed.specs[i])
        return constraint, warm, points, self.setup._replace(threshold=threshold, gravity=gravity)

    def solve(
        self, carry: NearbyCarry, contacts: ListedPairs, sides: list[BodySide], statics: list[BodySide]
    ) -> tuple[list[BodySide], SolvedChunk]:
        specs: dict[int, TableSpec] = {}

        def play(i: int, k: Array, indices: GatherIndices, a: BodySide, b: BodySide, carried: tuple) -> tuple:
            buffer, depth, begins = carried
            constraint, warm, points, setup = self._unpack_contacts(contacts, i, k)
            a, b, solved = contact_passes.solve(constraint, warm, points, a, b, setup, self.params)
            values, specs[i] = pack(solved, (self.chunk,), self._dtype, once=True)
            overlap, began = contact_passes.observe(solved, warm)
            depth, begins = depth.at[indices.scene].max(overlap), begins.at[indices.scene].add(began.astype(jnp.int32))
            return a, b, (self._store(self.batches[i], buffer, k, values), depth, begins)

        buffers = [None] * len(self.batches) if carry.buffers is None else [b.solved for b in carry.buffers]
        zero = jnp.zeros_like(carry.depth), jnp.zeros_like(carry.begins)
        starts = [(buffer, *zero) for buffer in buffers]
        sides, carries = self._pass(sides, statics, contacts, starts, play, (*CONSTANTS, "support"))
        observed = [(depth, begins) for _, depth, begins in carries]
        solved = SolvedChunk(contacts, [packed for packed, *_ in carries], specs, observed)
        return self._later_impacts(solved, sides, statics)

    def _later_impacts(
        self, solved: SolvedChunk, sides: list[BodySide], statics: list[BodySide]
    ) -> tuple[list[BodySide], SolvedChunk]:
        """Sides and contacts after the impacts that follow others of their bodies in this step."""
        if not self.params.by_time:
            return sides, solved
        listed, zero = solved.listed, jnp.zeros((), jnp.int32)
        points = [self._unpack_contacts(listed, i, zero)[2] for i in range(len(self.batches))]
        batches = [i for i, of in enumerate(points) if takes_part(of, sides[0])]
        if not batches:
            return sides, solved
        bodies = self._bodies(sides, statics, (*CONSTANTS, "support"))
        clocks = [_column(table, "clock") for table in bodies.changing]

        def idle(i: int, buffer: Array, k: Array, indices: GatherIndices, rows: dict[int, Array]) -> Array:
            """Whether no impact may follow in a chunk."""

            def clock_of(group: int, where: Array) -> Array:
                return rows[group][:, clocks[group]].at[where].get(mode=SAFE)

            batch, (contact,) = self.batches[i], unpack(list(buffer[k]), solved.specs[i]).contacts
            clock = clock_of(batch.second, indices.b)
            if batch.first is not None:
                clock = jnp.maximum(clock, clock_of(batch.first, indices.a))
            return ~jnp.any(may_follow(contact, clock))

        def find(rows: list[Array], packed: list[Array]) -> tuple[list[Array], Array]:
            def play(i: int, k: Array, indices: GatherIndices, a: BodySide, b: BodySide, follow: Array) -> tuple:
                _, _, points, setup = self._unpack_contacts(listed, i, k)
                pair = unpack(list(packed[i][k]), solved.specs[i])
                tau = later_impact(points[0], pair.contacts[0], a, b, setup, self.params.step)
                return *with_first(a, b, tau), follow | jnp.any(tau >= 0)

            firsts = [_column(table, "first") for table in bodies.changing]
            rows = [x.at[:, column].set(jnp.inf) for x, column in zip(rows, firsts, strict=True)]
            none = [jnp.zeros((), bool)] * len(self.batches)
            rows, follow = self._play(
                bodies,
                rows,
                listed,
                none,
                play,
                batches,
                lambda i, k, indices, rows, _: idle(i, packed[i], k, indices, rows),
            )
            return rows, functools.reduce(jnp.logical_or, follow)

        def turn(state: tuple) -> tuple:
            rows, packed, _, count = state
            rows, follow = find(rows, packed)

            def play(i: int, k: Array, indices: GatherIndices, a: BodySide, b: BodySide, buffer: Array) -> tuple:
                constraint, _, points, setup = self._unpack_contacts(listed, i, k)
                pair = unpack(list(buffer[k]), solved.specs[i])
                a, b, pair = contact_passes.solve_impact(constraint, points[0], pair, a, b, setup, self.params)
                values, _ = pack(pair, (self.chunk,), self._dtype, once=True)
                return a, b, self._store(self.batches[i], buffer, k, values)

            def skip(i: int, k: Array, indices: GatherIndices, rows: dict[int, Array], buffer: Array) -> Array:
                return ~follow | idle(i, buffer, k, indices, rows)

            rows, packed = self._play(bodies, rows, listed, packed, play, batches, skip)
            return rows, packed, follow, count + 1

        start = bodies.rows, solved.packed, jnp.ones((), bool), zero
        rows, packed, *_ = jax.lax.while_loop(lambda state: state[2] & (state[3] < TURNS), turn, start)
        return self._unpacked(bodies, rows), solved._replace(packed=packed)

    def relax(
        self, carry: NearbyCarry, solved: SolvedChunk, sides: list[BodySide], statics: list[BodySide], time: Array
    ) -> tuple[list[BodySide], NearbyCarry]:
        listed = solved.listed
        caches = self._cache_tables(carry)

        def play(i: int, k: Array, indices: GatherIndices, a: BodySide, b: BodySide, carried: tuple) -> tuple:
            cache, touch = caches[i]._replace(rows=carried[0]), carried[1]
            constraint, memory, points, setup = self._unpack_contacts(listed, i, k)
            pair = unpack(list(solved.packed[i][k]), solved.specs[i])
            a, b, (last, warm) = contact_passes.relax(constraint, memory, points, pair, a, b, setup, self.params)
            new = CachedConstraint(warm, jnp.full(self.chunk, carry.step, self._dtype), None, None)
            if self.setup.log:
                event = record_event(self._event_so_far(carry, cache.at(indices.pair)), pair, last, time)
                new = new._replace(event=event, elasticity=constraint.elasticity)
                now = 2 * carry.step + jnp.where((event.flags & ON) > 0, 1, 0)
                old = touch.at[indices.pair].get(mode=SAFE)
                now = jnp.where(contact_passes.touching(pair, last), now, old)
                touch = touch.at[indices.pair].set(now, mode=SAFE)
            return a, b, (cache.put(indices.pair, new).rows, touch)

        last_touch = carry.last_touch or [jnp.zeros(0, jnp.int32)] * len(self.batches)
        starts = list(zip(carry.cache, last_touch, strict=True))
        sides, carries = self._pass(sides, statics, listed, starts, play, (*CONSTANTS, "push"))
        depth, begins = carry.depth, carry.begins
        for overlap, began in solved.observed:
            depth, begins = jnp.maximum(depth, overlap), begins + began
        of_batches = zip(listed.indices, listed.packed, solved.packed, strict=True)
        return sides, carry._replace(
            cache=[cache for cache, _ in carries],
            last_touch=[touch for _, touch in carries] if self.setup.log else [],
            buffers=[PassBuffers(*of) for of in of_batches],
            depth=depth,
            begins=begins,
            step=carry.step + 1,
        )

    # ---- Logged contacts

    def _event_so_far(self, carry: NearbyCarry, cached: CachedConstraint) -> ContactEvent:
        """Event of a pair in this frame so far; of an older one only whether the pair touched is kept."""
        assert cached.event is not None, "events are cached where contacts are logged"
        current = cached.stamp >= carry.first
        ended = cached.stamp == carry.first - 1  # written by the last step of the last frame
        fresh = next_frame_event(cached.event._replace(flags=jnp.where(ended, cached.event.flags, 0)))
        return jax.tree.map(lambda x, y: jnp.where(current, x, y), cached.event, fresh)

    def begin_frame(self, carry: NearbyCarry) -> NearbyCarry:
        return carry._replace(first=carry.step)

    def end_frame(self, carry: NearbyCarry) -> tuple[NearbyCarry, None]:
        if carry.log is None or carry.log_count is None:
            return carry, None
        log, count = carry.log, carry.log_count
        for batch, cache, touch in zip(self.batches, self._cache_tables(carry), carry.last_touch, strict=True):
            recent = touch[:-1].reshape(*batch.a.shape, self._scenes) >= 2 * carry.first - 1
            words = bits_of(recent)
            log = self._append_to_log(carry, batch, cache, words, log, count)
            new = jnp.sum(count_active(words).reshape(-1, self._scenes), axis=0, dtype=jnp.int32)
            count = count.at[:-1].add(new)
        return carry._replace(log=log, log_count=count), None

    def _append_to_log(
        self, carry: NearbyCarry, batch: PairBatch, cache: PackedTable, words: Array, log: Array, count: Array
    ) -> Array:
        """Log with the pairs of a batch that have a bit in words [R, W n], after `count` [n + 1] contacts."""
        n, active = self._scenes, active_pairs(words, self.chunk)
        counts = count_active(words).reshape(-1, n)
        before = count[:-1] + jnp.cumsum(counts, axis=0, dtype=jnp.int32) - counts  # by round and word
        table, slots = self._log_table(log), [jnp.asarray(x.reshape(-1), jnp.int32) for x in batch.slots]
        capacity, width = (len(log) - 1) // n, words.shape[1]
        frame = carry.step // jnp.maximum(carry.step - carry.first, 1)

        def chunk(k: Array, log: Array) -> Array:
            lookup = row_lookup(active, k, self.chunk)
            indices = self._chunk_indices(batch, lookup, batch.pairs_in_order)
            cached = cache.at(indices.pair)
            event, last = self._event_so_far(carry, cached), cached.stamp == (carry.step - 1).astype(self._dtype)
            event = event._replace(flags=jnp.where(last, event.flags, event.flags & ~ON))
            new = pair_event(event, cached.elasticity)
            began = carry.first.astype(self._dtype) * self.params.step  # the time of an end without a touch
            new = new._replace(time=jnp.where(new.time >= 0, new.time, began))
            word = jnp.minimum(lookup.round * width + lookup.word, before.size - 1)
            rank = before.reshape(-1).at[word].get(mode=SAFE) + lookup.rank
            where = jnp.where(lookup.there & (rank < capacity), rank * n + indices.scene, capacity * n)
            pair = jnp.minimum(indices.pair // n, batch.a.size - 1)
            a, b = (x.at[pair].get(mode=SAFE) for x in slots)
            return table._replace(rows=log).put(where, ContactRow(new, jnp.full_like(a, frame), a, b)).rows

        return jax.lax.fori_loop(0, active.starts[-1], chunk, log)

    def _log_table(self, rows: Array) -> PackedTable:
        return table_of_rows(rows, _empty_row(self._dtype))

    def results(self, carry: NearbyCarry, events: None, slots: int, fps: float) -> tuple[Array, Array, Contacts | None]:
        depth, begins = carry.depth[:-1], carry.begins[:-1]
        if carry.log is None or carry.log_count is None:
            return depth, begins, None
        log, count = self._log_table(carry.log).unpack((slots, self._scenes)), carry.log_count[:-1]
        filled = jnp.arange(slots)[:, None] < count
        order = sort_order(jnp.where(filled, log.pair_event.time, jnp.inf))

        def in_order(x: Array) -> Array:
            x = jnp.where(filled, x, jnp.zeros_like(x))
            return jnp.take_along_axis(x, jnp.broadcast_to(order, x.shape), axis=-2)

        return depth, begins, contacts_of(*jax.tree.map(in_order, log), count=count)


def _split(side: BodySide, constants: tuple[str, ...]) -> tuple[BodySide, BodySide]:
    """What a pass changes of a side, and the rest."""
    rest = {name: getattr(side, name) for name in constants}
    return side._replace(**dict.fromkeys(constants)), BodySide(**rest)


def _column(table: PackedTable, name: str) -> int:
    """Column of a scalar of the bodies in a table."""
    return getattr(jax.tree.unflatten(table.spec.tree, [leaf.first for leaf in table.spec.leaves]), name)


def _merge(changing: BodySide, constant: BodySide, constants: tuple[str, ...]) -> BodySide:
    """A side from its two parts."""
    return changing._replace(**{name: getattr(constant, name) for name in constants})


def _empty_row(dtype: Any) -> ContactRow:
    nothing = pair_event(empty_events((1,), dtype), jnp.zeros(1, dtype))
    return ContactRow(nothing, *[jnp.zeros(1, jnp.int32)] * 3)


def chunk_size(scenes: int) -> int:
    """Pairs to solve at once with so many scenes: a few times fewer than are near in a round."""
    return min(max(16, 1 << (scenes // 16).bit_length()), 256)
