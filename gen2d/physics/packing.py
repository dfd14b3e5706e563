"""Trees of arrays as tables: a line for each thing, a column for each number, so that a gather copies whole lines."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.xla import materialize

SAFE = "promise_in_bounds"  # of indices; JAX's own check would cost a pass over them


class LeafSpec(NamedTuple):
    """Where a leaf's numbers begin, what stands before its last axes, and its type."""

    first: int
    lead: tuple[int, ...]
    dtype: Any


class TableSpec(NamedTuple):
    """How a tree is made of numbers again; a leaf that is no array is kept as it is."""

    tree: Any
    leaves: list[Any]


def pack(tree: Any, shape: tuple[int, ...], dtype: Any, once: bool = False) -> tuple[list[Array], TableSpec]:
    """Every number of the tree, each an array of `shape`, and how to get the tree back.

    Leaves are arrays [..., *shape], or broadcast to that; with `once` the same array is taken only once, wherever it
    stands.
    """
    leaves, treedef = jax.tree.flatten(tree)
    found: list[Array] = []
    known: dict[int, LeafSpec] = {}
    parts: list[Any] = []
    for leaf in leaves:
        if isinstance(leaf, bool):
            parts.append(leaf)
            continue
        if not once or id(leaf) not in known:
            lead = leaf.shape[: max(leaf.ndim - len(shape), 0)]
            known[id(leaf)] = LeafSpec(len(found), lead, leaf.dtype)
            found += list(jnp.broadcast_to(leaf, (*lead, *shape)).reshape(-1, *shape).astype(dtype))
        parts.append(known[id(leaf)])
    return found, TableSpec(treedef, parts)


def unpack(found: Sequence[Array], spec: TableSpec) -> Any:
    """The tree of its numbers."""

    def leaf(part: Any) -> Any:
        if not isinstance(part, LeafSpec):
            return part
        own = found[part.first : part.first + math.prod(part.lead)]
        whole = jnp.stack(list(own)).reshape(*part.lead, *own[0].shape) if part.lead else own[0]
        return whole.astype(part.dtype)

    return jax.tree.unflatten(spec.tree, [leaf(part) for part in spec.leaves])


class PackedTable(NamedTuple):
    """The numbers of things, a line each, and a last line that is nobody's."""

    lines: Array  # [N n + 1, F]
    spec: TableSpec

    def at(self, where: Array) -> Any:
        """The tree with leaves [..., C] of some lines."""
        return unpack(list(self.lines.at[where].get(mode=SAFE).T), self.spec)

    def put(self, where: Array, tree: Any) -> "PackedTable":
        """The table with other lines there; two may be the same only if they are the last."""
        found, _ = pack(tree, where.shape, self.lines.dtype)
        if not found:
            return self
        return self._replace(lines=self.lines.at[where].set(materialize(jnp.stack(found)).T, mode=SAFE))

    def whole(self, shape: tuple[int, ...]) -> Any:
        """The tree with leaves [..., *shape] of all lines but the last."""
        return unpack([column.reshape(shape) for column in self.lines[:-1].T], self.spec)


def make_table(tree: Any, shape: tuple[int, ...], dtype: Any) -> PackedTable:
    """Leaves [..., *shape] as a table of as many lines, and one of zeros."""
    found, spec = pack(tree, shape, dtype)
    columns = [x.reshape(-1) for x in found] or [jnp.zeros(math.prod(shape), dtype)]
    return PackedTable(jnp.pad(jnp.stack(columns, axis=-1), ((0, 1), (0, 0))), spec)


def repeat_rows(tree: Any, count: int, dtype: Any) -> PackedTable:
    """A table of `count` lines, each of them this tree of leaves [..., 1], and one more."""
    found, spec = pack(tree, (1,), dtype)
    return PackedTable(jnp.broadcast_to(jnp.concatenate(found), (count + 1, len(found))), spec)
