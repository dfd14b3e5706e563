"""One step of sequential impulses: coloured Gauss-Seidel over every pair that can touch, scenes last.

A step of h seconds reads as the sentences of `step`:

1. gravity and damping change the velocities;
2. the impulses of the last step are applied again (warm starting, as all of a stack's weight is known by then);
3. every pair is solved once with its soft bias (`biased`), bounces included, at the exact time of impact;
4. the bodies move;
5. every pair is solved once more without the bias (`relaxed`), so that pushing apart leaves no speed behind.

Pairs of discs are arranged as a round-robin tournament: in each of N - 1 rounds every disc meets one other, so a round
is one vector operation over N / 2 pairs without conflicts, and the next round sees its result: Gauss-Seidel, which is
what 'sequential' means. Between rounds the discs move one place on (two concatenations: no gather, no scatter).
Fixed segments come last, one round each, and so have the last word.

Restitution. A row that closes within the step bounces: Newton's law is applied to the velocities that the row finds, so
impacts happen one after the other and never add energy. The impulse P acts at the time of impact tau, not at the
start, so it moves its body by (h - tau) P / m: `shift` takes -tau P / m off what the new velocity would give. The
path is exact, and so is its derivative, which a step without tau gets wrong (even its sign).

Sources: E. Catto, 'Iterative dynamics with temporal coherence' (GDC 2005) for accumulated impulses and warm starting;
'Solver2D' (2024) for small steps with soft contacts and a relaxing pass; Y. Hu et al., DiffTaichi (arXiv 1910.00935)
for the time of impact in gradients.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.contacts import Segments, dot, inverse_length, segment_disc, turned
from gen2d.impacts import NONE, PASSES, disc_impact, wall_impact
from gen2d.tournament import settled, tournament
from gen2d.types import Array


@dataclasses.dataclass(frozen=True)
class Rules:
    """The numbers of a step; `simulate.rules` makes them from the config."""

    step: float  # s
    bounce_threshold: float  # m/s: slower impacts do not bounce, nor do those that gravity makes in two steps
    hertz: float  # stiffness of an overlapping contact; twice that against a fixed object
    damping_ratio: float
    push_speed: float  # m/s: an overlap is undone no faster
    damping: float  # 1/s, of velocity and spin
    mixing: str

    def softness(self, hertz: float) -> tuple[float, float, float]:
        """Of an implicit damped spring at this step: bias rate (1/s), mass scale and impulse scale."""
        omega = 2 * math.pi * hertz
        a1 = 2 * self.damping_ratio + self.step * omega
        a2 = self.step * omega * a1
        return omega / a1, a2 / (1 + a2), 1 / (1 + a2)


class Row(NamedTuple):
    """Pairs that are solved at once, each [pairs, ...]; the same for a whole video. A pair of which one is absent has
    no mass to push with. `turn` is the spin that a unit of tangential impulse gives: arm / moment."""

    arm_a: Array
    arm_b: Array
    inverse_mass_a: Array
    inverse_mass_b: Array
    turn_a: Array
    turn_b: Array
    normal_mass: Array
    tangent_mass: Array
    elasticity: Array
    friction: Array


class Motion(NamedTuple):
    """How the bodies move while they are solved."""

    velocity: Array  # [2, N, ...] m/s
    spin: Array  # [N, ...] rad/s


class Drift(NamedTuple):
    """What impacts change in where a body goes, beyond its new velocity."""

    shift: Array  # [2, N, ...] m: they act at their time, not at the start of the step
    turn: Array  # [N, ...] rad: likewise
    held: Array  # [N, ...] 1 where a contact other than an impact held the body


class Touch(NamedTuple):
    """A row as it stands in this step; tau < 0 where it does not bounce (impacts.py)."""

    normal: Array
    gap: Array
    tau: Array


class Impulse(NamedTuple):
    """Accumulated impulses of a row, N s; what is left of them at the end of a step warm-starts the next."""

    normal: Array
    tangent: Array


class Setup(NamedTuple):
    """What stays the same for a whole video."""

    gravity: Array  # [2, ...] m/s^2
    fall: Array  # [2, N, ...] m/s^2: gravity where there is a body, else 0
    threshold: Array  # [...] m/s: slower impacts do not bounce
    pairs: list[Row]
    walls: list[Row]
    segments: list[Segments]
    radius: Array  # [N, ...]
    one: Array  # see settled()


class Memory(NamedTuple):
    """What one step leaves to the next, and what it has seen."""

    pairs: list[Impulse]
    walls: list[Impulse]
    pair_depth: Array  # [N / 2, ...] m: deepest overlap so far
    pair_begins: Array  # [N / 2, ...] contacts that began so far
    wall_depth: Array  # [N, ...]
    wall_begins: Array  # [N, ...]


def _mixed(a: Array, b: Array, mixing: str) -> Array:
    return {"mean": (a + b) / 2, "product": a * b, "max": jnp.maximum(a, b), "geometric": jnp.sqrt(a * b)}[mixing]


class Discs(NamedTuple):
    """Constants of the dynamic discs, each [N, ...]."""

    radius: Array
    inverse_mass: Array
    inverse_moment: Array
    elasticity: Array
    friction: Array


def row(a: Discs, b: Discs, present: Array, mixing: str) -> Row:
    """The row of pairs (a, b); where not both are `present` it has no mass."""
    k_normal = a.inverse_mass + b.inverse_mass
    turn_a, turn_b = a.radius * a.inverse_moment, b.radius * b.inverse_moment
    k_tangent = k_normal + a.radius * turn_a + b.radius * turn_b
    return Row(
        arm_a=a.radius,
        arm_b=b.radius,
        inverse_mass_a=a.inverse_mass,
        inverse_mass_b=b.inverse_mass,
        turn_a=turn_a,
        turn_b=turn_b,
        normal_mass=jnp.where(present, 1 / jnp.where(present, k_normal, 1.0), 0.0),
        tangent_mass=jnp.where(present, 1 / jnp.where(present, k_tangent, 1.0), 0.0),
        elasticity=_mixed(a.elasticity, b.elasticity, mixing),
        friction=_mixed(a.friction, b.friction, mixing),
    )


# A row --------------------------------------------------------------------------------------------------------------


def biased(row: Row, touch: Touch, speed: Array, target: Array, old: Impulse, hertz: float, rules: Rules) -> Array:
    """The accumulated normal impulse after the biased solve of a row.

    Apart: the gap may be closed, no more. Overlapping: a soft push. Bouncing: `target` exactly. Passing: nothing, as
    the straight line of a soft contact would stop a body that only grazes the other, or that comes a step later.
    """
    rate, mass_scale, impulse_scale = rules.softness(hertz)
    apart = touch.gap > 0
    bias = jnp.where(apart, touch.gap / rules.step, jnp.maximum(rate * touch.gap, -rules.push_speed))
    soft = old.normal - jnp.where(apart, 1.0, mass_scale) * row.normal_mass * (speed + bias)
    soft = jnp.maximum(soft - jnp.where(apart, 0.0, impulse_scale) * old.normal, 0.0)
    soft = jnp.where(touch.tau == PASSES, 0.0, soft)
    hard = old.normal + row.normal_mass * (target - speed)
    return jnp.where(row.normal_mass > 0, jnp.where(touch.tau >= 0, hard, soft), 0.0)


def struck(row: Row, touch: Touch, speed: Array, threshold: Array) -> Array:
    """Where a neighbour's bounce has closed a row that is in contact: it bounces, too."""
    return (speed < -threshold) & (touch.gap <= 0) & (row.normal_mass > 0)


def relaxed(row: Row, touch: Touch, speed: Array, old: Impulse, threshold: Array) -> Array:
    """The accumulated normal impulse after the relaxing solve, without bias.

    No say has a row that bounced and parts, one that is apart and carried nothing (it would brake a body one step
    before its impact), and one that a neighbour closes across a gap (it bounces in a later step).
    """
    pushes = (touch.tau < 0) & ((old.normal > 0) | (touch.gap <= 0)) & (speed >= -threshold) & (row.normal_mass > 0)
    soft = jnp.where(pushes, jnp.maximum(old.normal - row.normal_mass * speed, 0.0), old.normal)
    hard = old.normal - (1 + row.elasticity) * row.normal_mass * speed
    return jnp.where(struck(row, touch, speed, threshold), hard, soft)


def rubbed(row: Row, normal_impulse: Array, slip: Array, old: Impulse) -> Array:
    """The accumulated tangential impulse: what stops the slip, within Coulomb's bound of the normal impulse now."""
    bound = row.friction * normal_impulse
    return jnp.clip(old.tangent - row.tangent_mass * slip, -bound, bound)


def difference(new: Impulse, old: Impulse) -> Impulse:
    """What a solve added."""
    return Impulse(new.normal - old.normal, new.tangent - old.tangent)


def remembered(touch: Touch, again: Array, impulse: Impulse) -> Impulse:
    """What may warm-start the next step: a bounce may not, be it in the biased pass or now."""
    return jax.tree.map(lambda x: jnp.where((touch.tau >= 0) | again, 0.0, x), impulse)


def slip_of(row: Row, normal: Array, velocity: Array, spin_a: Array | float, spin_b: Array) -> Array:
    """Tangential speed in m/s of b's rim over a's at the point of contact."""
    return normal[0] * velocity[1] - normal[1] * velocity[0] - row.arm_a * spin_a - row.arm_b * spin_b


def along(normal: Array, impulse: Impulse) -> Array:
    """The impulse as a vector [2, ...], N s."""
    return impulse.normal * normal + impulse.tangent * turned(normal)


def pushed(motion: Motion, push: Array, twist: Array, inverse_mass: Array, turn: Array) -> Motion:
    """The motion after the impulse `push` [2, ...] with the tangential part `twist`."""
    return Motion(motion.velocity + inverse_mass * push, motion.spin - turn * twist)


def drifted(drift: Drift, old: Motion, new: Motion, touch: Touch, impulse: Impulse) -> Drift:
    """The drift with what the time of an impact takes off the way, and whether anything but an impact held the body."""
    tau = jnp.maximum(touch.tau, 0.0)
    held = jnp.where((touch.tau < 0) & (impulse.normal > 0), 1.0, 0.0)
    return Drift(
        shift=drift.shift - tau * (new.velocity - old.velocity),
        turn=drift.turn - tau * (new.spin - old.spin),
        held=jnp.maximum(drift.held, held),
    )


# A step -------------------------------------------------------------------------------------------------------------


def warm(position: Array, motion: Motion, memory: Memory, setup: Setup) -> tuple[Motion, list, list[Touch]]:
    """The motion with the last step's impulses, and where every pair stands: (offset, 1 / distance), and touches."""

    def play(k: int, a: tuple, b: tuple) -> tuple:
        row, old = setup.pairs[k], memory.pairs[k]
        apart = b[0] - a[0]
        apart, inverse = settled((apart, inverse_length(apart)), setup.one)
        push = settled(along(apart * inverse, old), setup.one)
        a = a[0], pushed(a[1], -push, old.tangent, row.inverse_mass_a, row.turn_a)
        b = b[0], pushed(b[1], push, old.tangent, row.inverse_mass_b, row.turn_b)
        return a, b, (apart, inverse)

    (_, motion), offsets = tournament((position, motion), len(setup.pairs), play)
    touches = []
    for row, old, segment in zip(setup.walls, memory.walls, setup.segments, strict=True):
        normal, gap = settled(segment_disc(segment, position, setup.radius), setup.one)
        push = along(normal, old)
        motion = settled(pushed(motion, push, old.tangent, row.inverse_mass_b, row.turn_b), setup.one)
        touches.append(Touch(normal, gap, jnp.full_like(gap, NONE)))
    return motion, offsets, touches


def solve(motion: Motion, offsets: list, touches: list[Touch], memory: Memory, setup: Setup, rules: Rules) -> tuple:
    """Motion and drift after the biased pass, and (touch, impulse) of every row of pairs and of walls."""
    h, threshold = rules.step, setup.threshold

    def play(k: int, a: tuple, b: tuple) -> tuple:
        row, old, (apart, inverse) = setup.pairs[k], memory.pairs[k], offsets[k]
        (motion_a, drift_a), (motion_b, drift_b) = a, b
        velocity, reach = motion_b.velocity - motion_a.velocity, row.arm_a + row.arm_b
        impact = disc_impact(apart, inverse, reach, velocity, h, threshold)
        tau, scale = settled(impact, setup.one)
        normal = settled((apart + jnp.maximum(tau, 0.0) * velocity) * scale, setup.one)
        touch, speed = Touch(normal, 1 / inverse - reach, tau), dot(normal, velocity)
        pressed = settled(biased(row, touch, speed, -row.elasticity * speed, old, rules.hertz, rules), setup.one)
        slip = slip_of(row, normal, velocity, motion_a.spin, motion_b.spin)
        impulse = Impulse(pressed, settled(rubbed(row, pressed, slip, old), setup.one))
        added = difference(impulse, old)
        push = along(normal, added)
        new_a = pushed(motion_a, -push, added.tangent, row.inverse_mass_a, row.turn_a)
        new_b = pushed(motion_b, push, added.tangent, row.inverse_mass_b, row.turn_b)
        a = new_a, drifted(drift_a, motion_a, new_a, touch, impulse)
        b = new_b, drifted(drift_b, motion_b, new_b, touch, impulse)
        return a, b, (touch, impulse)

    drift = Drift(*(jnp.zeros_like(x) for x in (motion.velocity, motion.spin, motion.spin)))
    (motion, drift), pairs = tournament((motion, drift), len(setup.pairs), play)
    walls = []
    for row, old, touch in zip(setup.walls, memory.walls, touches, strict=True):
        speed, pull = dot(touch.normal, motion.velocity), -dot(touch.normal, setup.gravity[:, None])
        tau, target = settled(wall_impact(touch.gap, speed, pull, row.elasticity, h, threshold), setup.one)
        touch = touch._replace(tau=tau)
        pressed = settled(biased(row, touch, speed, target, old, 2 * rules.hertz, rules), setup.one)
        slip = slip_of(row, touch.normal, motion.velocity, 0.0, motion.spin)
        impulse = Impulse(pressed, settled(rubbed(row, pressed, slip, old), setup.one))
        added = difference(impulse, old)
        new = pushed(motion, along(touch.normal, added), added.tangent, row.inverse_mass_b, row.turn_b)
        motion, drift = settled((new, drifted(drift, motion, new, touch, impulse)), setup.one)
        walls.append((touch, impulse))
    return motion, drift, pairs, walls


def relax(motion: Motion, pairs: list, walls: list, setup: Setup) -> tuple[Motion, list[Impulse], list[Impulse]]:
    """The motion after the relaxing pass, and what each row leaves to the next step."""

    def again(row: Row, touch: Touch, old: Impulse, velocity: Array, slip: Array) -> tuple[Impulse, Impulse]:
        speed = dot(touch.normal, velocity)
        pressed = settled(relaxed(row, touch, speed, old, setup.threshold), setup.one)
        impulse = Impulse(pressed, settled(rubbed(row, pressed, slip, old), setup.one))
        left = settled(remembered(touch, struck(row, touch, speed, setup.threshold), impulse), setup.one)
        return left, difference(impulse, old)

    def play(k: int, a: Motion, b: Motion) -> tuple:
        row, (touch, old) = setup.pairs[k], pairs[k]
        velocity = b.velocity - a.velocity
        left, added = again(row, touch, old, velocity, slip_of(row, touch.normal, velocity, a.spin, b.spin))
        push = along(touch.normal, added)
        a = pushed(a, -push, added.tangent, row.inverse_mass_a, row.turn_a)
        b = pushed(b, push, added.tangent, row.inverse_mass_b, row.turn_b)
        return a, b, left

    motion, pair_memory = tournament(motion, len(setup.pairs), play)
    wall_memory = []
    for row, (touch, old) in zip(setup.walls, walls, strict=True):
        slip = slip_of(row, touch.normal, motion.velocity, 0.0, motion.spin)
        left, added = again(row, touch, old, motion.velocity, slip)
        push = along(touch.normal, added)
        motion = settled(pushed(motion, push, added.tangent, row.inverse_mass_b, row.turn_b), setup.one)
        wall_memory.append(left)
    return motion, pair_memory, wall_memory


def seen(depth: Array, begins: Array, rows: list[Row], touched: list, memory: list[Impulse]) -> tuple[Array, Array]:
    """The deepest overlap so far and the contacts that began so far, [pairs, ...]; a bounce begins a contact."""
    for row, (touch, impulse), old in zip(rows, touched, memory, strict=True):
        depth = jnp.maximum(depth, jnp.where(row.normal_mass > 0, -touch.gap, 0.0))
        begins = begins + ((impulse.normal > 0) & (old.normal <= 0))
    return depth, begins


def step(position: Array, angle: Array, motion: Motion, memory: Memory, setup: Setup, rules: Rules) -> tuple:
    """Position [2, N, ...], angle [N, ...], motion and memory one step later."""
    h = rules.step
    slowed = math.exp(-rules.damping * h)
    falling = Motion((motion.velocity + h * setup.fall) * slowed, motion.spin * slowed)
    warmed, offsets, touches = warm(position, settled(falling, setup.one), memory, setup)
    moving, drift, pairs, walls = solve(warmed, offsets, touches, memory, setup, rules)
    # Free fall is an exact parabola: x += h v + h^2 g / 2 with v from before, that is, h v_new - h^2 g / 2.
    free = 0.5 * h**2 * (1 - drift.held)
    position = position + h * moving.velocity + drift.shift - free * setup.fall
    angle = angle + h * moving.spin + drift.turn
    position, angle = settled((position, angle), setup.one)
    motion, pair_memory, wall_memory = relax(moving, pairs, walls, setup)
    pair_seen = seen(memory.pair_depth, memory.pair_begins, setup.pairs, pairs, memory.pairs)
    wall_seen = seen(memory.wall_depth, memory.wall_begins, setup.walls, walls, memory.walls)
    return position, angle, motion, Memory(pair_memory, wall_memory, *pair_seen, *wall_seen)
