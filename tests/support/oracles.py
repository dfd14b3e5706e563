"""One scene in three engines: gen2d, Box2D 2.3 and Chipmunk (pymunk); billiard.py has the exact path of smooth discs.

The bodies of a scene have the numbers 0, 1, ..., its walls, which are segments, -1, -2, ... All pairs of a scene have
the same elasticity and friction. The engines mix the values of two bodies differently, so the bodies have different
values in each: gen2d and Chipmunk multiply, Box2D takes the larger elasticity and the geometric mean of the frictions.
Densities are 1 kg/m^2.
"""

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pymunk
from worlds import world

from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.space import space

with warnings.catch_warnings():  # raised by types of SWIG
    warnings.filterwarnings("ignore", r"builtin type (SwigPy\w+|swigvarlink) has no __module__", DeprecationWarning)
    import Box2D

SKIN = Box2D.b2_polygonRadius  # m: Box2D's rounding of boxes and segments, which touch at this distance
Pair = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Thing:
    """A disc, or a box if it has a `size`."""

    x: Pair  # m
    v: Pair = (0.0, 0.0)  # m/s
    radius: float = 0.5  # m, of a disc
    size: Pair | None = None  # m, width and height of a box

    @property
    def mass(self) -> float:
        """Mass in kg."""
        return math.pi * self.radius**2 if self.size is None else self.size[0] * self.size[1]

    @property
    def moment(self) -> float:
        """Moment of inertia in kg m^2."""
        return self.mass * (self.radius**2 / 2 if self.size is None else (self.size[0] ** 2 + self.size[1] ** 2) / 12)

    @property
    def corners(self) -> np.ndarray:
        """Corners of a box at angle 0, relative to its centre, counter-clockwise, m [4, 2]."""
        return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * np.array(self.size) / 2


@dataclasses.dataclass(frozen=True)
class Setting:
    """A scene."""

    things: Sequence[Thing]
    walls: Sequence[tuple[Pair, Pair]]
    gravity: float = 0.0  # m/s^2, downwards
    elasticity: float = 0.0
    friction: float = 0.0


class Event(NamedTuple):
    """The beginning of a contact."""

    time: float  # s
    pair: tuple[int, int]  # in ascending order


class Path(NamedTuple):
    """Motion of a scene in an engine."""

    poses: np.ndarray  # [T, K, 3]: x, y in m, angle in rad
    speeds: np.ndarray  # [T, K, 3]: their velocities
    events: list[Event]


def pair_of(a: int, b: int) -> tuple[int, int]:
    """Two numbers in ascending order."""
    return min(a, b), max(a, b)


# gen2d --------------------------------------------------------------------------------------------------------------


def gen2d_world(setting: Setting, slots: int | None = None) -> tuple[Scene, State, Layout]:
    """The scene for `worlds.run`; some of the `slots` for discs may stay empty. gen2d mixes by the product."""
    material = {"elasticity": math.sqrt(setting.elasticity), "friction": math.sqrt(setting.friction)}
    if all(t.size is None for t in setting.things):
        discs = [{"x": t.x, "v": t.v, "radius": t.radius, **material} for t in setting.things]
        return world(discs, [{"a": a, "b": b, **material} for a, b in setting.walls], (0, -setting.gravity), slots)
    scene, friction = space.Space(gravity=(0, -setting.gravity)), math.sqrt(setting.friction)
    for t in setting.things:
        assert t.size is not None
        scene.add_box(t.x, *t.size, velocity=t.v, elasticity=math.sqrt(setting.elasticity), friction=friction)
    for a, b in setting.walls:
        scene.add_segment(a, b, elasticity=math.sqrt(setting.elasticity), friction=friction)
    return scene.scene()


def gen2d_paths(made: Any, settings: Sequence[Setting]) -> list[Path]:
    """Paths from a trajectory of `worlds.run`, with events if it has contacts."""
    states, paths = made.states, []
    for i, setting in enumerate(settings):
        bodies = slice(len(setting.things))
        poses = np.concatenate([states.position[i], states.angle[i][..., None]], axis=-1)
        speeds = np.concatenate([states.velocity[i], states.angular_velocity[i][..., None]], axis=-1)
        events = [] if made.contacts is None else _gen2d_events(made.contacts, i, poses.shape[1], setting)
        paths.append(Path(poses[:, bodies], speeds[:, bodies], events))
    return paths


def _gen2d_events(contacts: Any, video: int, slots: int, setting: Setting) -> list[Event]:
    def number(slot: int) -> int:
        return slot if slot < slots - len(setting.walls) else slots - len(setting.walls) - slot - 1

    begins = [k for k in range(contacts.time.shape[1]) if contacts.kind[video, k] in (1, 2)]
    ends = [(int(contacts.a[video, k]), int(contacts.b[video, k])) for k in begins]
    return [
        Event(float(contacts.time[video, k]), pair_of(number(a), number(b)))
        for k, (a, b) in zip(begins, ends, strict=True)
    ]


# Box2D and Chipmunk -------------------------------------------------------------------------------------------------


class _Listener(Box2D.b2ContactListener):
    def __init__(self, begin: Callable[[int, int], None]) -> None:
        super().__init__()
        self.begin = begin

    def BeginContact(self, contact: Any) -> None:
        """Callback of Box2D."""
        self.begin(contact.fixtureA.body.userData, contact.fixtureB.body.userData)


def box2d_path(setting: Setting, seconds: float, steps: int = 1, fps: int = 60, events: int | None = None) -> Path:
    """Box2D's path at `fps`, with `steps` per frame of 8 and 3 iterations; ends after this number of `events`."""
    b2_world = Box2D.b2World(gravity=(0, -setting.gravity))
    material = {"restitution": setting.elasticity, "friction": setting.friction}
    bodies = []
    for i, t in enumerate(setting.things):
        body = b2_world.CreateDynamicBody(position=t.x, linearVelocity=t.v, userData=i, allowSleep=False)
        circle, polygon = Box2D.b2CircleShape, Box2D.b2PolygonShape
        shape = circle(radius=t.radius) if t.size is None else polygon(vertices=t.corners.tolist())
        body.CreateFixture(shape=shape, density=1.0, **material)
        bodies.append(body)
    for j, ends in enumerate(setting.walls):
        body = b2_world.CreateStaticBody(userData=-1 - j)
        body.CreateFixture(shape=Box2D.b2EdgeShape(vertices=ends), **material)

    def state() -> list:
        return [(*b.position, b.angle, *b.linearVelocity, b.angularVelocity) for b in bodies]

    def listen(begin: Callable[[int, int], None]) -> None:
        b2_world.contactListener = _Listener(begin)

    return _path(lambda h: b2_world.Step(h, 8, 3), state, listen, seconds, steps, fps, events)


def chipmunk_path(setting: Setting, seconds: float, steps: int = 4, fps: int = 60, events: int | None = None) -> Path:
    """Chipmunk's path at `fps`, with `steps` per frame of 10 iterations; ends after this number of `events`."""
    pymunk_space = pymunk.Space()
    pymunk_space.gravity = 0, -setting.gravity
    bodies, shapes, numbers = [], [], {}
    for i, t in enumerate(setting.things):
        body = pymunk.Body(t.mass, t.moment)
        body.position, body.velocity = t.x, t.v
        shapes.append(pymunk.Circle(body, t.radius) if t.size is None else pymunk.Poly(body, t.corners.tolist()))
        numbers[shapes[-1]] = i
        pymunk_space.add(body)
        bodies.append(body)
    for j, (a, b) in enumerate(setting.walls):
        shapes.append(pymunk.Segment(pymunk_space.static_body, a, b, 0))
        numbers[shapes[-1]] = -1 - j
    for shape in shapes:
        shape.elasticity, shape.friction = math.sqrt(setting.elasticity), math.sqrt(setting.friction)
    pymunk_space.add(*shapes)

    def state() -> list:
        return [(*b.position, b.angle, *b.velocity, b.angular_velocity) for b in bodies]

    def listen(begin: Callable[[int, int], None]) -> None:
        pymunk_space.on_collision(begin=lambda arbiter, *_: begin(*(numbers[s] for s in arbiter.shapes)))

    return _path(pymunk_space.step, state, listen, seconds, steps, fps, events)


def _path(
    step: Callable[[float], Any], state: Callable[[], list], listen: Callable, seconds: float, steps: int, fps: int,
    max_events: int | None,
) -> Path:  # fmt: skip
    h, states, events, now = 1 / (fps * steps), [state()], [], 0
    if max_events is not None:
        listen(lambda a, b: events.append(Event(now * h, pair_of(a, b))))
    for _ in range(round(seconds * fps)):
        for _ in range(steps):
            step(h)
            now += 1
        states.append(state())
        if max_events is not None and len(events) >= max_events:
            break
    trajectory = np.array(states)
    return Path(trajectory[..., :3], trajectory[..., 3:], events)


# Overlaps -----------------------------------------------------------------------------------------------------------


def deepest(setting: Setting, poses: np.ndarray, skin: float = 0.0) -> float:
    """Deepest overlap in m over all poses [T, K, 3], by separating axes; `skin` is the rounding of boxes and walls."""
    things = [(_core(t, poses[:, k]), t.radius if t.size is None else skin) for k, t in enumerate(setting.things)]
    walls = [(np.broadcast_to(np.array(ends, float), (len(poses), 2, 2)), skin) for ends in setting.walls]
    pairs = [(a, b) for k, a in enumerate(things) for b in [*things[k + 1 :], *walls]]
    return max(0.0, max(float((r + s - _separation(a, b)).max()) for (a, r), (b, s) in pairs))


def _core(thing: Thing, poses: np.ndarray) -> np.ndarray:
    """Core of a body: the centre of a disc [T, 1, 2] or the corners of a box [T, 4, 2]."""
    if thing.size is None:
        return poses[:, None, :2]
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    axes = np.stack([np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)], axis=1)
    return poses[:, None, :2] + np.einsum("vi,tij->tvj", thing.corners, axes)


def _separation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Largest separation of two convex cores [T, V, 2] along any face normal; for a disc's centre, its distance."""
    if a.shape[1] == 1:
        start, edge = b[:, 0], b[:, -1] - b[:, 0]
        along = np.einsum("ti,ti->t", a[:, 0] - start, edge) / np.maximum(np.einsum("ti,ti->t", edge, edge), 1e-12)
        return np.linalg.norm(a[:, 0] - start - np.clip(along, 0, 1)[:, None] * edge, axis=1)
    edges = np.concatenate([np.roll(core, -1, axis=1) - core for core in (a, b)], axis=1)
    normals = np.stack([edges[..., 1], -edges[..., 0]], axis=-1) / np.linalg.norm(edges, axis=-1, keepdims=True)
    projected_a, projected_b = (np.einsum("tvi,tei->tev", core, normals) for core in (a, b))
    return np.maximum(projected_b.min(2) - projected_a.max(2), projected_a.min(2) - projected_b.max(2)).max(1)
