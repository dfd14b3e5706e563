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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d import joints, linkage
from gen2d.contacts import Shape, Stadium
from gen2d.forms import Form, placed
from gen2d.ledger import Ledger, booked, tallied
from gen2d.rows import Inertia, Motion, Rules
from gen2d.sweeps import Drift, kept_in
from gen2d.tournament import settled
from gen2d.types import Array


class Body(NamedTuple):
    """Some moving bodies as they are now."""

    position: Array  # [2, N, ...] m
    angle: Array  # [N, ...] rad
    motion: Motion
    rest: Motion | None = None  # m, rad: what rounding has kept back of the ways so far


class Group(NamedTuple):
    """What stays the same of the moving bodies of one run; an empty slot has no mass, and no inverse of it."""

    form: Form
    inverse: Inertia
    mass: Array  # [N, ...] kg
    moment: Array  # [N, ...] kg m^2
    collides: bool = True  # whether they meet anything


class Fixed(NamedTuple):
    """A body that nothing can push, at the start. `motion` is None where it stands still."""

    form: Form
    position: Array  # [2, 1, ...] m
    angle: Array  # [1, ...] rad
    motion: Motion | None
    shape: Shape  # as it lies at the start

    @property
    def still(self) -> Motion:
        """Its motion, zero where it stands still."""
        return self.motion or Motion(jnp.zeros_like(self.position), jnp.zeros_like(self.angle))

    def at(self, time: Array) -> tuple[Array, Array]:
        """Where it is by then."""
        if self.motion is None:
            return self.position, self.angle
        return self.position + time * self.motion.velocity, self.angle + time * self.motion.spin

    def shape_at(self, now: Body) -> Shape:
        """Its shape where it is now."""
        return self.shape if self.motion is None else placed(self.form, now.position, now.angle)


class Scenery(NamedTuple):
    """What stays the same for a whole video."""

    groups: list[Group]
    fixed: list[Fixed]
    rails: list[Stadium]  # fixed segments that stand still; where there is none, of negative length
    gravity: Array  # [2, ...] m/s^2
    contacts: Any  # how pairs are solved: Dense or Sparse
    ties: list[joints.Tied]
    linkage: linkage.Linkage | None
    forces: Callable | None  # (bodies, time) -> for each group force [2, N, ...] N and torque [N, ...] N m


class World(NamedTuple):
    """All that changes from one step to the next."""

    bodies: list[Body]
    time: Array  # s
    contacts: Any  # what the contacts hand on from step to step
    ties: list[Any]  # of each round of joints: its impulses
    pushes: Array | None  # of the linkage's rows
    ledger: Ledger | None


def _accelerations(world: World, scenery: Scenery) -> tuple[list[Array], list[Array] | None]:
    """Of each group: that of its centres [2, N, ...], and that of its angles [N, ...]; None where there is none."""
    groups, gravity = scenery.groups, scenery.gravity
    falls = [gravity[:, None] * (g.inverse.mass > 0) for g in groups]
    if scenery.forces is None:
        return falls, None
    forces = scenery.forces(world.bodies, world.time)
    falls = [fall + g.inverse.mass * force for fall, g, (force, _) in zip(falls, groups, forces, strict=True)]
    return falls, [g.inverse.moment * torque for g, (_, torque) in zip(groups, forces, strict=True)]


def _free(body: Body, fall: Array, spin_up: Array | float, rules: Rules) -> tuple[Motion, Motion]:
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


def _beyond(drift: Drift, more: Motion) -> Motion:
    """By how much more than h times its motion a body goes; free flight is exact for what no contact but an impact
    held."""
    free = jnp.where(drift.push > 0, 0.0, 1.0)
    return jax.tree.map(lambda x, y: x + free * y, drift.way, more)


def _warmth(warmed: Motion, before: Motion) -> Array:
    """What the contacts' last impulses may have added to a speed, m/s."""
    x, y = jnp.abs(warmed.velocity - before.velocity)
    return x + y


def _arrived(body: Body, way: Motion, one: Array) -> tuple[tuple[Array, Array], Motion]:
    """Position and angle after a way, and what rounding keeps back of it for the next one (W. Kahan, 1965)."""
    assert body.rest is not None
    old, add = Motion(body.position, body.angle), jax.tree.map(jnp.add, way, body.rest)
    new = settled(jax.tree.map(jnp.add, old, add), one)
    gone = jax.tree.map(lambda n, o, d: jax.lax.stop_gradient(d - (n - o)), new, old, add)
    return (new.velocity, new.spin), gone


class _Rigid:
    """The linkage in a step: its impulses so far and their work; nothing where there is none."""

    def __init__(self, linked: linkage.Linkage | None, world: World, fixed: list[Body], h: float, one: Array) -> None:
        self._of, self._world, self._fixed, self._h, self._one = linked, world, fixed, h, one
        self.pushes, self.works = world.pushes, []

    def warm(self, motions: list[Motion]) -> list[Motion]:
        """The motions with the last step's impulses."""
        if self._of is None or self.pushes is None:
            return motions
        bodies = self._world.bodies
        self._stance, motions, work = linkage.warm(self._of, bodies, self._fixed, motions, self.pushes, self._one)
        self.works.append(work)
        return motions

    def solve(self, motions: list[Motion], beyond: list[Motion]) -> list[Motion]:
        """The motions with which the joints hold at the end of the step."""
        return self._after(linkage.solve, motions, beyond)

    def relax(self, motions: list[Motion], ways: list[Motion]) -> list[Motion]:
        """The motions with which they go on to hold from there."""
        return self._after(linkage.relax, motions, ways)

    def _after(self, play: Callable, motions: list[Motion], ways: list[Motion]) -> list[Motion]:
        if self._of is None:
            return motions
        of = self._of, self._stance, motions, ways, self._fixed, self.pushes, self._h, self._one
        motions, self.pushes, work = play(*of)
        self.works.append(work)
        return motions


def step(world: World, scenery: Scenery, rules: Rules) -> World:
    """The world one step later."""
    h, groups, contacts, past = rules.step, scenery.groups, scenery.contacts, world.contacts
    one = contacts.setup.one
    falls, spin_ups = _accelerations(world, scenery)
    turns = spin_ups or [0.0] * len(groups)
    free = [_free(*of, rules) for of in zip(world.bodies, falls, turns, strict=True)]
    flying, more = settled([motion for motion, _ in free], one), [way for _, way in free]
    fixed = [Body(*body.at(world.time), body.still) for body in scenery.fixed]

    held, motions, tied = joints.warm(scenery.ties, world.bodies, fixed, flying, world.ties, one)
    rigid = _Rigid(scenery.linkage, world, fixed, h, one)
    joined = rigid.warm(motions)
    shapes = [placed(g.form, b.position, b.angle) for g, b in zip(groups, world.bodies, strict=True)]
    walls = [(f.shape_at(b), f.motion) for f, b in zip(scenery.fixed, fixed, strict=True)]
    unlike = falls if spin_ups else [None] * len(groups)
    book = world.ledger
    works = [None] * len(groups) if book is None else book.groups
    bodies = list(zip(shapes, unlike, strict=True))
    motions, works, found = contacts.warm(past, bodies, walls, joined, works)
    pushes = [_warmth(*of) for of in zip(motions, joined, strict=True)]

    ways = [Motion(*(jnp.zeros_like(x) for x in m)) for m in motions]
    held, motions, ways, tied_more = joints.solve(held, motions, ways, falls, fixed, rules, one, biased=True)
    drifts = [Drift(way, push) for way, push in zip(ways, pushes, strict=True)]
    motions, drifts, works, rows = contacts.solve(past, found, walls, motions, drifts, works)
    beyond = [_beyond(*of) for of in zip(drifts, more, strict=True)]
    motions = rigid.solve(motions, beyond)

    ways = [jax.tree.map(lambda x, y: h * x + y, *of) for of in zip(motions, beyond, strict=True)]
    ways = kept_in(ways, [s if g.collides else None for s, g in zip(shapes, groups, strict=True)], scenery.rails)
    places = [_arrived(b, way, one) for b, way in zip(world.bodies, ways, strict=True)]

    held, motions, _, tied_last = joints.solve(held, motions, ways, falls, fixed, rules, one, biased=False)
    motions, works, past = contacts.relax(past, rows, walls, motions, drifts, works, world.time)
    motions = rigid.relax(motions, ways)
    if book is not None:
        olds = [body.motion for body in world.bodies]
        done = zip(works, groups, olds, flying, more, ways, falls, turns, strict=True)
        tally = tallied(book.joints, [*tied, *tied_more, *tied_last, *rigid.works])
        book = Ledger([booked(*of, gravity=scenery.gravity, h=h) for of in done], tally)
    return World(
        bodies=[Body(*place, motion, rest) for (place, rest), motion in zip(places, motions, strict=True)],
        time=world.time + h,
        contacts=past,
        ties=[joint.impulses for joint in held],
        pushes=rigid.pushes,
        ledger=book,
    )
