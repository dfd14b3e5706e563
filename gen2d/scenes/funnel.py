"""Balls that fall through a funnel: two slopes with a gap between them."""

import dataclasses
import math

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
    segments,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random, and the box that the funnel is in."""

    balls: Distribution = option([4, 12], int, "balls", "in a video", low=1, high=64, draw=True)
    width: float = option(8.0, float, "m", "of the box, inside", above=0, high=1000)
    height: float = option(12.0, float, "m", "of the box, inside", above=0, high=1000)
    neck: float = option(3.5, float, "m", "from the floor up to the gap", above=0, high=1000)
    angle: Distribution = option(
        [0.5, 0.8], float, "rad", "of the slopes, from the horizontal", low=0, high=1.5, draw=True
    )
    gap: Distribution = option([1.0, 2.5], float, "m", "between the slopes", low=0, draw=True)
    radius: Distribution = option([0.3, 0.45], float, "m", "of each ball", low=1e-3, draw=True, each="balls")
    density: Distribution = option(1.0, float, "kg/m^2", "of each ball", low=1e-6, high=1e6, draw=True, each="balls")
    elasticity: Distribution = option([0.3, 0.8], float, "1", "of each ball", low=0, high=1, draw=True, each="balls")
    friction: Distribution = option([0.0, 0.4], float, "1", "of each ball", low=0, high=100, draw=True, each="balls")
    wall_elasticity: Distribution = option(0.7, float, "1", "of box and slopes", low=0, high=1, draw=True)
    wall_friction: Distribution = option(0.3, float, "1", "of box and slopes", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option(
        [0, -9.8], float, "m/s^2", "x right, y up; the same for a whole video", parts=2, draw=True
    )
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of each ball", parts=3, draw=True, low=0, high=255, each="balls"
    )


def check(options: Options) -> None:
    """ValueError where the slopes do not fit the box, or leave no room for a ball above them."""
    largest, (narrow, wide) = options.radius.support[1], options.gap.support
    if not wide < options.width:
        raise ValueError(f"gap may be {wide:g} m, but must be less than the width of the box, {options.width:g} m")
    if not 2 * largest < options.width:
        raise ValueError(f"radius may be {largest:g} m, but a ball must fit a box of {options.width:g} m")
    steep = options.angle.support[1]
    room = options.height - options.neck - math.tan(steep) * (options.width - narrow) / 2
    if not 2 * largest < room:
        raise ValueError(
            f"angle may be {steep:g} rad, but the slopes would leave {room:g} m of the height, too little for a ball"
        )


def layout(options: Options) -> Layout:
    """The balls, then floor, right wall, ceiling, left wall, then the left and the right slope."""
    runs = (
        SlotGroup("circle", int(options.balls.support[1])),
        SlotGroup("segment", 4, STATIC),
        SlotGroup("segment", 2, STATIC),
    )
    return Layout(runs, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: balls at rest at random places above the slopes."""
    radius, middle = factors["radius"], options.width / 2
    rim = options.neck + jnp.tan(factors["angle"]) * (middle - factors["gap"] / 2)
    present = jnp.arange(len(radius)) < factors["balls"]
    low, high = jnp.stack([jnp.zeros_like(rim), rim]), jnp.asarray([options.width, options.height])
    places, rejected, fits = place(jax.random.fold_in(key, 0), radius, present, low, high)
    material = {name: factors[name] for name in ("density", "elasticity", "friction", "color")}
    walls = {"elasticity": factors["wall_elasticity"], "friction": factors["wall_friction"]}
    upper = jnp.stack([jnp.asarray([0.0, options.width]), jnp.stack([rim, rim])], axis=-1)
    sides = middle + jnp.asarray([-0.5, 0.5]) * factors["gap"]
    lower = jnp.stack([sides, jnp.full(2, options.neck)], axis=-1)
    parts = [
        discs(places, radius, present, **material),
        box_walls(options.width, options.height, **walls),
        segments(upper, lower, **walls),
    ]
    return SampledScene(*assemble(layout(options), parts, factors["gravity"]), rejected, fits)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    crowded_by=("balls", "radius", "width", "height", "neck", "angle", "gap"),
)
