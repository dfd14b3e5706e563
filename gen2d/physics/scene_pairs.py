"""Near pairs of a few scenes, listed anew in small chunks.

What only a few scenes of a thousand need in a step is done for the pairs of these alone, a group of scenes at a time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics.broad_phase import active_pairs, row_lookup
from gen2d.physics.packing import SAFE, get_row, put_row
from gen2d.physics.pair_batches import ListedPairs, PairBatches
from gen2d.records.axes import Array
from gen2d.xla import materialize

CHUNK = 16  # pairs of them that are solved at once


class SceneChunk(NamedTuple):
    """Pairs of a chunk, each [C]."""

    a: Array  # rows of the bodies' tables; the last ones where there is no pair
    b: Array
    pair: Array  # rows of the pairs' tables
    scene: Array  # beyond the last one where there is no pair
    chunk: Array  # place in the buffers of the passes; beyond the end where there is no pair
    lane: Array
    member: Array  # number of the scene in its group

    def bodies(self, scenes: int, group: int) -> tuple[Array, Array]:
        """Rows of both bodies in tables of the group alone, of so many scenes."""
        return self.a // scenes * group + self.member, self.b // scenes * group + self.member

    def columns(self, buffer: Array) -> list[Array]:
        """Columns of a buffer [K, F, C]."""
        return list(buffer.at[self.chunk, :, self.lane].get(mode="clip").T)

    def put(self, buffer: Array, values: list[Array]) -> Array:
        """Buffer with these columns."""
        return buffer.at[self.chunk, :, self.lane].set(materialize(jnp.stack(values)).T, mode="drop")


class SceneList(NamedTuple):
    """Pairs of a batch in some scenes."""

    chunks: Array  # how many there are
    indices: Array  # [K, 7, C] `SceneChunk` of each

    def run(self, play: Callable, carry: Any) -> Any:
        """Carry after `play(k, chunk, carry)` of all chunks k."""

        def chunk(k: Array, carry: Any) -> Any:
            return play(k, SceneChunk(*get_row(self.indices, k)), carry)

        return jax.lax.fori_loop(0, self.chunks, chunk, carry)


class ScenePairs:
    """Near pairs of a step, of which those of some scenes are listed, a group at a time.

    With `in_rounds`, the pairs of a chunk share no body.
    """

    def __init__(
        self, solver: PairBatches, listed: ListedPairs, group: int, chunk: int = CHUNK, in_rounds: bool = False
    ) -> None:
        self._solver, self._listed, self._group, self._chunk = solver, listed, group, chunk
        self._in_rounds = in_rounds

    def empty(self, i: int) -> Array:
        """Buffer for the `SceneList` of a batch."""
        rounds, pairs = self._solver.batches[i].a.shape
        rows = rounds if self._in_rounds else 1
        most = rows * -(-rounds // rows * pairs * self._group // self._chunk)
        return jnp.zeros((most, len(SceneChunk._fields), self._chunk), jnp.int32)

    def run(self, chosen: Array, buffers: dict[int, Array], play: Callable, carry: Any) -> tuple[dict[int, Array], Any]:
        """Buffers, and the carry after `play(lists, scenes, carry)` of all groups of the chosen scenes [n].

        `lists` has a `SceneList` of each batch with a buffer, `scenes` the numbers of the group's scenes; those beyond
        the last scene are of none.
        """
        scenes, size = self._solver.scenes, self._group
        groups = active_pairs(chosen[None].astype(jnp.uint32), size)

        def group(k: Array, state: tuple) -> tuple:
            lookup = row_lookup(groups, k, size)
            of_group = jnp.where(lookup.there, lookup.word, scenes)
            lists = {i: self._list(i, of_group, buffer) for i, buffer in state[0].items()}
            return {i: pairs.indices for i, pairs in lists.items()}, play(lists, of_group, state[1])

        return jax.lax.fori_loop(0, groups.starts[-1], group, (buffers, carry))

    def contacts(self, i: int, own: SceneChunk) -> tuple[Any, ...]:
        """Constraint, impulses, points and setup of a chunk of pairs."""
        return self._solver.unpack_contacts(own.columns(self._listed.packed[i]), self._listed.specs[i])

    def _list(self, i: int, chosen: Array, buffer: Array) -> SceneList:
        """Near pairs of a batch in chosen scenes; numbers beyond the last scene are of none."""
        near, batch, solver = self._listed.near[i], self._solver.batches[i], self._solver
        scenes, size, rounds = solver.scenes, len(chosen), len(batch.a)
        words = near.words[:, : near.words.shape[1] // scenes * scenes].reshape(rounds, -1, scenes)
        words = jnp.where(chosen < scenes, words.at[..., chosen].get(mode="clip"), jnp.uint32(0))
        width, rows = words.shape[1] * size, rounds if self._in_rounds else 1
        active = active_pairs(words.reshape(rows, -1), self._chunk)

        def chunk(k: Array, listed: Array) -> Array:
            lookup = row_lookup(active, k, self._chunk)
            place = jnp.minimum(lookup.round * width + lookup.word, rounds * width - 1)
            member = place % size
            scene = jnp.minimum(chosen[member], scenes - 1)
            lookup = lookup._replace(round=place // width, word=place % width // size * scenes + scene)
            rank = near.before.at[lookup.round, lookup.word].get(mode=SAFE) + lookup.rank
            first = near.starts.at[lookup.round].get(mode=SAFE)
            place = jnp.where(lookup.there, first + rank // solver.chunk, len(self._listed.packed[i]))
            indices = solver.chunk_indices(batch, lookup, batch.pair_of_bit)
            member = jnp.where(lookup.there, member, 0)
            return put_row(listed, k, jnp.stack(SceneChunk(*indices, place, rank % solver.chunk, member)))

        return SceneList(active.starts[-1], jax.lax.fori_loop(0, active.starts[-1], chunk, buffer))
