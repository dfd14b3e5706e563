"""Speed of each stage of gen2d beside peer.py, compared with the project's targets.

    python tests/bench/bench.py                 # everything, about 10 minutes
    python tests/bench/bench.py --quick         # short run, to check a change of the code
    python tests/bench/bench.py --only physics  # cost of physics against the number of objects: bench_physics.py
    python tests/bench/bench.py --only render   # cost of rendering and annotations: bench_render.py
    python tests/bench/bench.py --only families # cost of sampling, for every scene family
    python tests/bench/bench.py --only storage  # cost of writing and reading: bench_storage.py
    python tests/bench/bench.py --only states   # cost of datasets of states whose frames are rendered when loaded
    python tests/bench/bench.py --only shards   # cost of a folder of 100,000 shards

Machines are noisy, so quantities that are compared are measured in turns, and a ratio is the median over the turns.
Every measurement runs in a separate process, on the cores that it is given, and in temporary folders.
"""

import argparse
import importlib.metadata
import json
import os
import platform
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve()
SUPPORT = HERE.parents[1] / "support"
sys.path.append(str(SUPPORT))

import bench_physics
import bench_render
import bench_storage
import numpy as np
from bench_physics import CASES, Cost
from bench_render import Annotated, Drawing
from bench_storage import Stored
from timing import first_batch, medians, timed

from gen2d.dataset.folder import open_folder
from gen2d.dataset.shard_writer import ShardWriter
from gen2d.generation.complete import complete

CONFIG = "benchmark.yaml"
FRAMES_BYTES = 64 * 64 * 64 * 3  # of an uncompressed video
CORES = sorted(os.sched_getaffinity(0))
Turns = Mapping[str, Sequence[float]]  # measurements by name, one per turn


# ---- Measurements, each in a separate process


def in_turns(works: Mapping[str, Callable[[], float]], turns: int) -> dict[str, list[float]]:
    """Results of each function in each turn, after one round of warm-up."""
    rounds = [{name: work() for name, work in works.items()} for _ in range(turns + 1)][1:]
    return {name: [turn[name] for turn in rounds] for name in works}


def stages(folder: Path, turns: int = 5, peer_videos: int = 32, overrides: Sequence[str] = ()) -> Turns:
    """Seconds per video of each stage of gen2d, and of the peer's stepping and rendering, on this process's cores."""
    import cv2
    import peer

    cv2.setNumThreads(1)
    works = _stages(folder, overrides) | {
        f"peer {read}": lambda read=read: peer.seconds_to_step(peer_videos, read) / peer_videos for read in peer.READERS
    }
    return in_turns(works | {"peer draw": lambda: peer.seconds_to_draw(peer_videos) / peer_videos}, turns)


def _stages(folder: Path, overrides: Sequence[str], config: str = CONFIG) -> dict[str, Callable[[], float]]:
    """For each stage of gen2d, a function that runs it on a batch and returns the seconds per video."""
    import jax

    from gen2d.generation import encoder as encoder_module
    from gen2d.generation.worker import dataset_of
    from gen2d.programs import devices
    from gen2d.programs.source import VideoRange

    source = source_of(overrides, config)
    rollout = source.rollout
    sample, simulate, numbers = _physics(rollout)
    start, batch = sample(numbers), first_batch(rollout)
    shard_videos = rollout.videos_per_shard // rollout.batch_size * rollout.batch_size
    dataset = dataset_of(source, folder / "data", {"train": shard_videos}, {})
    shard, *_ = open_folder(dataset)
    encoder = encoder_module.Encoder(source, dataset, encoder_module.threads_for(devices.cores()))
    slices = [jax.block_until_ready(videos) for videos in source.slices([VideoRange("train", 0, rollout.batch_size)])]

    def encode() -> list[Any]:
        return [encoder.encode(videos) for videos in slices]

    blocks = encode() * (shard_videos // rollout.batch_size)

    def draw() -> None:
        for videos in slices:
            jax.block_until_ready(rollout.draw(batch, videos.part.start, rollout.slice))

    def transfer() -> list[Any]:
        return [
            rollout.host_columns(batch),
            *(np.asarray(array) for videos in slices for array in videos.rendered.values()),
        ]

    works: dict[str, Callable[[], Any]] = {
        "sampler": lambda: jax.block_until_ready(sample(numbers)),
        "simulate": lambda: jax.block_until_ready(simulate(*start)),
        "render": draw,
        "transfer": transfer,
        "compress": encode,
    }
    clock = time.perf_counter
    timed_works = {name: timed(work, rollout.batch_size, clock) for name, work in works.items()}
    return timed_works | {"write": timed(lambda: ShardWriter(dataset).write(shard, blocks), shard_videos, clock)}


def source_of(overrides: Sequence[str] = (), config: str = CONFIG) -> Any:
    """Video source of a config, on all devices of this process."""
    from gen2d.config.config import load_config
    from gen2d.programs import devices
    from gen2d.programs.source import VideoSource

    return VideoSource(load_config(config, overrides), devices.prepare())


def _physics(rollout: Any) -> tuple[Callable, Callable, np.ndarray]:
    """Separate programs of sampling and simulation, and the numbers of a batch of videos."""
    import jax
    import jax.numpy as jnp

    from gen2d.physics.params import solver_params
    from gen2d.physics.simulate import simulate
    from gen2d.records import axes, keys

    config = rollout.config
    root, length = keys.seed_words(0, 0), (config.video.frames, rollout.steps)
    params = solver_params(config.physics, config.video.fps, rollout.steps)

    def sample_batch(numbers: Any) -> Any:
        sampled_scene = jax.vmap(rollout.sampler.sample)(keys.video_keys(jnp.asarray(root), numbers))[1]
        return sampled_scene.scene, sampled_scene.state

    def simulate_batch(scene: Any, state: Any) -> Any:
        device = axes.to_device(scene), axes.to_device(state)
        return axes.to_stored(simulate(*device, rollout.layout, params, *length, sparse=True))

    return jax.jit(sample_batch), jax.jit(simulate_batch), np.arange(rollout.batch_size, dtype=np.uint32)


def steady(folder: Path, videos: int = 4096, turns: int = 3, peer_videos: int = 0, lanes: int = 0) -> Turns:
    """Videos/s of compiled gen2d, from first batch to manifest, and of the peer; shares of cores used and idle.

    `peer_videos` also measures states alone. `lanes` is the number of devices and encoder threads; by default one for
    each core.
    """
    from gen2d.programs import devices

    if lanes:
        devices.cores = lambda: lanes
    source, used, idle = source_of(), [], []

    def rate(source: Any) -> float:
        with tempfile.TemporaryDirectory(dir=folder) as out:
            began = time.perf_counter()
            make(source, videos, Path(out))
            return videos / (time.perf_counter() - began)

    def ours() -> float:
        before, began = _cpu_seconds(), time.perf_counter()
        result, seconds = rate(source), time.perf_counter() - began
        used_seconds, idle_seconds = (after - b for after, b in zip(_cpu_seconds(), before, strict=True))
        used.append(used_seconds / seconds / len(os.sched_getaffinity(0)))
        idle.append(idle_seconds / seconds / (os.cpu_count() or 1))
        return result

    works: dict[str, Callable[[], float]] = {"gen2d": ours}
    if peer_videos:
        states_alone = source_of(["storage.frames=none"])
        works["states"] = lambda: rate(states_alone)
        works |= {f"peer {read}": lambda read=read: peer_command(peer_videos, read)[0] for read in ("body", "batch")}
    return in_turns(works, turns) | {"used": used[1:], "idle": idle[1:]}


def make(source: Any, videos: int, out: Path) -> None:
    """Generate a dataset as `gen2d.generate` does, with programs that are already compiled."""
    from gen2d.generation import encoder as encoder_module
    from gen2d.generation import writers as writers_module
    from gen2d.generation.worker import dataset_of
    from gen2d.programs import devices

    dataset = dataset_of(source, out, {"train": videos}, {})
    encoder = encoder_module.Encoder(source, dataset, encoder_module.threads_for(devices.cores()))
    with ShardWriter(dataset) as writer:
        writers = writers_module.ShardWriters(writer)
        for shard, block in encoder.blocks(encoder_module.shard_ranges(open_folder(dataset))):
            writers.put(shard, block)
        writers.finish()
    encoder.close()
    assert complete(dataset)


def _cpu_seconds() -> tuple[float, float]:
    """CPU seconds that this process has used, and idle seconds of all cores of this machine."""
    idle = sum(map(int, Path("/proc/stat").read_text().split()[4:6])) / os.sysconf("SC_CLK_TCK")
    return sum(resource.getrusage(resource.RUSAGE_SELF)[:2]), idle


def bounds(folder: Path) -> dict[str, float]:
    """Number of broken videos: a state is not finite, or a centre is nearer to a wall than 3/4 of the radius."""
    import gen2d

    dataset = gen2d.open(folder, fields=("states/*", "objects/radius", "objects/kind", "objects/present", "quality/*"))
    bad, walls, overlap = 0, 0.0, 0.0
    for first in range(0, len(dataset), 500):
        videos = dataset[first : first + 500]
        balls = (videos["objects/present"] & (videos["objects/kind"] == 0))[:, None]
        position, radius = videos["states/position"], videos["objects/radius"][:, None]
        gap = np.where(balls, np.minimum(position, 10.0 - position).min(-1) - radius, 0.0)
        states = [values for name, values in videos.items() if name.startswith("states/")]
        finite = np.all([np.isfinite(values.reshape(len(values), -1)).all(1) for values in states], axis=0)
        bad += int((~((gap >= -0.25 * radius).all((1, 2)) & finite)).sum())
        walls, overlap = max(walls, float(-gap.min())), max(overlap, float(videos["quality/max_penetration"].max()))
    return {"videos": len(dataset), "bad": bad, "walls": walls, "overlap": overlap}


def physics(folder: Path, scene: str, turns: int) -> Turns:
    """CPU seconds per video of gen2d, pymunk and phyjax2d (if installed), and of gen2d's compilation."""
    works, compiled = bench_physics.works(CASES[scene])
    return in_turns(works, turns) | {name: [seconds] for name, seconds in compiled.items()}


def physics_option(
    folder: Path, turns: int, config: str, option: str, values: Sequence[str], overrides: Sequence[str] = ()
) -> Turns:
    """CPU seconds per video of the simulation of a config, by the value of an option of its physics; and the overlap,
    m, that a hundredth of the videos exceeds."""
    import jax

    overlaps: dict[str, list[float]] = {}

    def simulation(value: str) -> Callable[[], float]:
        rollout = source_of([f"physics.{option}={value}", *overrides], config).rollout
        programs, device, numbers = rollout.programs, rollout.devices[0], np.arange(rollout.batch_size, dtype=np.uint32)
        grid, words = np.zeros((len(numbers), 0), np.float32), np.zeros(3, np.uint32)
        sampled = programs["sample"](device, words, np.int32(0), grid, numbers, np.zeros_like(numbers))
        start = sampled.keys, sampled.scene, sampled.state
        depth = programs["simulate"](device, *start).trajectory.quality.max_penetration
        overlaps[f"overlap {value}"] = [float(np.quantile(np.asarray(depth), 0.99))]
        return timed(lambda: jax.block_until_ready(programs["simulate"](device, *start)), len(numbers))

    return in_turns({value: simulation(value) for value in values}, turns) | overlaps


def render(folder: Path, case: str, turns: int) -> Turns:
    """CPU seconds per frame of gen2d, OpenCV and a copy."""
    bench_case = bench_render.CASES[case]
    return in_turns(bench_render.works(bench_case, source_of(bench_case.overrides).rollout), turns)


def looks(folder: Path, case: str, turns: int) -> Turns:
    """CPU seconds per frame in each look, of discs between walls."""
    return _frames(case, {name: (option,) for name, option in bench_render.LOOKS.items()}, turns)


def sensors(folder: Path, case: str, turns: int) -> Turns:
    """CPU seconds per frame with the stages of the sensor."""
    stages = {name: [f"image.{option}" for option in options] for name, options in bench_render.SENSORS.items()}
    return _frames(case, stages, turns)


def surfaces(folder: Path, case: str, turns: int) -> Turns:
    """CPU seconds per frame of lit objects with annotations of their surfaces."""
    look, added = bench_render.LOOKS["studio"], bench_render.SURFACES
    return _frames(
        case, {name: (look, *(f"annotations.{option}" for option in options)) for name, options in added.items()}, turns
    )


def _frames(case: str, overrides: Mapping[str, Sequence[str]], turns: int) -> Turns:
    """CPU seconds per frame of a case with overrides of its config, by name."""
    common = bench_render.CASES[case].overrides
    rollouts = {name: source_of((*common, *more)).rollout for name, more in overrides.items()}
    return in_turns(bench_render.frame_works(rollouts), turns)


def lit(folder: Path, videos: int = 512, turns: int = 5) -> Turns:
    """CPU seconds per video to make datasets of bouncing.yaml in each look, and their bytes per video."""
    works: dict[str, Callable[[], float]] = {}
    sizes: dict[str, list[float]] = {}
    for look in bench_render.LOOKS:
        source, root = source_of([f"look.name={look}"], "bouncing.yaml"), folder / look
        make(source, videos, root)
        sizes[f"bytes {look}"] = [sum(path.stat().st_size for path in root.rglob("*") if path.is_file()) / videos]

        def remake(source: Any = source) -> None:
            with tempfile.TemporaryDirectory(dir=folder) as out:
                make(source, videos, Path(out))

        works[look] = timed(remake, videos)
    return in_turns(works, turns) | sizes


def annotated(folder: Path, turns: int) -> Turns:
    """CPU seconds per frame of rendering with each annotation, and the bytes per frame of the annotation."""
    options = {name: [f"annotations.{part}" for part in parts] for name, parts in bench_render.ANNOTATIONS.items()}
    rollouts = {name: source_of((*bench_render.ANNOTATED.overrides, *parts)).rollout for name, parts in options.items()}
    works, sizes = bench_render.annotation_works(rollouts)
    return in_turns(works, turns) | {f"bytes {name}": [size] for name, size in sizes.items()}


def family(folder: Path, name: str, turns: int) -> Turns:
    """Seconds per video of each stage, with the config of a scene family."""
    return in_turns(_stages(folder, (), f"{name}.yaml"), turns)


def storage(folder: Path, case: str, turns: int) -> Turns:
    """CPU seconds to write, read and copy all videos of a case."""
    return in_turns(bench_storage.works(bench_storage.CASES[case], folder), turns)


def states(folder: Path, videos: int = 512, turns: int = 7, window: int = 16, overrides: Sequence[str] = ()) -> Turns:
    """CPU seconds per video to make datasets with frames and of states alone, and to load frames of both; their sizes.

    Videos are loaded in random order by one thread, into preallocated arrays: whole, and windows of some frames.
    """
    import gen2d

    works: dict[str, Callable[[], float]] = {}
    sizes: dict[str, list[float]] = {}
    order, batch = np.random.default_rng(0).permutation(videos), min(64, videos)
    for name, frames in (("frames", "video"), ("states", "none")):
        source, root = source_of((f"storage.frames={frames}", *overrides)), folder / name
        make(source, videos, root)
        sizes[f"bytes {name}"] = [sum(path.stat().st_size for path in root.rglob("*") if path.is_file()) / videos]

        def remake(source: Any = source) -> None:
            with tempfile.TemporaryDirectory(dir=folder) as out:
                make(source, videos, Path(out))

        works[f"make {name}"] = timed(remake, videos)
        for view, length in (("videos", None), ("windows", window)):
            ds = gen2d.open(root, fields=["frames"], window=length, start="first")
            out = ds.empty(batch)

            def load(ds: Any = ds, out: Any = out) -> None:
                for first in range(0, videos - batch + 1, batch):
                    ds.batch(order[first : first + batch], out=out)

            works[f"load {view} of {name}"] = timed(load, videos // batch * batch)
    return in_turns(works, turns) | sizes


MEASURED = (
    stages, steady, bounds, physics, physics_option, render, looks, sensors, surfaces, lit, annotated, family, storage,
    states,
)  # fmt: skip
MEASUREMENTS = {work.__name__: work for work in MEASURED}


# ---- Processes


class Ran(NamedTuple):
    """A completed command."""

    seconds: float
    cpu: float  # s, of all its processes
    peak: int  # memory, bytes
    text: str


def run(command: Sequence[object], cores: Sequence[int] = CORES, env: Mapping[str, str] | None = None) -> Ran:
    """Run a command on these cores; by taskset, as forks of a process with jax may hang. Exits if the command fails."""
    path = os.pathsep.join([str(HERE.parents[2]), str(SUPPORT), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path, **(env or {})}
    line = ["taskset", "-c", ",".join(map(str, cores)), *map(str, command)]
    began = time.perf_counter()
    process = subprocess.Popen(
        line, cwd=tempfile.gettempdir(), env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert process.stdout is not None
    text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{text}\nbench.py: {' '.join(line)} failed")
    return Ran(time.perf_counter() - began, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024, text)


def measure(work: Callable, folder: Path, cores: Sequence[int] = CORES, **options: Any) -> Any:
    """Result of one of MEASUREMENTS, run in a separate process."""
    ran = run([sys.executable, HERE, "--measure", work.__name__, folder, json.dumps(options)], cores)
    return json.loads(next(line for line in ran.text.splitlines() if line.startswith("{")))


def command(videos: int, out: Path, *overrides: str, cache: Path | None = None, config: str = CONFIG) -> Ran:
    """Run `python -m gen2d` to generate a new dataset."""
    arguments = ["--config", config, "--n", videos, "--out", out, *(part for s in overrides for part in ("--set", s))]
    env = {"JAX_COMPILATION_CACHE_DIR": str(cache)} if cache else {}
    return run([sys.executable, "-m", "gen2d", *arguments], env=env)


def peer_command(videos: int, read: str = "body") -> tuple[float, float]:
    """Videos/s of the peer with gzip, and the seconds of its start-up."""
    with tempfile.TemporaryDirectory() as out:
        ran = run([sys.executable, HERE.with_name("peer.py"), "--n", videos, "--read", read, "--out", out])
    seconds = float(re.findall(r"in ([\d.]+) s", ran.text)[-1])
    return videos / seconds, ran.seconds - seconds


# ---- Sections


class Row(NamedTuple):
    """A row of the table of speeds."""

    name: str
    rate: float  # videos/s
    peer: float | None = None
    share: float | None = None  # of the total time on one core
    note: str = ""


class Promise(NamedTuple):
    """A measured figure and its target; without a target it is reported for information."""

    name: str
    value: float
    unit: str = "x"
    target: float | None = None
    most: bool = False  # the target is a maximum, not a minimum
    note: str = ""

    @property
    def verdict(self) -> str:
        """The target and whether it is met; empty without a target."""
        if self.target is None:
            return ""
        is_met = self.value <= self.target if self.most else self.value >= self.target
        return f"{'at most' if self.most else 'at least'} {self.target:g}: {'kept' if is_met else 'NOT KEPT'}"


Result = Row | Promise | Cost | Drawing | Annotated | Stored
Results = Iterator[Result]
BETA = "an interface that pymunk calls highly experimental"
ALONE = f"against the frames alone, {bench_render.ANNOTATED.name}"


def _ratio(of: Sequence[float], to: Sequence[float]) -> float:
    return statistics.median(a / b for a, b in zip(of, to, strict=True))


def parts_section(folder: Path, quick: bool) -> Results:
    """Every stage on one core; physics and rendering beside the peer's."""
    turns = measure(stages, folder, CORES[:1], turns=4 if quick else 9)
    middle = medians(turns)
    peers = {"simulate": middle["peer body"], "render": middle["peer draw"]}
    ours = {name: seconds for name, seconds in middle.items() if not name.startswith("peer")}
    total = sum(ours.values())
    for name, seconds in ours.items():
        yield Row(name, 1 / seconds, 1 / peers[name] if name in peers else None, seconds / total)
    yield Row("all of these, 1 core", 1 / total)
    yield Promise("3 simulate, one core, against pymunk", _ratio(turns["peer body"], turns["simulate"]), target=5)
    yield Promise("  the same, against pymunk.batch", _ratio(turns["peer batch"], turns["simulate"]), note=BETA)
    yield Promise("4 render, one core, against OpenCV", _ratio(turns["peer draw"], turns["render"]), target=5)


def steady_section(folder: Path, quick: bool) -> Results:
    """End-to-end generation with compiled programs."""
    count, repeats = (2048, 2) if quick else (4096, 5)
    turns = measure(steady, folder, videos=count, turns=repeats, peer_videos=256 if quick else 512)
    middle = medians(turns)
    note = f"of the cores gen2d uses {middle['used']:.0%}, {middle['idle']:.0%} are idle"
    yield Row(f"end to end, {len(CORES)} cores", middle["gen2d"], middle["peer body"], note=note)
    yield Promise("1 end to end, against the peer", _ratio(turns["gen2d"], turns["peer body"]), target=5)
    yield Promise("  the same, it with pymunk.batch", _ratio(turns["gen2d"], turns["peer batch"]), note=BETA)
    yield Promise("  states alone, against the peer's frames", _ratio(turns["states"], turns["peer body"]), target=12)


def command_section(folder: Path, quick: bool) -> Results:
    """The whole command, with programs cached by an earlier run."""
    count, peer_count, ours, theirs = 8192, 512, [], []
    for turn in range(4):
        with tempfile.TemporaryDirectory(dir=folder) as out:
            ours.append(command(count if turn else 128, Path(out)).seconds)
        rate, start = peer_command(peer_count)
        theirs.append(start + count / rate)
    ratio = _ratio(theirs[1:], ours[1:])
    seconds = [statistics.median(values[1:]) for values in (ours, theirs)]
    note = f"{seconds[0]:.1f} s; the peer {seconds[1]:.1f} s, scaled from {peer_count} videos"
    yield Promise(f"2 whole command, {count} videos", ratio, target=5, note=note)


def memory_section(folder: Path, quick: bool) -> Results:
    """Peak memory of a small and a large dataset, and broken videos of the large one."""
    small, large = command(2000, folder / "small"), command(20000, folder / "large")
    yield Promise("5 peak memory, 20,000 videos", large.peak / 2**30, "GiB", 3, most=True)
    yield Promise("  the same, against 2,000 videos", large.peak / small.peak, target=1.1, most=True)
    checks = measure(bounds, folder / "large")
    note = f"deepest: {checks['walls']:.3f} m into a wall, {checks['overlap']:.3f} m at any step between any two"
    yield Promise(f"8 broken of {checks['videos']:,} videos", checks["bad"], "videos", 0, most=True, note=note)


def scaling_section(folder: Path, quick: bool) -> Results:
    """End-to-end speed on two cores against one."""
    if len(CORES) < 2:
        return
    runs = [measure(steady, folder, CORES[:k], videos=2048, turns=2) for _ in range(3) for k in (1, 2)]
    one, two = ([max(run["gen2d"]) for run in runs[k::2]] for k in (0, 1))
    used = statistics.median(max(run["used"]) for run in runs[1::2])
    note = f"{statistics.median(one):.0f} and {statistics.median(two):.0f} videos/s; of two cores gen2d got {used:.0%}"
    yield Promise("6 two cores against one", _ratio(two, one), target=1.8, note=note)
    rates = {lanes: max(measure(steady, folder, videos=2048, turns=2, lanes=lanes)["gen2d"]) for lanes in (2, 3, 4, 8)}
    for lanes in (3, 4, 8):
        yield Promise(f"  {lanes} devices on {len(CORES)} cores, against two", rates[lanes] / rates[2], target=0.95)


EDIT = (
    "scene.elasticity=[0.1, 0.4]",
    "scene.friction=[0.3, 0.6]",
    "physics.push_speed=0.9",
    "look.background=[12, 30, 61]",
)


SPACE = """
from gen2d import Space
space = Space(gravity=(0, -9.8))
space.add_segment((-6, 0), (6, 0), friction=0.8)
for k in range(4):
    space.add_box((0, 0.5 + k), width=1, height=1)
space.add_circle((-4, 1), radius=0.5, velocity=(8, 0), elasticity=0.5)
weight = space.add_circle((4, 2), radius=0.3)
space.add_joint("revolute", weight, anchor_a=(2.5, 4))
space.simulate(seconds=2, fps=30)
"""


def start_section(folder: Path, quick: bool) -> Results:
    """CPU seconds of a small job: the first of a family, one with edited numbers, and one that ran before."""
    for config, most in ({"bouncing": 20} if quick else {"bouncing": 20, "pile": 50}).items():
        jobs: dict[str, tuple[str, ...]] = {"cold": (), "edited": EDIT, "warm": (), "warm again": ()}
        runs = {
            job: command(
                16, folder / config / job, *overrides, cache=folder / config / "cache", config=f"{config}.yaml"
            )
            for job, overrides in jobs.items()
        }
        warm = [runs[job].cpu for job in ("warm", "warm again")]
        name = f"7 --n 16, {config}"
        yield Promise(f"{name}, cold", runs["cold"].cpu, "CPU s", most, most=True, note=f"{runs['cold'].seconds:.0f} s")
        yield Promise("  after editing numbers", runs["edited"].cpu, "CPU s", 6, most=True)
        yield Promise("  warm", min(warm), "CPU s", 4, most=True, note=f"{runs['warm again'].seconds:.1f} s")
    small = {
        "preview bouncing": [sys.executable, "-m", "gen2d", "preview", "bouncing.yaml", "--out", folder / "preview"],
        "a Space of the README": [sys.executable, "-c", SPACE],
    }
    for name, words in small.items():
        first, again = (run(words, env={"JAX_COMPILATION_CACHE_DIR": str(folder / "small")}) for _ in range(2))
        yield Promise(f"  {name}, cold", first.cpu, "CPU s", 20, most=True, note=f"{first.seconds:.0f} s")
        yield Promise(f"  {name}, warm", again.cpu, "CPU s", 4, most=True, note=f"{again.seconds:.1f} s")


def physics_section(folder: Path, quick: bool) -> Results:
    """Physics of 4 to 64 discs and of 8 boxes on one core, beside pymunk and phyjax2d."""
    if not bench_physics.has_phyjax2d():
        print(bench_physics.INSTALL)
    for case in CASES.values():
        turns = measure(physics, folder, CORES[:1], scene=case.name, turns=1 if quick else case.turns)
        cost = bench_physics.cost_of(case, medians(turns))
        floor, note = (5 if case.objects <= 32 and case.shape == "discs" else 1), "contacts and energy written"
        yield cost
        for other, target in {"pymunk": floor, "phyjax2d": floor if floor > 1 else None}.items():
            if other in turns:
                ratio = _ratio(turns[other], turns["all"])
                yield Promise(f"physics, {case.name}, against {other}", ratio, target=target, note=note)
        yield Promise("  compiled", cost.compile["all"], "s", 30, most=True)
    few = 3 if quick else 9
    options = {"config": "bouncing.yaml", "option": "precision", "values": ("float32", "float64")}
    turns = measure(physics_option, folder, CORES[:1], turns=few, **options)
    yield Promise("physics, float64 against float32", _ratio(turns["float32"], turns["float64"]), target=0.5)
    for name, most in RELAXED.items():
        options = {"config": f"{name}.yaml", "option": "relax_iterations", "values": ("1", "null")}
        turns = measure(physics_option, folder, CORES[:1], turns=few, **options)
        time, note = _ratio(turns["null"], turns["1"]), "time against one relaxing pass"
        yield Promise(f"physics, {name}.yaml, relax_iterations null", time, target=most, most=True, note=note)
        note = "a hundredth of the videos exceeds it"
        for passes in options["values"]:
            overlap = 1000 * turns[f"overlap {passes}"][0]
            yield Promise(f"  overlap, relax_iterations {passes}", overlap, "mm", note=note)


def render_section(folder: Path, quick: bool) -> Results:
    """Rendering of 2 to 32 discs at 64 to 256 px on one core, beside OpenCV and a copy; cost of annotations."""
    repeats = 5 if quick else 15
    for case in bench_render.CASES.values():
        turns = measure(render, folder, CORES[:1], case=case.name, turns=repeats)
        yield bench_render.drawing_of(case, medians(turns))
        target, name = 5 if case.pixels == 64 else None, f"render {case.name} against"
        yield Promise(f"{name} OpenCV", _ratio(turns["opencv"], turns["gen2d"]), target=target)
        if case.name == bench_render.COPIED:
            yield Promise(f"{name} a copy", _ratio(turns["gen2d"], turns["copy"]), target=4, most=True)
    for name, limit in zip(bench_render.LIT, (3, 4), strict=True):
        turns = measure(looks, folder, CORES[:1], case=name, turns=repeats)
        yield Promise(f"studio against flat, {name}", _ratio(turns["studio"], turns["flat"]), target=limit, most=True)
    turns = measure(lit, folder, CORES[:1], turns=3 if quick else 5)
    yield Promise("studio against flat, end to end", _ratio(turns["studio"], turns["flat"]), target=1.5, most=True)
    size = _ratio(turns["bytes studio"], turns["bytes flat"])
    yield Promise("studio against flat, bytes", size, target=1.6, most=True)
    limits = {"vignette, exposure, white balance": 2, "jpeg": 5}
    turns = measure(sensors, folder, CORES[:1], case=bench_render.LIT[0], turns=repeats)
    for name in list(turns)[1:]:
        ratio = _ratio(turns[name], turns["no sensor"])
        yield Promise(f"render with {name}", ratio, target=limits.get(name), most=True, note=ALONE)
    turns = measure(surfaces, folder, CORES[:1], case=bench_render.LIT[0], turns=repeats)
    for name in list(turns)[1:]:
        ratio = _ratio(turns[name], turns["studio"])
        yield Promise(f"studio with {name}", ratio, target=None, most=True, note=ALONE)
    yield from annotation_results(measure(annotated, folder, CORES[:1], turns=repeats))


def annotation_results(turns: Turns) -> Results:
    """Cost of rendering with annotations, relative to frames alone."""
    frames, limits = turns["frames"], {"masks, boxes, visibility": 1.5}
    for name in bench_render.ANNOTATIONS:
        added = [a - b for a, b in zip(turns[name], frames, strict=True)]
        (size,) = turns[f"bytes {name}"]
        yield Annotated(name, statistics.median(turns[name]) * 1e6, statistics.median(added) * 1e6, int(size))
        if name != "frames":
            yield Promise(
                f"render with {name}", _ratio(turns[name], frames), target=limits.get(name), most=True, note=ALONE
            )
        if name == "flow":
            each = _ratio(added, frames) * bench_render.ANNOTATED.frame_bytes / size
            yield Promise("  a byte of it, against one of frames", each, target=2, most=True)


def storage_section(folder: Path, quick: bool) -> Results:
    """Videos of three sizes on one core: loader against an h5py loop and a copy, writing against its codec."""
    for number, case in enumerate(bench_storage.CASES.values()):
        case_folder = folder / str(number)
        case_folder.mkdir()
        turns = measure(storage, case_folder, CORES[:1], case=case.name, turns=3 if quick else 9)
        yield bench_storage.stored_of(case, medians(turns))
        for codec in ("zstd", "gzip"):
            targets = case.against_gzip4, case.against_same, case.against_copy
            loader_seconds = turns[f"loader {codec}"]
            yield Promise(
                f"{case.name}, {codec}: loader against h5py, gzip-4",
                _ratio(turns["h5py gzip-4"], loader_seconds),
                target=targets[0],
            )
            yield Promise(
                "  against h5py on the same files", _ratio(turns[f"h5py {codec}"], loader_seconds), target=targets[1]
            )
            yield Promise("  against a copy", _ratio(turns["copy"], loader_seconds), target=targets[2])
            yield Promise(
                "  writing against the codec alone",
                _ratio(turns[f"codec {codec}"], turns[f"write {codec}"]),
                target=bench_storage.WRITTEN,
            )
        yield Promise(
            f"{case.name}, none: loader against a copy", _ratio(turns["copy"], turns["loader none"]), target=case.mapped
        )


def states_section(folder: Path, quick: bool) -> Results:
    """Datasets of states alone, whose frames are rendered when they are loaded, beside datasets with frames."""
    turns = measure(states, folder, CORES[:1], turns=3 if quick else 9)
    middle = medians(turns)
    for name, seconds in middle.items():
        if not name.startswith("bytes"):
            yield Row(name, 1 / seconds)
    for name in ("frames", "states"):
        yield Promise(f"a dataset of {name}", middle[f"bytes {name}"] / 1e3, "kB a video")
    yield Promise("9 size of stored frames, against states", middle["bytes frames"] / middle["bytes states"])
    for work, target in (("make", None), ("load videos of", 1), ("load windows of", 1)):
        ratio = _ratio(turns[f"{work} frames"], turns[f"{work} states"])
        yield Promise(f"  {work} states, against frames", ratio, target=target)


def shards_section(folder: Path, quick: bool) -> Results:
    """CPU seconds of a worker's start and end in a folder of many shards."""
    count = 10_000 if quick else 100_000
    for name, seconds in bench_storage.many_shards(folder / "many", count).items():
        yield Promise(f"{count:,} shards: {name}", seconds, "CPU s", target=5, most=True)


def families_section(folder: Path, quick: bool) -> Results:
    """Cost of sampling, relative to all other stages, for every scene family."""
    from gen2d.config import plugins

    for name in plugins.names("scene"):
        family_folder = folder / name
        family_folder.mkdir()
        turns = measure(family, family_folder, CORES[:1], name=name, turns=2 if quick else 5)
        shares = [
            turns["sampler"][i] / sum(of[i] for part, of in turns.items() if part != "sampler")
            for i in range(len(turns["sampler"]))
        ]
        yield Promise(f"{name}: sampler of all", 100 * statistics.median(shares), "%", target=5, most=True)


RELAXED = {"bouncing": 1.2, "seesaw": 1.3, "funnel": 1.4, "pile": 1.9}  # with the largest ratios of time
SECTIONS = {
    "parts": parts_section, "steady": steady_section, "command": command_section, "memory": memory_section,
    "scaling": scaling_section, "start": start_section, "physics": physics_section,
    "render": render_section, "families": families_section, "storage": storage_section, "states": states_section,
    "shards": shards_section,
}  # fmt: skip
QUICK = ("parts", "steady")


# ---- Report


def machine() -> dict[str, Any]:
    """Processor, number of cores, load and versions, which explain the figures."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    model = next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.machine())
    packages = ("jax", "jaxlib", "numpy", "h5py", "isal", "pymunk", "opencv-python-headless")
    versions = {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in packages}
    return {"cpu": model, "cores": len(CORES), "load": os.getloadavg()[0], **versions}


# Keys of the results in JSON; kinds of results with a table of their own; sections with a chart.
KINDS = {"rows": Row, "promises": Promise, "costs": Cost, "drawings": Drawing}
KINDS |= {"annotations": Annotated, "stored": Stored}
TABLES: Mapping[type, Callable[[Any], list[str]]] = {
    Cost: bench_physics.table,
    Drawing: bench_render.table,
    Annotated: bench_render.table_of_annotations,
    Stored: bench_storage.table,
}
CHARTS: Mapping[str, tuple[type, Callable[[Any, Path], None]]] = {
    "physics": (Cost, bench_physics.chart),
    "render": (Drawing, bench_render.chart),
}


def text_of(facts: Mapping[str, Any], results: Sequence[Result]) -> str:
    """Tables of the results, as text."""
    lines = [", ".join(f"{key} {value}" for key, value in facts.items())]
    rows, promises = [f for f in results if isinstance(f, Row)], [f for f in results if isinstance(f, Promise)]
    if rows:
        lines += ["", f"{'':21} {'videos/s':>9} {'MB/s':>8} {'share':>6} {'peer':>7} {'ratio':>6}"]
    for row in rows:
        share = f"{row.share:.0%}" if row.share else ""
        peer, ratio = (f"{row.peer:,.0f}", f"{row.rate / row.peer:.2f}") if row.peer else ("", "")
        speed = f"{row.rate:9,.0f} {row.rate * FRAMES_BYTES / 1e6:8,.0f}"
        lines += [f"{row.name:21} {speed} {share:>6} {peer:>7} {ratio:>6}  {row.note}".rstrip()]
    for kind, table in TABLES.items():
        own = [result for result in results if isinstance(result, kind)]
        lines += ["", *table(own)] if own else []
    lines += [""]
    for p in promises:
        lines += [f"{p.name:38} {p.value:7.2f} {p.unit:7} {p.verdict:22} {p.note}".rstrip()]
    return "\n".join(lines)


def main() -> None:
    """Run the measurements, print the tables and, on request, write JSON and a chart."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"only {' and '.join(QUICK)}, with fewer turns")
    parser.add_argument("--only", nargs="+", choices=tuple(SECTIONS), help="only these sections")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the section physics there, else render")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where gen2d computes (cpu)")
    parser.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    names = options.only or (QUICK if options.quick else SECTIONS)
    plotted = next((name for name in CHARTS if name in names), None)
    if options.plot and not plotted:
        parser.error("--plot draws the section physics or render, of which none is measured: add --only physics")
    if options.measure:
        name, folder, more = options.measure
        print(json.dumps(MEASUREMENTS[name](Path(folder), **json.loads(more))))
        return
    os.environ["JAX_PLATFORMS"] = options.device
    facts, results = machine(), []
    for name in names:
        with tempfile.TemporaryDirectory(prefix="gen2d-bench-") as folder:
            results += SECTIONS[name](Path(folder), options.quick)
    print(text_of(facts, results))
    if options.json:
        tables = {key: [f._asdict() for f in results if isinstance(f, kind)] for key, kind in KINDS.items()}
        options.json.write_text(json.dumps({"machine": facts} | tables, indent=1))
    if options.plot and plotted:
        kind, chart = CHARTS[plotted]
        chart([f for f in results if isinstance(f, kind)], options.plot)


if __name__ == "__main__":
    main()
