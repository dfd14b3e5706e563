"""The solver against the exact path of smooth discs in a box, to rounding: elastic and not, with gravity and without.

An error of rounding grows with the path, so errors are divided by the growth of a small perturbation of the exact path.
A path is followed to the first impact at less than SLOW, where the solver takes a contact for one at rest. Where a disc
is hit for the second time in one step, the impacts act in the order of their times only with `by_time`.
"""

import dataclasses
import functools
import itertools
import math

import jax
import numpy as np
import pytest
from billiard import Impact, impacts, positions, start
from laws import holds
from oracles import Path, Setting, Thing, gen2d_paths, gen2d_world
from worlds import STEP, rules, run

from gen2d.physics.simulate import SaveAt

SIDE, DISCS, FRAMES = 5.0, 5, 481  # m, number, number of steps of STEP
SLOW = 0.5  # m/s
NUDGE = 1e-9  # m and m/s
LINEAR = 1e7  # growth up to which the perturbation stays small
EARLY = 1.001e-3  # of a step: the solver may take an impact so much early, at the end of the step before
SETTINGS = [(e, g) for e in (1.0, 0.8) for g in (0.0, 9.81)]
EACH = 16  # scenes of each setting


@dataclasses.dataclass(frozen=True)
class Scene:
    """A scene, its exact path and that of the solver, up to the frame `slow`."""

    setting: Setting
    exact: list[Impact]
    path: Path
    slow: int  # the first frame after an impact that may count as a contact at rest
    twice: int  # the first frame after a disc was hit for the second time in a step

    @functools.cached_property
    def errors(self) -> np.ndarray:
        """Largest error of a disc in each frame, m; 0 where the solver is one early impact ahead."""
        times = np.arange(self.slow) * STEP
        offsets = self.path.poses[: self.slow, :, :2] - positions(self.setting, self.exact, times)
        ahead = [any(0 < i.time / STEP - frame < EARLY for i in self.exact) for frame in range(self.slow)]
        return np.where(ahead, 0.0, np.linalg.norm(offsets, axis=2).max(1))

    @functools.cached_property
    def growth(self) -> np.ndarray:
        """Growth of a small perturbation until each frame, at least 1."""
        times, largest = np.arange(self.slow) * STEP, np.ones(self.slow)
        for seed in range(2):
            rng = np.random.default_rng(seed)
            moved = [part + NUDGE * rng.normal(size=part.shape) for part in start(self.setting)]
            things = [Thing(tuple(x), tuple(v), t.radius) for x, v, t in zip(*moved, self.setting.things, strict=True)]
            other = dataclasses.replace(self.setting, things=things)
            way = positions(other, until(other, times[-1]), times) - positions(self.setting, self.exact, times)
            largest = np.maximum(largest, np.linalg.norm(way, axis=2).max(1) / NUDGE)
        return np.maximum.accumulate(largest)


def random_setting(seed: int, elasticity: float, gravity: float) -> Setting:
    """Discs at random places in a box."""
    rng, things = np.random.default_rng(seed), []
    while len(things) < DISCS:
        radius = rng.uniform(0.2, 0.5)
        x, y = rng.uniform(radius + 0.05, SIDE - radius - 0.05, 2).tolist()
        if all(math.hypot(x - t.x[0], y - t.x[1]) > radius + t.radius + 0.05 for t in things):
            u, v = rng.normal(0, 5, 2).tolist()
            things.append(Thing((x, y), (u, v), radius))
    corners = [(0.0, 0.0), (SIDE, 0.0), (SIDE, SIDE), (0.0, SIDE)]
    return Setting(things, list(zip(corners, [*corners[1:], corners[0]], strict=True)), gravity, elasticity)


def until(setting: Setting, time: float) -> list[Impact]:
    """The exact path until a time; at most 1,000 impacts."""
    return list(itertools.takewhile(lambda impact: impact.time <= time, itertools.islice(impacts(setting), 1000)))


def frame_after(impact: Impact) -> int:
    """The first frame that shows an impact."""
    return math.ceil(impact.time / STEP - EARLY)


def discs_of(impact: Impact) -> list[int]:
    """Discs that take part in an impact."""
    return [number for number in impact.pair if number >= 0]


@functools.cache
def scenes(by_time: bool = False) -> list[Scene]:
    """All scenes, simulated at once in double precision, every step a frame."""
    settings = [random_setting(seed, *of) for of in SETTINGS for seed in range(EACH)]
    numbers = rules(by_time=by_time)
    with jax.enable_x64(True):
        made = run([gen2d_world(s) for s in settings], FRAMES, 1, numbers, SaveAt(contacts=400))
    found = []
    for setting, path in zip(settings, gen2d_paths(made, settings), strict=True):
        exact, end = until(setting, (FRAMES - 1) * STEP), FRAMES
        frames = [frame_after(impact) for impact in exact]
        slow = next((f for f, impact in zip(frames, exact, strict=True) if impact.approach < SLOW), end)
        hits = [(frame, disc) for frame, impact in zip(frames, exact, strict=True) for disc in discs_of(impact)]
        twice = next((hit[0] for k, hit in enumerate(hits) if hit in hits[:k]), end)
        found.append(Scene(setting, exact, path, slow, twice))
    return found


def test_path_is_exact_to_rounding_where_impacts_act_in_the_order_of_their_times():
    ratios = [(scene.errors / scene.growth)[scene.growth < LINEAR].max() for scene in scenes(by_time=True)]
    twice = sum(scene.twice < scene.slow for scene in scenes(by_time=True))
    print(f"billiard: {twice} of {len(ratios)} scenes have a step in which a disc is hit twice")
    assert twice > 10
    holds("billiard by time: error over growth of a perturbation, m", ratios, 1e-13)


def test_path_is_exact_to_rounding_while_no_disc_is_hit_twice_in_a_step():
    ratios = [(scene.errors / scene.growth)[: scene.twice].max() for scene in scenes()]
    ends = [min(scene.twice, scene.slow) for scene in scenes()]
    hits = sum(frame_after(impact) < end for scene, end in zip(scenes(), ends, strict=True) for impact in scene.exact)
    print(f"billiard: {hits} impacts, {np.mean(ends) * STEP:.2f} s on average")
    assert hits > 1000
    holds("billiard: error over growth of a perturbation, m", ratios, 1e-13)


def test_impacts_are_the_exact_ones_while_no_disc_is_hit_twice_in_a_step():
    late = []
    for scene in scenes():
        end = min(scene.twice, scene.slow) - 1
        exact = [impact for impact in scene.exact if frame_after(impact) < end]
        found = scene.path.events[: len(exact)]
        assert [i.pair for i in exact] == [event.pair for event in found]
        errors = [i.time - event.time for i, event in zip(exact, found, strict=True)]
        late += [error / scene.growth[frame_after(i)] for error, i in zip(errors, exact, strict=True)]
    holds("billiard: time of impact, over growth, s", late, 1e-13)


@pytest.mark.asked
def test_path_is_exact_to_rounding_where_a_disc_is_hit_twice_in_a_step():
    """At the end of that step, at whose start the path was exact."""
    twice = [scene for scene in scenes() if scene.twice < scene.slow]
    errors = np.array([(scene.errors / scene.growth)[scene.twice] for scene in twice])
    print(f"billiard: {len(twice)} of {len(scenes())} scenes have such a step, {np.sum(errors > 1e-13)} depart in it")
    assert len(twice) > 10
    holds("billiard: error over growth of a step with two impacts of a disc, m", errors, 0.02, asked=1e-13)


AT_REST = 0.1  # m/s: contacts at rest are slower


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [0.0, 9.81])
@pytest.mark.parametrize("discs", [2, 3, 6])
def test_no_elastic_billiard_departs_from_its_exact_path_in_ten_seconds(discs, gravity, monkeypatch):
    monkeypatch.setitem(globals(), "DISCS", discs)
    monkeypatch.setitem(globals(), "FRAMES", 2401)
    monkeypatch.setitem(globals(), "SLOW", AT_REST)
    monkeypatch.setitem(globals(), "NUDGE", NUDGE / 100)
    monkeypatch.setitem(globals(), "SETTINGS", [(1.0, gravity)])
    monkeypatch.setitem(globals(), "EACH", 40)
    ratios, ends = [], []
    for scene in scenes.__wrapped__(by_time=True):
        small = scene.growth < 100 * LINEAR
        ends.append(int(small.argmin()) or scene.slow)
        ratios.append((scene.errors / scene.growth)[small].max())
    print(f"{discs} discs: {len(ends)} paths of {np.mean(ends) * STEP:.1f} s on average, until they are chaotic")
    holds(f"elastic billiard of {discs} discs, {gravity:g} m/s^2: error over growth, m", ratios, 1e-11)
