"""Rejection sampling of videos whose quality measures lie in the ranges of a config.

A video outside of them is sampled again: factors and positions come from the key of another attempt, while look, camera
and grid combination stay. Attempts fill batches of the usual size, several for one video at once. The first attempt
that fits is accepted, so a video does not depend on the others in its batch.
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
from gen2d.records.keys import key_for, unwrapped, wrapped

FIELD = Field("int32", "n", "1", "number of rejected attempts, which lay outside the ranges of the section quality")


class NoVideoError(UserError):
    """No attempt at a video lies in the required ranges."""


def attempt_keys(keys: Array, attempts: Array) -> Array:
    """Keys of these attempts [n] at videos with these keys [n]; attempt 0 has the video's own key."""

    def key_of(key: Array, attempt: Array) -> Array:
        other = jax.random.fold_in(key_for(key, "attempt"), attempt)
        return wrapped(jnp.where(attempt == 0, unwrapped(key), unwrapped(other)))

    return jax.vmap(key_of)(keys, attempts)


def accepted_batch(
    make: Callable[[np.ndarray, np.ndarray], Any], numbers: np.ndarray, options: Any
) -> tuple[Any, np.ndarray]:
    """Batch of videos that all lie in the required ranges, and the accepted attempt of each [n].

    `make(rows, attempts)` returns a batch with these attempts at the videos in these rows; its `columns` have the rows
    first. Raises NoVideoError if a video has no accepted attempt among `options.attempts`.
    """
    limits, rows = ranges(options), np.arange(len(numbers))
    chosen = np.zeros(len(numbers), np.int64)
    batch = make(rows, chosen)
    pending, tried = rows[~_fits(batch, limits)], 1
    while len(pending):
        if tried > options.attempts:
            required = ", ".join(f"{name} from {low:g} to {high:g}" for name, (low, high) in limits.items())
            raise NoVideoError(
                f"quality: none of {options.attempts} attempts at video {numbers[pending[0]]} has {required}; ask for "
                "less, or for more quality.attempts"
            )
        per_video = min(len(rows) // len(pending), options.attempts)
        videos, attempts = np.repeat(pending, per_video), tried + np.tile(np.arange(per_video), len(pending))
        fill = np.resize(np.arange(len(videos)), len(rows))  # idle rows are padded with copies
        attempted = make(videos[fill], attempts[fill])
        fits = (_fits(attempted, limits)[: len(videos)] & (attempts <= options.attempts)).reshape(
            len(pending), per_video
        )
        accepted, first = fits.any(axis=1), fits.argmax(axis=1)
        chosen[pending[accepted]] = tried + first[accepted]
        source = np.full(len(rows), -1)
        source[pending[accepted]] = (np.arange(len(pending)) * per_video + first)[accepted]
        batch = _replace_rows(batch, attempted, source)
        pending, tried = pending[~accepted], tried + per_video
    return batch, chosen


def _fits(batch: Any, wanted: Mapping[str, tuple[float, float]]) -> np.ndarray:
    values = {name: np.asarray(batch.columns[name]) for name in wanted}
    inside = [(values[name] >= low) & (values[name] <= high) for name, (low, high) in wanted.items()]
    return np.all([np.asarray(batch.placed), *inside], axis=0)


@jax.jit
def _replace_rows(old: Any, new: Any, source: Array) -> Any:
    """The old batch, with rows of the new one where `source` [n] is their index and not -1."""
    replaced, row = source >= 0, jnp.maximum(source, 0)
    return jax.tree.map(lambda a, b: jnp.where(replaced.reshape(-1, *[1] * (a.ndim - 1)), b[row], a), old, new)
