"""One step of sequential impulses: coloured Gauss-Seidel over every pair that can touch, static bodies last.

A step of h seconds:

1. Gravity, forces and damping change the velocities.
2. The impulses of the last step are applied again (warm starting), at half of the step.
3. Every pair is solved once, bounces at the exact time of impact, and is pushed apart where it overlaps, which
   moves the bodies but leaves no speed; then all rigid joints at once.
4. The bodies move, and springs give the energy that they have lost over the way (springs.py).
5. Every pair and all joints are solved once more, where the bodies are at the end of the step.

Pairs are solved in rounds of disjoint pairs (schedule.py), all of them (all_pairs.py) or those that are near
(nearby_pairs.py), each round from the result of the last. Springs, limits and motors come before the contacts
(springs.py, limits_motors.py), static bodies last of all pairs. Overlaps are corrected by displacements of their own
(position_correction.py). Rigid joints (rigid_joints.py) are solved before the contacts, which see what the joints
leave of their bodies' masses (jointed.py), and after them.

Restitution. A contact that closes within the step bounces: Newton's law is applied to the velocities that it finds, so
impacts follow one another and never add energy. The impulse P acts at the time of impact tau, not at the start of the
step, so it moves its body by (h - tau) P / m: the drift subtracts tau P / m from the displacement of the new velocity.
The path is exact, and so is its derivative; without tau even its sign is wrong. All other impulses act at h / 2, like
forces that are constant in the step.

Impulse and reaction act at one point, where the bodies are when they act, which conserves angular momentum: the passes
move the contact points by the displacement until then, the last one to the end of the step.

Sources: E. Catto, 'Iterative dynamics with temporal coherence' (GDC 2005) for accumulated impulses and warm starting;
'Solver2D' (2024) for small steps and a relaxing pass; Y. Hu et al., DiffTaichi (arXiv 1910.00935) for the time of
impact in gradients.
"""

import functools
import math

import jax
import jax.numpy as jnp

from gen2d.physics import limits_motors, rigid_joints, springs
from gen2d.physics.collision import Disc, Shape
from gen2d.physics.constraint import Motion, speed_bound
from gen2d.physics.contact_state import BodySide
from gen2d.physics.energy import Ledger, Work, accumulate, record_energy, spring_work_over
from gen2d.physics.impact_order import not_hit
from gen2d.physics.jointed import hold, release
from gen2d.physics.params import FIRST_STEPS, SolverParams
from gen2d.physics.shapes import to_world
from gen2d.physics.springs import poses_of, table_of
from gen2d.physics.state import BodyState, Model, WorldState
from gen2d.physics.support import no_obstacles, no_support
from gen2d.physics.tunnelling import clamp_displacement
from gen2d.records.axes import Array, take_scenes
from gen2d.records.parameter import apply
from gen2d.xla import materialize


def _accelerations(world: WorldState, model: Model) -> tuple[list[Array], list[Array] | None]:
    """Acceleration [2, N, ...] and angular acceleration [N, ...] of each group; None without forces."""
    groups, gravity = model.groups, model.gravity
    linear = [gravity[:, None] * (g.inverse.mass > 0) for g in groups]
    if model.forces is None:
        return linear, None
    forces = model.forces(world.bodies, world.time)
    linear = [a + g.inverse.mass * force for a, g, (force, _) in zip(linear, groups, forces, strict=True)]
    return linear, [g.inverse.moment * torque for g, (_, torque) in zip(groups, forces, strict=True)]


def _free_motion(
    body: BodyState, acceleration: Array, angular: Array | float, params: SolverParams
) -> tuple[Motion, Motion]:
    """Motion after a step without contacts, and the displacement beyond h times that.

    Both are exact for a constant acceleration a and a damping rate c: with s = exp(-c h), p = (1 - s) / c and
    q = (h - p) / c, v becomes s v + p a and the displacement is p v + q a.
    """
    h, c = params.step, params.damping
    s = apply(math.exp, -c * h) if c else 1.0
    p = -apply(math.expm1, -c * h) / c if c else h
    q = (h - p) / c if c * h > 1e-4 else 0.5 * h**2 * (1 - c * h / 3)
    old = body.motion
    motion = Motion(s * old.velocity + p * acceleration, s * old.spin + p * angular)
    velocity, spin = (q - h * p) * acceleration, (q - h * p) * angular + jnp.zeros_like(old.spin)
    if c:
        velocity, spin = velocity + (p - h * s) * old.velocity, spin + (p - h * s) * old.spin
    return motion, Motion(velocity, spin)


def _scaled(motion: Motion, time: float) -> Motion:
    return jax.tree.map(lambda x: time * x, motion)


def _displace(body: BodyState, displacement: Motion, motion: Motion) -> BodyState:
    """Body after a displacement, with a compensated sum (W. Kahan, 1965), and its motion."""
    assert body.remainder is not None, "moving bodies have a remainder"
    old, add = Motion(body.position, body.angle), jax.tree.map(jnp.add, displacement, body.remainder)
    new = materialize(jax.tree.map(jnp.add, old, add))
    remainder = jax.tree.map(lambda n, o, d: jax.lax.stop_gradient(d - (n - o)), new, old, add)
    return BodyState(new.velocity, new.spin, motion, remainder)


class _Springs:
    """The springs in a step, with their works so far; does nothing without springs."""

    def __init__(self, model: Model, world: WorldState, statics: list[BodyState], h: float) -> None:
        self._groups, self._h, self._sprung = model.groups, h, springs.Sprung([], None, [], [])
        self._works: list[Work] = []
        poses = poses_of(world.bodies, statics) if model.springs else None
        anchors = [springs.anchors_of(batch.a, batch.b, poses) for batch in model.springs]
        self._of = model.springs, anchors, [body.motion for body in statics]

    def speed_bounds(self, motions: list[Motion]) -> list[Array] | None:
        """Bounds on what they will add to the speeds of each group, m/s [N, ...], from these motions."""
        return springs.speed_bounds(*self._of, motions, self._h)

    def pull(
        self, motions: list[Motion], drifts: list[Motion], free_drifts: list[Motion], accelerations: list[Array]
    ) -> tuple[list[Motion], list[Motion]]:
        """Motions after their impulses, and the drifts of all forces; `drifts` are those of other impulses."""
        self._sprung = springs.apply(*self._of, motions, _sums(drifts, free_drifts), accelerations, self._h)
        if self._sprung.changes is None:
            return motions, free_drifts
        own = [_scaled(change, -0.5 * self._h) for change in self._sprung.changes]
        return self._sprung.motions, _sums(free_drifts, own)

    @property
    def accelerations(self) -> list[Array] | list[None]:
        """Acceleration [2, N, ...] of each group by the springs, m/s^2."""
        changes = self._sprung.changes
        return [None] * len(self._groups) if changes is None else [change.velocity / self._h for change in changes]

    def conserve(self, displacements: list[Motion], motions: list[Motion]) -> list[Motion]:
        """Motions at the end of the step, in which the springs have given what they have lost."""
        motions, self._works = springs.conserve(*self._of, displacements, motions, self._sprung.impulses, self._h)
        return motions

    def works(self, flown: list[Motion], displacements: list[Motion], warm: list[Motion]) -> list[Work]:
        """All works; `flown` are the displacements without any contact or joint, `warm` the changes by warm starting.

        A contact's work is that over the speeds that it meets, the springs' own included, which are given back by the
        end of the step; but those of warm starting come before the springs, which meet its speeds instead.
        """
        works, changes, h = [*self._sprung.works, *self._works], self._sprung.changes, self._h
        if changes is None:
            return works
        of = zip(displacements, flown, changes, warm, strict=True)
        ways = [jax.tree.map(lambda x, free, own, first: x - free - h * (0.5 * own + first), *parts) for parts in of]
        return [*works, spring_work_over(self._groups, [_scaled(change, 1 / h) for change in changes], ways)]


class _RigidJoints:
    """The rigid joints in a step, with their work so far; does nothing without joints."""

    def __init__(self, model: Model, world: WorldState, statics: list[BodyState], params: SolverParams) -> None:
        self._system, self._limits, self._params = model.joint_system, model.limit_system, params
        # Whether contacts meet bodies that joints may hold.
        self._in_contacts = self._system is not None and any(group.collides for group in model.groups)
        self._moved_again = bool(model.springs) or self._limits is not None  # between warm starting and the first pass
        self._fixed = [body.motion for body in statics]
        self.twists, self.works = world.twists, []
        if self._system is not None:
            self._impulses = rigid_joints.zero_impulses(self._system)
            anchors = rigid_joints.anchors_at(self._system, world.bodies, statics)
            self._factored = rigid_joints.FactoredSystem(self._system, anchors)
        if self._limits is not None:
            self._angles = limits_motors.hinge_angles(self._limits.hinges, poses_of(world.bodies, statics)[1])

    def limit(self, motions: list[Motion], drifts: list[Motion] | None = None) -> list[Motion]:
        """Motions after the limits and motors of hinges; the first pass needs the drifts."""
        if self._limits is None or self.twists is None:
            return motions
        motions, self.twists, work = limits_motors.limit(
            self._limits, self._factored.anchors, motions, drifts, self._fixed, self._angles, self.twists, self._params
        )
        self.works.append(work)
        return motions

    def stay_warm(self, motions: list[Motion]) -> list[Motion]:
        """Motions after warm starting with which the anchors stay together."""
        return self.stay(motions) if self._in_contacts else motions

    def hold(self, sides: list[BodySide]) -> list[BodySide]:
        """Sides of the first pass, whose contacts see the joints at the start of the step."""
        if not self._in_contacts:
            return sides
        motions = _motions(sides)
        self._schur = self._factored.schur_complements(motions)
        return self._held(sides, self.stay(motions) if self._moved_again else motions)

    def move(self, displacements: list[Motion]) -> None:
        """Moves the joints to the end of the step, for the relaxing pass."""
        if self._system is not None:
            moved = table_of(displacements, [_scaled(motion, self._params.step) for motion in self._fixed])
            self._factored = rigid_joints.FactoredSystem(self._system, self._factored.anchors, moved)

    def hold_again(self, sides: list[BodySide]) -> list[BodySide]:
        """Sides of the relaxing pass."""
        return self._held(sides, self.stay(_motions(sides))) if self._in_contacts else sides

    def _held(self, sides: list[BodySide], motions: list[Motion]) -> list[BodySide]:
        """Sides of a pass with motions with which their anchors stay together.

        A contact would take a speed along a rod for an approach, and answer it with the little that the rod leaves of
        the inverse mass.
        """
        of = zip(sides, motions, self._schur, strict=True)
        return [hold(side._replace(motion=motion), schur) for side, motion, schur in of]

    def meet(self, sides: list[BodySide], free_drifts: list[Motion]) -> tuple[list[Motion], list[Motion]]:
        """Motions with which the anchors meet at the end of the step, and the drifts: those of the sides and these."""
        sides = [release(side) for side in sides]
        motions, drifts = _motions(sides), [side.drift for side in sides if side.drift is not None]
        if self._system is None:
            return motions, _sums(drifts, free_drifts)
        solved, drifts = self._factored.meet(
            motions, drifts, free_drifts, self._fixed, self._impulses, self._params.step
        )
        return self._solved(solved), drifts

    def stay(self, motions: list[Motion]) -> list[Motion]:
        """Motions with which the anchors stay together."""
        if self._system is None:
            return motions
        return self._solved(self._factored.hold(motions, self._fixed, self._impulses))

    def _solved(self, solved: rigid_joints.Solved) -> list[Motion]:
        self._impulses = solved.impulses
        self.works.append(solved.work)
        return solved.motions


def _sums(first: list[Motion], second: list[Motion]) -> list[Motion]:
    return [jax.tree.map(jnp.add, *of) for of in zip(first, second, strict=True)]


def _motions(sides: list[BodySide]) -> list[Motion]:
    return [side.motion for side in sides if side.motion is not None]


def _first_pass_side(
    side: BodySide, motion: Motion, drift: Motion, change: Motion, pull: Array | None, params: SolverParams
) -> BodySide:
    """The side after warm starting, which changed its motion by `change`, as the first pass needs it.

    `pull` is the acceleration of springs.
    """
    disc = isinstance(side.shape, Disc)
    return BodySide(
        motion=motion,
        pull=pull,
        drift=drift,
        resting=None if disc else change,
        push=speed_bound(change.velocity) if disc else None,
        pending=jax.tree.map(jnp.zeros_like, change),
        work=side.work,
        support=side.support,
        obstacles=no_obstacles(side.support) if params.extreme_mass_ratios and side.support is not None else None,
        first=side.first,
        clock=jnp.zeros_like(change.spin) if params.by_time else None,
    )


def _loaded_at_start(old: BodySide, new: BodySide, time: Array, params: SolverParams) -> Array | None:
    """Bodies [N, ...] on which impulses acted in one of the first steps; None if passes do not depend on the scene."""
    if params.relax_iterations is not None:
        return None
    assert old.motion is not None, "only moving bodies change"
    assert new.motion is not None, "only moving bodies change"
    moved = jnp.any(new.motion.velocity != old.motion.velocity, axis=0)
    return moved & (time < (FIRST_STEPS - 0.5) * params.step)


def _clamp_late(
    sides: list[BodySide],
    scenes: Array | None = None,
    *,
    displacements: list[Motion],
    solid: list[Shape | None],
    model: Model,
) -> list[BodySide]:
    """Sides that late impacts have displaced, in all scenes or in some: nothing passes through a barrier, and a body on
    a joint keeps the displacement that its joint has given it."""
    barriers = model.barriers
    if scenes is not None:
        displacements, solid = take_scenes((displacements, solid), scenes)
        barriers = [barrier._replace(line=take_scenes(barrier.line, scenes)) for barrier in barriers]
    news = [side.displacement for side in sides if side.displacement is not None]
    for number, group in enumerate(model.groups):
        if group.jointed is not None:
            of = displacements[number], news[number]
            news[number] = jax.tree.map(lambda x, new, fixed=group.jointed: jnp.where(fixed, x, new), *of)
    news = clamp_displacement(news, solid, barriers)
    return [side._replace(displacement=new) for side, new in zip(sides, news, strict=True)]


def step(world: WorldState, model: Model, params: SolverParams) -> WorldState:
    """World one step later."""
    h, groups, solver, carry, ledger = params.step, model.groups, model.solver, world.contacts, world.ledger
    accelerations, angular = _accelerations(world, model)
    spin_ups = angular or [0.0] * len(groups)
    flights = [_free_motion(*of, params) for of in zip(world.bodies, accelerations, spin_ups, strict=True)]
    free, free_drifts = materialize([motion for motion, _ in flights]), [drift for _, drift in flights]
    fixed = [body.at(world.time) for body in model.statics]

    rigid = _RigidJoints(model, world, fixed, params)
    before = rigid.stay(free)
    shapes = [to_world(g.body_shape, b.position, b.angle) for g, b in zip(groups, world.bodies, strict=True)]
    statics = [BodySide(f.shape_at(b), f.motion) for f, b in zip(model.statics, fixed, strict=True)]
    pulling = _Springs(model, world, fixed, h)
    different = accelerations if angular else [None] * len(groups)
    works = [None] * len(groups) if ledger is None else ledger.groups
    of_groups = zip(shapes, before, different, works, strict=True)
    sides = [
        BodySide(
            shape,
            motion,
            acceleration,
            displacement=_scaled(motion, 0.5 * h),
            work=work,
            support=no_support(motion.velocity, isinstance(shape, Disc)),
        )
        for shape, motion, acceleration, work in of_groups
    ]
    if params.by_time:
        sides = not_hit(sides)
    sides, contacts = solver.warm_start(carry, sides, statics, pulling.speed_bounds(before))
    motions = rigid.stay_warm(_motions(sides))
    changes = [jax.tree.map(jnp.subtract, *of) for of in zip(motions, before, strict=True)]
    drifts = [_scaled(change, -0.5 * h) for change in changes]

    motions, forced_drifts = pulling.pull(motions, drifts, free_drifts, accelerations)
    motions = rigid.limit(motions, _sums(drifts, forced_drifts))
    of_groups = zip(sides, motions, drifts, jax.lax.stop_gradient(changes), pulling.accelerations, strict=True)
    held = rigid.hold([_first_pass_side(*of, params) for of in of_groups])
    statics = [BodySide(motion=side.motion) for side in statics]
    sides, solved = solver.solve(carry, contacts, held, statics)
    motions, drifts = rigid.meet(sides, forced_drifts)

    displacements = [jax.tree.map(lambda x, y: h * x + y, *of) for of in zip(motions, drifts, strict=True)]
    solid = [s if g.collides else None for s, g in zip(shapes, groups, strict=True)]
    displacements = clamp_displacement(displacements, solid, model.barriers)
    motions = pulling.conserve(displacements, motions)

    rigid.move(displacements)
    motions = rigid.limit(motions)
    of_groups = zip(held, sides, motions, displacements, strict=True)
    sides = [
        BodySide(
            motion=motion,
            displacement=moved,
            resting=side.resting,
            push=side.push,
            work=side.work,
            late=_loaded_at_start(old, side, world.time, params),
        )
        for old, side, motion, moved in of_groups
    ]
    clamp = functools.partial(_clamp_late, displacements=displacements, solid=solid, model=model)
    sides, carry = solver.relax(carry, solved, rigid.hold_again(sides), statics, world.time, clamp)
    displacements = [side.displacement for side in sides if side.displacement is not None]
    motions = rigid.stay(_motions([release(side) for side in sides]))
    bodies = [_displace(*of) for of in zip(world.bodies, displacements, motions, strict=True)]
    if ledger is not None:
        olds, works = [body.motion for body in world.bodies], [side.work for side in sides]
        flown = _sums([_scaled(motion, h) for motion in free], free_drifts)
        done = zip(works, groups, olds, free, flown, displacements, accelerations, spin_ups, strict=True)
        by_joints = accumulate(ledger.joints, [*pulling.works(flown, displacements, changes), *rigid.works])
        ledger = Ledger([record_energy(*of, gravity=model.gravity, h=h) for of in done], by_joints)
    return WorldState(
        bodies=bodies,
        time=world.time + h,
        contacts=carry,
        twists=rigid.twists,
        ledger=ledger,
    )
