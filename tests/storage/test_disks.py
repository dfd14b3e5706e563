"""Disks that are full, fail, or go away, and machines that stop: nothing that was written is lost, and what is said is
true."""

import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import synthetic
import tiny
from packages import not_run

import gen2d
from gen2d.core.errors import DamagedError, Error, FolderError, UnreachableError, UserError
from gen2d.dataset.folder import open_folder
from gen2d.generation.complete import complete
from gen2d.loading import chunks
from gen2d.storage import explain, leases
from gen2d.storage.atomic import publishing_folder
from gen2d.storage.leases import lease, temporary_name
from gen2d.tools.verify import verify

TESTS = Path(synthetic.__file__).parent


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    return synthetic.folder(synthetic.make(synthetic.dataset(tmp_path / "toy", train=3)))


# ---- Reading


@pytest.mark.parametrize(
    ("code", "expected", "said"),
    [
        (errno.EIO, UnreachableError, "the disk or its network fails"),
        (errno.ESTALE, UnreachableError, "the disk or its network fails"),
        (errno.EMFILE, UserError, "too many files are open"),
        (errno.ENFILE, UserError, "too many files are open"),
        (errno.EACCES, FolderError, "permission denied"),
        (errno.ENOMEM, UserError, "no memory left"),
        (errno.ELOOP, DamagedError, "not a regular file"),
        (errno.ENOENT, DamagedError, "is missing"),
    ],
    ids=lambda value: errno.errorcode.get(value, "") if isinstance(value, int) else "",
)
def test_a_file_that_cannot_be_read_is_damaged_only_if_it_is(
    toy: Path, monkeypatch: pytest.MonkeyPatch, code: int, expected: type[Error], said: str
) -> None:
    real = os.open

    def failing(path: Any, *arguments: Any, **named: Any) -> int:
        if str(path).endswith(".h5"):
            raise OSError(code, os.strerror(code), str(path))
        return real(path, *arguments, **named)

    ds = gen2d.open(toy)
    monkeypatch.setattr(os, "open", failing)
    monkeypatch.setattr(chunks, "_files", chunks.OrderedDict())
    with pytest.raises(expected, match=said) as caught:
        ds[0]
    assert type(caught.value) is expected
    if expected is UserError:  # not even the check calls it damaged
        with pytest.raises(UserError, match=said):
            verify(toy)
    monkeypatch.undo()
    assert ds[0].keys() == ds.fields.keys()


FEW = """
import resource, sys
sys.path.insert(0, sys.argv[1])
import gen2d
ds = gen2d.open(sys.argv[2], fields="index")
ds[0]
resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[3]), 100))
print(ds[:]["index"].tolist() == list(range(len(ds))))
"""


def test_few_descriptors_are_enough_or_said(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path, train=60, videos_per_shard=1), size=1)
    words = [sys.executable, "-c", FEW, str(TESTS), str(tmp_path)]
    done = subprocess.run([*words, "30"], capture_output=True, text=True, check=False)
    assert done.stdout == "True\n", done.stderr
    done = subprocess.run([*words, "4"], capture_output=True, text=True, check=False)
    assert "UserError" in done.stderr.splitlines()[-1]
    assert "too many files are open" in done.stderr.splitlines()[-1]


# ---- Writing


@pytest.mark.parametrize(
    ("code", "said", "exit_code"),
    [
        (errno.ENOSPC, "no space left", 1),
        (errno.EDQUOT, "no space left", 1),
        (errno.EIO, "the disk or its network fails", 1),
        (errno.ESTALE, "the disk or its network fails", 1),
        (errno.EFBIG, "cannot hold so large a file", 1),
        (errno.EMFILE, "too many files are open", 2),
        (errno.EROFS, "read-only", 2),
        (errno.EACCES, "no permission", 2),
    ],
    ids=lambda value: errno.errorcode.get(value, "") if isinstance(value, int) and value > 2 else "",
)
@pytest.mark.parametrize("where", ["fsync", "replace", "mkdir"])
def test_what_cannot_be_written_is_said_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, said: str, exit_code: int, where: str
) -> None:
    made = synthetic.dataset(tmp_path / "data", train=3)

    def failing(*arguments: Any, **_: Any) -> None:
        raise OSError(code, os.strerror(code), str(arguments[0]))

    with monkeypatch.context() as patch:
        patch.setattr(os, where, failing)
        with pytest.raises(UserError, match=said) as caught:
            synthetic.make(made)
    assert caught.value.exit_code == exit_code
    assert "\n" not in str(caught.value)
    assert not [path for path in tmp_path.rglob("*") if ".tmp." in path.name]
    synthetic.make(made)
    assert verify(tmp_path / "data") == []


def test_what_has_a_name_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes are flushed before a file is renamed, and names before a record says that the file is there."""
    flush, rename = os.fsync, os.replace
    flushed: dict[int, bytes] = {}  # content by inode
    renamed, recorded = set[Path](), list[bytes]()  # folders with names that are not flushed; logs of records

    def fsync(descriptor: int) -> None:
        path = Path(f"/proc/self/fd/{descriptor}").resolve()
        flush(descriptor)
        if path.is_dir():
            renamed.discard(path)
            return
        flushed[os.fstat(descriptor).st_ino] = path.read_bytes()
        if path.parent.name == "records":
            assert not renamed
            recorded.append(path.read_bytes())

    def replace(source: Any, target: Any) -> None:
        assert flushed[Path(source).stat().st_ino] == Path(source).read_bytes()
        rename(source, target)
        renamed.add(Path(target).parent)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    made = synthetic.dataset(tmp_path / "data", train=12)
    todo = open_folder(made)
    with synthetic.ShardWriter(made) as writer:
        for number, shard in enumerate(todo, 1):
            row = writer.write(shard, synthetic.blocks(made, shard))
            assert len(recorded) == number
            assert recorded[-1].endswith(row.tobytes())
    assert complete(made)
    assert not renamed


def test_what_is_in_a_folder_is_on_the_disk_before_the_folder_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, flush, flush_all, rename = list[str](), os.fsync, os.sync, os.rename
    monkeypatch.setattr(os, "sync", lambda: (flush_all(), done.append("flushed all")))
    monkeypatch.setattr(os, "rename", lambda *names: (rename(*names), done.append(f"renamed to {Path(names[1]).name}")))
    monkeypatch.setattr(
        os, "fsync", lambda file: (flush(file), done.append(f"flushed {Path(f'/proc/self/fd/{file}').resolve().name}"))
    )
    with publishing_folder(tmp_path / "films") as temporary:
        (temporary / "a").touch()
        done.clear()
    assert done == ["flushed all", "renamed to films", f"flushed {tmp_path.name}"]


def test_a_folder_that_cannot_be_replaced_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rename = os.rename

    def failing(source: Any, target: Any) -> None:
        if ".old." not in f"{source}{target}":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        rename(source, target)

    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "a").write_text("before")
    monkeypatch.setattr(os, "rename", failing)
    with pytest.raises(OSError, match="Input/output"), publishing_folder(tmp_path / "films") as temporary:
        (temporary / "a").write_text("after")
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["films", "films/a"]
    assert (tmp_path / "films" / "a").read_text() == "before"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 400 kB and 42 inodes, where this user may mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=400k,nr_inodes=42", "tmpfs", str(disk)]
    if subprocess.run(words, capture_output=True, check=False).returncode:
        not_run("a full disk, as this user may not mount one")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_full_disk_is_said_and_gone_on_from(small_disk: Path) -> None:
    made = synthetic.dataset(small_disk / "data", train=160)
    with pytest.raises(UserError, match=r"no space left .*the disk has .* MB left: make room") as caught:
        synthetic.make(made)
    assert caught.value.exit_code == 1
    subprocess.run(["mount", "-o", "remount,size=4m", str(small_disk)], check=True)
    done = len(list((small_disk / "data" / "shards").iterdir()))
    assert 0 < done < 21
    assert len(open_folder(made)) == 21 - done
    synthetic.make(made)
    assert verify(small_disk / "data") == []


# Fills the disk to every level at which a shard may meet its end.
LEVELS = """
import errno, sys
from pathlib import Path
import numpy as np
from gen2d.core.schema import Field
from gen2d.dataset import hdf5
from gen2d.dataset.block import encode
disk, sizes, noise = Path(sys.argv[1]), {"T": 4, "H": 16, "W": 16, "K": 8}, np.random.default_rng(0)
fields = {f"states/{k}": Field("float32", "n T K 2", "m", "noise") for k in range(12)}
fields["frames"] = Field("uint8", "n T H W 3", "sRGB", "noise")
columns = {name: (255 * noise.random((4, *field.shape(sizes)))).astype(field.dtype) for name, field in fields.items()}
blocks, outcomes = [encode(columns, fields, "gzip")] * 6, []
for fill in range(0, 400_000, 4096):
    (disk / "fill").write_bytes(bytes(fill))
    try:
        hdf5.write(disk / "shard.h5", fields, sizes, range(24), blocks, "gzip", None, {"a": 1}, {}, 0)
        outcomes.append("whole")
    except OSError as error:
        assert error.errno == errno.ENOSPC, error
        outcomes.append("full")
    (disk / "shard.h5").unlink(missing_ok=True)
print(outcomes.count("whole"), outcomes.count("full"))
"""


def test_a_disk_that_fills_at_any_moment_is_an_error(small_disk: Path) -> None:
    """HDF5 itself crashes where it finds the disk full while it closes a dataset."""
    done = subprocess.run([sys.executable, "-c", LEVELS, str(small_disk)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    whole, full = map(int, done.stdout.split())
    assert whole > 5
    assert full > 50
    assert done.stderr == ""


def test_a_disk_without_inodes_is_said(small_disk: Path) -> None:
    for number in range(28):
        (small_disk / f"{number}").touch()
    with pytest.raises(UserError, match="the disk has no inodes left: make room"):
        synthetic.make(synthetic.dataset(small_disk / "data", train=9, videos_per_shard=1), size=1)
    for number in range(28):
        (small_disk / f"{number}").unlink()
    synthetic.make(synthetic.dataset(small_disk / "data", train=9, videos_per_shard=1), size=1)
    assert verify(small_disk / "data") == []


def test_a_folder_that_is_moved_in_the_middle_loses_nothing(tmp_path: Path) -> None:
    made = synthetic.dataset(tmp_path / "data")
    todo = open_folder(made)
    with synthetic.ShardWriter(made) as writer:
        writer.write(todo[0], synthetic.blocks(made, todo[0]))

        def moving() -> Iterator[synthetic.Block]:
            for number, block in enumerate(synthetic.blocks(made, todo[1])):
                if number == 1:
                    (tmp_path / "data").rename(tmp_path / "moved")
                yield block

        with pytest.raises(FolderError, match=r"is gone: was .*data moved or removed during the run\?"):
            writer.write(todo[1], moving())
    assert not (tmp_path / "data").exists()
    (tmp_path / "moved").rename(tmp_path / "data")
    assert open_folder(made) == todo[1:]
    synthetic.make(made)
    assert verify(tmp_path / "data") == []


# ---- Whose a temporary file is


HOLDING = """
import os, sys
from pathlib import Path
from gen2d.storage.leases import lease
with lease(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
    os._exit(9)  # without a word, as one that is killed
"""


def in_a_container(*words: str) -> list[str]:
    """The command in namespaces of its own: process numbers begin at 1, and the host's name is that of all others."""
    return [
        "unshare",
        "--pid",
        "--fork",
        "--uts",
        "--mount-proc",
        "sh",
        "-c",
        'hostname box && exec "$@"',
        "sh",
        *words,
    ]


def test_containers_with_one_name_do_not_touch_each_others_files(tmp_path: Path) -> None:
    if subprocess.run(in_a_container("true"), capture_output=True, check=False).returncode:
        not_run("containers, as this user may not make namespaces")
    synthetic.make(synthetic.dataset(tmp_path, train=3))
    path = tmp_path / "shards" / temporary_name("train-00000.h5")
    sweeping = f"import sys; sys.path.insert(0, {str(TESTS)!r}); import synthetic; from pathlib import Path; "
    sweeping += f"synthetic.open_folder(synthetic.dataset(Path({str(tmp_path)!r}), train=3))"
    holder = in_a_container(sys.executable, "-c", HOLDING, str(path))
    with subprocess.Popen(holder, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout
        assert process.stdout.readline() == b"held\n"
        subprocess.run(in_a_container(sys.executable, "-c", sweeping), check=True)
        assert path.exists()
    assert process.returncode == 9
    subprocess.run(in_a_container(sys.executable, "-c", sweeping), check=True)
    assert not path.exists()


@pytest.mark.parametrize("reason", ["locking fails", "other machines do not see locks"])
def test_without_locks_only_clean_removes_what_is_left(toy: Path, monkeypatch: pytest.MonkeyPatch, reason: str) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    left = toy / "shards" / temporary_name("train-00000.h5")
    left.touch()
    if reason == "locking fails":
        monkeypatch.setattr(leases.fcntl, "flock", no_locks)
    else:
        monkeypatch.setattr(leases, "has_locks", lambda folder: False)
    synthetic.make(synthetic.dataset(toy, train=11))
    assert left.exists()
    done = tiny.run_main("clean", toy)
    assert f"removed: shards/{left.name}" in done.stdout
    assert not left.exists()


@pytest.mark.parametrize(
    ("kind", "options", "expected"),
    [
        ("ext4", "rw", True),
        ("nfs4", "rw,local_lock=none", True),
        ("nfs", "rw,nolock", False),
        ("nfs", "rw,local_lock=all", False),
        ("lustre", "rw,flock", True),
        ("lustre", "rw", False),
        ("fuse.sshfs", "rw", False),
        ("9p", "rw", False),
    ],
)
def test_only_locks_that_all_respect_count(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: str, options: str, expected: bool
) -> None:
    mounts = (
        f"1 0 0:1 / / rw - ext4 /dev/a rw\n2 1 0:2 / {tmp_path} rw,relatime shared:1 - {kind} server:/x {options}\n"
    )
    monkeypatch.setattr(leases.Path, "read_text", lambda _: mounts)
    assert leases.has_locks(tmp_path / "some" / "folder") is expected
    assert leases.has_locks(Path("/")) is True


def test_a_lease_is_the_owner_s_alone(tmp_path: Path) -> None:
    path = tmp_path / temporary_name("x")
    with lease(path) as descriptor:
        os.write(descriptor, b"mine")
        assert leases.remove_abandoned([path]) == []
        assert path.read_bytes() == b"mine"
    assert leases.remove_abandoned([path]) == [path]
    folder = tmp_path / temporary_name("y")
    folder.mkdir()
    with lease(folder.with_name(folder.name + ".lock")):
        assert leases.remove_abandoned(list(leases.temporary_files(tmp_path))) == []
    assert leases.remove_abandoned(list(leases.temporary_files(tmp_path))) == [folder]
    assert list(tmp_path.iterdir()) == []


def test_a_lease_is_of_the_file_that_has_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process may remove the file as abandoned between its making and its locking."""
    path, lock, removed = tmp_path / temporary_name("x"), leases.try_lock, list[bool]()

    def late(descriptor: int) -> bool | None:
        if not removed:
            path.unlink()
            removed.append(True)
        return lock(descriptor)

    monkeypatch.setattr(leases, "try_lock", late)
    with lease(path) as descriptor:
        assert os.path.samestat(os.fstat(descriptor), path.stat())
    assert removed


# ---- Time


def test_a_clock_that_is_set_back_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now - 10**8)
    made = synthetic.make(synthetic.dataset(tmp_path / "a", train=3))
    reader = gen2d.open(tmp_path / "a", fields="*")
    for path in (tmp_path / "a").rglob("*"):
        os.utime(path, (0, 0))
    synthetic.make(synthetic.dataset(tmp_path / "a", train=12))
    synthetic.make(synthetic.dataset(tmp_path / "b", train=12))
    assert synthetic.tree(tmp_path / "a") == synthetic.tree(tmp_path / "b")
    assert len(reader[:]["index"]) == 3
    assert made.splits["train"] == 3


@pytest.mark.slow
@pytest.mark.parametrize("what", ["stopped for a minute", "moved"])
def test_the_command_goes_on_after_what_happens_to_machines(tmp_path: Path, what: str) -> None:
    config = tmp_path / "tiny.yaml"
    config.write_text(str(tiny.CONFIG))
    out = tmp_path / "data"
    words, environment = tiny.command("--config", config, "--n", 10_000, "--out", out)
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, env=environment, **pipes) as process:
        while len(list(out.glob("shards/*.h5"))) < 20:
            assert process.poll() is None
            time.sleep(0.05)
        if what == "moved":
            out.rename(tmp_path / "moved")
        else:
            process.send_signal(signal.SIGSTOP)
            time.sleep(60)
            process.send_signal(signal.SIGCONT)
        output, errors = process.communicate(timeout=600)
    if what == "moved":
        assert process.returncode == 2
        assert f"was {out} moved or removed during the run?" in errors
        assert "Traceback" not in errors
        shutil.rmtree(out, ignore_errors=True)
        (tmp_path / "moved").rename(out)
        assert tiny.run_command("--config", config, "--n", 10_000, "--out", out).returncode == 0
    else:
        assert process.returncode == 0, errors
        assert "10,000 videos in" in output
    assert verify(out, "quick") == []


def test_errors_of_disks_have_a_sentence_each(tmp_path: Path) -> None:
    for code in errno.errorcode:
        error = OSError(code, os.strerror(code), str(tmp_path / "x"))
        for failure in (explain.reading_error(tmp_path / "x", error), explain.writing_error(tmp_path, error)):
            assert isinstance(failure, Error)
            assert str(failure).isprintable()
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > 100
