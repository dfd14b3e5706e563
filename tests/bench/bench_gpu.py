"""Speed of gen2d on one GPU, and agreement of its datasets with those of the CPU.

    python tests/bench/bench_gpu.py                      # everything, under 10 minutes
    python tests/bench/bench_gpu.py --only solvers,draw  # some sections
    python tests/bench/bench_gpu.py --seconds 200        # begin no section after so many seconds

Each figure is printed when it is measured, and a section that fails is reported and left out. Without a GPU it runs on
the CPU, to test this script. Rates are wall-clock, the best of three, with compiled programs.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from timing import first_batch, timed

HERE = Path(__file__).resolve()
ROOT = HERE.parents[2]
sys.path += [str(ROOT), str(HERE.parents[1] / "support")]

FAMILIES = ("bouncing", "collision", "pile", "chain")  # compared with the CPU
COMPARED = 16  # videos of each
ON_CPU = f"""
import sys, gen2d
for name in sys.argv[2:]:
    gen2d.generate(f"{{name}}.yaml", {COMPARED}, f"{{sys.argv[1]}}/{{name}}", device="cpu")
"""
Lines = Iterator[str]


def best(work: Callable[[], Any], turns: int = 3) -> float:
    """Seconds of the fastest of several calls, after one that is not measured."""
    import jax

    seconds = timed(lambda: jax.block_until_ready(work()), 1, time.perf_counter)
    return min([seconds() for _ in range(turns + 1)][1:])


def source_of(config: str, *overrides: str, slice_videos: int = 0) -> Any:
    """Video source of a config on the first device, with its programs compiled; slices of `slice_videos`, if not 0."""
    from gen2d.config.config import load_config
    from gen2d.programs import devices
    from gen2d.programs.source import VideoSource

    source = VideoSource(load_config(config, list(overrides)), devices.prepare()[:1])
    if slice_videos:
        source.rollout.slice = slice_videos
    source.rollout.compile()
    return source


# ---- Sections


def agreement(small: bool) -> Lines:
    """Differences of states and frames from those of the CPU, for families."""
    import gen2d
    from gen2d.config.config import load_config

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        names = FAMILIES[:1] if small else FAMILIES
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        reference = subprocess.Popen(
            [sys.executable, "-c", ON_CPU, str(root / "cpu"), *names],
            env={**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": path},
        )
        seconds = {}
        for name in names:
            began = time.perf_counter()
            gen2d.generate(f"{name}.yaml", COMPARED, root / "gpu" / name)
            seconds[name] = time.perf_counter() - began
        if reference.wait():
            raise RuntimeError("the datasets of the CPU failed")
        for name in names:
            ours, cpu = (gen2d.open(root / kind / name)[:] for kind in ("gpu", "cpu"))
            fps = round(load_config(f"{name}.yaml").video.fps)
            texts = []
            for span in (1, fps // 2, fps):
                shift = np.abs(ours["states/position"][:, : span + 1] - cpu["states/position"][:, : span + 1]).max(
                    (1, 2, 3)
                )
                frames = [values["frames"][:, : span + 1].astype(np.int16) for values in (ours, cpu)]
                grey = np.abs(frames[0] - frames[1])
                texts.append(
                    f"{span / fps:.2f} s: {np.median(shift):.1e} (most {shift.max():.1e}) m,"
                    f" {grey.max()} levels, over 1 in {(grey > 1).mean():.1e}"
                )
            yield f"{name:10} first run {seconds[name]:5.1f} s; " + "; ".join(texts)


def solvers(small: bool) -> Lines:
    """Microseconds per video and step of both solvers, by the number of objects and of videos at once."""
    import bench_physics
    from bench_physics import STEPPED, Case

    discs = (8, 4096), (4, 4096), (16, 2048), (32, 1024)
    cases = [*(Case("discs", n, size, (0, 0), 1) for n, size in discs), Case("boxes", 8, 4096, (0, 0), 1)]
    works = [(case, sparse) for case in cases[: 1 if small else None] for sparse in (False, True)]
    for (case, sparse), (program, inputs, seconds) in at_once(
        lambda case, sparse: bench_physics.gen2d_program(case, False, sparse=sparse), works
    ):
        compiling = f"compiled in {seconds:.0f} CPU s"
        seconds = best(lambda run=program, values=inputs: run(*values), 1)
        micros = seconds / case.batch_size / STEPPED * 1e6
        yield (
            f"{case.name:10} {'near' if sparse else 'all'} pairs, {case.batch_size:5} at once: {micros:8.3f} us a video"
            f" and step, {case.batch_size / seconds:9,.0f} videos/s, {seconds / STEPPED * 1e3:.2f} ms a step,"
            f" {compiling}"
        )


def at_once(function: Callable[..., Any], arguments: Sequence[tuple]) -> list[tuple[tuple, Any]]:
    """Arguments and results of a function that compiles, called in threads."""
    with ThreadPoolExecutor(12) as pool:
        return list(zip(arguments, pool.map(lambda values: function(*values), arguments), strict=True))


def batches(small: bool) -> Lines:
    """Videos per second of the simulation, by the number of videos in a batch."""
    sizes = (64,) if small else (512, 4096, 16384)
    in_time = "benchmark.yaml physics.impact_order=time"
    jobs = [(job, size) for job in ("benchmark.yaml", in_time, "phyworld_collision.yaml") for size in sizes]

    def source(job: str, size: int) -> Any:
        return source_of(*job.split(), f"storage.batch_size={size}", "storage.videos_per_shard=32768")

    for (job, size), compiled in at_once(source, jobs):
        seconds = best(lambda rollout=compiled.rollout: first_batch(rollout))
        yield f"{job:42} {size:6} videos at once: {size / seconds:10,.0f} videos/s, {seconds:.3f} s a batch"


def draw(small: bool) -> Lines:
    """Frames per second of the renderer, by the size of a frame and the number of videos rendered at once."""
    for look in ("flat", "studio"):
        for pixels in (64,) if small else (64, 128, 256):
            video = 64 * pixels**2 * 3
            sizes = sorted({max(1, raw // video) for raw in (2**24, 2**27, 2**30)})
            for count in sizes[:1] if small else sizes:
                source = source_of(
                    "benchmark.yaml", f"video.height={pixels}", f"video.width={pixels}", f"storage.batch_size={count}",
                    f"look.name={look}", slice_videos=count,
                )  # fmt: skip
                batch = first_batch(source.rollout)
                seconds = best(lambda s=source, b=batch, c=count: s.rollout.draw(b, 0, c)) / count
                yield (
                    f"{look:7} {pixels:3} px, {count:5} videos at once: {1 / seconds:10,.0f} videos/s,"
                    f" {64 / seconds:12,.0f} frames/s, {video / seconds / 1e9:6.2f} GB/s"
                )


def host(small: bool) -> Lines:
    """Speed of the way from the device to the host, and of compression there."""
    import jax

    from gen2d.dataset.block import encode
    from gen2d.generation.worker import dataset_of
    from gen2d.programs import devices
    from gen2d.programs.source import VideoRange
    from gen2d.storage import codecs

    ways = {"to NumPy": np.asarray, "to pinned memory": lambda array: np.asarray(devices.pinned(array))}
    for name, to_host in ways.items():
        for megabytes in (4,) if small else (16, 64, 512):
            for turn in ("first", "again"):  # jax reuses pinned memory
                arrays = [jax.block_until_ready(jax.numpy.full(megabytes << 20, i, np.uint8)) for i in range(16)]
                seconds = timed(lambda way=to_host, of=arrays: [way(array) for array in of], 1, time.perf_counter)()
                yield f"{name}, {megabytes:4} MiB arrays, {turn}: {(megabytes << 24) / seconds / 1e9:6.2f} GB/s"
    for config in ("benchmark.yaml", "phyworld_collision.yaml"):
        source, videos = source_of(config, "storage.batch_size=128"), 128
        with tempfile.TemporaryDirectory() as out:
            dataset = dataset_of(source, Path(out) / "data", {"train": videos}, {})
        fields = [part.fields() for part in source.slices([VideoRange("train", 0, videos)])]
        fields = [
            {k: v[i : i + 8] for k, v in part.items()} for part in fields for i in range(0, len(part["index"]), 8)
        ]
        raw = sum(part["frames"].nbytes for part in fields)

        def whole_block(part: Any, of: Any = dataset) -> Any:
            return encode(part, of.fields, of.codec, of.chunk_frames)

        def frames_alone(part: Any) -> Any:
            return [codecs.encode("gzip", video) for video in part["frames"]]

        for name, work in (("gzip alone", frames_alone), ("blocks", whole_block)):
            rates = []
            for threads in (1, 2, 4, 8, 16) if devices.cores() > 2 and not small else (1, 2):
                with ThreadPoolExecutor(threads) as pool:
                    began = time.perf_counter()
                    list(pool.map(work, fields * 2))
                    rates.append(f"{threads}: {2 * raw / (time.perf_counter() - began) / 1e9:.2f}")
            yield f"{config:24} {name}, GB/s of raw frames by threads: {', '.join(rates)}"


def whole(small: bool) -> Lines:
    """Videos per second of whole datasets."""
    import gen2d

    jobs = [
        ("phyworld_collision.yaml", 16384, ()),
        ("phyworld_collision.yaml", 65536, ("storage.frames=none",)),
        ("benchmark.yaml", 32768, ()),
        ("benchmark.yaml", 65536, ("storage.frames=none",)),
    ]
    for config, count, overrides in jobs:
        with tempfile.TemporaryDirectory() as out:
            count = 64 if small else count
            began = time.perf_counter()
            run = gen2d.generate(config, count, out, split="train", overrides=overrides)
            seconds = time.perf_counter() - began
        yield (
            f"{config:24} {' '.join(overrides):20} {count:6} videos: {run.videos_per_second:8,.0f} videos/s,"
            f" {seconds:.1f} s with {run.compile_seconds:.1f} s of compiling, {run.bytes / 1e6:,.0f} MB"
        )


def training(small: bool) -> Lines:
    """Videos per second of `gen2d.stream`, batches that stay on the device."""
    import jax

    import gen2d

    for pixels in (64, 256)[: 1 if small else 2]:
        overrides = [f"video.height={pixels}", f"video.width={pixels}"]
        steps = iter(gen2d.stream("phyworld_collision.yaml", seed=0, batch_size=64, overrides=overrides))
        mean = jax.jit(lambda frames: frames.astype(np.float32).mean())
        for count in (16, 2 if small else 100):
            began = time.perf_counter()
            means = [mean(next(steps)["frames"]) for _ in range(count)]
            jax.block_until_ready(means)
            seconds = time.perf_counter() - began
        yield f"stream, phyworld_collision.yaml at {pixels} px, batches of 64: {64 * count / seconds:10,.0f} videos/s"


SECTIONS = {work.__name__: work for work in (agreement, draw, whole, batches, host, training, solvers)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(SECTIONS), help="sections, separated by commas")
    parser.add_argument("--seconds", type=float, default=540, help="begin no section later")
    parser.add_argument("--small", action="store_true", help="least sizes, to test this script")
    options = parser.parse_args(arguments)
    began = time.perf_counter()
    import jax

    from gen2d.programs import devices

    device = devices.prepare()[0]
    print(json.dumps({"device": device.device_kind, "cores": devices.cores(), **devices.versions()}), flush=True)
    for name in options.only.split(","):
        if time.perf_counter() - began > options.seconds:
            print(f"\n== {name}: no time left", flush=True)
            continue
        section = SECTIONS[name]
        title = (section.__doc__ or "").strip()
        print(f"\n== {name}: {title} [{time.perf_counter() - began:.0f} s]", flush=True)
        try:
            for line in section(options.small):
                print(line, flush=True)
        except Exception:
            print(traceback.format_exc()[-1500:], flush=True)
        jax.clear_caches()


if __name__ == "__main__":
    main()
