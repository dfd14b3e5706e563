"""Trees of arrays packed as tables with a column for each number, so that a gather copies whole rows."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array
from gen2d.xla import materialize

SAFE = "promise_in_bounds"  # indices need no check, which would cost a pass over them


class LeafSpec(NamedTuple):
    """First column, leading axes and type of a leaf."""

    first: int
    lead: tuple[int, ...]
    dtype: Any


class TableSpec(NamedTuple):
    """How to unpack a tree; a leaf that is not an array stands for itself."""

    tree: Any
    leaves: list[Any]

    @property
    def places(self) -> Any:
        """The tree with the `LeafSpec` of each leaf in its place."""
        return jax.tree.unflatten(self.tree, self.leaves)


def pack(tree: Any, shape: tuple[int, ...], dtype: Any, once: bool = False) -> tuple[list[Array], TableSpec]:
    """Columns of a tree, arrays of `shape`, and how to unpack it.

    Leaves are arrays [..., *shape] or broadcast to that. With `once`, an array that occurs twice is packed once.
    """
    leaves, treedef = jax.tree.flatten(tree)
    columns: list[Array] = []
    known: dict[int, LeafSpec] = {}
    parts: list[Any] = []
    for leaf in leaves:
        if isinstance(leaf, bool):
            parts.append(leaf)
            continue
        if not once or id(leaf) not in known:
            lead = leaf.shape[: max(leaf.ndim - len(shape), 0)]
            known[id(leaf)] = LeafSpec(len(columns), lead, leaf.dtype)
            columns += list(jnp.broadcast_to(leaf, (*lead, *shape)).reshape(-1, *shape).astype(dtype))
        parts.append(known[id(leaf)])
    return columns, TableSpec(treedef, parts)


def unpack(columns: Sequence[Array], spec: TableSpec) -> Any:
    """Tree of packed columns."""

    def leaf(part: Any) -> Any:
        if not isinstance(part, LeafSpec):
            return part
        own = columns[part.first : part.first + math.prod(part.lead)]
        array = jnp.stack(list(own)).reshape(*part.lead, *own[0].shape) if part.lead else own[0]
        return array.astype(part.dtype)

    return jax.tree.unflatten(spec.tree, [leaf(part) for part in spec.leaves])


class PackedTable(NamedTuple):
    """Packed rows, and a last row for indices of nothing."""

    rows: Array  # [N n + 1, F]
    spec: TableSpec

    def at(self, where: Array) -> Any:
        """Tree with leaves [..., C] of some rows."""
        return unpack(list(self.rows.at[where].get(mode=SAFE).T), self.spec)

    def at_both(self, a: Array, b: Array) -> tuple[Any, Any]:
        """Trees of the rows `a` and `b`, by one gather."""
        both, count = self.at(jnp.concatenate([a, b])), len(a)
        return jax.tree.map(lambda x: x[..., :count], both), jax.tree.map(lambda x: x[..., count:], both)

    def put(self, where: Array, tree: Any) -> "PackedTable":
        """Table with some rows replaced; only the last row may occur more than once."""
        columns, _ = pack(tree, where.shape, self.rows.dtype)
        if not columns:
            return self
        return self._replace(rows=self.rows.at[where].set(materialize(jnp.stack(columns)).T, mode=SAFE))

    def put_both(self, a: Array, tree_a: Any, b: Array, tree_b: Any) -> "PackedTable":
        """Table with the rows `a` and `b` replaced, by one scatter: between two, the compiler would copy the table."""
        both = jax.tree.map(lambda x, y: jnp.concatenate([x, y], axis=-1), tree_a, tree_b)
        return self.put(jnp.concatenate([a, b]), both)

    def unpack(self, shape: tuple[int, ...]) -> Any:
        """Tree with leaves [..., *shape] of all rows but the last."""
        return unpack([column.reshape(shape) for column in self.rows[:-1].T], self.spec)


def make_table(tree: Any, shape: tuple[int, ...], dtype: Any) -> PackedTable:
    """Table of a tree with leaves [..., *shape], with a last row of zeros."""
    columns, spec = pack(tree, shape, dtype)
    columns = [x.reshape(-1) for x in columns] or [jnp.zeros(math.prod(shape), dtype)]
    return PackedTable(jnp.pad(jnp.stack(columns, axis=-1), ((0, 1), (0, 0))), spec)


def get_row(rows: Array, k: Array) -> Array:
    """Row k of an array [K, ...]; k is not negative, and below K."""
    return jax.lax.dynamic_index_in_dim(rows, k.astype(jnp.uint32), keepdims=False)


def put_row(rows: Array, k: Array, values: Array) -> Array:
    """An array [K, ...] with these values in row k, which is not negative, and below K."""
    return jax.lax.dynamic_update_index_in_dim(rows, values, k.astype(jnp.uint32), 0)


def repeat_rows(row: Any, count: int, dtype: Any) -> Array:
    """`count` equal rows, a tree with leaves [..., 1], and one more."""
    columns, _ = pack(row, (1,), dtype)
    return jnp.broadcast_to(jnp.concatenate(columns), (count + 1, len(columns)))


def table_of_rows(rows: Array, row: Any) -> PackedTable:
    """Table of packed rows; `row`, a tree with leaves [..., 1], shows what they hold."""
    return PackedTable(rows, pack(row, (1,), rows.dtype)[1])
