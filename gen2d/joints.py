"""Joints: rigid rods, springs, hinges with limits and motors, solved one after the other before the contacts.

A rod keeps the distance of two anchors, a hinge ('revolute') keeps them in one place; both are soft constraints at
60 Hz (E. Catto, 'Solver2D', 2024), warm-started and relaxed like contacts. A spring is not a constraint but a force:
the mean of what it is at both ends of the step, found implicitly and acting at half of the step, which keeps the energy
of a linear spring exactly and is stable at any stiffness (the implicit midpoint rule).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.contacts import dot, turned
from gen2d.ledger import Work
from gen2d.rows import Inertia, Motion, Rules, reciprocal
from gen2d.tournament import settled
from gen2d.types import Array

HERTZ, DAMPING_RATIO = 60.0, 5.0  # of rigid joints; at 120 Hz a light chain with a heavy end explodes
SHORTEST = 1e-6  # m: a shorter rod has no direction


class End(NamedTuple):
    """One of a joint's bodies: which one of a group of moving bodies, or of the fixed ones."""

    group: int | None  # None: fixed
    place: int  # in it
    inertia: Inertia | None  # [1, ...]; None: fixed
    anchor: Array  # [2, 1, ...] m, in the body's frame


class Tied(NamedTuple):
    """What stays the same of a joint, each [1, ...]. A distance joint is a spring where its stiffness is finite."""

    kind: str
    a: End
    b: End
    there: Array
    rest: Array
    stiffness: Array
    damping: Array
    lower: Array
    upper: Array
    motor_speed: Array
    motor_torque: Array


class Held(NamedTuple):
    """A joint in this step."""

    tied: Tied
    arm_a: Array  # [2, 1, ...] m
    arm_b: Array
    apart: Array  # [2, 1, ...] m: from a's anchor to b's
    angle: Array  # [1, ...] rad: b's over a's, beyond that at rest
    impulses: tuple[Array, ...]


Bodies = dict[tuple[int | None, int], Any]  # one body's values, by group and place


def nothing(tied: Tied) -> tuple[Array, ...]:
    """The impulses of a joint that has done nothing.

    A rod has one, along it; a hinge has five: along x and y, at both limits, and by the motor.
    """
    return (jnp.zeros_like(tied.rest),) * (1 if tied.kind == "distance" else 5)


def _key(end: End) -> tuple[int | None, int]:
    return end.group, end.place


def _taken(groups: list[Any], ties: list[Tied]) -> Bodies:
    return {
        _key(end): jax.tree.map(lambda x, i=end.place: x[..., i : i + 1, :], groups[end.group])
        for tie in ties
        for end in (tie.a, tie.b)
        if end.group is not None
    }


def _put(groups: list[Any], bodies: Bodies) -> list[Any]:
    """The groups with the bodies back in them."""

    def whole(g: int, group: Any) -> Any:
        mine = {i: body for (h, i), body in bodies.items() if h == g}
        if not mine:
            return group
        count = jax.tree.leaves(group)[0].shape[-2]
        rows = [mine.get(i, jax.tree.map(lambda x, i=i: x[..., i : i + 1, :], group)) for i in range(count)]
        return jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), *rows)

    return [whole(g, group) for g, group in enumerate(groups)]


def _turned(vector: Array, angle: Array) -> Array:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])


def _apply(held: Held, bodies: Bodies, push: Array | None, twist: Array | None) -> Bodies:
    """The bodies' motions after an impulse on b at its anchor, an angular one beside it, and their reactions on a."""
    bodies = dict(bodies)
    for end, arm, sign in ((held.tied.a, held.arm_a, -1), (held.tied.b, held.arm_b, 1)):
        if end.inertia is None:
            continue
        motion, turn = bodies[_key(end)], _twist(arm, push, twist)
        velocity = motion.velocity if push is None else motion.velocity + sign * end.inertia.mass * push
        bodies[_key(end)] = Motion(velocity, motion.spin + sign * end.inertia.moment * turn)
    return bodies


def _twist(arm: Array, push: Array | None, twist: Array | None) -> Array:
    """The angular impulse of an impulse at an arm and an angular one; not both are None."""
    if push is None:
        assert twist is not None
        return twist
    return dot(turned(arm), push) if twist is None else dot(turned(arm), push) + twist


def _speed(held: Held, bodies: Bodies, still: dict[int, Motion]) -> tuple[Array, Array]:
    """Velocity of b's anchor over a's, and spin of b over a."""
    of = []
    for end, arm in ((held.tied.a, held.arm_a), (held.tied.b, held.arm_b)):
        motion = still[end.place] if end.group is None else bodies[_key(end)]
        of.append((motion.velocity + motion.spin * turned(arm), motion.spin))
    return of[1][0] - of[0][0], of[1][1] - of[0][1]


def _k(held: Held, direction: Array) -> Array:
    """Speed along a direction that a unit impulse along it gives, 1/kg."""
    k = jnp.zeros_like(held.tied.rest)
    for end, arm in ((held.tied.a, held.arm_a), (held.tied.b, held.arm_b)):
        if end.inertia is not None:
            k = k + end.inertia.mass + end.inertia.moment * dot(turned(arm), direction) ** 2
    return k


def _k_turn(held: Held) -> Array:
    return sum(
        (e.inertia.moment for e in (held.tied.a, held.tied.b) if e.inertia is not None), jnp.zeros_like(held.angle)
    )


def _over(x: Array, usable: Array) -> Array:
    return reciprocal(x, usable & (x > 0))


def _along(apart: Array) -> tuple[Array, Array]:
    """Unit direction and length, finite at zero."""
    squared = dot(apart, apart)
    length = jnp.sqrt(jnp.where(squared > SHORTEST**2, squared, 1.0))
    return jnp.where(squared > SHORTEST**2, apart / length, 0.0), jnp.where(squared > SHORTEST**2, length, 0.0)


class _Book:
    """The work that a joint's impulses do, as they are applied. `one` is 1.0 in a way that the compiler cannot know:
    else a CPU computes each impulse again for all that come after it, and takes minutes to compile two hinges."""

    def __init__(self, held: Held, still: dict[int, Motion], bodies: Bodies, one: Array) -> None:
        self.held, self.still, self.bodies, self.one = held, still, bodies, one
        self.lost, self.driven = jnp.zeros_like(held.angle), jnp.zeros_like(held.angle)

    def apply(self, push: Array | None, twist: Array | None, motor: bool = False) -> None:
        """Applies an impulse, and books what it does."""
        push, twist = settled((push, twist), self.one)
        before = settled(_speed(self.held, self.bodies, self.still), self.one)
        self.bodies = _apply(self.held, self.bodies, push, twist)
        moved = {_key(end) for end in (self.held.tied.a, self.held.tied.b) if end.inertia is not None}
        self.bodies |= settled({key: self.bodies[key] for key in sorted(moved)}, self.one)
        sums = [x + y for x, y in zip(before, _speed(self.held, self.bodies, self.still), strict=True)]
        parts = [dot(push, sums[0])] if push is not None else []
        parts += [twist * sums[1]] if twist is not None else []
        gained = 0.5 * sum(parts[1:], parts[0])
        if motor:
            self.driven = self.driven + gained
        else:
            self.lost = self.lost - gained
        for end, sign in ((self.held.tied.a, -1), (self.held.tied.b, 1)):
            if end.group is None:  # what moves as it likes does work where it is held
                motion, arm = self.still[end.place], self.held.arm_a if sign < 0 else self.held.arm_b
                work = motion.spin * _twist(arm, push, twist)
                work = work if push is None else work + dot(motion.velocity, push)
                self.driven = self.driven - sign * work


def warm(
    ties: list[Tied], bodies: list[Any], fixed: dict[int, Any], motions: list[Motion], memory: list[tuple], one: Array
) -> tuple:
    """Every joint as it stands, the motions with its last impulses, and the work done."""
    if not ties:
        return [], motions, []
    places, now, still = _taken(bodies, ties), _taken(motions, ties), {i: b.motion for i, b in fixed.items()}
    held, works = [], []
    for tied, impulses in zip(ties, memory, strict=True):
        a, b = (fixed[e.place] if e.group is None else places[_key(e)] for e in (tied.a, tied.b))
        arm_a, arm_b = settled((_turned(tied.a.anchor, a.angle), _turned(tied.b.anchor, b.angle)), one)
        apart = b.position + arm_b - a.position - arm_a
        joint = Held(tied, arm_a, arm_b, apart, b.angle - a.angle - tied.rest, impulses)
        book = _Book(joint, still, now, one)
        if tied.kind == "distance":
            book.apply(impulses[0] * _along(apart)[0], None)
        else:
            book.apply(jnp.stack(impulses[:2]), impulses[2] - impulses[3])
            book.apply(None, impulses[4], motor=True)
        now = book.bodies
        held.append(joint)
        works.append(Work(book.lost, book.driven, None))
    return held, _put(motions, now), works


def solve(
    held: list[Held],
    motions: list[Motion],
    ways: list[Motion],
    falls: list[Array],
    fixed: dict[int, Any],
    rules: Rules,
    one: Array,
    biased: bool,
) -> tuple:
    """Every joint after a pass, motions and ways (what a body goes beyond its velocity), and the work done."""
    if not held:
        return [], motions, ways, []
    ties, still = [h.tied for h in held], {i: b.motion for i, b in fixed.items()}
    now, way, fall = _taken(motions, ties), _taken(ways, ties), _taken(falls, ties)
    done, works = [], []
    for joint in held:
        joint = joint if biased else _moved(joint, way, still, rules.step, one)
        book = _Book(joint, still, now, one)
        if joint.tied.kind == "distance":
            impulses, spring = _rod(joint, book, rules, biased), None
            if biased:
                way, spring = _spring(joint, book, way, fall, rules.step)
            works.append(Work(book.lost, book.driven, spring))
        else:
            impulses = _hinge(joint, book, rules, biased)
            works.append(Work(book.lost, book.driven, None))
        done.append(joint._replace(impulses=impulses))
        now = book.bodies
    return done, _put(motions, now), _put(ways, way), works


def _moved(joint: Held, way: Bodies, still: dict[int, Motion], h: float, one: Array) -> Held:
    """The joint as it stands after the bodies have gone their ways."""
    arms, apart = [], joint.apart
    for end, arm, sign in ((joint.tied.a, joint.arm_a, -1), (joint.tied.b, joint.arm_b, 1)):
        gone = way[_key(end)] if end.group is not None else jax.tree.map(lambda x: h * x, still[end.place])
        arms.append(settled(_turned(arm, gone.spin), one))
        apart = apart + sign * (gone.velocity + arms[-1] - arm)
    return joint._replace(arm_a=arms[0], arm_b=arms[1], apart=apart)


def _curve(joint: Held, book: _Book, h: float) -> Array:
    """How much faster the anchors part over a step than at its start, m/s, as their arms turn meanwhile.

    A pass that knows of it, and a second pass at the new arms, are RATTLE (H. C. Andersen, 1983): a pendulum keeps its
    energy, while the straight line at the start leaves the circle and loses (h spin)^2 of it in every step.
    """
    aside = jnp.zeros_like(joint.apart)
    for end, arm, sign in ((joint.tied.a, joint.arm_a, -1), (joint.tied.b, joint.arm_b, 1)):
        turn = h * (book.still[end.place].spin if end.group is None else book.bodies[_key(end)].spin)
        beyond = (jnp.sin(turn) - turn) * turned(arm) - 2 * jnp.sin(turn / 2) ** 2 * arm
        aside = aside + sign / h * beyond
    return aside


def _rod(joint: Held, book: _Book, rules: Rules, biased: bool) -> tuple[Array, ...]:
    tied, (old,) = joint.tied, joint.impulses
    rate, mass_scale, impulse_scale = rules.softness(HERTZ, DAMPING_RATIO) if biased else (0.0, 1.0, 0.0)
    axis, length = _along(joint.apart)
    velocity = _speed(joint, book.bodies, book.still)[0]
    speed = dot(axis, velocity)
    if biased:
        mean = velocity + _curve(joint, book, rules.step)
        way = rules.step * mean
        speed = dot(2 * joint.apart + way, mean) / jnp.maximum(_along(joint.apart + way)[1] + length, SHORTEST)
    mass = _over(_k(joint, axis), tied.there & ~jnp.isfinite(tied.stiffness))
    new = old - mass_scale * mass * (speed + rate * (length - tied.rest)) - impulse_scale * old
    new = jnp.where(mass > 0, new, 0.0)
    book.apply((new - old) * axis, None)
    return (new,)


def _spring(joint: Held, book: _Book, way: Bodies, fall: Bodies, h: float) -> tuple[Bodies, Array]:
    """The ways with an impulse at half of the step, and the work that it took from the motion.

    What the spring holds of that is taken off when the books are closed.
    """
    tied = joint.tied
    soft = tied.there & jnp.isfinite(tied.stiffness)
    k, c = (jnp.where(soft, x, 0.0) for x in (tied.stiffness, tied.damping))
    axis, length = _along(joint.apart)
    speed, inverse = dot(axis, _speed(joint, book.bodies, book.still)[0]), _k(joint, axis)
    stretch = length - tied.rest + 0.5 * h * speed
    push = -h * (k * stretch + c * speed) / (1 + inverse * h * (0.25 * h * k + 0.5 * c)) * axis
    lost = book.lost
    book.apply(push, None)
    ends = [(end, sign) for end, sign in ((tied.a, -1), (tied.b, 1)) if end.inertia is not None]
    aside = sum((0.5 * h * sign * dot(fall[_key(end)], push) for end, sign in ends), jnp.zeros_like(push[0]))
    spent = book.lost - lost + aside
    book.lost = lost - aside  # what it changes in the fall is its own, not the contacts'
    return _apply(joint, way, -0.5 * h * push, None), spent


def springs_energy(ties: list[Tied], bodies: list[Any], fixed: dict[int, Any]) -> Array | float:
    """What all springs hold now, J [...]: k x^2 / 2 each."""
    places, energy = _taken(bodies, ties), 0.0
    for tied in (t for t in ties if t.kind == "distance"):
        a, b = (fixed[e.place] if e.group is None else places[_key(e)] for e in (tied.a, tied.b))
        length = _along(b.position + _turned(tied.b.anchor, b.angle) - a.position - _turned(tied.a.anchor, a.angle))[1]
        soft = tied.there & jnp.isfinite(tied.stiffness)
        energy = energy + (0.5 * jnp.where(soft, tied.stiffness, 0.0) * (length - tied.rest) ** 2)[0]
    return energy


def _hinge(joint: Held, book: _Book, rules: Rules, biased: bool) -> tuple[Array, ...]:
    tied, (x, y, low, high, motor) = joint.tied, joint.impulses
    rate, mass_scale, impulse_scale = rules.softness(HERTZ, DAMPING_RATIO) if biased else (0.0, 1.0, 0.0)
    turn_mass = _over(_k_turn(joint), tied.there)
    spin = _speed(joint, book.bodies, book.still)[1]
    bound = rules.step * tied.motor_torque
    new_motor = jnp.clip(motor - turn_mass * (spin - tied.motor_speed), -bound, bound)
    book.apply(None, new_motor - motor, motor=True)
    news = []
    for old, sign, room in ((low, 1, joint.angle - tied.lower), (high, -1, tied.upper - joint.angle)):
        limited = jnp.isfinite(room)
        room = jnp.where(limited, room, 1.0)
        speed = sign * _speed(joint, book.bodies, book.still)[1]
        bias = jnp.where(room > 0, room / rules.step, rate * room)
        scale, keep = jnp.where(room > 0, 1.0, mass_scale), jnp.where(room > 0, 0.0, impulse_scale)
        new = jnp.maximum(old - scale * turn_mass * (speed + bias) - keep * old, 0.0)
        news.append(jnp.where(limited, new, 0.0))
        book.apply(None, sign * (news[-1] - old))
    velocity = _speed(joint, book.bodies, book.still)[0]
    if biased:
        velocity = velocity + rate * joint.apart + _curve(joint, book, rules.step)
    push = _point_push(joint, velocity)
    old = jnp.stack([x, y])
    added = jnp.where(tied.there, mass_scale * push - impulse_scale * old, 0.0)
    book.apply(added, None)
    return *(old + added), *news, new_motor


def _point_push(joint: Held, velocity: Array) -> Array:
    """The impulse that takes away the anchors' relative velocity: the inverse of a symmetric matrix."""
    kxx = kxy = kyy = jnp.zeros_like(joint.angle)
    for end, (rx, ry) in ((joint.tied.a, joint.arm_a), (joint.tied.b, joint.arm_b)):
        if end.inertia is not None:
            m, i = end.inertia
            kxx, kxy, kyy = kxx + m + i * ry * ry, kxy - i * rx * ry, kyy + m + i * rx * rx
    one_over = _over(kxx * kyy - kxy * kxy, joint.tied.there)
    x, y = velocity
    return -one_over * jnp.stack([kyy * x - kxy * y, kxx * y - kxy * x])
