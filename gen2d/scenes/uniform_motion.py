"""One ball that crosses the view at a constant velocity: nothing pulls at it, nothing is in its way.

With the numbers of configs/phyworld_uniform_motion.yaml it is a scene of the study 'How Far is Video Generation from
World Model' (Kang et al., arXiv 2411.02385).
"""

import dataclasses
import math

import jax.numpy as jnp

from gen2d.plugin import (
    Array,
    Distribution,
    Family,
    Layout,
    SampledScene,
    SlotGroup,
    assemble,
    discs,
    option,
    start_position,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The ball, and the view that it crosses."""

    width: float = option(10.0, float, "m", "of the view", above=0, high=1000)
    height: float = option(10.0, float, "m", "of the view", above=0, high=1000)
    radius: Distribution = option([0.7, 1.4], float, "m", "of the ball", low=1e-3, draw=True)
    density: Distribution = option(1.0, float, "kg/m^2", "of the ball", low=1e-6, high=1e6, draw=True)
    speed: Distribution = option([1.0, 4.0], float, "m/s", "of the ball", low=0, draw=True)
    direction: Distribution = option(
        {"choice": [0, math.pi]}, float, "rad", "in which it moves, counter-clockwise; 0: to the right", draw=True
    )
    place: tuple[Distribution, ...] = option(
        [[0, 1], [0, 1]], float, "1", "of the start among those possible; 0, 0 is the lowest and leftmost",
        parts=2, draw=True, low=0, high=1,
    )  # fmt: skip
    seconds: float = option(2.4, float, "s", "for which it stays in view, where there is room for that", low=0)
    entry: float = option(0.5, float, "m", "from the side that it comes from, at most, where there is not", low=0)
    margin: float = option(0.5, float, "m", "above and below the ball at the start, at least", low=0)
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of the ball", parts=3, draw=True, low=0, high=255
    )


def check(options: Options) -> None:
    """ValueError where the ball may be larger than the view."""
    largest = options.radius.support[1]
    if not (2 * largest < options.width and 2 * (largest + options.margin) < options.height):
        raise ValueError(
            f"radius may be {largest:g} m, but a ball must fit a view of {options.width:g} x {options.height:g} m, "
            f"with a margin of {options.margin:g} m above and below"
        )


def layout(options: Options) -> Layout:
    """The ball."""
    return Layout((SlotGroup("circle", 1),), (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: the ball where it stays in view long enough, if there is such a place."""
    radius, direction = factors["radius"], factors["direction"]
    velocity = factors["speed"] * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
    room = jnp.asarray([options.width, options.height])
    nearest = radius + jnp.asarray([0.0, options.margin])
    start = start_position(factors["place"], nearest, room - nearest, options.seconds * velocity, options.entry)
    ball = discs(
        start[None], radius, density=factors["density"], velocity=velocity, elasticity=1.0, color=factors["color"]
    )
    return SampledScene(*assemble(layout(options), [ball], jnp.zeros(2)))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
