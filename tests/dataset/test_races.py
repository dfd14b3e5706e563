"""Several processes on one folder: what one is about to do when another has just done it.

Where a test stops a process between two steps, the other one runs right there, in the same process and so without
locks: what holds then holds at a URL, too.
"""

import os
import shutil
import signal
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import synthetic
from crashes import every_crash
from numpy.testing import assert_array_equal
from synthetic import small

import gen2d
import gen2d.tools.verify as verification
from gen2d.core.errors import ConfigError, FolderError
from gen2d.dataset import folder, records, snapshots
from gen2d.dataset.folder import clean, open_folder
from gen2d.dataset.manifest import read_manifest
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.dataset.spec import DatasetSpec, Shard, plan
from gen2d.generation import complete as completion
from gen2d.generation.run import generate
from gen2d.storage import leases
from gen2d.storage.paths import Place, place
from gen2d.tools.verify import verify


def work(made: DatasetSpec, todo: list[Shard] | None = None) -> list[str]:
    """Makes what remains, and does not publish it; the shards' names."""
    todo = open_folder(made) if todo is None else todo
    with ShardWriter(made) as writer:
        for shard in todo:
            writer.write(shard, synthetic.blocks(made, shard))
    return [shard.name for shard in todo]


def run(made: DatasetSpec) -> list[str]:
    names = work(made)
    assert completion.complete(made)
    return names


def splits(root: Place) -> Mapping[str, int]:
    return dict(read_manifest(root).splits)


def one_run(tmp_path: Path, counts: Mapping[str, int]) -> Mapping[str, bytes]:
    return synthetic.tree(synthetic.folder(synthetic.make(small(tmp_path / "one", counts))))


@pytest.fixture
def without_locks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leases, "try_lock", lambda descriptor: None)
    monkeypatch.setattr(leases, "has_locks", lambda folder: False)


class Between:
    """Runs something once, right before or after a function is called."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.patch = patch

    def __call__(self, module: Any, name: str, action: Callable[[], Any], after: bool = False) -> None:
        real, left = getattr(module, name), [action]

        def called(*arguments: Any, **named: Any) -> Any:
            own = left.pop() if left else None
            if own and not after:
                own()
            result = real(*arguments, **named)
            if own and after:
                own()
            return result

        self.patch.setattr(module, name, called)


@pytest.fixture
def between(monkeypatch: pytest.MonkeyPatch) -> Between:
    return Between(monkeypatch)


@pytest.mark.usefixtures("without_locks")
@pytest.mark.parametrize("step", ["publish_changed", "check_current"])
def test_who_publishes_late_takes_nothing_back(tmp_path: Path, between: Between, step: str) -> None:
    root = tmp_path / "data"
    run(small(root, {"train": 12}))
    reader = gen2d.open(root, fields="*")
    late, early = small(root, {"train": 30}), small(root, {"train": 50})
    work(late)
    between(snapshots, step, lambda: run(early))
    assert completion.complete(late)
    assert splits(root) == {"train": 50}
    assert verify(root) == []
    assert len(reader[:]["index"]) == 12
    assert open_folder(early) == []


@pytest.mark.usefixtures("without_locks")
@pytest.mark.parametrize("late", ["train", "val"])
def test_splits_that_end_at_once_are_all_there(tmp_path: Path, between: Between, late: str) -> None:
    root = tmp_path / "data"
    own = {"train": small(root, {"train": 20}), "val": small(root, {"val": 5})}
    first, second = own[late], own["val" if late == "train" else "train"]
    for made in own.values():
        open_folder(made)
    work(first)
    between(completion, "read_records", lambda: run(second), after=True)
    assert completion.complete(first)
    assert splits(root) == {"train": 20, "val": 5}
    assert verify(root) == []


@pytest.mark.usefixtures("without_locks")
def test_a_split_that_the_other_did_not_see_is_published_after_it(tmp_path: Path, between: Between) -> None:
    root = tmp_path / "data"
    first, second = small(root, {"train": 20}), small(root, {"val": 5})
    for made in (first, second):
        open_folder(made)
    work(first)

    def publish() -> None:
        """As if the other had looked at the records before these were there."""
        logs = {path: path.read_bytes() for path in (root / ".gen2d" / "records").iterdir()}
        for path in logs:
            path.unlink()
        run(second)
        for path, content in logs.items():
            path.write_bytes(content)

    between(completion, "read_records", publish, after=True)
    assert completion.complete(first)
    assert splits(root) == {"train": 20, "val": 5}
    assert verify(root) == []


def _forked(action: Callable[[], Any]) -> int:
    """The number of a process that does this, and ends with 0, or with 2 where it is refused."""
    process = os.fork()
    if process:
        return process
    try:
        action()
    except FolderError:
        os._exit(2)
    except BaseException:
        os._exit(1)
    os._exit(0)


def _codes(processes: list[int]) -> list[int]:
    return [os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in processes]


def test_processes_that_begin_and_end_together(tmp_path: Path) -> None:
    """Another split each, and another recipe each: of the latter one wins, and the other is refused."""
    for number in range(10):
        root, other = tmp_path / f"{number}", tmp_path / f"{number}-other"
        parts = [small(root, {"train": 16}), small(root, {"val": 16})]
        assert _codes([_forked(lambda made=made: run(made)) for made in parts]) == [0, 0]
        assert splits(root) == {"train": 16, "val": 16}
        recipes = [small(other, {"train": 16}, seed=seed) for seed in (1, 2)]
        assert sorted(_codes([_forked(lambda made=made: run(made)) for made in recipes])) == [0, 2]
        assert verify(root) == verify(other) == []


def test_one_process_at_a_time_publishes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "data"
    made = small(root, {"train": 12})
    work(made)
    monkeypatch.setattr(folder, "LOCK_SECONDS", 0.1)
    with folder.folder_lock(root):
        for action in (lambda: completion.complete(made), lambda: open_folder(made)):
            with pytest.raises(FolderError, match="is being changed by another process: try again"):
                action()
    assert completion.complete(made)
    with folder.folder_lock(root), pytest.raises(FolderError, match="is being changed by another process: try again"):
        clean(root)


@pytest.mark.parametrize("harm", ["a row", "a table", "the manifest"])
@pytest.mark.parametrize("asked", [{"val": 5}, {"train": 12}])
def test_damage_does_not_make_a_dataset_smaller(tmp_path: Path, harm: str, asked: Mapping[str, int]) -> None:
    root = tmp_path / "data"
    run(small(root, {"train": 30}))
    table, manifest = root / "index" / "train-30.npy", root / "manifest.json"
    if harm == "a table":
        table.unlink()
    else:
        path, at = (table, -100) if harm == "a row" else (manifest, 400)
        content = bytearray(path.read_bytes())
        content[at] ^= 4
        path.write_bytes(content)
    run(small(root, asked))
    assert splits(root) == {"train": 30, **{split: count for split, count in asked.items() if split != "train"}}
    assert verify(root) == []
    assert synthetic.tree(root) == one_run(tmp_path, splits(root))


def test_sizes_of_shards_that_appear_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A temporary file gets its name between the listing of the folder and the look at the file."""
    root = tmp_path / "data"
    run(small(root, {"train": 16}))
    temporary = root / "shards" / f"train-00020.h5.tmp.{'0' * 16}"
    temporary.touch()

    class Listing:
        def __init__(self, path: Path) -> None:
            self.entries = real(path)

        def __enter__(self) -> "Listing":
            return self

        def __exit__(self, *_: object) -> None:
            self.entries.close()

        def __iter__(self) -> Any:
            for entry in self.entries:
                Path(entry.path).unlink() if ".tmp." in entry.name else None
                yield entry

    real = os.scandir
    monkeypatch.setattr(folder.os, "scandir", Listing)
    assert folder.Sizes(root).known == {
        name: (root / "shards" / name).stat().st_size for name in ("train-00000.h5", "train-00001.h5")
    }


@pytest.mark.usefixtures("without_locks")
def test_a_late_worker_leaves_the_snapshot_of_readers(tmp_path: Path, between: Between) -> None:
    root = tmp_path / "data"
    run(small(root, {"train": 12}))
    reader = gen2d.open(root, fields="*")
    growth = small(root, {"train": 30})
    todo = open_folder(growth)
    work(growth, todo[:-1])

    def end() -> None:
        work(growth, todo[-1:])
        assert completion.complete(growth)

    between(folder, "Sizes", end, after=True)  # what is known of the records is old by now
    open_folder(growth)
    assert len(reader[:]["index"]) == 12
    assert len(gen2d.open(root, fields="*", snapshot=reader.snapshot)) == 12


@pytest.mark.parametrize("order", [1, -1])
def test_splits_that_grow_from_one_snapshot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: int) -> None:
    """Readers of the snapshot before, and of the one before that, both read on."""
    root = tmp_path / "data"
    run(small(root, {"train": 12}))
    first = gen2d.open(root, "train", fields="*")
    val, train = small(root, {"val": 5}), small(root, {"train": 30})
    open_folder(val)
    open_folder(train)
    work(val, plan({"val": 5}, 8))
    assert completion.complete(val)
    second = gen2d.open(root, "train", fields="*")
    work(train, plan({"train": 30}, 8)[1:])
    entries = snapshots.list_folder
    monkeypatch.setattr(snapshots, "list_folder", lambda path: entries(path)[::order])
    assert completion.complete(train)
    assert splits(root) == {"train": 30, "val": 5}
    for reader in (first, second):
        assert len(reader[:]["index"]) == 12


def test_a_newer_version_keeps_the_snapshot(tmp_path: Path) -> None:
    """The same videos again, by a version of the program that makes the same bits."""
    root = tmp_path / "data"
    run(small(root, {"train": 12}))
    before = synthetic.tree(root)
    reader = gen2d.open(root, fields="*")
    loader = gen2d.DataLoader(reader, 4)
    next(iter(loader))
    newer = {"producer": {"gen2d": "1", "fingerprint": {"jaxlib": "0", "batch_size": 8}}}
    assert run(small(root, {"train": 12}, **newer)) == []
    assert synthetic.tree(root) == before
    gen2d.DataLoader(gen2d.open(root, fields="*"), 4).load_state_dict(loader.state_dict())
    (root / "sheet.png").write_bytes(b"")
    assert run(small(root, {"train": 12}, **newer)) == []  # and mends what it can
    assert synthetic.tree(root) == before
    run(small(root, {"train": 30}, **newer))
    assert read_manifest(root).producer["gen2d"] == "1"
    assert len(reader[:]["index"]) == 12


def test_a_lost_shard_costs_readers_nothing(tmp_path: Path) -> None:
    root = tmp_path / "data"
    run(small(root, {"train": 12}))
    reader = gen2d.open(root, fields="*")
    run(small(root, {"train": 30}))
    (root / "shards" / "train-00003-n6.h5").unlink()
    assert run(small(root, {"train": 30})) == ["train-00003-n6"]
    assert len(reader[:]["index"]) == 12


@pytest.mark.parametrize("step", ["_check_tables", "_check_sizes", "_ShardChecker"])
def test_verify_while_a_dataset_grows(tmp_path: Path, between: Between, step: str) -> None:
    root = tmp_path / "data"
    run(small(root, {"train": 12}))
    growth = small(root, {"train": 30})
    work(growth)
    between(verification, step, lambda: completion.complete(growth))
    assert verify(root) == []
    assert splits(root) == {"train": 30}


def test_overwriting_is_for_one_process(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^overwrite and worker cannot go together"):
        generate("bouncing.yaml", 8, tmp_path, worker=(0, 2), overwrite=True)


@pytest.mark.parametrize("where", ["memory://overwritten", "disk"])
def test_killed_while_it_overwrites(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    root = place(where) if "://" in where else tmp_path / "data"
    run(small(root, {"train": 12}))
    real, left = folder.remove_tree, [3]

    def dying(path: Place) -> None:
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt
        real(path)

    monkeypatch.setattr(folder, "remove_tree", dying)
    other = small(root, {"train": 12}, seed=8)
    with pytest.raises(KeyboardInterrupt):
        open_folder(other, overwrite=True)
    with pytest.raises(FolderError, match="holds another dataset"):
        open_folder(other)
    assert len(open_folder(other, overwrite=True)) == 2


def test_a_log_that_grows_while_it_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a URL a finisher may remove a log that another worker writes: it comes back when that one ends."""
    root = place("memory://grows/data")
    first, second = small(root, {"train": 16}), small(root, {"train": 24})
    open_folder(second)
    shards, writer = plan({"train": 24}, 8), ShardWriter(second)
    for shard in shards[:2]:
        writer.write(shard, synthetic.blocks(second, shard))
    real, left = records.read_bytes, [2]  # the first time the finisher looks what is done

    def read(path: Place, limit: int) -> bytes:
        content = real(path, limit)
        if "records" in f"{path}":
            left[0] -= 1
            if not left[0]:
                writer.write(shards[2], synthetic.blocks(second, shards[2]))
        return content

    monkeypatch.setattr(records, "read_bytes", read)
    assert completion.complete(first)
    assert splits(root) == {"train": 16}
    writer.close()
    assert open_folder(second) == []
    assert completion.complete(second)
    assert splits(root) == {"train": 24}


def test_a_fork_while_a_thread_reads(tmp_path: Path) -> None:
    """The thread's lock is held in the child, where nobody gives it back."""
    from gen2d.loading import chunks

    root = tmp_path / "data"
    run(small(root, {"train": 12}))
    ds = gen2d.open(root, fields="*")
    held, go = threading.Event(), threading.Event()

    def hold() -> None:
        with chunks._lock:
            held.set()
            go.wait()

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait()
    process = os.fork()
    if not process:
        signal.alarm(10)
        ds[0]
        os._exit(0)
    assert _codes([process]) == [0]
    go.set()
    thread.join()


@pytest.mark.full
def test_nothing_is_left_of_a_growth_that_crashed(tmp_path: Path) -> None:
    """After a crash another number of videos is asked for than before, or only `clean` is called."""
    root, base = tmp_path / "data", tmp_path / "base"
    synthetic.make(small(base, {"train": 12}))
    expected = one_run(tmp_path, {"train": 50})
    videos = gen2d.open(base, fields="*")[:]

    def restored() -> None:
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(base, root)

    restored()
    for crash in every_crash(lambda: run(small(root, {"train": 30}))):
        reader = gen2d.open(root, fields="*")
        if crash % 2:
            clean(root)
            reader = gen2d.open(root, fields="*")
        else:
            assert_array_equal(reader[:12]["frames"], videos["frames"])
        run(small(root, {"train": 50}))
        assert len(reader[:]["index"]) == len(reader)
        assert synthetic.tree(root) == expected, crash
        restored()


def test_clean_removes_what_nothing_names(tmp_path: Path) -> None:
    root = tmp_path / "data"
    run(small(root, {"train": 12}))
    before = synthetic.tree(root)
    made = small(root, {"train": 30})
    todo = open_folder(made)
    work(made, todo[:1])  # recorded: it stays
    content = (root / "shards" / f"{todo[0].name}.h5").read_bytes()
    (root / "shards" / f"{todo[1].name}.h5").write_bytes(b"killed before its row")
    assert clean(root) == [f"shards/{todo[1].name}.h5"]
    assert synthetic.tree(root) == {**before, f"shards/{todo[0].name}.h5": content}
