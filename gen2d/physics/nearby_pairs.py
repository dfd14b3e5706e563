"""Only the rows that are near each other, found anew in every step: what a CPU likes.

A step looks at all pairs once, for a bit each: whether they may meet in it (near.py). The three passes then run over
those rows in chunks, of all scenes at once, round after round in the order of dense.py. Bodies, and what is remembered
of a row, lie in tables with a line each (tables.py): a chunk's lines are gathered, solved and put back. A row that is
not near would have changed nothing, so the result is that of dense.py, but for the rounding of other machine code.

The loops end when the rows do, so there is no reverse-mode gradient here: dense.py has it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics import contact_passes, tunnelling
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
from gen2d.physics.constraint import ContactConstraint, Impulse, Motion
from gen2d.physics.contact_log import (
    ON,
    ContactEvent,
    PairEvent,
    began_touching,
    contacts_of,
    empty_events,
    order_of,
    pair_event,
    record_event,
)
from gen2d.physics.contact_state import Displacement, PassSetup, WarmStart
from gen2d.physics.packing import SAFE, PackedTable, TableSpec, make_table, pack, repeat_rows, unpack
from gen2d.physics.params import SolverParams
from gen2d.physics.schedule import bipartite_rounds
from gen2d.records.axes import Array
from gen2d.records.trajectory import Contacts
from gen2d.xla import materialize, max_bodies

NEVER = -2  # the step of what has not happened


class StaticSide(NamedTuple):
    """A fixed body, as rows need it beside its shape; leaves [..., 1, n]."""

    side: Any
    left: tuple[Array, Array] | None  # see `rows.Row`
    right: tuple[Array, Array] | None
    present: Array


class DynamicSide(NamedTuple):
    """What stays the same of the bodies of a group; leaves [..., N, n]."""

    side: Any
    gravity: Array
    threshold: Array


@dataclasses.dataclass(frozen=True)
class PairBatch:
    """Rows that are solved by the same operations: a match of two groups, or of some fixed bodies with a group."""

    first: int | None  # a group; None: fixed bodies
    posts: dict[int, StaticSide]  # which
    second: int
    a: np.ndarray  # [R, P] who meets in each of R rounds, by their numbers in their group, or among the posts
    b: np.ndarray
    slots: tuple[np.ndarray, np.ndarray]  # [R, P] theirs
    ring: RoundRobin | None  # of a group with itself
    row: Callable[[Any, Any], ContactConstraint]  # from both sides
    points: int

    @property
    def groups(self) -> list[int]:
        """The groups whose bodies it moves."""
        return [self.second] if self.first in (None, self.second) else [self.first, self.second]


class GatherIndices(NamedTuple):
    """Where the rows of a chunk are, each [C]; where there is no row, the last line of all."""

    a: Array  # lines of the tables of their bodies
    b: Array
    row: Array  # and of the table of rows
    lane: Array


class PassBuffers(NamedTuple):
    """What a step's passes tell each other of the rows of a kind, by chunk."""

    places: Array  # [K, 4, C]
    found: Array  # [K, F, C]
    solved: Array


class ListedPairs(NamedTuple):
    """What the first pass tells the others, of each kind: how many chunks there are, and what it keeps of them."""

    chunks: list[Array]
    places: list[Array]
    kept: list[Array]
    specs: dict[int, TableSpec]  # how to read it


class SolvedChunk(NamedTuple):
    """What the second pass tells the third, of each kind."""

    found: ListedPairs
    kept: list[Array]
    specs: dict[int, TableSpec]
    seen: list[tuple[Array, Array]]  # by scene, and nobody's: the deepest overlap, m, and how many contacts began


class CachedConstraint(NamedTuple):
    """What is remembered of a row; of impulses nothing, if it is older than the last step."""

    memory: WarmStart
    stamp: Array  # the step that wrote it
    event: ContactEvent | None
    elasticity: Array | None


class NearbyCarry(NamedTuple):
    """What all rows hand on from step to step."""

    lines: list[Array]  # of each kind, a line for each row: see `CachedConstraint`
    marks: list[Array]  # [R P n + 1] twice the last step in which a row touched, and one more if it stayed in touch
    stores: list[PassBuffers] | None  # room to write into; None: nobody knows yet how much
    depth: Array  # [n + 1] m
    begins: Array  # [n + 1]
    step: Array
    first: Array  # the frame's first step
    written: Array | None  # contacts: a line for each row and scene
    contact_rows: Array | None  # [n + 1] how many rows of contacts there are so far


class ContactRow(NamedTuple):
    """A row of contacts as it is written."""

    pair_event: PairEvent
    frame: Array
    a: Array
    b: Array


@dataclasses.dataclass(frozen=True)
class NearbyPairs:
    """All rows of a video, of which only those are solved whose bodies are near each other."""

    kinds: list[PairBatch]
    seats: list[DynamicSide]  # by group
    rolling: bool  # whether anything resists rolling
    setup: PassSetup
    rules: SolverParams
    chunk: int  # rows that are solved at once

    @property
    def _lanes(self) -> int:
        return self.setup.threshold.shape[-1]

    @property
    def _dtype(self) -> Any:
        return self.setup.threshold.dtype

    def start(self, contacts: int) -> NearbyCarry:
        """What the first step begins with."""
        n, count = self._lanes, jnp.zeros(self._lanes + 1, jnp.int32)
        return NearbyCarry(
            lines=[repeat_rows(self._nothing(kind), kind.a.size * n, self._dtype).lines for kind in self.kinds],
            marks=[jnp.full(kind.a.size * n + 1, NEVER, jnp.int32) for kind in self.kinds] if contacts else [],
            stores=None,
            depth=count.astype(self._dtype),
            begins=count,
            step=jnp.zeros((), jnp.int32),
            first=jnp.zeros((), jnp.int32),
            written=repeat_rows(_empty_contact_rows(self._dtype), contacts * n, self._dtype).lines
            if contacts
            else None,
            contact_rows=count if contacts else None,
        )

    def with_room(self, past: NearbyCarry, after: NearbyCarry) -> NearbyCarry:
        """The same with room for what a step, whose result looks like `after`, has to write."""
        return past._replace(stores=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), after.stores))

    def _nothing(self, kind: PairBatch) -> CachedConstraint:
        zero = jnp.zeros(1, self._dtype)
        memory = WarmStart([Impulse(zero, zero)] * kind.points, zero if self.rolling else None)
        if not self.setup.contacts:
            return CachedConstraint(memory, zero + NEVER, None, None)
        return CachedConstraint(memory, zero + NEVER, empty_events((1,), self._dtype), zero)

    def _spec(self, kind: PairBatch) -> TableSpec:
        return pack(self._nothing(kind), (1,), self._dtype)[1]

    # ---- Which rows are near

    def _near(self, shapes: list[Shape], walls: list[tuple], motions: list[Motion]) -> list[ActivePairs]:
        """The rows of each kind that may meet in this step."""
        squares = [dot(motion.velocity, motion.velocity) for motion in motions]
        fastest = jnp.zeros(self._lanes, self._dtype)
        for square in squares:
            fastest = jnp.maximum(fastest, jnp.sqrt(max_bodies(square)))
        for shape, motion in walls:
            if motion is not None:
                speed = jnp.sqrt(dot(motion.velocity, motion.velocity)) + jnp.abs(motion.spin) * bounding_radius(shape)
                fastest = jnp.maximum(fastest, speed[0])
        # Two that meet come no faster than both do now, or than the fastest of all has made one of them.
        half = 0.5 * self.rules.step * fastest
        ways = [self.rules.step * jnp.sqrt(square) + half for square in squares]
        reaches = [
            jnp.where(seat.side.present, bounding_radius(shape) + way, jnp.nan)  # what is not there is near nothing
            for shape, seat, way in zip(shapes, self.seats, ways, strict=True)
        ]
        bodies = [(shape.centre, reach) for shape, reach in zip(shapes, reaches, strict=True)]
        return [active_pairs(self._bits(kind, bodies, walls, half), self.chunk) for kind in self.kinds]

    def _bits(self, kind: PairBatch, bodies: list[tuple], walls: list[tuple], half: Array) -> Array:
        """A bit for each row that is near, in words [R, W n]."""
        centre, reach = bodies[kind.second]
        if kind.first is None:
            here = [jnp.where(post.present, 0.0, jnp.nan) for post in kind.posts.values()]
            gaps = [
                signed_distance(walls[i][0], centre) - reach - half + x for i, x in zip(kind.posts, here, strict=True)
            ]
            return bits_of(jnp.stack(materialize(gaps)) < 0)
        if kind.ring is not None:
            return bits_in_round_robin(centre, reach, kind.ring)

        def play(_: int, a: tuple, b: tuple) -> tuple[tuple, tuple, Array]:
            apart, both = b[0] - a[0], a[1] + b[1]
            return a, b, materialize(dot(apart, apart) - both * both)

        *_, gaps = bipartite_rounds(bodies[kind.first], (centre, reach), play)
        return bits_of(jnp.stack(gaps) < 0)

    def _place(self, kind: PairBatch, spot: RowLookup, pair: np.ndarray) -> GatherIndices:
        """Where rows are; `pair` [R, bits] says which pair of a round a bit stands for."""
        n, (_, pairs), bits = self._lanes, kind.a.shape, pair.shape[1]
        lane, bit = spot.word % n, jnp.minimum(spot.word // n * BITS + spot.bit, bits - 1)

        def looked_up(values: np.ndarray, where: Array) -> Array:
            return jnp.asarray(values.reshape(-1), jnp.int32).at[where].get(mode=SAFE)

        row = spot.round * pairs + looked_up(pair, spot.round * bits + bit)
        a, b = looked_up(kind.a, row), looked_up(kind.b, row)
        ends = len(kind.posts) if kind.first is None else self._size(kind.first), self._size(kind.second), kind.a.size
        lines = (jnp.where(spot.there, x * n + lane, end * n) for x, end in zip((a, b, row), ends, strict=True))
        return GatherIndices(*lines, lane=jnp.where(spot.there, lane, n))

    def _size(self, group: int) -> int:
        return self.seats[group].threshold.shape[0]

    def _places(self, near: list[ActivePairs], stores: list[PassBuffers] | None) -> list[Array]:
        """Where the rows of all chunks are: in a loop of its own, or each gather would compute it again."""
        if stores is None:
            return [
                jnp.zeros((self._room(kind), len(GatherIndices._fields), self.chunk), jnp.int32) for kind in self.kinds
            ]

        def placed(kind: PairBatch, rows: ActivePairs, room: Array) -> Array:
            pair = _pairs(kind) if kind.ring is None else kind.ring.pair

            def chunk(k: Array, room: Array) -> Array:
                place = self._place(kind, row_lookup(rows, k, self.chunk), pair)
                return room.at[k].set(jnp.stack(place), mode=SAFE)

            return jax.lax.fori_loop(0, rows.starts[-1], chunk, room)

        return [placed(*of) for of in zip(self.kinds, near, [store.places for store in stores], strict=True)]

    def _room(self, kind: PairBatch) -> int:
        """How many chunks there may be."""
        rounds, pairs = kind.a.shape
        return rounds * -(-pairs * self._lanes // self.chunk)

    # ---- The passes

    def _table(self, tree: Any, count: int) -> PackedTable:
        return make_table(tree, (count, self._lanes), self._dtype)

    def _fixed(self, trees: list[Any]) -> PackedTable:
        """A table of fixed bodies, whose trees have leaves [..., 1, n]."""
        return self._table(jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *trees), len(trees))

    def _pass(
        self, groups: list[Any], walls: list[Any], found: ListedPairs, carries: list[Any], play: Callable
    ) -> tuple:
        """The groups, and what is carried for each kind, after all rows that are near.

        `play(i, k, place, a, b, carried)` gives both sides of the rows of chunk k of kind i, and what is carried on.
        What carries None is not known yet: its first chunk is played once, to see what it looks like.
        """
        carries = list(carries)
        tables = [self._table(group, self._size(g)) for g, group in enumerate(groups)]
        for i, kind in enumerate(self.kinds):
            fixed = self._fixed([walls[j] for j in kind.posts]) if kind.first is None else None

            def chunk(
                k: Array, state: tuple, i: int = i, kind: PairBatch = kind, fixed: PackedTable | None = fixed
            ) -> tuple:
                lines, carried = state
                now = {g: tables[g]._replace(lines=x) for g, x in lines.items()}
                place = GatherIndices(*found.places[i][k])
                a = now[kind.first].at(place.a) if fixed is None else fixed.at(place.a)
                a, b, carried = play(i, k, place, a, now[kind.second].at(place.b), carried)
                if fixed is None:
                    now[kind.first] = now[kind.first].put(place.a, a)
                now[kind.second] = now[kind.second].put(place.b, b)
                return {g: x.lines for g, x in now.items()}, carried

            start = {g: tables[g].lines for g in kind.groups}, carries[i]
            if any(x is None for x in jax.tree.leaves(carries[i], is_leaf=lambda x: x is None)):
                lines, carries[i] = chunk(jnp.zeros((), jnp.int32), start)
            else:
                lines, carries[i] = jax.lax.fori_loop(0, found.chunks[i], chunk, start)
            for g, x in lines.items():
                tables[g] = tables[g]._replace(lines=x)
        return [t.whole((self._size(g), self._lanes)) for g, t in enumerate(tables)], carries

    def _kept(self, kind: PairBatch, room: Array | None, k: Array, values: list[Array]) -> Array:
        """The room with a chunk's values; new room if there is none."""
        if room is None:
            return jnp.zeros((self._room(kind), len(values), self.chunk), self._dtype)
        return room.at[k].set(materialize(jnp.stack(values)), mode=SAFE)

    def warm(
        self, past: NearbyCarry, bodies: list[tuple], walls: list[tuple], motions: list[Motion], works: list
    ) -> tuple[list[Motion], list, ListedPairs]:
        """Motions and works with the last step's impulses, and which rows there are.

        `bodies` are shapes and accelerations, the latter None where all fall alike; `walls` are shapes and motions,
        the latter None where they stand still.
        """
        near = self._near([shape for shape, _ in bodies], walls, motions)
        found = ListedPairs([rows.starts[-1] for rows in near], self._places(near, past.stores), [], {})
        seats = [self._table(seat, self._size(g)) for g, seat in enumerate(self.seats)]
        firsts = [self._fixed(list(k.posts.values())) if k.first is None else seats[k.first] for k in self.kinds]
        memories = [PackedTable(x, self._spec(kind)) for x, kind in zip(past.lines, self.kinds, strict=True)]
        specs: dict[int, TableSpec] = {}

        def play(i: int, k: Array, place: GatherIndices, a: Any, b: Any, room: Array | None) -> tuple:
            kind, first, seat = self.kinds[i], firsts[i].at(place.a), seats[self.kinds[i].second].at(place.b)
            line = memories[i].at(place.row)
            fresh = line.stamp == (past.step - 1).astype(self._dtype)
            memory = jax.tree.map(lambda x: jnp.where(fresh, x, 0.0), line.memory)
            row = kind.row(first.side, seat.side)
            if isinstance(first, StaticSide):
                row = row._replace(left=first.left, right=first.right)
            setup = self.setup._replace(gravity=seat.gravity, threshold=seat.threshold)
            a, b, points = contact_passes.warm_start(row, memory, a, b, setup)
            values, specs[i] = pack((row, memory, points, seat.threshold), (self.chunk,), self._dtype, once=True)
            return a, b, self._kept(kind, room, k, values)

        rooms = [None] * len(self.kinds) if past.stores is None else [store.found for store in past.stores]
        groups = [(shape, m, fall, w) for (shape, fall), m, w in zip(bodies, motions, works, strict=True)]
        groups, kept = self._pass(groups, [(*wall, None, None) for wall in walls], found, rooms, play)
        found = found._replace(kept=kept, specs=specs)
        return [motion for _, motion, *_ in groups], [work for *_, work in groups], found

    def _again(self, found: ListedPairs, i: int, k: Array) -> tuple[ContactConstraint, WarmStart, list, PassSetup]:
        """What the first pass has kept of a chunk of rows."""
        row, memory, points, threshold = unpack(list(found.kept[i][k]), found.specs[i])
        return row, memory, points, self.setup._replace(threshold=threshold)

    def solve(
        self,
        past: NearbyCarry,
        found: ListedPairs,
        walls: list[tuple],
        motions: list[Motion],
        drifts: list,
        works: list,
    ) -> tuple[list[Motion], list[Displacement], list, SolvedChunk]:
        """Motions, drifts and works after the biased pass, and what it has seen of the rows."""
        specs: dict[int, TableSpec] = {}

        def play(i: int, k: Array, place: GatherIndices, a: Any, b: Any, carried: tuple) -> tuple:
            room, depth, begins = carried
            row, memory, points, setup = self._again(found, i, k)
            a, b, solved = contact_passes.solve(row, memory, points, a, b, setup, self.rules)
            values, specs[i] = pack(solved, (self.chunk,), self._dtype, once=True)
            deep, began = tunnelling.visible_motion(solved, memory)
            depth, begins = depth.at[place.lane].max(deep), begins.at[place.lane].add(began.astype(jnp.int32))
            return a, b, (self._kept(self.kinds[i], room, k, values), depth, begins)

        rooms = [None] * len(self.kinds) if past.stores is None else [store.solved for store in past.stores]
        nothing = jnp.zeros_like(past.depth), jnp.zeros_like(past.begins)
        groups = list(zip(motions, drifts, works, strict=True))
        fixed = [(motion, None, None) for _, motion in walls]
        groups, carries = self._pass(groups, fixed, found, [(room, *nothing) for room in rooms], play)
        motions, drifts, works = (list(values) for values in zip(*groups, strict=True))
        seen = [(depth, begins) for _, depth, begins in carries]
        return motions, drifts, works, SolvedChunk(found, [kept for kept, *_ in carries], specs, seen)

    def relax(
        self,
        past: NearbyCarry,
        rows: SolvedChunk,
        walls: list[tuple],
        motions: list[Motion],
        drifts: list,
        works: list,
        time: Array,
    ) -> tuple[list[Motion], list, NearbyCarry]:
        """Motions and works after the relaxing pass, and what all rows hand on; the step began at `time`."""
        found = rows.found
        specs = [self._spec(kind) for kind in self.kinds]

        def play(i: int, k: Array, place: GatherIndices, a: Any, b: Any, carried: tuple) -> tuple:
            lines, marks = PackedTable(carried[0], specs[i]), carried[1]
            row, _, _, setup = self._again(found, i, k)
            solved = unpack(list(rows.kept[i][k]), rows.specs[i])
            a, b, (last, memory) = contact_passes.relax(row, solved, a, b, setup)
            new = CachedConstraint(memory, jnp.full(self.chunk, past.step, self._dtype), None, None)
            if self.setup.contacts:
                event = record_event(self._event(past, lines.at(place.row)), solved, last, time)
                new = new._replace(event=event, elasticity=row.elasticity)
                mark = 2 * past.step + jnp.where((event.flags & ON) > 0, 1, 0)
                old = marks.at[place.row].get(mode=SAFE)
                marks = marks.at[place.row].set(jnp.where(contact_passes.touching(solved, last), mark, old), mode=SAFE)
            return a, b, (lines.put(place.row, new).lines, marks)

        groups = [(motion, drift.push, work) for motion, drift, work in zip(motions, drifts, works, strict=True)]
        marks = past.marks or [jnp.zeros(0, jnp.int32)] * len(self.kinds)
        carries = list(zip(past.lines, marks, strict=True))
        groups, carries = self._pass(groups, [(motion, None, None) for _, motion in walls], found, carries, play)
        depth, begins = past.depth, past.begins
        for deep, began in rows.seen:
            depth, begins = jnp.maximum(depth, deep), begins + began
        past = past._replace(
            lines=[lines for lines, _ in carries],
            marks=[marks for _, marks in carries] if self.setup.contacts else [],
            stores=[PassBuffers(*of) for of in zip(found.places, found.kept, rows.kept, strict=True)],
            depth=depth,
            begins=begins,
            step=past.step + 1,
        )
        return [motion for motion, *_ in groups], [work for *_, work in groups], past

    # ---- What happened

    def _event(self, past: NearbyCarry, line: CachedConstraint) -> ContactEvent:
        """A row's event in this frame so far: what an older one says counts only for whether it touched before."""
        assert line.event is not None, "lines hold events where contacts are kept"
        current, ended = line.stamp >= past.first, line.stamp == past.first - 1  # it is of the last frame's last step
        fresh = began_touching(line.event._replace(flags=jnp.where(ended, line.event.flags, 0)))
        return jax.tree.map(lambda x, y: jnp.where(current, x, y), line.event, fresh)

    def frame_begins(self, past: NearbyCarry) -> NearbyCarry:
        """The same, with nothing seen in the frame yet."""
        return past._replace(first=past.step)

    def frame_ends(self, past: NearbyCarry) -> tuple[NearbyCarry, None]:
        """The same, with the rows of contacts of the frame."""
        if past.written is None or past.contact_rows is None:
            return past, None
        written, contact_rows = past.written, past.contact_rows
        for kind, lines, marks in zip(self.kinds, past.lines, past.marks, strict=True):
            recent = marks[:-1].reshape(*kind.a.shape, self._lanes) >= 2 * past.first - 1
            words = bits_of(recent)
            written = self._tell(past, kind, PackedTable(lines, self._spec(kind)), words, written, contact_rows)
            contact_rows = contact_rows.at[:-1].add(
                jnp.sum(count_active(words).reshape(-1, self._lanes), axis=0, dtype=jnp.int32)
            )
        return past._replace(written=written, contact_rows=contact_rows), None

    def _tell(
        self, past: NearbyCarry, kind: PairBatch, lines: PackedTable, words: Array, written: Array, contact_rows: Array
    ) -> Array:
        """What is written, and the rows of a kind with a bit in words [R, W n]; `contact_rows` have been before."""
        n, rows = self._lanes, active_pairs(words, self.chunk)
        counts = count_active(words).reshape(-1, n)
        before = contact_rows[:-1] + jnp.cumsum(counts, axis=0, dtype=jnp.int32) - counts  # by round and word
        spec = pack(_empty_contact_rows(self._dtype), (1,), self._dtype)[1]
        slots = [jnp.asarray(x.reshape(-1), jnp.int32) for x in kind.slots]
        room, width = (len(written) - 1) // n, words.shape[1]
        number = past.step // jnp.maximum(past.step - past.first, 1)

        def chunk(k: Array, written: Array) -> Array:
            spot = row_lookup(rows, k, self.chunk)
            place = self._place(kind, spot, _pairs(kind))
            line = lines.at(place.row)
            event, last = self._event(past, line), line.stamp == (past.step - 1).astype(self._dtype)
            event = event._replace(flags=jnp.where(last, event.flags, event.flags & ~ON))
            new = pair_event(event, line.elasticity)
            began = past.first.astype(self._dtype) * self.rules.step  # when an end without a touch is contact_rows
            new = new._replace(time=jnp.where(new.time >= 0, new.time, began))
            word = jnp.minimum(spot.round * width + spot.word, before.size - 1)
            rank = before.reshape(-1).at[word].get(mode=SAFE) + spot.rank
            where = jnp.where(spot.there & (rank < room), rank * n + place.lane, room * n)
            row = jnp.minimum(place.row // n, kind.a.size - 1)
            a, b = (x.at[row].get(mode=SAFE) for x in slots)
            return PackedTable(written, spec).put(where, ContactRow(new, jnp.full_like(a, number), a, b)).lines

        return jax.lax.fori_loop(0, rows.starts[-1], chunk, written)

    def ended(self, past: NearbyCarry, _: None, slots: int, fps: float) -> tuple[Array, Array, Contacts | None]:
        """Of the whole video: the deepest overlap, m, how many contacts began, and up to `slots` rows of contacts."""
        depth, begins = past.depth[:-1], past.begins[:-1]
        if past.written is None or past.contact_rows is None:
            return depth, begins, None
        spec = pack(_empty_contact_rows(self._dtype), (1,), self._dtype)[1]
        contact_rows, count = PackedTable(past.written, spec).whole((slots, self._lanes)), past.contact_rows[:-1]
        filled = jnp.arange(slots)[:, None] < count
        order = order_of(jnp.where(filled, contact_rows.pair_event.time, jnp.inf))

        def in_order(x: Array) -> Array:
            x = jnp.where(filled, x, jnp.zeros_like(x))
            return jnp.take_along_axis(x, jnp.broadcast_to(order, x.shape), axis=-2)

        return depth, begins, contacts_of(*jax.tree.map(in_order, contact_rows), count=count)


def _pairs(kind: PairBatch) -> np.ndarray:
    """The pairs of each round, one for each bit."""
    return np.broadcast_to(np.arange(kind.a.shape[1]), kind.a.shape)


def _empty_contact_rows(dtype: Any) -> ContactRow:
    nothing = pair_event(empty_events((1,), dtype), jnp.zeros(1, dtype))
    return ContactRow(nothing, *[jnp.zeros(1, jnp.int32)] * 3)


def chunk_of(lanes: int) -> int:
    """How many rows to solve at once with so many scenes: a few times fewer than are near in a round."""
    return min(max(16, 1 << (lanes // 16).bit_length()), 256)
