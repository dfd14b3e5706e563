"""Shapes in the body frame and in the world."""

from typing import NamedTuple, TypeAlias, overload

import jax.numpy as jnp

from gen2d.physics.collision import Disc, Shape, Stadium, edge_normals, hull_at
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


def body_shape_of(objects: Objects, group: SlotGroup, slots: slice | Array) -> BodyShape:
    """Body shape of some slots of a slot group; objects in the device layout."""
    radius = objects.radius[slots]
    if group.shape == "circle":
        return DiscShape(radius)
    if group.shape in ("segment", "capsule"):
        return CapsuleShape(objects.half_length[slots], radius)
    assert objects.vertices is not None, "a layout with polygons needs objects.vertices"
    vertices = tuple(objects.vertices[: group.vertices, :, slots])
    return PolygonShape(vertices, edge_normals(vertices), radius)


@overload
def to_world(shape: CapsuleShape, position: Array, angle: Array) -> Stadium: ...
@overload
def to_world(shape: BodyShape, position: Array, angle: Array) -> Shape: ...
def to_world(shape: BodyShape, position: Array, angle: Array) -> Shape:
    """Shape in the world at a position [2, N, ...] in m and an angle [N, ...] in rad."""
    if isinstance(shape, DiscShape):
        return Disc(position, shape.radius)
    if isinstance(shape, CapsuleShape):
        return Stadium(position, jnp.stack([jnp.cos(angle), jnp.sin(angle)]), shape.half_length, shape.radius)
    return hull_at(shape.vertices, shape.normals, position, angle, shape.radius)
