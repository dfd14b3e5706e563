"""Where things start: at a share of the room there is for them, or at random places that do not overlap.

What overlaps is drawn again: the place only, never the size, which would bias it.
"""

from typing import Any

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array

TRIES = 100  # places tried for one object before all are placed anew
RESTARTS = 100  # after which the scene is given up
CLEARANCE = 1e-3  # m between objects at the start


def start_position(share: Array, low: Any, high: Any, way: Array, entry: float) -> Array:
    """Where on a line something starts that goes `way` m and shall then still be between `low` and `high` m: at this
    share, in [0, 1], of the places that are possible, from the lowest on.

    If it goes too far for any, it starts at this share of `entry` m from the end that it leaves.
    """
    lowest, highest = low - jnp.minimum(way, 0), high - jnp.maximum(way, 0)
    near = share * jnp.minimum(entry, high - low)
    return jnp.where(lowest < highest, lowest + share * (highest - lowest), jnp.where(way < 0, high - near, low + near))


def place(key: Array, radius: Array, present: Array, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Centres [K, 2] of discs that neither overlap nor leave the box, uniformly drawn one after the other.

    `radius` [K] m, `present` [K], the box from `low` [2] to `high` [2] m. Also returns how many draws were rejected,
    and whether all found a place. One draw an iteration, so that a batch of scenes costs what its slowest scene does.
    """
    slots = jnp.arange(radius.shape[0])

    def unfinished(carry: tuple) -> Array:
        slot, _, restarts, *_ = carry
        return (slot < radius.shape[0]) & (restarts < RESTARTS)

    def draw(carry: tuple) -> tuple:
        slot, tries, restarts, rejected, draws, places = carry
        reach = radius[slot]
        unit = jax.random.uniform(jax.random.fold_in(key, draws), (2,))
        centre = low + reach + unit * (high - low - 2 * reach)
        distance = jnp.linalg.norm(places - centre, axis=-1)
        clear = jnp.all((distance >= radius + reach + CLEARANCE) | ~present | (slots >= slot))
        fits = clear | ~present[slot]
        again = ~fits & (tries + 1 >= TRIES)
        return (
            jnp.where(again, 0, slot + fits),
            jnp.where(fits | again, 0, tries + 1),
            restarts + again,
            rejected + ~fits,
            draws + 1,
            jnp.where((slots == slot)[:, None] & fits, centre, places),
        )

    zero = jnp.int32(0)
    start = zero, zero, zero, zero, zero, jnp.zeros((radius.shape[0], 2))
    slot, _, _, rejected, _, places = jax.lax.while_loop(unfinished, draw, start)
    return jnp.where(present[:, None], places, 0.0), rejected, slot == radius.shape[0]
