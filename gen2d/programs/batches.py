"""Slices of batches, and the checks of what they hold."""

import numpy as np

from gen2d.config.plugin_options import Plugin
from gen2d.core.errors import UserError
from gen2d.dataset.spec import Shard
from gen2d.programs.rollout import DeviceBatch, Rollout, per_device

ShardSlice = tuple[Shard, int, int]  # a shard's videos among those of a batch: rows from the first to before the second


class NoPlaceError(UserError):
    """A scene in which the objects do not fit."""


def check_block_placed(rollout: Rollout, batch: DeviceBatch, firsts: list[int], pieces: list[list[ShardSlice]]) -> None:
    for first, own, placed in zip(firsts, pieces, per_device(batch.placed), strict=True):
        for _, start, stop in own:
            check_placed(rollout.config.scene, placed[start:stop], np.arange(first + start, first + stop))


def check_placed(scene: Plugin, placed: np.ndarray, numbers: np.ndarray) -> None:
    """Returns nothing; raises NoPlaceError if the scene of one of the videos with these numbers did not fit."""
    if not placed.all():
        options = [f"scene.{name}" for name in scene.contract.crowded_by]
        cause = f": it depends on {', '.join(options)}" if options else ""
        raise NoPlaceError(
            f"scene: video {numbers[np.argmin(placed)]} could not be placed without overlap in 100 attempts{cause}; "
            "ask for fewer or smaller objects, or for more room"
        )
