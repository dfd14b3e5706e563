"""A thrown ball, whose path is a parabola, as it hits nothing.

With the values of configs/phyworld_parabola.yaml it is a scene of the study 'How Far is Video Generation from World
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
    builder,
    common,
    option,
    start_position,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The ball, its throw and the view."""

    width: float = common.size("width of the view", 10.0)
    height: float = common.size("height of the view", 10.0)
    radius: Distribution = common.radius("the ball", [0.7, 1.4])
    density: Distribution = common.density("the ball")
    speed: Distribution = common.speed("the throw", [1.0, 4.0])
    angle: Distribution = common.angle("angle of the throw, counter-clockwise; 0: to the right", 0.0)
    relative_position: Distribution = common.fraction("position of the start among those possible, from left to right")
    top_distance: Distribution = common.length("distance of the ball's start from the upper side", [0.5, 1.5])
    duration: float = option(2.4, float, "s", "time for which the ball passes neither side, where there is room", low=0)
    entry_distance: float = option(
        0.5, float, "m", "largest distance of the start from the side, if there is no such room", low=0
    )
    gravity: tuple[Distribution, ...] = common.gravity((0, -2.5))
    color: tuple[Distribution, ...] = common.color("the ball")


def check(options: Options) -> None:
    """Raise ValueError if the ball may start outside of the view."""
    largest, drop = options.radius.support[1], options.top_distance.support[1]
    if not 2 * largest < options.width:
        raise ValueError(f"radius may be {largest:g} m, but a ball must fit a view {options.width:g} m wide")
    if not 2 * largest + drop <= options.height:
        raise ValueError(
            f"top_distance may be {drop:g} m, but a ball with a radius of {largest:g} m must start in a view "
            f"{options.height:g} m high"
        )


def layout(options: Options) -> Layout:
    """The ball."""
    return Layout((SlotGroup("circle", 1),), (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: the ball where it stays in view long enough, if such a position exists."""
    radius, angle = factors["radius"], factors["angle"]
    velocity = factors["speed"] * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    # The horizontal motion is computed without gravity, which is exact if gravity points down.
    x = start_position(
        factors["relative_position"],
        radius,
        options.width - radius,
        options.duration * velocity[0],
        options.entry_distance,
    )
    start = jnp.stack([x, options.height - radius - factors["top_distance"]])
    ball = builder.discs(start[None], radius, velocity=velocity, elasticity=1.0, **builder.material(factors))
    return SampledScene(*builder.assemble(layout(options), [ball], factors["gravity"]))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
