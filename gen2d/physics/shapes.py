"""What a slot's shape is in its own frame, and where it lies in the world."""

from typing import NamedTuple, TypeAlias, overload

import jax.numpy as jnp

from gen2d.physics.collision import Disc, Shape, Stadium, edge_normals, hull
from gen2d.records.axes import Array
from gen2d.records.layout import SlotGroup
from gen2d.records.scene import Objects


class DiscShape(NamedTuple):
    """A disc."""

    radius: Array  # [N, ...] m


class CapsuleShape(NamedTuple):
    """A segment or a capsule, along its own x axis."""

    half_length: Array  # [N, ...] m
    radius: Array


class PolygonShape(NamedTuple):
    """A convex polygon."""

    vertices: tuple[Array, ...]  # each [2, N, ...] m, counter-clockwise
    normals: tuple[Array, ...]
    radius: Array


BodyShape: TypeAlias = DiscShape | CapsuleShape | PolygonShape


def body_shape_of(objects: Objects, run: SlotGroup, slots: slice | Array) -> BodyShape:
    """The form of a run's slots; objects in the device's layout."""
    radius = objects.radius[slots]
    if run.shape == "circle":
        return DiscShape(radius)
    if run.shape in ("segment", "capsule"):
        return CapsuleShape(objects.half_length[slots], radius)
    assert objects.vertices is not None, "a layout with polygons needs objects.vertices"
    vertices = tuple(objects.vertices[: run.vertices, :, slots])
    return PolygonShape(vertices, edge_normals(vertices), radius)


@overload
def to_world(form: CapsuleShape, position: Array, angle: Array) -> Stadium: ...
@overload
def to_world(form: BodyShape, position: Array, angle: Array) -> Shape: ...
def to_world(form: BodyShape, position: Array, angle: Array) -> Shape:
    """The shape in the world; position [2, N, ...] in m, angle [N, ...] in rad."""
    if isinstance(form, DiscShape):
        return Disc(position, form.radius)
    if isinstance(form, CapsuleShape):
        return Stadium(position, jnp.stack([jnp.cos(angle), jnp.sin(angle)]), form.half_length, form.radius)
    return hull(form.vertices, form.normals, position, angle, form.radius)
