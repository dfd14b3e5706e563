"""The records that travel from sampler to solver to files, each field with its stored name, axes, unit and meaning.

Three layouts, one rule. A sampler is written for one video: ``K 2``. `jax.vmap` puts the videos first, which is also
how they are stored: ``n T K 2``. On the device the same array lies as ``T 2 K n``, scenes last, because the last axis
is the one that SIMD lanes and GPU threads run over. `to_device` and `to_stored` are the only transpositions.
"""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

from gen2d.fields import Field

Array = jax.Array
Record = TypeVar("Record")
DYNAMIC, STATIC, KINEMATIC = 0, 1, 2  # objects/kind
SHAPES = ("circle", "segment", "capsule", "polygon")  # objects/shape is an index into this


def axes(name: str, axes: str, unit: str, meaning: str, dtype: str = "float32") -> Any:
    """A record's field that is stored under `name`."""
    return dataclasses.field(metadata={"name": name, "field": Field(dtype, axes, unit, meaning)})


@dataclass_transform(frozen_default=True, field_specifiers=(axes,))
def record(cls: type[Record]) -> type[Record]:
    """The class as a frozen dataclass that jax takes as a pytree."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True, eq=False)(cls))


@record
class Objects:
    """What the slots of a scene are; an empty slot is zero everywhere."""

    present: Array = axes("objects/present", "n K", "1", "whether the slot holds an object", "bool")
    kind: Array = axes("objects/kind", "n K", "1", "0 dynamic, 1 static, 2 kinematic", "uint8")
    shape: Array = axes("objects/shape", "n K", "1", "0 circle, 1 segment, 2 capsule, 3 polygon", "uint8")
    radius: Array = axes("objects/radius", "n K", "m", "of the disc, or of the rounding of a segment")
    half_length: Array = axes("objects/half_length", "n K", "m", "half the distance between a segment's ends")
    depth: Array = axes("objects/depth", "n K", "1", "drawing order, 0 is farthest back", "int16")
    mass: Array = axes("objects/mass", "n K", "kg", "infinite for a static object")
    moment: Array = axes("objects/moment", "n K", "kg m^2", "of inertia about the centre; infinite for a static object")
    elasticity: Array = axes("objects/elasticity", "n K", "1", "coefficient of restitution, before mixing")
    friction: Array = axes("objects/friction", "n K", "1", "Coulomb coefficient, before mixing")
    color: Array = axes("objects/color", "n K 3", "sRGB", "red, green, blue", "uint8")


@record
class Scene:
    """What stays the same for the length of a video."""

    objects: Objects
    gravity: Array = axes("world/gravity", "n 2", "m/s^2", "acceleration of free fall, y up")


@record
class State:
    """Where everything is and how it moves, at one instant or (with T) at every frame."""

    position: Array = axes("states/position", "n T K 2", "m", "of the centre of mass, y up")
    angle: Array = axes("states/angle", "n T K", "rad", "counter-clockwise, not wrapped")
    velocity: Array = axes("states/velocity", "n T K 2", "m/s", "of the centre of mass")
    angular_velocity: Array = axes("states/angular_velocity", "n T K", "rad/s", "counter-clockwise")


@record
class Quality:
    """What a video was like to make."""

    max_penetration: Array = axes("quality/max_penetration", "n", "m", "deepest overlap of two objects at any step")
    contacts: Array = axes("quality/contacts", "n", "1", "contacts that began, bounces included", "int32")


@record
class Trajectory:
    """A simulated video before it is drawn."""

    states: State
    quality: Quality


@dataclasses.dataclass(frozen=True)
class Layout:
    """What is known of a family's slots before anything is drawn: dynamic discs first, then static segments.

    `bounds` is the part of the world worth seeing: (left, bottom, right, top) in metres.
    `reach` is the largest distance from the centre of a moving object to its rim, in metres.
    """

    discs: int
    segments: int
    bounds: tuple[float, float, float, float]
    reach: float

    @property
    def slots(self) -> int:
        """The length of the axis K."""
        return self.discs + self.segments


def described(cls: type) -> dict[str, tuple[str, Field]]:
    """For each stored field of a record: its stored name -> (its attribute, what it is)."""
    fields = [f for f in dataclasses.fields(cls) if "field" in f.metadata]
    return {f.metadata["name"]: (f.name, f.metadata["field"]) for f in fields}


def columns(value: Any) -> dict[str, Array]:
    """Every stored field of a record and of the records inside it, by stored name."""
    found = {name: getattr(value, attribute) for name, (attribute, _) in described(type(value)).items()}
    for field in dataclasses.fields(value):
        if "field" not in field.metadata:
            found |= columns(getattr(value, field.name))
    return found


def _device_order(stored: str, dimensions: int) -> list[int]:
    tokens = [token for token in stored.split() if token != "T" or dimensions == len(stored.split())]
    place = {"T": 0, "K": 2, "n": 3}  # vectors (2, 3) come second
    return sorted(range(len(tokens)), key=lambda i: place.get(tokens[i], 1))


def _transposed(value: Any, back: bool) -> Any:
    changes = {}
    for field in dataclasses.fields(value):
        array = getattr(value, field.name)
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
