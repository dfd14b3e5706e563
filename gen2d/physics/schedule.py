"""Every pair that can meet, as many at a time as share no body, without gather or scatter.

Bodies of one group meet in a round-robin tournament, by the circle method (`round_robin`). Bodies of two groups meet
while one group moves past the other (`bipartite_rounds`). A static body meets all of a group at once. `run_schedule`
plays all rounds, one after the other.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.records.axes import Array


def split_halves(values: Any) -> tuple[Any, Any]:
    """Two half-arrays over the bodies (the axis before the scenes'): each of the first meets one of the second."""
    count = jax.tree.leaves(values)[0].shape[-2] // 2
    return jax.tree.map(lambda x: x[..., :count, :], values), jax.tree.map(lambda x: x[..., count:, :], values)


def join_halves(first: Any, second: Any) -> Any:
    """The inverse of `split_halves`."""
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y], axis=-2), first, second)


def rotate(first: Any, second: Any) -> tuple[Any, Any]:
    """Both halves after one rotation of the circle method; N - 1 of them come back to the start."""

    def one_half(x: Array, y: Array) -> Array:
        return jnp.concatenate([x[..., :1, :], y[..., :1, :], x[..., 1:-1, :]], axis=-2)

    def other_half(x: Array, y: Array) -> Array:
        return jnp.concatenate([y[..., 1:, :], x[..., -1:, :]], axis=-2)

    if jax.tree.leaves(first)[0].shape[-2] == 1:
        return first, second
    return jax.tree.map(one_half, first, second), jax.tree.map(other_half, first, second)


def round_robin(values: Any, rounds: int, play: Callable) -> tuple[Any, list]:
    """The bodies after all rounds, and what `play(k, first, second) -> (first, second, out)` gave in each."""
    first, second, outs = *split_halves(values), []
    for k in range(rounds):
        first, second, out = play(k, first, second)
        outs.append(out)
        first, second = rotate(first, second)
    return join_halves(first, second), outs


def bipartite_rounds(first: Any, second: Any, play: Callable) -> tuple[Any, Any, list]:
    """Both groups after every one of the first has met every one of the second, and what each round gave."""
    n, m = (jax.tree.leaves(x)[0].shape[-2] for x in (first, second))
    few, outs = min(n, m), []
    for k in range(max(n, m)):
        a, b = (jax.tree.map(lambda x: x[..., :few, :], group) for group in (first, second))
        a, b, out = play(k, a, b)
        outs.append(out)
        first, second = (a, _turned(second, b)) if m >= n else (_turned(first, a), b)
    return first, second, outs


def _turned(group: Any, played: Any) -> Any:
    """The group with those that played put back, and its first moved to the end."""

    def moved(x: Array, y: Array) -> Array:
        return jnp.concatenate([y[..., 1:, :], x[..., y.shape[-2] :, :], y[..., :1, :]], axis=-2)

    return jax.tree.map(moved, group, played)


class Match(NamedTuple):
    """Who meets in it: two groups, one group (twice), or a fixed body and a group; and in how many rounds."""

    first: int
    second: int
    rounds: int
    fixed: bool = False


def matches(sizes: list[int], fixed: int) -> list[Match]:
    """Every match of groups of these sizes and of fixed bodies, which come last and so have the last word."""
    found = [Match(g, g, n - 1) for g, n in enumerate(sizes) if n > 1]
    found += [Match(g, h, max(n, m)) for h, m in enumerate(sizes) for g, n in enumerate(sizes[:h])]
    return found + [Match(f, g, 1, fixed=True) for f in range(fixed) for g in range(len(sizes))]


def match_of_rows(order: list[Match]) -> list[Match]:
    """The match of each row: a match has one row a round."""
    return [match for match in order for _ in range(match.rounds)]


def pairings(first: int, second: int, match: Match) -> tuple[np.ndarray, np.ndarray]:
    """Who meets in each round of a match, [R, P], by their numbers in their groups."""

    def play(_: int, a: Array, b: Array) -> tuple[Array, Array, tuple[Array, Array]]:
        return a, b, (a[:, 0], b[:, 0])

    with jax.ensure_compile_time_eval():
        a, b = (jnp.arange(size)[:, None] for size in (first, second))
        *_, rounds = round_robin(a, match.rounds, play) if match.first == match.second else bipartite_rounds(a, b, play)
        a, b = (np.array([np.asarray(side) for side in sides]) for sides in zip(*rounds, strict=True))
    return a, b


def run_schedule(groups: list, fixed: list, order: list[Match], play: Callable) -> tuple[list, list]:
    """The groups after all matches, and what `play(row, a, b) -> (a, b, out)` gave for each row, counted from 0."""
    groups, outs = list(groups), []
    for match in order:
        begun, (i, j) = len(outs), match[:2]

        def one(k: int, a: Any, b: Any, begun: int = begun) -> tuple:
            return play(begun + k, a, b)

        if match.fixed:
            _, groups[j], out = play(begun, fixed[i], groups[j])
            out = [out]
        elif i == j:
            groups[i], out = round_robin(groups[i], match.rounds, one)
        else:
            groups[i], groups[j], out = bipartite_rounds(groups[i], groups[j], one)
        outs += out
    return groups, outs
