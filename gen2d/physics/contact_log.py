"""What touched what, and when: noted row by row while a frame is simulated, told as it ends."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.core.enums import BEGIN, END, IMPACT, NO_CONTACT, PERSIST
from gen2d.physics.contact_state import SolvedPair
from gen2d.records.axes import Array
from gen2d.records.trajectory import Contacts
from gen2d.xla import materialize

ON, BOUNCED, BEFORE = 1, 2, 4  # flags: touching after the last step, an impact in this frame, touching as it began


class ContactEvent(NamedTuple):
    """What a row has seen since the frame began, each [pairs, ...]."""

    time: Array  # s from frame 0, of the first touch; -1: none yet
    place: Array  # [2, ...] m
    normal: Array  # [2, ...]
    approach: Array  # m/s
    normal_impulse: Array  # N s
    tangent_impulse: Array  # N s
    flags: Array


def empty_events(shape: tuple[int, ...], dtype: jnp.dtype) -> ContactEvent:
    """A row in which nothing has happened yet."""
    zero = jnp.zeros(shape, dtype)
    vector = jnp.zeros((2, *shape), dtype)
    return ContactEvent(zero - 1, vector, vector, zero, zero, zero, jnp.zeros(shape, jnp.int32))


def record_event(event: ContactEvent, solved: SolvedPair, relaxed: SolvedPair, start: Array) -> ContactEvent:
    """The event with one more step, which began at `start`: the row after its biased solve, and after its last one."""
    points = list(zip(solved.touches, solved.impulses, relaxed.impulses, strict=True))
    touching = [(biased.normal > 0) | (last.normal > 0) for _, biased, last in points]
    touch, on = points[0][0]._replace(grip=None), touching[0]
    bounced = on & (touch.tau >= 0)
    if len(points) == 2:  # the second counts where only it touches
        second, other = touching[1] & ~on, points[1][0]._replace(grip=None)
        bounced = bounced | (touching[1] & (other.tau >= 0))
        touch, on = jax.tree.map(lambda x, y: jnp.where(second, y, x), touch, other), on | second
    first = materialize(jnp.where(on & (event.time < 0), 1.0, 0.0)) > 0.5
    assert touch.place is not None, "who keeps events asks for the touches' places"
    news = (start + jnp.maximum(touch.tau, 0.0), touch.place, touch.normal, touch.arrival)
    time, place, normal, approach = (jnp.where(first, new, old) for new, old in zip(news, event[:4], strict=True))
    return ContactEvent(
        time,
        place,
        normal,
        approach,
        event.normal_impulse + sum(last.normal for *_, last in points),
        event.tangent_impulse + sum(last.tangent for *_, last in points),
        (event.flags & (BOUNCED | BEFORE)) | jnp.where(bounced, BOUNCED, jnp.where(on, ON, 0)).astype(jnp.int32),
    )


def began_touching(event: ContactEvent) -> ContactEvent:
    """The event as the next frame begins."""
    fresh = empty_events(event.time.shape, event.time.dtype)
    return fresh._replace(flags=jnp.where((event.flags & ON) > 0, ON | BEFORE, 0).astype(jnp.int32))


class PairEvent(NamedTuple):
    """What happened in a row in a frame, each [pairs, ...]; kind 0: nothing."""

    kind: Array
    time: Array  # s; -1: an end without a touch
    place: Array
    normal: Array
    approach: Array
    separation: Array
    normal_impulse: Array
    tangent_impulse: Array


def pair_event(event: ContactEvent, elasticity: Array) -> PairEvent:
    """What happened, as the frame ends. What bounces leaves with e times the speed that it came with."""
    on, bounced, before = ((event.flags & flag) > 0 for flag in (ON, BOUNCED, BEFORE))
    kind = jnp.where(before, jnp.where(on, PERSIST, END), jnp.where(event.time >= 0, BEGIN, NO_CONTACT))
    separation = jnp.where(bounced, elasticity * event.approach, 0.0)
    return PairEvent(jnp.where(bounced, IMPACT, kind).astype(jnp.uint8), *event[:4], separation, *event[4:6])


def compact(frames: PairEvent, a: Array, b: Array, fps: float, slots: int) -> Contacts:
    """The rows [T - 1, P, ...] in which something happened, the first `slots` of them, in time's order.

    `a` and `b` are the slots of the objects of each of P rows, [P, n].
    """
    steps, rows, lanes = frames.kind.shape
    rank = jnp.cumsum((frames.kind > 0).reshape(steps * rows, lanes), axis=0, dtype=jnp.int32)
    wanted = jnp.arange(1, slots + 1)
    place = jax.vmap(lambda r: jnp.searchsorted(r, wanted), in_axes=1, out_axes=1)(rank)  # [C, n]
    count = rank[-1]
    filled, place = wanted[:, None] <= count, jnp.minimum(place, steps * rows - 1)
    time = jnp.take_along_axis(frames.time.reshape(-1, lanes), place, axis=0)
    time = jnp.where(time >= 0, time, (place // rows) / fps)  # an end without a touch: as the frame began
    order = order_of(jnp.where(filled, time, jnp.inf))
    time, place = (jnp.take_along_axis(x, order, axis=0) for x in (time, place))
    frame, row = place // rows, place % rows

    def cleared(values: Array) -> Array:
        return jnp.where(filled, values, jnp.zeros_like(values))

    def taken(values: Array, axis: int = 0) -> Array:
        parts = values.size // (steps * rows * lanes)  # 2 in a vector
        there = (frame * parts + axis) * rows + row
        return cleared(jnp.take_along_axis(values.reshape(-1, lanes), there, axis=0))

    def vector(values: Array) -> Array:
        return jnp.stack([taken(values, 0), taken(values, 1)])

    told = jax.tree.map(lambda x: vector(x) if x.ndim == 4 else taken(x), frames)._replace(time=cleared(time))
    number, first, second = frame.astype(jnp.int32) + 1, a[row, 0], b[row, 0]
    return contacts_of(told, cleared(number), cleared(first), cleared(second), count)


def contacts_of(what: PairEvent, frame: Array, a: Array, b: Array, count: Array) -> Contacts:
    """The rows [C, n] of what happened, in which frame and to which slots, as they are stored."""
    return Contacts(
        time=what.time,
        frame=frame,
        a=a.astype(jnp.int16),
        b=b.astype(jnp.int16),
        point=what.place,
        normal=what.normal,
        normal_impulse=what.normal_impulse,
        tangent_impulse=what.tangent_impulse,
        approach_speed=what.approach,
        separation_speed=what.separation,
        kind=what.kind,
        count=count,
    )


def order_of(time: Array) -> Array:
    """The places [C, n] of times in ascending order, of equal ones as they come.

    An odd-even transposition sort: as many passes as a row is out of its place, which is few, as frames come in order;
    a sort of all takes twenty times as long on a CPU.
    """
    rows = jnp.arange(len(time), dtype=jnp.int32)[:, None]

    def beside(values: Array, by: int) -> Array:
        return jnp.roll(values, by, axis=0)

    def exchange(state: tuple) -> tuple:
        time, order, turn, idle = state
        first, last = rows % 2 == turn % 2, len(rows) - 1
        later = first & (rows < last) & (time > beside(time, -1))
        earlier = ~first & (rows > 0) & (beside(time, 1) > time)
        time, order = (jnp.where(later, beside(x, -1), jnp.where(earlier, beside(x, 1), x)) for x in (time, order))
        return time, order, turn + 1, jnp.where(jnp.any(later), 0, idle + 1)

    start = time, jnp.broadcast_to(rows, time.shape), jnp.int32(0), jnp.int32(0)
    return jax.lax.while_loop(lambda state: state[3] < 2, exchange, start)[1]
