"""Balls in a closed box, with or without gravity."""

import dataclasses

import jax
import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Bodies,
    Distribution,
    Family,
    Layout,
    SampledScene,
    SlotGroup,
    builder,
    common,
    option,
    place,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The balls and their box."""

    balls: Distribution = common.count("balls", [3, 8])
    width: float = common.size("width of the box, inside", 10.0)
    height: float = common.size("height of the box, inside", 10.0)
    radius: Distribution = common.radius("each ball", [0.5, 1.0], each="balls")
    density: Distribution = common.density("each ball", each="balls")
    velocity: tuple[Distribution, ...] = option(
        [{"normal": [0, 3]}, {"normal": [0, 3]}], float, "m/s", "velocity of each ball at the start",
        parts=2, draw=True, each="balls",
    )  # fmt: skip
    spin: Distribution = common.spin("each ball at the start", each="balls")
    elasticity: Distribution = common.elasticity("each ball", 0.9, each="balls")
    friction: Distribution = common.friction("each ball", 0.2, each="balls")
    wall_elasticity: Distribution = common.elasticity("the box", 0.9)
    wall_friction: Distribution = common.friction("the box", 0.2)
    gravity: tuple[Distribution, ...] = common.gravity()
    color: tuple[Distribution, ...] = common.color("each ball", [[40, 254]] * 3, each="balls")


def check(options: Options) -> None:
    """Raise ValueError if the box cannot hold a ball."""
    largest = options.radius.support[1]
    if not 2 * largest < min(options.width, options.height):
        raise ValueError(
            f"radius may be {largest:g} m, but a ball must fit a box of {options.width:g} x {options.height:g} m"
        )


def layout(options: Options) -> Layout:
    """The balls, then floor, right wall, ceiling, left wall."""
    groups = SlotGroup("circle", int(options.balls.support[1])), SlotGroup("segment", 4, STATIC)
    return Layout(groups, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: balls at random positions without overlap."""
    radius, box = factors["radius"], jnp.asarray([options.width, options.height])
    present = jnp.arange(len(radius)) < factors["balls"]
    positions, rejected, fits = place(jax.random.fold_in(key, 0), radius, present, jnp.zeros(2), box)
    balls = builder.discs(
        positions, radius, present, velocity=factors["velocity"], spin=factors["spin"], **builder.material(factors)
    )
    walls = builder.box_walls(options.width, options.height, **builder.material(factors, "wall"))
    return SampledScene(*builder.assemble(layout(options), [balls, walls], factors["gravity"]), rejected, fits)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    crowded_by=("balls", "radius", "width", "height"),
    bodies={"balls": Bodies("circle", ("radius",), speed=("velocity",), bears=("balls",))},
)
