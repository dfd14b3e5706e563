"""Contact events: recorded for each pair in every step, logged at the end of a frame."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gen2d.core.enums import BEGIN, END, IMPACT, NO_CONTACT, PERSIST
from gen2d.physics.collision import dot, perpendicular
from gen2d.physics.constraint import reciprocal
from gen2d.physics.contact_state import SolvedPair
from gen2d.records.axes import Array
from gen2d.records.trajectory import Contacts
from gen2d.xla import materialize

ON, BOUNCED, BEFORE = 1, 2, 4  # flags: touching after the last step, an impact in this frame, touching as it began


class ContactEvent(NamedTuple):
    """Record of a pair since the frame began, each [pairs, ...]."""

    time: Array  # s from frame 0, of the first touch; -1: none yet
    position: Array  # [2, ...] m
    normal: Array  # [2, ...]
    approach: Array  # m/s
    normal_impulse: Array  # N s
    tangent_impulse: Array  # N s
    flags: Array


def empty_events(shape: tuple[int, ...], dtype: jnp.dtype) -> ContactEvent:
    """Events of pairs that have not touched yet."""
    zero = jnp.zeros(shape, dtype)
    vector = jnp.zeros((2, *shape), dtype)
    return ContactEvent(zero - 1, vector, vector, zero, zero, zero, jnp.zeros(shape, jnp.int32))


MOST_OF_IT = 0.5  # a smaller share of the impulse is a difference of two large ones, without a direction


def _impulse_of_step(solved: SolvedPair, relaxed: SolvedPair) -> tuple[Array, Array, Array]:
    """Normal [2, ...], and normal and tangential impulse in N s, of a pair with one point in both passes.

    Discs move on between the passes, so the impulses act along two normals, and are added as vectors.
    """
    begin, end = solved.contacts[0].normal, relaxed.contacts[0].normal
    (first, slid), (last, slides) = solved.impulses[0], relaxed.impulses[0]
    pressed = first * begin + (last - first) * end
    friction = slid * perpendicular(begin) + (slides - slid) * perpendicular(end)
    if relaxed.vectors is not None:  # what passes along several normals have left of no impulse is no touch
        pressed, friction = (jnp.where((first > 0) | (last > 0), vector, 0.0) for vector in relaxed.vectors)
    squared = dot(pressed, pressed)
    has_direction = squared > (MOST_OF_IT * jnp.maximum(first, last)) ** 2
    length = jnp.sqrt(jnp.where(has_direction, squared, 1.0))
    normal = jnp.where(has_direction, pressed / length, begin)
    length, across = jnp.where(has_direction, length, last), perpendicular(normal)
    # After two bounces, friction has also acted along two tangents.
    twice = (solved.contacts[0].tau >= 0) & has_direction
    if relaxed.vectors is None:
        twice = twice & (last > first)
    tangent = jnp.where(twice, dot(across, friction), slides * (length * reciprocal(last, last > 0)))
    return normal, jnp.where(twice, length + dot(normal, friction), length), tangent


def record_event(event: ContactEvent, solved: SolvedPair, relaxed: SolvedPair, start: Array) -> ContactEvent:
    """Event after one more step, which began at `start`, from the pair after the first and the relaxing pass."""
    points = list(zip(solved.contacts, solved.impulses, relaxed.impulses, strict=True))
    touching = [(first.normal > 0) | (last.normal > 0) for _, first, last in points]
    contact, on = points[0][0]._replace(frame=None), touching[0]
    bounced = on & (contact.tau >= 0)
    if len(points) == 2:  # the second counts where the first does not touch
        second, other = touching[1] & ~on, points[1][0]._replace(frame=None)
        bounced = bounced | (touching[1] & (other.tau >= 0))
        contact, on = jax.tree.map(lambda x, y: jnp.where(second, y, x), contact, other), on | second
    if len(points) == 1:
        normal, *impulses = _impulse_of_step(solved, relaxed)
        contact = contact._replace(normal=normal)
    else:
        impulses = [sum(x[1:], x[0]) for x in zip(*relaxed.impulses, strict=True)]
    first = materialize(jnp.where(on & (event.time < 0), 1.0, 0.0)) > 0.5
    assert contact.position is not None, "logged contacts have positions"
    news = (start + jnp.maximum(contact.tau, 0.0), contact.position, contact.normal, contact.arrival)
    time, position, normal, approach = (jnp.where(first, new, old) for new, old in zip(news, event[:4], strict=True))
    return ContactEvent(
        time,
        position,
        normal,
        approach,
        event.normal_impulse + impulses[0],
        event.tangent_impulse + impulses[1],
        (event.flags & (BOUNCED | BEFORE)) | jnp.where(bounced, BOUNCED, jnp.where(on, ON, 0)).astype(jnp.int32),
    )


def next_frame_event(event: ContactEvent) -> ContactEvent:
    """Event of a pair as the next frame begins."""
    fresh = empty_events(event.time.shape, event.time.dtype)
    return fresh._replace(flags=jnp.where((event.flags & ON) > 0, ON | BEFORE, 0).astype(jnp.int32))


class PairEvent(NamedTuple):
    """Event of a pair in a frame, each [pairs, ...]; kind 0: none."""

    kind: Array
    time: Array  # s; -1: an end without a touch
    position: Array
    normal: Array
    approach: Array
    separation: Array
    normal_impulse: Array
    tangent_impulse: Array


def pair_event(event: ContactEvent, elasticity: Array) -> PairEvent:
    """Events of a frame. A bounce separates at e times its approach speed."""
    on, bounced, before = ((event.flags & flag) > 0 for flag in (ON, BOUNCED, BEFORE))
    kind = jnp.where(before, jnp.where(on, PERSIST, END), jnp.where(event.time >= 0, BEGIN, NO_CONTACT))
    separation = jnp.where(bounced, elasticity * event.approach, 0.0)
    return PairEvent(jnp.where(bounced, IMPACT, kind).astype(jnp.uint8), *event[:4], separation, *event[4:6])


def compact(frames: PairEvent, a: Array, b: Array, fps: float, slots: int) -> Contacts:
    """The first `slots` events of [T - 1, P, ...], in order of time.

    `a` and `b` [P, n] are the slots of the objects of each pair.
    """
    steps, pairs, scenes = frames.kind.shape
    rank = jnp.cumsum((frames.kind > 0).reshape(steps * pairs, scenes), axis=0, dtype=jnp.int32)
    wanted = jnp.arange(1, slots + 1)
    index = jax.vmap(lambda r: jnp.searchsorted(r, wanted), in_axes=1, out_axes=1)(rank)  # [C, n]
    count = rank[-1]
    filled, index = wanted[:, None] <= count, jnp.minimum(index, steps * pairs - 1)
    time = jnp.take_along_axis(frames.time.reshape(-1, scenes), index, axis=0)
    time = jnp.where(time >= 0, time, (index // pairs) / fps)  # an end without a touch: the start of the frame
    order = sort_order(jnp.where(filled, time, jnp.inf))
    time, index = (jnp.take_along_axis(x, order, axis=0) for x in (time, index))
    frame, pair = index // pairs, index % pairs

    def zero_unfilled(values: Array) -> Array:
        return jnp.where(filled, values, jnp.zeros_like(values))

    def gather(values: Array, axis: int = 0) -> Array:
        parts = values.size // (steps * pairs * scenes)  # 2 in a vector
        where = (frame * parts + axis) * pairs + pair
        return zero_unfilled(jnp.take_along_axis(values.reshape(-1, scenes), where, axis=0))

    def vector(values: Array) -> Array:
        return jnp.stack([gather(values, 0), gather(values, 1)])

    events = jax.tree.map(lambda x: vector(x) if x.ndim == 4 else gather(x), frames)._replace(time=zero_unfilled(time))
    number, first, second = frame.astype(jnp.int32) + 1, a[pair, 0], b[pair, 0]
    return contacts_of(events, zero_unfilled(number), zero_unfilled(first), zero_unfilled(second), count)


def contacts_of(event: PairEvent, frame: Array, a: Array, b: Array, count: Array) -> Contacts:
    """Stored contacts from events, frames and slots [C, n]."""
    return Contacts(
        time=event.time,
        frame=frame,
        a=a.astype(jnp.int16),
        b=b.astype(jnp.int16),
        point=event.position,
        normal=event.normal,
        normal_impulse=event.normal_impulse,
        tangent_impulse=event.tangent_impulse,
        approach_speed=event.approach,
        separation_speed=event.separation,
        kind=event.kind,
        count=count,
    )


def sort_order(time: Array) -> Array:
    """Indices [C, n] that sort times in ascending order; the sort is stable.

    An odd-even transposition sort takes as many passes as the largest distance of a row from its place, which is small,
    as frames come in order. A general sort takes twenty times as long on a CPU.
    """
    rows = jnp.arange(len(time), dtype=jnp.int32)[:, None]

    def exchange(state: tuple) -> tuple:
        time, order, turn, idle = state
        first, last = rows % 2 == turn % 2, len(rows) - 1
        later = first & (rows < last) & (time > jnp.roll(time, -1, axis=0))
        earlier = ~first & (rows > 0) & (jnp.roll(time, 1, axis=0) > time)
        time, order = (
            jnp.where(later, jnp.roll(x, -1, axis=0), jnp.where(earlier, jnp.roll(x, 1, axis=0), x))
            for x in (time, order)
        )
        return time, order, turn + 1, jnp.where(jnp.any(later), 0, idle + 1)

    start = time, jnp.broadcast_to(rows, time.shape), jnp.int32(0), jnp.int32(0)
    return jax.lax.while_loop(lambda state: state[3] < 2, exchange, start)[1]
