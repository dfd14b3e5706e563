"""Shards written in threads: what fails is raised, and what is abandoned leaves nothing; a run has room on its disk."""

import errno
import os
import time
from pathlib import Path
from typing import Any

import pytest
import synthetic

from gen2d.core.errors import FolderError
from gen2d.dataset import folder, hdf5
from gen2d.dataset.folder import open_folder
from gen2d.dataset.hdf5 import Offsets
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.generation.complete import complete
from gen2d.generation.warm_up import check_disk
from gen2d.generation.writers import ShardWriters


def test_shards_are_whole_when_the_writers_have_finished(tmp_path: Path) -> None:
    made = synthetic.dataset(tmp_path)
    with ShardWriter(made) as writer:
        writers = ShardWriters(writer)
        for shard in open_folder(made):
            for block in synthetic.blocks(made, shard):
                writers.put(shard, block)
        writers.finish()
    assert complete(made)


@pytest.mark.parametrize("place", [0, -1])
def test_an_error_in_a_thread_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: int) -> None:
    made = synthetic.dataset(tmp_path)
    todo = open_folder(made)
    write = hdf5.write

    def failing(path: Path, *arguments: Any) -> Offsets:
        if todo[place].name in path.name:
            time.sleep(0.2)  # until the others wait for it
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return write(path, *arguments)

    monkeypatch.setattr(hdf5, "write", failing)

    def write_all(writers: ShardWriters) -> None:
        for shard in todo:
            for block in synthetic.blocks(made, shard):
                writers.put(shard, block)
        writers.finish()

    with ShardWriter(made) as writer:
        writers = ShardWriters(writer)
        with pytest.raises(FolderError, match="the disk or its network fails"):
            write_all(writers)
        writers.abort()
    assert todo[place] in open_folder(made)


def test_an_abandoned_shard_leaves_nothing_and_those_before_it_are_whole(tmp_path: Path) -> None:
    made = synthetic.dataset(tmp_path)
    todo = open_folder(made)
    with ShardWriter(made) as writer:
        writers = ShardWriters(writer)
        for block in synthetic.blocks(made, todo[0]):
            writers.put(todo[0], block)
        for block in synthetic.blocks(made, todo[1]):
            writers.put(todo[1], block)
        writers.abort()
    assert [path.name for path in (tmp_path / "shards").iterdir()] == [f"{todo[0].name}.h5"]
    assert open_folder(made) == todo[1:]


def test_a_disk_that_cannot_hold_the_run_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder, "free_bytes", lambda root: 1000)
    check_disk(tmp_path, 1000)
    with pytest.raises(FolderError, match=r"would need about 1\.0 kB, but its disk has 1\.0 kB free; ask for"):
        check_disk(tmp_path, 1001)
