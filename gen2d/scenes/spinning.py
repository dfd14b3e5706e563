"""Balls that go to the right with a spin, each on a floor of its own; with enough back-spin they come back.

A ball slides until it rolls, and then has the speed (2 v - r w) / 3, whatever the friction: about a point of the floor
its angular momentum stays the same.
"""

import dataclasses

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
    discs,
    option,
    segments,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The balls and their floors."""

    balls: Distribution = option([1, 3], int, "balls", "in a video, one above the other", low=1, high=64, draw=True)
    width: float = option(14.0, float, "m", "of the view; the floors go on beyond it", above=0, high=1000)
    storey: float = option(2.5, float, "m", "from floor to floor", above=0, high=1000)
    radius: Distribution = option([0.5, 0.9], float, "m", "of each ball", low=1e-3, draw=True, each="balls")
    density: Distribution = option(1.0, float, "kg/m^2", "of each ball", low=1e-6, high=1e6, draw=True, each="balls")
    speed: Distribution = option([2.0, 6.0], float, "m/s", "of each ball, to the right", low=0, draw=True, each="balls")
    spin: Distribution = option(
        [0.0, 20.0], float, "rad/s", "of each ball, counter-clockwise: back-spin", draw=True, each="balls"
    )
    place: Distribution = option(
        [0.1, 0.5], float, "1", "of each ball among those in view, from left to right",
        low=0, high=1, draw=True, each="balls",
    )  # fmt: skip
    friction: Distribution = option([0.1, 0.5], float, "1", "of each ball", low=0, high=100, draw=True, each="balls")
    floor_friction: Distribution = option(1.0, float, "1", "of the floors", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option([0, -9.8], float, "m/s^2", "x right, y up", parts=2, draw=True)
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of each ball", parts=3, draw=True, low=0, high=255, each="balls"
    )
    floor_color: tuple[Distribution, ...] = option(
        [150, 150, 150], int, "sRGB", "of the floors", parts=3, draw=True, low=0, high=255
    )


def check(options: Options) -> None:
    """ValueError where a ball may not fit its storey."""
    largest = options.radius.support[1]
    if not 2 * largest < min(options.storey, options.width):
        raise ValueError(
            f"radius may be {largest:g} m, but a ball must fit a storey of {options.width:g} x {options.storey:g} m"
        )


def layout(options: Options) -> Layout:
    """The balls, and as many floors, each from the lowest on."""
    most = int(options.balls.support[1])
    runs = SlotGroup("circle", most), SlotGroup("segment", most, STATIC)
    return Layout(runs, (0.0, 0.0, options.width, most * options.storey), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: each ball on its floor, at its speed and spin."""
    radius, most = factors["radius"], len(factors["radius"])
    present, floor = jnp.arange(most) < factors["balls"], options.storey * jnp.arange(most)
    x = radius + factors["place"] * (options.width - 2 * radius)
    balls = discs(
        jnp.stack([x, floor + radius], 1), radius, present,
        velocity=jnp.stack([factors["speed"], jnp.zeros(most)], 1),
        **{name: factors[name] for name in ("density", "spin", "friction", "color")},
    )  # fmt: skip
    # A ball that leaves the view is far away when it comes to the end of its floor.
    left, right = (jnp.stack([jnp.full(most, end * options.width), floor], 1) for end in (-9.0, 10.0))
    floors = segments(left, right, present, friction=factors["floor_friction"], color=factors["floor_color"])
    return SampledScene(*assemble(layout(options), [balls, floors], factors["gravity"]))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
