"""Balls in a closed box, with or without gravity."""

import dataclasses

import jax
import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Distribution,
    Family,
    Layout,
    SampledScene,
    SlotGroup,
    assemble,
    box_walls,
    discs,
    option,
    place,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random, and the box."""

    balls: Distribution = option([3, 8], int, "balls", "in a video", low=1, high=64, draw=True)
    width: float = option(10.0, float, "m", "of the box, inside", above=0, high=1000)
    height: float = option(10.0, float, "m", "of the box, inside", above=0, high=1000)
    radius: Distribution = option([0.5, 1.0], float, "m", "of each ball", low=1e-3, draw=True, each="balls")
    density: Distribution = option(1.0, float, "kg/m^2", "of each ball", low=1e-6, high=1e6, draw=True, each="balls")
    velocity: tuple[Distribution, ...] = option(
        [{"normal": [0, 3]}, {"normal": [0, 3]}], float, "m/s", "of each ball at the start",
        parts=2, draw=True, each="balls",
    )  # fmt: skip
    spin: Distribution = option(0.0, float, "rad/s", "of each ball at the start", draw=True, each="balls")
    elasticity: Distribution = option(0.9, float, "1", "of each ball", low=0, high=1, draw=True, each="balls")
    friction: Distribution = option(0.2, float, "1", "of each ball", low=0, high=100, draw=True, each="balls")
    wall_elasticity: Distribution = option(0.9, float, "1", "of the box", low=0, high=1, draw=True)
    wall_friction: Distribution = option(0.2, float, "1", "of the box", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option(
        [0, -9.8], float, "m/s^2", "x right, y up; the same for a whole video", parts=2, draw=True
    )
    color: tuple[Distribution, ...] = option(
        [[40, 254]] * 3, int, "sRGB", "of each ball", parts=3, draw=True, low=0, high=255, each="balls"
    )


def check(options: Options) -> None:
    """ValueError where the box cannot hold a ball."""
    largest = options.radius.support[1]
    if not 2 * largest < min(options.width, options.height):
        raise ValueError(
            f"radius may be {largest:g} m, but a ball must fit a box of {options.width:g} x {options.height:g} m"
        )


def layout(options: Options) -> Layout:
    """The balls, then floor, right wall, ceiling, left wall."""
    runs = SlotGroup("circle", int(options.balls.support[1])), SlotGroup("segment", 4, STATIC)
    return Layout(runs, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: balls at random places that do not overlap."""
    radius, box = factors["radius"], jnp.asarray([options.width, options.height])
    present = jnp.arange(len(radius)) < factors["balls"]
    places, rejected, fits = place(jax.random.fold_in(key, 0), radius, present, jnp.zeros(2), box)
    material = {name: factors[name] for name in ("density", "velocity", "spin", "elasticity", "friction", "color")}
    walls = box_walls(
        options.width, options.height, elasticity=factors["wall_elasticity"], friction=factors["wall_friction"]
    )
    parts = [discs(places, radius, present, **material), walls]
    return SampledScene(*assemble(layout(options), parts, factors["gravity"]), rejected, fits)


FAMILY = Family(
    options=Options, layout=layout, sample=sample, check=check, crowded_by=("balls", "radius", "width", "height")
)
