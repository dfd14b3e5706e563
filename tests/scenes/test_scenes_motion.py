"""Scenes of one or a few balls against their closed forms: uniform motion, collision, parabola (and these as the study
phyworld has them, without the faults of its generator), billiards, ramp, spinning.

`played` simulates a config with some factors put in place of the drawn ones, so that a family is compiled once.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import holds
from numpy.testing import assert_array_equal
from tiny import everything

import gen2d
from gen2d.config.config import Config, load_config
from gen2d.core.errors import ConfigError
from gen2d.generation.run import generate
from gen2d.physics.params import solver_params
from gen2d.physics.simulate import simulate, substeps
from gen2d.programs.simulation import save_at
from gen2d.records.axes import to_device, to_stored
from gen2d.sampling.sampler import Sampler

FAMILIES = ("uniform_motion", "collision", "parabola")
SIDE, FPS, STAYS = 10.0, 10.0, 2.4  # m, 1/s, s: of the study
# What the study trains and tests on: radii and speeds in its training range, below it and above it.
RADII = {"one": [(0.7, 1.4), (0.3, 0.6), (1.5, 2.0)], "two": [(0.5, 1.5), (0.3, 0.4), (1.7, 2.0)]}  # m
SPEEDS = [(1.0, 4.0), (0.0, 0.8), (4.5, 6.0)]  # m/s


class Played(NamedTuple):
    """Videos, first axis; what follows is as stored, in double precision."""

    factors: dict[str, np.ndarray]
    scene: Any
    start: Any
    states: Any = None
    contacts: Any = None


def begun(config: Config, n: int, given: dict[str, Any] | None = None) -> Played:
    """The starts of n videos, with the given factors [n, ...] in place of those drawn."""
    sampler = Sampler(config)

    def made(key: jax.Array, given: dict) -> tuple:
        draw_key, place_key = jax.random.split(key)
        drawn = sampler.sample_factors(draw_key) | given
        found = config.scene.contract.sample(place_key, drawn, config.scene.options)
        return drawn | found.derived, found.scene, found.state

    given = {name: jnp.asarray(values, jnp.float32) for name, values in (given or {}).items()}
    made = jax.jit(jax.vmap(made))(jax.random.split(jax.random.key(0), n), given)
    return Played(*jax.tree.map(lambda x: np.asarray(x, np.float64), made))


def played(config: Config, n: int, given: dict[str, Any] | None = None) -> Played:
    """n videos, simulated."""
    start, layout = begun(config, n, given), config.scene.contract.layout(config.scene.options)
    steps = substeps(config.video.fps, config.physics.substeps, config.physics.max_step)
    rules = solver_params(config.physics, config.video.fps, steps)

    def run(scene: Any, state: Any) -> Any:
        device = to_device(scene), to_device(state)
        keep = save_at(config, layout)
        return to_stored(simulate(*device, layout, rules, config.video.frames, steps, keep, sparse=True))

    kinds = jax.eval_shape(lambda: Sampler(config).sample(jax.random.key(0))[1])
    scene = jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), start.scene, kinds.scene)
    state = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), start.start)
    made = jax.tree.map(lambda x: np.asarray(x, np.float64), jax.jit(run)(scene, state))
    return start._replace(states=made.states, contacts=made.contacts)


def phyworld(family: str, *overrides: str) -> Config:
    """The study's config, small."""
    return load_config(f"phyworld_{family}.yaml", ["video.height=16", "video.width=16", *overrides])


def mixed(ranges: list[tuple[float, float]], n: int, seed: int) -> np.ndarray:
    """n numbers, each from one of the ranges."""
    draws = np.random.default_rng(seed)
    low, high = np.array(ranges)[draws.integers(len(ranges), size=n)].T
    return np.float32(low + draws.random(n) * (high - low)).astype(float)


def uniformly(shares: np.ndarray) -> None:
    """Fails unless the numbers are uniform in [0, 1] (Kolmogorov-Smirnov, p = 0.001)."""
    rank, ordered = np.arange(len(shares)) / len(shares), np.sort(shares)
    assert np.abs(ordered - rank).max() < 1.95 / np.sqrt(len(shares)) + 1 / len(shares)


# Every config -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*FAMILIES, "billiards", "ramp", "spinning"])
def test_what_moves_starts_in_view_and_touches_nothing(name):
    config = load_config(f"{name}.yaml")
    made = begun(config, 256)
    left, bottom, right, top = config.scene.contract.layout(config.scene.options).bounds
    objects, x = made.scene.objects, made.start.position
    moving = (objects.present > 0) & (objects.kind == 0)
    rim = objects.radius + np.abs(objects.half_length)
    low, high = np.array([left, bottom]) - 1e-5, np.array([right, top]) + 1e-5
    inside = ((x - rim[..., None] >= low) & (x + rim[..., None] <= high)).all(-1)
    assert inside[moving].all()
    apart = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1) - rim[:, :, None] - rim[:, None]
    pairs = moving[:, :, None] & moving[:, None] & ~np.eye(x.shape[1], dtype=bool)
    assert (apart[pairs] > 0).all()
    for leaf in jax.tree.leaves(made):
        assert not np.isnan(leaf).any()


@pytest.mark.parametrize("family", FAMILIES)
def test_exactly_n_videos_none_alike_over_shards_seeds_and_splits(family, tmp_path: Path):
    overrides = ["storage.batch_size=4", "storage.videos_per_shard=4", "storage.frames=none", "video.frames=3"]
    config, n, starts = phyworld(family, *overrides), 10, []
    for seed, split in ((0, "train"), (1, "train"), (0, "test")):
        out = tmp_path / f"{seed}-{split}"
        generate(config, n, out, seed=seed, split=split)
        data = everything(out, split)
        assert_array_equal(data["index"], np.arange(n))
        starts.append(data["states/position"][:, 0].reshape(n, -1))
    assert gen2d.open(out, "test", fields="states/*").time[0] == 0
    flat = np.concatenate(starts)
    assert len(np.unique(flat, axis=0)) == len(flat)


BROKEN = {
    "uniform_motion": ("radius", [4, 5], "must fit a view of 10 x 10 m"),
    "parabola": ("top_distance", 9, "must start in a view 10 m high"),
    "collision": ("contact_frames", [24, 8], "must have the first frame first"),
    "billiards": ("rows", [3, 12], "must fit a table of 10 x 5 m"),
    "ramp": ("slope", [0.2, 1.0], "must fit a view 6 m high"),
    "spinning": ("radius", 2, "must fit a storey of 14 x 2.5 m"),
}


@pytest.mark.parametrize("family", BROKEN)
def test_options_that_cannot_be_met_are_refused_in_one_sentence(family):
    option, value, message = BROKEN[family]
    with pytest.raises(ConfigError, match=message) as error:
        load_config({"scene": {"name": family, option: value}})
    assert f"scene.{option} " in str(error.value)
    assert "\n" not in str(error.value)


# Uniform motion and parabola ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", ["uniform_motion", "parabola"])
def test_ball_starts_where_the_study_says_in_and_out_of_its_training_range(family):
    n = 6000
    radius, speed = mixed(RADII["one"], n, 1), mixed(SPEEDS, n, 2)
    made = begun(phyworld(family), n, {"radius": radius, "speed": speed})
    x, y = made.start.position[:, 0].T
    last = SIDE - STAYS * speed - radius
    fits = last > radius
    assert 0.3 < fits.mean() < 0.7
    uniformly(((x - radius) / (last - radius))[fits])
    uniformly(((x - radius) / 0.5)[~fits])
    lowest, highest = (radius + 0.5, 9.5 - radius) if family == "uniform_motion" else (8.5 - radius, 9.5 - radius)
    uniformly((y - lowest) / (highest - lowest))


def test_a_quarter_of_fast_or_large_balls_has_no_room_in_the_training_range():
    made = begun(phyworld("uniform_motion"), 6000)
    radius, speed = made.factors["radius"], made.factors["speed"]
    assert abs((STAYS * speed + 2 * radius > SIDE).mean() - 0.24) < 0.02


def test_ball_stays_in_view_in_whatever_direction_it_moves():
    n = 2000
    draws = np.random.default_rng(3)
    given = {"direction": draws.uniform(-np.pi, np.pi, n), "speed": draws.uniform(0, 2, n)}
    made = begun(load_config("uniform_motion.yaml"), n, given)
    radius, start = made.factors["radius"][:, None], made.start.position[:, 0]
    for x in (start, start + STAYS * made.start.velocity[:, 0]):
        assert (x - radius > -1e-5).all()
        assert (x + radius < SIDE + 1e-5).all()


def test_velocity_of_the_states_is_the_factor_to_the_bit():
    """The study's own positions give 255/256 of it."""
    made = played(phyworld("uniform_motion"), 32, {"speed": mixed(SPEEDS, 32, 4), "radius": mixed(RADII["one"], 32, 5)})
    x, v, speed = made.states.position[:, :, 0], made.states.velocity[:, :, 0], made.factors["speed"]
    assert_array_equal(v[..., 0], np.broadcast_to(speed[:, None], v.shape[:2]))
    assert_array_equal(v[..., 1], 0)
    assert_array_equal(x[:, 0], made.start.position[:, 0])
    t = np.arange(32) / FPS
    holds("uniform motion: place, m", x[..., 0] - x[:, :1, 0] - speed[:, None] * t, 5e-6)
    holds("uniform motion: speed by places, relative", (x[:, -1, 0] - x[:, 0, 0]) / t[-1] - speed, 1e-6)


def test_thrown_ball_is_on_its_parabola():
    n, draws = 32, np.random.default_rng(6)
    given = {"speed": mixed(SPEEDS, n, 7), "radius": mixed(RADII["one"], n, 8), "angle": draws.uniform(-1, 1, n)}
    made = played(phyworld("parabola"), n, given)
    t = np.arange(32)[:, None] / FPS
    start, velocity = made.start.position[:, :1, :], made.start.velocity[:, :1, :]
    exact = start + velocity * t + made.scene.gravity[:, None] * t**2 / 2
    holds("parabola: place after 3.1 s, m", made.states.position[:, :, 0] - exact, 1e-4)
    holds("parabola: speed, m/s", made.states.velocity[:, :, 0] - velocity - made.scene.gravity[:, None] * t, 2e-4)


# Collision ----------------------------------------------------------------------------------------------------------


def pairs(n: int) -> dict[str, np.ndarray]:
    """Radii and speeds of two balls in and out of the training range, some of which hardly approach or stand still."""
    given = {f"radius_{k}": mixed(RADII["two"], n, 10 + k) for k in (1, 2)}
    given |= {f"speed_{k}": mixed(SPEEDS, n, 20 + k) for k in (1, 2)}
    special = [(0, 0), (0, 3), (2, 0), (0.01, 0), (0.005, 0.0051), (0, 0.02), (6, 6), (0, 0)]
    for k in (1, 2):
        given[f"speed_{k}"][: len(special)] = np.array(special, np.float32)[:, k - 1]
    for k in (1, 2):
        given[f"radius_{k}"][6] = 2.0
    return given


def test_contact_is_within_8_to_24_frames_wherever_there_is_room():
    n = 4000
    made = begun(phyworld("collision"), n, pairs(n))
    radius, x = made.scene.objects.radius, made.start.position[..., 0]
    closing = made.factors["speed_1"] + made.factors["speed_2"]
    frame, gap = made.factors["contact_frame"], x[:, 1] - x[:, 0] - radius.sum(1)
    assert (x[:, 0] - radius[:, 0] > -1e-5).all()
    assert (x[:, 1] + radius[:, 1] < SIDE + 1e-5).all()
    assert_array_equal(made.start.position[:, 0, 1], made.start.position[:, 1, 1])
    assert_array_equal(frame == -1, closing == 0)
    assert (gap > 0).all()
    moves = closing > 0
    latest = FPS * (SIDE - 2 * radius.sum(1)) / np.where(moves, closing, np.nan)
    roomy, narrow = moves & (latest >= 8), moves & (latest < 8)
    assert 0.05 < narrow.mean() < 0.5
    assert (frame[roomy] > 7.9999).all()
    assert (frame[roomy] < np.minimum(latest[roomy], 24) + 1e-3).all()
    assert (frame[narrow] > latest[narrow] / 2 - 1e-3).all()
    assert (frame[narrow] < latest[narrow] + 1e-3).all()
    last = np.minimum(latest, 24)[roomy]
    uniformly(((frame[roomy] - 8) / (last - 8))[last > 9])
    holds("collision: contact frame by places, frames", frame[moves] - FPS * gap[moves] / closing[moves], 2e-3)


@pytest.mark.full
def test_balls_part_as_they_must_down_to_a_centimetre_a_second():
    n = 64
    made = played(phyworld("collision", "annotations.contacts=4"), n, pairs(n))
    first, second = made.factors["speed_1"], -made.factors["speed_2"]
    mass, closing = made.scene.objects.mass.T, first - second
    moves = closing > 0
    mean = (mass[0] * first + mass[1] * second) / mass.sum(0)
    exact, v = np.stack([2 * mean - first, 2 * mean - second], 1), made.states.velocity
    after = (v[:, -1, :, 0] - exact)[moves] / closing[moves, None]
    holds("collision: speeds after, of that of approach", after, 1e-4)
    holds("collision: speeds across, m/s", v[..., 1], 0)
    rows = made.contacts
    assert_array_equal(rows.count, moves)
    holds("collision: time of contact, frames", (FPS * rows.time[:, 0] - made.factors["contact_frame"])[moves], 2e-3)
    before = v[np.arange(n), np.maximum(rows.frame[:, 0].astype(int) - 1, 0), :, 0]
    assert_array_equal(before[moves], np.stack([first, second], 1)[moves])
    assert_array_equal(made.states.position[~moves], made.states.position[~moves][:, :1].repeat(32, 1))


def test_contact_frames_count_the_frames_of_the_video():
    for name in ("collision", "phyworld_collision"):
        config = load_config(f"{name}.yaml")
        assert config.scene.options.frame_interval * config.video.fps == 1


# Billiards ----------------------------------------------------------------------------------------------------------


def test_rack_is_whole_and_its_balls_are_a_gap_apart():
    made = begun(load_config("billiards.yaml"), 64)
    rows, x = made.factors["rows"].astype(int), made.start.position
    there = made.scene.objects.present[:, 1:-4] > 0
    assert set(rows) == {3, 4, 5}
    assert_array_equal(there.sum(1), rows * (rows + 1) // 2)
    apart = np.linalg.norm(x[:, 1:-4, None] - x[:, None, 1:-4], axis=-1)
    nearest = np.where(there[:, :, None] & there[:, None] & (apart > 0), apart, np.inf).min(2)
    holds("rack: distance of neighbours, m", nearest[there] - (2 * 0.24 + 0.01), 1e-5)
    off = made.start.velocity[:, 0] / made.factors["speed"][:, None]
    way = x[:, 1] - x[:, 0]
    sine = (way[:, 0] * off[:, 1] - way[:, 1] * off[:, 0]) / np.linalg.norm(way, axis=-1)
    holds("aim_angle, rad", np.arcsin(sine) - made.factors["aim_angle"], 1e-5)


@pytest.mark.full
def test_break_keeps_momentum_until_a_cushion_is_hit_and_never_gains_energy():
    overrides = ["scene.rows=2", "video.frames=48", "annotations.contacts=8"]
    config = load_config("billiards.yaml", overrides)
    made, rate = played(config, 8), config.physics.damping
    objects, x, v = made.scene.objects, made.states.position[:, :, :-4], made.states.velocity[:, :, :-4]
    mass, moment, radius = objects.mass[:, None, :-4], objects.moment[:, None, :-4], objects.radius[:, None, :-4, None]
    assert ((x >= radius - 1e-3) & (x <= np.array([10, 5]) - radius + 1e-3)).all()
    energy = (mass * (v**2).sum(-1) + moment * made.states.angular_velocity[:, :, :-4] ** 2).sum(-1) / 2
    holds("break: energy gained in a frame, relative", np.maximum(np.diff(energy) / energy[:, :1], 0), 1e-5)
    rows, t = made.contacts, np.arange(48) / config.video.fps
    momentum = (mass[..., None] * v).sum(2)
    balls = x.shape[2]
    struck = 0
    for k in range(8):
        cushion = rows.frame[k][(rows.kind[k] > 0) & (np.maximum(rows.a[k], rows.b[k]) >= balls)]
        before = t < (cushion.min() if len(cushion) else 48) / config.video.fps
        change = momentum[k] * np.exp(rate * t)[:, None] - momentum[k, 0]
        holds("break: momentum until a cushion is hit, relative", change[before] / np.abs(momentum[k, 0]).max(), 1e-4)
        struck += (np.abs(v[k, before][-1]).sum(-1) > 0).sum() > 1  # others than the cue ball move by then
    assert struck >= 6


# Ramp ---------------------------------------------------------------------------------------------------------------


def downhill(made: Played) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Way and speed [n, T] down the slope, and where it is still clear of the floor."""
    slope, half = made.factors["slope"], made.scene.objects.half_length[:, 0]
    down = np.stack([np.cos(slope), -np.sin(slope)], -1)[:, None]
    way = ((made.states.position[:, :, 0] - made.start.position[:, None, 0]) * down).sum(-1)
    end = (1 - made.factors["relative_position"]) * (made.factors["length"] - 2 * (half + made.factors["radius"]))
    return way, (made.states.velocity[:, :, 0] * down).sum(-1), way < end[:, None]


def test_ball_rolls_or_slides_as_its_friction_says():
    slope, part = (x.ravel() for x in np.meshgrid([0.25, 0.4, 0.55], [0.3, 0.8, 0.95, 1.05, 1.5]))
    given = {"slope": slope, "friction": part * np.tan(slope) / 3}
    config = load_config("ramp.yaml", ["video.frames=40"])
    made = played(config, len(slope), given)
    way, speed, clear = downhill(made)
    t = np.arange(40) / config.video.fps
    slides = 9.8 * (np.sin(slope) - given["friction"] * np.cos(slope))
    exact = np.where(part < 1, slides, 2 / 3 * 9.8 * np.sin(slope))[:, None]
    clear &= t > 0.3
    assert clear.any(1).all()
    holds("ramp: speed, relative", (speed / (exact * np.maximum(t, 1e-9)) - 1)[clear], 1e-3)
    # What a contact holds goes h v in a step of h, with v at its end: half a step's way more than the exact one.
    ahead = (way - exact * t**2 / 2) / (np.maximum(speed, 1e-9) / 240)
    holds("ramp: way, of that in a step", ahead[clear], 0.6)
    slip = speed + made.states.angular_velocity[:, :, 0] * made.factors["radius"][:, None]
    holds("ramp: slip of a ball that rolls, m/s", slip[clear & (part > 1)[:, None]], 1e-3)
    x, r = made.states.position[:, :, 0], made.factors["radius"][:, None]
    assert (x[..., 1] > r - 0.02).all()  # on the floor
    assert (x[..., 0] < 10 - r + 0.02).all()  # before the wall


@pytest.mark.full
def test_capsule_slides_or_stays_as_its_friction_says():
    slope = np.array([0.3, 0.3, 0.5, 0.5])
    part = np.array([0.5, 1.05, 0.5, 1.05])
    config = load_config("ramp.yaml", ["scene.shape=capsule", "video.frames=25"])
    made = played(config, 4, {"slope": slope, "friction": part * np.tan(slope)})
    way, speed, clear = downhill(made)
    t = np.arange(25) / config.video.fps
    exact = (9.8 * np.sin(slope) * (1 - part))[part < 1, None]
    clear = clear[part < 1] & (t > 0.3)
    holds("capsule: speed, relative", (speed[part < 1] / (exact * np.maximum(t, 1e-9)) - 1)[clear], 1e-3)
    holds("capsule: way where friction holds it, m", way[part > 1], 1e-3)


# Spinning -----------------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_ball_ends_with_the_speed_that_its_angular_momentum_gives_it():
    n, draws = 32, np.random.default_rng(9)
    given = {name: draws.uniform(low, high, (n, 1)) for name, low, high in
             (("speed", 0, 5), ("spin", -10, 20), ("friction", 0.2, 1), ("radius", 0.5, 0.9))}  # fmt: skip
    made = played(load_config("spinning.yaml", ["scene.balls=1", "video.fps=12", "video.frames=48"]), n, given)
    v, spin, radius = made.states.velocity[:, :, 0], made.states.angular_velocity[:, :, 0], made.factors["radius"]
    speed, back, friction = (made.factors[name][:, 0] for name in ("speed", "spin", "friction"))
    rim = back * radius[:, 0]
    rolls = np.abs(speed + rim) / (3 * friction * 9.8)
    t = np.arange(48) / 12
    rolling = t > rolls[:, None] + 0.05
    exact = (2 * speed - rim) / 3
    assert rolling.any(1).mean() > 0.9
    holds("spinning: speed of a ball that rolls, m/s", (v[..., 0] - exact[:, None])[rolling], 2e-3)
    holds("spinning: slip of a ball that rolls, m/s", (v[..., 0] + spin * radius)[rolling], 2e-3)
    conserved = v[..., 0] - spin * radius / 2
    holds("spinning: angular momentum about the floor, m/s", conserved - conserved[:, :1], 2e-3)
    returns = (rim > 2 * speed) & rolling.any(1)
    assert returns.any()
    assert_array_equal(v[rolling.any(1), -1, 0] < 0, (rim > 2 * speed)[rolling.any(1)])
