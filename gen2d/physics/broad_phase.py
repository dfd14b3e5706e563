"""Broad phase: a bit for each pair that is near, counted, and found again by its rank.

The bits of a round lie in words, one for each scene and `BITS` pairs. Near pairs are solved in chunks; `row_lookup`
finds the bits of a chunk. All pairs of a chunk are of one round, of any scene, so they share no body.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.physics.collision import Disc, Hull, Shape, Stadium, dot, offset_from_core
from gen2d.physics.packing import SAFE
from gen2d.records.axes import Array
from gen2d.xla import materialize

BITS = 16  # bits of a word, which a float32 holds exactly
BLOCK = 32  # words searched at once


def bounding_radius(shape: Shape) -> Array:
    """Radius of the smallest circle about a shape's centre that holds it, m."""
    if isinstance(shape, Disc):
        return shape.radius
    if isinstance(shape, Stadium):
        return shape.half_length + shape.radius
    offsets = [vertex - shape.centre for vertex in shape.vertices]
    return jnp.sqrt(functools.reduce(jnp.maximum, [dot(x, x) for x in offsets])) + shape.radius


def signed_distance(shape: Shape, centre: Array) -> Array:
    """Distance of a point from a shape, m; for a hull, the largest distance from the line through a side."""
    if isinstance(shape, Hull):
        sides = [dot(n, centre - v) for n, v in zip(shape.normals, shape.vertices, strict=True)]
        return functools.reduce(jnp.maximum, sides) - shape.radius
    offset = centre - shape.centre if isinstance(shape, Disc) else offset_from_core(shape, centre)[0]
    return jnp.sqrt(dot(offset, offset)) - shape.radius


class RoundRobin(NamedTuple):
    """Round robin of N bodies in R = N - 1 rounds, by the circle method.

    In round k the body at place t of `numbers` meets the one at place k - t modulo R; body 0, which has no place, meets
    the one that would meet itself. So the opponents of a body, round by round, lie side by side.
    """

    numbers: np.ndarray  # [R] all but 0
    of_first: np.ndarray  # [R] the places of the opponents of body 0
    pair: np.ndarray  # [R, N] by round, the pair that the body at place t leads; last, that of body 0


def round_robin_of(a: np.ndarray, b: np.ndarray) -> RoundRobin:
    """Round robin from the pairs of its rounds [R, P]."""
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
        assert zero or (i + j) % rounds == k, "pairs are not those of the circle method"
        pair[k, rounds if zero else min(i, j)] = p
    return RoundRobin(ring, of_first, pair)


def bits_of(near: Array) -> Array:
    """Words [R, W n] of booleans [R, P, n]."""
    bit = np.float32(2) ** (np.arange(near.shape[1]) % BITS)[:, None].astype(np.float32)
    bits = jnp.where(near, bit, np.float32(0))
    columns = [bits[:, p] for p in range(near.shape[1])]
    words = [functools.reduce(jnp.add, columns[i : i + BITS]) for i in range(0, len(columns), BITS)]
    return jnp.concatenate(materialize(words), axis=1).astype(jnp.uint32)


def bits_in_round_robin(centre: Array, reach: Array, ring: RoundRobin) -> Array:
    """Words [R, W n] of the pairs of a round robin whose circles overlap: centres [2, N, n], radii [N, n], m."""
    rounds = len(ring.numbers)
    circles = jnp.concatenate([centre, reach[None]])
    others = circles[:, ring.numbers]
    twice, turns = jnp.concatenate([others, others], axis=1), np.arange(rounds)
    words = [jnp.zeros((rounds, reach.shape[-1]), jnp.float32) for _ in range(0, rounds + 1, BITS)]

    def meet(t: int, a: Array, b: Array, counts: np.ndarray) -> None:
        offset, both = b[:2] - a[:2], a[2] + b[2]
        near = (dot(offset, offset) < both * both) & counts[:, None]
        words[t // BITS] = words[t // BITS] + jnp.where(near, np.float32(2 ** (t % BITS)), np.float32(0))

    for t in range(rounds):
        start = -t % rounds  # its opponents, from round 0 on
        meet(t, others[:, t : t + 1], twice[:, start : start + rounds], (turns - t) % rounds > t)
    meet(rounds, circles[:, :1], others[:, ring.of_first], turns >= 0)
    return jnp.concatenate(materialize(words), axis=1).astype(jnp.uint32)


class ActivePairs(NamedTuple):
    """Near pairs, by round, then word, then bit."""

    words: Array  # [R, W n] uint32, padded with empty ones
    before: Array  # [R, W n] pairs of the round in earlier words
    total: Array  # [R]
    starts: Array  # [R + 1] the first chunk of each round; last, the number of chunks


def count_active(words: Array) -> Array:
    """Number of bits of each word."""
    return jax.lax.population_count(words).astype(jnp.int32)


def active_pairs(words: Array, chunk: int) -> ActivePairs:
    """Pairs with a bit in words [R, W n], in chunks of `chunk` pairs."""
    words = jnp.pad(words, ((0, 0), (0, -words.shape[1] % BLOCK)))
    counts = count_active(words)
    # In blocks, as jnp.cumsum takes quadratic time on a CPU; those of a block by a product of matrices, which is exact.
    in_blocks = counts.reshape(len(counts), -1, BLOCK).astype(jnp.float32)
    inside = (in_blocks @ np.triu(np.ones((BLOCK, BLOCK), np.float32))).astype(jnp.int32)
    blocks = jnp.cumsum(inside[..., -1], axis=-1, dtype=jnp.int32)
    upto = (inside + (blocks - inside[..., -1])[..., None]).reshape(counts.shape)
    starts = jnp.cumsum(-(-upto[:, -1] // chunk), dtype=jnp.int32)
    return ActivePairs(words, upto - counts, upto[:, -1], jnp.pad(starts, (1, 0)))


class RowLookup(NamedTuple):
    """Pairs of a chunk, each [C]; any values where there is no pair."""

    round: Array  # a scalar
    word: Array
    bit: Array
    rank: Array  # in the word
    there: Array


def row_lookup(rows: ActivePairs, k: Array, chunk: int) -> RowLookup:
    """Pairs of chunk k."""
    current = jnp.sum(rows.starts[1:] <= k, dtype=jnp.int32)
    place = (k - rows.starts[current]) * chunk + jnp.arange(chunk, dtype=jnp.int32)
    there = place < rows.total[current]
    # The last word with at most as many pairs before it: by blocks of words, then in the block.
    blocks = rows.before[current].reshape(-1, BLOCK)
    block = jnp.sum(blocks[:, 0] <= place[:, None], axis=1, dtype=jnp.int32) - 1
    within = jnp.sum(blocks.at[block].get(mode=SAFE) <= place[:, None], axis=1, dtype=jnp.int32) - 1
    word = block * BLOCK + within
    rank = place - rows.before[current].at[word].get(mode=SAFE)
    # The bit with `rank` bits below it, by halving the word.
    bits, bit, left = rows.words[current].at[word].get(mode=SAFE), jnp.zeros(chunk, jnp.int32), rank
    for half in (8, 4, 2, 1):
        low = count_active(bits & jnp.uint32((1 << half) - 1))
        above = left >= low
        left, bit = jnp.where(above, left - low, left), jnp.where(above, bit + half, bit)
        bits = jnp.where(above, bits >> half, bits)
    return RowLookup(current, word, _materialize_integers(bit), rank, there)


def _materialize_integers(values: Array) -> Array:
    """The same small integers, computed once and not again for each of their uses."""
    return materialize(values.astype(jnp.float32)).astype(values.dtype)
