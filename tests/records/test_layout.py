"""Layouts: slots in the order of their groups, and depths in the order in which they are drawn."""

import numpy as np
import pytest

from gen2d.core.enums import STATIC
from gen2d.records.layout import JointSpec, Layout, SlotGroup

LAYOUT = Layout((
    SlotGroup("circle", 2),
    SlotGroup("segment", 3, STATIC),
    SlotGroup("capsule", 1, layer=-1),
    SlotGroup("polygon", 2, STATIC, layer=5),
))  # fmt: skip


def test_groups_fill_consecutive_slots() -> None:
    assert LAYOUT.slots == 8
    assert [first for _, first in LAYOUT.spans] == [0, 2, 5, 6]


def test_the_depth_of_a_slot_is_its_rank_in_the_drawing_order() -> None:
    """First the layer -1, then what is static, then what moves, then the layer 5; within a layer, slot by slot."""
    drawn = [5, 2, 3, 4, 0, 1, 6, 7]
    assert [first for _, first in LAYOUT.back_to_front] == [5, 2, 0, 6]
    assert np.argsort(LAYOUT.depths).tolist() == drawn
    assert LAYOUT.depths.tolist() == [drawn.index(slot) for slot in range(8)]


def test_a_joint_connects_two_slots_in_one_of_two_ways() -> None:
    with pytest.raises(AssertionError, match="'spring', but must be one of distance, revolute"):
        JointSpec("spring", 0, 1)
    for ends in ((0, 2), (1, 1), (-1, 0)):
        with pytest.raises(AssertionError, match="two of the layout's slots, 0 to 1"):
            Layout((SlotGroup("circle", 2),), joints=(JointSpec("distance", *ends),))
