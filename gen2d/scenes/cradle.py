"""Newton's cradle: some balls hit a row from the left, and as many leave it to the right."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import Array, Bodies, Distribution, Family, Field, Layout, SampledScene, SlotGroup, builder, common


@dataclasses.dataclass(frozen=True)
class Options:
    """The row of balls, seen from above, without gravity."""

    balls: Distribution = common.count("balls", [3, 6], "number of balls in the row", low=2)
    moving_balls: Distribution = common.count("balls", [1, 2], "number of balls that come from the left", high=63)
    width: float = common.size("width of the view", 18.0)
    height: float = common.size("height of the view", 4.5)
    radius: Distribution = common.radius("every ball", [0.5, 0.8])
    # Above 0, because a simultaneous impact of touching bodies does not determine their speeds.
    gap: Distribution = common.length("gap between neighbours", [0.03, 0.1], low=1e-3)
    approach_distance: Distribution = common.length("gap between moving and resting balls", [0.5, 2.0], low=1e-3)
    speed: Distribution = common.speed("the balls that move", [2.0, 5.0])
    density: Distribution = common.density("each ball", each="balls")
    elasticity: Distribution = common.elasticity("every ball", 1.0)
    friction: Distribution = common.friction("every ball", 0.0)
    color: tuple[Distribution, ...] = common.color("each ball", each="balls")


def check(options: Options) -> None:
    """Raise ValueError if all balls could move, or the row may not fit the view."""
    few, most = options.balls.support[0], options.moving_balls.support[1]
    if not most < few:
        raise ValueError(f"moving_balls may be {most:g}, but must be less than balls, which may be {few:g}")
    largest = options.radius.support[1]
    if not 2 * largest < options.height:
        raise ValueError(f"radius may be {largest:g} m, but a ball must fit a height of {options.height:g} m")
    pitch = 2 * largest + options.gap.support[1]
    row = (options.balls.support[1] + most) * pitch + 2 * options.approach_distance.support[1]
    if not row <= options.width:
        raise ValueError(
            f"width is {options.width:g} m, but must be {row:g} m or more for the largest row in its middle"
        )


def layout(options: Options) -> Layout:
    """The balls, from left to right."""
    groups = (SlotGroup("circle", int(options.balls.support[1])),)
    return Layout(groups, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: the balls at rest in the middle, the others to their left."""
    number = jnp.arange(len(factors["density"]))
    moving, radius, gap = (factors[name] for name in ("moving_balls", "radius", "gap"))
    pitch, resting = 2 * radius + gap, factors["balls"] - moving
    x = options.width / 2 + (number - moving - (resting - 1) / 2) * pitch
    x = jnp.where(number < moving, x - factors["approach_distance"] + gap, x)
    positions = jnp.stack([x, jnp.full_like(x, options.height / 2)], axis=-1)
    speed = jnp.where(number < moving, factors["speed"], 0.0)
    velocity = jnp.stack([speed, jnp.zeros_like(speed)], axis=-1)
    balls = builder.discs(positions, radius, number < factors["balls"], velocity=velocity, **builder.material(factors))
    derived = {"contact_time": factors["approach_distance"] / factors["speed"]}
    return SampledScene(*builder.assemble(layout(options), [balls], jnp.zeros(2)), derived=derived)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    bodies={"balls": Bodies("circle", ("radius",), speed=("speed",))},
    derived={
        "contact_time": Field("float32", "n", "s", "time of the first contact between a moving and a resting ball")
    },
)
