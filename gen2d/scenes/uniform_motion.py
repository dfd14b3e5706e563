"""One ball that crosses the view at constant velocity, without gravity or obstacles.

With the values of configs/phyworld_uniform_motion.yaml it is a scene of the study 'How Far is Video Generation from
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
    builder,
    common,
    option,
    start_position,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The ball, and the view that it crosses."""

    width: float = common.size("width of the view", 10.0)
    height: float = common.size("height of the view", 10.0)
    radius: Distribution = common.radius("the ball", [0.7, 1.4])
    density: Distribution = common.density("the ball")
    speed: Distribution = common.speed("the ball", [1.0, 4.0])
    direction: Distribution = common.angle("direction; 0: to the right", {"choice": [0, math.pi]})
    relative_position: tuple[Distribution, ...] = common.position("the start")
    duration: float = option(2.4, float, "s", "time for which the ball stays in view, where there is room", low=0)
    entry_distance: float = option(
        0.5, float, "m", "largest distance of the start from the side, if there is no such room", low=0
    )
    margin: float = option(0.5, float, "m", "smallest distance of the ball from the top and bottom at the start", low=0)
    color: tuple[Distribution, ...] = common.color("the ball")


def check(options: Options) -> None:
    """Raise ValueError if the ball may be larger than the view."""
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
    """One video's scene and initial state: the ball where it stays in view long enough, if such a position exists."""
    radius, direction = factors["radius"], factors["direction"]
    velocity = factors["speed"] * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
    view = jnp.asarray([options.width, options.height])
    nearest = radius + jnp.asarray([0.0, options.margin])
    start = start_position(
        factors["relative_position"], nearest, view - nearest, options.duration * velocity, options.entry_distance
    )
    ball = builder.discs(start[None], radius, velocity=velocity, elasticity=1.0, **builder.material(factors))
    return SampledScene(*builder.assemble(layout(options), [ball], jnp.zeros(2)))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
