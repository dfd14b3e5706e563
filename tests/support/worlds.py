"""Small worlds for the law tests: discs and segments by hand, simulated with the product's own programs; videos to be
drawn, and the exact areas of shapes in their pixels.

All tests share a few shapes (how many discs, segments, frames, steps), so that each is compiled once.
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
    """The solver's default numbers at a step, but for the changes."""
    numbers: dict[str, Any] = {
        "bounce_threshold": 0.01,
        "hertz": min(30.0, 0.125 / step),
        "damping_ratio": 10.0,
        "push_speed": 3.0,
        "damping": 0.0,
        "mixing": "product",
    }
    return SolverParams(step=step, **(numbers | changes))


def world(
    discs: Sequence[dict],
    segments: Sequence[dict] = (),
    gravity: Sequence[float] = (0.0, 0.0),
    slots: int | None = None,
) -> tuple[Scene, State, Layout]:
    """One scene in the sampler's layout, in the precision that jax has now.

    A disc: x, v, radius, spin, elasticity, friction, mass, moment, rolling, force, torque; a segment: a, b (its ends),
    elasticity, friction. Slots that are left over stay empty.
    """
    count = max(slots or len(discs), 1)
    rows = [{"x": (0, 0), "v": (0, 0), "radius": 0.5, "spin": 0, "elasticity": 1, "friction": 0, **d} for d in discs]
    rows += [{"x": (0, 0), "v": (0, 0), "radius": 0, "spin": 0, "elasticity": 0, "friction": 0}] * (count - len(discs))
    walls = [{"elasticity": 1, "friction": 0, **s} for s in segments]
    ends = np.array([[s["a"], s["b"]] for s in walls], float).reshape(-1, 2, 2)
    radius = np.array([r["radius"] for r in rows], float)
    mass = np.array([r.get("mass", np.pi * r["radius"] ** 2) for r in rows], float)
    moment = [r.get("moment", m * r["radius"] ** 2 / 2) for r, m in zip(rows, mass, strict=True)]
    there = [*(k < len(discs) for k in range(count)), *(True for _ in walls)]

    real = np.dtype(jnp.result_type(float))

    def both(of_discs: Any, of_walls: Any, dtype: Any = real) -> jax.Array:
        parts = np.asarray(of_discs, float), np.asarray(of_walls, float)
        parts = [p.reshape(len(p), *np.shape(of_discs)[1:]) for p in parts]
        return jnp.asarray(np.concatenate(parts).astype(dtype))

    def some(key: str, of_walls: np.ndarray) -> jax.Array | None:
        if not any(key in r for r in rows):
            return None
        return both([r.get(key, np.zeros(of_walls.shape[1:])) for r in rows], of_walls)

    nothing, ones = np.zeros(len(walls)), np.ones(len(walls))
    span = ends[:, 1] - ends[:, 0]
    objects = Objects(
        present=jnp.asarray(there),
        kind=both(np.zeros(count), ones, np.uint8),
        shape=both(np.zeros(count), ones, np.uint8),
        radius=both(radius, nothing),
        half_length=both(np.zeros(count), np.hypot(*span.T) / 2),
        depth=both(np.arange(count), nothing, np.int16),
        mass=both(mass, np.inf * ones),
        moment=both(moment, np.inf * ones),
        elasticity=both([r["elasticity"] for r in rows], [s["elasticity"] for s in walls]),
        friction=both([r["friction"] for r in rows], [s["friction"] for s in walls]),
        color=jnp.zeros((count + len(walls), 3), jnp.uint8),
        rolling_resistance=some("rolling", nothing),
        force=some("force", np.zeros((len(walls), 2))),
        torque=some("torque", nothing),
    )
    state = State(
        position=both([r["x"] for r in rows], ends.mean(axis=1)),
        angle=both(np.zeros(count), np.arctan2(span[:, 1], span[:, 0])),
        velocity=both([r["v"] for r in rows], np.zeros((len(walls), 2))),
        angular_velocity=both([r["spin"] for r in rows], nothing),
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
    """The trajectories of worlds of one layout, videos first, as NumPy arrays; in the solver's form for CPUs."""
    layout = worlds[0][2]
    scene, state = (jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *(w[i] for w in worlds)) for i in (0, 1))
    wide = state.position.dtype == np.float64
    made = _program(layout, numbers or rules(), frames, steps, keep or SaveAt(), forces, sparse, wide)(scene, state)
    return jax.tree.map(np.asarray, made)


def box(side: float, elasticity: float = 1.0, friction: float = 0.0, centre: Sequence[float] = (5, 5)) -> list[dict]:
    """Four segments around a square."""
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


def turned(vector: Sequence[float], degrees: float) -> tuple[float, float]:
    """The vector turned counter-clockwise."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return float(c * vector[0] - s * vector[1]), float(s * vector[0] + c * vector[1])


def _of_discs(scene: Scene, made: Trajectory, i: int, count: int) -> tuple[np.ndarray, ...]:
    """Mass and moment [K], position, velocity [T, K, 2] and spin [T, K] of video i's discs."""
    mass, moment = (np.asarray(x, float)[:count] for x in (scene.objects.mass, scene.objects.moment))
    states = made.states.position, made.states.velocity, made.states.angular_velocity
    x, v, w = (np.asarray(a[i], float)[:, :count] for a in states)
    return mass, moment, x, v, w


def energies(worlds: Sequence[tuple[Scene, State, Layout]], made: Trajectory) -> np.ndarray:
    """Kinetic and potential energy of each video and frame, J [n, T]."""
    total = []
    for i, (scene, _, layout) in enumerate(worlds):
        mass, moment, x, v, w = _of_discs(scene, made, i, layout.runs[0].count)
        fall = -np.einsum("tkd,d->tk", x, np.asarray(scene.gravity, float)) * mass
        total.append((0.5 * mass * (v**2).sum(-1) + 0.5 * moment * w**2 + fall).sum(-1))
    return np.array(total)


def momenta(worlds: Sequence[tuple[Scene, State, Layout]], made: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Linear [n, T, 2] and angular [n, T] momentum about the origin."""
    linear, angular = [], []
    for i, (scene, _, layout) in enumerate(worlds):
        mass, moment, x, v, w = _of_discs(scene, made, i, layout.runs[0].count)
        linear.append((mass[:, None] * v).sum(1))
        cross = x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0]
        angular.append((mass * cross + moment * w).sum(-1))
    return np.array(linear), np.array(angular)


# ---- Videos that no solver makes, to be drawn


def flown(config: Config | Mapping, count: int) -> tuple[RenderScene, FramePlan, Scene, State]:
    """What `count` videos of a config are drawn from, their plan, scenes and states [n, T, ...]; from where the sampler
    puts it everything flies straight on, through walls too."""
    config = load_config(config)
    layout = config.scene.contract.layout(config.scene.options)
    keys = keys_module.video_keys(
        jnp.asarray(keys_module.seed_words(config.seed, 0)), jnp.arange(count, dtype=jnp.uint32)
    )
    stages, scenes, states = _all_flown(config, layout, keys)
    return stages, render.plan_of(config, layout), scenes, states


@functools.partial(jax.jit, static_argnums=(0, 1))
def _all_flown(config: Config, layout: Layout, keys: jax.Array) -> tuple[RenderScene, Scene, State]:
    return jax.vmap(functools.partial(_flown, config, layout))(keys)


def _flown(config: Config, layout: Layout, key: jax.Array) -> tuple[RenderScene, Scene, State]:
    video, steps = config.video, 4
    scene, begin, *_ = sampler.Sampler(config).sampled(key)[1]

    def at(time: jax.Array) -> State:
        def moved(start: jax.Array, rate: jax.Array) -> jax.Array:
            return start + time.reshape(*time.shape, *[1] * start.ndim) * rate

        return State(
            moved(begin.position, begin.velocity),
            moved(begin.angle, begin.angular_velocity),
            moved(begin.velocity, 0 * begin.velocity),
            moved(begin.angular_velocity, 0 * begin.angular_velocity),
        )

    frame, step = jnp.arange(video.frames), jnp.arange(1, steps + 1)
    states, between = at(frame / video.fps), at((frame[:-1, None] + step / steps) / video.fps)
    stage = render.render_scene(key, config, render.plan_of(config, layout), scene, states, between=between)
    return stage, scene, states


# ---- Exact areas of shapes in pixels, in float64; px, x to the right and y down


def disc_areas(x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    """The area of a disc in each pixel [rows, columns], from the pixels' edges x [columns + 1] and y [rows + 1], both
    from its centre."""
    radius = float(radius)

    def under(u: np.ndarray) -> np.ndarray:
        return (u * np.sqrt(np.maximum(radius**2 - u**2, 0)) + radius**2 * np.arcsin(u / radius)) / 2

    reach, height = np.minimum(np.abs(x), radius), np.minimum(np.abs(y), radius)[:, None]
    flat = np.minimum(reach, np.sqrt(radius**2 - height**2))
    to_corner = np.sign(x) * np.sign(y)[:, None] * (height * flat + under(reach) - under(flat))
    return np.diff(np.diff(to_corner, axis=0), axis=1)


def outline(corners: np.ndarray, radius: float, count: int = 4096) -> np.ndarray:
    """A convex polygon, or what else its corners [V, 2] span, grown by a radius: as a polygon with many corners."""
    if radius == 0:
        return corners
    angle = np.arange(count) * (2 * np.pi / count)
    normal = np.stack([np.cos(angle), np.sin(angle)], -1)
    grown = radius * np.sqrt(2 * np.pi / count / np.sin(2 * np.pi / count))  # as large as the disc
    return corners[np.argmax(normal @ corners.T, axis=1)] + grown * normal


def polygon_areas(corners: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """The area of any polygon [V, 2] in each pixel [rows, columns]: each piece of its boundary adds to its own pixel
    and to those on its right, as in the smooth rasterizers of AGG and FreeType."""
    begin = _finely(np.asarray(corners, float))
    side = np.roll(begin, -1, axis=0) - begin
    cross = np.ones_like(side)  # where a piece shorter than a pixel crosses a column's edge, and a row's
    np.divide(np.ceil(np.minimum(begin, begin + side)) - begin, side, where=np.abs(side) > 1e-12, out=cross)
    cross = np.sort(np.clip(cross, 0, 1), axis=1)
    parts = np.concatenate([np.zeros((len(side), 1)), cross, np.ones((len(side), 1))], axis=1)
    middle = begin[:, None] + side[:, None] * ((parts[:, 1:] + parts[:, :-1]) / 2)[..., None]
    down = side[:, 1:] * np.diff(parts, axis=1)
    column, row = np.floor(middle[..., 0]).astype(int), np.floor(middle[..., 1]).astype(int)
    seen = (row >= 0) & (row < rows) & (column < columns)
    column, row, down, past = column[seen], row[seen], down[seen], (middle[..., 0] - column)[seen]
    own, right = np.zeros((rows, columns)), np.zeros((rows, columns + 1))
    inside = column >= 0
    np.add.at(own, (row[inside], column[inside]), (down * (1 - past))[inside])
    np.add.at(right, (row, np.maximum(column + 1, 0)), down)
    return np.abs(own + np.cumsum(right, axis=1)[:, :-1])


def _finely(corners: np.ndarray) -> np.ndarray:
    """The polygon with its sides in pieces shorter than a pixel."""
    side = np.roll(corners, -1, axis=0) - corners
    pieces = np.ceil(1.001 * np.hypot(*side.T)).astype(int) + 1
    which = np.repeat(np.arange(len(corners)), pieces)
    part = (np.arange(len(which)) - (np.cumsum(pieces) - pieces)[which]) / pieces[which]
    return corners[which] + part[:, None] * side[which]
