"""Finite-time Lyapunov exponent of a video, by a forward derivative through the solver."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from gen2d.core.enums import DYNAMIC
from gen2d.core.schema import Field
from gen2d.records.axes import Array
from gen2d.records.keys import key_for
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Trajectory

FIELDS = {
    "quality/lyapunov": Field(
        "float32",
        "n",
        "1/s",
        "growth rate of a small perturbation of the initial state: log10 of its growth, over the duration of the video",
    )
}
SMALL = 1e-18  # size of the perturbation, which may grow by 10^56 in a float32; the derivative is linear in it


def lyapunov_exponent(
    keys: Array, scene: Scene, state: State, run: Callable[[Scene, State], Trajectory], seconds: float
) -> Array:
    """Growth rate [n] of a perturbation of the start until the end, as log10 per second.

    It perturbs the positions and velocities of all dynamic bodies in a direction drawn from each video's key. The size
    of a perturbation is (sum |dx|^2 + (1 s)^2 |dv|^2)^1/2, so 1 m/s counts as 1 m; the unit of length cancels. Records
    and the trajectory of `run` are in the device layout.
    """
    change = perturbation(keys, scene, state)
    _, after = jax.jvp(lambda start: last_state(run(scene, start).states), (state,), (change,))
    most = jnp.finfo(state.angle.dtype).max  # an overflow counts as the largest growth
    size = jnp.clip(jnp.nan_to_num(perturbation_size(after), nan=most, posinf=most), SMALL * SMALL)
    moves = perturbation_size((change.position, change.velocity)) > 0
    return jnp.where(moves, jnp.log10(size) - jnp.log10(SMALL), 0.0) / (seconds or 1.0)


def perturbation(keys: Array, scene: Scene, state: State) -> State:
    """Random perturbation of the size SMALL."""
    dynamic = scene.objects.present & (scene.objects.kind == DYNAMIC)
    shape = 2, *state.position.shape[:2]
    normal = jax.vmap(lambda key: jax.random.normal(key_for(key, "lyapunov"), shape, jnp.float32))(keys)
    position, velocity = jnp.where(dynamic, jnp.moveaxis(normal, 0, -1), 0.0).astype(state.angle.dtype)
    zero = jnp.zeros_like(state.angle)
    change = State(position, zero, velocity, zero)
    size = perturbation_size((position, velocity))
    return jax.tree.map(lambda x: SMALL * x / jnp.where(size > 0, size, 1.0), change)


def last_state(states: State) -> tuple[Array, Array]:
    """Position and velocity in the last frame."""
    return states.position[-1], states.velocity[-1]


def perturbation_size(change: tuple[Array, Array]) -> Array:
    """Size [n] of a perturbation of positions and velocities [2, K, n], scaled so that no square overflows."""
    numbers = jnp.concatenate([part.reshape(-1, part.shape[-1]) for part in change])
    largest = jnp.abs(numbers).max(0)
    return largest * jnp.linalg.norm(numbers / jnp.where(largest > 0, largest, 1.0), axis=0)
