"""Laws of the families of blocks and joints: statics of towers, waves of dominoes, torques of seesaws, periods of
pendulums, the shape of a chain at rest."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from laws import holds
from tiny import run_command

from gen2d.config.config import load_config
from gen2d.core.errors import ConfigError
from gen2d.physics.params import solver_params
from gen2d.physics.simulate import SaveAt, simulate, substeps
from gen2d.records.axes import to_device, to_stored
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.sampling.sampler import Sampler

GRAVITY = 9.8  # m/s^2, the default


class Film(NamedTuple):
    """What some videos of a family did; arrays have them first."""

    factors: dict[str, np.ndarray]
    layout: Layout
    scene: Scene
    states: State
    energy: Any  # [n, T] J, kinetic and potential
    kinetic: Any  # [n, T] J
    time: np.ndarray  # [T] s


@functools.cache
def film(family: str, videos: int, seconds: float, fps: float, *overrides: str, energy: bool = False) -> Film:
    """Some videos of a family's config, with some options changed."""
    config = load_config(f"{family}.yaml", [*overrides, f"video.fps={fps}"])
    scene, physics, frames = config.scene, config.physics, round(seconds * fps) + 1
    layout, steps = scene.contract.layout(scene.options), substeps(fps, physics.substeps, physics.max_step)
    rules = solver_params(physics, fps, steps)

    @jax.jit
    def run(keys: jax.Array) -> tuple:
        factors, (things, state, *_) = jax.vmap(Sampler(config).sample)(keys)
        device = to_device(things), to_device(state)
        made = simulate(*device, layout, rules, frames, steps, SaveAt(energy=energy), sparse=True)
        return factors, things, to_stored(made)

    factors, things, made = jax.tree.map(np.asarray, run(jax.random.split(jax.random.key(1), videos)))
    kinetic = None if made.energy is None else made.energy.kinetic + made.energy.rotational
    total = None if made.energy is None else kinetic + made.energy.potential
    return Film(factors, layout, things, made.states, total, kinetic, np.arange(frames) / fps)


def slots(made: Film, number: int) -> slice:
    """Those of the layout's run with this number."""
    run, first = made.layout.spans[number]
    return slice(first, first + run.count)


def moved(made: Film, number: int) -> np.ndarray:
    """How far the farthest of a run is from where it began, m [n, T]."""
    place = made.states.position[:, :, slots(made, number)]
    return np.linalg.norm(place - place[:, :1], axis=-1).max(-1)


def apart(made: Film) -> np.ndarray:
    """How far the anchors of joints are from each other, m [n, T, J]."""
    ends = []
    for side in "ab":
        of = np.array([getattr(tie, side) for tie in made.layout.joints])
        anchor = getattr(made.scene.joints, f"anchor_{side}")[:, None]
        cos, sin = np.cos(made.states.angle[:, :, of]), np.sin(made.states.angle[:, :, of])
        arm = np.stack([cos * anchor[..., 0] - sin * anchor[..., 1], sin * anchor[..., 0] + cos * anchor[..., 1]], -1)
        ends.append(made.states.position[:, :, of] + arm)
    return np.linalg.norm(ends[1] - ends[0], axis=-1)


def gained(made: Film) -> np.ndarray:
    """How much energy was ever gained, over all that was lost or moved [n]."""
    least = np.minimum.accumulate(made.energy, axis=1)
    return (made.energy - least).max(1) / np.ptp(made.energy, axis=1)


# Towers -------------------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_a_tower_does_what_statics_says():
    made = film("tower", 64, 3.0, 20, "scene.offset=[-0.9,0.9]")
    way, margin = moved(made, 1), made.factors["margin"]
    stands, falls = margin > 0.05, margin < -0.05
    assert min(stands.sum(), falls.sum()) > 8
    np.testing.assert_array_equal(made.factors["stable"], margin > 0)
    holds("tower that stands: way, m", way[stands], 1e-2)
    assert way[falls, -1].min() > 0.3


# Dominoes -----------------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_about_half_of_the_towers_stand():
    sampler = Sampler(load_config("tower.yaml"))
    factors, _ = jax.vmap(sampler.sample)(jax.random.split(jax.random.key(0), 1000))
    assert 0.42 < factors["stable"].mean() < 0.58


@pytest.mark.full
def test_dominoes_fall_in_order_in_a_steady_wave_unless_their_gap_is_too_wide():
    options = "scene.dominoes=10", "scene.height=1.5", "scene.gap={choice: [0.6, 1.7]}", "scene.speed=[2, 4]"
    made = film("dominoes", 8, 3.0, 40, *options)
    fallen = made.states.angle[:, :, slots(made, 2)] < -0.3
    wide = made.factors["gap"] > 1.5
    assert 0 < wide.sum() < 8
    assert fallen[wide, -1, 0].all()
    assert not fallen[wide, -1, 1:].any()
    assert fallen[~wide, -1].all()
    begins = when(np.asarray(made.states.angle[~wide][:, :, slots(made, 2)]), made.time)
    steps = np.diff(begins, axis=1)
    assert steps.min() > 0
    middle = steps[:, 3:-1]
    holds("dominoes: speed of the wave, over its mean", middle / middle.mean(1, keepdims=True) - 1, 0.2)


def when(angle: np.ndarray, time: np.ndarray) -> np.ndarray:
    """The time [n, K] when each first leans by 0.3 rad, between frames by a straight line."""
    after = np.argmax(angle < -0.3, axis=1)
    early, late = (np.take_along_axis(angle, (after - k)[:, None], 1)[:, 0] for k in (1, 0))
    return time[after] - (time[1] - time[0]) * (-0.3 - late) / (early - late)


# Seesaws ------------------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_a_seesaw_tips_to_the_side_of_the_larger_torque():
    made = film("seesaw", 32, 1.5, 20, "scene.drop_height=0", "scene.plank_density=0.2", energy=True)
    torque, angle = made.factors["torque"], made.states.angle[:, -1, slots(made, 2)][:, 0]
    clear = np.abs(torque) > 2.0
    assert clear.sum() > 12
    np.testing.assert_array_equal(np.sign(angle[clear]), np.sign(torque[clear]))
    assert np.abs(angle[clear]).min() > 0.05
    holds("seesaw: pivot, m", apart(made), 1e-5)
    holds("seesaw: energy gained, of the largest kinetic energy", gained_of_kinetic(made), 1e-2)


def gained_of_kinetic(made: Film) -> np.ndarray:
    """Largest gain of energy of each video, over its largest kinetic energy."""
    least = np.minimum.accumulate(made.energy, axis=1)
    return (made.energy - least).max(1) / made.kinetic.max(1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("passes", "bound"),
    [pytest.param(1, 0.1, marks=pytest.mark.asked), pytest.param(4, 0.05, marks=pytest.mark.asked), ("null", 0.01)],
)
def test_a_seesaw_gains_less_energy_with_several_relaxing_passes(passes, bound):
    overrides = "scene.drop_height=0", "scene.plank_density=0.2", f"physics.relax_iterations={passes}"
    made = film("seesaw", 32, 1.5, 240, *overrides, energy=True)
    holds(f"seesaw, {passes} passes: pivot, m", apart(made), 1e-5)
    gained = gained_of_kinetic(made)
    holds(f"seesaw, {passes} passes: energy gained, of the largest kinetic energy", gained, bound, asked=1e-2)


# Pendulums ----------------------------------------------------------------------------------------------------------


def mean(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The arithmetic-geometric mean."""
    for _ in range(8):
        a, b = (a + b) / 2, np.sqrt(a * b)
    return a


def test_a_pendulum_has_the_period_of_its_length_and_swing():
    made = film("pendulum", 8, 8.0, 60, "scene.angle=[0.1,2.6]", energy=True)
    swing = made.factors["angle"][:, 0]
    lean = made.states.angle[:, :, 1] + np.pi / 2
    np.testing.assert_allclose(lean[:, 0], swing, atol=1e-5)
    # T = T0 / agm(1, cos(swing / 2)): the complete elliptic integral (Gauss).
    period = made.factors["period"] / mean(np.ones(8), np.cos(swing / 2))
    for video in range(8):
        falls = np.flatnonzero((lean[video, :-1] > 0) & (lean[video, 1:] <= 0))
        early, late = lean[video, falls], lean[video, falls + 1]
        times = made.time[falls] + (made.time[1] - made.time[0]) * early / (early - late)
        holds("pendulum: period", np.diff(times) / period[video] - 1, 1e-3)
        holds("pendulum: first quarter", times[0] / period[video] - 0.25, 1e-3)
    small = 2 * np.pi * np.sqrt(made.factors["length"][:, 0] / GRAVITY)
    assert (np.abs(made.factors["period"] / small - 1) < 0.1).all()  # the rod is light, the bob small
    holds("pendulum: energy", np.ptp(made.energy, axis=1) / np.abs(made.energy).max(1), 2e-3)


@pytest.mark.full
def test_a_double_pendulum_keeps_its_energy_and_its_joints():
    made = film("pendulum", 8, 4.0, 30, "scene.links=2", energy=True)
    scale = np.abs(made.energy).max(1) + made.scene.objects.mass[:, 3:].sum(1) * GRAVITY
    holds("double pendulum: energy", np.ptp(made.energy, axis=1) / scale, 5e-3)
    holds("double pendulum: joints, m", apart(made), 1e-4)


# Chains -------------------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_a_chain_at_rest_is_a_catenary():
    links = 16
    made = film("chain", 4, 24.0, 10, f"scene.links={links}", "scene.slope=0", "physics.damping=1")
    length, span = links * made.factors["length"].astype(float), made.factors["span"].astype(float)
    ratio = np.array([parameter(share) for share in span])  # half of the span over the catenary's parameter
    sag = length * span / 2 / ratio * (np.cosh(ratio) - 1)
    pins = made.states.position[:, -1, :2, 1].mean(1)
    last, of = made.states, slots(made, 1)
    half = made.scene.objects.half_length[:, of]
    low = last.position[:, -1, of, 1] - np.abs(half * np.sin(last.angle[:, -1, of]))
    holds("chain: speed at rest, m/s", np.linalg.norm(last.velocity[:, -1, of], axis=-1), 2e-2)
    holds("chain: sag", (pins - low.min(1)) / sag - 1, 0.02)
    holds("chain: joints, m", apart(made), 1e-4)


def parameter(share: float) -> float:
    """Where x / sinh x is so much, by halving."""
    low, high = 1e-6, 50.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if middle / np.sinh(middle) > share else (low, middle)
    return low


# Wrecking balls -----------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_a_wrecking_ball_hits_a_tower_that_stands():
    made = film("wrecking_ball", 8, 2.0, 30, "scene.angle=[0.8, 1.4]", energy=True)
    ball = made.states.position[:, :, slots(made, 3)][:, :, 0, 0] + made.factors["radius"][:, None]
    near = np.maximum.accumulate(ball > -0.1 - made.factors["gap"][:, None], axis=1)
    way = moved(made, 4)
    holds("tower before it is hit: way, m", way[~near], 1e-2)
    assert way[:, -1].min() > 0.1
    holds("wrecking ball: energy gained", gained(made), 1e-2)
    holds("wrecking ball: joints, m", apart(made), 1e-4)


# Files --------------------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_joints_and_polygons_are_stored_whole(tmp_path):
    options = ["video.frames=3", "video.height=16", "video.width=24", "storage.batch_size=2", "scene.weights=2"]
    overrides = [word for option in options for word in ("--set", option)]
    made = run_command("--config", "seesaw.yaml", "--n", 2, "--out", tmp_path / "made", *overrides)
    assert made.returncode == 0, made.stderr
    checked = run_command("verify", tmp_path / "made")
    assert checked.returncode == 0, checked.stdout


BAD = {
    "seesaw": ("width=9", "scene.width may be 9 m"),
    "dominoes": ("radius=5", "scene.radius may be 5 m"),
    "chain": ("span=1", "scene.span may be 1 to 1"),
    "wrecking_ball": ("radius=5", "scene.radius may be 5 m"),
}


@pytest.mark.parametrize("family", BAD)
def test_options_that_cannot_be_are_refused_in_one_sentence(family):
    change, message = BAD[family]
    with pytest.raises(ConfigError, match=message):
        load_config(f"{family}.yaml", [f"scene.{change}"])
