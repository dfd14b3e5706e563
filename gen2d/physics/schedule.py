"""Round-robin schedule of the pairs that can touch, in rounds of disjoint pairs, without gather or scatter.

Bodies of one group meet by the circle method (`round_robin`). Bodies of two groups meet while one group moves past the
other (`bipartite_rounds`). A static body meets a whole group at once. `run_schedule` plays all rounds in order.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array


def rotate(first: Any, second: Any) -> tuple[Any, Any]:
    """Both halves after one rotation of the circle method; N - 1 rotations restore the start."""

    def rotate_first(x: Array, y: Array) -> Array:
        return jnp.concatenate([x[..., :1, :], y[..., :1, :], x[..., 1:-1, :]], axis=-2)

    def rotate_second(x: Array, y: Array) -> Array:
        return jnp.concatenate([y[..., 1:, :], x[..., -1:, :]], axis=-2)

    if jax.tree.leaves(first)[0].shape[-2] == 1:
        return first, second
    return jax.tree.map(rotate_first, first, second), jax.tree.map(rotate_second, first, second)


def round_robin(values: Any, rounds: int, play: Callable) -> tuple[Any, list]:
    """Bodies [..., N, n] after all rounds, and the `out` of `play(k, first, second) -> (first, second, out)` in each.

    Each body of the first half meets one of the second.
    """
    count, outs = jax.tree.leaves(values)[0].shape[-2] // 2, []
    first = jax.tree.map(lambda x: x[..., :count, :], values)
    second = jax.tree.map(lambda x: x[..., count:, :], values)
    for k in range(rounds):
        first, second, out = play(k, first, second)
        outs.append(out)
        first, second = rotate(first, second)
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y], axis=-2), first, second), outs


def bipartite_rounds(first: Any, second: Any, play: Callable) -> tuple[Any, Any, list]:
    """Both groups after each body of the first has met each of the second, and the `out` of each round."""
    n, m = (jax.tree.leaves(x)[0].shape[-2] for x in (first, second))
    few, outs = min(n, m), []

    def shift(x: Array, y: Array) -> Array:
        """The group x with those that played, y, put back, and its first body moved to the end."""
        return jnp.concatenate([y[..., 1:, :], x[..., y.shape[-2] :, :], y[..., :1, :]], axis=-2)

    for k in range(max(n, m)):
        a, b = (jax.tree.map(lambda x: x[..., :few, :], group) for group in (first, second))
        a, b, out = play(k, a, b)
        outs.append(out)
        first, second = (a, jax.tree.map(shift, second, b)) if m >= n else (jax.tree.map(shift, first, a), b)
    return first, second, outs


class Match(NamedTuple):
    """Rounds of two groups, of one group (named twice), or of a static body and a group."""

    first: int
    second: int
    rounds: int
    static: bool = False


def matches(sizes: list[int], statics: int) -> list[Match]:
    """Matches of groups of these sizes and of static bodies, which come last."""
    order = [Match(g, g, n - 1) for g, n in enumerate(sizes) if n > 1]
    order += [Match(g, h, max(n, m)) for h, m in enumerate(sizes) for g, n in enumerate(sizes[:h])]
    return order + [Match(f, g, 1, static=True) for f in range(statics) for g in range(len(sizes))]


def pairings(first: int, second: int, match: Match) -> tuple[np.ndarray, np.ndarray]:
    """Pairs [R, P] of each round of a match, by their numbers in two groups of these sizes."""

    def play(_: int, a: Array, b: Array) -> tuple[Array, Array, tuple[Array, Array]]:
        return a, b, (a[:, 0], b[:, 0])

    with jax.ensure_compile_time_eval():
        a, b = (jnp.arange(size)[:, None] for size in (first, second))
        *_, rounds = round_robin(a, match.rounds, play) if match.first == match.second else bipartite_rounds(a, b, play)
        a, b = (np.array([np.asarray(side) for side in sides]) for sides in zip(*rounds, strict=True))
    return a, b


def run_schedule(groups: list, statics: list, order: list[Match], play: Callable) -> tuple[list, list]:
    """Groups after all matches, and the `out` of `play(k, a, b) -> (a, b, out)` in each round, counted from 0."""
    groups, outs = list(groups), []
    for match in order:
        start, (i, j) = len(outs), match[:2]

        def play_round(k: int, a: Any, b: Any, start: int = start) -> tuple:
            return play(start + k, a, b)

        if match.static:
            _, groups[j], out = play(start, statics[i], groups[j])
            out = [out]
        elif i == j:
            groups[i], out = round_robin(groups[i], match.rounds, play_round)
        else:
            groups[i], groups[j], out = bipartite_rounds(groups[i], groups[j], play_round)
        outs += out
    return groups, outs
