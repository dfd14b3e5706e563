"""From a scene to what the solver needs of it: groups of moving bodies, fixed bodies, joints, and a row for every pair.

The layout says which slots hold what, so all of this is known when a program is compiled, but for the numbers.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.core.enums import DYNAMIC, KINEMATIC
from gen2d.physics import joint_forces, rigid_joints
from gen2d.physics.all_pairs import AllPairs
from gen2d.physics.broad_phase import round_robin_of
from gen2d.physics.collision import FAR, Stadium, dot, from_core
from gen2d.physics.constraint import ContactConstraint, Inertia, Motion, frame_of, mix_materials, reciprocal
from gen2d.physics.contact_state import PassSetup
from gen2d.physics.nearby_pairs import DynamicSide, NearbyPairs, PairBatch, StaticSide, chunk_of
from gen2d.physics.params import SolverParams
from gen2d.physics.schedule import match_of_rows, matches, pairings, run_schedule
from gen2d.physics.shapes import BodyShape, CapsuleShape, DiscShape, body_shape_of, to_world
from gen2d.physics.state import BodyGroupState, Model, StaticBody
from gen2d.records.axes import Array, Record
from gen2d.records.layout import JointSpec, Layout, SlotGroup
from gen2d.records.scene import Objects, Scene, State


class GroupSide(NamedTuple):
    """What a row needs to know of one of its sides."""

    inverse: Inertia | None
    present: Array
    radius: Array
    elasticity: Array
    friction: Array
    rolling: Array | None  # m
    slot: Array


def without_empty(scene: Scene, state: State) -> tuple[Scene, State]:
    """Both with nothing in their empty slots, so that whatever stood there (NaN, too) cannot matter."""
    present = scene.objects.present

    def clean(values: Record) -> Record:
        return jax.tree.map(lambda x: jnp.where(present, x, jnp.zeros_like(x)), values)

    return Scene(clean(scene.objects), scene.gravity, scene.joints), clean(state)


def pad_groups(count: int) -> int:
    """How many bodies a group of so many has: a tournament needs an even number."""
    return count + count % 2 if count > 1 else count


def slots_of(value: Any, first: int, count: int, room: int | None = None) -> Any:
    """Some slots of arrays [..., K, n], with zeros up to `room`."""

    def some(x: Array) -> Array:
        part = x[..., first : first + count, :]
        return jnp.pad(part, [(0, 0)] * (x.ndim - 2) + [(0, (room or count) - count), (0, 0)])

    return jax.tree.map(some, value)


def moving(layout: Layout) -> list[tuple[SlotGroup, int]]:
    """The runs of dynamic bodies, each a group, and their first slots."""
    return [(run, first) for run, first in layout.spans if run.kind == DYNAMIC]


def standing(layout: Layout) -> list[tuple[SlotGroup, int]]:
    """Every static and kinematic slot, and the run that it is in."""
    runs = [(run, first) for run, first in layout.spans if run.kind != DYNAMIC]
    return [(run, first + i) for run, first in runs for i in range(run.count)]


def _inverse(value: Array, present: Array) -> Array:
    return reciprocal(value, present & jnp.isfinite(value) & (value > 0))


def _group(objects: Objects, layout: Layout, run: SlotGroup, first: int) -> BodyGroupState:
    some = slots_of(objects, first, run.count, pad_groups(run.count))
    inverse = Inertia(_inverse(some.mass, some.present), _inverse(some.moment, some.present))
    mass, moment = (_inverse(x, x > 0) for x in inverse)
    return BodyGroupState(body_shape_of(some, run, slice(None)), inverse, mass, moment, run.collides)


def _fixed(objects: Objects, state: State, run: SlotGroup, slot: int) -> StaticBody:
    some, place = slots_of(objects, slot, 1), slots_of(state, slot, 1)
    motion = Motion(place.velocity, place.angular_velocity) if run.kind == KINEMATIC else None
    form = body_shape_of(some, run, slice(None))
    return StaticBody(form, place.position, place.angle, motion, to_world(form, place.position, place.angle))


def _side(objects: Objects, first: int, count: int, inverse: Inertia | None) -> GroupSide:
    some = slots_of(objects, first, count, pad_groups(count))
    slots = jnp.broadcast_to(jnp.arange(first, first + pad_groups(count))[:, None], some.radius.shape)
    resistance = some.rolling_resistance
    rolling = None if resistance is None else resistance * some.radius
    return GroupSide(inverse, some.present, some.radius, some.elasticity, some.friction, rolling, slots)


def _sides(objects: Objects, layout: Layout, groups: list[BodyGroupState]) -> tuple[list[GroupSide], list[GroupSide]]:
    """Of the groups and of the fixed bodies; a kinematic one has an inertia, which is infinite."""
    ours = [_side(objects, s, run.count, g.inverse) for (run, s), g in zip(moving(layout), groups, strict=True)]
    nothing = jnp.zeros_like(objects.radius[:1])
    unmoved = Inertia(nothing, nothing)
    theirs = [_side(objects, s, 1, unmoved if run.kind == KINEMATIC else None) for run, s in standing(layout)]
    return ours, theirs


def _apart(a: GroupSide, b: GroupSide, layout: Layout) -> Array:
    """Where two collide: where no joint ties them together, and neither is of a run that nothing touches."""
    tied = [tie for tie in layout.joints if not tie.collide]
    together = jnp.zeros(b.slot.shape, bool)
    for run, first in layout.spans:
        if not run.collides:
            for slot in (a.slot, b.slot):
                together = together | ((slot >= first) & (slot < first + run.count))
    for i, j in ((tie.a, tie.b) for tie in tied):
        together = together | ((a.slot == i) & (b.slot == j)) | ((a.slot == j) & (b.slot == i))
    return ~together


def _round(a: BodyShape, b: BodyShape, fixed: bool, still: bool) -> bool:
    """Whether a pair's levers are known beforehand: two discs, or a disc on something that stands still."""
    if not isinstance(b, DiscShape):
        return False
    return (isinstance(a, DiscShape) and (not fixed or still)) or (isinstance(a, CapsuleShape) and fixed and still)


def _row(
    a: GroupSide, b: GroupSide, forms: tuple[BodyShape, BodyShape], fixed: bool, layout: Layout, mixing: str
) -> ContactConstraint:
    rolling = None
    if a.rolling is not None and b.rolling is not None:
        rolling = jnp.maximum(a.rolling, b.rolling) + jnp.zeros_like(b.radius)
    assert b.inverse is not None, "a fixed body is never second"
    values = jax.tree.map(lambda x: jnp.broadcast_to(x, b.radius.shape), a._replace(inverse=None))
    a = values._replace(inverse=a.inverse)
    here = a.present & b.present & (b.inverse.mass > 0) & _apart(a, b, layout)
    if a.inverse is not None and not fixed:
        here = here & (a.inverse.mass > 0)
    elasticity, friction = (
        mix_materials(a.elasticity, b.elasticity, mixing),
        mix_materials(a.friction, b.friction, mixing),
    )
    row = ContactConstraint(a.inverse, b.inverse, here, elasticity, friction, rolling, None, fixed)
    if not _round(*forms, fixed, a.inverse is None):
        return row
    levers = None, None, None if a.inverse is None else a.radius, -b.radius
    return row._replace(grip=frame_of(row, levers, here))


TOGETHER = 1e-4  # m: ends that are so near to another segment lie on it


def _onward(ends: Array, own: np.ndarray, shapes: Stadium) -> tuple[Array, Array]:
    """For ends [2, E, n] of segments `own` [E], the two directions in which others go on from there, zero if none do;
    of all segments [S, ..., 1, n] one after the other, in a loop, which is compiled once for all of them."""

    def on(found: tuple[Array, Array], other: tuple[Stadium, Array]) -> tuple[tuple[Array, Array], None]:
        (first, second), (shape, number) = found, other
        aside, along, _ = from_core(shape, ends)
        there = (dot(aside, aside) < TOGETHER**2) & (shape.half_length > TOGETHER) & (number != own)[:, None]
        for way, goes in ((1, along < shape.half_length - TOGETHER), (-1, along > TOGETHER - shape.half_length)):
            new, empty = there & goes, dot(first, first) == 0
            first, second = (
                jnp.where(new & empty, way * shape.direction, first),
                jnp.where(new & ~empty, way * shape.direction, second),
            )
        return (first, second), None

    nothing = jnp.zeros_like(ends)
    return jax.lax.scan(on, (nothing, nothing), (shapes, jnp.arange(len(shapes.radius))))[0]


def _ways(fixed: list[StaticBody]) -> dict[int, list]:
    """Of each fixed segment that stands still what goes on from its two ends; nothing where there is one at most."""
    lines = {i: f.shape for i, f in enumerate(fixed) if isinstance(f.shape, Stadium) and f.motion is None}
    if len(lines) < 2:
        return {}
    shapes: Stadium = jax.tree.map(lambda *x: jnp.stack(jnp.broadcast_arrays(*x)), *lines.values())
    reach = shapes.half_length[:, None] * shapes.direction
    ends = jnp.stack([shapes.centre - reach, shapes.centre + reach], axis=1)  # [S, 2 ends, 2, 1, n]
    numbers = np.arange(2 * len(lines))
    found = _onward(jnp.moveaxis(ends[..., 0, :], 2, 0).reshape(2, len(numbers), -1), numbers // 2, shapes)
    each = [tuple(x[:, k : k + 1] for x in found) for k in numbers]
    return {i: each[2 * k : 2 * k + 2] for k, i in enumerate(lines)}


def _dense(
    objects: Objects,
    layout: Layout,
    groups: list[BodyGroupState],
    fixed: list[StaticBody],
    setup: PassSetup,
    rules: SolverParams,
) -> AllPairs:
    order = matches([pad_groups(run.count) for run, _ in moving(layout)], len(fixed))
    forms, matched, ways = [g.form for g in groups], match_of_rows(order), _ways(fixed)
    pairs = [(fixed[m.first].form if m.fixed else forms[m.first], forms[m.second]) for m in matched]

    def play(k: int, a: GroupSide, b: GroupSide) -> tuple[GroupSide, GroupSide, tuple[ContactConstraint, Array, Array]]:
        row, m = _row(a, b, pairs[k], matched[k].fixed, layout, rules.mixing), matched[k]
        if row.grip is not None and m.fixed and m.first in ways:
            row = row._replace(left=ways[m.first][0], right=ways[m.first][1])
        return a, b, (row, jnp.broadcast_to(a.slot, b.slot.shape), b.slot)

    _, made = run_schedule(*_sides(objects, layout, groups), order, play)
    points = [_points(*of) for of in pairs]
    return AllPairs([row for row, *_ in made], points, [(a, b) for _, a, b in made], order, setup, rules)


def _points(a: BodyShape, b: BodyShape) -> int:
    """How many points of contact two shapes have."""
    return 1 if _is_disc(a) or _is_disc(b) else 2


def _sparse(
    objects: Objects,
    layout: Layout,
    groups: list[BodyGroupState],
    fixed: list[StaticBody],
    setup: PassSetup,
    rules: SolverParams,
) -> NearbyPairs:
    ours, theirs = _sides(objects, layout, groups)
    sizes, firsts = [side.slot.shape[0] for side in ours], [first for _, first in moving(layout)]
    solid, firm = ([run.collides for run, _ in of] for of in (moving(layout), standing(layout)))
    fixed_slots, ways, kinds = [slot for _, slot in standing(layout)], _ways(fixed), []

    def add(forms: tuple[BodyShape, BodyShape], of_a: np.ndarray, b: np.ndarray, **more: Any) -> None:
        def row(a: GroupSide, b: GroupSide) -> ContactConstraint:
            return _row(a, b, forms, more["first"] is None, layout, rules.mixing)

        slots = of_a, b + firsts[more["second"]]
        kinds.append(PairBatch(b=b, slots=slots, row=row, points=_points(*forms), **more))

    for m in matches(sizes, 0):
        if not (solid[m.first] and solid[m.second]):
            continue
        a, b = pairings(sizes[m.first], sizes[m.second], m)
        ring = round_robin_of(a, b) if m.first == m.second else None
        forms = groups[m.first].form, groups[m.second].form
        add(forms, a + firsts[m.first], b, first=m.first, second=m.second, a=a, posts={}, ring=ring)
    for g, group in enumerate(groups):

        def like(i: int, form: BodyShape = group.form) -> tuple:
            """What fixed bodies have in common whose rows with the group are of one kind."""
            of = fixed[i]
            return type(of.form), len(jax.tree.leaves(of.form)), of.motion is None, i in ways and _is_disc(form)

        touching = [i for i in range(len(fixed)) if solid[g] and firm[i]]
        for alike, numbers in itertools.groupby(touching, key=like):
            some = list(numbers)
            onward = {i: ways[i] if alike[-1] else (None, None) for i in some}
            posts = {i: StaticSide(theirs[i], left, right, theirs[i].present) for i, (left, right) in onward.items()}
            a, b = np.indices((len(some), sizes[g]))
            slots = np.array([fixed_slots[i] for i in some])[a]
            add((fixed[some[0]].form, group.form), slots, b, first=None, second=g, a=a, posts=posts, ring=None)
    seats = [
        DynamicSide(
            side,
            jnp.broadcast_to(setup.gravity, (2, *side.slot.shape)),
            jnp.broadcast_to(setup.threshold, side.slot.shape),
        )
        for side in ours
    ]
    rolling = objects.rolling_resistance is not None
    return NearbyPairs(kinds, seats, rolling, setup, rules, chunk_of(setup.threshold.shape[-1]))


def _is_disc(form: BodyShape) -> bool:
    return isinstance(form, DiscShape)


def _ties(
    scene: Scene, layout: Layout, groups: list[BodyGroupState]
) -> tuple[list[joint_forces.JointBatch], rigid_joints.JointSystem | None]:
    """The joints in rounds, and what of them is rigid. A body's line in the solver's table is its place among the
    groups, or behind them."""
    if not layout.joints:
        return [], None
    values, nothing = scene.joints, jnp.zeros_like(scene.objects.mass[:1])
    assert values is not None, "a layout with joints needs scene.joints"
    sizes, still = [pad_groups(run.count) for run, _ in moving(layout)], [slot for _, slot in standing(layout)]
    lines = {slot: sum(sizes) + place for place, slot in enumerate(still)}
    for g, (run, first) in enumerate(moving(layout)):
        lines |= {first + i: sum(sizes[:g]) + i for i in range(run.count)}
    unmoved = [Inertia(nothing, nothing)] * len(still)
    inverse = jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *(g.inverse for g in groups), *unmoved)

    def end(slots: np.ndarray, anchor: Array) -> joint_forces.JointSide:
        of = np.array([lines[int(slot)] for slot in slots])
        return joint_forces.JointSide(of, of >= sum(sizes), joint_forces.joint_lines(inverse, of), anchor)

    def tied(numbers: Sequence[int]) -> joint_forces.JointBatch:
        ties, of = [layout.joints[j] for j in numbers], joint_forces.joint_lines(values, np.array(numbers))
        a, b = (np.array([getattr(tie, side) for tie in ties]) for side in "ab")
        there = scene.objects.present[a] & scene.objects.present[b]
        ends = end(a, of.anchor_a), end(b, of.anchor_b)
        rest = (of.rest, of.stiffness, of.damping, of.lower, of.upper, of.motor_speed, of.motor_torque)
        return joint_forces.JointBatch(ties[0].kind, *ends, there, *rest)

    named = [JointSpec(tie.kind, lines[tie.a], lines[tie.b]) for tie in layout.joints]
    every = tied(range(len(named)))
    springs = np.array([tie.kind == "distance" for tie in named])[:, None] & jnp.isfinite(every.stiffness)
    linked = rigid_joints.JointSystem(
        rigid_joints.joint_system_plan(named, sum(sizes)), every.a, every.b, inverse, every.there & ~springs, every.rest
    )
    return [tied(numbers) for numbers in joint_forces.joint_rounds(named, sum(sizes))], linked


def build_model(
    scene: Scene, state: State, layout: Layout, rules: SolverParams, forces: Any, contacts: bool, sparse: bool
) -> Model:
    """What stays the same for a whole video; `contacts` says whether touches shall say where they are, `sparse` which
    form of the solver it is for."""
    objects = scene.objects
    groups = [_group(objects, layout, run, first) for run, first in moving(layout)]
    fixed = [_fixed(objects, state, run, slot) for run, slot in standing(layout)]
    one = 1.0 + jax.lax.stop_gradient(jnp.maximum(-jnp.max(objects.radius), 0.0))  # 1, but the compiler cannot know
    # In a pile at rest, what has to be stopped anew each step is what gravity gave: that must not count as a bounce.
    at_rest = 2 * rules.step * jnp.sqrt(jnp.sum(scene.gravity**2, axis=0))
    setup = PassSetup(scene.gravity[:, None], jnp.maximum(rules.bounce_threshold, at_rest), contacts)
    made = (_sparse if sparse else _dense)(objects, layout, groups, fixed, setup, rules)
    rails = [
        _rail(f, objects.present[s : s + 1]) for f, (r, s) in zip(fixed, standing(layout), strict=True) if r.collides
    ]
    return Model(
        groups,
        fixed,
        [r for r in rails if r is not None],
        scene.gravity,
        made,
        *_ties(scene, layout, groups),
        forces,
        one,
    )


def _rail(body: StaticBody, present: Array) -> Stadium | None:
    """A fixed segment that stands still, and None if it is no such thing; of negative length where it is absent."""
    if body.motion is not None or not isinstance(body.shape, Stadium):
        return None
    return body.shape._replace(half_length=jnp.where(present, body.shape.half_length, -FAR))
