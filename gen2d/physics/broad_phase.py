"""Which rows are near: a bit for each pair, counted, and found again by its place in the count.

The bits of a round lie in words, one for each scene and `BITS` pairs. A round's rows are solved in chunks; `row_lookup`
says which bits those of a chunk are. All rows of a chunk are of one round, of any scene, so they share no body.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.collision import Disc, Hull, Shape, Stadium, dot, from_core
from gen2d.physics.packing import SAFE
from gen2d.records.axes import Array
from gen2d.xla import materialize

BITS = 16  # of a word: so few that a float32 holds it exactly
BLOCK = 32  # words that are searched at once


def bounding_radius(shape: Shape) -> Array:
    """The radius of a circle around a shape's centre that holds it, m."""
    if isinstance(shape, Disc):
        return shape.radius
    if isinstance(shape, Stadium):
        return shape.half_length + shape.radius
    offsets = [vertex - shape.centre for vertex in shape.vertices]
    return jnp.sqrt(functools.reduce(jnp.maximum, [dot(x, x) for x in offsets])) + shape.radius


def signed_distance(wall: Shape, centre: Array) -> Array:
    """How far a point is from a wall, m; of a hull, from the line through the side that it is beyond most."""
    if isinstance(wall, Hull):
        sides = [dot(n, centre - v) for n, v in zip(wall.normals, wall.vertices, strict=True)]
        return functools.reduce(jnp.maximum, sides) - wall.radius
    offset = centre - wall.centre if isinstance(wall, Disc) else from_core(wall, centre)[0]
    return jnp.sqrt(dot(offset, offset)) - wall.radius


class RoundRobin(NamedTuple):
    """A tournament of N numbers in R = N - 1 rounds, by the circle method.

    In the order of `numbers` the one at t meets, in round k, the one at k - t modulo R; number 0, which has no place
    in it, meets the one that would meet itself. So all whom one meets, round by round, lie side by side.
    """

    numbers: np.ndarray  # [R] all but 0
    of_first: np.ndarray  # [R] the places of those whom number 0 meets
    pair: np.ndarray  # [R, N] the pair of a round in which the one at t comes first; last, that of number 0


def round_robin_of(a: np.ndarray, b: np.ndarray) -> RoundRobin:
    """The ring of a tournament, from who meets in each pair of its rounds [R, P]."""
    rounds = len(a)
    turns = np.arange(rounds)
    of_first = turns * (rounds + 1) // 2 % rounds  # half of k modulo R
    ring = np.empty(rounds, int)
    ring[of_first] = np.where(a == 0, b, 0).sum(1) + np.where(b == 0, a, 0).sum(1)
    place = np.full(rounds + 1, rounds)
    place[ring] = turns
    pair = np.zeros((rounds, rounds + 1), int)
    for k, p in np.ndindex(a.shape):
        i, j = place[a[k, p]], place[b[k, p]]
        zero = rounds in (i, j)
        assert zero or (i + j) % rounds == k, "a tournament is played by the circle method"
        pair[k, rounds if zero else min(i, j)] = p
    return RoundRobin(ring, of_first, pair)


def bits_of(near: Array) -> Array:
    """Booleans [R, P, n] as bits of words [R, W n]."""
    bit = np.float32(2) ** (np.arange(near.shape[1]) % BITS)[:, None].astype(np.float32)
    marked = jnp.where(near, bit, np.float32(0))
    columns = [marked[:, p] for p in range(near.shape[1])]
    words = [functools.reduce(jnp.add, columns[i : i + BITS]) for i in range(0, len(columns), BITS)]
    return jnp.concatenate(materialize(words), axis=1).astype(jnp.uint32)


def bits_in_round_robin(centre: Array, reach: Array, ring: RoundRobin) -> Array:
    """The bits of a tournament [R, W n]: which of those with centres [2, N, n] and reaches [N, n] overlap, m."""
    rounds = len(ring.numbers)
    everyone = jnp.concatenate([centre, reach[None]])
    others = everyone[:, ring.numbers]
    twice, turns = jnp.concatenate([others, others], axis=1), np.arange(rounds)
    words = [jnp.zeros((rounds, reach.shape[-1]), jnp.float32) for _ in range(0, rounds + 1, BITS)]

    def meet(t: int, a: Array, b: Array, counts: np.ndarray) -> None:
        apart, both = b[:2] - a[:2], a[2] + b[2]
        near = (dot(apart, apart) < both * both) & counts[:, None]
        words[t // BITS] = words[t // BITS] + jnp.where(near, np.float32(2 ** (t % BITS)), np.float32(0))

    for t in range(rounds):
        beside = -t % rounds  # whom it meets, from round 0 on
        meet(t, others[:, t : t + 1], twice[:, beside : beside + rounds], (turns - t) % rounds > t)
    meet(rounds, everyone[:, :1], others[:, ring.of_first], turns >= 0)
    return jnp.concatenate(materialize(words), axis=1).astype(jnp.uint32)


class ActivePairs(NamedTuple):
    """The rows that are near, by round, then word, then bit."""

    words: Array  # [R, W n] uint32, and some empty ones
    before: Array  # [R, W n] how many of the round come before this word's
    total: Array  # [R]
    starts: Array  # [R + 1] the first chunk of each round; last, how many chunks there are


def count_active(words: Array) -> Array:
    """How many bits each word has."""
    return jax.lax.population_count(words).astype(jnp.int32)


def active_pairs(words: Array, chunk: int) -> ActivePairs:
    """The rows with a bit in words [R, W n], in chunks of so many."""
    words = jnp.pad(words, ((0, 0), (0, -words.shape[1] % BLOCK)))
    counts = count_active(words)
    # By blocks, as jnp.cumsum takes time n^2 on a CPU.
    inside = jnp.cumsum(counts.reshape(len(counts), -1, BLOCK), axis=-1, dtype=jnp.int32)
    blocks = jnp.cumsum(inside[..., -1], axis=-1, dtype=jnp.int32)
    upto = (inside + (blocks - inside[..., -1])[..., None]).reshape(counts.shape)
    starts = jnp.cumsum(-(-upto[:, -1] // chunk), dtype=jnp.int32)
    return ActivePairs(words, upto - counts, upto[:, -1], jnp.pad(starts, (1, 0)))


class RowLookup(NamedTuple):
    """Rows of a chunk, each [C], as `ActivePairs` counts them; anything where there is none."""

    round: Array  # one for all
    word: Array
    bit: Array
    rank: Array  # among the word's
    there: Array


def row_lookup(rows: ActivePairs, k: Array, chunk: int) -> RowLookup:
    """The rows of chunk k."""
    turn = jnp.sum(rows.starts[1:] <= k, dtype=jnp.int32)
    place = (k - rows.starts[turn]) * chunk + jnp.arange(chunk, dtype=jnp.int32)
    there = place < rows.total[turn]
    # The last word that no more come before: by blocks of words, then in its block.
    blocks = rows.before[turn].reshape(-1, BLOCK)
    block = jnp.sum(blocks[:, 0] <= place[:, None], axis=1, dtype=jnp.int32) - 1
    within = jnp.sum(blocks.at[block].get(mode=SAFE) <= place[:, None], axis=1, dtype=jnp.int32) - 1
    word = block * BLOCK + within
    rank = place - rows.before[turn].at[word].get(mode=SAFE)
    # The bit with as many below it: by halves of the word.
    bits, bit, left = rows.words[turn].at[word].get(mode=SAFE), jnp.zeros(chunk, jnp.int32), rank
    for half in (8, 4, 2, 1):
        low = count_active(bits & jnp.uint32((1 << half) - 1))
        above = left >= low
        left, bit = jnp.where(above, left - low, left), jnp.where(above, bit + half, bit)
        bits = jnp.where(above, bits >> half, bits)
    return RowLookup(turn, word, bit, rank, there)
