"""One step of sequential impulses: coloured Gauss-Seidel over every pair that can touch, scenes last.

A step of h seconds reads as the sentences of `step`:

1. gravity, forces and damping change the velocities;
2. the impulses of the last step are applied again (warm starting, as all of a stack's weight is known by then);
3. every pair is solved once with its soft bias, bounces included, at the exact time of impact, then all joints at once;
4. the bodies move;
5. every pair and all joints are solved once more without the bias, so that pushing apart leaves no speed behind.

Pairs are solved in rounds of disjoint pairs (tournament.py), all of them (dense.py) or those that are near (sparse.py),
and each round sees the last one's result: Gauss-Seidel, which is what 'sequential' means. Springs, limits and motors
(joints.py) come first, fixed bodies last of all pairs, and what is rigid (linkage.py) has the last word.

Restitution. A row that closes within the step bounces: Newton's law is applied to the velocities that the row finds, so
impacts happen one after the other and never add energy. The impulse P acts at the time of impact tau, not at the
start, so it moves its body by (h - tau) P / m: the drift takes -tau P / m off what the new velocity would give. The
path is exact, and so is its derivative, which a step without tau gets wrong (even its sign).

Sources: E. Catto, 'Iterative dynamics with temporal coherence' (GDC 2005) for accumulated impulses and warm starting;
'Solver2D' (2024) for small steps with soft contacts and a relaxing pass; Y. Hu et al., DiffTaichi (arXiv 1910.00935)
for the time of impact in gradients.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from gen2d.physics import joint_forces, rigid_joints
from gen2d.physics.constraint import Motion
from gen2d.physics.contact_state import Displacement
from gen2d.physics.energy import Ledger, accumulate, record_energy
from gen2d.physics.params import SolverParams
from gen2d.physics.shapes import to_world
from gen2d.physics.state import BodyState, Model, WorldState
from gen2d.physics.tunnelling import clamp_displacement
from gen2d.records.axes import Array
from gen2d.xla import materialize


def _accelerations(world: WorldState, scenery: Model) -> tuple[list[Array], list[Array] | None]:
    """Of each group: that of its centres [2, N, ...], and that of its angles [N, ...]; None where there is none."""
    groups, gravity = scenery.groups, scenery.gravity
    falls = [gravity[:, None] * (g.inverse.mass > 0) for g in groups]
    if scenery.forces is None:
        return falls, None
    forces = scenery.forces(world.bodies, world.time)
    falls = [fall + g.inverse.mass * force for fall, g, (force, _) in zip(falls, groups, forces, strict=True)]
    return falls, [g.inverse.moment * torque for g, (_, torque) in zip(groups, forces, strict=True)]


def _free(body: BodyState, fall: Array, spin_up: Array | float, rules: SolverParams) -> tuple[Motion, Motion]:
    """How a body moves after a step in which nothing touches it, and by how much more than h times that it goes.

    Both are exact for a constant acceleration a and a damping rate c: with s = exp(-c h), p = (1 - s) / c and
    q = (h - p) / c, v becomes s v + p a and the way is p v + q a.
    """
    h, c = rules.step, rules.damping
    s = math.exp(-c * h)
    p = -math.expm1(-c * h) / c if c else h
    q = (h - p) / c if c * h > 1e-4 else 0.5 * h**2 * (1 - c * h / 3)
    old = body.motion
    motion = Motion(s * old.velocity + p * fall, s * old.spin + p * spin_up)
    velocity, spin = (q - h * p) * fall, (q - h * p) * spin_up + jnp.zeros_like(old.spin)
    if c:
        velocity, spin = velocity + (p - h * s) * old.velocity, spin + (p - h * s) * old.spin
    return motion, Motion(velocity, spin)


def _beyond(drift: Displacement, more: Motion) -> Motion:
    """By how much more than h times its motion a body goes; free flight is exact for what no contact but an impact
    held."""
    free = jnp.where(drift.push > 0, 0.0, 1.0)
    return jax.tree.map(lambda x, y: x + free * y, drift.way, more)


def _warmth(warmed: Motion, before: Motion) -> Array:
    """What the contacts' last impulses may have added to a speed, m/s."""
    x, y = jnp.abs(warmed.velocity - before.velocity)
    return x + y


def _arrived(body: BodyState, way: Motion) -> tuple[tuple[Array, Array], Motion]:
    """Position and angle after a way, and what rounding keeps back of it for the next one (W. Kahan, 1965)."""
    assert body.rest is not None
    old, add = Motion(body.position, body.angle), jax.tree.map(jnp.add, way, body.rest)
    new = materialize(jax.tree.map(jnp.add, old, add))
    gone = jax.tree.map(lambda n, o, d: jax.lax.stop_gradient(d - (n - o)), new, old, add)
    return (new.velocity, new.spin), gone


class _Rigid:
    """The linkage in a step: its impulses so far and their work; nothing where there is none."""

    def __init__(
        self, linked: rigid_joints.JointSystem | None, world: WorldState, fixed: list[BodyState], h: float
    ) -> None:
        self._of, self._world, self._fixed, self._h = linked, world, fixed, h
        self.pushes, self.works = world.pushes, []

    def warm(self, motions: list[Motion]) -> list[Motion]:
        """The motions with the last step's impulses."""
        if self._of is None or self.pushes is None:
            return motions
        bodies = self._world.bodies
        self._stance, motions, work = rigid_joints.warm_start(self._of, bodies, self._fixed, motions, self.pushes)
        self.works.append(work)
        return motions

    def solve(self, motions: list[Motion], beyond: list[Motion]) -> list[Motion]:
        """The motions with which the joints hold at the end of the step."""
        return self._after(rigid_joints.solve, motions, beyond)

    def relax(self, motions: list[Motion], ways: list[Motion]) -> list[Motion]:
        """The motions with which they go on to hold from there."""
        return self._after(rigid_joints.relax, motions, ways)

    def _after(self, play: Callable, motions: list[Motion], ways: list[Motion]) -> list[Motion]:
        if self._of is None:
            return motions
        of = self._of, self._stance, motions, ways, self._fixed, self.pushes, self._h
        motions, self.pushes, work = play(*of)
        self.works.append(work)
        return motions


def step(world: WorldState, scenery: Model, rules: SolverParams) -> WorldState:
    """The world one step later."""
    h, groups, contacts, past = rules.step, scenery.groups, scenery.contacts, world.contacts
    falls, spin_ups = _accelerations(world, scenery)
    turns = spin_ups or [0.0] * len(groups)
    free = [_free(*of, rules) for of in zip(world.bodies, falls, turns, strict=True)]
    flying, more = materialize([motion for motion, _ in free]), [way for _, way in free]
    fixed = [BodyState(*body.at(world.time), body.still) for body in scenery.fixed]

    held, motions, tied = joint_forces.warm_start(scenery.ties, world.bodies, fixed, flying, world.ties)
    rigid = _Rigid(scenery.linkage, world, fixed, h)
    joined = rigid.warm(motions)
    shapes = [to_world(g.form, b.position, b.angle) for g, b in zip(groups, world.bodies, strict=True)]
    walls = [(f.shape_at(b), f.motion) for f, b in zip(scenery.fixed, fixed, strict=True)]
    unlike = falls if spin_ups else [None] * len(groups)
    book = world.ledger
    works = [None] * len(groups) if book is None else book.groups
    bodies = list(zip(shapes, unlike, strict=True))
    motions, works, found = contacts.warm(past, bodies, walls, joined, works)
    pushes = [_warmth(*of) for of in zip(motions, joined, strict=True)]

    ways = [Motion(*(jnp.zeros_like(x) for x in m)) for m in motions]
    held, motions, ways, tied_more = joint_forces.solve(held, motions, ways, falls, fixed, rules, biased=True)
    drifts = [Displacement(way, push) for way, push in zip(ways, pushes, strict=True)]
    motions, drifts, works, rows = contacts.solve(past, found, walls, motions, drifts, works)
    beyond = [_beyond(*of) for of in zip(drifts, more, strict=True)]
    motions = rigid.solve(motions, beyond)

    ways = [jax.tree.map(lambda x, y: h * x + y, *of) for of in zip(motions, beyond, strict=True)]
    ways = clamp_displacement(
        ways, [s if g.collides else None for s, g in zip(shapes, groups, strict=True)], scenery.rails
    )
    places = [_arrived(b, way) for b, way in zip(world.bodies, ways, strict=True)]

    held, motions, _, tied_last = joint_forces.solve(held, motions, ways, falls, fixed, rules, biased=False)
    motions, works, past = contacts.relax(past, rows, walls, motions, drifts, works, world.time)
    motions = rigid.relax(motions, ways)
    if book is not None:
        olds = [body.motion for body in world.bodies]
        done = zip(works, groups, olds, flying, more, ways, falls, turns, strict=True)
        tally = accumulate(book.joints, [*tied, *tied_more, *tied_last, *rigid.works])
        book = Ledger([record_energy(*of, gravity=scenery.gravity, h=h) for of in done], tally)
    return WorldState(
        bodies=[BodyState(*place, motion, rest) for (place, rest), motion in zip(places, motions, strict=True)],
        time=world.time + h,
        contacts=past,
        ties=[joint.impulses for joint in held],
        pushes=rigid.pushes,
        ledger=book,
    )
