"""Records whose fields know their stored name, axes, unit and meaning.

Three layouts, one rule. A sampler is written for one video: ``K 2``. `jax.vmap` puts the videos first, which is also
how they are stored: ``n T K 2``. On the device the same array lies as ``T 2 K n``, scenes last, because the last axis
is the one that SIMD lanes and GPU threads run over. `to_device` and `to_stored` are the only transpositions.
"""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

from gen2d.core.schema import Field

Array = jax.Array
Record = TypeVar("Record")


def axes(name: str, axes: str, unit: str, meaning: str, dtype: str = "float32", **default: Any) -> Any:
    """A record's field that is stored under `name`; with `default=None`, one that a record may lack."""
    return dataclasses.field(metadata={"name": name, "field": Field(dtype, axes, unit, meaning)}, **default)


@dataclass_transform(frozen_default=True, field_specifiers=(axes,))
def record(cls: type[Record]) -> type[Record]:
    """The class as a frozen dataclass that jax takes as a pytree."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True, eq=False)(cls))


def described(cls: type) -> dict[str, tuple[str, Field]]:
    """For each stored field of a record: its stored name -> (its attribute, what it is)."""
    fields = [f for f in dataclasses.fields(cls) if "field" in f.metadata]
    return {f.metadata["name"]: (f.name, f.metadata["field"]) for f in fields}


def fields_of(value: Any) -> dict[str, Field]:
    """What a record's stored fields are, and those of the records inside it, by stored name; those that it has."""
    known = described(type(value)).items()
    found = {name: field for name, (attribute, field) in known if getattr(value, attribute) is not None}
    inner = [getattr(value, f.name) for f in dataclasses.fields(value) if "field" not in f.metadata]
    for record in inner:
        found |= {} if record is None else fields_of(record)
    return found


def columns(value: Any) -> dict[str, Array]:
    """Every stored field that a record and the records inside it have, by stored name."""
    found = {name: getattr(value, attribute) for name, (attribute, _) in described(type(value)).items()}
    for field in dataclasses.fields(value):
        if "field" not in field.metadata and getattr(value, field.name) is not None:
            found |= columns(getattr(value, field.name))
    return {name: array for name, array in found.items() if array is not None}


def _device_order(stored: str, dimensions: int) -> list[int]:
    tokens = [token for token in stored.split() if token != "T" or dimensions == len(stored.split())]
    place = {"T": 0, "K": 2, "C": 2, "J": 2, "n": 3}  # vectors (2, 3) come second
    return sorted(range(len(tokens)), key=lambda i: place.get(tokens[i], 1))


def _transposed(value: Any, back: bool) -> Any:
    changes = {}
    for field in dataclasses.fields(value):
        array = getattr(value, field.name)
        if array is None:
            continue
        if "field" not in field.metadata:
            changes[field.name] = _transposed(array, back)
            continue
        order = _device_order(field.metadata["field"].axes, array.ndim)
        changes[field.name] = jnp.transpose(array, [order.index(i) for i in range(array.ndim)] if back else order)
    return dataclasses.replace(value, **changes)


def to_device(value: Record) -> Record:
    """The record with scenes last, from the stored layout with videos first."""
    return _transposed(value, back=False)


def to_stored(value: Record) -> Record:
    """The record with videos first, from the device's layout."""
    return _transposed(value, back=True)
