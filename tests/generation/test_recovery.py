"""What a dataset of the real program survives: a flipped bit anywhere, and its command killed at any moment."""

import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import buckets
import pytest
import s3fs
import tiny
from synthetic import contents

import gen2d
from gen2d.config.reading import yaml_text
from gen2d.dataset.folder import clean
from gen2d.generation.regenerate import repair
from gen2d.generation.run import generate
from gen2d.tools.verify import verify, verify_and_repair

# Simulated by the program of `tiny.CONFIG`.
CONFIG = tiny.tiny_config(
    video={"height": 32, "width": 32}, annotations={"masks": True}, storage={"videos_per_shard": 16}
)
slow = pytest.mark.slow


# ---- Flipped bits


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three shards of frames, states and masks, about 300 kB."""
    out = tmp_path_factory.mktemp("flipped") / "data"
    generate(CONFIG, 42, out)
    return out


def places(root: Path) -> list[tuple[str, int]]:
    """A bit in each kilobyte of each file, but for the card that people may write in."""
    chance, positions = random.Random(3), []
    for name, content in sorted(contents(root).items()):
        if name != "README.md":
            for begin in range(0, len(content), 1000):
                positions.append((name, 8 * begin + chance.randrange(8 * min(1000, len(content) - begin))))
    return positions


def flip(root: Path, name: str, bit: int) -> None:
    content = bytearray((root / name).read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    (root / name).write_bytes(content)


@pytest.mark.parametrize("share", [pytest.param(0.015, id="some"), pytest.param(1.0, id="every kilobyte", marks=slow)])
def test_a_flipped_bit_is_repaired_to_the_byte(pristine: Path, tmp_path: Path, share: float) -> None:
    root, before, chance = tmp_path / "data", contents(pristine), random.Random(4)
    every = places(pristine)
    assert 250 < len(every) < 900
    shutil.copytree(pristine, root)
    for name, bit in (place for place in every if chance.random() < share):
        flip(root, name, bit)
        outcome = verify_and_repair(root, "full", lambda names: repair(root, names))
        assert outcome.problems == [], (name, bit)
        assert outcome.repaired, (name, bit)
        assert contents(root) == before, (name, bit)


@slow
def test_the_command_repairs_a_flipped_bit_to_the_byte(pristine: Path, tmp_path: Path) -> None:
    root, before = tmp_path / "data", contents(pristine)
    shutil.copytree(pristine, root)
    for name, bit in random.Random(5).sample(places(pristine), 20):
        flip(root, name, bit)
        done = tiny.run_command("verify", root, "--repair", "--json")
        assert done.returncode == 0, done
        assert json.loads(done.stdout)["problems"] == []
        assert contents(root) == before, (name, bit)


# ---- Kills


class Reader(threading.Thread):
    """Reads a snapshot of a dataset over and over, every video, until it is told to stop."""

    def __init__(self, root: Path) -> None:
        super().__init__(daemon=True)
        self.root, self.ds = root, gen2d.open(root, fields="*")
        self.expected = self.ds[:]
        self.errors: list[str] = []
        self.rounds, self.going = 0, True

    def run(self) -> None:
        while self.going:
            try:
                for ds in (self.ds, gen2d.open(self.root, fields="*", snapshot=self.ds.snapshot)):
                    actual = ds[:]
                    for name, values in self.expected.items():
                        assert (actual[name] == values).all() or values.dtype.kind == "f", name
                self.rounds += 1
            except Exception as error:
                self.errors.append(repr(error))
            time.sleep(0.05)


@slow
def test_two_hundred_kills_while_a_dataset_grows(tmp_path: Path) -> None:
    """Three workers of the real command, all killed at once or one of them; a reader of the old snapshot goes on."""
    config, out, chance = tmp_path / "tiny.yaml", tmp_path / "data", random.Random(6)
    config.write_text(yaml_text(tiny.CONFIG))
    count, killed, rounds = 24, 0, 0

    def workers(n: int) -> list[subprocess.Popen]:
        made = []
        for number in range(3):
            words, environment = tiny.command("--config", config, "--n", n, "--out", out, "--worker", f"{number}/3")
            pipes: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
            made.append(subprocess.Popen(words, env=environment, **pipes))
        return made

    def count_killed(processes: list[subprocess.Popen]) -> int:
        codes = []
        for process in processes:
            output = process.communicate()[1]
            assert process.returncode in (0, -signal.SIGKILL), output
            codes.append(process.returncode)
        return sum(code != 0 for code in codes)

    assert count_killed(workers(count)) == 0
    while killed < 200:
        reader = Reader(out)
        reader.start()
        count += chance.randrange(100, 3000)
        for _ in range(chance.randrange(3, 9)):
            processes = workers(count)
            time.sleep(chance.random() * 12)
            for process in processes if chance.random() < 0.5 else [chance.choice(processes)]:
                process.send_signal(signal.SIGKILL)
            killed += count_killed(processes)
            assert verify(out, "quick") == []
        assert count_killed(workers(count)) == 0
        reader.going = False
        reader.join()
        assert reader.errors == []
        rounds += reader.rounds
        assert len(gen2d.open(out)) == count
    generate(tiny.CONFIG, count, tmp_path / "one run")
    clean(out)
    grown, once = contents(out), contents(tmp_path / "one run")
    assert grown == once
    print(f"{killed} kills, {count} videos, {rounds} rounds of readers")


@slow
def test_thirty_kills_of_a_repair(pristine: Path, tmp_path: Path) -> None:
    root, before, chance, killed, seconds = tmp_path / "data", contents(pristine), random.Random(7), 0, math.inf
    while killed < 30:
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(pristine, root)
        flip(root, "shards/train-00000.h5", 8 * 20_000)
        words, environment = tiny.command("verify", root, "--repair")
        began = time.monotonic()
        with subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL) as process:
            if math.isfinite(seconds):  # that a whole repair takes, as the first does
                time.sleep(chance.uniform(0.2, 1.1) * seconds)
                process.send_signal(signal.SIGKILL)
        seconds = min(seconds, time.monotonic() - began) if process.returncode == 0 else seconds
        killed += process.returncode == -signal.SIGKILL
        for name, content in before.items():
            if name != "shards/train-00000.h5":
                assert (root / name).read_bytes() == content, name
        assert verify_and_repair(root, "full", lambda names: repair(root, names)).problems == []
        clean(root)
        assert contents(root) == before


@pytest.fixture(scope="module")
def server() -> Iterator[buckets.Server]:
    with buckets.serving() as made, pytest.MonkeyPatch.context() as patch:
        for name, value in buckets.environment(made).items():
            patch.setenv(name, value)
        yield made
        s3fs.S3FileSystem.clear_instance_cache()


GROWING = """
import sys
sys.path.insert(0, sys.argv[1])
import synthetic
from gen2d.storage.paths import place
synthetic.make(synthetic.dataset(place(sys.argv[2]), train=int(sys.argv[3])))
"""


def killing(process: subprocess.Popen, change: int, fault: str) -> buckets.Fault:
    """Kills the process when the server is asked for its change with this number, which comes to pass or fails."""
    asked = 0

    def kill(request: buckets.Request) -> str:
        nonlocal asked
        asked += request.method in ("PUT", "POST", "DELETE")
        if asked == change and request.method in ("PUT", "POST", "DELETE"):
            process.kill()
            return fault
        return ""

    return kill


@slow
def test_thirty_kills_of_an_upload(server: buckets.Server, tmp_path: Path) -> None:
    """At the first, the second, the third ... change to what lies there, right before it or right after."""
    import synthetic

    synthetic.make(synthetic.dataset(tmp_path / "data", train=30))
    expected, url = synthetic.tree(tmp_path / "data"), "s3://bucket/growing"
    for number in range(30):
        s3fs.S3FileSystem(use_listings_cache=False).rm(url, recursive=True) if number else None
        synthetic.make(synthetic.dataset(gen2d.storage.paths.place(url), train=12))
        old = gen2d.open(url, fields="*")
        videos = old[:]
        words = [sys.executable, "-c", GROWING, os.fspath(Path(synthetic.__file__).parent), url, "30"]
        with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
            server.fault = killing(process, number + 1, "" if number % 2 else "fail")
            process.wait()
        server.reset()
        actual = gen2d.open(url, fields="*", snapshot=old.snapshot)[:]
        assert all((actual[name] == values).all() for name, values in videos.items())
        assert len(gen2d.open(url)) in (12, 30)
        synthetic.make(synthetic.dataset(gen2d.storage.paths.place(url), train=30))
        assert buckets.tree(url) == expected
