"""Rows with checksums: a row counts at its own place alone, and only if a shard can have it."""

import numpy as np
import pytest
import synthetic

from gen2d.core.errors import DamagedError
from gen2d.dataset.rows import OVERHEAD, check_shard, intact, origin, seal_rows, shard_type

PLACES = range(0, 24, 8)


def test_a_row_counts_at_its_own_place_alone() -> None:
    begin = origin("a" * 64, "train")
    rows = seal_rows(np.zeros(3, shard_type(synthetic.FIELDS)), begin, PLACES)
    assert intact(rows, begin, PLACES).all()
    assert not intact(rows[[1, 2, 0]], begin, PLACES).any()
    assert not intact(rows, origin("a" * 64, "test"), PLACES).any()
    assert not intact(rows, origin("b" * 64, "train"), PLACES).any()


def test_a_flipped_bit_of_a_row_is_found() -> None:
    begin = origin("a" * 64, "train")
    whole = seal_rows(np.zeros(3, shard_type(synthetic.FIELDS)), begin, PLACES)
    for bit in range(8 * whole.dtype.itemsize):
        content = bytearray(whole.tobytes())
        content[whole.dtype.itemsize + bit // 8] ^= 1 << bit % 8
        assert intact(np.frombuffer(bytes(content), whole.dtype), begin, PLACES).tolist() == [True, False, True]


def test_a_row_that_no_shard_can_have_is_refused() -> None:
    """A file of 1,000 bytes with 4 videos: 10 bytes of index each, and values of 20 and 30 bytes in two fields."""
    kind = np.dtype([("first", "<u8"), ("count", "<u4"), ("bytes", "<u8"), ("index", "<u8"), ("offsets", "<u8", (2,))])

    def check(**changes: object) -> None:
        row = np.zeros((), kind)
        for name, value in (
            {"first": 8, "count": 4, "bytes": 1000, "index": 960, "offsets": (0, 80)} | changes
        ).items():
            row[name] = value
        check_shard(row, 8, 4, 10, (20, 30), 50)

    check()
    check(offsets=(920, 880))
    check(bytes=4 * 2 * 50 + OVERHEAD)
    with pytest.raises(DamagedError, match="must begin with video 8 and have 4"):
        check(first=0)
    with pytest.raises(DamagedError, match="must begin with video 8 and have 4"):
        check(count=3)
    for changes, end in (({"index": 961}, 1001), ({"offsets": (921, 0)}, 1001), ({"offsets": (0, 881)}, 1001)):
        with pytest.raises(DamagedError, match=f"a field ends at byte {end}, but the file has 1000 bytes"):
            check(**changes)
    with pytest.raises(DamagedError, match="more than 4 such videos can take"):
        check(bytes=4 * 2 * 50 + OVERHEAD + 1)
