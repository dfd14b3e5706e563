"""Helpers of the law tests: one scene in eight poses, and assertions of a figure against its bound.

A case is written once, in the frame of its closed form. `watch` simulates it at four orientations, each also mirrored,
in one batch, and returns the motion in the frame of the case. Cases are padded with empty slots, segments far away and
copies of the last video, so that many tests share few compiled programs.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from worlds import STEP, run, world

from gen2d.space.space import Space
from gen2d.space.video import Video

GRAVITY = 9.81  # m/s^2
DOWN = (0.0, -GRAVITY)
FLOOR = {"a": (-50.0, 0.0), "b": (50.0, 0.0), "elasticity": 1.0, "friction": 1.0}
FAR = 1000.0  # m: out of reach of all bodies
BATCH_SIZES = (64, 512)  # sizes that batches are padded to
QUARTERS = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
MIRROR = np.diag([-1, 1])
POSES = [*QUARTERS, *(turn @ MIRROR for turn in QUARTERS)]


class Case(NamedTuple):
    """A scene as arguments of `worlds.world`."""

    discs: Sequence[dict]
    segments: Sequence[dict] = ()
    gravity: Sequence[float] = (0.0, 0.0)


class Motion(NamedTuple):
    """Motion of the discs in the frame of the cases: [case, pose, frame, slot], vectors [..., 2]."""

    x: np.ndarray  # m
    angle: np.ndarray  # rad
    v: np.ndarray  # m/s
    spin: np.ndarray  # rad/s


def pose_world(case: Case, pose: np.ndarray, slots: int, walls: int) -> tuple:
    """World of a case, rotated or mirrored by `pose`, with `slots` disc slots and `walls` segments."""
    handedness = round(float(np.linalg.det(pose)))

    def transform(row: dict, names: Sequence[str]) -> dict:
        vectors = {name: tuple(pose @ np.array(row[name], float)) for name in names if name in row}
        return {**row, **vectors, **{name: handedness * row[name] for name in ("spin", "torque") if name in row}}

    padding = [{"a": (-1.0, -FAR - k), "b": (1.0, -FAR - k)} for k in range(walls - len(case.segments))]
    discs = [transform(row, ("x", "v", "force")) for row in case.discs]
    segments = [transform(row, ("a", "b")) for row in [*case.segments, *padding]]
    return world(discs, segments, tuple(pose @ np.array(case.gravity, float)), slots)


def pad_batch(worlds: Sequence[tuple]) -> list[tuple]:
    """The worlds, padded with copies of the last one to a batch size in `BATCH_SIZES`."""
    size = next(n for n in BATCH_SIZES if n >= len(worlds))
    return [*worlds, *[worlds[-1]] * (size - len(worlds))]


def watch(
    cases: Sequence[Case], frames: int = 721, steps: int = 1, slots: int = 2, walls: int = 2, **options: Any
) -> Motion:
    """Motion of every case in every pose; `options` are those of `worlds.run`."""
    worlds = [pose_world(case, pose, slots, walls) for case in cases for pose in POSES]
    states = run(pad_batch(worlds), frames, steps, **options).states

    def to_case_frame(values: np.ndarray, hand: bool) -> np.ndarray:
        in_world = np.asarray(values, float)[: len(worlds), :, :slots]
        in_world = in_world.reshape(len(cases), len(POSES), *in_world.shape[1:])
        if not hand:
            return np.stack([in_world[:, k] @ pose for k, pose in enumerate(POSES)], axis=1)
        return in_world * np.array([np.linalg.det(pose) for pose in POSES]).round()[:, None, None]

    return Motion(
        to_case_frame(states.position, False),
        to_case_frame(states.angle, True),
        to_case_frame(states.velocity, False),
        to_case_frame(states.angular_velocity, True),
    )


def times(frames: int, step: float = STEP) -> np.ndarray:
    """Times of the frames, s [frames]."""
    return np.arange(frames) * step


class Owed(NamedTuple):
    """A law that holds at a weaker bound than was asked for."""

    measured: float
    asked: float


owed: dict[str, Owed] = {}
"""Laws of the running test that are owed; conftest.py reports and clears them."""


def holds(law: str, measured: Any, bound: float, asked: float | None = None) -> None:
    """Check that the largest magnitude in `measured` is within the bound; `pytest -rP` prints it.

    Where the solver does not satisfy a law yet, `asked`, less than `bound`, is the law's bound, and `bound` prevents
    regressions. Such a test is marked `asked`, is reported as an expected failure, and fails once the law holds at
    `asked`.
    """
    worst = float(np.max(np.abs(measured)))
    print(f"{law}: {worst:.2g}, bound {bound:.2g}" + (f", asked {asked:.2g}" if asked is not None else ""))
    assert math.isfinite(worst), law
    assert worst <= bound, f"{law}: {worst:.4g}, but at most {bound:g}"
    if asked is not None and asked < bound:
        owed[law] = Owed(max(worst, owed[law].measured) if law in owed else worst, asked)


def to_double(worlds: Sequence[tuple]) -> list[tuple]:
    """The worlds in double precision."""

    def wide(x: jax.Array) -> jax.Array:
        return x.astype(jnp.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return [(*jax.tree.map(wide, (scene, state)), layout) for scene, state, layout in worlds]


def overlaps(one: tuple, position: np.ndarray) -> np.ndarray:
    """Deepest overlap at each frame, m [T], of a world with its discs at `position` [T, K, 2]."""
    scene, state, layout = one
    n, present = layout.groups[0].count, np.asarray(scene.objects.present)
    radius, x = np.asarray(scene.objects.radius, float), np.asarray(position, float)[:, : layout.groups[0].count]
    distance = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
    pairs = present[:n, None] & present[None, :n] & ~np.eye(n, dtype=bool)
    depths = np.where(pairs, radius[:n, None] + radius[None, :n] - distance, -np.inf).max((1, 2))
    for k in range(n, layout.slots):
        centre, angle = np.asarray(state.position[k], float), float(state.angle[k])
        along = np.array([math.cos(angle), math.sin(angle)])
        half = float(scene.objects.half_length[k])
        nearest = centre + np.clip((x - centre) @ along, -half, half)[..., None] * along
        depth = radius[:n] + radius[k] - np.linalg.norm(x - nearest, axis=-1)
        depths = np.maximum(depths, np.where(present[:n] & present[k], depth, -np.inf).max(1))
    return depths


def deepest_overlap(space: Space, video: Video) -> float:
    """Deepest overlap of two bodies at any frame, m."""
    return float(np.max(space.poses(video.position, video.angle).contacts.depth, initial=0.0))


def total_energy(video: Video) -> np.ndarray:
    """Kinetic and potential energy at every frame, J [T]."""
    return np.asarray(video.energy.kinetic + video.energy.rotational + video.energy.potential, float)
