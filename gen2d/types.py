"""The records that travel from sampler to solver to files, each field with its stored name, axes, unit and meaning.

Three layouts, one rule. A sampler is written for one video: ``K 2``. `jax.vmap` puts the videos first, which is also
how they are stored: ``n T K 2``. On the device the same array lies as ``T 2 K n``, scenes last, because the last axis
is the one that SIMD lanes and GPU threads run over. `to_device` and `to_stored` are the only transpositions.
"""

import dataclasses
import itertools
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.core.schema import Field

Array = jax.Array
Record = TypeVar("Record")
DYNAMIC, STATIC, KINEMATIC = 0, 1, 2  # objects/kind
SHAPES = ("circle", "segment", "capsule", "polygon")  # objects/shape is an index into this


def axes(name: str, axes: str, unit: str, meaning: str, dtype: str = "float32", **default: Any) -> Any:
    """A record's field that is stored under `name`; with `default=None`, one that a record may lack."""
    return dataclasses.field(metadata={"name": name, "field": Field(dtype, axes, unit, meaning)}, **default)


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
    radius: Array = axes("objects/radius", "n K", "m", "of the disc, or of the rounding of another shape")
    half_length: Array = axes("objects/half_length", "n K", "m", "half the distance between the core's ends")
    depth: Array = axes("objects/depth", "n K", "1", "drawing order, 0 is farthest back", "int16")
    mass: Array = axes("objects/mass", "n K", "kg", "infinite for a static object")
    moment: Array = axes("objects/moment", "n K", "kg m^2", "of inertia about the centre; infinite for a static object")
    elasticity: Array = axes("objects/elasticity", "n K", "1", "coefficient of restitution, before mixing")
    friction: Array = axes("objects/friction", "n K", "1", "Coulomb coefficient, before mixing")
    color: Array = axes("objects/color", "n K 3", "sRGB", "red, green, blue", "uint8")
    vertices: Array | None = axes(
        "objects/vertices", "n K V 2", "m", "of a polygon, from its centre of mass, counter-clockwise", default=None
    )
    vertex_count: Array | None = axes("objects/vertex_count", "n K", "1", "of a polygon", "uint8", default=None)
    rolling_resistance: Array | None = axes(
        "objects/rolling_resistance", "n K", "1", "torque against rolling, over normal force and radius", default=None
    )
    force: Array | None = axes("objects/force", "n K 2", "N", "constant, at the centre of mass", default=None)
    torque: Array | None = axes("objects/torque", "n K", "N m", "constant", default=None)


@record
class Joints:
    """What ties two objects together; which two, and how, is in the layout."""

    anchor_a: Array = axes("joints/anchor_a", "n J 2", "m", "in the frame of object a")
    anchor_b: Array = axes("joints/anchor_b", "n J 2", "m", "in the frame of object b")
    rest: Array = axes("joints/rest", "n J", "m, rad", "length of a distance joint, angle at rest of a revolute one")
    stiffness: Array = axes("joints/stiffness", "n J", "N/m", "of a distance joint; infinite: rigid")
    damping: Array = axes("joints/damping", "n J", "N s/m", "of a distance joint that is not rigid")
    lower: Array = axes("joints/lower", "n J", "rad", "limit of a revolute joint's angle; -infinite: none")
    upper: Array = axes("joints/upper", "n J", "rad", "limit of a revolute joint's angle; infinite: none")
    motor_speed: Array = axes("joints/motor_speed", "n J", "rad/s", "that a revolute joint's motor aims at")
    motor_torque: Array = axes("joints/motor_torque", "n J", "N m", "that the motor has at most; 0: no motor")


@record
class Scene:
    """What stays the same for the length of a video."""

    objects: Objects
    gravity: Array = axes("world/gravity", "n 2", "m/s^2", "acceleration of free fall, y up")
    joints: Joints | None = None


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
    energy_residual: Array | None = axes(
        "quality/energy_residual",
        "n",
        "J",
        "largest of any frame: what the books of energy leave unexplained",
        default=None,
    )


@record
class Contacts:
    """What touched what: a row for each pair and frame in which it did, in time's order; empty rows are zero."""

    time: Array = axes("contacts/time", "n C", "s", "of the first touch in the frame's interval", "float64")
    frame: Array = axes("contacts/frame", "n C", "1", "at whose end, or just before, the touch was", "int32")
    a: Array = axes("contacts/a", "n C", "object", "slot of the one that the normal leaves", "int16")
    b: Array = axes("contacts/b", "n C", "object", "slot of the one that the normal enters", "int16")
    point: Array = axes("contacts/point", "n C 2", "m", "of the first touch")
    normal: Array = axes("contacts/normal", "n C 2", "1", "from a to b")
    normal_impulse: Array = axes("contacts/normal_impulse", "n C", "N s", "on b along the normal, over the frame")
    tangent_impulse: Array = axes("contacts/tangent_impulse", "n C", "N s", "on b a quarter turn left of the normal")
    approach_speed: Array = axes("contacts/approach_speed", "n C", "m/s", "along the normal, before the first touch")
    separation_speed: Array = axes("contacts/separation_speed", "n C", "m/s", "along the normal, after it")
    kind: Array = axes("contacts/kind", "n C", "1", "0 none, 1 impact, 2 begin, 3 persist, 4 end", "uint8")
    count: Array = axes("contacts/count", "n", "1", "rows there were; those over C are not stored", "int32")


@record
class Energy:
    """Where the energy is and where it went, at every frame; the last four count from frame 0."""

    kinetic: Array = axes("energy/kinetic", "n T", "J", "of motion of the centres of mass")
    rotational: Array = axes("energy/rotational", "n T", "J", "of spin")
    potential: Array = axes("energy/potential", "n T", "J", "of gravity (0 at the origin) and of springs")
    lost_in_contact: Array = axes(
        "energy/lost_in_contact", "n T", "J", "to impacts, friction, overlap and rigid joints"
    )
    lost_to_damping: Array = axes("energy/lost_to_damping", "n T", "J", "to damping, of bodies and of springs")
    work_in: Array = axes("energy/work_in", "n T", "J", "done by forces, torques, motors and kinematic bodies")
    residual: Array = axes("energy/residual", "n T", "J", "what the terms above do not add up to")
    linear: Array = axes("momentum/linear", "n T 2", "kg m/s", "of all dynamic objects")
    angular: Array = axes("momentum/angular", "n T", "kg m^2/s", "of all dynamic objects, about the origin")


@record
class Trajectory:
    """A simulated video before it is drawn."""

    states: State
    quality: Quality
    contacts: Contacts | None = None
    energy: Energy | None = None
    between: State | None = None  # at every step, [T, steps, ...]; not stored


@dataclasses.dataclass(frozen=True)
class Run:
    """Some slots in a row that hold one shape: "circle", "segment", "capsule" or "polygon"."""

    shape: str
    count: int
    kind: int = DYNAMIC
    vertices: int = 0  # of each polygon, at most
    rounded: bool = False  # whether polygons have a radius
    layer: int | None = None  # lower layers are drawn first; None: 0 for static objects, 1 for those that move
    collides: bool = True  # False: it is drawn, and joints may hold on to it, but it meets nothing

    @property
    def painted(self) -> int:
        """The layer that it is drawn in."""
        return (0 if self.kind == STATIC else 1) if self.layer is None else self.layer


@dataclasses.dataclass(frozen=True)
class Tie:
    """A joint between two slots: "distance" or "revolute"; the two do not collide unless they shall."""

    kind: str
    a: int
    b: int
    collide: bool = False


@dataclasses.dataclass(frozen=True)
class Layout:
    """What is known of a family's slots before anything is drawn.

    `bounds` is the part of the world worth seeing: (left, bottom, right, top) in metres.
    `reach` is the largest distance from the centre of a moving object to its rim, in metres.
    """

    runs: tuple[Run, ...]
    bounds: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    reach: float = 1.0
    joints: tuple[Tie, ...] = ()

    @property
    def slots(self) -> int:
        """The length of the axis K."""
        return sum(run.count for run in self.runs)

    @property
    def spans(self) -> tuple[tuple[Run, int], ...]:
        """Each run and its first slot."""
        starts = itertools.accumulate((run.count for run in self.runs), initial=0)
        return tuple(zip(self.runs, starts, strict=False))

    @property
    def painted(self) -> tuple[tuple[Run, int], ...]:
        """The same from back to front: lower layers first, slots of one layer in their order."""
        return tuple(sorted(self.spans, key=lambda span: (span[0].painted, span[1])))

    @property
    def depths(self) -> np.ndarray:
        """Each slot's place in the drawing order, [K] int16, 0 is farthest back: what `objects/depth` holds."""
        order = [slot for run, first in self.painted for slot in range(first, first + run.count)]
        return np.argsort(order).astype(np.int16)


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
