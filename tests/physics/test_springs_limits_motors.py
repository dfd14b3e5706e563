"""Springs, limits and motors: closed forms of bodies that joints tie to the world and to each other."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import holds
from worlds import rules

from gen2d import Space
from gen2d.physics.simulate import SaveAt, simulate
from gen2d.records import axes
from gen2d.records.scene import Scene, State
from gen2d.records.trajectory import Trajectory

pytestmark = pytest.mark.full  # two programs, compiled once


@pytest.fixture(scope="module")
def moved() -> tuple:
    """Space in which each row, 10 m from the next, holds one mechanism, its video, and its bodies by name."""
    space, bodies = Space(gravity=(0, 0)), {}

    def disc(name: str, x: float, row: int, **options: Any) -> int:
        bodies[name] = space.add_circle((x, 10.0 * row), 0.1, **options)
        return bodies[name]

    def hinged(name: str, row: int, spin: float = 0.0, **joint: Any) -> None:
        space.add_joint("revolute", disc(name, 0, row, mass=1, moment=1, spin=spin), anchor_a=(0, 10 * row), **joint)

    for name, row, damping in (("spring", 0, 0.0), ("damped", 1, 0.8)):
        space.add_joint(
            "distance", disc(name, 1.5, row, mass=2), anchor_b=(0, 10 * row), length=1, stiffness=8, damping=damping
        )
    light, heavy = disc("light", 0, 2, mass=1), disc("heavy", 1.4, 2, mass=3)
    space.add_joint("distance", light, heavy, length=1, stiffness=12)
    # A spring across the end of a bar that is hinged in its middle.
    bodies["bar"] = bar = space.add_capsule((-1, 30), (1, 30), 0.05, mass=1, moment=2, spin=0.02)
    space.add_joint("revolute", bar, anchor_a=(0, 30))
    space.add_joint("distance", bar, anchor_a=(1, 30), anchor_b=(1, 34), stiffness=8)
    hinged("motor", 4, motor_speed=3, motor_torque=2)
    hinged("upper", 5, spin=2, limits=(-0.5, 1))
    hinged("lower", 6, spin=-2, limits=(-0.5, 1))
    slow, fast = disc("slow", 0, 7, mass=1, moment=3), disc("fast", 0, 7, mass=1, moment=1)
    space.add_joint("revolute", slow, fast, anchor_a=(0, 70), motor_speed=100, motor_torque=2)
    both = disc("both", 0.5, 8, mass=2)
    for side in (-2, 2):
        space.add_joint("distance", both, anchor_b=(side, 80), length=1, stiffness=4)
    return space, space.simulate(3, fps=60, contacts=0), bodies


def test_a_spring_swings_with_the_period_of_its_stiffness_and_mass(moved):
    _, video, bodies = moved
    t = video.time
    holds("spring: place, m", video.position[:, bodies["spring"], 0] - 1 - 0.5 * np.cos(2 * t), 1e-4)
    holds("two springs: place, m", video.position[:, bodies["both"], 0] - 0.5 * np.cos(2 * t), 1e-4)
    x = {name: video.position[:, bodies[name], 0] for name in ("light", "heavy")}
    holds("spring between two: length, m", x["heavy"] - x["light"] - 1 - 0.4 * np.cos(4 * t), 5e-4)
    holds("spring between two: centre of mass, m", (x["light"] + 3 * x["heavy"]) / 4 - 1.05, 1e-5)


def test_a_damper_slows_a_spring_exponentially(moved):
    _, video, bodies = moved
    rate, t = 0.8 / (2 * 2), video.time
    omega = math.sqrt(4 - rate**2)
    exact = 0.5 * np.exp(-rate * t) * (np.cos(omega * t) + rate / omega * np.sin(omega * t))
    holds("damped spring: place, m", video.position[:, bodies["damped"], 0] - 1 - exact, 1e-4)


def test_a_spring_at_an_arm_turns_its_body(moved):
    _, video, bodies = moved
    exact = 0.01 * np.sin(2 * video.time)  # I angle" = -k arm^2 angle
    holds("spring at an arm: angle, rad", video.angle[:, bodies["bar"]] - exact, 1e-5)


def test_a_motor_reaches_its_speed_with_its_torque_and_turns_both_bodies(moved):
    _, video, bodies = moved
    t = video.time
    spins = {name: video.angular_velocity[:, bodies[name]] for name in bodies}
    holds("motor: spin, rad/s", spins["motor"] - np.minimum(2 * t, 3), 1e-3)
    slower, faster = spins["slow"], spins["fast"]
    holds("motor between two: angular momentum, kg m^2/s", 3 * slower + faster, 1e-4)
    holds("motor between two: relative spin, rad/s", np.abs(slower - faster) - 2 * (1 + 1 / 3) * t, 1e-3)


def test_a_limit_stops_a_hinge_there(moved):
    _, video, bodies = moved
    for name, stop in (("upper", 1.0), ("lower", -0.5)):
        angle, side = video.angle[:, bodies[name]], math.copysign(1, stop)
        exact = side * np.minimum(2 * video.time, abs(stop))
        holds(f"{name} limit: angle, rad", angle - exact, 1e-3)
        holds(f"{name} limit: angle beyond it, rad", np.maximum(side * (angle - stop), 0), 1e-3)
        holds(f"{name} limit: spin after it, rad/s", video.angular_velocity[-60:, bodies[name]], 1e-3)


def test_the_energy_budget_accounts_for_motors_dampers_and_limits(moved):
    _, video, _ = moved
    t, energy = video.time, video.energy
    exact = np.minimum(2 * t, 3) ** 2 / 2 + (2 * t) ** 2 / 2 * (1 + 1 / 3)
    holds("motors: put in, J", energy.work_in - exact, 1e-3)
    holds("limits: lost, J", energy.lost_in_contact[-1] - 2 * 2**2 / 2, 5e-3)
    rate = 0.2
    v = -0.5 * 4 / math.sqrt(4 - rate**2) * np.exp(-rate * t) * np.sin(math.sqrt(4 - rate**2) * t)
    power = 0.8 * v**2
    lost = np.concatenate([[0], np.cumsum((power[1:] + power[:-1]) / 2)]) * (t[1] - t[0])
    holds("damper: lost, J", energy.lost_to_damping - lost, 5e-4)
    holds("springs, limits and motors: residual, J", energy.residual, 1e-3)


def test_a_step_of_a_spring_is_the_implicit_midpoint_rule():
    """Its force is that of the mean place, from any place and speed, also where a step is half of a radian."""
    space, h, rate, mass = Space(gravity=(0, 0)), 1 / 240, 120.0, 2.0
    starts = [(x, v) for x in (-0.05, 0.0, 0.05) for v in (-6.0, 0.0, 2.0)]
    for row, (x, v) in enumerate(starts):
        disc = space.add_circle((x, row), 0.1, mass=mass, velocity=(v, 0))
        space.add_joint("distance", disc, anchor_b=(-5, row), length=5, stiffness=mass * rate**2)
    video = space.simulate(h, fps=240, contacts=0)
    x, v = np.array(starts).T
    q = (rate * h / 2) ** 2
    holds("step of a spring: place, m", video.position[1, :, 0] - ((1 - q) * x + h * v) / (1 + q), 1e-6)
    holds("step of a spring: speed, m/s", video.velocity[1, :, 0] - ((1 - q) * v - h * rate**2 * x) / (1 + q), 1e-4)


@pytest.mark.parametrize(("stiffness", "bound"), [(1.0, 1e-5), (1e3, 1e-4), (1e6, 1e-3), (1e9, 1e-2)])
def test_a_spring_keeps_its_energy_at_any_stiffness(stiffness: float, bound: float):
    """From 2 m between two bodies of 1 and 3 kg in space, pulled apart by a tenth of that."""
    space = Space(gravity=(0, 0))
    masses = np.array([1.0, 3.0])
    bodies = [space.add_circle((x, 0), 0.2, mass=mass) for x, mass in zip((-1.1, 1.1), masses, strict=True)]
    space.add_joint("distance", *bodies, length=2.0, stiffness=stiffness)
    video = space.simulate(seconds=4, fps=60, contacts=0)
    stretch = np.linalg.norm(video.position[:, 1].astype(float) - video.position[:, 0], axis=-1) - 2.0
    energy = 0.5 * (masses * (video.velocity**2).sum(-1)).sum(1) + 0.5 * stiffness * stretch**2
    holds(f"spring of {stiffness:g} N/m: energy, relative", energy / energy[0] - 1, bound)  # of rounded positions
    momentum = (video.velocity * masses[:, None]).sum(1)
    holds(f"spring of {stiffness:g} N/m: momentum, relative", momentum / np.sqrt(energy[0]), 1e-4)


def test_a_limit_that_stops_an_elbow_sees_the_shoulder():
    """Two bars, the first pinned to the world, the second turning, stop as one body: no torque acts about the pin."""
    space, spin, stop = Space(gravity=(0, 0)), 3.0, 1.0
    upper = space.add_capsule((0, 0), (1, 0), 0.05, mass=2, moment=0.4)
    lower = space.add_capsule((1, 0), (2.2, 0), 0.05, mass=1, moment=0.2, spin=spin, velocity=(0, 0.6 * spin))
    space.add_joint("revolute", upper, anchor_a=(0, 0))
    space.add_joint("revolute", upper, lower, anchor_a=(1, 0), limits=(-0.5, stop))
    video = space.simulate(3, fps=240, contacts=0)
    elbow = video.angle[:, lower] - video.angle[:, upper]
    holds("elbow: angle beyond its limit, rad", np.maximum(elbow - stop, 0), 1e-4)
    holds("elbow: largest angle, rad", elbow.max() - stop, 1e-4)
    momentum = 0.2 * spin + 1.6 * 0.6 * spin  # about the pin
    moment = 0.4 + 2 * 0.5**2 + 0.2 + 1 + 0.6**2 + 2 * 0.6 * math.cos(stop)  # at the limit
    energy = np.asarray(video.energy.kinetic + video.energy.rotational)
    stopped = int(np.argmax(elbow > stop - 1e-3)) + 3
    holds(
        "elbow: energy after the stop, relative", energy[stopped : stopped + 60] / (momentum**2 / moment / 2) - 1, 1e-3
    )
    holds("elbow: energy gained in a step, relative", np.maximum(np.diff(energy), 0) / energy[0], 5e-5)


def test_a_spring_that_turns_keeps_its_energy_and_angular_momentum():
    """Two bodies swing about each other on a spring that sweeps a radian in a tenth of a second."""
    space, masses = Space(gravity=(0, 0)), np.array([1.0, 3.0])
    starts = (0, 6.0), (0, -2.0)
    bodies = [
        space.add_circle((x, 0), 0.2, mass=m, velocity=v) for x, m, v in zip((-0.6, 0.2), masses, starts, strict=True)
    ]
    space.add_joint("distance", *bodies, length=1.0, stiffness=50.0)
    video = space.simulate(4, fps=60, contacts=0)
    x, v = (np.asarray(value, float) for value in (video.position, video.velocity))
    stretch = np.linalg.norm(x[:, 1] - x[:, 0], axis=-1) - 1.0
    energy = 0.5 * (masses * (v**2).sum(-1)).sum(1) + 0.5 * 50 * stretch**2
    holds("spring that turns: energy, relative", energy / energy[0] - 1, 5e-4)
    angular = (masses * (x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0])).sum(1)
    holds("spring that turns: angular momentum, relative", angular / angular[0] - 1, 2e-4)


@pytest.mark.parametrize("order", ["pairs", "time"])
@pytest.mark.parametrize(("rate", "bound", "way"), [(5.0, 2e-5, 3e-4), (20.0, 2e-5, 0.01), (130.0, 1e-4, None)])
def test_a_spring_and_an_elastic_wall_keep_the_energy(rate: float, bound: float, way: float | None, order: str):
    """A disc swings about a place beyond a wall's reach, and bounces off the wall on each swing."""
    space, swing, wall, mass = Space(gravity=(0, 0), impact_order=order), 0.3, -0.11, 2.0
    disc = space.add_circle((swing, 0), 0.1, mass=mass, elasticity=1)
    space.add_segment((wall - 0.1, -3), (wall - 0.1, 3), elasticity=1)
    space.add_joint("distance", disc, anchor_b=(-5, 0), length=5, stiffness=mass * rate**2)
    video = space.simulate(2, fps=240, contacts=0)
    x, v = (np.asarray(values[:, disc, 0], float) for values in (video.position, video.velocity))
    energy = 0.5 * mass * (v**2 + (rate * x) ** 2)
    holds(f"spring at a wall, {rate:g} rad/s: energy, relative", energy / energy[0] - 1, bound)
    if way is not None:
        period = 2 * math.acos(wall / swing) / rate
        phase = (np.asarray(video.time, float) + period / 2) % period - period / 2
        holds(f"spring at a wall, {rate:g} rad/s: path, m", x - swing * np.cos(rate * phase), way)


@pytest.mark.parametrize("rate", [20.0, 130.0])
def test_a_spring_presses_a_disc_onto_a_wall_with_its_force(rate: float):
    """From .2 m in front of a wall, until it rests there; what is lost is lost in the contact."""
    space, wall, mass = Space(gravity=(0, 0)), 0.1, 2.0
    disc = space.add_circle((0.3, 0), 0.1, mass=mass, elasticity=0.5)
    space.add_segment((wall - 0.1, -3), (wall - 0.1, 3), elasticity=1)
    space.add_joint("distance", disc, anchor_b=(-5, 0), length=5, stiffness=mass * rate**2)
    video = space.simulate(2, fps=240, contacts=500)
    x, force = np.asarray(video.position[:, disc, 0], float), mass * rate**2 * wall
    last = video.contacts.frame > 240
    holds("pressed disc: force on the wall, relative", video.contacts.normal_impulse[last] * 240 / force - 1, 1e-4)
    holds("pressed disc: depth in the wall, m", np.maximum(wall - x, 0), 1e-6)
    holds("pressed disc: way in the last second, m", np.ptp(x[240:]), 1e-6)
    lost = 0.5 * mass * rate**2 * (0.3**2 - wall**2)
    holds("pressed disc: lost in the contact, relative", video.energy.lost_in_contact[-1] / lost - 1, 1e-3)
    holds(
        "pressed disc: given in a contact, relative", np.minimum(np.diff(video.energy.lost_in_contact), 0) / lost, 1e-4
    )
    holds("pressed disc: lost to damping, relative", video.energy.lost_to_damping / lost, 1e-3)


@pytest.mark.parametrize("gap", [0.001, 0.004])
def test_a_body_that_a_spring_brings_back_in_the_step_of_its_impact_rests_there(gap: float):
    """A slow disc meets a wall onto which a spring presses it with 170 g."""
    space, wall, mass, rate = Space(gravity=(0, 0)), 0.1, 2.0, 130.0
    disc = space.add_circle((wall + gap, 0), 0.1, mass=mass, elasticity=0.2, velocity=(-1, 0))
    space.add_segment((wall - 0.1, -3), (wall - 0.1, 3), elasticity=1)
    space.add_joint("distance", disc, anchor_b=(-5, 0), length=5, stiffness=mass * rate**2)
    video = space.simulate(1 / 240, fps=240, contacts=0)
    holds("disc that a spring brings back: way from the wall after a step, m", video.position[1, disc, 0] - wall, 1e-6)


def test_a_row_of_locked_hinges_is_a_stiff_beam():
    """Eight bars from a wall, whose hinges have no room to turn: solved one after the other, they would fold."""
    space, last = Space(gravity=(0, -9.81)), None
    for i in range(8):
        bar = space.add_box((0.5 + i, 0), 1.0, 0.2, mass=1.0)
        ends = (bar,) if last is None else (last, bar)
        space.add_joint("revolute", *ends, anchor_a=(i, 0), limits=(0, 0))
        last = bar
    video = space.simulate(2, fps=60, contacts=0)
    holds("beam of 8 locked bars: way of its end, m", video.position[:, last, 1], 1e-4)
    energy = np.asarray(video.energy.kinetic + video.energy.rotational + video.energy.potential)
    holds("beam of 8 locked bars: energy gained, J", np.maximum(energy - energy[0], 0), 1e-4)


def test_a_motor_holds_an_arm_with_just_the_torque_of_its_weight():
    """Two bars of 1 kg, the second locked to the first, need 2 g 1 m."""
    for torque, held in ((19.0, False), (20.0, True)):
        space = Space(gravity=(0, -9.81))
        upper, lower = (space.add_box((0.5 + i, 0), 1.0, 0.1, mass=1.0) for i in range(2))
        space.add_joint("revolute", upper, anchor_a=(0, 0), motor_torque=torque)
        space.add_joint("revolute", upper, lower, anchor_a=(1, 0), limits=(0, 0))
        drop = space.simulate(1, fps=60, contacts=0).position[-1, lower, 1]
        if held:
            holds("arm that a motor holds: drop of its end, m", drop, 2e-4)
        else:
            assert drop < -0.05


def swinging_bars(spin: float, torque: float) -> Space:
    """Three bars that hang from a pin, with room to turn by .4 rad at each hinge and friction in it."""
    space, last = Space(gravity=(0, -9.81)), None
    for i in range(3):
        bar = space.add_box((0.5 + i, 0), 1.0, 0.1, mass=1.0, spin=spin if i == 2 else 0.0)
        ends, limits = ((bar,), (-1.2, 1.2)) if last is None else ((last, bar), (-0.4, 0.4))
        space.add_joint("revolute", *ends, anchor_a=(i, 0), limits=limits, motor_torque=torque)
        last = bar
    return space


def program(
    space: Space, frames: int, sparse: bool, collides: bool = False
) -> tuple[Callable[..., Trajectory], Scene, State]:
    """Simulation of a space, without contacts unless it `collides`, by one of the two solvers, and its arguments."""
    scene, state, layout = space.scene()
    groups = tuple(dataclasses.replace(group, collides=collides) for group in layout.groups)
    layout, params = dataclasses.replace(layout, groups=groups), rules()

    def run(scene: Scene, state: State) -> Trajectory:
        return axes.to_stored(simulate(scene, state, layout, params, frames, 4, SaveAt(energy=True), sparse=sparse))

    return run, *(axes.to_device(jax.tree.map(lambda x: jnp.asarray(x)[None], record)) for record in (scene, state))


def test_limits_neither_pull_nor_depend_on_the_solver():
    """The bars swing from limit to limit; the solver for GPUs and gradients has a fixed number of rounds."""
    space = swinging_bars(spin=6.0, torque=0.5)
    ours, theirs = (jax.jit(run)(*of) for run, *of in (program(space, 121, sparse) for sparse in (True, False)))
    holds("bars: angles by both solvers, rad", ours.states.angle - theirs.states.angle, 2e-3)
    elbows = np.diff(np.asarray(ours.states.angle[0, :, :3], float), axis=1)
    assert (np.abs(elbows).max(0) > 0.39).all(), "both elbows reach a limit"
    holds("bars: angle beyond a limit, rad", np.maximum(np.abs(elbows) - 0.4, 0), 1e-3)
    energy = np.asarray(ours.energy.kinetic + ours.energy.rotational + ours.energy.potential, float)[0]
    holds("bars: energy gained in a frame, J", np.maximum(np.diff(energy), 0), 1e-2)


@pytest.mark.slow
def test_limits_have_the_gradient_of_their_differences():
    """By the torque of friction in hinges that reach their limits."""
    run, scene, state = program(swinging_bars(spin=6.0, torque=0.5), 13, False)

    @jax.jit
    def last_angle(torque: jax.Array, scene: Scene, state: State) -> jax.Array:
        joints = scene.joints
        assert joints is not None
        joints = dataclasses.replace(joints, motor_torque=0 * joints.motor_torque + torque)
        return run(dataclasses.replace(scene, joints=joints), state).states.angle[0, -1, 2]

    gradient = jax.jit(jax.grad(last_angle))(jnp.asarray(0.5), scene, state)
    ends = [last_angle(jnp.asarray(torque), scene, state) for torque in (0.49, 0.51)]
    holds("bars: gradient less difference, relative", gradient / ((ends[1] - ends[0]) / 0.02) - 1, 2e-2)


@pytest.mark.slow
def test_a_spring_at_a_wall_has_the_gradient_of_its_closed_form():
    """By the start and the stiffness, after one bounce; the solver for CPUs has the same path."""
    space, swing, wall, rate, mass, frames = Space(gravity=(0, 0)), 0.3, -0.11, 5.0, 2.0, 37
    disc = space.add_circle((swing, 0), 0.1, mass=mass, elasticity=1)
    space.add_segment((wall - 0.1, -3), (wall - 0.1, 3), elasticity=1)
    space.add_joint("distance", disc, anchor_b=(-5, 0), length=5, stiffness=mass * rate**2)
    run, scene, state = program(space, frames, False, collides=True)

    def end(shift: jax.Array, stiffness: jax.Array) -> jax.Array:
        joints = scene.joints
        assert joints is not None
        joints = dataclasses.replace(joints, stiffness=0 * joints.stiffness + stiffness)
        moved = dataclasses.replace(state, position=state.position.at[0, 0].add(shift))
        return run(dataclasses.replace(scene, joints=joints), moved).states.position[0, -1, 0, 0]

    place, slopes = jax.jit(jax.value_and_grad(end, (0, 1)))(jnp.asarray(0.0), jnp.asarray(mass * rate**2))
    time, reach = (frames - 1) / 60, math.acos(wall / swing)
    phase = rate * time - 2 * reach
    by_start = math.cos(phase) + 2 * math.sin(phase) * wall / swing / math.sin(reach)
    by_rate = -swing * time * math.sin(phase)
    holds("spring at a wall: place after a bounce, m", place - swing * math.cos(phase), 2e-4)
    holds("spring at a wall: derivative by the start", slopes[0] - by_start, 2e-3)
    holds("spring at a wall: derivative by the stiffness, relative", slopes[1] * 2 * mass * rate / by_rate - 1, 2e-2)
    theirs, *of = program(space, frames, True, collides=True)
    holds("spring at a wall: place by both solvers, m", jax.jit(theirs)(*of).states.position[0, -1, 0, 0] - place, 1e-6)


def test_chains_with_friction_in_their_hinges_only_lose_energy():
    """Hinges that slip and stick, without limits."""
    for torque in (0.05, 0.5):
        space, last = Space(gravity=(0, -9.81)), None
        for i in range(12):
            link = space.add_capsule((0.2 * i, 0), (0.2 * i + 0.2, 0), 0.04, mass=0.1)
            ends = (link,) if last is None else (last, link)
            space.add_joint("revolute", *ends, anchor_a=(0.2 * i, 0), motor_torque=torque)
            last = link
        video = space.simulate(2, fps=60, contacts=0)
        energy = np.asarray(video.energy.kinetic + video.energy.rotational + video.energy.potential)
        holds("chain with friction: energy gained in a frame, J", np.maximum(np.diff(energy), 0), 1e-4)
        holds("chain with friction: residual, J", video.energy.residual, 1e-3)


def test_limits_that_other_joints_do_not_let_a_hinge_reach_do_nothing():
    """A rod holds a box that its limits would turn by .3 rad."""
    space = Space(gravity=(0, -9.81))
    box = space.add_box((0.5, 0), 1.0, 0.2, mass=1.0)
    space.add_joint("revolute", box, anchor_a=(0, 0), limits=(0.3, 1.0))
    space.add_joint("distance", box, anchor_a=(1, 0), anchor_b=(1, 1))
    video = space.simulate(2, fps=60, contacts=0)
    holds("limits against a rod: angle, rad", video.angle[:, box], 1e-4)
    holds("limits against a rod: spin, rad/s", video.angular_velocity[:, box], 1e-3)
