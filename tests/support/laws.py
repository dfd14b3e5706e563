"""What the law tests share: one scene seen from eight sides, and a figure held against its bound.

A case is written once, in the frame of its closed form. `watch` simulates it at four orientations, each also mirrored,
as lanes of one batch, and hands the motion back in the case's own frame. Cases are filled up with empty slots, segments
far away and copies of the last lane, so that many tests share few compiled programs.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from worlds import STEP, run, world

GRAVITY = 9.81  # m/s^2
DOWN = (0.0, -GRAVITY)
FLOOR = {"a": (-50.0, 0.0), "b": (50.0, 0.0), "elasticity": 1.0, "friction": 1.0}
FAR = 1000.0  # m: nothing gets there
LANES = (64, 512)  # batches are filled up to one of these
QUARTERS = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
MIRROR = np.diag([-1, 1])
POSES = [*QUARTERS, *(turn @ MIRROR for turn in QUARTERS)]


class Case(NamedTuple):
    """A scene as `worlds.world` takes it."""

    discs: Sequence[dict]
    segments: Sequence[dict] = ()
    gravity: Sequence[float] = (0.0, 0.0)


class Motion(NamedTuple):
    """What the discs did, in the frame of the cases: [case, pose, frame, slot] and, of vectors, [..., 2]."""

    x: np.ndarray  # m
    angle: np.ndarray  # rad
    v: np.ndarray  # m/s
    spin: np.ndarray  # rad/s


def posed(case: Case, pose: np.ndarray, slots: int, walls: int) -> tuple:
    """The world of a case turned and mirrored, with `slots` discs and `walls` segments."""
    hand = round(float(np.linalg.det(pose)))

    def there(row: dict, names: Sequence[str]) -> dict:
        vectors = {name: tuple(pose @ np.array(row[name], float)) for name in names if name in row}
        return {**row, **vectors, **{name: hand * row[name] for name in ("spin", "torque") if name in row}}

    away = [{"a": (-1.0, -FAR - k), "b": (1.0, -FAR - k)} for k in range(walls - len(case.segments))]
    discs = [there(row, ("x", "v", "force")) for row in case.discs]
    segments = [there(row, ("a", "b")) for row in [*case.segments, *away]]
    return world(discs, segments, tuple(pose @ np.array(case.gravity, float)), slots)


def filled(worlds: Sequence[tuple]) -> list[tuple]:
    """The worlds, and copies of the last up to one of the usual numbers of lanes."""
    lanes = next(n for n in LANES if n >= len(worlds))
    return [*worlds, *[worlds[-1]] * (lanes - len(worlds))]


def watch(
    cases: Sequence[Case], frames: int = 721, steps: int = 1, slots: int = 2, walls: int = 2, **options: Any
) -> Motion:
    """The motion of every case in every pose; `numbers` (Rules) as `worlds.run` takes them."""
    worlds = [posed(case, pose, slots, walls) for case in cases for pose in POSES]
    states = run(filled(worlds), frames, steps, **options).states

    def back(values: np.ndarray, hand: bool) -> np.ndarray:
        one = np.asarray(values, float)[: len(worlds), :, :slots]
        one = one.reshape(len(cases), len(POSES), *one.shape[1:])
        if not hand:
            return np.stack([one[:, k] @ pose for k, pose in enumerate(POSES)], axis=1)
        return one * np.array([np.linalg.det(pose) for pose in POSES]).round()[:, None, None]

    return Motion(
        back(states.position, False),
        back(states.angle, True),
        back(states.velocity, False),
        back(states.angular_velocity, True),
    )


def times(frames: int, step: float = STEP) -> np.ndarray:
    """The times of the frames in s."""
    return np.arange(frames) * step


def holds(law: str, measured: Any, bound: float, asked: float | None = None) -> None:
    """Asserts that the worst of the measured figures keeps the bound; `pytest -rP` prints it.

    Where the solver does not do what a law asks yet, `asked` says what that is, and the bound that it gets no worse.
    """
    worst = float(np.max(np.abs(measured)))
    print(f"{law}: {worst:.2g}, bound {bound:.2g}" + (f", asked {asked:.2g}" if asked is not None else ""))
    assert math.isfinite(worst), law
    assert worst <= bound, f"{law}: {worst:.4g}, but at most {bound:g}"


def doubled(worlds: Sequence[tuple]) -> list[tuple]:
    """The worlds with their numbers in double precision."""

    def wide(x: jax.Array) -> jax.Array:
        return x.astype(jnp.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return [(*jax.tree.map(wide, (scene, state)), layout) for scene, state, layout in worlds]


def overlaps(one: tuple, position: np.ndarray) -> np.ndarray:
    """The deepest overlap in m at each frame, [T], of a world whose discs stood at `position` [T, K, 2]."""
    scene, state, layout = one
    n, there = layout.runs[0].count, np.asarray(scene.objects.present)
    radius, x = np.asarray(scene.objects.radius, float), np.asarray(position, float)[:, : layout.runs[0].count]
    apart = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
    pairs = there[:n, None] & there[None, :n] & ~np.eye(n, dtype=bool)
    deepest = np.where(pairs, radius[:n, None] + radius[None, :n] - apart, -np.inf).max((1, 2))
    for k in range(n, layout.slots):
        centre, angle = np.asarray(state.position[k], float), float(state.angle[k])
        along = np.array([math.cos(angle), math.sin(angle)])
        half = float(scene.objects.half_length[k])
        nearest = centre + np.clip((x - centre) @ along, -half, half)[..., None] * along
        depth = radius[:n] + radius[k] - np.linalg.norm(x - nearest, axis=-1)
        deepest = np.maximum(deepest, np.where(there[:n] & there[k], depth, -np.inf).max(1))
    return deepest
