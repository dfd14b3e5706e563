"""Cost of the Ray engine: throughput of two workers beside a plain run on the same cores, and the driver's CPU time.

    python tests/bench/bench_cluster.py

Prints the figures of docs/engines.md; only ratios are meaningful on a shared machine.
"""

import argparse
import os
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent / "support")]
os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parent / "support"), os.environ.get("PYTHONPATH", "")])

from fake_jobs import SquareJob  # noqa: E402

from gen2d.config.config import load_config  # noqa: E402
from gen2d.core.progress import to_stderr  # noqa: E402
from gen2d.dataset.folder import open_folder  # noqa: E402
from gen2d.engines.local import Local  # noqa: E402
from gen2d.engines.protocol import Engine, Job, Workers  # noqa: E402
from gen2d.engines.ray import Ray  # noqa: E402


class Rate(NamedTuple):
    """Videos per second, and per CPU second of all workers."""

    wall: float
    cpu: float


def run(workers: Workers, job: Job, items: Sequence[Any]) -> Rate:
    """Rate from the moment when every worker has done its first item, which includes loading the programs."""
    for item in items:
        workers.submit(item)
    marks: list[tuple[float, dict[str, float], int]] = []  # time, CPU time by worker, and videos of each item
    seen: set[str] = set()
    began = time.perf_counter(), {name_of(): _cpu_seconds()}
    for item, _, worker in workers.done():
        seen.add(worker)
        marks.append((time.perf_counter(), {name: _cpu_of(name) for name in seen}, job.size(item)))
    if seen == {name_of()}:  # the plain run, in this process
        count = sum(size for *_, size in marks)
        return Rate(count / (marks[-1][0] - began[0]), count / (_cpu_seconds() - began[1][name_of()]))
    first = next(k for k, (_, cpu, _) in enumerate(marks) if cpu.keys() == seen)
    count = sum(size for *_, size in marks[first + 1 :])
    cpu = sum(marks[-1][1][name] - marks[first][1][name] for name in seen)
    return Rate(count / (marks[-1][0] - marks[first][0]), count / cpu)


def name_of() -> str:
    """Name of this process as a worker."""
    return f"{os.uname().nodename}:{os.getpid()}"


def _cpu_of(name: str) -> float:
    """CPU time of a worker, in s."""
    fields = Path(f"/proc/{name.rpartition(':')[2]}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rate_of(engine: Engine, count: int, folder: Path) -> Rate:
    """Rate of generating, compressing and writing."""
    from gen2d.generation.worker import GenerationJob

    config = load_config("benchmark.yaml", ["storage.videos_per_shard=512"])
    job = GenerationJob(config, folder, {"train": count}, "cpu")
    workers = engine.start(job, lambda line: None)
    try:
        assert job.dataset is not None
        return run(workers, job, open_folder(job.dataset))
    finally:
        workers.stop()


def driver_share(count: int, rate: float) -> tuple[float, float]:
    """Share of a core that the driver takes, and items per minute, with fake workers."""
    with tempfile.TemporaryDirectory() as folder:
        at_once = 2 * 2  # workers, and calls of each at once
        job = SquareJob(Path(folder), seconds=at_once / rate)
        workers = Ray(workers=2).start(job, lambda line: None)
        try:
            for item in range(count):
                workers.submit(item)
            began, cpu = time.perf_counter(), _cpu_seconds()
            done = sum(1 for _ in workers.done())
            seconds, cpu = time.perf_counter() - began, _cpu_seconds() - cpu
        finally:
            workers.stop()
    assert done == count
    return cpu / seconds, 60 * count / seconds


def _cpu_seconds() -> float:
    return sum(resource.getrusage(resource.RUSAGE_SELF)[:2])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])  # pyright: ignore[reportOptionalMemberAccess]
    parser.add_argument("--videos", type=int, default=8192)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    share, per_minute = driver_share(500, 1000 / 60)
    print(f"driver: {100 * share:.2f} % of a core at {per_minute:,.0f} shards a minute")
    with tempfile.TemporaryDirectory() as folder:
        rate_of(Local(), 1024, Path(folder) / "first")  # loads the programs
    for _ in range(options.repeats):
        with tempfile.TemporaryDirectory() as folder:
            cluster = rate_of(Ray(workers=2), options.videos, Path(folder) / "cluster")
            plain = rate_of(Local(), options.videos, Path(folder) / "plain")
        ratios = f"{cluster.wall / plain.wall:.2f} per second, {cluster.cpu / plain.cpu:.2f} per CPU second"
        print(f"videos of two workers beside a plain run: {ratios}", flush=True)
        to_stderr(f"plain {plain.wall:,.0f} videos/s, {plain.cpu:,.0f} per CPU second")


if __name__ == "__main__":
    main()
