"""Setup of the solver: from a scene to groups of moving bodies, static bodies, joints and a constraint for every pair.

The layout says which slots hold what, so everything but the numbers is known when a program is compiled.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.core.enums import DYNAMIC, KINEMATIC
from gen2d.physics import limits_motors, rigid_joints, springs
from gen2d.physics.all_pairs import AllPairs
from gen2d.physics.broad_phase import round_robin_of
from gen2d.physics.collision import Stadium
from gen2d.physics.constraint import ContactConstraint, Inertia, Motion, frame_of, mix_materials, reciprocal
from gen2d.physics.contact_state import PassSetup
from gen2d.physics.nearby_pairs import NearbyPairs, chunk_size
from gen2d.physics.pair_batches import DynamicSide, PairBatch, StaticSide
from gen2d.physics.params import SolverParams
from gen2d.physics.schedule import matches, pairings, run_schedule
from gen2d.physics.segment_lines import Neighbours, neighbours_of
from gen2d.physics.shapes import BodyShape, CapsuleShape, DiscShape, body_shape_of, to_world
from gen2d.physics.state import BodyGroupState, Model, StaticBody
from gen2d.physics.tunnelling import barriers_of
from gen2d.records.axes import Array, Record
from gen2d.records.layout import Layout, SlotGroup
from gen2d.records.scene import Objects, Scene, State


class Material(NamedTuple):
    """Inertia and surface of the bodies on one side of a constraint."""

    inverse: Inertia | None  # None: static
    present: Array
    radius: Array
    elasticity: Array
    friction: Array
    rolling: Array | None  # m
    slot: Array


def without_empty(scene: Scene, state: State) -> tuple[Scene, State]:
    """Scene and state with zeros in empty slots, so that values there, such as NaN, have no effect."""
    present = scene.objects.present

    def clean(values: Record) -> Record:
        return jax.tree.map(lambda x: jnp.where(present, x, jnp.zeros_like(x)), values)

    return Scene(clean(scene.objects), scene.gravity, scene.joints), clean(state)


def padded_size(count: int) -> int:
    """Size of a group of `count` bodies with its padding, as a round robin needs an even number."""
    return count + count % 2 if count > 1 else count


def slots_of(value: Any, first: int, count: int, size: int | None = None) -> Any:
    """Some slots of arrays [..., K, n], padded with zeros to `size`."""

    def some(x: Array) -> Array:
        part = x[..., first : first + count, :]
        return jnp.pad(part, [(0, 0)] * (x.ndim - 2) + [(0, (size or count) - count), (0, 0)])

    return jax.tree.map(some, value)


def dynamic_groups(layout: Layout) -> list[tuple[SlotGroup, int]]:
    """Slot groups of dynamic bodies, with their first slots."""
    return [(group, first) for group, first in layout.spans if group.kind == DYNAMIC]


def static_slots(layout: Layout) -> list[tuple[SlotGroup, int]]:
    """Slots of static and kinematic bodies, with their slot groups."""
    groups = [(group, first) for group, first in layout.spans if group.kind != DYNAMIC]
    return [(group, first + i) for group, first in groups for i in range(group.count)]


def _inverse(value: Array, present: Array) -> Array:
    return reciprocal(value, present & jnp.isfinite(value) & (value > 0))


def _group(objects: Objects, layout: Layout, group: SlotGroup, first: int) -> BodyGroupState:
    own = slots_of(objects, first, group.count, padded_size(group.count))
    inverse = Inertia(_inverse(own.mass, own.present), _inverse(own.moment, own.present))
    mass, moment = (_inverse(x, x > 0) for x in inverse)
    ends = {slot for joint in layout.joints for slot in (joint.a, joint.b)}
    jointed = np.array([[first + i in ends] for i in range(padded_size(group.count))])
    shape = body_shape_of(own, group, slice(None))
    return BodyGroupState(shape, inverse, mass, moment, group.collides, jointed if jointed.any() else None)


def _static(objects: Objects, state: State, group: SlotGroup, slot: int) -> StaticBody:
    own, start = slots_of(objects, slot, 1), slots_of(state, slot, 1)
    motion = Motion(start.velocity, start.angular_velocity) if group.kind == KINEMATIC else None
    shape = body_shape_of(own, group, slice(None))
    return StaticBody(shape, start.position, start.angle, motion, to_world(shape, start.position, start.angle))


def _material(objects: Objects, first: int, count: int, inverse: Inertia | None) -> Material:
    own = slots_of(objects, first, count, padded_size(count))
    slots = jnp.broadcast_to(jnp.arange(first, first + padded_size(count))[:, None], own.radius.shape)
    resistance = own.rolling_resistance
    rolling = None if resistance is None else resistance * own.radius
    return Material(inverse, own.present, own.radius, own.elasticity, own.friction, rolling, slots)


def _materials(objects: Objects, layout: Layout, groups: list[BodyGroupState]) -> tuple[list[Material], list[Material]]:
    """Materials of the groups and of the static bodies; a kinematic body has infinite inertia."""
    spans = zip(dynamic_groups(layout), groups, strict=True)
    dynamic = [_material(objects, first, group.count, own.inverse) for (group, first), own in spans]
    zero = jnp.zeros_like(objects.radius[:1])
    static = []
    for group, slot in static_slots(layout):
        static.append(_material(objects, slot, 1, Inertia(zero, zero) if group.kind == KINEMATIC else None))
    return dynamic, static


def _collide(a: Material, b: Material, layout: Layout) -> Array:
    """Whether two bodies collide: no joint connects them, and both slot groups collide."""
    excluded = jnp.zeros(b.slot.shape, bool)
    for group, first in layout.spans:
        if not group.collides:
            for slot in (a.slot, b.slot):
                excluded = excluded | ((slot >= first) & (slot < first + group.count))
    for i, j in layout.exempt:
        excluded = excluded | ((a.slot == i) & (b.slot == j)) | ((a.slot == j) & (b.slot == i))
    return ~excluded


def _passing(layout: Layout, slot: int) -> list[np.ndarray]:
    """Bodies [N, 1] of each dynamic group that do not collide with the one in this slot, as a joint connects them."""
    exempt = layout.exempt
    return [
        np.array([[{slot, first + i} in exempt] for i in range(padded_size(group.count))])
        for group, first in dynamic_groups(layout)
    ]


def _constraint(
    a: Material, b: Material, shapes: tuple[BodyShape, BodyShape], static: bool, layout: Layout, mixing: str
) -> ContactConstraint:
    rolling = None
    if a.rolling is not None and b.rolling is not None:
        rolling = jnp.maximum(a.rolling, b.rolling) + jnp.zeros_like(b.radius)
    assert b.inverse is not None, "the second body is dynamic"
    inverse = a.inverse
    a = jax.tree.map(lambda x: jnp.broadcast_to(x, b.radius.shape), a._replace(inverse=None))._replace(inverse=inverse)
    present = a.present & b.present & (b.inverse.mass > 0) & _collide(a, b, layout)
    if a.inverse is not None and not static:
        present = present & (a.inverse.mass > 0)
    elasticity = mix_materials(a.elasticity, b.elasticity, mixing)
    friction = mix_materials(a.friction, b.friction, mixing)
    constraint = ContactConstraint(a.inverse, b.inverse, present, elasticity, friction, rolling, None, static)
    # Constant levers: of a disc on a dynamic disc, or on a disc or segment at rest.
    if a.inverse is None:
        constant = isinstance(shapes[0], DiscShape | CapsuleShape)
    else:
        constant = isinstance(shapes[0], DiscShape) and not static
    if not (constant and isinstance(shapes[1], DiscShape)):
        return constraint
    levers = None, None, None if a.inverse is None else a.radius, -b.radius
    return constraint._replace(frame=frame_of(constraint, levers, present))


def _neighbours(statics: list[StaticBody]) -> tuple[dict[int, Neighbours], dict[int, Neighbours]]:
    """Neighbours of each static segment at rest, for discs and for other shapes."""
    segments = {i: f.shape for i, f in enumerate(statics) if isinstance(f.shape, Stadium) and f.motion is None}
    return neighbours_of(segments)


def _all_pairs(
    objects: Objects,
    layout: Layout,
    groups: list[BodyGroupState],
    statics: list[StaticBody],
    setup: PassSetup,
    params: SolverParams,
) -> AllPairs:
    order = matches([padded_size(group.count) for group, _ in dynamic_groups(layout)], len(statics))
    (of_discs, of_others), rounds = _neighbours(statics), [match for match in order for _ in range(match.rounds)]
    pairs = [((statics if m.static else groups)[m.first].body_shape, groups[m.second].body_shape) for m in rounds]

    def play(k: int, a: Material, b: Material) -> tuple[Material, Material, tuple[ContactConstraint, Array, Array]]:
        match = rounds[k]
        constraint = _constraint(a, b, pairs[k], match.static, layout, params.mixing)
        if match.static:
            neighbours = of_discs if isinstance(pairs[k][1], DiscShape) else of_others
            constraint = constraint._replace(neighbours=neighbours.get(match.first))
        return a, b, (constraint, jnp.broadcast_to(a.slot, b.slot.shape), b.slot)

    _, played = run_schedule(*_materials(objects, layout, groups), order, play)
    slots = [(a, b) for _, a, b in played]
    points = [_point_count(*of) for of in pairs]
    return AllPairs([constraint for constraint, *_ in played], points, slots, order, setup, params)


def _point_count(a: BodyShape, b: BodyShape) -> int:
    """Number of contact points of two shapes."""
    return 1 if isinstance(a, DiscShape) or isinstance(b, DiscShape) else 2


def _nearby_pairs(
    objects: Objects,
    layout: Layout,
    groups: list[BodyGroupState],
    statics: list[StaticBody],
    setup: PassSetup,
    params: SolverParams,
) -> NearbyPairs:
    dynamic, static = _materials(objects, layout, groups)
    sizes, firsts = [material.slot.shape[0] for material in dynamic], [first for _, first in dynamic_groups(layout)]
    solid, solid_static = ([group.collides for group, _ in of] for of in (dynamic_groups(layout), static_slots(layout)))
    slots_of_statics, (of_discs, of_others) = [slot for _, slot in static_slots(layout)], _neighbours(statics)
    batches: list[PairBatch] = []

    def add(shapes: tuple[BodyShape, BodyShape], slots_a: np.ndarray, b: np.ndarray, **more: Any) -> None:
        def constraint(a: Material, b: Material) -> ContactConstraint:
            return _constraint(a, b, shapes, more["first"] is None, layout, params.mixing)

        slots = slots_a, b + firsts[more["second"]]
        batches.append(PairBatch(b=b, slots=slots, constraint=constraint, points=_point_count(*shapes), **more))

    for m in matches(sizes, 0):
        if not (solid[m.first] and solid[m.second]):
            continue
        a, b = pairings(sizes[m.first], sizes[m.second], m)
        ring = round_robin_of(a, b) if m.first == m.second else None
        shapes = groups[m.first].body_shape, groups[m.second].body_shape
        add(shapes, a + firsts[m.first], b, first=m.first, second=m.second, a=a, statics={}, round_robin=ring)
    for g, group in enumerate(groups):
        neighbours = of_discs if isinstance(group.body_shape, DiscShape) else of_others

        def operations(i: int, neighbours: dict[int, Neighbours] = neighbours) -> tuple:
            """Key of the static bodies that are solved by the same operations."""
            body = statics[i]
            leaves = len(jax.tree.leaves(body.body_shape))
            return type(body.body_shape), leaves, body.motion is None, i in neighbours

        touching = [i for i in range(len(statics)) if solid[g] and solid_static[i]]
        for _, numbers in itertools.groupby(touching, key=operations):
            alike = list(numbers)
            sides = {i: StaticSide(static[i], neighbours.get(i), static[i].present) for i in alike}
            a, b = np.indices((len(alike), sizes[g]))
            slots = np.array([slots_of_statics[i] for i in alike])[a]
            shapes = statics[alike[0]].body_shape, group.body_shape
            add(shapes, slots, b, first=None, second=g, a=a, statics=sides, round_robin=None)
    sides = []
    for material in dynamic:
        gravity = jnp.broadcast_to(setup.gravity, (2, *material.slot.shape))
        sides.append(DynamicSide(material, gravity, jnp.broadcast_to(setup.threshold, material.slot.shape)))
    rolling = objects.rolling_resistance is not None
    return NearbyPairs(batches, sides, rolling, setup, params, chunk_size(setup.threshold.shape[-1]))


def _joints(
    scene: Scene, layout: Layout, groups: list[BodyGroupState], sparse: bool
) -> tuple[list[springs.JointBatch], rigid_joints.JointSystem | None, limits_motors.LimitSystem | None]:
    """Springs in rounds, rigid joints, limits and motors; bodies are rows of a table, static ones last."""
    if not layout.joints:
        return [], None, None
    values, zero = scene.joints, jnp.zeros_like(scene.objects.mass[:1])
    assert values is not None, "a layout with joints needs scene.joints"
    sizes = [padded_size(group.count) for group, _ in dynamic_groups(layout)]
    static = [slot for _, slot in static_slots(layout)]
    rows = {slot: sum(sizes) + i for i, slot in enumerate(static)}
    for g, (group, first) in enumerate(dynamic_groups(layout)):
        rows |= {first + i: sum(sizes[:g]) + i for i in range(group.count)}
    infinite = [Inertia(zero, zero)] * len(static)
    inverse = jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *(g.inverse for g in groups), *infinite)

    def side(slots: np.ndarray, anchor: Array) -> springs.JointSide:
        own = np.array([rows[int(slot)] for slot in slots])
        return springs.JointSide(own, own >= sum(sizes), springs.take_rows(inverse, own), anchor)

    def batch(numbers: Sequence[int]) -> springs.JointBatch:
        joints, own = [layout.joints[j] for j in numbers], springs.take_rows(values, np.array(numbers))
        a, b = (np.array([getattr(joint, side) for joint in joints]) for side in "ab")
        present = scene.objects.present[a] & scene.objects.present[b]
        sides = side(a, own.anchor_a), side(b, own.anchor_b)
        rest = (own.rest, own.stiffness, own.damping, own.lower, own.upper, own.motor_speed, own.motor_torque)
        return springs.JointBatch(*sides, present, *rest)

    joints = [dataclasses.replace(joint, a=rows[joint.a], b=rows[joint.b]) for joint in layout.joints]
    every, moving = batch(range(len(joints))), sum(sizes)
    soft = np.array([joint.kind == "distance" for joint in joints])[:, None] & jnp.isfinite(every.stiffness)
    plan = rigid_joints.joint_system_plan(joints, moving)
    system = rigid_joints.JointSystem(plan, every.a, every.b, inverse, every.present & ~soft, every.rest)
    plan, limits = rigid_joints.joint_system_plan(joints, moving, angles=True), None
    hinges = plan.joint[plan.direction == rigid_joints.ANGLE].tolist()
    if hinges:
        limits = limits_motors.LimitSystem(system._replace(plan=plan), batch(hinges), sparse)
    return [batch(numbers) for numbers in springs.spring_rounds(joints, moving)], system, limits


def build_model(
    scene: Scene, state: State, layout: Layout, params: SolverParams, forces: Any, log: bool, sparse: bool
) -> Model:
    """Constants of a video; `log` asks for the positions of contacts, `sparse` for the solver of near pairs."""
    objects = scene.objects
    groups = [_group(objects, layout, group, first) for group, first in dynamic_groups(layout)]
    statics = [_static(objects, state, group, slot) for group, slot in static_slots(layout)]
    one = 1.0 + jax.lax.stop_gradient(jnp.maximum(-jnp.max(objects.radius), 0.0))  # 1.0, unknown to the compiler
    # A pile at rest is stopped anew in each step from the speed that gravity gave it, which is not a bounce.
    at_rest = 2 * params.step * jnp.sqrt(jnp.sum(scene.gravity**2, axis=0))
    setup = PassSetup(scene.gravity[:, None], jnp.maximum(params.bounce_threshold, at_rest), log)
    solver = (_nearby_pairs if sparse else _all_pairs)(objects, layout, groups, statics, setup, params)
    barriers = []
    for body, (group, slot) in zip(statics, static_slots(layout), strict=True):
        if group.collides and body.motion is None:
            barriers += barriers_of(body.shape, objects.present[slot : slot + 1], _passing(layout, slot))
    return Model(groups, statics, barriers, scene.gravity, solver, *_joints(scene, layout, groups, sparse), forces, one)
