"""Cost of physics against the number of objects: gen2d, Chipmunk (pymunk) and phyjax2d on the same scenes.

    python tests/bench/bench.py --only physics --plot docs/physics_cost.png     # about 5 minutes

In each scene, N discs of random radii, or 8 rectangles, fall and bounce in a box with a constant area per object, for
64 frames at 60 Hz with 4 steps each. Every engine has its default number of iterations and returns the states of all
frames; pymunk is stepped, and read by the attributes of each body, as its manual shows. phyjax2d steps 16 scenes at
once under `jax.vmap`, as it is slower with more (8 discs: 13 microseconds per step with 16, 18 with 64). Times are CPU
times of this process on one core, so other work on the machine has little effect. Most of the run is compilation.
"""

import copy
import importlib
import importlib.util
import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import peer
import pymunk
from charts import FAINT, cost_chart, save
from timing import timed

FRAMES, STEPS, STEP = 64, 4, 1 / 240  # s
GRAVITY, ELASTICITY, FRICTION = -9.81, 0.9, 0.2  # m/s^2; of each body: gen2d and Chipmunk multiply those of two
AREA = 12.5  # m^2 of the box per object, as with the 8 of configs/benchmark.yaml
RADIUS, SIDES, SPEED = (0.5, 1.0), (0.6, 1.4), 3.0  # m: uniform ranges; m/s: standard deviation of each component
STEPPED = (FRAMES - 1) * STEPS
INSTALL = "phyjax2d is not measured, as it is not installed here: pip install --no-deps phyjax2d==0.5.0"


class Case(NamedTuple):
    """A kind of scene, and the numbers of videos and turns that are measured."""

    shape: str  # "discs" or "boxes"
    objects: int
    batch_size: int  # of gen2d
    peers: tuple[int, int]  # videos that pymunk and phyjax2d simulate in a turn
    turns: int

    @property
    def name(self) -> str:
        """Name in the tables."""
        return f"{self.objects} {self.shape}"

    @property
    def pairs(self) -> int:
        """Number of pairs that can collide: two objects, or an object and a wall."""
        return self.objects * (self.objects - 1) // 2 + 4 * self.objects


CASES = {
    case.name: case
    for case in (
        Case("discs", 4, 512, (64, 16), 5),
        Case("discs", 8, 512, (32, 16), 5),
        Case("discs", 16, 512, (24, 16), 3),
        Case("discs", 32, 512, (16, 16), 3),
        Case("discs", 64, 256, (12, 16), 2),
        Case("boxes", 8, 512, (32, 0), 5),
    )
}


class Start(NamedTuple):
    """Initial state of a video; discs have a radius, boxes two sides."""

    box: float  # m, its side
    positions: np.ndarray  # [N, 2] m
    angles: np.ndarray  # [N] rad
    velocities: np.ndarray  # [N, 2] m/s
    sizes: np.ndarray  # [N] or [N, 2] m

    @property
    def masses(self) -> np.ndarray:
        """Masses [N] in kg, at a density of 1 kg/m^2."""
        return np.pi * self.sizes**2 if self.sizes.ndim == 1 else self.sizes.prod(axis=1)

    @property
    def walls(self) -> list[tuple[tuple[float, float], tuple[float, float]]]:
        """End points of the four sides of the box."""
        corners = [(0.0, 0.0), (self.box, 0.0), (self.box, self.box), (0.0, self.box), (0.0, 0.0)]
        return list(itertools.pairwise(corners))


def sample(case: Case, number: int) -> Start:
    """Initial state of video `number`: objects on a square grid, so that none overlap."""
    rng, box = np.random.default_rng([1, number]), math.sqrt(AREA * case.objects)
    columns = math.isqrt(case.objects - 1) + 1
    cells = [((i + 0.5) * box / columns, (j + 0.5) * box / columns) for j in range(columns) for i in range(columns)]
    discs = case.shape == "discs"
    return Start(
        box=box,
        positions=np.array(cells[: case.objects]),
        angles=np.zeros(case.objects) if discs else rng.uniform(0, np.pi, case.objects),
        velocities=rng.normal(0, SPEED, (case.objects, 2)),
        sizes=rng.uniform(*RADIUS, case.objects) if discs else rng.uniform(*SIDES, (case.objects, 2)),
    )


# ---- The engines


def works(case: Case) -> tuple[dict[str, Callable[[], float]], dict[str, float]]:
    """By engine, functions that simulate videos and return the CPU seconds per video; gen2d's compile times, s."""
    ours, seconds = {}, {}
    for name, *options in (("states", False, False), ("all", True, False), ("time", True, True)):
        program, inputs, seconds[f"compile {name}"] = gen2d_program(case, *options)
        ours[name] = _timed_program(program, inputs, case.batch_size)
    by_engine = ours | {"pymunk": lambda: chipmunk_seconds(case)}
    if case.peers[1] and has_phyjax2d():
        program, inputs = phyjax2d_program(case)
        by_engine["phyjax2d"] = _timed_program(program, inputs, case.peers[1])
    return by_engine, seconds


def has_phyjax2d() -> bool:
    """Whether phyjax2d is installed."""
    return importlib.util.find_spec("phyjax2d") is not None


def _timed_program(program: Callable, inputs: Sequence[Any], videos: int) -> Callable[[], float]:
    import jax

    return timed(lambda: jax.block_until_ready(program(*inputs)), videos)


def gen2d_program(
    case: Case, everything: bool, by_time: bool = False, sparse: bool = True
) -> tuple[Callable, Any, float]:
    """Compiled program, its inputs, and the CPU seconds of its compilation.

    With `everything`, it also records energy and contacts, in as many rows as `annotations.contacts: 4` gives; with
    `by_time`, the impacts of a step act in the order of their times. `sparse` selects the solver of nearby pairs.
    """
    import jax
    from worlds import rules

    from gen2d.physics.simulate import SaveAt, simulate
    from gen2d.programs import devices, environment
    from gen2d.records import axes, trajectory
    from gen2d.records import scene as scene_module

    devices.keep_freed_memory()  # as in a run
    jax.config.update("jax_enable_compilation_cache", False)
    scenes = [gen2d_scene(sample(case, number)) for number in range(case.batch_size)]
    layout = scenes[0][2]
    inputs = jax.tree.map(lambda *x: np.stack(x), *(scene[:2] for scene in scenes))
    save_at = SaveAt(4 * layout.slots * math.ceil(FRAMES / 16), energy=True) if everything else SaveAt()

    def run(scene: scene_module.Scene, state: scene_module.State) -> trajectory.Trajectory:
        device = axes.to_device(scene), axes.to_device(state)
        return axes.to_stored(simulate(*device, layout, params, FRAMES, STEPS, save_at, sparse=sparse))

    params, began = rules(STEP, by_time=by_time), time.process_time()
    program = jax.jit(run).lower(*inputs).compile(environment.compiler_options(devices.default()))
    return program, jax.device_put(inputs), time.process_time() - began


def gen2d_scene(start: Start) -> Any:
    """Scene, initial state and layout."""
    from gen2d.space.space import Space

    space = Space((0, GRAVITY))
    for position, angle, velocity, size in zip(*start[1:], strict=True):
        if start.sizes.ndim == 1:
            space.add_circle(position, size, velocity=velocity, elasticity=ELASTICITY, friction=FRICTION)
        else:
            space.add_box(position, *size, angle=angle, velocity=velocity, elasticity=ELASTICITY, friction=FRICTION)
    for a, b in start.walls:
        space.add_segment(a, b, elasticity=ELASTICITY, friction=FRICTION)
    return space.scene()


def chipmunk_seconds(case: Case) -> float:
    """CPU seconds per video, without building the scenes."""
    spaces = [chipmunk_space(sample(case, number)) for number in range(case.peers[0])]
    began = time.process_time()
    for space in spaces:
        peer.simulate(space, step=STEP)
    return (time.process_time() - began) / len(spaces)


def chipmunk_space(start: Start) -> pymunk.Space:
    """The scene, with Chipmunk's default of 10 iterations."""
    space = pymunk.Space()
    space.gravity = 0, GRAVITY
    shapes: list[pymunk.Shape] = [pymunk.Segment(space.static_body, a, b, 0) for a, b in start.walls]
    rows = zip(start.positions, start.angles, start.velocities, start.sizes, start.masses, strict=True)
    for position, angle, velocity, size, mass in rows:
        disc = start.sizes.ndim == 1
        moment = pymunk.moment_for_circle(mass, 0, size) if disc else pymunk.moment_for_box(mass, tuple(size))
        body = pymunk.Body(mass, moment)
        body.position, body.angle, body.velocity = tuple(position.tolist()), float(angle), tuple(velocity.tolist())
        shapes.append(pymunk.Circle(body, size) if disc else pymunk.Poly.create_box(body, tuple(size)))
        space.add(body)
    for shape in shapes:
        shape.elasticity, shape.friction = ELASTICITY, FRICTION
    space.add(*shapes)
    return space


def phyjax2d_program(case: Case) -> tuple[Callable, Any]:
    """Compiled program for discs, with phyjax2d's default of 6 and 2 iterations, and its inputs."""
    import jax

    starts = [sample(case, number) for number in range(case.peers[1])]
    spaces = [phyjax2d_space(start) for start in starts]
    step, first = importlib.import_module("phyjax2d").step, spaces[0]
    parts = [(space.shaped, space._ci, space._ci_total) for space in spaces]
    tree, leaves = jax.tree.structure(parts[0]), zip(*map(jax.tree.leaves, parts), strict=True)
    arrays = {i: np.stack(values) for i, values in enumerate(leaves)}
    # Arrays that differ between scenes: radii and masses.
    own = {i: array for i, array in arrays.items() if (array != array[:1]).any()}

    def video(own: Any, position: Any, velocity: Any) -> Any:
        space = copy.copy(first)  # a Space cannot be built under jit, so all were built before
        space.shaped, space._ci, space._ci_total = tree.unflatten([own.get(i, all_[0]) for i, all_ in arrays.items()])
        state = first.zeros_state().nested_replace("circle.p.xy", position).nested_replace("circle.v.xy", velocity)

        def frame(world: Any, _: None) -> Any:
            world = jax.lax.fori_loop(0, STEPS, lambda _, now: step(space, *now)[:2], world)
            return world, (world[0].circle.p, world[0].circle.v)

        return jax.lax.scan(frame, (state, first.init_solver()), None, length=FRAMES - 1)[1]

    columns = [np.array([start[i] for start in starts], np.float32) for i in (1, 3)]
    inputs = jax.device_put((own, *columns))
    return jax.jit(jax.vmap(video)).lower(*inputs).compile(), inputs


def phyjax2d_space(start: Start) -> Any:
    """The scene in phyjax2d."""
    physics = importlib.import_module("phyjax2d")
    builder = physics.SpaceBuilder(
        gravity=(0, GRAVITY), dt=STEP, linear_damping=0.0, angular_damping=0.0, bounce_threshold=0.01
    )
    # phyjax2d takes the mean of two bodies, the others the product.
    material = {"elasticity": ELASTICITY**2, "friction": FRICTION**2}
    for radius in start.sizes:
        builder.add_circle(radius=float(radius), **material)
    for a, b in start.walls:
        builder.add_segment(p1=physics.Vec2d(*a), p2=physics.Vec2d(*b), **material)
    return builder.build()


# ---- Results


class Cost(NamedTuple):
    """A row of the table of physics."""

    name: str
    objects: int
    pairs: int
    micros: Mapping[str, float]  # CPU time per video and step, by engine
    compile: Mapping[str, float]  # s


LINES = {
    "states": "gen2d, states only",
    "all": "gen2d, contacts and energy too",
    "time": "gen2d, and impacts in the order of time",
    "pymunk": "pymunk",
    "phyjax2d": "phyjax2d, vmap",
}


def cost_of(case: Case, seconds: Mapping[str, float]) -> Cost:
    """Row of the table, from the seconds per video by engine and gen2d's compile times in s."""
    micros = {name: seconds[name] / STEPPED * 1e6 for name in LINES if name in seconds}
    compiled = {name: seconds[f"compile {name}"] for name in ("states", "all", "time")}
    return Cost(case.name, case.objects, case.pairs, micros, compiled)


def table(costs: Sequence[Cost]) -> list[str]:
    """Lines of the table."""
    lines = [
        "one core, microseconds of CPU time a video and step; gen2d with states only, with contacts and energy too, and"
        " with those and impacts in the order of time"
    ]
    head = f"{'states':>8} {'all':>8} {'time':>8} {'pymunk':>8} {'phyjax2d':>9}"
    lines += [f"{'':12} {'pairs':>6} {head}   compile, s: states, all, time"]
    for c in costs:
        states, all_, time_, *others = (f"{c.micros[name]:.2f}" if name in c.micros else "-" for name in LINES)
        compiled = ", ".join(f"{seconds:.1f}" for seconds in c.compile.values())
        of_peers = f"{others[0]:>8} {others[1]:>9}"
        lines += [f"{c.name:12} {c.pairs:6} {states:>8} {all_:>8} {time_:>8} {of_peers}   {compiled}"]
    return lines


COLORS = {"states": "#44aadd", "all": "#114499", "pymunk": "#dd6622", "phyjax2d": "#229977"}


def chart(costs: Sequence[Cost], path: Path) -> None:
    """Write a PNG chart of the cost against the number of discs."""
    costs = [cost for cost in costs if cost.name.endswith("discs")]
    counts = [cost.objects for cost in costs]
    axes = cost_chart("Physics on one core", "discs in a box, N", "microseconds a video and step", counts)
    for name, color in COLORS.items():
        points = [(cost.objects, cost.micros[name]) for cost in costs if name in cost.micros]
        if points:
            axes.plot(*zip(*points, strict=True), "o-", color=color, label=LINES[name])
    guide = [cost.pairs * min(costs[0].micros.values()) / costs[0].pairs for cost in costs]
    axes.plot(counts, guide, color=FAINT, linewidth=1, label="pairs that can meet, slope only")
    save(axes, path)
