"""Reference implementation for bench.py: Chipmunk (pymunk), OpenCV and h5py in one process per core.

python tests/bench/peer.py --n 512 --out /tmp/peer      # the scene of configs/benchmark.yaml
"""

import argparse
import itertools
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import h5py
import numpy as np
import pymunk
from pymunk import batch

BALLS, SIDE, GRAVITY = 8, 10.0, -9.8  # m, m/s^2
RADIUS, SPEED = (0.5, 1.0), 3.0  # m: uniform range; m/s: standard deviation of each component
ELASTICITY, FRICTION = 0.9, 0.2  # of balls and walls; Chipmunk multiplies those of two bodies
FRAMES, SIZE, FPS, SUBSTEPS = 64, 64, 30, 4
BACKGROUND, COLORS = 20, (40, 255)
SHARD = 64  # videos
STATE = (
    batch.BodyFields.POSITION | batch.BodyFields.ANGLE | batch.BodyFields.VELOCITY | batch.BodyFields.ANGULAR_VELOCITY
)
BITS = 4  # fractional bits of OpenCV's coordinates


class Start(NamedTuple):
    """Initial state of a video."""

    radii: list[float]  # m
    positions: list[tuple[float, float]]  # m
    velocities: list[list[float]]  # m/s
    colors: list[list[int]]


def sample(number: int) -> Start:
    """Initial state of video `number`: balls at random positions, by rejection of those that overlap."""
    rng = np.random.default_rng([0, number])
    radii = rng.uniform(*RADIUS, BALLS).tolist()
    while (positions := _sample_positions(rng, radii)) is None:
        pass
    velocities, colors = rng.normal(0, SPEED, (BALLS, 2)), rng.integers(*COLORS, (BALLS, 3))
    return Start(radii, positions, velocities.tolist(), colors.tolist())


def _sample_positions(rng: np.random.Generator, radii: list[float]) -> list[tuple[float, float]] | None:
    positions: list[tuple[float, float]] = []
    for radius in radii:
        for unit in rng.random((100, 2)).tolist():
            x, y = (radius + u * (SIDE - 2 * radius) for u in unit)
            if all(math.hypot(x - a, y - b) > radius + r for (a, b), r in zip(positions, radii, strict=False)):
                positions.append((x, y))
                break
        else:
            return None
    return positions


def space_of(start: Start) -> pymunk.Space:
    """A closed box that contains the balls."""
    space = pymunk.Space()
    space.gravity = 0, GRAVITY
    corners = [(0, 0), (SIDE, 0), (SIDE, SIDE), (0, SIDE), (0, 0)]
    shapes: list[pymunk.Shape] = [pymunk.Segment(space.static_body, a, b, 0) for a, b in itertools.pairwise(corners)]
    for radius, position, velocity in zip(start.radii, start.positions, start.velocities, strict=True):
        mass = math.pi * radius**2
        body = pymunk.Body(mass, pymunk.moment_for_circle(mass, 0, radius))
        body.position, body.velocity = position, (velocity[0], velocity[1])
        shapes.append(pymunk.Circle(body, radius))
        space.add(body)
    for shape in shapes:
        shape.elasticity, shape.friction = ELASTICITY, FRICTION
    space.add(*shapes)
    return space


def simulate(space: pymunk.Space, read: str = "body", step: float = 1 / FPS / SUBSTEPS) -> np.ndarray:
    """States [T, N, 6], float32: position, angle, velocity and angular velocity; `step` is in s."""
    states, read_states = [], READERS[read](space)
    for t in range(FRAMES):
        for _ in range(SUBSTEPS if t else 0):
            space.step(step)
        states.append(read_states())
    return np.array(states, np.float32)


def _by_body(space: pymunk.Space) -> Callable[[], Any]:
    bodies = space.bodies
    return lambda: [(*b.position, b.angle, *b.velocity, b.angular_velocity) for b in bodies]


def _by_batch(space: pymunk.Space) -> Callable[[], Any]:
    buffer = batch.Buffer()

    def read_states() -> np.ndarray:
        buffer.clear()
        batch.get_space_bodies(space, STATE, buffer)
        return np.frombuffer(buffer.float_buf()).reshape(-1, 6)[:BALLS].copy()  # the last body holds the walls

    return read_states


# How states are read from Chipmunk: by the attributes of each body, as in pymunk's manual, or by one call of
# pymunk.batch, which its documentation calls 'highly experimental'.
READERS = {"body": _by_body, "batch": _by_batch}


def draw(states: np.ndarray, radii: np.ndarray, colors: Sequence[Sequence[int]], frames: np.ndarray) -> None:
    """Render antialiased discs on a dark background into frames [T, H, W, 3] uint8.

    The states [T, N, ...] begin with x and y in m; `radii` [N] are in m.
    """
    scale = frames.shape[1] / SIDE
    pixels = np.stack([states[..., 0] * scale - 0.5, (SIDE - states[..., 1]) * scale - 0.5], axis=-1)
    centers = np.rint(pixels * 2**BITS).astype(int).tolist()
    pixel_radii = np.rint(radii * scale * 2**BITS).astype(int).tolist()
    frames[:] = BACKGROUND
    for frame, frame_centers in zip(frames, centers, strict=True):
        for center, radius, color in zip(frame_centers, pixel_radii, colors, strict=True):
            cv2.circle(frame, center, radius, color, -1, cv2.LINE_AA, BITS)


def write_shard(path: Path, numbers: range, compression: str = "gzip", read: str = "body") -> None:
    """Generate these videos and write them to one HDF5 file, a chunk per video."""
    frames = np.empty((len(numbers), FRAMES, SIZE, SIZE, 3), np.uint8)
    states = np.empty((len(numbers), FRAMES, BALLS, 6), np.float32)
    for row, number in enumerate(numbers):
        start = sample(number)
        states[row] = simulate(space_of(start), read)
        draw(states[row], np.array(start.radii), start.colors, frames[row])
    filters = {"compression": "gzip", "compression_opts": 1} if compression == "gzip" else {}
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=frames, chunks=(1, *frames.shape[1:]), **filters)
        file.create_dataset("states", data=states)


def make(count: int, workers: int, compression: str, read: str, out: Path) -> float:
    """Generate the dataset; the seconds from the start of the workers to the last closed file."""
    out.mkdir(parents=True, exist_ok=True)
    parts = [range(first, min(first + SHARD, count)) for first in range(0, count, SHARD)]
    jobs = [(out / f"shard-{part.start // SHARD:05d}.h5", part, compression, read) for part in parts]
    began = time.perf_counter()
    with multiprocessing.get_context("fork").Pool(workers, cv2.setNumThreads, (1,)) as pool:
        pool.starmap(write_shard, jobs, chunksize=1)
    return time.perf_counter() - began


def seconds_to_step(count: int, read: str = "body") -> float:
    """Seconds to step `count` videos, without sampling and building the scenes."""
    spaces = [space_of(sample(number)) for number in range(count)]
    began = time.perf_counter()
    for space in spaces:
        simulate(space, read)
    return time.perf_counter() - began


def seconds_to_draw(count: int) -> float:
    """Seconds to render `count` videos from given states."""
    starts = [sample(number) for number in range(count)]
    states = [simulate(space_of(start)) for start in starts]
    frames = np.zeros((FRAMES, SIZE, SIZE, 3), np.uint8)
    began = time.perf_counter()
    for start, trajectory in zip(starts, states, strict=True):
        draw(trajectory, np.array(start.radii), start.colors, frames)
    return time.perf_counter() - began


def main() -> None:
    """Generate a dataset from the options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=512)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--compression", choices=("gzip", "none"), default="gzip")
    parser.add_argument("--read", choices=tuple(READERS), default="body", help="how states leave Chipmunk")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    seconds = make(options.n, options.workers, options.compression, options.read, options.out)
    print(f"{options.n / seconds:.1f} videos/s ({options.n} videos in {seconds:.3f} s)")


if __name__ == "__main__":
    main()
