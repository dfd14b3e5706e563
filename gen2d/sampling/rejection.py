"""Videos of a certain kind: a config may ask for ranges of what they were like to make, and others are made instead.

A video that does not fit is sampled anew, as often as it takes: its factors and places come from another attempt's key,
its look, camera and combination on a grid stay. Attempts fill batches of the usual size, several of one video at once;
the first that fits is taken, so that a video does not depend on the others that are made with it.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.config.quality import ranges
from gen2d.core.errors import UserError
from gen2d.core.schema import Field
from gen2d.records.axes import Array
from gen2d.records.keys import key_for

FIELD = Field("int32", "n", "1", "scenes drawn again as they were not of the kind that was asked for")


class NoVideoError(UserError):
    """A video of which no attempt is of the kind that was asked for."""


def attempt_keys(keys: Array, attempts: Array) -> Array:
    """The keys that videos are sampled from at their attempts [n]; at the first, 0, their own."""

    def of_video(key: Array, attempt: Array) -> Array:
        data = jax.random.key_data
        other = jax.random.fold_in(key_for(key, "attempt"), attempt)
        return jax.random.wrap_key_data(jnp.where(attempt == 0, data(key), data(other)), impl="threefry2x32")

    return jax.vmap(of_video)(keys, attempts)


def accepted_batch(
    make: Callable[[np.ndarray, np.ndarray], Any], numbers: np.ndarray, options: Any
) -> tuple[Any, np.ndarray]:
    """A batch of videos that are all of the kind that is asked for, and which attempt each is.

    `make(rows, attempts)` makes those attempts of the videos in these rows, a batch with `columns` whose arrays have
    the rows first. Raises NoVideoError where `options.attempts` are too few.
    """
    wanted, rows = ranges(options), np.arange(len(numbers))
    chosen = np.zeros(len(numbers), np.int64)
    batch = make(rows, chosen)
    left, tried = rows[~_fits(batch, wanted)], 1
    while len(left):
        if tried > options.attempts:
            asked = ", ".join(f"{name} from {low:g} to {high:g}" for name, (low, high) in wanted.items())
            raise NoVideoError(
                f"quality: none of {options.attempts} attempts at video {numbers[left[0]]} has {asked}; ask for less, "
                "or for more quality.attempts"
            )
        each = min(len(rows) // len(left), options.attempts)
        of, attempts = np.repeat(left, each), tried + np.tile(np.arange(each), len(left))
        fill = np.resize(np.arange(len(of)), len(rows))  # a row left over repeats one for nothing
        made = make(of[fill], attempts[fill])
        fits = (_fits(made, wanted)[: len(of)] & (attempts <= options.attempts)).reshape(len(left), each)
        found, first = fits.any(axis=1), fits.argmax(axis=1)
        chosen[left[found]] = tried + first[found]
        source = np.full(len(rows), -1)
        source[left[found]] = (np.arange(len(left)) * each + first)[found]
        batch = _taken(batch, made, source)
        left, tried = left[~found], tried + each
    return batch, chosen


def _fits(batch: Any, wanted: Mapping[str, tuple[float, float]]) -> np.ndarray:
    values = {name: np.asarray(batch.columns[name]) for name in wanted}
    inside = [(values[name] >= low) & (values[name] <= high) for name, (low, high) in wanted.items()]
    return np.all([np.asarray(batch.placed), *inside], axis=0)


@jax.jit
def _taken(old: Any, new: Any, source: Array) -> Any:
    """The old batch, but where `source` [n] names a row of the new one."""
    here, row = source >= 0, jnp.maximum(source, 0)
    return jax.tree.map(lambda a, b: jnp.where(here.reshape(-1, *[1] * (a.ndim - 1)), b[row], a), old, new)
