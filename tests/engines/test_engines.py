"""Engines without videos: every item is done once whatever dies, fails or dawdles, and the sentence says why not."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from clusters import Cluster, add_node, two_cores
from fake_jobs import SquareJob
from tiny import run_main, sentences

import gen2d.engines.ray as module
from gen2d.core.errors import ConfigError, FolderError, UserError
from gen2d.core.progress import Event
from gen2d.engines import Local, Ray
from gen2d.engines.protocol import Engine, EngineError

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's own


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A head without cores and a machine with two."""
    with two_cores() as cluster:
        yield cluster


def squares(engine: Engine, job: SquareJob, count: int, lines: list[str] | None = None) -> dict[int, int]:
    """The results of a run, each of which must come once."""
    results: dict[int, int] = {}
    workers = engine.start(job, (lines if lines is not None else []).append)
    try:
        for item in range(count):
            workers.submit(item)
        for item, result, _ in workers.done():
            assert item not in results
            results[item] = result
    finally:
        workers.stop()
    return results


ALL = {item: item * item for item in range(12)}


def events(lines: list[str]) -> list[str]:
    """Lines without waits and progress, which depend on the machine."""
    return [line for line in lines if isinstance(line, Event) and line.values["event"] != "progress"]


def test_the_local_engine_runs_all_items_in_this_process(tmp_path: Path):
    assert squares(Local(), SquareJob(tmp_path), 12) == ALL
    assert (tmp_path / f"closed-{os.getpid()}").exists()


def test_workers_that_die_or_fail_are_made_up_for(cluster: Cluster, tmp_path: Path):
    faults = {2: "die once", 3: "die once", 5: "terminate once", 7: "bug once", 9: "disk once"}
    lines: list[str] = []
    engine = Ray(cluster.address, workers=2)
    assert squares(engine, SquareJob(tmp_path, faults, group=2), 12, lines) == ALL
    lost = [line for line in lines if " is lost (its process died); " in line]
    assert 2 <= len(lost) <= 3, lines  # on SIGTERM, a worker may finish what it does
    assert events(lines)[0] == "2 workers (cpu fake)"
    assert len(events(lines)) == 1 + len(lost), lines  # and nothing else
    assert any(tmp_path.glob("closed-*"))  # those that are left close their files


@pytest.mark.parametrize(
    ("fault", "error", "sentence"),
    [
        ("die", EngineError, r"^4 failed 3 times, the last on .+:\d+: its process died; what is made stays$"),
        ("bug", EngineError, r"^4 failed 3 times, the last on .+:\d+: ZeroDivisionError: a bug; what is made stays$"),
        ("disk", FolderError, r"^4 failed 3 times, the last on .+:\d+: the disk is full; what is made stays$"),
        ("config", ConfigError, r"^scene.balls is 0, but must be 1 or more$"),
    ],
)
def test_an_item_that_always_fails_ends_the_run_with_its_name(
    cluster: Cluster, tmp_path: Path, fault: str, error: type[UserError], sentence: str
):
    with pytest.raises(error, match=sentence):
        squares(Ray(cluster.address, workers=2, retries=2), SquareJob(tmp_path, {4: fault}), 12)


def test_a_late_item_is_also_run_by_another_worker(cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "STRAGGLER_SECONDS", 1.0)
    began = time.monotonic()
    assert squares(Ray(cluster.address, workers=2), SquareJob(tmp_path, {11: "dawdle once"}), 12) == ALL
    assert time.monotonic() - began < 30  # of the 60 that the first attempt takes


def test_a_cluster_may_lose_and_gain_machines(cluster: Cluster, tmp_path: Path):
    """Three machines, of which one goes and another comes; of those that make other bits, each is released by name."""
    second = add_node(cluster)
    foreign = add_node(cluster, FAKE_IDENTITY="other")
    lines: list[str] = []
    workers = Ray(cluster.address).start(SquareJob(tmp_path, seconds=0.3), lines.append)
    late, results, count, lost = None, {}, 20, r" is lost \((its machine is gone|it cannot be reached)\)"
    try:
        for item in range(count):
            workers.submit(item)
        for item, result, _ in workers.done():
            results[item] = result
            if len(results) == 5:
                cluster.remove_node(second, allow_graceful=False)
                late = add_node(cluster)
            if not (re.search(lost, "".join(lines)) and " joins" in "".join(lines)) and count < 1000:
                workers.submit(count)  # until all has happened
                count += 1
        assert results == {item: item * item for item in range(count)}
        assert sum(" is released: it makes other, not one" in line for line in lines) == 1, lines
        assert sum(bool(re.search(lost, line)) for line in lines) == 1, lines
        assert sum(line.endswith(" joins") for line in lines) == 1, lines
        assert "2 workers (cpu fake)" in events(lines)[:2]
    finally:
        workers.stop()
        for node in (foreign, late):
            if node:
                cluster.remove_node(node)
        # The process of a driver that is given a machine whose death Ray has not noticed ends without a word.
        cluster.wait_for_nodes(timeout=60)


@pytest.mark.full
def test_fewer_workers_than_asked_for_is_one_sentence(cluster: Cluster, tmp_path: Path):
    foreign = add_node(cluster, FAKE_IDENTITY="other")
    try:
        with pytest.raises(EngineError, match=r"^workers asks for 3 or more, but fewer can take part: .*makes "):
            squares(Ray(cluster.address, workers=3, cpus_per_worker=1, patience=20), SquareJob(tmp_path), 4)
    finally:
        cluster.remove_node(foreign)


@pytest.mark.full
def test_workers_without_a_machine_of_their_own_avoid_those_that_were_refused(cluster: Cluster, tmp_path: Path):
    """More are asked for than there is room for, so the room of a released worker would be taken at once."""
    foreign, lines = add_node(cluster, FAKE_IDENTITY="other"), []
    try:
        engine = Ray(cluster.address, workers=(1, 5), cpus_per_worker=1)
        assert squares(engine, SquareJob(tmp_path, seconds=0.2), 60, lines) == {item: item * item for item in range(60)}
    finally:
        cluster.remove_node(foreign)
    assert sum(" is released: it makes other, not one" in line for line in lines) == 1, lines


def test_a_worker_has_its_gpus_and_the_same_share_of_the_cores(cluster: Cluster, tmp_path: Path):
    machine = cluster.add_node(num_cpus=6, num_gpus=4, object_store_memory=10**8, include_dashboard=False)
    job, lines = SquareJob(tmp_path), []
    job.device = "auto"
    try:
        assert squares(Ray(cluster.address, gpus_per_worker=2), job, 12, lines) == ALL
        assert events(lines)[0] == "2 workers (cpu fake)"  # fewer than there are cores
    finally:
        cluster.remove_node(machine)


def test_nobody_who_can_work_is_one_sentence(cluster: Cluster, tmp_path: Path):
    job = SquareJob(tmp_path)
    with pytest.raises(EngineError, match=r"its device is 'cpu fake', but device_kind is 'h100'$"):
        squares(Ray(cluster.address, device_kind="H100"), job, 1)
    with pytest.raises(EngineError, match=r"^there is no room for 9 workers of 2 cores: the cluster has .* machines"):
        squares(Ray(cluster.address, workers=(9, 9), cpus_per_worker=2, patience=1), job, 1)
    job.device = "gpu"
    with pytest.raises(EngineError, match=r"^there is no room for 1 worker of 1 GPU and 1 core: .*, 0 GPUs; lower"):
        squares(Ray(cluster.address, patience=1), job, 1)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--workers", "4:2"], "--workers is 4:2, but must be MIN:MAX with whole numbers, 1 <= MIN <= MAX"),
        (["--workers", "two"], "--workers: 'two' is not MIN:MAX, such as 1:8; see python -m gen2d generate --help"),
        (["--retries", "0"], "--retries is 0, but must be 1 or more"),
        (["--gpus-per-worker", "1.5"], "--gpus-per-worker is 1.5, but must be a whole number or part of 1"),
        (["--cpus-per-worker", "0"], "--cpus-per-worker is 0, but must be 1 or more"),
        (["--worker", "0/2"], "--worker and --engine cannot go together: the engine divides the work"),
        (["--address", "nowhere"], "--address is 'nowhere', but must be auto, HOST:PORT or ray://HOST:PORT"),
        (
            ["--address", "ray://127.0.0.1:1"],
            "--address is ray://127.0.0.1:1, where nothing answers (Connection refused)",
        ),
    ],
)
def test_bad_arguments_are_one_sentence(arguments: list[str], sentence: str, tmp_path: Path):
    done = run_main("--config", "bouncing", "--n", 1, "--out", tmp_path / "x", "--engine", "ray", *arguments)
    assert (done.returncode, done.stdout, sentences(done.stderr)) == (2, "", [f"gen2d: {sentence}"])
    assert not (tmp_path / "x").exists()


def test_arguments_of_a_cluster_need_one():
    done = run_main("--config", "bouncing", "--n", 1, "--workers", "2")
    assert (done.returncode, sentences(done.stderr)) == (2, ["gen2d: --workers needs --engine ray"])


def test_without_ray_one_sentence_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(EngineError, match=r"^Ray is not installed: pip install 'gen2d\[ray\]'"):
        squares(Ray(), SquareJob(tmp_path), 1)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs affinities")
def test_workers_of_a_machine_take_different_cores(tmp_path: Path):
    code = "import os; os.sched_setaffinity(0, range(os.cpu_count())); from gen2d.engines.ray_actor import take_cores; "
    code += "locks = take_cores(1); print(*os.sched_getaffinity(0), flush=True); input()"
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    processes = [
        subprocess.Popen([sys.executable, "-c", code], stdin=-1, stdout=-1, text=True, env=environment)
        for _ in range(min(2, os.cpu_count() or 1))
    ]
    cores = [process.stdout.readline().strip() for process in processes if process.stdout]
    for process in processes:
        process.communicate("\n")
    assert len(set(cores)) == len(processes)
    assert all(len(core.split()) == 1 for core in cores)
