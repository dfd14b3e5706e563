"""The solver beside two others, Box2D 2.3 and Chipmunk (pymunk), and beside exact paths of flying discs.

Engines agree on what meets what, and when, only until errors have grown: a hit of two discs makes them about 2 L / r
times as large. So three events are compared, and afterwards only how piles rest, and distributions over many scenes.
`pytest -rP` prints the figures.
"""

import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from billiard import Impact, impacts
from laws import holds
from oracles import (
    SKIN,
    Event,
    Path,
    Setting,
    Thing,
    box2d_path,
    chipmunk_path,
    deepest,
    gen2d_paths,
    gen2d_world,
)
from worlds import STEP, energies, momenta, run, world

from gen2d.physics.simulate import SaveAt

GRAVITY = 9.81  # m/s^2
FRAME = 1 / 60  # s

# Events -------------------------------------------------------------------------------------------------------------

SCENES, EVENTS, SIDE, SECONDS = 200, 3, 9.0, 4  # number, number, m, s
FINE = 8  # steps a frame of the other engines in flight: 480 Hz
SLOW = 1.0  # m/s: Box2D does not bounce what is slower, and its skins of 1 cm show in when that touches
Events = Sequence[Event | Impact]


def box(side: float) -> list:
    """Four walls, counter-clockwise."""
    corners = [(0.0, 0.0), (side, 0.0), (side, side), (0.0, side)]
    return list(zip(corners, [*corners[1:], corners[0]], strict=True))


def discs(seed: int, least: int) -> list[Thing]:
    """Up to 8 discs at random places in the box, 5 cm or more apart, at random speeds."""
    rng = np.random.default_rng(seed)
    radii = rng.uniform(0.4, 0.8, rng.integers(least, 8, endpoint=True)).tolist()
    places: list[tuple[float, float]] = []
    while len(places) < len(radii):
        radius = radii[len(places)]
        x, y = rng.uniform(radius + 0.05, SIDE - radius - 0.05, 2).tolist()
        if all(math.hypot(x - a, y - b) > radius + r + 0.05 for (a, b), r in zip(places, radii, strict=False)):
            places.append((x, y))
    speeds = rng.normal(0, 3, (len(radii), 2)).tolist()
    return [Thing(x, (u, v), r) for x, (u, v), r in zip(places, speeds, radii, strict=True)]


def firsts(events: Events, elasticity: float) -> list:
    """The events; where nothing bounces only the first of each pair, as contacts that stay may begin again."""
    known = {event.pair: event for event in reversed(events)}
    return [e for e in events if elasticity > 0 or known[e.pair] is e]


@functools.cache
def flights(elasticity: float) -> tuple[list[Setting], list[list[Impact]], list[Path]]:
    """200 smooth scenes, their exact paths, and gen2d's, all in one batch; one program for any elasticity."""
    settings = [Setting(discs(seed, 4), box(SIDE), elasticity=elasticity) for seed in range(SCENES)]
    made = run([gen2d_world(s, 8) for s in settings], SECONDS * 60 + 1, 4, keep=SaveAt(contacts=256))
    paths = [p._replace(events=firsts(p.events, elasticity)) for p in gen2d_paths(made, settings)]
    return settings, [firsts(exact_path(s), elasticity) for s in settings], paths


def exact_path(setting: Setting) -> list[Impact]:
    """The exact path until 8 pairs have collided."""
    path, pairs = [], set()
    for impact in impacts(setting):
        path.append(impact)
        pairs.add(impact.pair)
        if len(pairs) == 8:
            break
    return path


def is_clear(exact: Events) -> bool:
    """Whether the order of the first three is beyond doubt: they and the fourth are more than a frame apart."""
    return bool((np.diff([e.time for e in exact[: EVENTS + 1]]) > FRAME).all())


def delay(exact: Events, found: Events) -> float:
    """Largest difference in time of the first events, s."""
    return max(abs(e.time - f.time) for e, f in zip(exact[:EVENTS], found[:EVENTS], strict=True))


def disagree(exact: Sequence[Events], found: Sequence[Events]) -> tuple[list[int], list[int]]:
    """Of the clear scenes those that differ in pair, order or time (a frame or more); of the others, in the set."""
    ordered, sets = [], []
    for i, (own, other) in enumerate(zip(exact, found, strict=True)):
        pairs = [[e.pair for e in events[:EVENTS]] for events in (own, other)]
        if not is_clear(own):
            sets += [i] * (set(pairs[0]) != set(pairs[1]))
        elif pairs[0] != pairs[1] or delay(own, other) > FRAME:
            ordered.append(i)
    return ordered, sets


def same_events(name: str, exact: Sequence[Events], found: Sequence[Events]) -> None:
    """Asserts that all clear scenes agree, and of the others, whose events have no certain order, 9 of 10 sets."""
    ordered, sets = disagree(exact, found)
    certain = sum(is_clear(e) for e in exact)
    print(f"{name}: {len(ordered)} of {certain} in order differ, {len(sets)} of {len(exact) - certain} others as sets")
    assert certain >= len(exact) / 2
    assert not ordered, f"{name}: {ordered} differ"
    assert len(sets) <= 0.1 * (len(exact) - certain), f"{name}: {sets} differ as sets"


@pytest.mark.parametrize("elasticity", [1.0, 0.0])
def test_first_events_are_the_exact_ones(elasticity):
    _, exact, paths = flights(elasticity)
    same_events(f"e = {elasticity:g}, exact", exact, [p.events for p in paths])
    holds(
        f"e = {elasticity:g}: time of event, s",
        [delay(e, p.events) for e, p in zip(exact, paths, strict=True) if is_clear(e)],
        STEP,
    )


def test_speeds_after_the_first_events_are_the_exact_ones():
    """Relative to the faster one of the pair. All speeds stay as they are until the next event, a frame later."""
    _, exact, paths = flights(1.0)
    errors = []
    for impact, path in ((i, p) for own, p in zip(exact, paths, strict=True) if is_clear(own) for i in own[:EVENTS]):
        pair, frame = [i for i in impact.pair if i >= 0], math.floor(impact.time / FRAME) + 1
        error, speed = path.speeds[frame, pair, :2] - impact.after[pair], np.linalg.norm(impact.after[pair], axis=1)
        errors.append(np.linalg.norm(error, axis=1).max() / speed.max())
    assert len(errors) >= EVENTS * SCENES / 2
    holds("speed after events, relative", errors, 0.02)


@pytest.mark.parametrize("elasticity", [1.0, 0.0])
def test_first_events_are_those_of_chipmunk(elasticity):
    """Scenes in which Chipmunk itself is off the exact path do not count; they are few."""
    settings, exact, paths = flights(elasticity)
    theirs = [firsts(chipmunk_path(s, SECONDS, FINE, events=24).events, elasticity) for s in settings]
    assert_agreement(f"e = {elasticity:g}, Chipmunk", exact, theirs, [p.events for p in paths], range(SCENES))


@pytest.mark.parametrize("elasticity", [1.0, 0.0])
def test_first_events_are_those_of_box2d(elasticity):
    """Scenes with a slow approach do not count: skins and the threshold of Box2D's bounces make them other scenes."""
    settings, exact, paths = flights(elasticity)
    theirs = [firsts(box2d_path(s, SECONDS, FINE, events=24).events, elasticity) for s in settings]
    fast = [i for i in range(SCENES) if min(e.approach for e in exact[i][:EVENTS]) > SLOW]
    assert_agreement(f"e = {elasticity:g}, Box2D", exact, theirs, [p.events for p in paths], fast)


def assert_agreement(name: str, exact: list, theirs: list, ours: list, scenes: Sequence[int]) -> None:
    """Asserts that another engine finds gen2d's events in these scenes, but where it is off the exact ones."""
    off = {scenes[i] for found in disagree([exact[i] for i in scenes], [theirs[i] for i in scenes]) for i in found}
    kept = [i for i in scenes if i not in off]
    print(f"{name}: {len(kept)} scenes of {SCENES}; off the exact path itself: {sorted(off)}")
    assert len(kept) >= 0.8 * SCENES
    same_events(name, [theirs[i] for i in kept], [ours[i] for i in kept])


# Rest ---------------------------------------------------------------------------------------------------------------

FRICTION = 0.5
FLOOR = [((-20.0, 0.0), (20.0, 0.0))]


def channel(width: float) -> list:
    """A floor between two walls."""
    return [((0.0, 0.0), (width, 0.0)), ((width, 0.0), (width, 20.0)), ((0.0, 20.0), (0.0, 0.0))]


def pile_in(things: list[Thing], walls: list, elasticity: float = 0.0) -> Setting:
    """The scene of a pile."""
    return Setting(things, walls, GRAVITY, elasticity, FRICTION)


def pyramid(elasticity: float) -> Setting:
    """Six rows of discs between walls, a millimetre apart."""
    air, rise = 1.001, math.sqrt(0.75)
    places = [(air * (0.5 + 0.5 * k + i), air * (0.5 + k * rise)) for k in range(6) for i in range(6 - k)]
    return pile_in([Thing(x) for x in places], channel(6 * air), elasticity)


def column(elasticity: float) -> Setting:
    """Ten discs that fall against the walls of a channel 1.2 diameters wide."""
    return pile_in([Thing((0.5 + 0.2 * (k % 2), 0.5 + k)) for k in range(10)], channel(1.2), elasticity)


def bin_of_32(elasticity: float) -> Setting:
    """Discs of many sizes that fall into a bin."""
    rng = np.random.default_rng(0)
    things = [
        Thing((0.5 + k % 4 + rng.uniform(-0.05, 0.05), 0.5 + 1.05 * (k // 4)), radius=rng.uniform(0.3, 0.45))
        for k in range(32)
    ]
    return pile_in(things, channel(4.0), elasticity)


def tower(count: int) -> Setting:
    """Boxes on each other, 5 mm apart."""
    return pile_in([Thing((0, 0.5 + 1.005 * k), size=(1, 1)) for k in range(count)], FLOOR)


def bricks(courses: int) -> Setting:
    """A wall, two bricks long, with half bricks at the ends of every other course."""
    odd, even = [(-0.505, 1.0), (0.505, 1.0)], [(-0.7575, 0.5), (0.0, 1.0), (0.7575, 0.5)]
    rows = [(k, x, width) for k in range(courses) for x, width in (even if k % 2 else odd)]
    return pile_in([Thing((x, 0.25 + 0.505 * k), size=(width, 0.5)) for k, x, width in rows], FLOOR)


def heap(rows: int) -> Setting:
    """A pyramid of boxes of different sizes."""
    rng, base, things = np.random.default_rng(1), 0.0, []
    for k in range(rows):
        height = rng.uniform(0.4, 1)
        sizes = [(rng.uniform(0.7, 0.95), height) for _ in range(rows - k)]
        things += [Thing((i - (rows - 1 - k) / 2, base + height / 2), size=s) for i, s in enumerate(sizes)]
        base += 1.005 * height
    return pile_in(things, FLOOR)


def figures(
    setting: Setting, path: Path, settle: int, skin: float = 0.0, rolling: int = 0
) -> tuple[float, float, float]:
    """Overlap in m, way in m and speed in m/s at most, from `settle` s on; the way without that of `rolling` bodies."""
    poses, speeds = path.poses[60 * settle :], path.speeds[60 * settle :]
    way = np.sort(np.linalg.norm((poses - poses[0])[..., :2], axis=-1).max(0))[-1 - rolling]
    return deepest(setting, poses[::10], skin), float(way), float(np.linalg.norm(speeds[..., :2], axis=-1).max())


def rests_as_box2d(
    settings: Mapping[str, tuple[Setting, float | None, float]],
    slots: int | None,
    settle: int,
    watch: int,
    rolling: int = 0,
) -> None:
    """Asserts that scenes, each with the bounds of its overlap (None: Box2D's at 60 Hz) and speed, come to rest,
    but for the ways of `rolling` bodies in ours.

    Box2D 2.3 leaves 5 mm of overlap (its slop) and takes out what is more, whatever the load; gen2d's grows with it.
    """
    made = run([gen2d_world(s, slots) for s, *_ in settings.values()], (settle + watch) * 60 + 1, 4)
    paths = gen2d_paths(made, [s for s, *_ in settings.values()])
    found = {
        name: figures(s, p, settle, rolling=rolling) for (name, (s, *_)), p in zip(settings.items(), paths, strict=True)
    }
    theirs = {n: figures(s, box2d_path(s, settle + watch), settle, SKIN) for n, (s, *_) in settings.items()}
    for name in settings:
        of = zip(("gen2d", "Box2D"), (found[name], theirs[name]), strict=True)
        print(
            name, *(f"{who}: overlap {a:.5f} m, way {b:.1e} m, speed {c:.1e} m/s" for who, (a, b, c) in of), sep="\n  "
        )
    for name, (_, depth, fast) in settings.items():
        overlap, way, speed = found[name]
        holds(f"{name}: overlap, m", overlap, theirs[name][0] if depth is None else depth)
        holds(f"{name}: way in {watch} s, m", way, 1e-3)
        holds(f"{name}: speed, m/s", speed, fast)


@pytest.mark.full
def test_discs_rest_as_well_as_in_box2d():
    piles = {f"pyramid, e = {e:g}": (pyramid(e), 0.005, 1e-3) for e in (0.0, 0.5)}
    piles |= {f"column of 10, e = {e:g}": (column(e), 0.0055, 1e-3) for e in (0.0, 0.5)}
    rests_as_box2d(piles, 22, settle=8, watch=2)


@pytest.mark.full
def test_boxes_rest_as_well_as_in_box2d():
    piles = {"tower of 5": (tower(5), None, 1e-3), "wall of 2 courses": (bricks(2), None, 1e-3)}
    rests_as_box2d(piles, None, settle=3, watch=3)


@pytest.mark.slow
def test_discs_rest_as_well_as_in_box2d_for_ten_seconds():
    piles = {f"pyramid, e = {e:g}": (pyramid(e), 0.005, 1e-3) for e in (0.0, 0.5)}
    piles |= {f"column of 10, e = {e:g}": (column(e), 0.0055, 1e-3) for e in (0.0, 0.5)}
    piles |= {"bin of 32, e = 0.5": (bin_of_32(0.5), 0.01, 2e-2)}
    rests_as_box2d(piles, 32, settle=10, watch=10)


@pytest.mark.slow
def test_full_bin_without_bounces_rests_for_ten_seconds():
    """One disc may roll freely below an arch of others: nothing stops it but a wall."""
    rests_as_box2d({"bin of 32, e = 0": (bin_of_32(0.0), 0.01, 1e-2)}, 32, settle=10, watch=10, rolling=1)


@pytest.mark.slow
def test_boxes_rest_as_well_as_in_box2d_for_ten_seconds():
    piles = {"tower of 10": tower(10), "wall of 4 courses": bricks(4), "heap of 4 rows": heap(4)}
    rests_as_box2d({name: (s, None, 1e-3) for name, s in piles.items()}, None, settle=10, watch=10)


# Many hits ----------------------------------------------------------------------------------------------------------


def kolmogorov_smirnov(one: np.ndarray, two: np.ndarray) -> float:
    """The probability that two samples of one distribution differ so much (Numerical Recipes, 14.3.3)."""
    every = np.concatenate([one, two])
    ranks = [np.searchsorted(np.sort(x), every, side="right") / len(x) for x in (one, two)]
    size = math.sqrt(len(one) * len(two) / (len(one) + len(two)))
    reach = (size + 0.12 + 0.11 / size) * float(np.abs(np.subtract(*ranks)).max())
    terms = [2 * (-1) ** (k - 1) * math.exp(-2 * (k * reach) ** 2) for k in range(1, 101)]
    return min(1.0, max(0.0, sum(terms))) if reach > 0.2 else 1.0


def settling_figures(setting: Setting, path: Path) -> dict[str, float]:
    """Kinetic energy left over, as a fraction, and heights of the discs in m."""
    mass, moment = (np.array([getattr(t, n) for t in setting.things]) for n in ("mass", "moment"))
    energy = 0.5 * (mass * (path.speeds[..., :2] ** 2).sum(-1) + moment * path.speeds[..., 2] ** 2).sum(-1)
    left = {f"kinetic energy after {t:g} s": float(energy[round(60 * t)] / energy[0]) for t in (0.5, 1, 2, 3)}
    heights = path.poses[-1, :, 1]
    return left | {"mean height at the end": float(heights.mean()), "top at the end": float(heights.max())}


SETTLING = ("kinetic energy after 2 s", "kinetic energy after 3 s")


@functools.cache
def settled(elasticity: float) -> tuple[list[dict[str, float]], list[dict[str, float]]]:
    """Settling figures of 500 scenes in gen2d and in Chipmunk."""
    settings = [Setting(discs(seed, 8), box(SIDE), GRAVITY, elasticity, FRICTION) for seed in range(500)]
    paths = gen2d_paths(run([gen2d_world(s, 8) for s in settings], 6 * 60 + 1, 4), settings)
    ours, theirs = (
        [settling_figures(s, p) for s, p in zip(settings, of, strict=True)]
        for of in (paths, [chipmunk_path(s, 6) for s in settings])
    )
    return ours, theirs


@pytest.mark.slow
@pytest.mark.parametrize("elasticity", [0.0, 0.5, 0.8])
def test_many_hits_are_distributed_as_in_chipmunk(elasticity):
    """With e = .5 but for the energy while piles settle: see the next test."""
    ours, theirs = settled(elasticity)
    chances = {}
    for name in ours[0]:
        one, two = (np.array([figures[name] for figures in of]) for of in (ours, theirs))
        chances[name] = kolmogorov_smirnov(one, two)
        print(
            f"e = {elasticity:g}, {name}: median {np.median(one):.4f} and {np.median(two):.4f}, p = {chances[name]:.3f}"
        )
    compared = {name: p for name, p in chances.items() if elasticity != 0.5 or name not in SETTLING}
    assert min(compared.values()) > 0.01, compared


@pytest.mark.slow
def test_piles_settle_sooner_than_in_chipmunk_as_impacts_come_in_sequence():
    """A disc that hits a resting one loses more than in Chipmunk, which solves both contacts of the latter at once.

    The test of a disc that bounces off a resting one (test_closed_forms.py) has the closed form of this choice.
    """
    ours, theirs = settled(0.5)
    for name in SETTLING:
        one, two = (np.median([figures[name] for figures in of]) for of in (ours, theirs))
        print(f"e = 0.5, {name}: median {one:.4f} and {two:.4f}")
        assert 0.4 * two < one < 0.9 * two


# Newton's cradle ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_touching_cradle_keeps_momentum_and_gains_no_energy(gap):
    """Rows of 2 to 6, hit by one or from both ends. How the speeds are shared out is not determined."""
    worlds = []
    for count in range(2, 7):
        row = [{"x": (k * (1 + gap), 0)} for k in range(count)]
        shot, back = {"x": (-2, 0), "v": (2, 0)}, {"x": (count * (1 + gap) + 1, 0), "v": (-1, 0)}
        worlds += [world([shot, *row], slots=8), world([shot, *row, back], slots=8)]
    made = run(worlds, 361, 1)
    linear, _ = momenta(worlds, made)
    energy = energies(worlds, made)
    size = np.pi / 4 * np.array([2, 3] * (len(worlds) // 2))[:, None]  # kg m/s: of all that flies in
    holds(f"cradle, gap {gap:g}: momentum, relative", np.linalg.norm(linear - linear[:, :1], axis=-1) / size, 1e-6)
    holds(f"cradle, gap {gap:g}: energy gained, relative", np.maximum(energy / energy[:, :1] - 1, 0), 1e-4)
    holds(f"cradle, gap {gap:g}: energy lost, relative", np.maximum(1 - energy / energy[:, :1], 0), 0.05)
