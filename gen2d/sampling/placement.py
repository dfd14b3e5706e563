"""Start positions: at a given fraction of the possible interval, or random without overlap.

If objects overlap, only the position is sampled again, because sampling sizes again would bias them.
"""

from typing import Any

import jax
import jax.numpy as jnp

from gen2d.records.axes import Array

TRIES = 100  # positions tried for one object before all objects are placed anew
RESTARTS = 100  # of all objects before the scene is abandoned
CLEARANCE = 1e-3  # m between objects at the start


def start_position(fraction: Array, low: Any, high: Any, displacement: Array, entry_distance: float) -> Array:
    """Start from which an object that moves by `displacement` m stays between `low` and `high` m.

    The start lies at `fraction`, in [0, 1], of the interval of possible starts. If there are none, it lies at this
    fraction of `entry_distance` m from the end that the object comes from.
    """
    lowest, highest = low - jnp.minimum(displacement, 0), high - jnp.maximum(displacement, 0)
    near = fraction * jnp.minimum(entry_distance, high - low)
    entering = jnp.where(displacement < 0, high - near, low + near)
    return jnp.where(lowest < highest, lowest + fraction * (highest - lowest), entering)


def place(key: Array, radius: Array, present: Array, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Centres [K, 2] m of discs in a box without overlap, sampled uniformly one after the other.

    `radius` [K] is in m, and the box extends from `low` [2] to `high` [2] m. Also returns the number of rejected
    positions, and whether all discs with `present` [K] could be placed. Each iteration samples one position, so a batch
    takes as long as its slowest scene.
    """
    slots = jnp.arange(radius.shape[0])

    def unfinished(carry: tuple[Any, ...]) -> Array:
        slot, _, restarts, *_ = carry
        return (slot < radius.shape[0]) & (restarts < RESTARTS)

    def draw(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        slot, tries, restarts, rejected, draws, positions = carry
        reach = radius[slot]
        unit = jax.random.uniform(jax.random.fold_in(key, draws), (2,))
        centre = low + reach + unit * (high - low - 2 * reach)
        distance = jnp.linalg.norm(positions - centre, axis=-1)
        clear = jnp.all((distance >= radius + reach + CLEARANCE) | ~present | (slots >= slot))
        fits = clear | ~present[slot]
        restart = ~fits & (tries + 1 >= TRIES)
        return (
            jnp.where(restart, 0, slot + fits),
            jnp.where(fits | restart, 0, tries + 1),
            restarts + restart,
            rejected + ~fits,
            draws + 1,
            jnp.where((slots == slot)[:, None] & fits, centre, positions),
        )

    zero = jnp.int32(0)
    start = zero, zero, zero, zero, zero, jnp.zeros((radius.shape[0], 2))
    slot, _, _, rejected, _, positions = jax.lax.while_loop(unfinished, draw, start)
    return jnp.where(present[:, None], positions, 0.0), rejected, slot == radius.shape[0]
