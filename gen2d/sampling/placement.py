"""Start positions: at a given fraction of the room there is, or at random without overlap.

Where objects overlap, the position alone is drawn again; drawing sizes again would bias them.
"""

from typing import Any

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array

TRIES = 100  # positions tried for one object before all objects are placed anew
RESTARTS = 100  # of all objects, before the scene is given up
CLEARANCE = 1e-3  # m between objects at the start


def start_position(fraction: Array, low: Any, high: Any, displacement: Array, entry_distance: float) -> Array:
    """Start on a line from which an object moves by `displacement` m and stays between `low` and `high` m.

    It lies at `fraction`, in [0, 1], of the interval of possible starts. Where there are none, it lies within
    `entry_distance` m of the end that the object comes from, at this fraction of that distance.
    """
    lowest, highest = low - jnp.minimum(displacement, 0), high - jnp.maximum(displacement, 0)
    near = fraction * jnp.minimum(entry_distance, high - low)
    entering = jnp.where(displacement < 0, high - near, low + near)
    return jnp.where(lowest < highest, lowest + fraction * (highest - lowest), entering)


def place(key: Array, radius: Array, present: Array, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Centres [K, 2] of discs that neither overlap nor leave a box, drawn uniformly one after the other.

    `radius` [K] m, `present` [K], the box from `low` [2] to `high` [2] m. Also returns the number of rejected draws,
    and whether all discs were placed. Each iteration makes one draw, so a batch costs what its slowest scene does.
    """
    slots = jnp.arange(radius.shape[0])

    def unfinished(carry: tuple) -> Array:
        slot, _, restarts, *_ = carry
        return (slot < radius.shape[0]) & (restarts < RESTARTS)

    def draw(carry: tuple) -> tuple:
        slot, tries, restarts, rejected, draws, positions = carry
        reach = radius[slot]
        unit = jax.random.uniform(jax.random.fold_in(key, draws), (2,))
        centre = low + reach + unit * (high - low - 2 * reach)
        distance = jnp.linalg.norm(positions - centre, axis=-1)
        clear = jnp.all((distance >= radius + reach + CLEARANCE) | ~present | (slots >= slot))
        fits = clear | ~present[slot]
        again = ~fits & (tries + 1 >= TRIES)
        return (
            jnp.where(again, 0, slot + fits),
            jnp.where(fits | again, 0, tries + 1),
            restarts + again,
            rejected + ~fits,
            draws + 1,
            jnp.where((slots == slot)[:, None] & fits, centre, positions),
        )

    zero = jnp.int32(0)
    start = zero, zero, zero, zero, zero, jnp.zeros((radius.shape[0], 2))
    slot, _, _, rejected, _, positions = jax.lax.while_loop(unfinished, draw, start)
    return jnp.where(present[:, None], positions, 0.0), rejected, slot == radius.shape[0]
