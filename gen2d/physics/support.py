"""Heavy bodies on light ones that static bodies bear (shock propagation).

A light body between a heavy one and a floor cannot give way, but sequential impulses pass on only a share of the load
in each pass, which falls with the ratio of the masses. In the first pass, the contact of a body with one of less than a
third of its mass therefore sees the lighter one as if it could not move along the load that static bodies bore in the
last step: along the sum of their normal impulses, with its torque. A body that two points of a contact bear cannot turn
either. Its inverse mass lacks the Schur complement of these directions, and its velocity the part along them.

What the lighter body cannot do is pending: a velocity beside its own, which only static bodies see. They come last in a
pass, and their impulses take it up as far as they press against it; the rest of it is lost. So no third body meets a
speed that the static ones are about to stop, and where these let the lighter one slip, as out of a wedge, it does not
leave with an energy that the heavier one has not lost.

A light body that a heavy one has pressed onto others need not rest on them: it may bounce between them many times in a
step, which each contact sees once, and the heavy one goes through it. So, with `physics.extreme_mass_ratios`, the
contact of a pair that overlaps by more than `CRUSHED` sees the lighter one without the directions in which it
approaches static bodies and far heavier ones in this step, its obstacles. What the lighter one would do in these
directions is lost, and the obstacles do not feel it: passed on, it would throw the lighter one where it misses them.

Source: E. Guendelman, R. Bridson and R. Fedkiw, 'Nonconvex rigid bodies with stacking' (2003), give supported bodies an
infinite mass.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.physics.collision import dot, perpendicular
from gen2d.physics.constraint import (
    ActiveContact,
    Components,
    ContactConstraint,
    ContactFrame,
    ContactPoint,
    Impulse,
    Inertia,
    Motion,
    reciprocal,
)
from gen2d.records.axes import Array
from gen2d.xla import materialize

LEAST_RATIO = 3.0  # of the masses: sequential impulses serve smaller ones
LARGEST_RATIO = 3000.0  # a lighter body gives way, as its rounding errors would move the heavy one
LARGEST_IN_IMPACTS = 300.0  # beyond, heavy bodies would press too long into light ones in corners
LARGEST_IN_CORNERS = 30.0  # where friction on one wall lifts the lighter body off another
PARALLEL = 0.2  # sine of the angle between two loads that act in one direction
PRESSED = 0.5  # least cosine of the angle between a contact's normal and the load of the static bodies
LEAST_LEFT = 1e-4  # share of a contact's compliance that a support leaves at least, as the rest would be rounding
LEAST_COMPLIANCE = 1e-30  # (N s)^2 / kg, of a load that bears anything: a lesser one has no finite reciprocal
CRUSHED = 0.005  # m: least overlap of a pair whose lighter body has obstacles; bodies at rest overlap by far less
SEVERAL = 0.98  # of the obstacles' impulses: length of their sum over the sum of their lengths, if they act in one line

LINE, FLUSH, CORNER = 0.0, 1.0, 2.0  # kinds of supports: in one direction, at two points of a contact, in several


class Support(NamedTuple):
    """Normal impulses of the static bodies that bear a body, in the last step."""

    load: Array  # [2, N, ...] N s
    torque: Array | None  # [N, ...] N m s; None: discs
    kind: Array  # [N, ...] LINE, FLUSH or CORNER


def no_support(velocity: Array, disc: bool) -> Support:
    """Support of bodies [2, N, ...] that nothing bears."""
    zero = jnp.zeros_like(velocity[0])
    return Support(jnp.zeros_like(velocity), None if disc else zero, zero)


def add_support(support: Support, points: Sequence[ContactPoint], impulses: Sequence[Impulse]) -> Support:
    """Support with the contact with a static body, from its impulses in the last step."""
    load, torque, kind = support
    borne = [impulse.normal > 0 for impulse in impulses]
    crossing = dot(load, perpendicular(points[0].normal)) ** 2 > PARALLEL**2 * dot(load, load)
    any_point, both = functools.reduce(jnp.logical_or, borne), functools.reduce(jnp.logical_and, borne)
    kind = jnp.where(any_point & crossing & (kind == LINE), CORNER, kind)
    if len(impulses) == 2:
        kind = jnp.where(both, FLUSH, kind)
    for point, impulse in zip(points, impulses, strict=True):
        load = load + impulse.normal * point.normal
        if point.frame.normal_b is not None and torque is not None:
            torque = torque + impulse.normal * point.frame.normal_b
    return Support(load, torque, kind)


class Obstacles(NamedTuple):
    """Impulses that static bodies and far heavier ones exert on a body in this step, as far as is known before it."""

    load: Array  # [2, N, ...] N s: their sum
    torque: Array | None  # [N, ...] N m s; None: discs
    total: Array  # [N, ...] N s: sum of their lengths

    def add(self, normal: Array, lever: Array | None, impulse: Array) -> "Obstacles":
        """Obstacles with an impulse along a normal with this lever; without it if it is negative."""
        torque = self.torque if self.torque is None or lever is None else self.torque + impulse * lever
        return Obstacles(self.load + impulse * normal, torque, self.total + impulse)


def no_obstacles(support: Support) -> Obstacles:
    """Obstacles of bodies with these supports, of which none is known."""
    zeros = jax.tree.map(jnp.zeros_like, support)
    return Obstacles(zeros.load, zeros.torque, zeros.kind)


def far_lighter(constraint: ContactConstraint) -> tuple[Array, Array]:
    """Whether the bodies a and b are far lighter than the other; b is than a static body."""
    if constraint.a is None:
        return jnp.zeros_like(constraint.present), jnp.ones_like(constraint.present)
    a, b = constraint.a.mass, constraint.b.mass
    return a > LEAST_RATIO * b, b > LEAST_RATIO * a


def is_crushed(constraint: ContactConstraint, points: Sequence[ContactPoint]) -> Array:
    """Whether the pair overlaps so far that the obstacles of its lighter body count."""
    lighter_a, lighter_b = far_lighter(constraint)
    deep = [(point.gap < -CRUSHED) & (point.frame.normal_mass > 0) for point in points]
    return (lighter_a | lighter_b) & functools.reduce(jnp.logical_or, deep)


def add_obstacles(
    constraint: ContactConstraint, points: Sequence[ContactPoint], of: tuple[Obstacles | None, Obstacles], sign: int
) -> tuple[Obstacles | None, Obstacles]:
    """Obstacles of both bodies with each other, the heavier of the lighter, or, if the sign is -1, without."""
    (a, b), (lighter_a, lighter_b) = of, far_lighter(constraint)
    for point in points:
        assert point.stop is not None, "what stops a point is known"
        b = b.add(point.normal, point.frame.normal_b, jnp.where(lighter_b, sign * point.stop, 0.0))
        if a is not None:
            lever = None if point.frame.normal_a is None else -point.frame.normal_a
            a = a.add(-point.normal, lever, jnp.where(lighter_a, sign * point.stop, 0.0))
    return a, b


class CrushedPair(NamedTuple):
    """What a pair that may be crushed has beyond others."""

    crushed: Array  # whether obstacles stop the lighter body, instead of a support
    fixed: Array  # whether these are in several directions, so that it does not move at all
    heavier: Inertia

    def where(self, yes: Any, no: Any) -> Any:
        """The tree `yes` where the pair is crushed, else `no`."""
        return jax.tree.map(lambda x, y: jnp.where(self.crushed, x, y), yes, no)


class SupportedPair(NamedTuple):
    """Two moving bodies in contact, of which static bodies may bear the lighter, or obstacles stop it."""

    lighter: tuple[Array, Array]  # whether each is the lighter and pressed onto what bears it
    mass: Array  # 1/kg: inverse mass of the lighter
    moment: Array  # 1 / (kg m^2): its inverse moment of inertia; zero if two points of a contact bear it
    locked: Array  # 1 / (kg m^2): what such a contact takes from it
    load: Array  # N s: direction in which it does not move, with the torque
    torque: Array | None  # N m s
    share: Array  # kg / (N s)^2: reciprocal of the load's compliance; zero where nothing bears it
    in_impacts: Array  # whether impacts see the support, too
    crush: CrushedPair | None  # None: no obstacles are known

    def left(self, motions: tuple[Motion | None, Motion]) -> tuple[Motion, Motion]:
        """Motions of both bodies that supports leave."""
        a, b = motions
        assert a is not None, "both bodies move"
        velocity, spin = jax.tree.map(self._of_lighter, a, b)
        power = dot(self.load, velocity)
        if self.torque is not None:
            power = power + jnp.where(self.locked > 0, 0.0, self.torque * spin)
        impulse = materialize(self.share * power)
        new = velocity - self.mass * impulse * self.load, spin
        if self.torque is not None:
            new = new[0], jnp.where(self.locked > 0, 0.0, spin - self.moment * impulse * self.torque)
        if self.crush is not None:
            new = [jnp.where(self.crush.fixed, 0.0, x) for x in new]
        of = zip(self.lighter, motions, strict=True)
        of_a, of_b = (
            jax.tree.map(lambda x, y, borne=borne: jnp.where(borne, x, y), Motion(*new), m) for borne, m in of
        )
        return of_a, of_b

    def _of_lighter(self, a: Array, b: Array) -> Array:
        return jnp.where(self.lighter[1], b, a)

    def _levers(self, levers: Components) -> tuple[Array, Array]:
        """Levers of a direction on the lighter and on the heavier body, m."""
        of_a, of_b = (0.0 if lever is None else lever for lever in levers)
        return jnp.where(self.lighter[1], of_b, of_a), jnp.where(self.lighter[1], of_a, of_b)

    def _schur_complement(self, p: tuple[Array, Components], q: tuple[Array, Components]) -> Array:
        """What the support takes from the speed along q that a unit impulse along p causes, 1/kg.

        Both are directions with levers on both bodies.
        """
        alongs, (lever_p, lever_q) = [], (self._levers(levers)[0] for _, levers in (p, q))
        for (unit, _), lever in zip((p, q), (lever_p, lever_q), strict=True):
            along = self.mass * dot(self.load, unit)
            alongs.append(along if self.torque is None else along + self.moment * self.torque * lever)
        taken = self.share * alongs[0] * alongs[1]
        taken = taken if self.torque is None else taken + self.locked * lever_p * lever_q
        if self.crush is None:
            return taken
        return jnp.where(self.crush.fixed, self.mass * dot(p[0], q[0]) + self.moment * lever_p * lever_q, taken)

    def taken_slip(self, contact: ActiveContact) -> Array:
        """What the support takes from the tangential speed that a unit impulse along the normal causes, 1/kg."""
        frame, unit = contact.frame, perpendicular(contact.normal)
        along_normal = contact.normal, (frame.normal_a, frame.normal_b)
        return self._schur_complement(along_normal, (unit, (frame.tangent_a, frame.tangent_b)))

    def _frame(self, frame: ContactFrame, normal: Array) -> ContactFrame:
        """Frame of a contact with the effective masses that the support leaves."""
        near = frame.normal_mass > 0

        def left(k: Array, direction: tuple[Array, Components]) -> Array:
            left = k - self._schur_complement(direction, direction)
            if self.crush is None:
                return jnp.maximum(left, LEAST_LEFT * k)
            (_, fixed, heavier), (_, lever) = self.crush, self._levers(direction[1])
            least = heavier.mass + heavier.moment * lever**2
            borne = self.lighter[0] | self.lighter[1]
            return jnp.where(borne, jnp.where(fixed, least, jnp.maximum(left, least)), k)

        k_normal = left(frame.k_normal, (normal, (frame.normal_a, frame.normal_b)))
        k_tangent = left(frame.k_tangent, (perpendicular(normal), (frame.tangent_a, frame.tangent_b)))
        masses = reciprocal(k_normal, near), reciprocal(k_tangent, near)
        return frame._replace(k_normal=k_normal, k_tangent=k_tangent, normal_mass=masses[0], tangent_mass=masses[1])

    def contacts(self, contacts: list[ActiveContact]) -> "SupportedContacts":
        """Contacts of the pair with the effective masses that the support leaves."""
        taken = 0.0
        if len(contacts) == 2:
            of_p, of_q = ((c.normal, (c.frame.normal_a, c.frame.normal_b)) for c in contacts)
            taken = self._schur_complement(of_p, of_q)
        left = [contact._replace(frame=self._frame(contact.frame, contact.normal)) for contact in contacts]
        return SupportedContacts(self, left, taken)

    def where_acts(self, acts: Array) -> "SupportedPair":
        """The pair without supports where no impulse acts."""
        lighter_a, lighter_b = self.lighter
        return self._replace(lighter=(lighter_a & acts, lighter_b & acts))

    def pending(self, taken: Motion) -> Motion:
        """What static bodies are to take up of a motion that supports do not leave: nothing where obstacles stop it."""
        if self.crush is None:
            return taken
        crushed = self.crush.crushed
        return jax.tree.map(lambda x: jnp.where(crushed, 0.0, x), taken)

    @property
    def bears_impacts(self) -> Array:
        """Whether impacts see what bears the lighter body."""
        return (self.lighter[0] | self.lighter[1]) & self.in_impacts

    def acceleration(self, acceleration: Array | None, gravity: Array) -> Array:
        """Acceleration [2, ...] of b relative to a, m/s^2: gravity's of the heavier body, if the lighter is borne."""
        free = jnp.zeros_like(self.load) if acceleration is None else acceleration
        lighter_a, lighter_b = (borne & self.in_impacts for borne in self.lighter)
        return jnp.where(lighter_a, gravity, jnp.where(lighter_b, -gravity, free))

    def seen(self, impact: Array) -> "SupportedPair":
        """The pair as its contacts see it, which may have an impact in this step."""
        sees, (lighter_a, lighter_b), crush = self.in_impacts | ~impact, self.lighter, self.crush
        if crush is not None:
            crush = crush._replace(crushed=crush.crushed & sees, fixed=crush.fixed & sees)
        return self._replace(
            lighter=(lighter_a & sees, lighter_b & sees),
            locked=jnp.where(sees, self.locked, 0.0),
            share=jnp.where(sees, self.share, 0.0),
            crush=crush,
        )


class SupportedContacts(NamedTuple):
    """Contacts of a pair as its impulses see them: with what supports leave of its bodies."""

    pair: SupportedPair | None  # None: nothing bears them
    contacts: list[ActiveContact]
    taken: Array | float  # 1/kg, by the support from the speed at one of two points after a unit impulse at the other

    def left(self, motions: tuple[Motion | None, Motion]) -> tuple[Motion | None, Motion]:
        """Motions, or displacements, of both bodies that supports leave."""
        return motions if self.pair is None else self.pair.left(motions)

    @property
    def crush(self) -> CrushedPair | None:
        """What a pair that may be crushed has beyond others; None if no obstacles are known."""
        return None if self.pair is None else self.pair.crush

    def kept(self, motions: tuple[Motion | None, Motion]) -> tuple[Motion | None, Motion]:
        """Motions, or displacements, of which obstacles take up what a crushed body cannot do."""
        return motions if self.crush is None else self.crush.where(self.left(motions), motions)

    def pushed(self, contacts: list[ActiveContact]) -> tuple[list[ActiveContact], Array | float]:
        """Contacts as the correction of overlaps sees them, and what is `taken`: only obstacles count."""
        if self.crush is None:
            return contacts, 0.0
        frames = self.crush.where([c.frame for c in self.contacts], [c.frame for c in contacts])
        contacts = [contact._replace(frame=frame) for contact, frame in zip(contacts, frames, strict=True)]
        return contacts, self.crush.where(self.taken, 0.0)


def supported_pair(
    constraint: ContactConstraint,
    points: Sequence[ContactPoint],
    supports: tuple[Support | None, Support | None],
    obstacles: tuple[Obstacles | None, Obstacles | None],
) -> SupportedPair | None:
    """The pair in contact; None for a static body, and in passes that see no supports.

    Nothing bears or stops a body on a rigid joint.
    """
    (a, b), normal = supports, points[0].normal
    if constraint.static or constraint.a is None or a is None or b is None:
        return None
    crushed, (stop_a, stop_b) = None, obstacles
    if stop_b is not None:
        crushed = is_crushed(constraint, points)
        stop_a, stop_b = add_obstacles(constraint, points, (stop_a, stop_b), -1)
        assert stop_a is not None, "both bodies move"
        a, b = _stopped(crushed, a, stop_a), _stopped(crushed, b, stop_b)
    of_a, of_b = constraint.a, constraint.b  # inverse masses

    def borne(far: Array, one: Inertia, other: Inertia, support: Support, schur: Array | None) -> Array:
        served = one.mass <= jnp.where(support.kind == CORNER, LARGEST_IN_CORNERS, LARGEST_RATIO) * other.mass
        lighter = far & (served if crushed is None else served | crushed)
        return lighter if schur is None else lighter & (schur == 0).all(0)

    far_a, far_b = far_lighter(constraint)
    lighter_a = borne(far_a, of_a, of_b, a, constraint.schur_a)
    lighter_b = borne(far_b, of_b, of_a, b, constraint.schur_b)
    load, kind, mass, moment = (
        jnp.where(lighter_b, y, x)
        for x, y in ((a.load, b.load), (a.kind, b.kind), (of_a.mass, of_b.mass), (of_a.moment, of_b.moment))
    )
    square, along = dot(load, load), dot(load, normal)
    along = jnp.where(lighter_b, -along, along)
    torque, k = None, mass * square
    pressed = (lighter_a | lighter_b) & (along > 0) & (along * along > PRESSED**2 * square) & (k > LEAST_COMPLIANCE)
    locked = jnp.zeros_like(moment)
    if a.torque is not None or b.torque is not None:
        x, y = (jnp.zeros_like(k) if torque is None else torque for torque in (a.torque, b.torque))
        flush = kind == FLUSH
        torque, locked = jnp.where(lighter_b, y, x), jnp.where(flush & pressed, moment, 0.0)
        moment = jnp.where(flush, 0.0, moment)
        k = k + moment * torque * torque
    share = reciprocal(k, pressed)
    in_impacts, crush = mass <= LARGEST_IN_IMPACTS * jnp.where(lighter_b, of_a.mass, of_b.mass), None
    if crushed is not None and stop_a is not None and stop_b is not None:
        crushed = crushed & pressed
        fixed = crushed & (square < SEVERAL**2 * jnp.where(lighter_b, stop_b.total, stop_a.total) ** 2)
        heavier = Inertia(*(jnp.where(lighter_b, x, y) for x, y in zip(of_a, of_b, strict=True)))
        in_impacts, crush = in_impacts | crushed, CrushedPair(crushed, fixed, heavier)
    lighter = pressed & lighter_a, pressed & lighter_b
    return SupportedPair(lighter, mass, moment, locked, load, torque, share, in_impacts, crush)


def _stopped(crushed: Array, support: Support, stop: Obstacles) -> Support:
    """Support with the obstacles in its place where the pair is crushed."""
    line = Support(stop.load, stop.torque, jnp.full_like(support.kind, LINE))
    return jax.tree.map(lambda x, y: jnp.where(crushed, x, y), line, support)
