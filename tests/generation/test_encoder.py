"""Encoding in threads: blocks come in the order of the videos, and values that are not finite are an error."""

import time
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic

from gen2d.dataset.spec import plan
from gen2d.generation.encoder import Encoder, NotFiniteError, shard_ranges


class Source:
    """Videos of a dataset, one at a time, in another order; those with lower numbers take longer."""

    def __init__(self, spec: Any, order: Sequence[int], changes: dict[int, Any] | None = None) -> None:
        self.spec, self.order, self.changes = spec, order, changes or {}
        self.rollout = SimpleNamespace(devices=[0])

    def slices(self, ranges: Sequence[Any]) -> Iterator[Any]:
        for number in self.order:
            part = SimpleNamespace(order=number, range=ranges[number // 8], numbers=np.array([number]))
            yield SimpleNamespace(part=part, fields=lambda number=number: self._fields(number))

    def _fields(self, number: int) -> dict[str, np.ndarray]:
        time.sleep(0.005 * (12 - number))
        fields = synthetic.columns(self.spec, plan(self.spec.splits, 8)[number // 8], range(number % 8, number % 8 + 1))
        for name, index, value in self.changes.get(number, ()):
            fields[name][index] = value
        return fields


def encoder(tmp_path: Any, *arguments: Any) -> Encoder:
    spec = synthetic.dataset(tmp_path, splits={"train": 12})
    return Encoder(Source(spec, *arguments), spec, 3)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("order", [range(12), [3, 0, 1, 2, 7, 4, 6, 5, 11, 10, 9, 8]])
def test_blocks_come_in_the_order_of_the_videos(tmp_path: Any, order: Sequence[int]) -> None:
    made, called = encoder(tmp_path, order), []
    shards = plan(made.dataset.splits, 8)
    found = [
        (tag, block.arrays["index"].tolist())
        for tag, block in made.blocks(shard_ranges(shards), lambda: called.append(1))
    ]
    assert found == [(shards[number // 8], [number]) for number in range(12)]
    assert called == [1]
    made.close()


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("component", [0, 1])
def test_values_that_are_not_finite_are_an_error_that_names_the_video(
    tmp_path: Any, value: float, component: int
) -> None:
    made = encoder(tmp_path, range(12), {9: [("states/position", (0, 3, 0, component), value)]})
    with pytest.raises(NotFiniteError, match="states/position of video 9 is not finite"):
        list(made.blocks(shard_ranges(plan(made.dataset.splits, 8))))
    made.close()
