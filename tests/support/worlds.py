"""Small worlds of discs and segments, simulated by gen2d; render inputs without a solver; exact areas in pixels.

All tests share a few sizes (discs, segments, frames, steps), so that each program is compiled once.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.config.config import Config, load_config
from gen2d.core.enums import STATIC
from gen2d.physics.params import SolverParams
from gen2d.physics.simulate import Forces, SaveAt, simulate
from gen2d.programs import render
from gen2d.records import axes
from gen2d.records import keys as keys_module
from gen2d.records.layout import Layout, SlotGroup
from gen2d.records.scene import Objects, Scene, State
from gen2d.records.trajectory import Trajectory
from gen2d.renderers.plan import FramePlan, RenderScene
from gen2d.sampling import sampler

STEP = 1 / 240


def rules(step: float = STEP, **changes: Any) -> SolverParams:
    """Default solver parameters for a step in s, with `changes`."""
    numbers: dict[str, Any] = {
        "bounce_threshold": 0.01,
        "hertz": min(30.0, 0.125 / step),
        "damping_ratio": 2.0,
        "push_speed": 3.0,
        "damping": 0.0,
        "mixing": "product",
        "by_time": False,
        "relax_iterations": None,
        "extreme_mass_ratios": False,
    }
    return SolverParams(step=step, **(numbers | changes))


def world(
    discs: Sequence[dict],
    segments: Sequence[dict] = (),
    gravity: Sequence[float] = (0.0, 0.0),
    slots: int | None = None,
) -> tuple[Scene, State, Layout]:
    """Scene, initial state and layout of one world, in jax's current precision.

    A disc has x, v, radius, spin, elasticity, friction, mass, moment, rolling, force, torque; a segment has its ends a
    and b, elasticity, friction. `slots` is the number of disc slots; unused ones stay empty.
    """
    count = max(slots or len(discs), 1)
    rows = [{"x": (0, 0), "v": (0, 0), "radius": 0.5, "spin": 0, "elasticity": 1, "friction": 0, **d} for d in discs]
    rows += [{"x": (0, 0), "v": (0, 0), "radius": 0, "spin": 0, "elasticity": 0, "friction": 0}] * (count - len(discs))
    walls = [{"elasticity": 1, "friction": 0, **s} for s in segments]
    ends = np.array([[s["a"], s["b"]] for s in walls], float).reshape(-1, 2, 2)
    radius = np.array([r["radius"] for r in rows], float)
    mass = np.array([r.get("mass", np.pi * r["radius"] ** 2) for r in rows], float)
    moment = [r.get("moment", m * r["radius"] ** 2 / 2) for r, m in zip(rows, mass, strict=True)]
    present = [*(k < len(discs) for k in range(count)), *(True for _ in walls)]

    real = np.dtype(jnp.result_type(float))

    def stacked(of_discs: Any, of_walls: Any, dtype: Any = real) -> jax.Array:
        parts = np.asarray(of_discs, float), np.asarray(of_walls, float)
        parts = [p.reshape(len(p), *np.shape(of_discs)[1:]) for p in parts]
        return jnp.asarray(np.concatenate(parts).astype(dtype))

    def optional(key: str, of_walls: np.ndarray) -> jax.Array | None:
        if not any(key in r for r in rows):
            return None
        return stacked([r.get(key, np.zeros(of_walls.shape[1:])) for r in rows], of_walls)

    zeros, ones = np.zeros(len(walls)), np.ones(len(walls))
    span = ends[:, 1] - ends[:, 0]
    objects = Objects(
        present=jnp.asarray(present),
        kind=stacked(np.zeros(count), ones, np.uint8),
        shape=stacked(np.zeros(count), ones, np.uint8),
        radius=stacked(radius, zeros),
        half_length=stacked(np.zeros(count), np.hypot(*span.T) / 2),
        depth=stacked(np.arange(count), zeros, np.int16),
        mass=stacked(mass, np.inf * ones),
        moment=stacked(moment, np.inf * ones),
        elasticity=stacked([r["elasticity"] for r in rows], [s["elasticity"] for s in walls]),
        friction=stacked([r["friction"] for r in rows], [s["friction"] for s in walls]),
        color=jnp.zeros((count + len(walls), 3), jnp.uint8),
        rolling_resistance=optional("rolling", zeros),
        force=optional("force", np.zeros((len(walls), 2))),
        torque=optional("torque", zeros),
    )
    state = State(
        position=stacked([r["x"] for r in rows], ends.mean(axis=1)),
        angle=stacked(np.zeros(count), np.arctan2(span[:, 1], span[:, 0])),
        velocity=stacked([r["v"] for r in rows], np.zeros((len(walls), 2))),
        angular_velocity=stacked([r["spin"] for r in rows], zeros),
    )
    layout = Layout((SlotGroup("circle", count), SlotGroup("segment", len(walls), STATIC)))
    return Scene(objects, jnp.asarray(gravity, real)), state, layout


@functools.lru_cache(maxsize=64)
def _program(
    layout: Layout,
    numbers: SolverParams,
    frames: int,
    steps: int,
    keep: SaveAt,
    forces: Forces | None,
    sparse: bool,
    wide: bool,
):
    def run(scene: Scene, state: State) -> Trajectory:
        device = axes.to_device(scene), axes.to_device(state)
        return axes.to_stored(simulate(*device, layout, numbers, frames, steps, keep, forces, sparse))

    return jax.jit(run)


def run(
    worlds: Sequence[tuple[Scene, State, Layout]],
    frames: int,
    steps: int,
    numbers: SolverParams | None = None,
    keep: SaveAt | None = None,
    forces: Forces | None = None,
    sparse: bool = True,
) -> Any:
    """Trajectories of worlds that share a layout, as NumPy arrays with the video axis first.

    `sparse` selects the near-pair back end, which CPUs use.
    """
    layout = worlds[0][2]
    scene, state = (jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *(w[i] for w in worlds)) for i in (0, 1))
    double = state.position.dtype == np.float64
    trajectory = _program(layout, numbers or rules(), frames, steps, keep or SaveAt(), forces, sparse, double)(
        scene, state
    )
    return jax.tree.map(np.asarray, trajectory)


def box(side: float, elasticity: float = 1.0, friction: float = 0.0, centre: Sequence[float] = (5, 5)) -> list[dict]:
    """Four segments around a square of this side, m."""
    x, y = centre
    corners = [
        (x - side / 2, y - side / 2),
        (x + side / 2, y - side / 2),
        (x + side / 2, y + side / 2),
        (x - side / 2, y + side / 2),
    ]
    return [
        {"a": a, "b": b, "elasticity": elasticity, "friction": friction}
        for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)
    ]


def rotate(vector: Sequence[float], degrees: float) -> tuple[float, float]:
    """The vector rotated counter-clockwise."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return float(c * vector[0] - s * vector[1]), float(s * vector[0] + c * vector[1])


def _disc_states(scene: Scene, trajectory: Trajectory, i: int, count: int) -> tuple[np.ndarray, ...]:
    """Mass and moment [K], position and velocity [T, K, 2] and spin [T, K] of the discs of video i."""
    mass, moment = (np.asarray(x, float)[:count] for x in (scene.objects.mass, scene.objects.moment))
    states = trajectory.states.position, trajectory.states.velocity, trajectory.states.angular_velocity
    x, v, w = (np.asarray(a[i], float)[:, :count] for a in states)
    return mass, moment, x, v, w


def energies(worlds: Sequence[tuple[Scene, State, Layout]], trajectory: Trajectory) -> np.ndarray:
    """Kinetic and potential energy of each video and frame, J [n, T]."""
    total = []
    for i, (scene, _, layout) in enumerate(worlds):
        mass, moment, x, v, w = _disc_states(scene, trajectory, i, layout.groups[0].count)
        fall = -np.einsum("tkd,d->tk", x, np.asarray(scene.gravity, float)) * mass
        total.append((0.5 * mass * (v**2).sum(-1) + 0.5 * moment * w**2 + fall).sum(-1))
    return np.array(total)


def momenta(worlds: Sequence[tuple[Scene, State, Layout]], trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Linear [n, T, 2] and angular [n, T] momentum about the origin."""
    linear, angular = [], []
    for i, (scene, _, layout) in enumerate(worlds):
        mass, moment, x, v, w = _disc_states(scene, trajectory, i, layout.groups[0].count)
        linear.append((mass[:, None] * v).sum(1))
        cross = x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0]
        angular.append((mass * cross + moment * w).sum(-1))
    return np.array(linear), np.array(angular)


# ---- Render inputs without a solver


def straight_motion(config: Config | Mapping, count: int) -> tuple[RenderScene, FramePlan, Scene, State]:
    """Render scenes, frame plan, scenes and states [n, T, ...] of the first `count` videos of a config.

    From the sampled initial state, all bodies move in straight lines at constant velocity and spin, through walls, too.
    """
    config = load_config(config)
    layout = config.scene.contract.layout(config.scene.options)
    keys = keys_module.video_keys(
        jnp.asarray(keys_module.seed_words(config.seed, 0)), jnp.arange(count, dtype=jnp.uint32)
    )
    render_scenes, scenes, states = _straight_motions(config, layout, keys)
    return render_scenes, render.plan_of(config, layout), scenes, states


@functools.partial(jax.jit, static_argnums=(0, 1))
def _straight_motions(config: Config, layout: Layout, keys: jax.Array) -> tuple[RenderScene, Scene, State]:
    return jax.vmap(functools.partial(_straight_motion, config, layout))(keys)


def _straight_motion(config: Config, layout: Layout, key: jax.Array) -> tuple[RenderScene, Scene, State]:
    video, steps = config.video, 4
    scene, initial, *_ = sampler.Sampler(config).sample(key)[1]

    def at(time: jax.Array) -> State:
        def extrapolated(start: jax.Array, rate: jax.Array) -> jax.Array:
            return start + time.reshape(*time.shape, *[1] * start.ndim) * rate

        return State(
            extrapolated(initial.position, initial.velocity),
            extrapolated(initial.angle, initial.angular_velocity),
            extrapolated(initial.velocity, 0 * initial.velocity),
            extrapolated(initial.angular_velocity, 0 * initial.angular_velocity),
        )

    frame, step = jnp.arange(video.frames), jnp.arange(1, steps + 1)
    states, between = at(frame / video.fps), at((frame[:-1, None] + step / steps) / video.fps)
    render_scene = render.render_scene(key, config, render.plan_of(config, layout), scene, states, between=between)
    return render_scene, scene, states


# ---- Exact areas of shapes in pixels, in float64; px, x to the right and y down


def disc_areas(x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    """Area of a disc in each pixel [rows, columns].

    x [columns + 1] and y [rows + 1] are the edges of the pixels, relative to the disc's centre.
    """
    radius = float(radius)

    def circle_integral(u: np.ndarray) -> np.ndarray:
        return (u * np.sqrt(np.maximum(radius**2 - u**2, 0)) + radius**2 * np.arcsin(u / radius)) / 2

    reach, height = np.minimum(np.abs(x), radius), np.minimum(np.abs(y), radius)[:, None]
    flat = np.minimum(reach, np.sqrt(radius**2 - height**2))
    corner_areas = np.sign(x) * np.sign(y)[:, None] * (height * flat + circle_integral(reach) - circle_integral(flat))
    return np.diff(np.diff(corner_areas, axis=0), axis=1)


def outline(corners: np.ndarray, radius: float, count: int = 4096) -> np.ndarray:
    """Convex hull of the corners [V, 2], grown by a radius, as a polygon of `count` corners."""
    if radius == 0:
        return corners
    angle = np.arange(count) * (2 * np.pi / count)
    normal = np.stack([np.cos(angle), np.sin(angle)], -1)
    distance = radius * np.sqrt(2 * np.pi / count / np.sin(2 * np.pi / count))  # so that the area is the disc's
    return corners[np.argmax(normal @ corners.T, axis=1)] + distance * normal


def polygon_areas(corners: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Area of a polygon [V, 2] in each pixel [rows, columns].

    Each piece of its boundary contributes to its own pixel and to those on its right, as in the anti-aliasing
    rasterizers of AGG and FreeType.
    """
    starts = _subdivide(np.asarray(corners, float))
    side = np.roll(starts, -1, axis=0) - starts
    cross = np.ones_like(side)  # where a piece crosses the edge of a column and of a row; it is shorter than a pixel
    np.divide(np.ceil(np.minimum(starts, starts + side)) - starts, side, where=np.abs(side) > 1e-12, out=cross)
    cross = np.sort(np.clip(cross, 0, 1), axis=1)
    parts = np.concatenate([np.zeros((len(side), 1)), cross, np.ones((len(side), 1))], axis=1)
    middle = starts[:, None] + side[:, None] * ((parts[:, 1:] + parts[:, :-1]) / 2)[..., None]
    down = side[:, 1:] * np.diff(parts, axis=1)
    column, row = np.floor(middle[..., 0]).astype(int), np.floor(middle[..., 1]).astype(int)
    in_frame = (row >= 0) & (row < rows) & (column < columns)
    column, row, down, offset = column[in_frame], row[in_frame], down[in_frame], (middle[..., 0] - column)[in_frame]
    area, right = np.zeros((rows, columns)), np.zeros((rows, columns + 1))
    inside = column >= 0
    np.add.at(area, (row[inside], column[inside]), (down * (1 - offset))[inside])
    np.add.at(right, (row, np.maximum(column + 1, 0)), down)
    return np.abs(area + np.cumsum(right, axis=1)[:, :-1])


def _subdivide(corners: np.ndarray) -> np.ndarray:
    """The polygon with its sides split into pieces shorter than a pixel."""
    side = np.roll(corners, -1, axis=0) - corners
    pieces = np.ceil(1.001 * np.hypot(*side.T)).astype(int) + 1
    side_of = np.repeat(np.arange(len(corners)), pieces)
    share = (np.arange(len(side_of)) - (np.cumsum(pieces) - pieces)[side_of]) / pieces[side_of]
    return corners[side_of] + share[:, None] * side[side_of]
