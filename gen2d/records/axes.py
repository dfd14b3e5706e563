"""Records: dataclasses of arrays whose fields declare stored name, axes, unit and meaning.

An array has one of three layouts. A sampler works on one video: ``K 2``. `jax.vmap` adds the videos as the first axis,
which is the stored layout: ``n T K 2``. The device layout has the videos last, ``T 2 K n``, because SIMD lanes and GPU
threads run over the last axis. Only `to_device` and `to_stored` transpose.
"""

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

from gen2d.core.schema import Field

Array = jax.Array
Record = TypeVar("Record")


def axes(name: str, axes: str, unit: str, meaning: str, dtype: str = "float32", **default: Any) -> Any:
    """A record's field that is stored as `name`; with `default=None`, an optional one."""
    return dataclasses.field(metadata={"name": name, "field": Field(dtype, axes, unit, meaning)}, **default)


@dataclass_transform(frozen_default=True, field_specifiers=(axes,))
def record(cls: type[Record]) -> type[Record]:
    """Class decorator for records: a frozen dataclass, registered as a jax pytree."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True, eq=False)(cls))


def stored_fields(cls: type) -> dict[str, tuple[str, Field]]:
    """Stored fields of a record class: stored name -> (attribute, Field)."""
    fields = [f for f in dataclasses.fields(cls) if "field" in f.metadata]
    return {f.metadata["name"]: (f.name, f.metadata["field"]) for f in fields}


def fields_of(value: Any) -> dict[str, Field]:
    """Fields of a record and of its inner records, by stored name; fields that are None are left out."""
    stored = stored_fields(type(value)).items()
    fields = {name: field for name, (attribute, field) in stored if getattr(value, attribute) is not None}
    inner_records = [getattr(value, f.name) for f in dataclasses.fields(value) if "field" not in f.metadata]
    for record in inner_records:
        fields |= {} if record is None else fields_of(record)
    return fields


def columns(value: Any) -> dict[str, Array]:
    """Arrays of a record and of its inner records, by stored name; fields that are None are left out."""
    arrays = {name: getattr(value, attribute) for name, (attribute, _) in stored_fields(type(value)).items()}
    for field in dataclasses.fields(value):
        if "field" not in field.metadata and getattr(value, field.name) is not None:
            arrays |= columns(getattr(value, field.name))
    return {name: array for name, array in arrays.items() if array is not None}


def check_shapes(value: Any, absent: Collection[str] = (), device: bool = False, **sizes: int) -> None:
    """Assert that the arrays of a record, and of its inner records, have their declared axes.

    `sizes` are lengths of axes by letter, such as K=10; other axes may have any length. `absent` are the letters of
    axes that the arrays lack: "n" within `jax.vmap`, "T" for a single instant. `device`: the arrays are in device
    layout. Raises AssertionError, which names the field.
    """
    arrays = columns(value)
    for name, field in fields_of(value).items():
        tokens = [token for token in field.axes.split() if token not in absent]
        shape = [int(token) if token.isdigit() else sizes.get(token) for token in tokens]
        if device:
            shape = [shape[i] for i in _device_order(" ".join(tokens), len(tokens))]
        assert_shape(arrays[name], shape, f"{name} [{' '.join(tokens)}]")


def assert_shape(array: Array, shape: Sequence[int | None], name: str) -> None:
    """Raise AssertionError, which names the array, unless it has this shape; None stands for any length."""
    fits = len(array.shape) == len(shape) and all(
        wanted in (None, length) for length, wanted in zip(array.shape, shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise AssertionError(f"{name} has the shape {array.shape}, but must have ({wanted})")


def _device_order(stored: str, dimensions: int) -> list[int]:
    tokens = [token for token in stored.split() if token != "T" or dimensions == len(stored.split())]
    rank = {"T": 0, "K": 2, "C": 2, "J": 2, "n": 3}  # all other axes, such as the 2 of vectors, come second
    return sorted(range(len(tokens)), key=lambda i: rank.get(tokens[i], 1))


def _transpose(value: Any, back: bool) -> Any:
    changes = {}
    for field in dataclasses.fields(value):
        array = getattr(value, field.name)
        if array is None:
            continue
        if "field" not in field.metadata:
            changes[field.name] = _transpose(array, back)
            continue
        order = _device_order(field.metadata["field"].axes, array.ndim)
        changes[field.name] = jnp.transpose(array, [order.index(i) for i in range(array.ndim)] if back else order)
    return dataclasses.replace(value, **changes)


def to_precision(value: Record, dtype: str) -> Record:
    """The record, or tree of records, with its floating-point numbers of this type."""

    def convert(x: Array) -> Array:
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(convert, value)


def to_device(value: Record) -> Record:
    """The record in device layout (videos last), from stored layout (videos first)."""
    return _transpose(value, back=False)


def to_stored(value: Record) -> Record:
    """The record in stored layout (videos first), from device layout (videos last)."""
    return _transpose(value, back=True)


def take_scenes(tree: Any, scenes: Array) -> Any:
    """The tree, with leaves [..., n], of some scenes."""
    return jax.tree.map(lambda x: x.at[..., scenes].get(mode="clip"), tree)


def put_scenes(tree: Any, scenes: Array, new: Any) -> Any:
    """The tree with those of some scenes replaced; numbers beyond the last scene are of none."""
    return jax.tree.map(lambda x, y: x.at[..., scenes].set(y, mode="drop"), tree, new)
