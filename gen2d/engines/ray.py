"""Engine that runs a job on a Ray cluster: one warm worker per GPU or, on CPUs, per machine.

Ray (https://docs.ray.io) starts the workers, as actors, and tells which have died. Only names of shards and numbers of
bytes pass through it. What is run twice is harmless (engines/protocol.py), so the rules are few:

- a worker reports first; it gets work if the job takes it, and is released, by name, if not
- a worker that dies is started again, on any machine; what it had in work is run again, alone on a worker, and if that
  is lost as well each item alone, so that an item that kills its workers is known by its name
- when nothing is left to hand out, idle workers also run items that take far longer than the others
"""

import contextlib
import dataclasses
import math
import re
import statistics
import time
from collections import deque
from collections.abc import Hashable, Iterator, Sequence
from typing import Any, NamedTuple

from gen2d.core.errors import Error, FolderError, UserError, argument
from gen2d.core.humanize import with_noun
from gen2d.core.progress import Event, Log, progress, stopping_on_sigterm, waiting
from gen2d.engines.protocol import Done, EngineError, Job, Report
from gen2d.engines.ray_actor import Actor, Failure
from gen2d.engines.ray_connection import Connection

DEPTH = 2  # groups of items that a worker has at once: one in work, one that follows without a pause
SCALE_PERIOD = 2.0  # s between two looks at the machines of the cluster
GRACE = 30.0  # s that a first worker waits for the reports of the others
STRAGGLER, STRAGGLER_SECONDS = 3.0, 10.0  # an item is late after this many medians, and at least these seconds
UNREACHABLE = 20.0  # s; Ray starts nothing anywhere while it tries a machine that it does not know to be dead
CLOSING = 20.0  # s that workers have to close their files
DIED = "its process died"


@dataclasses.dataclass(frozen=True)
class Ray:
    """A Ray cluster, or Ray on this machine.

    Parameters
    ----------
    address : str, optional
        "auto" for the cluster of this machine, "HOST:PORT" or "ray://HOST:PORT"; by default $RAY_ADDRESS or, without
        it, a cluster of this machine alone, which ends with the run.
    workers : int or (int, int or None), optional
        Smallest and largest number of workers. The run starts with the smallest, by default 1; the largest is, by
        default, what the machines of the cluster can hold. More than that are requested from an autoscaler.
    gpus_per_worker : float
        GPUs of a worker.
    cpus_per_worker : int, optional
        Cores of a worker; by default all of its machine, or an equal share for each GPU or for each worker.
    device_kind : str, optional
        Part of the name of the only kind of devices to use, such as "H100" or "avx512f".
    retries : int
        How often a shard that fails is tried again.
    patience : float
        Seconds to wait for the smallest number of workers.

    Raises
    ------
    EngineError
        If a parameter is invalid.
    """

    address: str | None = None
    workers: int | tuple[int, int | None] | None = None
    gpus_per_worker: float = 1
    cpus_per_worker: int | None = None
    device_kind: str | None = None
    retries: int = 3
    patience: float = 300.0

    def __post_init__(self) -> None:
        low, high = self.limits
        if not (_is_whole(low, 1) and (high is None or _is_whole(high, low))):
            raise EngineError(
                f"{argument('workers')} is {low}:{high}, but must be MIN:MAX with whole numbers, 1 <= MIN <= MAX"
            )
        if not self.gpus_per_worker > 0 or (self.gpus_per_worker > 1 and self.gpus_per_worker % 1):
            raise EngineError(
                f"{argument('gpus_per_worker')} is {self.gpus_per_worker}, but must be a whole number or part of 1"
            )
        if self.cpus_per_worker is not None and not _is_whole(self.cpus_per_worker, 1):
            raise EngineError(f"{argument('cpus_per_worker')} is {self.cpus_per_worker}, but must be 1 or more")
        if not _is_whole(self.retries, 1):
            raise EngineError(f"{argument('retries')} is {self.retries}, but must be 1 or more")

    @property
    def limits(self) -> tuple[int, int | None]:
        """Smallest and largest number of workers; None for as many as the cluster can hold."""
        if self.workers is None:
            return 1, None
        return (self.workers, self.workers) if isinstance(self.workers, int) else self.workers

    def start(self, job: Job, log: Log) -> "RayWorkers":
        """Workers that have reported and were accepted.

        Raises EngineError if Ray is not installed or not reachable, or if there are too few workers.
        """
        workers = RayWorkers(self, job, log, Connection(self.address, log))
        try:
            workers.assemble()
        except BaseException:
            workers.stop()
            raise
        return workers


def _is_whole(value: Any, low: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= low


class _Slot(NamedTuple):
    """Room for a worker: what Ray reserves for it, and on which machine, if that matters."""

    cpus: int
    gpus: float
    node: str | None
    cores: int | None  # to use; None for a share


class _Member:
    """A worker as the driver sees it."""

    def __init__(self, key: Hashable, slot: _Slot, actor: Any) -> None:
        self.key, self.slot, self.actor = key, slot, actor
        self.name, self.node = "a worker", slot.node or ""
        self.report: Report | None = None
        self.ready = False
        self.calls: dict[Any, _Call] = {}  # in work, by the reference to their results

    @property
    def has_retry(self) -> bool:
        return any(call.alone for call in self.calls.values())


@dataclasses.dataclass
class _Call:
    """A call to a worker."""

    member: _Member
    kind: str  # "open", "check" or "run"
    items: Sequence[Any] = ()
    alone: bool = False  # these items, which have failed or lost their worker before, are all that the worker has
    began: float = 0.0
    repeated: bool = False


class RayWorkers:
    """The workers of a run, and the items that are in work or left."""

    def __init__(self, engine: Ray, job: Job, log: Log, connection: Connection) -> None:
        self.engine, self.job, self.log, self.connection = engine, job, log, connection
        self.ray = connection.ray
        self.actor_type = self.ray.remote(Actor)
        self.opening = self.ray.put(job.open)
        self.members: dict[Hashable, _Member] = {}
        self.calls: dict[Any, _Call] = {}
        self.todo: deque[Any] = deque()
        self.retry_queue: deque[Sequence[Any]] = deque()  # items that failed, or whose worker was lost, to be run alone
        self.missing: dict[Any, None] = {}  # submitted and not done, in order
        self.failures: dict[Any, int] = {}
        self.failed_on: dict[Any, str] = {}  # name of the last worker
        self.seconds: deque[float] = deque(maxlen=1000)  # of the last calls
        self.refused: dict[Hashable, str] = {}  # why, by the key of the slot
        self.refused_nodes: set[str] = set()
        self.blocked_until: dict[Hashable, float] = {}  # until when, slots whose workers die early
        self.losses = 0  # workers lost since the last item was done
        self.seen: set[Hashable] = set()  # slots that have had a worker
        self.scaled, self.opened = 0.0, False
        self.device = ""
        self.stopped = False

    # ---- Calls of an engine

    def submit(self, item: Any) -> None:
        self.todo.append(item)
        self.missing[item] = None

    def done(self) -> Iterator[Done]:
        total = sum(map(self.job.size, self.missing))
        self.opened = True  # what the job writes to is ready, so that workers may check it
        for member in self.members.values():
            if member.report is not None:
                self._call(member, "check")
        with (
            stopping_on_sigterm(self.log),
            progress(self.job.title, total, self.log, self.job.unit, self._ready_count) as advance,
        ):
            while self.missing:
                self._scale()
                self._feed()
                for done in self._step():
                    advance(self.job.size(done.item))
                    yield done

    def stop(self) -> None:
        """Close idle workers and kill busy ones; leave the cluster, or end it if it is this machine's own."""
        if self.stopped:
            return
        self.stopped = True
        if self.connection.is_lost:  # every call to the head would wait for it
            return self.connection.abandon()
        with contextlib.suppress(Exception):  # the cluster may be gone
            idle = [member for member in self.members.values() if member.ready and not member.calls]
            closing = [member.actor.close.remote() for member in idle]
            if closing:
                self.ray.wait(closing, num_returns=len(closing), timeout=CLOSING)
            for member in self.members.values():
                self.ray.kill(member.actor)
        self.connection.close()

    # ---- Workers

    def assemble(self) -> None:
        """Wait until enough workers have reported and were accepted. Raises EngineError if there are too few."""
        low, _ = self.engine.limits
        began, first = time.monotonic(), 0.0
        with waiting("Waiting for workers", self.log, lambda _: self._status()):
            while True:
                self._scale()
                list(self._step())
                reported = [member for member in self.members.values() if member.report is not None]
                first = first or (time.monotonic() if reported else 0.0)
                is_late = first and time.monotonic() > first + GRACE and len(reported) >= low
                if reported and (is_late or len(reported) + len(self.refused) >= self._capacity()):
                    self._admit(reported)
                    if self._reported_count() >= low:
                        break
                    first = 0.0
                if self._is_timed_out(time.monotonic() - began):
                    raise EngineError(self._too_few())
        names = ", ".join(sorted({member.report.device for member in self.members.values() if member.report}))
        ready = self._reported_count()
        line = f"{with_noun(ready, 'worker')} ({names}){self.connection.dashboard}"
        self.log(Event.of(line, "started", workers=ready))

    def _status(self) -> str:
        wanted = self.engine.limits[0]
        return f"Waiting for workers: {self._reported_count()} of {wanted} or more have reported; {self._resources()}"

    def _reported_count(self) -> int:
        return sum(member.report is not None for member in self.members.values())

    def _resources(self) -> str:
        nodes = self._nodes()
        total = {kind: sum(node["Resources"].get(kind, 0) for node in nodes) for kind in ("CPU", "GPU")}
        parts = with_noun(len(nodes), "machine"), with_noun(total["CPU"], "core"), with_noun(total["GPU"], "GPU")
        return f"the cluster has {', '.join(parts)}"

    def _is_timed_out(self, seconds: float) -> bool:
        """Whether to wait no longer for the smallest number of workers."""
        low, _ = self.engine.limits
        slots = self._slots()
        if slots and set(slots) <= set(self.refused):
            return True
        possible = self._capacity() - len(self.refused)
        return seconds > (self.engine.patience if not self.connection.is_own or possible >= low else 0)

    def _too_few(self) -> str:
        low, _ = self.engine.limits
        reasons = list(dict.fromkeys(self.refused.values()))
        if reasons:
            return (
                f"no worker can take part: {reasons[-1]}"
                if not self._reported_count()
                else (f"{argument('workers')} asks for {low} or more, but fewer can take part: {reasons[-1]}")
            )
        device, slot = self.device or "cpu", next(iter(self._slots().values()), None)
        need = f"{with_noun(slot.gpus, 'GPU')} and " if slot and slot.gpus else "1 GPU and " if device == "gpu" else ""
        cores = slot.cpus if slot else self.engine.cpus_per_worker or 1
        return (
            f"there is no room for {with_noun(low, 'worker')} of {need}{with_noun(cores, 'core')}: "
            f"{self._resources()}; lower {argument('workers')}, {argument('gpus_per_worker')} or "
            f"{argument('cpus_per_worker')}, or add machines"
        )

    def _nodes(self) -> list[dict[str, Any]]:
        return [node for node in self.ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1]

    def _slots(self) -> dict[Hashable, _Slot]:
        """Room for workers in the cluster as it is now, and as many more as were asked for, by a key that stays."""
        nodes, (_, high), cores = self._nodes(), self.engine.limits, self.engine.cpus_per_worker
        if not self.device:
            if not nodes and self.job.device == "auto":
                return {}
            has_gpu = any(node["Resources"].get("GPU", 0) for node in nodes)
            self.device = "gpu" if self.job.device == "gpu" or (self.job.device == "auto" and has_gpu) else "cpu"
        if self.device == "gpu":
            slot = _Slot(cores or 1, self.engine.gpus_per_worker, None, cores)
            return dict.fromkeys(range(_room(slot, nodes) if high is None else high), slot)
        if cores:
            slot = _Slot(cores, 0, None, cores)
            return dict.fromkeys(range(_room(slot, nodes) if high is None else high), slot)
        slots = {}
        each = max(1, -(-(high or 0) // max(1, len(nodes))))  # workers on a machine
        for number in range(each):
            for node in nodes:
                share = int(node["Resources"]["CPU"]) // each
                if share and (high is None or len(slots) < high):
                    slots[node["NodeID"], number] = _Slot(share, 0, node["NodeID"], share)
        return slots

    def _capacity(self) -> int:
        """Number of workers that the cluster has room for now."""
        slots = self._slots()
        slot = next(iter(slots.values()), None)
        return len(slots) if slot is None or slot.node else min(len(slots), _room(slot, self._nodes()))

    def _scale(self) -> None:
        """Start a worker in each free slot."""
        if time.monotonic() < self.scaled + SCALE_PERIOD:
            return
        self.scaled = time.monotonic()
        if not self.connection.has_head():
            return
        for key, slot in self._slots().items():
            if key in self.members or key in self.refused or time.monotonic() < self.blocked_until.get(key, 0):
                continue
            options: dict[str, Any] = {"num_cpus": slot.cpus, "num_gpus": slot.gpus, "max_concurrency": DEPTH + 2}
            options |= {"max_restarts": 0, "max_task_retries": 0}
            if slot.node is not None:
                from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

                options["scheduling_strategy"] = NodeAffinitySchedulingStrategy(slot.node, soft=False)
            elif self.refused_nodes:
                options["label_selector"] = {"ray.io/node-id": f"!in({','.join(sorted(self.refused_nodes))})"}
            member = _Member(key, slot, self.actor_type.options(**options).remote())
            self.members[key] = member
            self._call(member, "open")

    def _admit(self, members: Sequence[_Member]) -> None:
        """Release the workers that cannot take part; the first call decides what all must agree on."""
        kind = (self.engine.device_kind or "").lower()
        able = []
        for member in members:
            assert member.report is not None
            if kind not in member.report.device.lower():
                self._refuse(
                    member, f"its device is {member.report.device!r}, but {argument('device_kind')} is {kind!r}"
                )
            else:
                able.append(member)
        if able:
            refusals = self.job.refusals([member.report for member in able if member.report])
            for member, refusal in zip(able, refusals, strict=True):
                if refusal:
                    self._refuse(member, refusal)

    def _refuse(self, member: _Member, reason: str) -> None:
        """Release a worker for good, and keep others from its machine."""
        self.refused[member.key] = f"{member.name}: {reason}"
        if member.node:
            self.refused_nodes.add(member.node)
        line = f"{member.name} is released: {reason}"
        self.log(Event.of(line, "released", worker=member.name, reason=reason))
        self._remove(member)
        if member.slot.node is None:  # those that wait for room would start on the same machine
            for other in list(self.members.values()):
                if other.report is None:
                    self._remove(other)

    def _remove(self, member: _Member) -> None:
        for reference in member.calls:
            self.calls.pop(reference, None)
        self.members.pop(member.key, None)
        with contextlib.suppress(Exception):
            self.ray.kill(member.actor)

    def _ready_count(self) -> int:
        return sum(member.ready for member in self.members.values())

    # ---- Work

    def _call(self, member: _Member, kind: str, items: Sequence[Any] = (), alone: bool = False) -> None:
        if kind == "open":
            reference = member.actor.open.remote(self.opening, self.device, member.slot.cores, member.slot.gpus)
        else:
            reference = getattr(member.actor, kind).remote(*([items] if kind == "run" else []))
        call = _Call(member, kind, items, alone, time.monotonic())
        self.calls[reference] = member.calls[reference] = call

    def _feed(self) -> None:
        """Give items to the workers that have room for them."""
        ready = [member for member in self.members.values() if member.ready]
        for member in ready:
            if self.retry_queue and not member.calls:
                for items in self.retry_queue:
                    if len(ready) == 1 or self.failed_on.get(items[0]) != member.name:
                        self.retry_queue.remove(items)
                        self._call(member, "run", items, alone=True)
                        break
        for member in sorted(ready, key=lambda member: len(member.calls)):
            assert member.report is not None
            while self.todo and len(member.calls) < DEPTH and not member.has_retry:
                # The last items are shared, also by workers that are still starting.
                share = -(-len(self.todo) // (DEPTH * max(len(ready), min(self._expected, len(self.members)))))
                count = min(member.report.group, share)
                items = [self.todo.popleft() for _ in range(count)]
                self._call(member, "run", items)
        if not self.todo and not self.retry_queue:
            self._repeat_late(member for member in ready if not member.calls)

    @property
    def _expected(self) -> int:
        """Number of workers that hold their room; others wait for a machine."""
        return sum(member.report is not None or member.slot.node is not None for member in self.members.values())

    def _repeat_late(self, idle: Iterator[_Member]) -> None:
        """Give items that take far longer than others to idle workers, too."""
        if not self.seconds:
            return
        late = time.monotonic() - max(STRAGGLER_SECONDS, STRAGGLER * statistics.median(self.seconds))
        for call in list(self.calls.values()):
            if call.kind == "run" and call.began < late and not call.repeated:
                items = [item for item in call.items if item in self.missing]
                member = next(idle, None)
                if member is None:
                    return
                call.repeated = True
                if items:
                    self._call(member, "run", items)

    def _step(self, seconds: float = 1.0) -> Iterator[Done]:
        """Wait for answers, at most this long, and act on them; yield items that are done."""
        if not self.calls:
            time.sleep(min(seconds, 0.2))
            return
        ready, _ = self.ray.wait(list(self.calls), num_returns=1, timeout=seconds)
        if ready:  # all that have come
            ready, _ = self.ray.wait(list(self.calls), num_returns=len(self.calls), timeout=0)
        for reference in ready:
            call = self.calls.pop(reference, None)
            if call is None:
                continue  # its worker was removed meanwhile
            call.member.calls.pop(reference)
            try:
                answer = self.ray.get(reference)
            except self.ray.exceptions.RayError as error:
                self._lose(call, error)
                continue
            yield from self._answered(call, answer)

    def _answered(self, call: _Call, answer: Any) -> Iterator[Done]:
        member = call.member
        if call.kind == "run":
            if isinstance(answer, Failure):
                return self._failed(call, answer.error)
            self.seconds.append(time.monotonic() - call.began)
            self.losses = 0
            self.blocked_until.pop(member.key, None)
            for item, result in zip(call.items, answer, strict=True):
                if item in self.missing:
                    del self.missing[item]
                    yield Done(item, result, member.name)
        elif isinstance(answer, Failure):
            self._refuse_or_raise(member, f"{answer.error}")
        elif call.kind == "open":
            member.name, member.node, member.report = answer
            if self.opened:
                self._admit([member])
                if member.key in self.members:
                    if member.key not in self.seen:  # otherwise it replaces one that was lost
                        self.log(Event.of(f"{member.name} joins", "joined", worker=member.name))
                    self._call(member, "check")
            self.seen.add(member.key)
        elif answer:
            self._refuse_or_raise(member, answer)
        else:
            member.ready = True

    def _refuse_or_raise(self, member: _Member, reason: str) -> None:
        """Release a worker; raise EngineError if it was the last that could come."""
        self._refuse(member, reason)
        if self.opened and not self.members and set(self._slots()) <= set(self.refused):
            raise EngineError(f"no worker is left: {member.name}: {reason}; what is made stays")

    def _failed(self, call: _Call, error: Exception) -> Iterator[Done]:
        """Try the items of a failed call again; raise the error if that is of no use."""
        if isinstance(error, UserError) and not isinstance(error, FolderError):
            raise error  # the same for every worker
        self.failed_on |= dict.fromkeys(call.items, call.member.name)
        self._again(call, error)
        return iter(())

    def _again(self, call: _Call, error: Exception | str) -> None:
        """Have the items of a call that failed run again, alone; raise the error if one has failed alone too often."""
        items = [item for item in call.items if item in self.missing and not self._is_running(item)]
        if call.alone and len(call.items) == 1 and items:
            item = items[0]
            self.failures[item] = self.failures.get(item, 0) + 1
            if self.failures[item] >= self.engine.retries:
                name, times = getattr(item, "name", item), with_noun(self.failures[item] + 1, "time")
                sentence = f"{name} failed {times}, the last on {call.member.name}: {error}; what is made stays"
                raise type(error)(sentence) if isinstance(error, Error) else EngineError(sentence)
        if items:
            self.retry_queue.extend([[item] for item in items] if call.alone else [items])

    def _lose(self, call: _Call, error: Exception) -> None:
        """Replace a worker that died, and have its items run again."""
        member, cause = call.member, _cause(error)
        calls = [call, *member.calls.values()]
        self._remove(member)
        missing_module = re.search(r"No module named '([\w.]+)'", str(error))
        if missing_module and call.kind == "open":
            member.name = f"the machine {member.node[:8]}" if member.node else "a machine of the cluster"
            reason = f"it has no module {missing_module[1]}: install gen2d there, as it is here"
            return self._refuse_or_raise(member, reason)
        items = [item for each in calls for item in each.items if item in self.missing]
        again = f"; {with_noun(len(items), self.job.noun)} will be run again" if items else ""
        node_is_known = member.node and member.node in {node["NodeID"] for node in self._nodes()}
        cause = cause if node_is_known or not member.node else "its machine is gone"
        line, names = f"{member.name} is lost ({cause}){again}", [f"{getattr(item, 'name', item)}" for item in items]
        if member.report is not None:  # otherwise it never was one
            self.log(Event.of(line, "lost", worker=member.name, cause=cause, items=names))
        for each in calls:
            self._again(each, cause)
        self.losses += 1
        pause = min(0.5 * 2 ** min(self.losses, 6), 30.0) if self.losses > 2 else 0.0
        if cause != DIED:
            pause = max(pause, UNREACHABLE)
        self.blocked_until[member.key] = time.monotonic() + pause
        if self.losses > (self.engine.retries + 1) * (len(self._slots()) + 1):
            raise EngineError(
                f"{self.losses} workers died one after the other before any finished a {self.job.noun}, the last as "
                f"{cause}; what is made stays"
            )

    def _is_running(self, item: Any) -> bool:
        return any(item in call.items for call in self.calls.values())


def _room(slot: _Slot, nodes: Sequence[dict[str, Any]]) -> int:
    """Number of such slots that these machines hold."""
    room = 0
    for node in nodes:
        has = node["Resources"]
        room += int(min(has["CPU"] // slot.cpus, has.get("GPU", 0) // slot.gpus if slot.gpus else math.inf))
    return room


def _cause(error: Exception) -> str:
    text = str(error)
    if "node has died" in text or "node was terminated" in text:
        return "its machine is gone"
    if "memory" in text.lower() and "running low" in text:
        return "its machine ran out of memory"
    return DIED if "Unavailable" not in type(error).__name__ else "it cannot be reached"
