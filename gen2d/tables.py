"""Trees of arrays as tables: a line for each thing, a column for each number, so that a gather copies whole lines."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.types import Array


class Leaf(NamedTuple):
    """Where a leaf's numbers begin, what stands before its last axes, and its type."""

    first: int
    lead: tuple[int, ...]
    dtype: Any


class Spec(NamedTuple):
    """How a tree is made of numbers again; a leaf that is no array is kept as it is."""

    tree: Any
    leaves: list[Any]


def numbers(tree: Any, shape: tuple[int, ...], dtype: Any) -> tuple[list[Array], Spec]:
    """Every number of the tree, each an array of `shape`, and how to get the tree back.

    Leaves are arrays [..., *shape], or broadcast to that; one that stands in the tree twice is taken once.
    """
    leaves, treedef = jax.tree.flatten(tree)
    found: list[Array] = []
    known: dict[int, Leaf] = {}
    parts: list[Any] = []
    for leaf in leaves:
        if isinstance(leaf, bool):
            parts.append(leaf)
            continue
        if id(leaf) not in known:
            lead = leaf.shape[: max(leaf.ndim - len(shape), 0)]
            known[id(leaf)] = Leaf(len(found), lead, leaf.dtype)
            found += list(jnp.broadcast_to(leaf, (*lead, *shape)).reshape(-1, *shape).astype(dtype))
        parts.append(known[id(leaf)])
    return found, Spec(treedef, parts)


def rebuilt(found: Sequence[Array], spec: Spec) -> Any:
    """The tree of its numbers."""

    def leaf(part: Any) -> Any:
        if not isinstance(part, Leaf):
            return part
        if not part.lead:
            return found[part.first].astype(part.dtype)
        count = 1
        for size in part.lead:
            count *= size
        stacked = jnp.stack(list(found[part.first : part.first + count]))
        return stacked.reshape(*part.lead, *stacked.shape[1:]).astype(part.dtype)

    return jax.tree.unflatten(spec.tree, [leaf(part) for part in spec.leaves])


def table(tree: Any, shape: tuple[int, ...], dtype: Any) -> tuple[Array, Spec]:
    """Leaves [..., N, n] as a table of N n lines and one of zeros, and how to get them back."""
    found, spec = numbers(tree, shape, dtype)
    columns = [x.reshape(-1) for x in found] or [jnp.zeros(math.prod(shape), dtype)]
    lines = jnp.stack(columns, axis=-1)
    return jnp.pad(lines, ((0, 1), (0, 0))), spec


def untabled(lines: Array, spec: Spec, shape: tuple[int, ...]) -> Any:
    """The tree of a table."""
    return rebuilt([column.reshape(shape) for column in lines[:-1].T], spec)


def gathered(lines: Array, where: Array, spec: Spec) -> Any:
    """The tree with leaves [..., C] of some lines of a table."""
    return rebuilt(list(lines.at[where].get(mode="promise_in_bounds").T), spec)


def scattered(lines: Array, where: Array, tree: Any, one: Array) -> Array:
    """The table with other lines there, which may be the same only where they do not matter."""
    found, _ = numbers(tree, where.shape, lines.dtype)
    return lines.at[where].set((jnp.stack(found) / one).T, mode="promise_in_bounds")
