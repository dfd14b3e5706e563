"""Only the rows that are near: found anew in every step, gathered, solved a chunk at a time; what a CPU likes.

A step looks at all pairs once, for a bit each: whether they may meet in it. The bits are counted, and the three passes
run over chunks of rows of one round (tournament.py), of all scenes at once: such rows share no body, so the order in a
chunk does not matter, and the rounds come in dense.py's order. What is not near would have been solved for nothing.
Bodies, and what a row remembers, lie in tables with one line each, so that a gather copies whole lines.

The loops end when the rows do, so there is no reverse-mode gradient here: dense.py has it.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d import sweeps
from gen2d.contacts import Disc, Hull, Shape, Stadium, dot, from_core
from gen2d.events import BEFORE, ON, Event, Happening, happening, noted, unseen
from gen2d.rows import Impulse, Motion, Row, Rules
from gen2d.sweeps import Drift, Memory, Setup
from gen2d.tables import Spec, gathered, numbers, rebuilt, scattered, table, untabled
from gen2d.tournament import league, settled
from gen2d.types import Array, Contacts

BITS = 16  # of a word: so few that a float32 holds it exactly
BLOCK = 32  # words that are searched at once
NEVER = -2  # the step of what has not happened
PAST = "promise_in_bounds"


class Post(NamedTuple):
    """A fixed body, as rows need it beside its shape; leaves [..., 1, n]."""

    side: Any
    left: tuple[Array, Array] | None  # see `rows.Row`
    right: tuple[Array, Array] | None
    present: Array


class Seat(NamedTuple):
    """What stays the same of the bodies of a group; leaves [..., N, n]."""

    side: Any
    gravity: Array
    threshold: Array


@dataclasses.dataclass(frozen=True)
class Kind:
    """Rows that are solved by the same operations: a match of two groups, or of some fixed bodies with a group."""

    first: int | None  # a group; None: fixed bodies
    walls: tuple[int, ...]  # which
    second: int
    a: np.ndarray  # [R, P] who meets in each of R rounds, by their numbers in their group, or among the walls
    b: np.ndarray
    slots: tuple[np.ndarray, np.ndarray]  # [R, P] theirs
    ring: np.ndarray  # [N - 1] of one group: see `ring_of`; else empty
    pair: np.ndarray  # [R, bits] which pair of a round a bit stands for
    row: Callable[[Any, Any], Row]  # from both sides
    points: int


class Listed(NamedTuple):
    """The rows of a kind that are near, by round, then word and scene, then bit."""

    words: Array  # [R, W n] uint32
    before: Array  # [R, W n] how many of the round come before this word's
    total: Array  # [R]
    starts: Array  # [R + 1] the first chunk of each round


class Place(NamedTuple):
    """Where the rows of a chunk are, each [C]; all of these are past the end where there is no row."""

    a: Array  # lines of the tables of their bodies
    b: Array
    row: Array  # and of the table of rows
    lane: Array


class Store(NamedTuple):
    """What a step's passes tell each other of the rows of a kind, by chunk."""

    place: Array  # [K, 4, C]
    found: Array  # [K, F, C]
    solved: Array


class Found(NamedTuple):
    """What the first pass tells the others: how many chunks each kind has, what they keep, and how to read it."""

    chunks: list[Array]
    places: list[Array]
    kept: list[Array]
    specs: list[Spec]


class Line(NamedTuple):
    """What is remembered of a row; of impulses nothing, if it is older than the last step."""

    memory: Memory
    stamp: Array  # the step that wrote it
    event: Event | None
    elasticity: Array | None


class Past(NamedTuple):
    """What all rows hand on from step to step."""

    lines: list[Array]  # of each kind, a line for each row: see `Line`
    marks: list[Array]  # [R P n + 1] twice the last step in which a row touched, and one more if it stayed in touch
    stores: list[Store] | None  # room to write into; None: nobody knows yet how much
    depth: Array  # [n + 1] m
    begins: Array  # [n + 1]
    step: Array
    first: Array  # the frame's first step
    written: Array | None  # contacts: a line for each row and scene
    told: Array | None  # [n + 1] how many rows of contacts there are so far


class Told(NamedTuple):
    """A row of contacts as it is written."""

    happening: Happening
    frame: Array
    a: Array
    b: Array


def around(shape: Shape) -> Array:
    """The radius of a circle around a shape's centre that holds it, m."""
    if isinstance(shape, Disc):
        return shape.radius
    if isinstance(shape, Stadium):
        return shape.half_length + shape.radius
    offsets = [v - shape.centre for v in shape.vertices]
    furthest = dot(offsets[0], offsets[0])
    for offset in offsets[1:]:
        furthest = jnp.maximum(furthest, dot(offset, offset))
    return jnp.sqrt(furthest) + shape.radius


def clearance(wall: Shape, centre: Array) -> Array:
    """How far a point is from a wall, m; never more than it is."""
    if isinstance(wall, Hull):
        sides = [dot(n, centre - v) for n, v in zip(wall.normals, wall.vertices, strict=True)]
        furthest = sides[0]
        for side in sides[1:]:
            furthest = jnp.maximum(furthest, side)
        return furthest - wall.radius
    offset = centre - wall.centre if isinstance(wall, Disc) else from_core(wall, centre)[0]
    return jnp.sqrt(dot(offset, offset)) - wall.radius


def ring_of(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the rounds of a tournament [R, P]: an order of all but number 0, and the pair of each round and bit.

    In this order the one at t meets, in round k, the one at k - t modulo R, or number 0 if that is itself (the circle
    method). So all who meet one of them lie side by side. Bit t stands for the pair in which the one at t is the
    first, the last bit for number 0's.
    """
    rounds, _ = a.shape
    ring = np.empty(rounds, int)
    of_0 = np.where(a == 0, b, 0).sum(1) + np.where(b == 0, a, 0).sum(1)
    ring[np.arange(rounds) * (rounds + 1) // 2 % rounds] = of_0
    at = np.argsort(np.concatenate([[0], ring]))[1:] - 1 if rounds > 0 else ring
    at = np.concatenate([[rounds], at])  # where each number stands; number 0 comes last
    pair = np.zeros((rounds, rounds + 1), int)
    for k, p in np.ndindex(a.shape):
        i, j = at[a[k, p]], at[b[k, p]]
        zero = rounds in (i, j)
        assert zero or (i + j) % rounds == k, "a tournament is played by the circle method"
        pair[k, rounds if zero else min(i, j)] = p
    return ring, pair


def words_of(near: Array, one: Array) -> Array:
    """Booleans [R, P, n] as bits of words [R, W n]."""
    bits = 2.0 ** (np.arange(near.shape[1]) % BITS)[:, None]
    marked = jnp.where(near, bits.astype(np.float32), 0.0)
    columns = [marked[:, p] for p in range(near.shape[1])]
    parts = [functools.reduce(jnp.add, columns[i : i + BITS]) for i in range(0, len(columns), BITS)]
    return jnp.concatenate(settled(parts, one), axis=1).astype(jnp.uint32)


def _near_in_ring(centre: Array, reach: Array, ring: np.ndarray, one: Array) -> Array:
    """The bits of a tournament [R, W n], whose bodies have centres [2, N, n] and reaches [N, n]."""
    rounds = len(ring)
    own = jnp.concatenate([centre, reach[None]])
    others = own[:, ring]
    twice = jnp.concatenate([others, others], axis=1)
    parts = [jnp.zeros((rounds, reach.shape[-1]), jnp.float32) for _ in range(-(-(rounds + 1) // BITS))]
    turns = np.arange(rounds)
    for t in range(rounds + 1):
        if t < rounds:
            a, b = others[:, t : t + 1], twice[:, -t % rounds : -t % rounds + rounds]
            first = (turns - t) % rounds > t
        else:
            a, b = own[:, :1], own[:, ring[turns * (rounds + 1) // 2 % rounds]]
            first = turns >= 0
        apart, reach = b[:2] - a[:2], a[2] + b[2]
        near = (dot(apart, apart) < reach * reach) & first[:, None]
        parts[t // BITS] = parts[t // BITS] + jnp.where(near, np.float32(2.0 ** (t % BITS)), 0.0)
    return jnp.concatenate(settled(parts, one), axis=1).astype(jnp.uint32)


def _largest(values: Array) -> Array:
    """Along the first axis; XLA's own reduction of a maximum is ten times slower on a CPU."""
    while (count := values.shape[0]) > 1:
        values = jnp.maximum(values[: (count + 1) // 2], values[count // 2 :])
    return values[0]


def listed(words: Array, chunk: int) -> Listed:
    """The rows with a bit in words [R, W n]."""
    words = jnp.pad(words, ((0, 0), (0, -words.shape[1] % BLOCK)))
    counts = jax.lax.population_count(words).astype(jnp.int32)
    upto = _summed(counts)
    total = upto[:, -1]
    starts = jnp.cumsum(-(-total // chunk))
    return Listed(words, upto - counts, total, jnp.pad(starts, (1, 0)))


def _summed(counts: Array) -> Array:
    """Cumulative sums [R, n] along the last axis, by blocks: jnp.cumsum takes time n^2 on a CPU."""
    inside = jnp.cumsum(counts.reshape(len(counts), -1, BLOCK), axis=-1)
    whole = jnp.cumsum(inside[..., -1], axis=-1)
    return (inside + (whole - inside[..., -1])[..., None]).reshape(counts.shape)


class Spot(NamedTuple):
    """Rows of a chunk, each [C], as `Listed` counts them."""

    round: Array  # one for all
    word: Array
    bit: Array
    rank: Array  # among the word's
    there: Array


def _spot(rows: Listed, k: Array, chunk: int) -> Spot:
    """The rows of chunk k."""
    turn = jnp.sum(rows.starts[1:] <= k)
    rank = (k - rows.starts[turn]) * chunk + jnp.arange(chunk)
    there = rank < rows.total[turn]
    # The last word that as many come before: by blocks of words, then in its block.
    blocks = rows.before[turn].reshape(-1, BLOCK)
    block = jnp.sum(blocks[:, 0] <= rank[:, None], axis=1) - 1
    inside = blocks.at[block].get(mode=PAST)
    which = jnp.sum(inside <= rank[:, None], axis=1) - 1
    word, before = block * BLOCK + which, blocks.reshape(-1)
    rank = rank - before.at[word].get(mode="promise_in_bounds")
    bits, bit, rest = rows.words[turn].at[word].get(mode="promise_in_bounds"), jnp.zeros(chunk, jnp.int32), rank
    for half in (8, 4, 2, 1):
        low = jax.lax.population_count(bits & jnp.uint32((1 << half) - 1)).astype(jnp.int32)
        up = rest >= low
        rest, bit = jnp.where(up, rest - low, rest), jnp.where(up, bit + half, bit)
        bits = jnp.where(up, bits >> half, bits)
    return Spot(turn, word, bit, rank, there)


@dataclasses.dataclass(frozen=True)
class Sparse:
    """All rows of a video, of which only those are solved whose bodies are near each other."""

    kinds: list[Kind]
    seats: list[Seat]  # by group
    posts: list[list[Post]]  # by kind: of its fixed bodies
    rolling: bool  # whether anything resists rolling
    setup: Setup
    rules: Rules
    chunk: int  # rows that are solved at once

    @property
    def _lanes(self) -> int:
        return self.setup.threshold.shape[-1]

    @property
    def _dtype(self) -> Any:
        return self.setup.threshold.dtype

    def start(self, contacts: int) -> Past:
        """What the first step begins with."""
        n, count = self._lanes, jnp.zeros(self._lanes + 1, jnp.int32)
        first = [numbers(self._nothing(kind), (1,), self._dtype)[0] for kind in self.kinds]
        told = numbers(_told_nothing(self._dtype), (1,), self._dtype)[0]
        return Past(
            lines=[
                jnp.broadcast_to(jnp.concatenate(line), (kind.a.size * n + 1, len(line)))
                for kind, line in zip(self.kinds, first, strict=True)
            ],
            marks=[jnp.full(kind.a.size * n + 1, NEVER, jnp.int32) for kind in self.kinds] if contacts else [],
            stores=None,
            depth=count.astype(self._dtype),
            begins=count,
            step=jnp.zeros((), jnp.int32),
            first=jnp.zeros((), jnp.int32),
            written=jnp.zeros((contacts * n + 1, len(told)), self._dtype) if contacts else None,
            told=count if contacts else None,
        )

    def with_room(self, past: Past, after: Past) -> Past:
        """The same with room for what a step, whose result looks like `after`, has to write."""
        return past._replace(stores=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), after.stores))

    def _nothing(self, kind: Kind) -> Line:
        def zero() -> Array:
            return jnp.zeros(1, self._dtype)

        memory = Memory([Impulse(zero(), zero()) for _ in range(kind.points)], zero() if self.rolling else None)
        event = jax.tree.map(jnp.copy, unseen((1,), self._dtype)) if self.setup.contacts else None
        return Line(memory, zero() + NEVER, event, zero() if self.setup.contacts else None)

    # ---- Which rows are near

    def _near(self, shapes: list[Shape], walls: list[tuple], motions: list[Motion]) -> list[Listed]:
        """The rows of each kind that may meet in this step."""
        squares = [dot(motion.velocity, motion.velocity) for motion in motions]
        fastest = jnp.zeros(self._lanes, self._dtype)
        for square in squares:
            fastest = jnp.maximum(fastest, _largest(square))
        fastest = jnp.sqrt(fastest)
        for shape, motion in walls:
            if motion is not None:
                speed = jnp.sqrt(dot(motion.velocity, motion.velocity)) + jnp.abs(motion.spin) * around(shape)
                fastest = jnp.maximum(fastest, speed[0])
        # Two that meet come no faster than both do now, or than the fastest of all has made one of them.
        half = 0.5 * self.rules.step * fastest
        ways = [self.rules.step * jnp.sqrt(square) + half for square in squares]
        # What is not there reaches not a number, which is more than nothing.
        reaches = [
            jnp.where(seat.side.present, around(shape) + way, jnp.nan)
            for shape, seat, way in zip(shapes, self.seats, ways, strict=True)
        ]
        bodies = [(shape.centre, reach) for shape, reach in zip(shapes, reaches, strict=True)]
        return [
            listed(self._bits(kind, posts, bodies, walls, half), self.chunk)
            for kind, posts in zip(self.kinds, self.posts, strict=True)
        ]

    def _bits(self, kind: Kind, posts: list[Post], bodies: list[tuple], walls: list[tuple], half: Array) -> Array:
        """A bit for each row that is near, in words [R, W n]."""
        (centre, reach), one = bodies[kind.second], self.setup.one
        if kind.first is None:
            here = [jnp.where(post.present, 0.0, jnp.nan) for post in posts]
            gaps = [clearance(walls[i][0], centre) - reach - half + x for i, x in zip(kind.walls, here, strict=True)]
            return words_of(jnp.stack(settled(gaps, one)) < 0, one)
        if kind.first == kind.second:
            return _near_in_ring(centre, reach, kind.ring, one)

        def play(_: int, a: tuple, b: tuple) -> tuple[tuple, tuple, Array]:
            apart, reach = b[0] - a[0], a[1] + b[1]
            return a, b, settled(dot(apart, apart) - reach * reach, one)

        return words_of(jnp.stack(league(bodies[kind.first], (centre, reach), play)[2]) < 0, one)

    def _place(self, kind: Kind, rows: Listed, k: Array) -> tuple[Place, Spot]:
        spot, n, (_, pairs), bits = _spot(rows, k, self.chunk), self._lanes, kind.a.shape, kind.pair.shape[1]
        lane, bit = spot.word % n, jnp.minimum(spot.word // n * BITS + spot.bit, bits - 1)
        row = spot.round * pairs + jnp.asarray(kind.pair.reshape(-1), jnp.int32).at[spot.round * bits + bit].get(
            mode=PAST
        )
        a, b = (jnp.asarray(x.reshape(-1), jnp.int32).at[row].get(mode=PAST) for x in (kind.a, kind.b))
        last = self._size(kind.second)
        ends = len(kind.walls) if kind.first is None else self._size(kind.first), last, kind.a.size
        lines = (jnp.where(spot.there, x * n + lane, end * n) for x, end in zip((a, b, row), ends, strict=True))
        return Place(*lines, jnp.where(spot.there, lane, n)), spot

    def _size(self, group: int) -> int:
        return self.seats[group].threshold.shape[0]

    # ---- The passes

    def _room(self, kind: Kind) -> int:
        """How many chunks there may be."""
        rounds, pairs = kind.a.shape
        return rounds * -(-pairs * self._lanes // self.chunk)

    def _of_fixed(self, trees: list[Any]) -> tuple[Array, Spec]:
        """A table of fixed bodies, whose trees have leaves [..., 1, n]."""
        whole = jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *trees)
        return table(whole, (len(trees), self._lanes), self._dtype)

    def _written(self, kind: Kind, room: Array | None, k: Array, values: Array) -> Array:
        if room is None:
            return jnp.zeros((self._room(kind), *values.shape), values.dtype)
        return room.at[k].set(values, mode=PAST)

    def _pass(
        self,
        groups: list[Any],
        walls: list[Any],
        counts: list[Array],
        places: list[Array],
        carries: list[Any],
        play: Callable,
        dry: bool,
    ) -> tuple[list[Any], list[Any]]:
        """The groups, and what is carried for each kind, after all rows that are near.

        `places` are the `Store.place` of each kind, `play(i, k, place, a, b, carried)` gives both sides of the rows of
        its chunk k and what is carried on.
        """
        one, shapes, carries = self.setup.one, [seat.threshold.shape for seat in self.seats], list(carries)
        made = [table(group, shape, self._dtype) for group, shape in zip(groups, shapes, strict=True)]
        tables, specs = [lines for lines, _ in made], [spec for _, spec in made]
        for i, kind in enumerate(self.kinds):
            mine = [kind.second] if kind.first is None or kind.first == kind.second else [kind.first, kind.second]
            fixed = None
            if kind.first is None:
                fixed = self._of_fixed([walls[j] for j in kind.walls])

            def chunk(
                k: Array, state: tuple, i: int = i, kind: Kind = kind, mine: list = mine, fixed: Any = fixed
            ) -> tuple:
                now, carried = dict(zip(mine, state[0], strict=True)), state[1]
                place = Place(*places[i][k])
                if fixed is not None:
                    a = gathered(fixed[0], place.a, fixed[1])
                else:
                    a = gathered(now[kind.first], place.a, specs[kind.first])
                b = gathered(now[kind.second], place.b, specs[kind.second])
                a, b, carried = play(i, k, place, a, b, carried)
                if kind.first is not None:
                    now[kind.first] = scattered(now[kind.first], place.a, a, one)
                now[kind.second] = scattered(now[kind.second], place.b, b, one)
                return [now[g] for g in mine], carried

            start = [tables[g] for g in mine], carries[i]
            after, carries[i] = (
                chunk(jnp.zeros((), jnp.int32), start) if dry else jax.lax.fori_loop(0, counts[i], chunk, start)
            )
            for g, lines in zip(mine, after, strict=True):
                tables[g] = lines
        return [untabled(*of) for of in zip(tables, specs, shapes, strict=True)], carries

    def warm(
        self, past: Past, bodies: list[tuple], walls: list[tuple], motions: list[Motion], works: list
    ) -> tuple[list[Motion], list, Found]:
        """Motions and works with the last step's impulses, and which rows there are.

        `bodies` are shapes and accelerations, the latter None where all fall alike; `walls` are shapes and motions,
        the latter None where they stand still.
        """
        near = self._near([shape for shape, _ in bodies], walls, motions)
        seats = [table(s, s.threshold.shape, self._dtype) for s in self.seats]
        posts = [
            seats[kind.first] if kind.first is not None else self._of_fixed(some)
            for kind, some in zip(self.kinds, self.posts, strict=True)
        ]
        lines = [numbers(self._nothing(kind), (1,), self._dtype)[1] for kind in self.kinds]
        specs: dict[int, Spec] = {}

        def play(i: int, k: Array, place: Place, a: Any, b: Any, room: Array | None) -> tuple:
            kind = self.kinds[i]
            first, seat = gathered(posts[i][0], place.a, posts[i][1]), gathered(*_of(seats[kind.second], place.b))
            line = gathered(past.lines[i], place.row, lines[i])
            fresh = line.stamp == (past.step - 1).astype(self._dtype)
            memory = jax.tree.map(lambda x: jnp.where(fresh, x, 0.0), line.memory)
            row = kind.row(first.side, seat.side)
            if isinstance(first, Post):
                row = row._replace(left=first.left, right=first.right)
            setup = self.setup._replace(gravity=seat.gravity, threshold=seat.threshold)
            a, b, points = sweeps.warm(row, memory, a, b, setup)
            kept, specs[i] = numbers((row, memory, points, seat.threshold), (self.chunk,), self._dtype)
            kept = settled(jnp.stack(kept), self.setup.one)
            return a, b, self._written(kind, room, k, kept)

        dry = past.stores is None
        rooms = [None] * len(self.kinds) if past.stores is None else [store.found for store in past.stores]
        groups = [(shape, m, fall, w) for (shape, fall), m, w in zip(bodies, motions, works, strict=True)]
        fixed = [(*wall, None, None) for wall in walls]
        counts = [rows.starts[-1] for rows in near]
        places = self._places(near, past.stores)
        groups, kept = self._pass(groups, fixed, counts, places, rooms, play, dry)
        found = Found(counts, places, kept, [specs[i] for i in range(len(self.kinds))])
        return [motion for _, motion, *_ in groups], [work for *_, work in groups], found

    def _places(self, near: list[Listed], stores: list[Store] | None) -> list[Array]:
        """Where the rows of all chunks are: for themselves, or they would be computed again for every gather."""
        if stores is None:
            return [jnp.zeros((self._room(kind), len(Place._fields), self.chunk), jnp.int32) for kind in self.kinds]

        def placed(i: int) -> Array:
            def chunk(k: Array, room: Array) -> Array:
                place, _ = self._place(self.kinds[i], near[i], k)
                return room.at[k].set(jnp.stack(place), mode=PAST)

            return jax.lax.fori_loop(0, near[i].starts[-1], chunk, stores[i].place)

        return [placed(i) for i in range(len(self.kinds))]

    def _again(self, found: Found, i: int, k: Array) -> tuple[Row, Memory, list, Setup]:
        """What the first pass has kept of a chunk of rows."""
        row, memory, points, threshold = rebuilt(list(found.kept[i][k]), found.specs[i])
        return row, memory, points, self.setup._replace(threshold=threshold)

    def solve(
        self, past: Past, found: Found, walls: list[tuple], motions: list[Motion], drifts: list, works: list
    ) -> tuple[list[Motion], list[Drift], list, Any]:
        """Motions, drifts and works after the biased pass, and what it has to say of the rows."""
        specs: dict[int, Spec] = {}

        def play(i: int, k: Array, place: Place, a: Any, b: Any, carried: tuple) -> tuple:
            room, depth, begins = carried
            row, memory, points, setup = self._again(found, i, k)
            a, b, solved = sweeps.solve(row, memory, points, a, b, setup, self.rules)
            kept, specs[i] = numbers(solved, (self.chunk,), self._dtype)
            deep, began = sweeps.seen(solved, memory)
            depth, begins = depth.at[place.lane].max(deep), begins.at[place.lane].add(began.astype(jnp.int32))
            kept = settled(jnp.stack(kept), self.setup.one)
            return a, b, (self._written(self.kinds[i], room, k, kept), depth, begins)

        dry = past.stores is None
        nothing = jnp.zeros_like(past.depth), jnp.zeros_like(past.begins)
        rooms = [(None if past.stores is None else past.stores[i].solved, *nothing) for i in range(len(self.kinds))]
        groups = list(zip(motions, drifts, works, strict=True))
        fixed = [(motion, None, None) for _, motion in walls]
        groups, carries = self._pass(groups, fixed, found.chunks, found.places, rooms, play, dry)
        motions, drifts, works = (list(values) for values in zip(*groups, strict=True))
        return motions, drifts, works, (found, carries, specs)

    def relax(
        self, past: Past, rows: Any, walls: list[tuple], motions: list[Motion], drifts: list, works: list, time: Array
    ) -> tuple[list[Motion], list, Past]:
        """Motions and works after the relaxing pass, and what all rows hand on; the step began at `time`."""
        found, before, specs = rows
        lines = [numbers(self._nothing(kind), (1,), self._dtype)[1] for kind in self.kinds]

        def play(i: int, k: Array, place: Place, a: Any, b: Any, carried: tuple) -> tuple:
            table_, marks = carried
            row, _, _, setup = self._again(found, i, k)
            solved = rebuilt(list(before[i][0][k]), specs[i])
            a, b, (last, memory) = sweeps.relax(row, solved, a, b, setup)
            stamp = jnp.full(self.chunk, past.step, self._dtype)
            new = Line(memory, stamp, None, None)
            if self.setup.contacts:
                event = self._event(past, gathered(table_, place.row, lines[i]))
                event = noted(event, solved, last, time, self.setup.one)
                new = Line(memory, stamp, event, row.elasticity)
                touching = sweeps.touching(solved, last)
                mark = 2 * past.step + jnp.where((event.flags & ON) > 0, 1, 0)
                old = marks.at[place.row].get(mode=PAST)
                marks = marks.at[place.row].set(jnp.where(touching, mark, old), mode=PAST)
            return a, b, (scattered(table_, place.row, new, self.setup.one), marks)

        groups = [(motion, drift.push, work) for motion, drift, work in zip(motions, drifts, works, strict=True)]
        fixed = [(motion, None, None) for _, motion in walls]
        marks = past.marks or [jnp.zeros(0)] * len(self.kinds)
        carries = list(zip(past.lines, marks, strict=True))
        groups, carries = self._pass(groups, fixed, found.chunks, found.places, carries, play, past.stores is None)
        depth, begins = past.depth, past.begins
        for _, deep, began in before:
            depth, begins = jnp.maximum(depth, deep), begins + began
        now = past._replace(
            lines=[table_ for table_, _ in carries],
            marks=[marks for _, marks in carries] if self.setup.contacts else [],
            stores=[Store(*of, solved) for *of, (solved, *_) in zip(found.places, found.kept, before, strict=True)],
            depth=depth,
            begins=begins,
            step=past.step + 1,
        )
        return [motion for motion, *_ in groups], [work for *_, work in groups], now

    # ---- What happened

    def _event(self, past: Past, line: Line) -> Event:
        """A row's event in this frame so far: what an older one says counts only for whether it touched before."""
        assert line.event is not None, "lines hold events where contacts are kept"
        current = line.stamp >= past.first
        touched = ((line.event.flags & ON) > 0) & (line.stamp == past.first - 1)
        fresh = unseen(line.stamp.shape, self._dtype)
        fresh = fresh._replace(flags=jnp.where(touched, ON | BEFORE, 0))
        return jax.tree.map(lambda x, y: jnp.where(current, x, y), line.event, fresh)

    def frame_begins(self, past: Past) -> Past:
        """The same, with nothing seen in the frame yet."""
        return past._replace(first=past.step)

    def frame_ends(self, past: Past) -> tuple[Past, None]:
        """The same, with the rows of contacts of the frame."""
        if past.written is None or past.told is None:
            return past, None
        written, count, n = past.written, past.told, self._lanes
        began = past.first.astype(self._dtype) * self.rules.step
        frame = past.step // jnp.maximum(past.step - past.first, 1)
        for kind, lines, marks in zip(self.kinds, past.lines, past.marks, strict=True):
            rounds, pairs = kind.a.shape
            recent = marks[:-1].reshape(rounds, pairs, n) >= 2 * past.first - 1
            words = words_of(recent, self.setup.one)
            kind = dataclasses.replace(kind, pair=np.broadcast_to(np.arange(pairs), kind.a.shape))  # a bit each
            rows = listed(words, self.chunk)
            counts = jax.lax.population_count(words).astype(jnp.int32).reshape(-1, n)
            before = (jnp.cumsum(counts, axis=0) - counts).reshape(-1)
            spec = numbers(self._nothing(kind), (1,), self._dtype)[1]
            slots = [jnp.asarray(x.reshape(-1), jnp.int32) for x in kind.slots]

            def chunk(k: Array, written: Array, kind: Kind = kind, rows: Listed = rows, lines: Array = lines,
                      before: Array = before, spec: Spec = spec, slots: list = slots, count: Array = count) -> Array:  # fmt: skip
                place, spot = self._place(kind, rows, k)
                line = gathered(lines, place.row, spec)
                event = self._event(past, line)
                last = line.stamp == (past.step - 1).astype(self._dtype)
                event = event._replace(flags=jnp.where(last, event.flags, event.flags & ~ON))
                told = happening(event, line.elasticity)
                told = told._replace(time=jnp.where(told.time >= 0, told.time, began))
                pair = jnp.minimum(place.row // n, kind.a.size - 1)
                a, b = (x.at[pair].get(mode=PAST) for x in slots)
                word = jnp.minimum(spot.round * (before.size // len(kind.a)) + spot.word, before.size - 1)
                rank = count[place.lane] + before.at[word].get(mode=PAST) + spot.rank
                room = (written.shape[0] - 1) // n
                where = jnp.where(spot.there & (rank < room), rank * n + place.lane, room * n)
                frames = jnp.full(self.chunk, frame, jnp.int32)
                return scattered(written, where, Told(told, frames, a, b), self.setup.one)

            written = jax.lax.fori_loop(0, rows.starts[-1], chunk, written)
            count = count.at[:-1].add(jnp.sum(counts, axis=0))
        return past._replace(written=written, told=count), None

    def ended(self, past: Past, _: None, slots: int, fps: float) -> tuple[Array, Array, Contacts | None]:
        """Of the whole video: the deepest overlap, m, how many contacts began, and up to `slots` rows of contacts."""
        depth, begins = past.depth[:-1], past.begins[:-1]
        if past.written is None or past.told is None:
            return depth, begins, None
        count = past.told[:-1]
        told = untabled(past.written, numbers(_told_nothing(self._dtype), (1,), self._dtype)[1], (slots, self._lanes))
        filled = jnp.arange(slots)[:, None] < count
        order = jnp.argsort(jnp.where(filled, told.happening.time, jnp.inf), axis=0, stable=True)

        def taken(x: Array) -> Array:
            x = jnp.where(filled, x, jnp.zeros_like(x))
            return jnp.take_along_axis(x, jnp.broadcast_to(order, x.shape), axis=-2)

        told = jax.tree.map(taken, told)
        kind, time, place, normal, approach, separation, normal_impulse, tangent_impulse = told.happening
        return depth, begins, Contacts(
            time=time,
            frame=told.frame,
            a=told.a.astype(jnp.int16),
            b=told.b.astype(jnp.int16),
            point=place,
            normal=normal,
            normal_impulse=normal_impulse,
            tangent_impulse=tangent_impulse,
            approach_speed=approach,
            separation_speed=separation,
            kind=kind,
            count=count,
        )  # fmt: skip


def _told_nothing(dtype: Any) -> Told:
    zero, vector = (lambda: jnp.zeros(1, dtype)), (lambda: jnp.zeros((2, 1), dtype))
    happened = Happening(jnp.zeros(1, jnp.uint8), zero(), vector(), vector(), *(zero() for _ in range(4)))
    return Told(happened, *(jnp.zeros(1, jnp.int32) for _ in range(3)))


def _of(made: tuple[Array, Spec], where: Array) -> tuple[Array, Array, Spec]:
    return made[0], where, made[1]


def chunk_of(lanes: int) -> int:
    """How many rows to solve at once, with so many scenes."""
    return max(16, min(256, 1 << max(lanes // 16, 1).bit_length()))
