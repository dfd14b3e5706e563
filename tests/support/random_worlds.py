"""Random worlds of all shapes and joints, made from seeds, and what their laws measure.

All worlds of an `Arena` share its layout, so one compiled program simulates them; a `Recipe` says which of the slots a
class of worlds fills, and with what. Every step is a frame. Energies and momenta are computed here, in float64, from
the states alone.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from overlap import deepest
from worlds import rules, run

from gen2d.core.enums import DYNAMIC, END, NO_CONTACT, STATIC
from gen2d.physics.params import SolverParams
from gen2d.physics.simulate import SaveAt
from gen2d.records.layout import JointSpec, Layout, SlotGroup
from gen2d.records.scene import Joints, Objects, Scene, State
from gen2d.records.trajectory import Contacts

HALF, SIDES = 5.0, 4  # m: half the side of the box; its number of walls
GRAVITY = 9.81  # m/s^2
FRAMES = 361  # 1.5 s
MARKS = slice(120, None, 120)  # frames at each half second, at 240 Hz
ROWS = 8000  # of contacts in a world
MIXING = {
    "product": np.multiply,
    "mean": lambda a, b: (a + b) / 2,
    "max": np.maximum,
    "geometric": lambda a, b: np.sqrt(a * b),
}
SHAPES = {"circle": 0, "segment": 1, "capsule": 2, "polygon": 3}
SIGNS = [(-1, -1), (1, -1), (1, 1), (-1, 1)]


@dataclasses.dataclass(frozen=True)
class Arena:
    """Slots of worlds: discs, capsules, polygons, walls and an obstacle of segments and, if asked for, of boxes."""

    discs: int
    capsules: int
    polygons: int
    corners: int
    blocks: bool = False  # whether there are fixed boxes and joints

    @property
    def moving(self) -> int:
        """Number of slots of bodies that move, which are the first."""
        return self.discs + self.capsules + self.polygons

    @property
    def firsts(self) -> tuple[int, int, int]:
        """First slots of discs, capsules and polygons."""
        return 0, self.discs, self.discs + self.capsules

    @property
    def block(self) -> int:
        """Slot of the fixed box; those before it are the walls of boxes."""
        return self.moving + 2 * SIDES + 1

    @property
    def hinged(self) -> tuple[int, int]:
        """Two polygons that only worlds with joints have: a hinge, unlike a spring, cannot have no strength."""
        return self.moving - 2, self.moving - 1

    @functools.cached_property
    def layout(self) -> Layout:
        """The layout of all worlds."""
        groups = [
            SlotGroup("circle", self.discs),
            SlotGroup("capsule", self.capsules),
            SlotGroup("polygon", self.polygons, vertices=self.corners),
            SlotGroup("segment", SIDES + 1, STATIC),
            SlotGroup("polygon", (SIDES + 1) * self.blocks, STATIC, vertices=4),
        ]
        joints = (
            JointSpec("distance", 0, 1, collide=True),
            JointSpec("distance", self.firsts[1], self.firsts[2], collide=True),
            JointSpec("distance", self.block, 2, collide=True),
            JointSpec("revolute", *self.hinged),
            JointSpec("revolute", self.block, self.hinged[0]),
        )
        return Layout(tuple(group for group in groups if group.count), joints=joints if self.blocks else ())

    @property
    def shapes(self) -> np.ndarray:
        """Code of the shape in each slot."""
        groups = self.layout.groups
        return np.repeat([SHAPES[group.shape] for group in groups], [group.count for group in groups])


SMALL = Arena(discs=6, capsules=0, polygons=3, corners=5)
LARGE = Arena(discs=6, capsules=2, polygons=5, corners=6, blocks=True)


@dataclasses.dataclass(frozen=True)
class Recipe:
    """A class of worlds. Ranges are of uniform distributions."""

    discs: tuple[int, int] = (2, 6)  # numbers of bodies, at least and at most
    capsules: tuple[int, int] = (0, 2)  # where the arena has any
    polygons: tuple[int, int] = (0, 3)
    boxes: bool = False  # whether all polygons are rectangles
    radius: tuple[float, float] = (0.3, 0.6)  # m: of discs, and of the circles around polygons
    speed: float = 3.0  # m/s: standard deviation of each component
    fast: float = 0.0  # m/s: speed of discs if it is not 0; their radii are a fifth
    spin: float = 5.0  # rad/s: standard deviation
    density: float = 0.0  # decades: densities are 10^-density to 10^density
    elasticity: tuple[float, float] = (0.0, 1.0)  # of pairs, so each body has the square root
    friction: tuple[float, float] = (0.0, 1.0)
    gravity: float = 0.5  # share of worlds with gravity
    fixed: float = 0.5  # share of worlds with an obstacle and, where the arena has blocks, a fixed box
    thick: float = 0.5  # there, share of worlds with walls of boxes instead of segments
    closed: bool = True  # whether there are walls at all
    joints: bool = False


def outline(rng: np.random.Generator, radius: float, most: int, boxes: bool) -> np.ndarray:
    """Corners [most, 2] of a convex polygon about its centre of mass, the last repeated."""
    if boxes or rng.random() < 0.5:
        turn = rng.uniform(math.radians(10), math.radians(80))
        corners = radius * np.array([(s * math.cos(turn), t * math.sin(turn)) for s, t in SIGNS])
    else:
        count = rng.integers(3, most, endpoint=True)
        turns = (np.arange(count) + rng.uniform(0, 0.6, count)) * 2 * np.pi / count
        corners = radius * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    corners = corners - centroid(corners)
    return np.concatenate([corners, np.repeat(corners[-1:], most - len(corners), axis=0)])


def centroid(corners: np.ndarray) -> np.ndarray:
    """Centre of mass [2] of a polygon [V, 2]."""
    following = np.roll(corners, -1, axis=0)
    cross = corners[:, 0] * following[:, 1] - following[:, 0] * corners[:, 1]
    return ((corners + following) * cross[:, None]).sum(0) / (3 * cross.sum())


def mass_and_moment(shape: int, radius: float, half: float, corners: np.ndarray, density: float) -> tuple[float, float]:
    """Mass in kg and moment of inertia in kg m^2 of a disc (0), capsule (2) or polygon (3)."""
    if shape == 3:
        x, y = corners.T
        following = np.roll(corners, -1, axis=0)
        cross = x * following[:, 1] - following[:, 0] * y
        squares = (corners**2).sum(1) + (corners * following).sum(1) + (following**2).sum(1)
        return density * cross.sum() / 2, density * (cross * squares).sum() / 12
    ends, middle = density * math.pi * radius**2, density * 4 * half * radius
    centroid = 4 * radius / (3 * math.pi)  # of a half disc, from its straight side
    moment = middle * ((2 * half) ** 2 + (2 * radius) ** 2) / 12
    return ends + middle, moment + ends * (radius**2 / 2 + half**2 + 2 * half * centroid)


def random_world(arena: Arena, recipe: Recipe, seed: int) -> tuple[Scene, State, Layout]:  # noqa: PLR0915  one story
    """One world; bodies start apart from each other and from what is fixed."""
    rng, slots, shape = np.random.default_rng([seed, 19]), arena.layout.slots, arena.shapes
    o: dict[str, Any] = {name: np.zeros(slots) for name in ("radius", "half_length", "elasticity", "friction")}
    o |= {"mass": np.full(slots, np.inf), "moment": np.full(slots, np.inf), "present": np.zeros(slots, bool)}
    vertices, x, v = np.zeros((slots, arena.corners, 2)), np.zeros((slots, 2)), np.zeros((slots, 2))
    angle, spin, circles = np.zeros(slots), np.zeros(slots), []  # circles: (centre, radius) around what is there

    def material(slot: int) -> None:
        o["present"][slot] = True
        o["elasticity"][slot] = math.sqrt(rng.uniform(*recipe.elasticity))
        o["friction"][slot] = math.sqrt(rng.uniform(*recipe.friction))

    def segment(slot: int, centre: np.ndarray, turn: float, half: float) -> None:
        material(slot)
        x[slot], angle[slot], o["half_length"][slot] = centre, turn, half

    def box(slot: int, centre: np.ndarray, width: float, height: float, turn: float = 0.0) -> None:
        material(slot)
        corners = np.array(SIGNS) * (width / 2, height / 2)
        vertices[slot] = np.concatenate([corners, np.repeat(corners[-1:], arena.corners - 4, axis=0)])
        x[slot], angle[slot] = centre, turn

    thick = arena.blocks and rng.random() < recipe.thick
    for k in range(SIDES if recipe.closed else 0):
        along = k * math.pi / 2  # counter-clockwise from the floor
        outward = np.array([math.sin(along), -math.cos(along)])
        if thick:
            sides = (2 * HALF + 4, 2.0) if k % 2 == 0 else (2.0, 2 * HALF + 4)
            box(arena.block - SIDES + k, (HALF + 1) * outward, *sides)
        else:
            segment(arena.moving + k, HALF * outward, along, HALF)
    if recipe.joints or (recipe.closed and rng.random() < recipe.fixed):
        obstacle = arena.moving + SIDES
        segment(obstacle, rng.uniform((-3.5, -4), (3.5, -2)), rng.uniform(-0.5, 0.5), rng.uniform(0.5, 1))
        circles.append((x[obstacle], o["half_length"][obstacle]))
        if arena.blocks:
            centre, (width, height) = rng.uniform((-1, 0), (1, 2)), rng.uniform(0.5, 1.5, 2)
            box(arena.block, centre, width, height, rng.uniform(-math.pi, math.pi))
            circles.append((x[arena.block], math.hypot(*vertices[arena.block, 0])))

    ranges = [recipe.discs, recipe.capsules if arena.capsules else (0, 0), recipe.polygons]
    counts = [int(rng.integers(*of, endpoint=True)) for of in ranges]
    if recipe.joints:
        counts = [max(counts[0], 3), max(counts[1], 1), arena.polygons]
    bodies = [first + k for first, count in zip(arena.firsts, counts, strict=True) for k in range(count)]
    for slot in reversed(bodies):  # large ones first
        material(slot)
        radius = rng.uniform(*recipe.radius)
        if shape[slot] == SHAPES["polygon"]:
            vertices[slot] = outline(rng, radius, arena.corners, recipe.boxes)
        elif shape[slot] == SHAPES["capsule"]:
            o["radius"][slot], o["half_length"][slot] = radius / 4, 0.75 * radius
        else:
            o["radius"][slot] = radius / 5 if recipe.fast else radius
        reach = max(np.hypot(*vertices[slot].T).max(), o["radius"][slot] + o["half_length"][slot])
        x[slot] = free_place(rng, reach, circles)
        circles.append((x[slot], reach))
        angle[slot], spin[slot] = rng.uniform(-math.pi, math.pi), rng.normal(0, recipe.spin)
        v[slot] = rng.normal(0, recipe.speed, 2)
        if recipe.fast and shape[slot] == SHAPES["circle"]:
            v[slot] *= recipe.fast / math.hypot(*v[slot])
        density = 10 ** rng.uniform(-recipe.density, recipe.density)
        own = o["radius"][slot], o["half_length"][slot], vertices[slot], density
        o["mass"][slot], o["moment"][slot] = mass_and_moment(int(shape[slot]), *own)
    joints = random_joints(rng, arena, recipe, x, angle, v, spin) if arena.blocks else None
    corners = [
        len(np.unique(of, axis=0)) if s == SHAPES["polygon"] else 0 for of, s in zip(vertices, shape, strict=True)
    ]
    o |= {
        "kind": np.repeat([DYNAMIC, STATIC], [arena.moving, slots - arena.moving]).astype(np.uint8),
        "shape": shape.astype(np.uint8),
        "depth": np.arange(slots).astype(np.int16),
        "color": np.zeros((slots, 3), np.uint8),
        "vertices": vertices,
        "vertex_count": np.array(corners, np.uint8),
    }
    state: dict[str, Any] = {"position": x, "angle": angle, "velocity": v, "angular_velocity": spin}
    gravity: Any = np.array((0.0, -GRAVITY if rng.random() < recipe.gravity else 0.0), np.float32)
    return Scene(Objects(**single(o)), gravity, joints), State(**single(state)), arena.layout


def single(values: dict[str, Any]) -> dict[str, Any]:
    """The arrays, those of real numbers in single precision."""
    return {name: x.astype(np.float32) if x.dtype == np.float64 else x for name, x in values.items()}


def free_place(rng: np.random.Generator, reach: float, circles: list[tuple[np.ndarray, float]]) -> np.ndarray:
    """A place [2] for a body within this radius of it, apart from all circles and from the walls."""
    room = HALF - reach - 0.01
    for _ in range(1000):
        place = rng.uniform(-room, room, 2)
        if all(math.hypot(*(place - centre)) > reach + radius + 0.01 for centre, radius in circles):
            return place
    raise AssertionError("the box is too full")


def random_joints(
    rng: np.random.Generator, arena: Arena, recipe: Recipe, x: np.ndarray, angle: np.ndarray, v: np.ndarray,
    spin: np.ndarray,
) -> Joints:  # fmt: skip
    """Joints of a world, at their rest lengths and angles: rods, springs, hinges, some with limits.

    Without them, distance joints have no stiffness and hinges no bodies. Bodies on rods and hinges start at rest, as a
    rigid joint would take away the speeds that it does not allow.
    """
    count = len(arena.layout.joints)
    numbers = {name: np.zeros(count) for name in ("rest", "stiffness", "damping", "motor_speed", "motor_torque")}
    numbers |= {"lower": np.full(count, -np.inf), "upper": np.full(count, np.inf)}
    anchors = np.zeros((2, count, 2))
    for j, joint in enumerate(arena.layout.joints if recipe.joints else ()):
        ends, middle = (joint.a, joint.b), (x[joint.a] + x[joint.b]) / 2
        if joint.kind == "revolute":
            anchors[:, j] = [rotation(-angle[slot]) @ (middle - x[slot]) for slot in ends]
            numbers["rest"][j] = angle[joint.b] - angle[joint.a]
            if rng.random() < 0.5:
                numbers["lower"][j], numbers["upper"][j] = rng.uniform(-1.5, -0.2), rng.uniform(0.2, 1.5)
        else:
            numbers["rest"][j] = math.hypot(*(x[joint.b] - x[joint.a]))
            numbers["stiffness"][j] = math.inf if rng.random() < 0.5 else 10 ** rng.uniform(0, 4)
            numbers["damping"][j] = 10 ** rng.uniform(-1, 2) if rng.random() < 0.5 else 0.0
        if joint.kind == "revolute" or numbers["stiffness"][j] == math.inf:
            for slot in ends:
                v[slot], spin[slot] = 0.0, 0.0
    return Joints(**single({"anchor_a": anchors[0], "anchor_b": anchors[1], **numbers}))


def rotation(angle: float) -> np.ndarray:
    """Matrix [2, 2] of a rotation."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([(c, -s), (s, c)])


# What the laws measure ------------------------------------------------------------------------------------------------


class Measures(NamedTuple):
    """Figures of n worlds in T frames."""

    finite: np.ndarray  # [n] whether all states are finite
    energy: np.ndarray  # [n, T] J: kinetic, potential (0 on the floor) and of springs
    momentum: np.ndarray  # [n, T, 2] kg m/s
    angular: np.ndarray  # [n, T] kg m^2/s, about the origin
    momentum_scale: np.ndarray  # [n] sum of |m v| at the start
    angular_scale: np.ndarray  # [n] sum of |m x| |v| + |I w| at the start
    outside: np.ndarray  # [n] m: largest distance of a centre beyond a wall; negative inside
    contacts: Contacts
    friction: np.ndarray  # [n, C] of the pair of each row
    overlap: np.ndarray  # [n, M] m: deepest overlap of a moving body at each mark
    detour: np.ndarray  # [n] m: farthest that a body on no joint, without a contact, ends a step off its parabola

    @property
    def gain_in_step(self) -> np.ndarray:
        """Largest gain of energy in a step, relative to that at the start, [n]."""
        return np.nanmax(np.diff(self.energy), axis=1) / self.energy[:, 0]

    @property
    def gain(self) -> np.ndarray:
        """Largest gain of energy over that at the start, [n]."""
        return np.nanmax(self.energy, axis=1) / self.energy[:, 0] - 1

    @property
    def rows(self) -> np.ndarray:
        """Whether a row holds a contact, [n, C]."""
        return np.asarray(self.contacts.kind) > 0

    @property
    def normal_impulse(self) -> np.ndarray:
        """Normal impulse of each row, N s [n, C]."""
        return np.asarray(self.contacts.normal_impulse, float)

    @property
    def idle_impulses(self) -> np.ndarray:
        """Whether a row has an impulse, for each row without a contact, unused ones and those of an end."""
        kind, tangent = np.asarray(self.contacts.kind), np.asarray(self.contacts.tangent_impulse)
        return ((self.normal_impulse != 0) | (tangent != 0))[(kind == NO_CONTACT) | (kind == END)]

    @property
    def slipping(self) -> np.ndarray:
        """Whether |p_t| exceeds mu p_n (1 + 1e-5) in a row, [n, C]."""
        bound = self.friction * np.maximum(self.normal_impulse, 0.0)
        return self.rows & (np.abs(self.contacts.tangent_impulse) > bound * (1 + 1e-5))


def measure(
    arena: Arena, recipes: Sequence[Recipe], seeds: int, first: int = 0, params: SolverParams | None = None
) -> list[Measures]:
    """Measures of worlds `first`, `first` + 1, ... of each recipe, all simulated in one batch."""
    params = params or rules()
    worlds = [random_world(arena, recipe, first + k) for recipe in recipes for k in range(seeds)]
    made = run(worlds, FRAMES, 1, params, SaveAt(contacts=ROWS))
    every = jax.tree.map(lambda *x: np.stack(x), *(scene for scene, *_ in worlds)), made.states, made.contacts
    measures = []
    for k in range(len(recipes)):
        part = slice(k * seeds, (k + 1) * seeds)
        scene, states, contacts = jax.tree.map(lambda x, part=part: x[part], every)
        measures.append(_measures(arena, scene, states, contacts, params))
    return measures


def _measures(arena: Arena, scene: Scene, states: State, contacts: Contacts, params: SolverParams) -> Measures:
    objects, moving = scene.objects, slice(arena.moving)
    present = np.asarray(objects.present)[:, None, moving]
    mass, moment = (
        np.where(present, np.asarray(a, float)[:, None, moving], 0.0) for a in (objects.mass, objects.moment)
    )
    x, v, w = (np.asarray(a, float)[:, :, moving] for a in (states.position, states.velocity, states.angular_velocity))
    g = -np.asarray(scene.gravity, float)[:, 1, None, None]
    speed, cross = np.linalg.norm(v, axis=-1), x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0]
    turning = mass * np.linalg.norm(x, axis=-1) * speed + np.abs(moment * w)
    frictions = [
        np.take_along_axis(np.asarray(objects.friction, float), np.asarray(slots, int), axis=1)
        for slots in (contacts.a, contacts.b)
    ]
    return Measures(
        finite=np.isfinite(np.concatenate([x, v, w[..., None]], axis=-1)).all((1, 2, 3)),  # pyright: ignore[reportArgumentType]
        energy=(0.5 * mass * speed**2 + 0.5 * moment * w**2 + mass * g * (x[..., 1] + HALF)).sum(-1)
        + _springs(arena, scene, states),
        momentum=(mass[..., None] * v).sum(2),
        angular=(mass * cross + moment * w).sum(-1),
        momentum_scale=(mass * speed).sum(-1)[:, 0],
        angular_scale=turning.sum(-1)[:, 0],
        outside=np.where(present, np.nan_to_num(np.abs(x).max(-1) - HALF, nan=np.inf), -HALF).max((1, 2)),
        contacts=contacts,
        friction=MIXING[params.mixing](*frictions),
        overlap=deepest(objects, np.asarray(states.position)[:, MARKS], np.asarray(states.angle)[:, MARKS]),
        detour=_detour(present & ~_on_joints(arena, scene), x, v, contacts, params.step),
    )


def _on_joints(arena: Arena, scene: Scene) -> np.ndarray:
    """Whether a joint may hold a moving body, [n, 1, moving]."""
    slots = [end for joint in arena.layout.joints for end in (joint.a, joint.b)]
    stiffness = np.zeros((len(scene.gravity), 1)) if scene.joints is None else np.asarray(scene.joints.stiffness)
    return np.isin(np.arange(arena.moving), slots) & (stiffness != 0).any(1)[:, None, None]


def _detour(free: np.ndarray, x: np.ndarray, v: np.ndarray, contacts: Contacts, h: float) -> np.ndarray:
    """See `Measures.detour`; `free` [n, 1, moving] are the bodies to look at."""
    off = np.linalg.norm(np.diff(x, axis=1) - (v[:, 1:] + v[:, :-1]) * h / 2, axis=-1)
    free = np.broadcast_to(free, off.shape).copy()
    world, row = np.nonzero(np.asarray(contacts.kind) != NO_CONTACT)
    frame = np.asarray(contacts.frame, int)[world, row]
    for slots in (contacts.a, contacts.b):
        slot = np.asarray(slots, int)[world, row]
        moving = slot < off.shape[2]
        for step in (frame - 1, frame):
            free[world[moving], np.clip(step, 0, off.shape[1] - 1)[moving], slot[moving]] = False
    return np.nan_to_num(np.where(free, off, 0.0)).max((1, 2))


def _springs(arena: Arena, scene: Scene, states: State) -> np.ndarray | float:
    """Energy of the springs, J [n, T]; they join centres of mass."""
    joints, total = scene.joints, 0.0
    for j, joint in enumerate(arena.layout.joints):
        if joint.kind == "distance" and joints is not None:
            x = np.asarray(states.position, float)
            length = np.linalg.norm(x[:, :, joint.b] - x[:, :, joint.a], axis=-1)
            stiffness = np.asarray(joints.stiffness, float)[:, j, None]
            spring = np.where(np.isfinite(stiffness), stiffness, 0.0)
            with np.errstate(invalid="ignore", over="ignore"):  # worlds that are not finite are counted by themselves
                total = total + 0.5 * spring * (length - np.asarray(joints.rest, float)[:, j, None]) ** 2
    return total
