"""Groups of bodies from which the scene of one video is assembled: discs, capsules, segments, boxes and polygons.

    balls = builder.discs(positions, radius, present, velocity=velocity, **builder.material(factors))
    walls = builder.box_walls(options.width, options.height, **builder.material(factors, "wall"))
    scene, state = builder.assemble(layout(options), [balls, walls], factors["gravity"])

A group fills consecutive slots. Arguments are broadcast to its K slots; absent bodies (`present` is false) are zero
in every field.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

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
OPTIONAL = ("vertices", "vertex_count", "rolling_resistance", "force", "torque")  # fields that scenes may lack


class SampledScene(NamedTuple):
    """Scene and initial state of one video, which a family builds from sampled factors."""

    scene: Scene
    state: State
    rejected: Any = 0  # number of positions rejected because of overlap
    fits: Any = True  # whether all objects could be placed
    derived: Mapping[str, Array] = MappingProxyType({})  # values derived from the factors, stored beside them


class BodyGroup(NamedTuple):
    """Bodies in consecutive slots: fields of `Objects` except the depth, and the initial state."""

    run: SlotGroup
    objects: dict[str, Array]
    state: State


# Arguments of all groups besides the shape; each is a scalar or has a value per slot [K].
MATERIAL = {
    "density": "kg/m^2; default 1",
    "mass": "kg; default: area times density",
    "velocity": "m/s, [2] or [K, 2]; default 0",
    "spin": "rad/s; default 0",
    "elasticity": "coefficient of restitution; default 0",
    "friction": "Coulomb coefficient; default 0",
    "color": "sRGB, [3] or [K, 3]; default grey",
    "kind": "DYNAMIC, STATIC or KINEMATIC, of the group; default DYNAMIC, of segments STATIC",
    "layer": "of the group, in the drawing order",
    "collides": "whether the group collides with anything; default True",
    "rolling_resistance": "torque over normal force and radius",
    "force": "N, [2] or [K, 2], constant",
    "torque": "N m, constant",
}


def material(factors: Mapping[str, Array], of: str = "") -> dict[str, Any]:
    """Density, elasticity, friction and color among a family's factors, as arguments of a group.

    With `of="wall"`, they come from the factors `wall_density`, `wall_elasticity`, `wall_friction` and `wall_color`.
    """
    names = {name: f"{of}_{name}" if of else name for name in ("density", "elasticity", "friction", "color")}
    return {name: factors[factor] for name, factor in names.items() if factor in factors}


def discs(position: Array, radius: Any, present: Any = True, *, angle: Any = 0.0, **material: Any) -> BodyGroup:
    """Discs at centres [K, 2] m, with radii in m."""
    radius = jnp.broadcast_to(radius, position.shape[:1]).astype(jnp.float32)
    mass = disc_mass(radius, material.get("density", 1.0))
    return _group("circle", position, angle, present, material, mass, disc_moment(radius, jnp.ones(())), radius=radius)


def capsules(
    position: Array, angle: Any, half_length: Any, radius: Any, present: Any = True, **material: Any
) -> BodyGroup:
    """Capsules at centres [K, 2] m; `half_length` m is half the distance between the centres of their ends."""
    half, radius = (jnp.broadcast_to(x, position.shape[:1]).astype(jnp.float32) for x in (half_length, radius))
    mass, moment = stadium_mass(half, radius, material.get("density", 1.0)), stadium_moment(half, radius, jnp.ones(()))
    return _group("capsule", position, angle, present, material, mass, moment, radius=radius, half_length=half)


def capsules_between(a: Any, b: Any, radius: Any, present: Any = True, **material: Any) -> BodyGroup:
    """Capsules whose ends are centred at `a` and `b` [K, 2] m."""
    a, b = (jnp.asarray(x, jnp.float32) for x in (a, b))
    along = b - a
    angle, half = jnp.arctan2(along[:, 1], along[:, 0]), jnp.linalg.norm(along, axis=-1) / 2
    return capsules((a + b) / 2, angle, half, radius, present, **material)


def segments(a: Any, b: Any, present: Any = True, **material: Any) -> BodyGroup:
    """Segments from `a` to `b` [K, 2] m, static by default; dynamic ones have a mass of 1 kg by default."""
    a, b = (jnp.asarray(x, jnp.float32) for x in (a, b))
    along = b - a
    half = jnp.linalg.norm(along, axis=-1) / 2
    mass = jnp.asarray(material.get("mass", 1.0), jnp.float32)
    return _group(
        "segment", (a + b) / 2, jnp.arctan2(along[:, 1], along[:, 0]), present, {"kind": STATIC, **material}, mass,
        stadium_moment(half, jnp.zeros_like(half), jnp.ones(())), half_length=half,
    )  # fmt: skip


def segment_chain(points: Any, present: Any = True, *, closed: bool = False, **material: Any) -> BodyGroup:
    """Segments from each of `points` [P, 2] m to the next, and from the last to the first if `closed`; static by
    default. Bodies do not feel their joints."""
    points = jnp.asarray(points, jnp.float32)
    nexts = jnp.roll(points, -1, axis=0)
    count = len(points) if closed else len(points) - 1
    return segments(points[:count], nexts[:count], present, **material)


def boxes(position: Array, angle: Any, width: Any, height: Any, present: Any = True, **material: Any) -> BodyGroup:
    """Rectangles at centres [K, 2] m, with sides in m."""
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
    """Convex polygons with centres of mass at `position` [K, 2] m.

    `vertices` [K, V, 2] m are relative to these, counter-clockwise. Each polygon has the first `count` [K] of them, by
    default all; the others must repeat the last one.
    """
    mass, moment = polygon_mass(vertices, material.get("density", 1.0)), polygon_moment(vertices, jnp.ones(()))
    corners = vertices.shape[1] if count is None else count
    shape = {"vertices": vertices, "vertex_count": jnp.broadcast_to(corners, position.shape[:1])}
    return _group("polygon", position, angle, present, material, mass, moment, **shape)


def box_walls(width: float, height: float, **material: Any) -> BodyGroup:
    """Floor, right wall, ceiling and left wall of a box from (0, 0) to (width, height) m; each faces inwards."""
    corners = jnp.asarray([[0, 0], [width, 0], [width, height], [0, height]], jnp.float32)
    return segment_chain(corners, closed=True, **material)


def floor(layout: Layout, widths: float = 4.0, **material: Any) -> BodyGroup:
    """Floor at height 0 from -w to w, where w is `widths` times the right bound of the layout."""
    reach = widths * layout.bounds[2]
    return segments([(-reach, 0.0)], [(reach, 0.0)], **material)


def _group(
    shape: str,
    position: Array,
    angle: Any,
    present: Any,
    material: Any,
    mass: Array,
    moment: Array,
    **sizes: Array,
) -> BodyGroup:
    """Group of one shape; `mass` follows from the density, `moment` is that of one kilogram."""
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
    motion = slots(material.get("velocity", 0.0), 2), slots(material.get("spin", 0.0))
    return BodyGroup(run, objects, State(slots(position, 2), slots(angle), *motion))


def assemble(
    layout: Layout, groups: Sequence[BodyGroup], gravity: Array, joints: Joints | None = None
) -> tuple[Scene, State]:
    """Scene and initial state of these groups, with `gravity` [2] m/s^2, and of `joints`, if the layout has any.

    Joints whose `rest` was not given have their rest length from the initial state; that of revolute joints is 0 rad.

    Raises AssertionError unless the layout has the same slot groups, and as many joints.
    """
    runs = tuple(group.run for group in groups)
    assert runs == layout.groups, f"the groups are {runs}, but the layout has {layout.groups}"
    given = 0 if joints is None else len(joints.anchor_a)
    assert given == len(layout.joints), (
        f"assemble() was given {given} joints, but the layout has {len(layout.joints)}; "
        "builder.distance_joints and builder.hinge_chain make them"
    )
    corners = max(run.vertices for run in runs)
    names = [*groups[0].objects, *(name for name in OPTIONAL if any(name in group.objects for group in groups))]
    fields = {
        name: jnp.concatenate([_values_of(group, name, corners) for group in groups]) for name in dict.fromkeys(names)
    }
    depth = jnp.where(fields["present"], jnp.asarray(layout.depths), 0).astype(jnp.int16)
    state = jax.tree.map(lambda *values: jnp.concatenate(values), *(group.state for group in groups))
    if joints is not None and joints.rest is None:
        joints = dataclasses.replace(joints, rest=_rest_of(joints, layout, fields["present"], state))
    return Scene(Objects(depth=depth, **fields), jnp.asarray(gravity, jnp.float32), joints), state


def _values_of(group: BodyGroup, name: str, corners: int) -> Array:
    """Values of a field of the objects in a group; zeros if the group lacks the field."""
    count = group.run.count
    zeros = {
        "vertices": jnp.zeros((count, corners, 2)),
        "vertex_count": jnp.zeros(count, jnp.uint8),
        "rolling_resistance": jnp.zeros(count),
        "force": jnp.zeros((count, 2)),
        "torque": jnp.zeros(count),
    }
    values = group.objects[name] if name in group.objects else zeros[name]
    if name == "vertices" and values.shape[1] < corners:  # pad with copies of the last vertex
        values = jnp.concatenate([values, jnp.repeat(values[:, -1:], corners - values.shape[1], axis=1)], axis=1)
    return values


def _rest_of(joints: Joints, layout: Layout, present: Array, state: State) -> Array:
    """Distance of the anchors in this state [J], m, of distance joints with both objects; 0 for the other joints."""
    is_distance = np.array([joint.kind == "distance" for joint in layout.joints])
    if not is_distance.any():
        return jnp.zeros(len(is_distance))
    slots = [np.array([getattr(joint, side) for joint in layout.joints]) for side in "ab"]
    anchors = zip(slots, (joints.anchor_a, joints.anchor_b), strict=True)
    one, other = (state.position[own] + rotate(anchor, state.angle[own]) for own, anchor in anchors)
    there = present[slots[0]] & present[slots[1]] & is_distance
    return jnp.where(there, jnp.hypot(*(other - one).T), 0.0)


def rotate(vector: Array, angle: Array) -> Array:
    """Vectors [..., 2] rotated counter-clockwise by angles [...], rad."""
    cos, sin, (x, y) = jnp.cos(angle), jnp.sin(angle), (vector[..., 0], vector[..., 1])
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def distance_joints(anchor_a: Any, anchor_b: Any, *, rest: Any = None, **numbers: Any) -> Joints:
    """Joints of both kinds in the layout's order, with anchors [J, 2] m in the frames of their objects.

        layout(options): Layout(groups, joints=(JointSpec("distance", 0, 1),))
        sample(...): joints = builder.distance_joints([[0, 0]], [[0, 0]], stiffness=factors["stiffness"])
                     builder.assemble(layout(options), [pin, ball], factors["gravity"], joints)

    `rest` is the rest length (m) of distance joints and the rest angle (rad) of revolute ones; by default, `assemble`
    takes the length from the initial state, and the angle is 0. `numbers` are other fields of `Joints`, scalars or
    arrays [J]: `stiffness` (N/m) and `damping` (N s/m) of distance joints, and `lower`, `upper` (rad), `motor_speed`
    (rad/s) and `motor_torque` (N m) of revolute ones. By default, joints are rigid and have neither limits nor motors.
    """
    anchors = [jnp.asarray(x, jnp.float32) for x in (anchor_a, anchor_b)]
    defaults = {"stiffness": jnp.inf, "damping": 0.0, "lower": -jnp.inf, "upper": jnp.inf}
    defaults |= {"motor_speed": 0.0, "motor_torque": 0.0}
    names = [field.name for field in dataclasses.fields(Joints) if field.name in defaults]
    assert not numbers.keys() - set(names), f"{numbers.keys() - set(names)} are not of {names}"
    values: dict[str, Any] = {
        name: jnp.broadcast_to(jnp.asarray((defaults | numbers)[name], jnp.float32), len(anchors[0])) for name in names
    }
    values["rest"] = rest if rest is None else jnp.broadcast_to(jnp.asarray(rest, jnp.float32), len(anchors[0]))
    return Joints(*anchors, **values)


def hinge_chain(links: BodyGroup, tail: bool, **numbers: Any) -> Joints:
    """Revolute joints of a chain of bars.

    The first bar hangs from the centre of an object, each other bar from the end of the previous one. With `tail`,
    another joint connects the centre of an object (the joint's `a`) with the end of the last bar.
    """
    half = links.objects["half_length"]
    ends, middle = jnp.stack([half, jnp.zeros_like(half)], -1), jnp.zeros((1, 2))
    above, below = jnp.concatenate([middle, ends[:-1]]), -ends
    if tail:
        above, below = jnp.concatenate([above, middle]), jnp.concatenate([below, ends[-1:]])
    return distance_joints(above, below, **numbers)
