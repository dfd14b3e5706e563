"""What gen2d opens it closes: threads, files and maps of files, also where a call fails or is abandoned."""

import gc
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest
import synthetic
import tiny

import gen2d
from gen2d.core.errors import UserError
from gen2d.dataset.block import Block
from gen2d.dataset.folder import open_folder
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.loading import chunks

ROOT = Path(__file__).parents[1]


def held() -> Counter[str]:
    """How many threads of each name, descriptors of each file and maps of each data file this process has."""
    with chunks._lock:
        chunks._files.clear()  # at most OPEN_FILES stay open for later reads
    gc.collect()
    found = Counter(f"thread {re.sub(r'[-_0-9]*$', '', thread.name)}" for thread in threading.enumerate())
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            found[f"file {re.sub('[0-9]+', '', str(descriptor.readlink()))}"] += 1
        except FileNotFoundError:
            continue  # that of the listing
    maps = {line.split(maxsplit=5)[-1] for line in Path("/proc/self/maps").read_text().splitlines()}
    found.update(f"map {path}" for path in maps if path.endswith((".h5", ".npy", ".json", ".png", ".tar", ".mp4")))
    return found


def read(toy: Path, _: Path) -> None:
    for window in (None, 2):
        gen2d.open(toy, fields="*", window=window, start="first")[:]


def read_url(toy: Path, folder: Path) -> None:
    words = ["-u", "-m", "http.server", "0", "--bind", "127.0.0.1", "--directory", str(toy)]
    quiet = subprocess.DEVNULL
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, stderr=quiet, text=True) as server:
        assert server.stdout
        port = server.stdout.readline().partition(" port ")[2].split()[0]
        gen2d.open(f"http://127.0.0.1:{port}", fields="*", cache_dir=folder)[:]
        server.kill()


def load_some(toy: Path, _: Path) -> None:
    with gen2d.DataLoader(gen2d.open(toy), 4, num_threads=3) as loader:
        next(iter(loader))
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("gen2d_")]  # `close` waits


def load_all(toy: Path, _: Path) -> None:
    assert len(list(gen2d.DataLoader(gen2d.open(toy), 4, epochs=2, num_threads=3))) == 10


def load_and_abandon(toy: Path, _: Path) -> None:
    next(iter(gen2d.DataLoader(gen2d.open(toy), 4, num_threads=3)))


def load_and_fail(toy: Path, _: Path) -> None:
    def fail(batch: object) -> NoReturn:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(gen2d.DataLoader(gen2d.open(toy), 4, num_threads=3, transform=fail))


def write(_: Path, folder: Path) -> None:
    synthetic.make(synthetic.dataset(folder))


def write_and_fail(_: Path, folder: Path) -> None:
    spec = synthetic.dataset(folder)

    def blocks() -> Iterator[Block]:
        yield from synthetic.blocks(spec, open_folder(spec)[0], size=3)
        raise UserError("no more videos")

    with pytest.raises(UserError, match="no more"), ShardWriter(spec) as writer:
        writer.write(open_folder(spec)[0], blocks())


def verify(toy: Path, _: Path) -> None:
    assert gen2d.verify(toy, "full") == []


def find_damage(toy: Path, folder: Path) -> None:
    shutil.copytree(toy, folder)
    synthetic.flip(next((folder / "shards").iterdir()), 8_000)
    assert gen2d.verify(folder, "full") != []


def export(toy: Path, folder: Path) -> None:
    for name in ("npz", "webdataset", "mp4", "ffv1"):
        gen2d.export(toy, name, folder / name)


def preview(toy: Path, folder: Path) -> None:
    folder.mkdir()
    gen2d.preview(toy, folder)


def generate(_: Path, folder: Path) -> None:
    gen2d.generate(tiny.CONFIG, 9, folder)


def stream_and_abandon(_: Path, __: Path) -> None:
    next(iter(gen2d.stream(tiny.CONFIG, 5, 4)))


USES: list[Callable[[Path, Path], None]] = [
    *(read, read_url, load_some, load_all, load_and_abandon, load_and_fail, write, write_and_fail, verify, find_damage),
    *(export, preview, generate, stream_and_abandon),
]


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.folder(synthetic.make(synthetic.dataset(tmp_path_factory.mktemp("resources") / "toy")))


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="reads /proc")
@pytest.mark.parametrize("use", USES, ids=lambda use: use.__name__)
def test_what_is_used_is_given_back(use: Callable[[Path, Path], None], toy: Path, tmp_path: Path) -> None:
    """The first use starts what a process keeps, such as the threads of XLA and the process that checks HDF5 files."""
    use(toy, tmp_path / "first")
    before = held()
    for number in range(3):
        use(toy, tmp_path / f"{number}")
    end = time.monotonic() + 10
    while (more := held() - before) and time.monotonic() < end:
        time.sleep(0.05)  # an abandoned thread ends when it has done what was requested ahead
    assert more == Counter()


COMMANDS = """
import sys
from gen2d.cli.main import main
folder = sys.argv[1]
for words in (
    f"--config {folder}/tiny.yaml --n 9 --out {folder}/data", f"verify {folder}/data", f"info {folder}/data",
    f"preview {folder}/data --out {folder}", f"export {folder}/data --to npz --out {folder}/npz",
):
    assert main(words.split()) in (0, None), words
"""


@pytest.mark.full
def test_the_commands_leave_no_file_open(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(str(tiny.CONFIG))
    words = [sys.executable, "-W", "always::ResourceWarning", "-c", COMMANDS, str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "ResourceWarning" not in done.stderr


FORGOTTEN = """
import threading
def test_an_error_in_a_thread():
    thread = threading.Thread(target=lambda: 1 / 0)
    thread.start()
    thread.join()
def test_a_forgotten_file(): open(__file__)
def test_a_forgotten_cycle():
    cycle = [open(__file__)]
    cycle.append(cycle)
def test_nothing(): pass
"""


def test_a_forgotten_file_fails_its_test(tmp_path: Path) -> None:
    """One in a cycle of references fails the test during which, or after which, it is collected."""
    (tmp_path / "test_forgotten.py").write_text(FORGOTTEN)
    words = [sys.executable, "-m", "pytest", "-c", ROOT / "pyproject.toml", "--rootdir", tmp_path, "-p", "conftest"]
    words = [*map(str, words), "-p", "no:cacheprovider", "-n", "0", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    failures = re.findall(r"^(FAILED|ERROR) .*?::(test_\w+)", done.stdout, re.MULTILINE)
    assert {("FAILED", "test_a_forgotten_file"), ("FAILED", "test_an_error_in_a_thread")} <= set(failures), done.stdout
    assert len(set(failures)) == 3, done.stdout
