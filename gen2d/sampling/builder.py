"""The parts that a scene is put together from: discs, capsules, segments, boxes and polygons, for one video at a time.

    balls = discs(places, factors["radius"], present, density=factors["density"], velocity=factors["velocity"])
    scene, state = assembled(layout(options), [balls, box_walls(options.width, options.height)], factors["gravity"])

A part is what a run of slots holds. Numbers are broadcast to its slots; a slot that holds nothing is zero everywhere.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.core.enums import DYNAMIC, SHAPES, STATIC
from gen2d.physics.inertia import (
    box_vertices,
    disc_mass,
    disc_moment,
    polygon_mass,
    polygon_moment,
    stadium_mass,
    stadium_moment,
)
from gen2d.records.axes import Array
from gen2d.records.layout import Layout, SlotGroup
from gen2d.records.scene import Joints, Objects, Scene, State

GREY = (128.0, 128.0, 128.0)
OPTIONAL = ("vertices", "vertex_count", "rolling_resistance", "force", "torque")  # what a scene may lack


class SampledScene(NamedTuple):
    """What a family makes of its factors, for one video."""

    scene: Scene
    state: State
    rejected: Any = 0  # places drawn again, as they did not fit
    fits: Any = True  # whether everything found a place
    derived: Mapping[str, Array] = MappingProxyType({})  # what follows from the drawn numbers; the family's `derived`


class BodyGroup(NamedTuple):
    """A run, and what its slots hold: `objects` without their depth."""

    run: SlotGroup
    objects: dict[str, Array]
    state: State


# What every part takes besides its shapes, each a number or one for each slot [K].
MATERIAL = {
    "density": "kg/m^2; default 1",
    "mass": "kg; default: area times density",
    "velocity": "m/s, [2] or [K, 2]; default 0",
    "spin": "rad/s; default 0",
    "elasticity": "coefficient of restitution; default 0",
    "friction": "Coulomb coefficient; default 0",
    "color": "sRGB, [3] or [K, 3]; default grey",
    "kind": "DYNAMIC, STATIC or KINEMATIC, of all; segments are static by default, all else is dynamic",
    "layer": "of all, in the drawing order",
    "collides": "whether anything meets them; of all, default True",
    "rolling_resistance": "torque over normal force and radius",
    "force": "N, [2] or [K, 2], constant",
    "torque": "N m, constant",
}


def discs(position: Array, radius: Any, present: Any = True, *, angle: Any = 0.0, **material: Any) -> BodyGroup:
    """Discs at these centres [K, 2] m, with this radius in m."""
    radius = jnp.broadcast_to(radius, position.shape[:1]).astype(jnp.float32)
    mass = disc_mass(radius, material.get("density", 1.0))
    return _part("circle", position, angle, present, material, mass, disc_moment(radius, jnp.ones(())), radius=radius)


def capsules(
    position: Array, angle: Any, half_length: Any, radius: Any, present: Any = True, **material: Any
) -> BodyGroup:
    """Capsules at these centres [K, 2] m; `half_length` m is half the distance between the centres of their ends."""
    half, radius = (jnp.broadcast_to(x, position.shape[:1]).astype(jnp.float32) for x in (half_length, radius))
    mass, moment = stadium_mass(half, radius, material.get("density", 1.0)), stadium_moment(half, radius, jnp.ones(()))
    return _part("capsule", position, angle, present, material, mass, moment, radius=radius, half_length=half)


def capsules_between(a: Any, b: Any, radius: Any, present: Any = True, **material: Any) -> BodyGroup:
    """Capsules whose ends have their centres at these points [K, 2] m and those."""
    a, b = (jnp.asarray(x, jnp.float32) for x in (a, b))
    way = b - a
    angle, half = jnp.arctan2(way[:, 1], way[:, 0]), jnp.linalg.norm(way, axis=-1) / 2
    return capsules((a + b) / 2, angle, half, radius, present, **material)


def segments(a: Any, b: Any, present: Any = True, **material: Any) -> BodyGroup:
    """Segments from these points [K, 2] m to those; static unless `kind` says otherwise, and then with a mass."""
    a, b = (jnp.asarray(x, jnp.float32) for x in (a, b))
    way = b - a
    half = jnp.linalg.norm(way, axis=-1) / 2
    mass = jnp.asarray(material.get("mass", 1.0), jnp.float32)
    return _part(
        "segment", (a + b) / 2, jnp.arctan2(way[:, 1], way[:, 0]), present, {"kind": STATIC, **material}, mass,
        stadium_moment(half, jnp.zeros_like(half), jnp.ones(())), half_length=half,
    )  # fmt: skip


def boxes(position: Array, angle: Any, width: Any, height: Any, present: Any = True, **material: Any) -> BodyGroup:
    """Rectangles at these centres [K, 2] m, with these sides in m."""
    count = position.shape[0]
    corners = box_vertices(*(jnp.broadcast_to(x, (count,)).astype(jnp.float32) for x in (width, height)))
    return polygons(position, angle, corners, present, **material)


def polygons(
    position: Array,
    angle: Any,
    vertices: Array,
    present: Any = True,
    *,
    count: Any = None,
    **material: Any,
) -> BodyGroup:
    """Convex polygons with their centres of mass at these points [K, 2] m; `vertices` [K, V, 2] m counter-clockwise
    from there. `count` [K] of them are a polygon's own, the rest repeat its last; default: all."""
    mass, moment = polygon_mass(vertices, material.get("density", 1.0)), polygon_moment(vertices, jnp.ones(()))
    own = vertices.shape[1] if count is None else count
    shape = {"vertices": vertices, "vertex_count": jnp.broadcast_to(own, position.shape[:1])}
    return _part("polygon", position, angle, present, material, mass, moment, **shape)


def box_walls(width: float, height: float, **material: Any) -> BodyGroup:
    """The floor, right wall, ceiling and left wall of a box from 0, 0 to width, height m; each faces inwards."""
    corners = jnp.asarray([[0, 0], [width, 0], [width, height], [0, height]], jnp.float32)
    return segments(corners, jnp.roll(corners, -1, axis=0), **material)


def _part(
    shape: str,
    position: Array,
    angle: Any,
    present: Any,
    material: Any,
    mass: Array,
    moment: Array,
    **sizes: Array,
) -> BodyGroup:
    """`mass` is that of the density, `moment` that of one kilogram."""
    assert material.keys() <= MATERIAL.keys(), f"{material.keys() - MATERIAL.keys()} are not of {list(MATERIAL)}"
    count, kind = position.shape[0], material.get("kind", DYNAMIC)
    present = jnp.broadcast_to(present, (count,))
    vertices = sizes["vertices"].shape[1] if "vertices" in sizes else 0
    run = SlotGroup(shape, count, kind, vertices, layer=material.get("layer"), collides=material.get("collides", True))

    def slots(value: Any, *more: int, dtype: Any = jnp.float32) -> Array:
        values = jnp.broadcast_to(jnp.asarray(value, jnp.float32), (count, *more))
        return jnp.where(present.reshape(-1, *[1] * len(more)), values, 0).astype(dtype)

    mass = jnp.asarray(material.get("mass", mass), jnp.float32)
    of_mass = jnp.inf if kind != DYNAMIC else mass
    objects = {
        "present": present.astype(bool),
        "kind": slots(kind, dtype=jnp.uint8),
        "shape": slots(SHAPES.index(shape), dtype=jnp.uint8),
        "radius": slots(sizes.get("radius", 0.0)),
        "half_length": slots(sizes.get("half_length", 0.0)),
        "mass": slots(of_mass),
        "moment": slots(jnp.inf if kind != DYNAMIC else mass * moment),
        "elasticity": slots(material.get("elasticity", 0.0)),
        "friction": slots(material.get("friction", 0.0)),
        "color": slots(material.get("color", GREY), 3, dtype=jnp.uint8),
    }
    if vertices:
        objects |= {"vertices": slots(sizes["vertices"], vertices, 2)}
        objects |= {"vertex_count": slots(sizes["vertex_count"], dtype=jnp.uint8)}
    more = {"rolling_resistance": (), "force": (2,), "torque": ()}
    objects |= {name: slots(material[name], *axes) for name, axes in more.items() if name in material}
    moves = slots(material.get("velocity", 0.0), 2), slots(material.get("spin", 0.0))
    return BodyGroup(run, objects, State(slots(position, 2), slots(angle), *moves))


def assemble(
    layout: Layout, parts: Sequence[BodyGroup], gravity: Array, joints: Joints | None = None
) -> tuple[Scene, State]:
    """Scene and initial state of these parts, whose runs are the layout's; `gravity` [2] m/s^2.

    Raises AssertionError where they are not.
    """
    runs = tuple(part.run for part in parts)
    assert runs == layout.runs, f"the parts are {runs}, but the layout has {layout.runs}"
    corners = max(run.vertices for run in runs)
    names = [*parts[0].objects, *(name for name in OPTIONAL if any(name in part.objects for part in parts))]
    found = {name: jnp.concatenate([_held(part, name, corners) for part in parts]) for name in dict.fromkeys(names)}
    depth = jnp.where(found["present"], jnp.asarray(layout.depths), 0).astype(jnp.int16)
    state = jax.tree.map(lambda *values: jnp.concatenate(values), *(part.state for part in parts))
    return Scene(Objects(depth=depth, **found), jnp.asarray(gravity, jnp.float32), joints), state


def _held(part: BodyGroup, name: str, corners: int) -> Array:
    """A part's values of one of the objects' fields; zero where it has none."""
    count = part.run.count
    empty = {
        "vertices": jnp.zeros((count, corners, 2)),
        "vertex_count": jnp.zeros(count, jnp.uint8),
        "rolling_resistance": jnp.zeros(count),
        "force": jnp.zeros((count, 2)),
        "torque": jnp.zeros(count),
    }
    values = part.objects[name] if name in part.objects else empty[name]
    if name == "vertices" and values.shape[1] < corners:  # its last corner again, which changes nothing
        values = jnp.concatenate([values, jnp.repeat(values[:, -1:], corners - values.shape[1], axis=1)], axis=1)
    return values


def distance_joints(anchor_a: Any, anchor_b: Any, **numbers: Any) -> Joints:
    """A scene's joints, in the order of its layout's: anchors [J, 2] m in the frames of their objects, and what else
    `Joints` has, each a number or one for each joint; default: rigid, without limits and motors."""
    anchors = [jnp.asarray(x, jnp.float32) for x in (anchor_a, anchor_b)]
    usual = {"rest": 0.0, "stiffness": jnp.inf, "damping": 0.0, "lower": -jnp.inf, "upper": jnp.inf}
    usual |= {"motor_speed": 0.0, "motor_torque": 0.0}
    known = [field.name for field in dataclasses.fields(Joints) if field.name in usual]
    assert not numbers.keys() - set(known), f"{numbers.keys() - set(known)} are not of {known}"
    values = {
        name: jnp.broadcast_to(jnp.asarray((usual | numbers)[name], jnp.float32), len(anchors[0])) for name in known
    }
    return Joints(*anchors, **values)


def hinge_chain(links: BodyGroup, tail: bool, **numbers: Any) -> Joints:
    """The revolute joints of bars in a row: where each begins, in the middle of an object or at the end of the bar
    before, and with a `tail` where the last ends, in the middle of another object, which is that joint's `a`."""
    half = links.objects["half_length"]
    ends, middle = jnp.stack([half, jnp.zeros_like(half)], -1), jnp.zeros((1, 2))
    above, below = jnp.concatenate([middle, ends[:-1]]), -ends
    if tail:
        above, below = jnp.concatenate([above, middle]), jnp.concatenate([below, ends[-1:]])
    return distance_joints(above, below, **numbers)
