"""How well a video can be foretold: how fast a small change of its start grows, by a derivative through the solver."""

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
        "float32", "n", "1/s", "log10 of what a small change of the start is multiplied by, over the video's seconds"
    )
}
SMALL = 1e-18  # of the change, so that it may grow by 10^56 before a float32 overflows; the derivative is linear in it


def lyapunov_exponent(
    keys: Array, scene: Scene, state: State, run: Callable[[Scene, State], Trajectory], seconds: float
) -> Array:
    """How fast a change of the start grows until the end, 1/s [n]; positive: tenfold in so many parts of a second.

    The change is of the places and velocities of all that is dynamic, in a direction drawn from each video's key. Its
    size is that of all its numbers together, with 1 m/s as large as 1 m: in (sum |dx|^2 + (1 s)^2 |dv|^2)^1/2 a change
    of speed counts as the way that it makes in a second. The unit of length is of no matter, as sizes are divided.
    Records and what `run` gives are in the device's layout.
    """
    change = perturbation(keys, scene, state)
    _, after = jax.jvp(lambda start: last_state(run(scene, start).states), (state,), (change,))
    most = jnp.finfo(jnp.float32).max  # what overflows has grown as much as can be told
    grown = jnp.clip(jnp.nan_to_num(perturbation_size(after), nan=most, posinf=most), SMALL * SMALL)
    moves = perturbation_size((change.position, change.velocity)) > 0
    return jnp.where(moves, jnp.log10(grown) - jnp.log10(SMALL), 0.0) / (seconds or 1.0)


def perturbation(keys: Array, scene: Scene, state: State) -> State:
    """A change of the size SMALL."""
    dynamic = scene.objects.present & (scene.objects.kind == DYNAMIC)
    drawn = jax.vmap(lambda key: jax.random.normal(key_for(key, "lyapunov"), (2, *state.position.shape[:2])))(keys)
    place, velocity = jnp.where(dynamic, jnp.moveaxis(drawn, 0, -1), 0.0)
    still = jnp.zeros_like(state.angle)
    way = State(place, still, velocity, still)
    whole = perturbation_size((place, velocity))
    return jax.tree.map(lambda x: SMALL * x / jnp.where(whole > 0, whole, 1.0), way)


def last_state(states: State) -> tuple[Array, Array]:
    """Place and velocity in the last frame."""
    return states.position[-1], states.velocity[-1]


def perturbation_size(change: tuple[Array, Array]) -> Array:
    """The size [n] of a change of places and velocities [2, K, n]; its square might leave a float32's range."""
    numbers = jnp.concatenate([part.reshape(-1, part.shape[-1]) for part in change])
    largest = jnp.abs(numbers).max(0)
    return largest * jnp.linalg.norm(numbers / jnp.where(largest > 0, largest, 1.0), axis=0)
