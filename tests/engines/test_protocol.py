"""Rules of engines without a cluster: workers are stopped, versions agree, and an item comes once or ends the run."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_jobs import SquareJob

from gen2d._version import __version__
from gen2d.core.errors import ConfigError, FolderError
from gen2d.engines import Local, Ray
from gen2d.engines.protocol import Done, EngineError, Report, other_version, results
from gen2d.engines.ray import RayWorkers, _Call, _Member, _Slot
from gen2d.engines.ray_actor import Failure


def test_a_worker_of_another_version_is_refused() -> None:
    assert other_version(Report("cpu", versions={"gen2d": __version__})) == ""
    for versions, name in (({"gen2d": "0.0"}, "0.0"), ({}, "None")):
        assert other_version(Report("cpu", versions=versions)) == f"it has gen2d {name}, but here is {__version__}"


@pytest.mark.parametrize("fails", [False, True])
def test_workers_are_stopped_whatever_happens(fails: bool) -> None:
    calls = []

    class Workers:
        def submit(self, item: int) -> None:
            calls.append(item)

        def done(self) -> Iterator[Done]:
            yield Done(0, 0, "one")
            if fails:
                raise EngineError("gone")

        def stop(self) -> None:
            calls.append("stop")

    engine: Any = SimpleNamespace(start=lambda job, log: Workers())
    found: Any = results(engine, SquareJob(Path()), [0, 1], print)
    assert next(found).result == 0
    with pytest.raises(EngineError if fails else StopIteration):
        next(found)
    assert calls == [0, 1, "stop"]
    found = results(engine, SquareJob(Path()), [0], print)
    next(found)
    found.close()  # the caller has had enough
    assert calls[-1] == "stop"


def test_the_local_engine_obeys_a_refusal(tmp_path: Path) -> None:
    job: Any = SquareJob(tmp_path)
    job.identity = "other"
    with pytest.raises(EngineError, match="it makes one, not other"):
        Local().start(job, print)


def workers(**options: Any) -> tuple[RayWorkers, _Member]:
    """Workers of a cluster that nothing has started, and one of them."""
    ray = SimpleNamespace(remote=lambda kind: kind, put=lambda value: value)
    connection: Any = SimpleNamespace(ray=ray)
    made = RayWorkers(Ray(**options), SquareJob(Path()), print, connection)
    member = _Member("key", _Slot(1, 0, None, None), None)
    member.name, member.ready = "one:1", True
    return made, member


def test_an_item_that_two_workers_have_done_comes_once() -> None:
    made, member = workers()
    for item in (3, 4):
        made.submit(item)
    one, other = (_Call(member, "run", items) for items in ([3, 4], [4]))
    assert [done.item for done in made._answered(one, [9, 16])] == [3, 4]
    assert list(made._answered(other, [16])) == []
    assert not made.missing


def test_an_item_that_fails_alone_so_often_ends_the_run() -> None:
    made, member = workers(retries=2)
    made.submit(3)
    failure = Failure(FolderError("the disk is full"))
    list(made._answered(_Call(member, "run", [3]), failure))
    assert [*made.retry_queue] == [[3]]
    list(made._answered(_Call(member, "run", [3], alone=True), failure))
    with pytest.raises(
        FolderError, match=r"^3 failed 3 times, the last on one:1: the disk is full; what is made stays$"
    ):
        list(made._answered(_Call(member, "run", [3], alone=True), failure))


def test_an_error_of_the_config_ends_the_run_at_once() -> None:
    made, member = workers()
    made.submit(3)
    with pytest.raises(ConfigError, match=r"scene\.balls is 0"):
        list(made._answered(_Call(member, "run", [3]), Failure(ConfigError("scene.balls is 0"))))
