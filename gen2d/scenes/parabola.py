"""A thrown ball: its way is a parabola, as nothing is in its way.

With the numbers of configs/phyworld_parabola.yaml it is a scene of the study 'How Far is Video Generation from World
Model' (Kang et al., arXiv 2411.02385).
"""

import dataclasses

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
    """The ball, how it is thrown, and the view."""

    width: float = option(10.0, float, "m", "of the view", above=0, high=1000)
    height: float = option(10.0, float, "m", "of the view", above=0, high=1000)
    radius: Distribution = option([0.7, 1.4], float, "m", "of the ball", low=1e-3, draw=True)
    density: Distribution = option(1.0, float, "kg/m^2", "of the ball", low=1e-6, high=1e6, draw=True)
    speed: Distribution = option([1.0, 4.0], float, "m/s", "at which it is thrown", low=0, draw=True)
    angle: Distribution = option(0.0, float, "rad", "at which it is thrown; 0: to the right, above: upwards", draw=True)
    place: Distribution = option(
        [0, 1], float, "1", "of the start among those possible, from left to right", draw=True, low=0, high=1
    )
    drop: Distribution = option(
        [0.5, 1.5], float, "m", "from the upper side of the view to the top of the ball at the start", low=0, draw=True
    )
    seconds: float = option(2.4, float, "s", "for which it passes neither side, where there is room for that", low=0)
    entry: float = option(0.5, float, "m", "from the side that it comes from, at most, where there is not", low=0)
    gravity: tuple[Distribution, ...] = option([0, -2.5], float, "m/s^2", "x right, y up", parts=2, draw=True)
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of the ball", parts=3, draw=True, low=0, high=255
    )


def check(options: Options) -> None:
    """ValueError where the ball may start outside of the view."""
    largest, drop = options.radius.support[1], options.drop.support[1]
    if not 2 * largest < options.width:
        raise ValueError(f"radius may be {largest:g} m, but a ball must fit a view {options.width:g} m wide")
    if not 2 * largest + drop <= options.height:
        raise ValueError(
            f"drop may be {drop:g} m, but a ball with a radius of {largest:g} m must start in a view "
            f"{options.height:g} m high"
        )


def layout(options: Options) -> Layout:
    """The ball."""
    return Layout((SlotGroup("circle", 1),), (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: the ball where it stays in view long enough, if there is such a place."""
    radius, angle = factors["radius"], factors["angle"]
    velocity = factors["speed"] * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    # Its way to the side is that of a ball without gravity, which is exact where gravity points down.
    x = start_position(factors["place"], radius, options.width - radius, options.seconds * velocity[0], options.entry)
    start = jnp.stack([x, options.height - radius - factors["drop"]])
    ball = discs(
        start[None], radius, density=factors["density"], velocity=velocity, elasticity=1.0, color=factors["color"]
    )
    return SampledScene(*assemble(layout(options), [ball], factors["gravity"]))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
