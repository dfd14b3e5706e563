"""Scene families in which things play with each other: the law of each, on videos of the config that comes with it.

One program a family, as most of the time is compiling: what a law compares is drawn within the videos of a batch.
"""

import functools

import jax
import numpy as np
import pytest
from laws import holds
from numpy.testing import assert_array_equal

from gen2d.config.config import load_config
from gen2d.core.errors import ConfigError
from gen2d.programs.rollout import Rollout

# Of each family what a law needs beside its config.
LAWS = {
    "galton": ["storage.batch_size=256"],
    "funnel": ["storage.batch_size=32", "annotations.energy=true", "scene.gap={choice: [0.5, 1.5, 2.5]}"],
    "marble_run": ["storage.batch_size=64"],
    "cradle": ["storage.batch_size=64", "scene.elasticity={choice: [0.8, 1.0]}"],
    "pile": ["storage.batch_size=16"],
    "occluder": ["storage.batch_size=32"],
    "hidden_mass": ["storage.batch_size=256"],
}
WRONG = {
    "galton": ["radius=0.35", "radius={normal: [0.2, 0.1]}", "ball_spacing=0.3", "jitter=[-3, 0]"],
    "funnel": ["gap=[1, 9]", "radius=5", "angle=[0.5, 1.2]"],
    "marble_run": ["length=[0.4, 0.7]", "length=[0.6, 0.95]", "slope=[0.1, 0.5]", "ramps=9"],
    "cradle": ["moving_balls=[1, 3]", "radius=3", "width=8"],
    "pile": ["disc_radius=4", "box_size=[5, 7]"],
    "occluder": ["screen_width=[1, 3]", "screen_height=3", "screen_width=8", "screen_height=9"],
    "hidden_mass": ["radius=2", "pairs=5", "width=3"],
}


def rollout_of(name: str) -> Rollout:
    """The programs that a family's law is shown with."""
    return Rollout(load_config(f"{name}.yaml", LAWS[name]), jax.devices()[:1])


@functools.cache
def made(name: str) -> dict[str, np.ndarray]:
    """All that is stored of a batch of a family's videos, and what is seen of each object; [n, ...]."""
    rollout = rollout_of(name)
    (batch,) = rollout.start("train", np.arange(rollout.batch_size))
    assert np.asarray(batch.placed).all()
    columns = rollout.host_columns([batch])[0] | {"time": rollout.schema.time}
    if "visibility" in rollout.config.annotations.enabled:
        columns |= rollout.draw([batch], 0, rollout.batch_size)[0]
    return {key: np.asarray(values, float) for key, values in columns.items() if key != "frames"}


def runs(name: str) -> list[slice]:
    """The slots of each of a family's runs."""
    layout = rollout_of(name).layout
    return [slice(first, first + run.count) for run, first in layout.spans]


def gaps(position: np.ndarray, radius: np.ndarray, columns: dict, slots: slice) -> np.ndarray:
    """How far discs at [n, ..., K, 2] m are from segments, from rim to line: [n, ..., K, segments] m, infinite from
    those that are not there."""
    more = (1,) * (position.ndim - 2)

    def of(field: str) -> np.ndarray:
        values = columns[field][:, 0] if field.startswith("states/") else columns[field]
        values = values[:, slots]
        return values.reshape(len(values), *more, *values.shape[1:])

    angle, way = of("states/angle"), position[..., None, :] - of("states/position")
    along = way[..., 0] * np.cos(angle) + way[..., 1] * np.sin(angle)
    aside = way[..., 1] * np.cos(angle) - way[..., 0] * np.sin(angle)
    beyond = np.maximum(np.abs(along) - of("objects/half_length"), 0)
    found = np.hypot(beyond, aside) - radius.reshape(len(radius), *more[1:], -1, 1)
    return np.where(of("objects/present") > 0, found, np.inf)


LONG = ("pile", "galton", "funnel", "marble_run", "occluder", "hidden_mass")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.full) if name in LONG else name for name in LAWS]
)
def test_a_video_begins_in_view_without_overlap_and_stays_finite(name):
    columns, layout = made(name), rollout_of(name).layout
    assert all(np.isfinite(values).all() for key, values in columns.items() if key.startswith(("states/", "factors/")))
    there = columns["objects/present"] * (columns["objects/kind"] == 0) > 0
    around = columns["objects/radius"] + columns["objects/half_length"]
    if "objects/vertices" in columns:
        around = around + np.linalg.norm(columns["objects/vertices"], axis=-1).max(-1)
    place, (left, bottom, right, top) = columns["states/position"][:, 0], layout.bounds
    inside = [place - around[..., None] - [left, bottom], [right, top] - place - around[..., None]]
    holds(f"{name}: out of view at the start, m", np.maximum(0, -np.array(inside)[:, there]), 1e-4)
    apart = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1) - around[:, :, None] - around[:, None]
    pairs = there[:, :, None] & there[:, None] & ~np.eye(there.shape[1], dtype=bool)
    holds(f"{name}: overlap at the start, m", np.maximum(0, np.where(pairs, -apart, 0)), 1e-4)
    for span, (run, _) in zip(runs(name), layout.spans, strict=True):
        if run.shape == "segment":
            holds(f"{name}: overlap with segments, m", np.maximum(0, -gaps(place, around, columns, span)[there]), 1e-4)


@pytest.mark.parametrize(("name", "wrong"), [(name, wrong) for name, some in WRONG.items() for wrong in some])
def test_what_cannot_be_is_refused_in_one_sentence(name, wrong):
    with pytest.raises(ConfigError, match=r": scene\..* but ") as caught:
        load_config(f"{name}.yaml", [f"scene.{wrong}"])
    assert wrong.partition("=")[0] in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.full
def test_galton_s_balls_end_in_bins_as_often_left_as_right():
    columns, options = made("galton"), rollout_of("galton").config.scene.options
    there, last = columns["objects/present"][:, runs("galton")[0]] > 0, columns["states/position"][:, -1]
    x, y = np.moveaxis(last[:, runs("galton")[0]][there], -1, 0)
    late = y >= options.bin_height
    holds("galton: balls in no bin at the end, of all", late.mean(), 0.01)
    x = x[~late]
    counts = np.bincount((x / options.spacing).astype(int), minlength=options.rows + 1)
    assert len(counts) == options.rows + 1
    both = counts + counts[::-1]
    holds("galton: bins against their mirror images, deviations", (counts - counts[::-1]) / np.sqrt(both + 1), 4)
    spread = np.average((np.arange(len(counts)) - options.rows / 2) ** 2, weights=counts) / (options.rows / 4)
    print(f"galton: {counts} in bins, variance {spread:.2f} times the binomial's")
    assert 0.7 < spread < 2.5


@pytest.mark.full
def test_funnel_lets_pass_what_fits_through_its_gap_and_gains_no_energy():
    columns, options = made("funnel"), rollout_of("funnel").config.scene.options
    ours = runs("funnel")[0]
    there, gap = columns["objects/present"][:, ours] > 0, columns["factors/gap"]
    x, y = np.moveaxis(columns["states/position"][:, :, ours], -1, 0)
    fell = (y[:, :-1] >= options.neck_height) & (y[:, 1:] < options.neck_height) & there[:, None]
    passed = fell.any(1)
    share = np.where(fell, (options.neck_height - y[:, :-1]) / np.where(fell, y[:, 1:] - y[:, :-1], 1), 0)
    at = x[:, :-1] + share * np.diff(x, axis=1)
    room = np.abs(at - options.width / 2) - gap[:, None, None] / 2
    holds("funnel: beyond the gap's sides, m", np.maximum(0, room[fell]), 0)
    assert_array_equal(passed, (y.min(1) < options.neck_height) & there)
    assert not passed[gap < 2 * options.radius.support[0]].any()
    assert passed[gap > 2].sum() > 0.5 * there[gap > 2].sum()
    energy = np.sum([columns[f"energy/{part}"] for part in ("kinetic", "rotational", "potential")], axis=0)
    gained = np.maximum(0, np.diff(energy, axis=1)) / energy[:, :1]
    holds("funnel: energy gained in a frame, of the first", gained, 2e-3)


@pytest.mark.full
def test_marble_run_is_run_from_ramp_to_ramp():
    columns = made("marble_run")
    ball, ramps, box = runs("marble_run")
    radius, place = columns["objects/radius"][:, ball], columns["states/position"][:, :, ball]
    touched = gaps(place, radius, columns, ramps)[:, :, 0] < 0.01
    count, frames = columns["factors/ramps"].astype(int), touched.shape[1]
    first = np.where(touched.any(1), touched.argmax(1), frames)
    for video, number in zip(first, count, strict=True):
        assert (np.diff(video[:number]) >= 0).all()
    floor = gaps(place, radius, columns, slice(box.start, box.start + 1))[:, :, 0, 0].min(1) < 0.01
    assert (first.max(1, where=np.arange(first.shape[1]) < count[:, None], initial=0) < frames)[floor].all()
    print(f"marble_run: {floor.mean():.0%} reach the floor")
    assert floor.mean() > 0.8
    holds("marble_run: deepest overlap, m", columns["quality/max_penetration"], 0.02)


def test_cradle_hands_its_speed_to_as_many_as_came():
    columns = made("cradle")
    v, there = columns["states/velocity"] / columns["factors/speed"][:, None, None, None], columns["objects/present"]
    number, balls = np.arange(v.shape[2]), columns["factors/balls"][:, None]
    moving, elastic = columns["factors/moving_balls"][:, None], columns["factors/elasticity"] == 1
    leave = (number >= balls - moving) & (number < balls)
    holds("cradle: speeds at the end, of the first", (v[:, -1, :, 0] - leave)[elastic], 1e-3)
    holds("cradle: sideways, of the first", v[..., 1], 1e-6)
    holds("cradle: momentum, of the first", (v[..., 0] * there[:, None]).sum(-1) / moving - 1, 1e-5)
    assert elastic.any()
    assert not elastic.all()


@pytest.mark.full
def test_pile_comes_to_rest_in_its_bin():
    columns, options = made("pile"), rollout_of("pile").config.scene.options
    there = columns["objects/present"] * (columns["objects/kind"] == 0) > 0
    speed = np.linalg.norm(columns["states/velocity"][:, -1], axis=-1)[there]
    # A disc that nothing stops rolls on.
    holds("pile: speed at the end of half of all, m/s", np.median(speed), 1e-3)
    holds("pile: speed at the end of nine out of ten, m/s", np.quantile(speed, 0.9), 0.05)
    # What is hit from several sides in a step may overlap by what it moves in that step.
    fastest = np.linalg.norm(columns["states/velocity"], axis=-1).max() / 240
    holds("pile: deepest overlap, of the longest way in a step", columns["quality/max_penetration"] / fastest, 3)
    place = columns["states/position"]
    inside = np.minimum(place, np.array([options.width, np.inf]) - place).min(-1)
    assert (inside > 0)[np.broadcast_to(there[:, None], inside.shape)].all()


@pytest.mark.full
def test_occluder_hides_balls_and_does_nothing_else():
    columns, options = made("occluder"), rollout_of("occluder").config.scene.options
    ours = runs("occluder")[0]
    there, time, radius = columns["objects/present"][:, ours] > 0, columns["time"], columns["objects/radius"][:, ours]
    # Each flies at its own height between two elastic walls: unfolded, a straight line.
    place, speed = columns["states/position"][:, :, ours], columns["states/velocity"][:, 0, ours, 0]
    room = options.width - 2 * radius
    way = (place[:, :1, :, 0] - radius[:, None] + time[:, None] * speed[:, None]) % (2 * room[:, None])
    x = radius[:, None] + np.minimum(way, 2 * room[:, None] - way)
    every = np.broadcast_to(there[:, None], x.shape)
    holds("occluder: way against that without a screen, m", (place[..., 0] - x)[every], 1e-4)
    holds("occluder: height, m", (place[..., 1] - place[:, :1, :, 1])[every], 1e-5)

    seen = columns["visibility/fraction"][:, :, ours]
    begin, end = columns["factors/hidden_from"], columns["factors/hidden_from"] + columns["factors/hidden_for"]
    behind = (time[:, None] >= begin[:, None]) & (time[:, None] <= end[:, None]) & every
    assert (behind.any(1) | ~there | (columns["factors/hidden_for"] < time[1])).all()
    assert (seen[behind] == 0).all()
    holds("occluder: unseen at the start, counted in whole pixels", 1 - seen[:, 0][there], 0.15)


def test_hidden_mass_shows_in_the_first_collision_and_nowhere_before():
    columns, options = made("hidden_mass"), rollout_of("hidden_mass").config.scene.options
    density, elasticity = columns["factors/density"], columns["factors/elasticity"]
    first = np.log(density[:, 0])  # the first pair is in every video
    for look in (columns["factors/radius"], *columns["factors/color"].T):
        for hidden in first.T:
            assert abs(np.corrcoef(look, hidden)[0, 1]) < 4 / np.sqrt(len(look))

    alone = columns["factors/pairs"] == 1
    radius, time = columns["factors/radius"], columns["time"]
    after = np.ceil(columns["factors/contact_time"][:, 0] / time[1] + 0.05).astype(int)
    alone &= after < len(time)
    video = np.arange(len(after))
    after = np.minimum(after, len(time) - 1)
    place, then = columns["states/position"][:, :, :2][video, after], columns["states/velocity"][:, :, :2]
    before, then = then[:, 0], then[video, after]
    edge = np.minimum(place, np.array([options.width, options.height]) - place).min((1, 2)) - radius
    fast = np.linalg.norm(then, axis=-1).max(-1)
    alone &= edge > 2 * fast * time[1]  # no wall was met since
    assert alone.sum() > len(alone) / 10
    way = then - before
    ratio = np.linalg.norm(way[:, 1], axis=-1) / np.linalg.norm(way[:, 0], axis=-1)
    holds("hidden_mass: ratio of masses, relative", (ratio / columns["factors/mass_ratio"][:, 0] - 1)[alone], 1e-3)
    sine = columns["factors/offset"][:, 0]
    normal = np.stack([np.sqrt(1 - sine**2), sine], axis=-1)
    closing, leaving = (np.einsum("ni,ni->n", v[:, 0] - v[:, 1], normal) for v in (before, then))
    bounce = -leaving / closing - elasticity[:, 0].prod(-1)
    holds("hidden_mass: coefficient of restitution", bounce[alone], 2e-3)
