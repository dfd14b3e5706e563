"""Rejection sampling of videos whose quality measures lie in the ranges that a config asks for.

A video outside of them is sampled again until it fits: its factors and positions come from another attempt's key; its
look, camera and combination on a grid stay. Attempts fill batches of the usual size, several for one video at once. The
first that fits is taken, so a video does not depend on the others in its batch.
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

FIELD = Field("int32", "n", "1", "attempts rejected, as they were outside the ranges that quality asks for")


class NoVideoError(UserError):
    """No attempt at a video lies in the ranges that were asked for."""


def attempt_keys(keys: Array, attempts: Array) -> Array:
    """Keys from which videos are sampled in their attempts [n]; in attempt 0 each video's own key."""

    def key_of(key: Array, attempt: Array) -> Array:
        data = jax.random.key_data
        other = jax.random.fold_in(key_for(key, "attempt"), attempt)
        return jax.random.wrap_key_data(jnp.where(attempt == 0, data(key), data(other)), impl="threefry2x32")

    return jax.vmap(key_of)(keys, attempts)


def accepted_batch(
    make: Callable[[np.ndarray, np.ndarray], Any], numbers: np.ndarray, options: Any
) -> tuple[Any, np.ndarray]:
    """A batch of videos that all lie in the ranges that were asked for, and the attempt of each.

    `make(rows, attempts)` returns these attempts at the videos in these rows: a batch with `columns`, whose arrays have
    the rows first. Raises NoVideoError where `options.attempts` are too few.
    """
    wanted, rows = ranges(options), np.arange(len(numbers))
    chosen = np.zeros(len(numbers), np.int64)
    batch = make(rows, chosen)
    pending, tried = rows[~_fits(batch, wanted)], 1
    while len(pending):
        if tried > options.attempts:
            asked = ", ".join(f"{name} from {low:g} to {high:g}" for name, (low, high) in wanted.items())
            raise NoVideoError(
                f"quality: none of {options.attempts} attempts at video {numbers[pending[0]]} has {asked}; ask for "
                "less, or for more quality.attempts"
            )
        each = min(len(rows) // len(pending), options.attempts)
        of, attempts = np.repeat(pending, each), tried + np.tile(np.arange(each), len(pending))
        fill = np.resize(np.arange(len(of)), len(rows))  # idle rows are padded with copies
        attempted = make(of[fill], attempts[fill])
        fits = (_fits(attempted, wanted)[: len(of)] & (attempts <= options.attempts)).reshape(len(pending), each)
        accepted, first = fits.any(axis=1), fits.argmax(axis=1)
        chosen[pending[accepted]] = tried + first[accepted]
        source = np.full(len(rows), -1)
        source[pending[accepted]] = (np.arange(len(pending)) * each + first)[accepted]
        batch = _replaced(batch, attempted, source)
        pending, tried = pending[~accepted], tried + each
    return batch, chosen


def _fits(batch: Any, wanted: Mapping[str, tuple[float, float]]) -> np.ndarray:
    values = {name: np.asarray(batch.columns[name]) for name in wanted}
    inside = [(values[name] >= low) & (values[name] <= high) for name, (low, high) in wanted.items()]
    return np.all([np.asarray(batch.placed), *inside], axis=0)


@jax.jit
def _replaced(old: Any, new: Any, source: Array) -> Any:
    """The old batch, with a row of the new one wherever `source` [n] names one."""
    replaced, row = source >= 0, jnp.maximum(source, 0)
    return jax.tree.map(lambda a, b: jnp.where(replaced.reshape(-1, *[1] * (a.ndim - 1)), b[row], a), old, new)
