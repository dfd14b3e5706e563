"""Contact solver over the pairs that are near each other, found again in every step; for CPUs.

A step looks at every pair once, for a bit: whether the two may meet in it (broad_phase.py). The three passes then run
over the near pairs of all scenes in chunks, in the order of all_pairs.py. Bodies and cache entries of pairs are rows
of packed tables (packing.py): a chunk's rows are gathered, solved and put back. A pair that is not near would change
nothing, so the result equals that of all_pairs.py up to rounding.

The loops end with the last near pair, so there is no reverse-mode gradient; all_pairs.py has one.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics import contact_passes
from gen2d.physics.broad_phase import (
    ActivePairs,
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
from gen2d.physics.contact_state import BodySide, RelaxedPair, SolvedPair, WarmStart
from gen2d.physics.impact_order import alone, ordered, with_clearance
from gen2d.physics.nearby_impacts import LaterImpacts, ordered_batches
from gen2d.physics.nearby_relaxing import LateBuffers, LatePasses
from gen2d.physics.packing import (
    SAFE,
    PackedTable,
    TableSpec,
    get_row,
    pack,
    put_row,
    repeat_rows,
    table_of_rows,
    unpack,
)
from gen2d.physics.pair_batches import (
    CONSTANTS,
    GatherIndices,
    ListedPairs,
    PairBatch,
    PairBatches,
    SolvedChunk,
    StaticSide,
)
from gen2d.physics.relaxing import late_scenes
from gen2d.physics.scene_pairs import SceneChunk
from gen2d.physics.schedule import bipartite_rounds
from gen2d.physics.solver_protocol import ContactSolver
from gen2d.physics.support import is_crushed
from gen2d.records.axes import Array
from gen2d.records.trajectory import Contacts
from gen2d.xla import materialize, max_bodies

RELAX_CONSTANTS = *CONSTANTS, "resting", "push"

NEVER = -2  # the step of an event that has not happened


class PassBuffers(NamedTuple):
    """Data of the pairs of a batch that one pass hands to the next, by chunk."""

    indices: Array  # [K, 4, C]
    contacts: Array  # [K, F, C]
    solved: Array
    touches: Array | None  # [K, F, C] `LastTouch` before the step; None: not kept


class PairMemory(NamedTuple):
    """What a batch keeps of its pairs from step to step."""

    cache: Array  # a row per pair: see `CachedConstraint`
    touch: Array  # [R P n + 1] see `NearbyCarry`; empty where contacts are not logged
    begins: Array  # [n + 1] contacts that began in this step


class LastTouch(NamedTuple):
    """What is logged of a pair before a step."""

    event: ContactEvent
    step: Array  # see `NearbyCarry.last_touch`


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
    late: list[LateBuffers]  # empty: not allocated yet, or no late passes
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
class NearbyPairs(PairBatches, ContactSolver):
    """Contact solver over all pairs of a video, of which each step solves those that are near."""

    def start(self, slots: int) -> NearbyCarry:
        n, count = self.scenes, jnp.zeros(self.scenes + 1, jnp.int32)
        return NearbyCarry(
            cache=[repeat_rows(self._empty_entry(b), b.a.size * n, self.dtype) for b in self.batches],
            last_touch=[jnp.full(b.a.size * n + 1, NEVER, jnp.int32) for b in self.batches] if slots else [],
            buffers=None,
            late=[],
            depth=count.astype(self.dtype),
            begins=count,
            step=jnp.zeros((), jnp.int32),
            first=jnp.zeros((), jnp.int32),
            log=repeat_rows(_empty_row(self.dtype), slots * n, self.dtype) if slots else None,
            log_count=count if slots else None,
        )

    def allocate(self, carry: NearbyCarry, step: Callable) -> NearbyCarry:
        after = jax.eval_shape(step, carry)
        buffers, late = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), (after.buffers, after.late))
        return carry._replace(buffers=buffers, late=late)

    def _empty_entry(self, batch: PairBatch) -> CachedConstraint:
        """Cache entry of a pair before its first contact."""
        zero = jnp.zeros(1, self.dtype)
        warm = WarmStart([Impulse(zero, zero)] * batch.points, zero if self.rolling else None)
        if not self.setup.log:
            return CachedConstraint(warm, zero + NEVER, None, None)
        return CachedConstraint(warm, zero + NEVER, empty_events((1,), self.dtype), zero)

    def _cache(self, i: int, rows: Array) -> PackedTable:
        """Table of the pairs of batch i, from its rows."""
        return table_of_rows(rows, self._empty_entry(self.batches[i]))

    # ---- Broad phase

    def _find_near_pairs(
        self, sides: list[BodySide], statics: list[BodySide], pulls: list[Array] | None
    ) -> list[ActivePairs]:
        """Pairs of each batch that may meet in this step."""
        motions = [side.motion for side in sides if side.motion is not None]
        squares = [dot(motion.velocity, motion.velocity) for motion in motions]
        if pulls is not None:
            squares = [(jnp.sqrt(square) + pull) ** 2 for square, pull in zip(squares, pulls, strict=True)]
        fastest = jnp.zeros(self.scenes, self.dtype)
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

    def _all_indices(self, near: list[ActivePairs], buffers: list[PassBuffers] | None) -> list[Array]:
        """Table rows of the pairs of all chunks, in loops of their own, or each gather would compute them again."""
        if buffers is None:
            fields = len(GatherIndices._fields)
            return [jnp.zeros((self._most_chunks(batch), fields, self.chunk), jnp.int32) for batch in self.batches]

        def of_batch(batch: PairBatch, active: ActivePairs, buffer: PassBuffers) -> Array:
            def chunk(k: Array, indices: Array) -> Array:
                new = self.chunk_indices(batch, row_lookup(active, k, self.chunk), batch.pair_of_bit)
                return put_row(indices, k, jnp.stack(new))

            return jax.lax.fori_loop(0, active.starts[-1], chunk, buffer.indices)

        return [of_batch(*of) for of in zip(self.batches, near, buffers, strict=True)]

    def _most_chunks(self, batch: PairBatch) -> int:
        rounds, pairs = batch.a.shape
        return rounds * -(-pairs * self.scenes // self.chunk)

    # ---- The passes

    def _pass(
        self,
        sides: list[BodySide],
        statics: list[BodySide],
        listed: ListedPairs,
        carries: list[Any],
        play: Callable,
        constants: tuple[str, ...],
    ) -> tuple[list[BodySide], list[Any]]:
        """Sides and carries of all batches after a pass over the near pairs."""
        bodies = self.bodies(sides, statics, constants)
        rows, carries = self.play(bodies, bodies.rows, listed, carries, play)
        return self.unpacked(bodies, rows), carries

    def _store(self, batch: PairBatch, buffer: Array | None, k: Array, values: list[Array]) -> Array:
        """Buffer with the values of chunk k; a new one if there is none."""
        if buffer is None:
            return jnp.zeros((self._most_chunks(batch), len(values), self.chunk), self.dtype)
        return put_row(buffer, k, materialize(jnp.stack(values)))

    def warm_start(
        self, carry: NearbyCarry, sides: list[BodySide], statics: list[BodySide], pulls: list[Array] | None
    ) -> tuple[list[BodySide], ListedPairs]:
        near = self._find_near_pairs(sides, statics, pulls)
        chunks, indices = [active.starts[-1] for active in near], self._all_indices(near, carry.buffers)
        listed = ListedPairs(near, chunks, indices, [], {}, jnp.zeros((), bool))
        groups = [self._table(group, self._size(g)) for g, group in enumerate(self.groups)]
        firsts = [
            self._static_table(list(b.statics.values())) if b.first is None else groups[b.first] for b in self.batches
        ]
        caches = [self._cache(*of) for of in enumerate(carry.cache)]
        specs: dict[int, TableSpec] = {}

        def play(
            i: int, k: Array, indices: GatherIndices, a: BodySide, b: BodySide, carried: tuple
        ) -> tuple[BodySide, BodySide, tuple]:
            batch, (buffer, crushed) = self.batches[i], carried
            if batch.first == batch.second:
                first, second = groups[batch.second].at_both(indices.a, indices.b)
            else:
                first, second = firsts[i].at(indices.a), groups[batch.second].at(indices.b)
            cached = caches[i].at(indices.pair)
            fresh = cached.stamp == (carry.step - 1).astype(self.dtype)
            warm = jax.tree.map(lambda x: jnp.where(fresh, x, 0.0), cached.warm)
            constraint = batch.constraint(first.material, second.material)
            if isinstance(first, StaticSide):
                constraint = constraint._replace(neighbours=first.neighbours)
            setup = self.setup._replace(gravity=second.gravity, threshold=second.threshold)
            a, b, points = contact_passes.warm_start(constraint, warm, a, b, setup, self.params)
            gravity = None if batch.first is None else second.gravity  # of impacts on supported bodies
            if self.params.extreme_mass_ratios and batch.first is not None:
                crushed = crushed | jnp.any(is_crushed(constraint, points))
            packed = (constraint, warm, points, second.threshold, gravity)
            values, specs[i] = pack(packed, (self.chunk,), self.dtype, once=True)
            return a, b, (self._store(batch, buffer, k, values), crushed)

        buffers = [None] * len(self.batches) if carry.buffers is None else [b.contacts for b in carry.buffers]
        starts = [(buffer, listed.crushed) for buffer in buffers]
        sides, carries = self._pass(sides, statics, listed, starts, play, CONSTANTS)
        crushed = functools.reduce(jnp.logical_or, [of for _, of in carries], listed.crushed)
        return sides, listed._replace(packed=[packed for packed, _ in carries], specs=specs, crushed=crushed)

    def _find_obstacles(
        self, contacts: ListedPairs, sides: list[BodySide], statics: list[BodySide]
    ) -> tuple[list[BodySide], ListedPairs]:
        """Sides and contacts with the obstacles of bodies, in a step with pairs that are crushed."""
        if not self.params.extreme_mass_ratios:
            return sides, contacts

        def play(
            i: int, k: Array, indices: GatherIndices, a: BodySide, b: BodySide, buffer: Array
        ) -> tuple[BodySide, BodySide, Array]:
            del indices
            columns = list(materialize(get_row(buffer, k)))
            constraint, warm, points, _ = self.unpack_contacts(columns, contacts.specs[i])
            a, b, points = contact_passes.find_obstacles(constraint, warm, points, a, b, self.params.step)
            if self.batches[i].first is None:
                return a, b, buffer
            _, _, places, *_ = contacts.specs[i].places
            for point, place in zip(points, places, strict=True):
                columns[place.stop.first] = point.stop
            return a, b, put_row(buffer, k, materialize(jnp.stack(columns)))

        def find(_: int, state: tuple) -> tuple:
            obstacles, packed = state
            of_sides = zip(sides, obstacles, strict=True)
            parts = [BodySide(motion=side.motion, obstacles=of) for side, of in of_sides]
            bodies = self.bodies(parts, statics, ("motion",))
            rows, packed = self.play(bodies, bodies.rows, contacts, packed, play)
            return [side.obstacles for side in self.unpacked(bodies, rows)], packed

        # A loop of one turn or none: a branch would copy the packed contacts.
        start = [side.obstacles for side in sides], contacts.packed
        obstacles, packed = jax.lax.fori_loop(0, contacts.crushed.astype(jnp.int32), find, start)
        sides = [side._replace(obstacles=of) for side, of in zip(sides, obstacles, strict=True)]
        return sides, contacts._replace(packed=packed)

    def solve(
        self, carry: NearbyCarry, contacts: ListedPairs, sides: list[BodySide], statics: list[BodySide]
    ) -> tuple[list[BodySide], SolvedChunk]:
        specs: dict[int, TableSpec] = {}
        constants = *CONSTANTS, "pull", "support", "obstacles", "first"
        sides, contacts = self._find_obstacles(contacts, sides, statics)
        by_time = ordered_batches(contacts) if self.params.by_time else []

        def play(i: int, k: Array, indices: GatherIndices, a: BodySide, b: BodySide, carried: tuple) -> tuple:
            buffer, depth, *follows = carried
            constraint, warm, points, setup = self.unpack_contacts(
                list(get_row(contacts.packed[i], k)), contacts.specs[i]
            )
            old, (a, b, solved) = (a, b), contact_passes.solve(constraint, warm, points, a, b, setup, self.params)
            values, specs[i] = pack(solved, (self.chunk,), self.dtype, once=True)
            if by_time:
                a, b, follow = with_clearance(solved, ordered(points), old, a, b, self.params.step)
                follows = [follows[0].at[indices.scene].max(follow)]
            depth = depth.at[indices.scene].max(contact_passes.overlap(solved))
            return a, b, (self._store(self.batches[i], buffer, k, values), depth, *follows)

        buffers = [None] * len(self.batches) if carry.buffers is None else [b.solved for b in carry.buffers]
        zero = [jnp.zeros_like(carry.depth), *([jnp.zeros(self.scenes + 1, bool)] if by_time else [])]
        bodies = self.bodies(alone(sides) if by_time else sides, statics, constants)
        rows, carries = self.play(bodies, bodies.rows, contacts, [(buffer, *zero) for buffer in buffers], play)
        packed, overlaps = [of for of, *_ in carries], [depth for _, depth, *_ in carries]
        solved = SolvedChunk(contacts, packed, specs, overlaps)
        if by_time:
            follow = functools.reduce(jnp.logical_or, [of for *_, of in carries])[:-1]
            rows, packed = LaterImpacts(self, bodies, solved, by_time).solve(rows, follow)
            solved = solved._replace(packed=packed)
        return self.unpacked(bodies, rows), solved

    def relax(
        self,
        carry: NearbyCarry,
        solved: SolvedChunk,
        sides: list[BodySide],
        statics: list[BodySide],
        time: Array,
        clamp: Callable,
    ) -> tuple[list[BodySide], NearbyCarry]:
        listed, keeps_touches = solved.listed, self.setup.log and self.params.late_passes > 0
        specs: dict[int, TableSpec] = {}

        def play(i: int, k: Array, indices: GatherIndices, a: BodySide, b: BodySide, carried: tuple) -> tuple:
            memory, *buffer = carried
            columns = list(get_row(listed.packed[i], k))
            constraint, warm, points, setup = self.unpack_contacts(columns, listed.specs[i])
            pair = unpack(list(get_row(solved.packed[i], k)), solved.specs[i])
            a, b, relaxed = contact_passes.relax(constraint, warm, points, pair, a, b, setup, self.params)
            old = self._last_touch(carry, i, memory, indices.pair) if self.setup.log else None
            if keeps_touches:
                values, specs[i] = pack(old, (self.chunk,), self.dtype)
                buffer = [self._store(self.batches[i], buffer[0], k, values)]
            memory = self._remember(carry, i, memory, indices, old, constraint, pair, relaxed, time)
            return a, b, (memory, *buffer)

        last_touch = carry.last_touch or [jnp.zeros(0, jnp.int32)] * len(self.batches)
        none = jnp.zeros_like(carry.begins)
        memories = [PairMemory(*of, none) for of in zip(carry.cache, last_touch, strict=True)]
        buffers = [None] * len(self.batches) if carry.buffers is None else [b.touches for b in carry.buffers]
        starts = [(of, *([buffer] if keeps_touches else [])) for of, buffer in zip(memories, buffers, strict=True)]
        new, carries = self._pass(sides, statics, listed, starts, play, RELAX_CONSTANTS)
        memories = [memory for memory, *_ in carries]
        touches = [buffer[0] if buffer else None for _, *buffer in carries]
        late = carry.late
        if self.params.late_passes and self.batches:
            scenes = late_scenes(new, (self.scenes,))

            def remember(i: int, memory: PairMemory, own: SceneChunk, contacts: tuple, pair: SolvedPair) -> PairMemory:
                (constraint, warm, _, setup), buffer = contacts, touches[i]
                touch = None if buffer is None else unpack(own.columns(buffer), specs[i])
                relaxed = contact_passes.relaxed_pair(constraint, warm, pair, setup, self.params.step)
                return self._remember(carry, i, memory, own, touch, constraint, pair, relaxed, time)

            others = jnp.append(~scenes, True)
            memories = [memory._replace(begins=jnp.where(others, memory.begins, 0)) for memory in memories]
            passes = LatePasses(self, sides, statics, solved, clamp, remember)
            late, new, memories = passes.solve(scenes, late, new, memories)
        depth, begins = carry.depth, carry.begins
        for overlap, memory in zip(solved.overlaps, memories, strict=True):
            depth, begins = jnp.maximum(depth, overlap), begins + memory.begins
        of_batches = zip(listed.indices, listed.packed, solved.packed, touches, strict=True)
        carry = carry._replace(
            cache=[memory.cache for memory in memories],
            last_touch=[memory.touch for memory in memories] if self.setup.log else [],
            buffers=[PassBuffers(*of) for of in of_batches],
            late=late,
            depth=depth,
            begins=begins,
            step=carry.step + 1,
        )
        return new, carry

    def _last_touch(self, carry: NearbyCarry, i: int, memory: PairMemory, where: Array) -> LastTouch:
        event = self._event_so_far(carry, self._cache(i, memory.cache).at(where))
        return LastTouch(event, memory.touch.at[where].get(mode=SAFE))

    def _remember(
        self,
        carry: NearbyCarry,
        i: int,
        memory: PairMemory,
        where: GatherIndices | SceneChunk,
        old: LastTouch | None,
        constraint: ContactConstraint,
        pair: SolvedPair,
        relaxed: RelaxedPair,
        time: Array,
    ) -> PairMemory:
        """Memory of a batch with these pairs after the step; `old` is what is logged of them before it."""
        touch = memory.touch
        new = CachedConstraint(relaxed.warm, jnp.full(where.pair.shape, carry.step, self.dtype), None, None)
        if old is not None:
            event = record_event(old.event, pair, relaxed.pair, time)
            new = new._replace(event=event, elasticity=constraint.elasticity)
            now = 2 * carry.step + jnp.where((event.flags & ON) > 0, 1, 0)
            now = jnp.where(contact_passes.touching(pair, relaxed.pair), now, old.step)
            touch = touch.at[where.pair].set(now, mode=SAFE)
        begins = memory.begins.at[where.scene].add(relaxed.began.astype(jnp.int32))
        return PairMemory(self._cache(i, memory.cache).put(where.pair, new).rows, touch, begins)

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
        caches = [self._cache(*of) for of in enumerate(carry.cache)]
        for batch, cache, touch in zip(self.batches, caches, carry.last_touch, strict=True):
            recent = touch[:-1].reshape(*batch.a.shape, self.scenes) >= 2 * carry.first - 1
            words = bits_of(recent)
            log = self._append_to_log(carry, batch, cache, words, log, count)
            new = jnp.sum(count_active(words).reshape(-1, self.scenes), axis=0, dtype=jnp.int32)
            count = count.at[:-1].add(new)
        return carry._replace(log=log, log_count=count), None

    def _append_to_log(
        self, carry: NearbyCarry, batch: PairBatch, cache: PackedTable, words: Array, log: Array, count: Array
    ) -> Array:
        """Log with the pairs of a batch that have a bit in words [R, W n], after `count` [n + 1] contacts."""
        n, active = self.scenes, active_pairs(words, self.chunk)
        counts = count_active(words).reshape(-1, n)
        before = count[:-1] + jnp.cumsum(counts, axis=0, dtype=jnp.int32) - counts  # by round and word
        table, slots = self._log_table(log), [jnp.asarray(x.reshape(-1), jnp.int32) for x in batch.slots]
        capacity, width = (len(log) - 1) // n, words.shape[1]
        frame = carry.step // jnp.maximum(carry.step - carry.first, 1)

        def chunk(k: Array, log: Array) -> Array:
            lookup = row_lookup(active, k, self.chunk)
            indices = self.chunk_indices(batch, lookup, batch.pairs_in_order)
            cached = cache.at(indices.pair)
            event, last = self._event_so_far(carry, cached), cached.stamp == (carry.step - 1).astype(self.dtype)
            event = event._replace(flags=jnp.where(last, event.flags, event.flags & ~ON))
            new = pair_event(event, cached.elasticity)
            began = carry.first.astype(self.dtype) * self.params.step  # the time of an end without a touch
            new = new._replace(time=jnp.where(new.time >= 0, new.time, began))
            word = jnp.minimum(lookup.round * width + lookup.word, before.size - 1)
            rank = before.reshape(-1).at[word].get(mode=SAFE) + lookup.rank
            where = jnp.where(lookup.there & (rank < capacity), rank * n + indices.scene, capacity * n)
            pair = jnp.minimum(indices.pair // n, batch.a.size - 1)
            a, b = (x.at[pair].get(mode=SAFE) for x in slots)
            return table._replace(rows=log).put(where, ContactRow(new, jnp.full_like(a, frame), a, b)).rows

        return jax.lax.fori_loop(0, active.starts[-1], chunk, log)

    def _log_table(self, rows: Array) -> PackedTable:
        return table_of_rows(rows, _empty_row(self.dtype))

    def results(self, carry: NearbyCarry, events: None, slots: int, fps: float) -> tuple[Array, Array, Contacts | None]:
        depth, begins = carry.depth[:-1], carry.begins[:-1]
        if carry.log is None or carry.log_count is None:
            return depth, begins, None
        log, count = self._log_table(carry.log).unpack((slots, self.scenes)), carry.log_count[:-1]
        filled = jnp.arange(slots)[:, None] < count
        order = sort_order(jnp.where(filled, log.pair_event.time, jnp.inf))

        def in_order(x: Array) -> Array:
            x = jnp.where(filled, x, jnp.zeros_like(x))
            return jnp.take_along_axis(x, jnp.broadcast_to(order, x.shape), axis=-2)

        return depth, begins, contacts_of(*jax.tree.map(in_order, log), count=count)


def _empty_row(dtype: Any) -> ContactRow:
    nothing = pair_event(empty_events((1,), dtype), jnp.zeros(1, dtype))
    return ContactRow(nothing, *[jnp.zeros(1, jnp.int32)] * 3)


def chunk_size(scenes: int) -> int:
    """Pairs to solve at once with so many scenes: a few times fewer than are near in a round."""
    return min(max(16, 1 << (scenes // 16).bit_length()), 256)
