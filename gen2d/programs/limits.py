"""Limits of the solver that a config exceeds: masses that rest on far lighter ones, and speeds for the step.

A body that comes to rest on two of a part 1 / r of its mass, one on the other, sinks in by up to 2 r g h^2 in steps of
h s, as the load takes many steps to arrive, and rises again. A body that several others hit in one step may overlap
them by about its displacement in it. Both depend on numbers of the config alone, and are compared with the size of the
bodies.
"""

import dataclasses
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

from gen2d.config.config import Config
from gen2d.config.contracts import Bodies
from gen2d.config.distributions import Distribution
from gen2d.config.sections import PhysicsOptions
from gen2d.physics.simulate import substeps

SAFE_SINKING = 0.02  # over the least size of the lighter body: less than a pixel in most frames
SAFE_DISPLACEMENT = 0.5  # in a step, over the least radius
CRUSHING = {"extreme_mass_ratios": True, "relax_iterations": None}  # options for bodies that heavy ones crush
RARELY_CRUSHED = 10.0  # times the mass
DEVIATIONS = 4.0  # of a normal distribution, which has no largest value


@dataclasses.dataclass(frozen=True)
class _Extremes:
    """Ranges of the numbers of bodies of one kind."""

    mass: tuple[float, float]  # kg
    per_video: frozenset[str]  # options that all bodies of a video share
    radius: float  # m, the least: half the shorter side of a box
    speed: float  # m/s, the largest at the start


def exceeded_limits(config: Config) -> list[str]:
    """A sentence for each limit of the solver that videos of the config may exceed, with the number that is safe."""
    options, family = config.scene.options, config.scene.contract
    kinds = {name: _extremes(options, bodies) for name, bodies in family.bodies.items()}
    gravity = math.hypot(*(_largest(part) for part in _parts(getattr(options, "gravity", ()))))
    _, bottom, _, top = family.layout(options).bounds
    fall = 2 * gravity * float(top - bottom)
    configs = dict.fromkeys([config, *(config.of_split(split.name) for split in config.splits)])
    exceeded = dict[str, tuple[float, str]]()  # by kind of limit: the worst, over what is safe, and its sentence
    for physics in dict.fromkeys(each.physics for each in configs):
        steps = substeps(config.video.fps, physics.substeps, physics.max_step)
        step = 1 / (config.video.fps * steps)
        masses = _of_masses(options, family.bodies, kinds, gravity, physics, step)
        speeds = _of_speeds(family.bodies, kinds, fall, step)
        for kind, found in (("mass", masses), ("speed", speeds)):
            exceeded[kind] = max([exceeded.get(kind, (1.0, "")), *found], key=lambda each: each[0])
    return [sentence for _, sentence in exceeded.values() if sentence]


def sinking(ratio: float, gravity: float, step: float) -> float:
    """Largest depth in m to which a body sinks into a tower of 1 / ratio of its mass each, in steps of so many s."""
    return 2 * ratio * gravity * step**2


def safe_ratio(depth: float, gravity: float, step: float) -> float:
    """Largest mass ratio at which a body sinks in by at most `depth` m; below 1 if equal ones may sink in deeper."""
    return depth / sinking(1.0, gravity, step)


def _of_masses(
    options: Any,
    bodies: Mapping[str, Bodies],
    kinds: Mapping[str, _Extremes],
    gravity: float,
    physics: PhysicsOptions,
    step: float,
) -> Iterator[tuple[float, str]]:
    """For each two kinds of bodies, how far their mass ratio may be beyond the safe one, and the sentence."""
    for lower, upper in itertools.product(bodies, bodies):
        if upper not in bodies[lower].bears or not gravity:
            continue
        light, heavy = kinds[lower], kinds[upper]
        ratio = _largest_ratio(options, (bodies[lower], light), (bodies[upper], heavy))
        depth = SAFE_SINKING * 2 * light.radius
        safe = safe_ratio(depth, gravity, step)
        names = dict.fromkeys([*_names(bodies[upper]), *_names(bodies[lower])])
        bound = f"mass ratios up to {safe:.4g} are safe" if safe >= 1 else "not even equal masses are safe"
        bound += f", as the heavier sinks in by {100 * SAFE_SINKING:g} % of the other's size"
        if safe > 0:
            bound += f"; physics.max_step={_below(step * math.sqrt(safe / ratio)):g} or less is short enough"
        off = [f"physics.{name}={json.dumps(on)}" for name, on in CRUSHING.items() if getattr(physics, name) != on]
        if off and ratio > RARELY_CRUSHED:
            bound += f"; with {' and '.join(off)}, fewer heavy bodies go through light ones"
        yield (
            ratio / safe if safe > 0 else math.inf,
            f"{' and '.join(f'scene.{name}' for name in names)} allow {upper} of {heavy.mass[1]:.3g} kg on {lower} "
            f"of {light.mass[0]:.3g} kg, a mass ratio of {ratio:.3g}: in steps of {step:.3g} s, {bound}",
        )


def _of_speeds(
    bodies: Mapping[str, Bodies], kinds: Mapping[str, _Extremes], fall: float, step: float
) -> Iterator[tuple[float, str]]:
    """For each kind of bodies, how far their displacement may be beyond the safe one, and the sentence."""
    for name, kind in kinds.items():
        smallest = min(kinds, key=lambda each: kinds[each].radius)
        safe, speed = SAFE_DISPLACEMENT * kinds[smallest].radius, math.sqrt(kind.speed**2 + fall)
        if not speed:
            continue
        causes = [f"scene.{option}" for option in bodies[name].speed] + ["scene.gravity"] * (fall > 0)
        yield (
            speed * step / safe if safe > 0 else math.inf,
            f"{' and '.join(causes)} allow {name} of {speed:.3g} m/s, which move by {speed * step:.3g} m in a step of "
            f"{step:.3g} s: up to {safe:.3g} m, half of the least radius of the {smallest}, is safe, as a body that is "
            "hit from several sides in a step may overlap others by as much; "
            f"physics.max_step={_below(safe / speed):g} or less is short enough",
        )


def _below(value: float) -> float:
    """Largest number of two digits that is not above a positive one."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / unit) * unit


def _parts(value: Any) -> tuple[Distribution, ...]:
    """Distributions of an option with one or several."""
    return value if isinstance(value, tuple) else (value,)


def _largest(distribution: Distribution) -> float:
    """Largest magnitude of a value."""
    return max(map(abs, _range(distribution)))


def _range(distribution: Distribution) -> tuple[float, float]:
    """Least and largest value; of a normal distribution, those within four standard deviations."""
    if distribution.kind == "mixture":
        ranges = [_range(part) for part in distribution.parts]
        return min(low for low, _ in ranges), max(high for _, high in ranges)
    low, high = distribution.support
    if distribution.kind == "normal":
        mean, deviation = distribution.numbers[:2]
        low, high = max(low, mean - DEVIATIONS * deviation), min(high, mean + DEVIATIONS * deviation)
    return float(low), float(high)


def _names(bodies: Bodies) -> tuple[str, ...]:
    """Options on which the masses depend."""
    return bodies.density, *bodies.size


def _extremes(options: Any, bodies: Bodies) -> _Extremes:
    lengths = [_range(part) for name in bodies.size for part in _parts(getattr(options, name))]
    density = _density(options, bodies)
    per_video = frozenset(name for name in _names(bodies) if not _each(options, name))
    radius = lengths[0][0] if bodies.shape != "box" else min(low for low, _ in lengths) / 2
    masses = [density[end] * _area(bodies.shape, [length[end] for length in lengths]) for end in (0, 1)]
    speeds = [_largest(part) for name in bodies.speed for part in _parts(getattr(options, name))]
    return _Extremes((masses[0], masses[1]), per_video, max(radius, 0.0), math.hypot(*speeds))


def _density(options: Any, bodies: Bodies) -> tuple[float, float]:
    lows, highs = zip(*map(_range, _parts(getattr(options, bodies.density))), strict=True)
    return min(lows), max(highs)


def _each(options: Any, name: str) -> str:
    (field,) = (field for field in dataclasses.fields(options) if field.name == name)
    return field.metadata["option"].each


def _area(shape: str, lengths: list[float]) -> float:
    match shape:
        case "circle":
            return math.pi * lengths[0] ** 2
        case "capsule":
            return math.pi * lengths[0] ** 2 + 4 * lengths[0] * lengths[1]
        case _:
            return lengths[0] * lengths[1]


def _largest_ratio(options: Any, lower: tuple[Bodies, _Extremes], upper: tuple[Bodies, _Extremes]) -> float:
    """Largest mass of an upper body over that of a lower one in the same video."""
    (light, low), (heavy, high) = lower, upper
    if light is heavy and low.per_video == frozenset(_names(light)):
        return 1.0
    ratio = high.mass[1] / low.mass[0] if low.mass[0] > 0 else math.inf
    if light.density == heavy.density and light.density in low.per_video:
        least, most = _density(options, light)
        ratio *= least / most
    return ratio
