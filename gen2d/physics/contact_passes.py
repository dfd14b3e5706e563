"""The three passes over a batch of contacts: warm start, first pass, relaxing pass.

A batch holds any number of pairs: all pairs of a round (all_pairs.py) or a chunk of near ones (nearby_pairs.py).
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from gen2d.physics.constraint import (
    ActiveContact,
    ContactConstraint,
    ContactPoint,
    Impulse,
    Motion,
    apply_impulse,
    impulse_change,
    impulse_vectors,
    relative_speed,
)
from gen2d.physics.contact_points import (
    accelerated,
    active_contacts,
    bounce_threshold,
    contact_points,
    displaced_points,
    impact_times,
    position_of,
)
from gen2d.physics.contact_state import BodySide, PassSetup, RelaxedPair, SolvedPair, WarmStart
from gen2d.physics.energy import MotionPair, add_disc_dissipation, add_dissipation, add_loss
from gen2d.physics.friction import apply_angular_impulse, friction_impulse, rolling_impulse
from gen2d.physics.impact_order import after_impact, in_order, takes_part, with_first
from gen2d.physics.jointed import free_motion, jointed_frame, with_joints, with_motions
from gen2d.physics.normal_impulse import (
    NormalTarget,
    TargetOf,
    impact_target,
    solve_normals,
    step_target,
)
from gen2d.physics.params import SolverParams
from gen2d.physics.position_correction import correct_positions
from gen2d.physics.relaxing import (
    LateImpact,
    closing_impact,
    displaced_since,
    displacement_before,
    relaxed_target,
    touching_impact,
)
from gen2d.physics.support import SupportedContacts, SupportedPair, add_obstacles, add_support, supported_pair
from gen2d.records.axes import Array
from gen2d.xla import materialize


def _supported_contacts(
    supported: SupportedPair | None, pair: SolvedPair, target_of: TargetOf, motions: MotionPair
) -> tuple[SupportedContacts, list[tuple[Array, Array]], list[NormalTarget]]:
    """Contacts with what supports leave of their bodies, their normal and tangential speeds, m/s, and targets."""
    seen = SupportedContacts(None, pair.contacts, 0.0) if supported is None else supported.contacts(pair.contacts)
    left = seen.left(motions)
    speeds = [relative_speed(contact.frame, contact.normal, *left) for contact in seen.contacts]
    of_contacts = zip(seen.contacts, speeds, pair.impulses, strict=True)
    return seen, speeds, [target_of(contact, speed, old) for contact, (speed, _), old in of_contacts]


def _solve_pending(
    constraint: ContactConstraint,
    pair: SolvedPair,
    normals: list[Array],
    a: BodySide,
    b: BodySide,
) -> tuple[BodySide, list[Array]]:
    """The side b, and the normal impulses, N s, with those by which a static body takes up its pending motion.

    The motion itself gets only the given ones.
    """
    if b.pending is None or constraint.a is not None or a.motion is not None:
        return b, normals
    pending, rows, none = b.pending, [], jnp.zeros_like(normals[0])
    for contact, normal, old in zip(pair.contacts, normals, pair.impulses, strict=True):
        bears = (normal > 0) | (old.normal > 0) | (contact.gap <= 0)
        active = bears & (contact.frame.normal_mass > 0)
        speed, _ = relative_speed(contact.frame, contact.normal, None, pending)
        rows.append((speed, Impulse(normal, none), NormalTarget(active, none, normal, jnp.zeros_like(active))))
    speeds, olds, targets = zip(*rows, strict=True)
    totals = materialize(solve_normals(constraint, pair.contacts, speeds, olds, targets))
    for contact, normal, total in zip(pair.contacts, normals, totals, strict=True):
        _, pending = apply_impulse(constraint, contact, (total - normal, None), None, pending)
    return b._replace(pending=pending), totals


def _apply_pass(
    constraint: ContactConstraint,
    pair: SolvedPair,
    target_of: TargetOf,
    a: BodySide,
    b: BodySide,
    supported: SupportedPair | None = None,
) -> tuple[BodySide, BodySide, SolvedPair, SupportedContacts]:
    """Both sides and the pair after impulses of contact and friction, and the contacts as these saw them."""
    assert b.motion is not None, "only static bodies lack a motion"
    before, roll, impulses, jointed = (a.motion, b.motion), pair.roll, [], b.joint_motion is not None
    seen, speeds, targets = _supported_contacts(supported, pair, target_of, before)
    normal_speeds = [speed for speed, _ in speeds]
    normals = materialize(solve_normals(constraint, seen.contacts, normal_speeds, pair.impulses, targets, seen.taken))
    b, totals = _solve_pending(constraint, pair, normals, a, b)
    changes = [normal - old.normal for normal, old in zip(normals, pair.impulses, strict=True)]
    if constraint.frame is not None and roll is None and not jointed:
        # The normal impulse between two discs adds no slip, but by supports: both follow from the same velocities.
        (contact,), (borne,), (old,), (normal,), (change,), (target,) = (
            pair.contacts, seen.contacts, pair.impulses, totals, changes, targets,
        )  # fmt: skip
        ((speed, slip),) = speeds
        slip = slip if seen.pair is None else slip - seen.pair.taken_slip(contact) * change
        tangent = materialize(friction_impulse(constraint, borne, normal, slip, old, target.apart))
        impulses.append(Impulse(normal, tangent))
        impulse = Impulse(change, tangent - old.tangent)
        motions = apply_impulse(constraint, contact, impulse, *before)
        work = add_disc_dissipation(b.work, borne.frame, impulse, speed, slip)
    else:
        motions = before
        for contact, change in zip(pair.contacts, changes, strict=True):
            motions = apply_impulse(constraint, contact, (change, None), *motions)
        for contact, old, normal, target in zip(seen.contacts, pair.impulses, totals, targets, strict=True):
            _, slip = relative_speed(contact.frame, contact.normal, *seen.left(motions))
            tangent = materialize(friction_impulse(constraint, contact, normal, slip, old, target.apart))
            impulses.append(Impulse(normal, tangent))
            motions = apply_impulse(constraint, contact, (None, tangent - old.tangent), *motions)
        if pair.roll is not None:
            roll = materialize(rolling_impulse(constraint, functools.reduce(jnp.add, totals), *motions, pair.roll))
            motions = apply_angular_impulse(constraint, roll - pair.roll, *motions)
        of = zip(changes, impulses, pair.impulses, strict=True)
        applied = [Impulse(change, new.tangent - old.tangent) for change, new, old in of]
        twist = None if roll is None or pair.roll is None else roll - pair.roll
        free = _free_motions(constraint, pair.contacts, applied, twist, a, b) if jointed else (before, motions)
        work = add_dissipation(b.work, constraint, pair.contacts, applied, twist, *(seen.left(of) for of in free))
        a, b = (with_motions(*of) for of in zip((a, b), motions, free[1], strict=True))
    vectors = pair.vectors
    if vectors is not None:
        more = impulse_vectors(pair.contacts[0].normal, impulse_change(impulses[0], pair.impulses[0]))
        vectors = jax.tree.map(jnp.add, vectors, more)
    solved = SolvedPair(pair.contacts, impulses, roll, vectors)
    a, b = a._replace(motion=motions[0]), b._replace(motion=motions[1], work=work)
    if seen.pair is not None:
        acts = [(normal > 0) | (old.normal > 0) for normal, old in zip(normals, pair.impulses, strict=True)]
        supported = seen.pair.where_acts(functools.reduce(jnp.logical_or, acts))
        a, b = _with_pending(constraint, supported, before, a, b)
    return a, b, solved, seen


def _with_pending(
    constraint: ContactConstraint, supported: SupportedPair, before: MotionPair, a: BodySide, b: BodySide
) -> tuple[BodySide, BodySide]:
    """Both sides after impulses, with what supports leave of their motions; the rest is pending.

    The impulses' own work is that on what supports leave, so the loss is that of the motions `before`.
    """
    assert b.motion is not None, "only static bodies lack a motion"
    work, sides = b.work, []
    of = zip((constraint.a, constraint.b), before, supported.left(before), supported.lighter, strict=True)
    for inertia, old, new, borne in of:
        assert inertia is not None, "both bodies move"
        work = add_loss(work, inertia, old, new, borne)
    for side, new in zip((a, b), supported.left((a.motion, b.motion)), strict=True):
        rest = supported.pending(jax.tree.map(jnp.subtract, side.motion, new))
        sides.append(side._replace(motion=new, pending=jax.tree.map(jnp.add, side.pending, rest)))
    return sides[0], sides[1]._replace(work=work)


def _free_motions(
    constraint: ContactConstraint,
    contacts: list[ActiveContact],
    changes: list[Impulse],
    twist: Array | None,
    a: BodySide,
    b: BodySide,
) -> tuple[MotionPair, MotionPair]:
    """Motions before and after the impulses, without what the joints take from them."""
    constraint = constraint._replace(schur_a=None, schur_b=None)
    free_a, free_b = free_motion(a), free_motion(b)
    assert free_b is not None, "only static bodies lack a motion"
    before = after = free_a, free_b
    for contact, change in zip(contacts, changes, strict=True):
        after = apply_impulse(constraint, contact, change, *after)
    return before, after if twist is None else apply_angular_impulse(constraint, twist, *after)


def warm_start(
    constraint: ContactConstraint, memory: WarmStart, a: BodySide, b: BodySide, setup: PassSetup, params: SolverParams
) -> tuple[BodySide, BodySide, list[ContactPoint]]:
    """Both sides with the impulses of the last step, which act at `displacement`, and the contact points.

    The sides also have the time of the first impact of each body.
    """
    assert b.motion is not None, "only static bodies lack a motion"
    roll, before = memory.roll, (a.motion, b.motion)
    acceleration = setup.gravity if constraint.static else None
    if b.acceleration is not None:
        acceleration = b.acceleration if a.acceleration is None else b.acceleration - a.acceleration
    normals = [jnp.abs(old.normal) for old in memory.impulses]
    points, motions = contact_points(constraint, a.shape, b.shape, normals, acceleration, setup), before
    assert b.displacement is not None, "only static bodies lack a displacement"
    olds = warm_start_impulses(constraint, points, memory.impulses)
    moved = displaced_points(constraint, points, a.displacement, b.displacement)
    for point, old in zip(moved, olds, strict=True):
        motions = apply_impulse(constraint, point, old, *motions)
    if roll is not None:
        motions = apply_angular_impulse(constraint, roll, *motions)
    if constraint.frame is not None and roll is None:
        speeds = relative_speed(moved[0].frame, moved[0].normal, *before)
        work = add_disc_dissipation(b.work, moved[0].frame, olds[0], *speeds)
    else:
        work = add_dissipation(b.work, constraint, moved, olds, roll, before, motions)
    motion_b = materialize(motions[1]) if constraint.static else motions[1]
    a, b = a._replace(motion=motions[0]), b._replace(motion=motion_b, work=work)
    if constraint.a is None and a.motion is None and b.support is not None:
        b = b._replace(support=add_support(b.support, points, olds))
    if takes_part(points, b):
        a, b = with_first(points[0], a, b, *impact_times(points, a, b, setup, params.step))
    if params.extreme_mass_ratios and constraint.a is not None:  # known in `find_obstacles`
        points = [point._replace(stop=jnp.zeros_like(point.gap)) for point in points]
    return a, b, points


def find_obstacles(
    constraint: ContactConstraint, memory: WarmStart, points: list[ContactPoint], a: BodySide, b: BodySide, h: float
) -> tuple[BodySide, BodySide, list[ContactPoint]]:
    """Both sides with each other as obstacles, and the points with their impulses; kinematic bodies are none.

    A point's impulse is what it starts with, or more if it touches in this step: what ends its approach.
    """
    if constraint.a is None and a.motion is not None:
        return a, b, points
    assert b.motion is not None, "only static bodies lack a motion"
    assert b.obstacles is not None, "moving bodies may have obstacles"
    stopped = []
    for point, old in zip(points, warm_start_impulses(constraint, points, memory.impulses), strict=True):
        speed, _ = relative_speed(point.frame, point.normal, a.motion, b.motion)
        ends = point.frame.normal_mass * jnp.maximum(-speed - jnp.maximum(point.gap, 0.0) / h, 0.0)
        stopped.append(point._replace(stop=jnp.maximum(old.normal, ends)))
    of_a, of_b = add_obstacles(constraint, stopped, (a.obstacles, b.obstacles), 1)
    return a._replace(obstacles=of_a), b._replace(obstacles=of_b), points if constraint.a is None else stopped


def _with_resting(old: BodySide, new: BodySide, bounces: Array) -> BodySide:
    """The side with what a contact at rest adds to its motion."""
    if new.resting is None:
        return new

    def total(added: Array, x: Array, y: Array) -> Array:
        return added + jax.lax.stop_gradient(jnp.where(bounces, 0.0, x - y))

    return new._replace(resting=jax.tree.map(total, new.resting, new.motion, old.motion))


def _update_drift(old: BodySide, new: BodySide, time: Array) -> BodySide:
    """The side with its drift reduced by the time of the impulses times the change of velocity."""
    assert old.motion, "only moving bodies drift"
    assert new.motion, "only moving bodies drift"
    assert old.drift, "only moving bodies drift"
    new = new._replace(drift=_reduced_drift(old.drift, time, new.motion, old.motion))
    if old.joint_drift is not None and new.joint_motion is not None and old.joint_motion is not None:
        new = new._replace(joint_drift=_reduced_drift(old.joint_drift, time, new.joint_motion, old.joint_motion))
    return new


def _reduced_drift(drift: Motion, time: Array, new: Motion, old: Motion) -> Motion:
    """Drift reduced by the time of an impulse times a change of motion."""
    return Motion(drift.velocity - time * (new.velocity - old.velocity), drift.spin - time * (new.spin - old.spin))


def _after_impulses(
    constraint: ContactConstraint,
    old: tuple[BodySide, BodySide],
    new: tuple[BodySide, BodySide],
    bounces: Array,
    time: Array,
) -> tuple[BodySide, BodySide]:
    """Both sides with the drift and the clock after impulses at this time, s."""
    (a, b), (new_a, new_b) = old, new
    new_b = _update_drift(b, new_b, time)
    if constraint.a is not None and a.drift is not None:
        new_a = _update_drift(a, new_a, time)
    return after_impact(new_a, new_b, bounces, time)


def solve(
    constraint: ContactConstraint,
    memory: WarmStart,
    points: list[ContactPoint],
    a: BodySide,
    b: BodySide,
    setup: PassSetup,
    params: SolverParams,
) -> tuple[BodySide, BodySide, SolvedPair]:
    """Both sides and the pair after the first pass: impulses, bounces and the correction of overlaps."""
    constraint, points = with_joints(constraint, a, b), accelerated(points, a, b)
    acceleration = points[0].acceleration
    supported = supported_pair(constraint, points, (a.support, b.support), (a.obstacles, b.obstacles))
    if supported is not None:
        pull = supported.acceleration(acceleration, setup.gravity)
        points = [point._replace(acceleration=pull) for point in points]
    taus = impact_times(points, a, b, setup, params.step)
    if takes_part(points, b):
        (tau,) = taus
        taus = [in_order(points[0], tau, a, b)]
        if supported is not None:  # those on borne bodies keep the order of the pairs
            taus = [jnp.where(supported.bears_impacts, tau, taus[0])]
    bounces = functools.reduce(jnp.logical_or, [tau >= 0 for tau in taus])
    supported = None if supported is None else supported.seen(bounces)
    contacts, time = active_contacts(constraint, points, taus, a, b, params.step)

    def target_of(contact: ActiveContact, speed: Array, old: Impulse) -> NormalTarget:
        return step_target(constraint, contact, speed, old, params.step)

    warm, vectors = warm_start_impulses(constraint, points, memory.impulses), None
    if params.late_passes and setup.log and constraint.frame is not None:
        vectors = impulse_vectors(contacts[0].normal, warm[0])
    pair = SolvedPair(contacts, warm, memory.roll, vectors)
    new_a, new_b, solved, seen = _apply_pass(constraint, pair, target_of, a, b, supported)
    new_a, new_b = _after_impulses(constraint, (a, b), (new_a, new_b), bounces, time)
    new_a, new_b = _with_resting(a, new_a, bounces), _with_resting(b, new_b, bounces)
    new_a, new_b = correct_positions(constraint, contacts, seen, acceleration, new_a, new_b, setup, params)
    if constraint.static:
        new_b = materialize(new_b._replace(work=None))._replace(work=new_b.work)
    return new_a, new_b, solved


def solve_impact(
    constraint: ContactConstraint,
    point: ContactPoint,
    solved: SolvedPair,
    tau: Array,
    a: BodySide,
    b: BodySide,
    params: SolverParams,
) -> tuple[BodySide, BodySide, SolvedPair]:
    """Both sides and the pair after an impact at tau that follows others of their bodies; unchanged without one."""
    constraint = with_joints(constraint, a, b)
    contacts, time = active_contacts(constraint, accelerated([point], a, b), [tau], a, b, params.step)
    happens = tau >= 0

    def target_of(contact: ActiveContact, speed: Array, old: Impulse) -> NormalTarget:
        return impact_target(constraint, contact, speed, old, happens)

    new_a, new_b, new, _ = _apply_pass(constraint, solved._replace(contacts=contacts), target_of, a, b)
    new_a, new_b = _after_impulses(constraint, (a, b), (new_a, new_b), happens, time)
    return jax.tree.map(lambda x, y: jnp.where(happens, x, y), (new_a, new_b, new), (a, b, solved))


MAX_STACK_IMPACT = 1.0  # m/s: faster contacts count as impacts even inside a stack


IMPULSE_GROWTH = 1.5  # from step to step, of the impulse that a resting contact starts with
LARGEST_SHIFT = 5.0  # in a step by that impulse alone, over the distance of the contact from the centres of its bodies


def _next_impulse(
    constraint: ContactConstraint,
    contact: ActiveContact,
    bounced: Array,
    impulse: Impulse,
    old: Impulse,
    setup: PassSetup,
    h: float,
) -> Impulse:
    """Impulse that the next step starts with.

    Impacts do not warm-start the next step, so `warm_start_impulses` drops negative impulses. The impulse is stored
    negated when the bodies were already touching, so that a resting pile mistaken for an impact recovers in the next
    step.

    The impulse of a contact that rests is at most that of the last step times `IMPULSE_GROWTH`, and what gravity adds
    in two steps. A pile that is crushed has large impulses once; applied again in the next steps, they would throw it
    apart. Nor would the impulse alone shift its bodies by more than `LARGEST_SHIFT` in a step. It could where a heavy
    body crushes a light one, and would throw both if it were applied again where the light one has turned.
    """
    frame = contact.frame
    most = IMPULSE_GROWTH * jnp.maximum(old.normal, 0.0) + setup.threshold * frame.normal_mass
    reach = jnp.abs(frame.tangent_b) + (0.0 if frame.tangent_a is None else jnp.abs(frame.tangent_a))
    normal = jnp.minimum(jnp.minimum(impulse.normal, most), LARGEST_SHIFT / h * reach * frame.normal_mass)
    friction = constraint.friction * normal
    negated = jnp.minimum(impulse.normal, MAX_STACK_IMPACT * frame.normal_mass)
    return Impulse(
        jnp.where(bounced, jnp.where(contact.gap <= 0, -negated, 0.0), normal),
        jnp.where(bounced, 0.0, jnp.clip(impulse.tangent, -friction, friction)),
    )


def warm_start_impulses(
    constraint: ContactConstraint, points: list[ContactPoint], impulses: list[Impulse]
) -> list[Impulse]:
    """Impulses of the last step without those of impacts, which are stored as negative normal impulses.

    Those of a segment end when the next segment of its line takes over.
    """
    impulses = [Impulse(jnp.maximum(i.normal, 0.0), i.tangent) for i in impulses]
    if constraint.neighbours is None or constraint.neighbours.line is None:
        return impulses
    held = [point.frame.normal_mass > 0 for point in points]
    return [Impulse(*(jnp.where(of, x, 0.0) for x in i)) for of, i in zip(held, impulses, strict=True)]


def _displaced_contacts(
    constraint: ContactConstraint, points: list[ContactPoint], solved: SolvedPair, a: Motion | None, b: Motion | None
) -> list[ActiveContact]:
    """Solved contacts after displacements of both bodies."""
    assert b is not None, "only static bodies lack a displacement"
    moved = zip(solved.contacts, displaced_points(constraint, points, a, b), strict=True)
    return [
        contact._replace(frame=jointed_frame(constraint, new.frame, new.normal), normal=new.normal)
        for contact, new in moved
    ]


def _relaxed_threshold(contact: ActiveContact, old: Impulse, a: BodySide, b: BodySide, setup: PassSetup) -> Array:
    resting = jnp.where(contact.tau < 0, old.normal, 0.0)
    return bounce_threshold(contact, resting, a, b, setup)


def _closing_impacts(
    constraint: ContactConstraint,
    points: list[ContactPoint],
    solved: SolvedPair,
    a: BodySide,
    b: BodySide,
    setup: PassSetup,
    h: float,
) -> list[LateImpact]:
    """Impacts of contacts that have closed by the end of the step; `constraint` is that with the joints."""
    contacts = _displaced_contacts(constraint, points, solved, a.displacement, b.displacement)
    return [
        closing_impact(point, contact, _relaxed_threshold(contact, old, a, b, setup), a, b, h)
        for point, contact, old in zip(points, contacts, solved.impulses, strict=True)
    ]


def _after_late_impact(
    constraint: ContactConstraint,
    point: ContactPoint,
    old: ActiveContact,
    contact: ActiveContact,
    late: LateImpact,
    a: Motion | None,
    b: Motion | None,
    h: float,
) -> ActiveContact:
    """The old contact with the late impact of the displaced one, if it is the first of the step."""
    side = a if point.moves_with_a else b
    path = 0.0 if side is None else side.velocity
    position = position_of(constraint, point, contact.frame, contact.normal, path)
    first = late.happens & (old.tau < 0)
    new = contact.normal, h - late.age, late.arrival, position
    of_both = new, (old.normal, old.tau, old.arrival, old.position)
    normal, tau, arrival, position = jax.tree.map(lambda x, y: jnp.where(first, x, y), *of_both)
    return old._replace(normal=normal, tau=tau, arrival=arrival, position=position)


def relaxed_pair(
    constraint: ContactConstraint, memory: WarmStart, pair: SolvedPair, setup: PassSetup, h: float
) -> RelaxedPair:
    """The pair with what the next step starts with, after relaxing passes with late impacts."""
    bounced = [contact.tau >= 0 for contact in pair.contacts]
    warm = _next_warm_start(constraint, memory, pair, bounced, setup, h)
    return RelaxedPair(pair, warm, _begins(memory, pair, pair))


def _next_warm_start(
    constraint: ContactConstraint, memory: WarmStart, pair: SolvedPair, bounced: list[Array], setup: PassSetup, h: float
) -> WarmStart:
    of = zip(pair.contacts, bounced, pair.impulses, memory.impulses, strict=True)
    impulses = [_next_impulse(constraint, c, b, new, old, setup, h) for c, b, new, old in of]
    return WarmStart(materialize(impulses), pair.roll)


def relax(
    constraint: ContactConstraint,
    memory: WarmStart,
    points: list[ContactPoint],
    solved: SolvedPair,
    a: BodySide,
    b: BodySide,
    setup: PassSetup,
    params: SolverParams,
) -> tuple[BodySide, BodySide, RelaxedPair]:
    """Both sides and the pair after a relaxing solve at the end of the step.

    Sides with `late` know afterwards whether one with late impacts is needed.
    """
    constraint, h = with_joints(constraint, a, b), params.step
    late: list[LateImpact] = []

    def target_of(contact: ActiveContact, speed: Array, old: Impulse) -> NormalTarget:
        threshold = _relaxed_threshold(contact, old, a, b, setup)
        late.append(touching_impact(contact, speed, threshold))
        return relaxed_target(constraint, contact, late[-1], speed, old, threshold)

    contacts = _displaced_contacts(constraint, points, solved, a.displacement, b.displacement)
    new_a, new_b, last = _relaxed(constraint, solved, contacts, target_of, a, b)
    bounced = [(contact.tau >= 0) | impact.happens for contact, impact in zip(last.contacts, late, strict=True)]
    warm = _next_warm_start(constraint, memory, last, bounced, setup, h)
    if new_b.late is not None:
        closing = _closing_impacts(constraint, points, solved, a, b, setup, h)
        happens = functools.reduce(jnp.logical_or, [impact.happens for impact in closing])
        new_b = new_b._replace(late=new_b.late | happens)
    return new_a, new_b, RelaxedPair(last, warm, _begins(memory, solved, last))


def _relaxed(
    constraint: ContactConstraint,
    solved: SolvedPair,
    contacts: list[ActiveContact],
    target_of: Callable[[ActiveContact, Array, Impulse], NormalTarget],
    a: BodySide,
    b: BodySide,
) -> tuple[BodySide, BodySide, SolvedPair]:
    """Both sides and the pair after a solve of displaced contacts."""
    a, b, last, _ = _apply_pass(constraint, solved._replace(contacts=contacts), target_of, a, b)
    return a, b._replace(motion=materialize(b.motion)) if constraint.static else b, last


def relax_late(
    constraint: ContactConstraint,
    points: list[ContactPoint],
    solved: SolvedPair,
    a: BodySide,
    b: BodySide,
    setup: PassSetup,
    params: SolverParams,
) -> tuple[BodySide, BodySide, SolvedPair, Array]:
    """Both sides and the pair after a relaxing solve with late impacts (relaxing.py), which also displace the sides,
    and whether any happened.

    The contacts of the pair stay as the first pass solved them, but for the ones that bounce late.
    """
    constraint, h = with_joints(constraint, a, b), params.step
    closing = _closing_impacts(constraint, points, solved, a, b, setup, h)
    age = functools.reduce(jnp.maximum, [impact.age for impact in closing])
    displacements = displacement_before(a, age), displacement_before(b, age)
    late: list[LateImpact] = []

    def target_of(contact: ActiveContact, speed: Array, old: Impulse) -> NormalTarget:
        late.append(closing[len(late)].seen_at(speed))
        threshold = _relaxed_threshold(contact, old, a, b, setup)
        return relaxed_target(constraint, contact, late[-1], speed, old, threshold)

    contacts = _displaced_contacts(constraint, points, solved, *displacements)
    new_a, new_b, last = _relaxed(constraint, solved, contacts, target_of, a, b)
    new_a, new_b = displaced_since(a, new_a, age), displaced_since(b, new_b, age)
    of = zip(points, solved.contacts, contacts, late, strict=True)
    contacts = [_after_late_impact(constraint, *each, *displacements, h) for each in of]
    happened = functools.reduce(jnp.logical_or, [impact.happens for impact in late])
    return new_a, new_b, last._replace(contacts=contacts), happened


def touching(solved: SolvedPair, last: SolvedPair) -> Array:
    """Whether a normal impulse acted in the first or in the relaxing pass."""
    pressed = [i.normal > 0 for pair in (solved, last) for i in pair.impulses]
    return functools.reduce(jnp.logical_or, pressed)


def _begins(memory: WarmStart, solved: SolvedPair, last: SolvedPair) -> Array:
    """See `RelaxedPair.began`; from the pair after the first and the relaxing pass."""
    before = [impulse.normal != 0 for impulse in memory.impulses]
    return touching(solved, last) & ~functools.reduce(jnp.logical_or, before)


def overlap(solved: SolvedPair) -> Array:
    """Deepest overlap of a pair, m."""
    depth = jnp.zeros_like(solved.contacts[0].gap)
    for contact in solved.contacts:
        depth = jnp.maximum(depth, jnp.where(contact.frame.normal_mass > 0, -contact.gap, 0.0))
    return depth
