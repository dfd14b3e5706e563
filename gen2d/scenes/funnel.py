"""Balls that fall through a funnel: two slopes with a gap between them."""

import dataclasses
import math

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
    place,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The balls, the funnel and its box."""

    balls: Distribution = common.count("balls", [4, 12])
    width: float = common.size("width of the box, inside", 8.0)
    height: float = common.size("height of the box, inside", 12.0)
    neck_height: float = common.size("height of the gap above the floor", 3.5)
    angle: Distribution = common.angle("angle of the slopes, from the horizontal", [0.5, 0.8], low=0, high=1.5)
    gap: Distribution = common.length("gap between the slopes", [1.0, 2.5])
    radius: Distribution = common.radius("each ball", [0.3, 0.45], each="balls")
    density: Distribution = common.density("each ball", each="balls")
    elasticity: Distribution = common.elasticity("each ball", [0.3, 0.8], each="balls")
    friction: Distribution = common.friction("each ball", [0.0, 0.4], each="balls")
    wall_elasticity: Distribution = common.elasticity("box and slopes", 0.7)
    wall_friction: Distribution = common.friction("box and slopes", 0.3)
    gravity: tuple[Distribution, ...] = common.gravity()
    color: tuple[Distribution, ...] = common.color("each ball", each="balls")


def check(options: Options) -> None:
    """Raise ValueError if the slopes do not fit the box, or leave no room for a ball above them."""
    largest, (narrow, wide) = options.radius.support[1], options.gap.support
    if not wide < options.width:
        raise ValueError(f"gap may be {wide:g} m, but must be less than the width of the box, {options.width:g} m")
    if not 2 * largest < options.width:
        raise ValueError(f"radius may be {largest:g} m, but a ball must fit a box of {options.width:g} m")
    steep = options.angle.support[1]
    room = options.height - options.neck_height - math.tan(steep) * (options.width - narrow) / 2
    if not 2 * largest < room:
        raise ValueError(
            f"angle may be {steep:g} rad, but the slopes would leave {room:g} m of the height, too little for a ball"
        )


def layout(options: Options) -> Layout:
    """The balls, then floor, right wall, ceiling, left wall, then the left and the right slope."""
    groups = (
        SlotGroup("circle", int(options.balls.support[1])),
        SlotGroup("segment", 4, STATIC),
        SlotGroup("segment", 2, STATIC),
    )
    return Layout(groups, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: balls at rest at random positions above the slopes."""
    radius, middle = factors["radius"], options.width / 2
    rim = options.neck_height + jnp.tan(factors["angle"]) * (middle - factors["gap"] / 2)
    present = jnp.arange(len(radius)) < factors["balls"]
    low, high = jnp.stack([jnp.zeros_like(rim), rim]), jnp.asarray([options.width, options.height])
    positions, rejected, fits = place(jax.random.fold_in(key, 0), radius, present, low, high)
    upper = jnp.stack([jnp.asarray([0.0, options.width]), jnp.stack([rim, rim])], axis=-1)
    sides = middle + jnp.asarray([-0.5, 0.5]) * factors["gap"]
    lower = jnp.stack([sides, jnp.full(2, options.neck_height)], axis=-1)
    parts = [
        builder.discs(positions, radius, present, **builder.material(factors)),
        builder.box_walls(options.width, options.height, **builder.material(factors, "wall")),
        builder.segments(upper, lower, **builder.material(factors, "wall")),
    ]
    return SampledScene(*builder.assemble(layout(options), parts, factors["gravity"]), rejected, fits)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    crowded_by=("balls", "radius", "width", "height", "neck_height", "angle", "gap"),
    bodies={"balls": Bodies("circle", ("radius",), bears=("balls",))},
)
