"""Demonstrations of other engines, rebuilt in gen2d, Box2D 2.3 and Chipmunk (pymunk), side by side.

    python tests/bench/bench_demos.py            # about 10 minutes; a table in Markdown

Each is built once, as a `gen2d.Space`, and translated. All engines take steps of 1/240 s; Box2D has 8 iterations for
velocities and 3 for positions, Chipmunk has 10. Bodies have no elasticity and friction .49 between them. Overlaps are
measured by `Space.poses` for all engines, after the first second. Times are CPU times on one core, for one world of the
other engines, and for a world of a batch of 64 of gen2d.
"""

import argparse
import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pymunk
import pymunk.constraints

from gen2d.core.enums import DYNAMIC, KINEMATIC, STATIC
from gen2d.physics.inertia import polygon_mass
from gen2d.physics.params import solver_params
from gen2d.physics.simulate import SaveAt, simulate
from gen2d.programs import devices, environment
from gen2d.records import axes
from gen2d.space.bodies import hinge_gap
from gen2d.space.space import Space

with warnings.catch_warnings():  # raised by types of SWIG
    warnings.filterwarnings("ignore", r"builtin type (SwigPy\w+|swigvarlink) has no __module__", DeprecationWarning)
    import Box2D

STEP, STEPS, FPS, SECONDS = 1 / 240, 4, 60, 10.0
FRICTION, GRAVITY = 0.7, 9.81  # of each body; m/s^2
BATCH = 64


class Demo(NamedTuple):
    """A scene, and whether it should stay as it is, or keep its energy."""

    name: str
    build: Callable[[Space], None]
    rests: bool = False
    driven: bool = False


def pyramid(space: Space, rows: int = 10) -> None:
    """Boxes of half a metre, on the floor."""
    space.add_segment((-10, 0), (10, 0))
    for row in range(rows):
        for k in range(rows - row):
            space.add_box((0.55 * (k - (rows - row - 1) / 2), 0.25 + 0.5 * row), 0.5, 0.5)


def card_house(space: Space, levels: int = 3) -> None:
    """Cards of 1 m, of which pairs lean against each other."""
    length, thickness, tilt, spacing = 1.0, 0.05, math.radians(20), 0.96
    space.add_segment((-10, 0), (10, 0))
    cos, sin = math.cos(tilt), math.sin(tilt)
    side = (length * sin + thickness * cos) / 2
    height = length * cos + thickness * sin
    for level in range(levels):
        base, frames = level * (height + thickness), levels - level
        middles = [spacing * (k - (frames - 1) / 2) for k in range(frames)]
        for x in middles:
            space.add_box((x - side, base + height / 2), thickness, length, angle=-tilt)
            space.add_box((x + side, base + height / 2), thickness, length, angle=tilt)
        for one, other in itertools.pairwise(middles):
            space.add_box(((one + other) / 2, base + height + thickness / 2), length, thickness)


def bridge(space: Space, planks: int = 20) -> None:
    """Hinged planks between two cliffs."""
    bodies = [space.add_box((k + 0.5, 0), 1.0, 0.25) for k in range(planks)]
    space.add_joint("revolute", bodies[0], anchor_a=(0, 0))
    for k, (one, other) in enumerate(itertools.pairwise(bodies)):
        space.add_joint("revolute", one, other, anchor_a=(k + 1, 0))
    space.add_joint("revolute", bodies[-1], anchor_a=(planks, 0))


def ball_and_chain(space: Space, links: int = 15) -> None:
    """A ball of 140 times the mass of a link, on a chain that begins level."""
    bodies = [space.add_box((k + 0.5, 0), 1.0, 0.25) for k in range(links)]
    bodies.append(space.add_circle((links + 1.5, 0), 1.5, density=5.0))
    space.add_joint("revolute", bodies[0], anchor_a=(0, 0))
    for k, (one, other) in enumerate(itertools.pairwise(bodies)):
        space.add_joint("revolute", one, other, anchor_a=(k + 1, 0))


def dominoes(space: Space, count: int = 15) -> None:
    """A row of dominoes, of which the first is pushed."""
    space.add_segment((-10, 0), (30, 0))
    for k in range(count):
        space.add_box((0.6 * k, 0.5), 0.125, 1.0, **({"spin": -2.0, "velocity": (1.0, 0.0)} if k == 0 else {}))


def cantilever(space: Space, count: int = 8) -> None:
    """Blocks that are welded, by two hinges each, to each other and to a wall."""
    bodies = [space.add_box((k + 0.5, 0), 1.0, 0.25) for k in range(count)]
    for y in (-0.125, 0.125):
        space.add_joint("revolute", bodies[0], anchor_a=(0, y))
    for k, (one, other) in enumerate(itertools.pairwise(bodies)):
        for y in (-0.125, 0.125):
            space.add_joint("revolute", one, other, anchor_a=(k + 1, y))


def top_heavy_box(space: Space) -> None:
    """A box of a hundred times the density on a narrow one."""
    space.add_segment((-10, 0), (10, 0))
    space.add_box((0, 0.5), 0.5, 1.0)
    space.add_box((0, 1.5), 1.0, 1.0, density=100.0)


def tumbler(space: Space) -> None:
    """Thirty boxes in a square drum that motors turn."""
    for k in range(4):
        angle = k * math.pi / 2
        centre = 2.6 * math.cos(angle), 2.6 * math.sin(angle)
        wall = space.add_box(centre, 0.3, 4.88, angle=angle, density=20.0)
        space.add_joint("revolute", wall, anchor_a=(0, 0), motor_speed=0.5, motor_torque=1e4)
    for k in range(30):
        space.add_box((0.6 * (k % 6) - 1.5, 0.6 * (k // 6) - 1.2), 0.4, 0.4)


DEMOS = (
    Demo("pyramid of 55 boxes", pyramid, rests=True),
    Demo("card house of 15", card_house, rests=True),
    Demo("bridge of 20 planks", bridge),
    Demo("ball and chain, 140:1", ball_and_chain),
    Demo("15 dominoes", dominoes),
    Demo("cantilever of 8", cantilever),
    Demo("top-heavy box, 200:1", top_heavy_box, rests=True),
    Demo("tumbler of 30 boxes", tumbler, driven=True),
)


# ---- The engines


class Run(NamedTuple):
    """Poses and motions of all bodies at `FPS`, and the CPU seconds per second of simulated time."""

    position: np.ndarray  # [T, K, 2] m
    angle: np.ndarray  # [T, K] rad
    velocity: np.ndarray  # [T, K, 2] m/s
    spin: np.ndarray  # [T, K] rad/s
    cost: float


class World(NamedTuple):
    """A scene in another engine."""

    step: Callable[[], Any]
    state: Callable[[], list]  # x, y, angle, their speeds, and the mass of each body


def stepped(world: World) -> Run:
    """Run of a scene in another engine."""
    step, state = world
    rows, seconds = [state()], 0.0
    for _ in range(round(SECONDS * FPS)):
        began = time.process_time()
        for _ in range(STEPS):
            step()
        seconds += time.process_time() - began
        rows.append(state())
    values = np.array(rows)
    return Run(values[..., :2], values[..., 2], values[..., 3:5], values[..., 5], seconds / SECONDS)


def in_box2d(space: Space) -> World:
    """The scene in Box2D."""
    world, bodies = Box2D.b2World(gravity=(0, -GRAVITY)), []
    for own in space.bodies:
        create = {
            DYNAMIC: world.CreateDynamicBody,
            STATIC: world.CreateStaticBody,
            KINEMATIC: world.CreateKinematicBody,
        }
        body = create[own.kind](position=own.position, angle=own.angle, allowSleep=False)
        body.linearVelocity, body.angularVelocity = own.velocity.tolist(), own.spin
        if len(own.vertices):
            shape = Box2D.b2PolygonShape(vertices=own.vertices.tolist())
        elif own.half_length:
            shape = Box2D.b2EdgeShape(vertices=[(-own.half_length, 0), (own.half_length, 0)])
        else:
            shape = Box2D.b2CircleShape(radius=own.radius)
        body.CreateFixture(shape=shape, density=density_of(own), friction=FRICTION**2, restitution=0.0)
        bodies.append(body)
    ground = world.CreateStaticBody()
    for joint in space.joints:
        a, b = (ground if i < 0 else bodies[i] for i in (joint.a, joint.b))
        motor = {"enableMotor": True} if joint.numbers["motor_torque"] else {}
        world.CreateRevoluteJoint(
            bodyA=a,
            bodyB=b,
            anchor=b.GetWorldPoint(joint.anchor_b.tolist()),
            motorSpeed=joint.numbers["motor_speed"],
            maxMotorTorque=joint.numbers["motor_torque"],
            **motor,
        )
    return World(
        lambda: world.Step(STEP, 8, 3),
        lambda: [(*b.position, b.angle, *b.linearVelocity, b.angularVelocity, b.mass) for b in bodies],
    )


def in_chipmunk(space: Space) -> World:
    """The scene in Chipmunk."""
    world, bodies = pymunk.Space(), []
    world.gravity = 0, -GRAVITY
    for own in space.bodies:
        if own.kind == DYNAMIC:
            body = pymunk.Body(own.mass, own.moment)
        else:
            body = pymunk.Body(body_type=pymunk.Body.STATIC if own.kind == STATIC else pymunk.Body.KINEMATIC)
        body.position, body.angle = own.position.tolist(), own.angle
        body.velocity, body.angular_velocity = own.velocity.tolist(), own.spin
        if len(own.vertices):
            shape = pymunk.Poly(body, own.vertices.tolist())
        elif own.half_length:
            shape = pymunk.Segment(body, (-own.half_length, 0), (own.half_length, 0), own.radius)
        else:
            shape = pymunk.Circle(body, own.radius)
        shape.friction = FRICTION
        world.add(body, shape)
        bodies.append(body)
    for joint in space.joints:
        a, b = (world.static_body if i < 0 else bodies[i] for i in (joint.a, joint.b))
        pivot = pymunk.constraints.PivotJoint(a, b, joint.anchor_a.tolist(), joint.anchor_b.tolist())
        pivot.collide_bodies = False
        world.add(pivot)
        if joint.numbers["motor_torque"]:
            motor = pymunk.constraints.SimpleMotor(a, b, -joint.numbers["motor_speed"])
            motor.max_force = joint.numbers["motor_torque"]
            world.add(motor)
    return World(
        lambda: world.step(STEP),
        lambda: [(*b.position, b.angle, *b.velocity, b.angular_velocity, b.mass) for b in bodies],
    )


def in_gen2d(space: Space) -> Run:
    """Run in gen2d, and its cost in a batch."""
    video = space.simulate(SECONDS, fps=FPS, contacts=0)
    scene, state, layout = space.scene()
    many = [
        axes.to_device(jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x)[None], BATCH, axis=0), record))
        for record in (scene, state)
    ]
    params, frames = solver_params(space.physics, FPS, STEPS), round(SECONDS * FPS) + 1
    program = jax.jit(lambda a, b: simulate(a, b, layout, params, frames, STEPS, SaveAt(0, False), sparse=True).states)
    program = program.lower(*many).compile(environment.compiler_options(devices.default()))
    began = time.process_time()
    jax.block_until_ready(program(*many))
    cost = (time.process_time() - began) / BATCH / SECONDS
    return Run(video.position, video.angle, video.velocity, video.angular_velocity, cost)


def density_of(body: Any) -> float:
    """Mass over the area of a body's shape, kg/m^2."""
    if body.kind != DYNAMIC:
        return 0.0
    if not len(body.vertices):
        return body.mass / (math.pi * body.radius**2)
    return body.mass / float(polygon_mass(jnp.asarray(body.vertices), jnp.ones(())))


# ---- The table


def measures(demo: Demo, space: Space, run: Run) -> tuple[str, ...]:
    """Drift in the last 5 s, overlap after the first, gap of the joints, gain of energy, and cost."""
    half, second = len(run.position) // 2, FPS
    moving = [k for k, body in enumerate(space.bodies) if body.kind == DYNAMIC]
    drift = np.linalg.norm(run.position[half:, moving] - run.position[half, moving], axis=-1).max()
    contacts = space.poses(run.position[second::6], run.angle[second::6]).contacts
    overlap = float(contacts.depth.max(initial=0.0))
    mass = np.array([space.bodies[k].mass for k in moving])
    moment = np.array([space.bodies[k].moment for k in moving])
    speed, spin = run.velocity[:, moving], run.spin[:, moving]
    kinetic = 0.5 * (mass * (speed**2).sum(-1) + moment * spin**2).sum(-1)
    energy = kinetic + (mass * GRAVITY * run.position[:, moving, 1]).sum(-1)
    gain = (energy - energy[0]).max() / (mass.sum() * GRAVITY)
    return (
        f"{drift:.2g}" if demo.rests else "",
        f"{overlap:.2g}" if overlap else "0",
        f"{hinge_gap(space.joints, run.position, run.angle):.2g}" if space.joints else "",
        "" if demo.driven else f"{gain:.1g}",
        f"{1e3 * run.cost:.2g}",
    )


def rows(demo: Demo) -> Iterator[tuple[str, ...]]:
    """Rows of the table for a demonstration, one for each engine."""
    engines: dict[str, tuple[Callable[[Space], Run], dict[str, Any]]] = {
        "gen2d": (in_gen2d, {}),
        "gen2d, 1 relaxing pass": (in_gen2d, {"relax_iterations": 1}),
        "Box2D": (lambda space: stepped(in_box2d(space)), {}),
        "Chipmunk": (lambda space: stepped(in_chipmunk(space)), {}),
    }
    for name, (run, physics) in engines.items():
        space = Space(gravity=(0, -GRAVITY), **physics)
        demo.build(space)
        yield demo.name, name, *measures(demo, space, run(space))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="part of the names of the demonstrations")
    options = parser.parse_args()
    heads = (
        "demonstration",
        "engine",
        "way in the last 5 s, m",
        "overlap, m",
        "gap of joints, m",
        "energy gained, m of height",
        "ms/s",
    )
    print("| " + " | ".join(heads) + " |")
    print("|" + "---|" * len(heads))
    for demo in DEMOS:
        if options.only in demo.name:
            for row in rows(demo):
                print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
