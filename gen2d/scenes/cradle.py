"""Balls in a row that hand on speed, as Newton's cradle does: some come from the left, as many leave to the right."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import Array, Distribution, Family, Field, Layout, SampledScene, SlotGroup, assemble, discs, option


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random, and what is shown. Nothing falls: the row is seen from above."""

    balls: Distribution = option([3, 6], int, "balls", "in a row", low=2, high=64, draw=True)
    moving: Distribution = option([1, 2], int, "balls", "that come from the left", low=1, high=63, draw=True)
    width: float = option(18.0, float, "m", "that is shown", above=0, high=1000)
    height: float = option(4.5, float, "m", "that is shown", above=0, high=1000)
    radius: Distribution = option([0.5, 0.8], float, "m", "of every ball", low=1e-3, draw=True)
    # Bodies that touch are hit all at once, and how they share the speed is then not determined.
    gap: Distribution = option([0.03, 0.1], float, "m", "between balls", low=1e-3, draw=True)
    approach: Distribution = option([0.5, 2.0], float, "m", "from those that move to the others", low=1e-3, draw=True)
    speed: Distribution = option([2.0, 5.0], float, "m/s", "of those that move", low=0, draw=True)
    density: Distribution = option(1.0, float, "kg/m^2", "of each ball", low=1e-6, high=1e6, draw=True, each="balls")
    elasticity: Distribution = option(1.0, float, "1", "of every ball", low=0, high=1, draw=True)
    friction: Distribution = option(0.0, float, "1", "of every ball", low=0, high=100, draw=True)
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of each ball", parts=3, draw=True, low=0, high=255, each="balls"
    )


def check(options: Options) -> None:
    """ValueError where all balls could move, or the row may not fit what is shown."""
    few, most = options.balls.support[0], options.moving.support[1]
    if not most < few:
        raise ValueError(f"moving may be {most:g}, but must be less than balls, which may be {few:g}")
    largest = options.radius.support[1]
    if not 2 * largest < options.height:
        raise ValueError(f"radius may be {largest:g} m, but a ball must fit a height of {options.height:g} m")
    pitch = 2 * largest + options.gap.support[1]
    row = (options.balls.support[1] + most) * pitch + 2 * options.approach.support[1]
    if not row <= options.width:
        raise ValueError(
            f"width is {options.width:g} m, but must be {row:g} m or more for the largest row in its middle"
        )


def layout(options: Options) -> Layout:
    """The balls, from left to right."""
    largest = options.radius.support[1]
    return Layout(
        (SlotGroup("circle", int(options.balls.support[1])),), (0.0, 0.0, options.width, options.height), largest
    )


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: those at rest in the middle, the others to the left of them."""
    number, moving, radius, gap = (
        jnp.arange(len(factors["density"])),
        factors["moving"],
        factors["radius"],
        factors["gap"],
    )
    pitch, resting = 2 * radius + gap, factors["balls"] - moving
    x = options.width / 2 + (number - moving - (resting - 1) / 2) * pitch
    x = jnp.where(number < moving, x - factors["approach"] + gap, x)
    places = jnp.stack([x, jnp.full_like(x, options.height / 2)], axis=-1)
    speed = jnp.where(number < moving, factors["speed"], 0.0)
    material = {name: factors[name] for name in ("density", "elasticity", "friction", "color")}
    velocity = jnp.stack([speed, jnp.zeros_like(speed)], axis=-1)
    balls = discs(places, radius, number < factors["balls"], velocity=velocity, **material)
    derived = {"contact_time": factors["approach"] / factors["speed"]}
    return SampledScene(*assemble(layout(options), [balls], jnp.zeros(2)), derived=derived)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    derived={"contact_time": Field("float32", "n", "s", "at which the first of those that move meets one at rest")},
)
