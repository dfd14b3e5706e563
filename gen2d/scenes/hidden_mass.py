"""Pairs of balls that look alike but differ in density, elasticity and friction, which only collisions reveal."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Bodies,
    Distribution,
    Family,
    Field,
    Layout,
    SampledScene,
    SlotGroup,
    builder,
    common,
    option,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The pairs of balls and their box, seen from above, without gravity.

    Lists of two hold values of the left and the right ball of each pair.
    """

    pairs: Distribution = common.count("pairs", [1, 2], "number of pairs, each in a lane of its own", high=32)
    width: float = common.size("width of the box, inside", 10.0)
    height: float = common.size("height of the box, inside", 8.0)
    radius: Distribution = common.radius("every ball", [0.5, 0.8])
    color: tuple[Distribution, ...] = common.color("every ball")
    density: tuple[Distribution, ...] = option(
        [{"log_uniform": [0.2, 5]}] * 2, float, "kg/m^2", "density of each ball", parts=2, low=1e-6, high=1e6,
        draw=True, each="pairs",
    )  # fmt: skip
    elasticity: tuple[Distribution, ...] = option(
        [[0.7, 1.0]] * 2, float, "1", "coefficient of restitution of each ball", parts=2, low=0, high=1,
        draw=True, each="pairs",
    )  # fmt: skip
    friction: tuple[Distribution, ...] = option(
        [[0.0, 0.5]] * 2, float, "1", "coefficient of friction of each ball", parts=2, low=0, high=100,
        draw=True, each="pairs",
    )  # fmt: skip
    speed: tuple[Distribution, ...] = option(
        [[1, 4]] * 2, float, "m/s", "speed of each ball", parts=2, above=0, draw=True, each="pairs"
    )
    relative_position: tuple[Distribution, ...] = common.fractions(
        "position of each ball; 0: at its wall, 1: in the middle", each="pairs"
    )
    offset: Distribution = option(
        [-0.5, 0.5], float, "1", "height of the right ball's path above the left one's, over twice the radius",
        low=-0.99, high=0.99, draw=True, each="pairs",
    )  # fmt: skip
    wall_elasticity: Distribution = common.elasticity("the box", 1.0)
    wall_friction: Distribution = common.friction("the box", 0.0)


def check(options: Options) -> None:
    """Raise ValueError if the pairs do not fit above each other, or two balls not beside each other."""
    largest, pairs = options.radius.support[1], options.pairs.support[1]
    lane = 2 * largest * (1 + max(map(abs, options.offset.support)))
    if not pairs * lane < options.height:
        raise ValueError(
            f"radius may be {largest:g} m, but a height of {options.height:g} m has no room for {pairs:g} pairs of "
            f"{lane:g} m with their offset"
        )
    if not 4 * largest < options.width:
        raise ValueError(f"radius may be {largest:g} m, but two balls must fit a width of {options.width:g} m")


def layout(options: Options) -> Layout:
    """The left and right ball of each pair in turn, then floor, right wall, ceiling, left wall."""
    groups = SlotGroup("circle", 2 * int(options.pairs.support[1])), SlotGroup("segment", 4, STATIC)
    return Layout(groups, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: each pair in its lane, a ball from the left and one from the right."""
    radius, density, pairs = factors["radius"], factors["density"], factors["pairs"]
    number, sides = jnp.arange(len(density)), jnp.asarray([1.0, -1.0])
    present = number < pairs
    # Distance in m from the ball's side of the box.
    inwards = radius + factors["relative_position"] * (options.width / 2 - 2 * radius)
    x = jnp.where(sides > 0, inwards, options.width - inwards)
    aside = factors["offset"] * 2 * radius
    y = ((number + 0.5) / pairs * options.height)[:, None] - sides * aside[:, None] / 2
    velocity = jnp.stack([factors["speed"] * sides, jnp.zeros_like(x)], axis=-1)

    def each(values: Array) -> Array:
        """Values of the balls [2 pairs, ...], from those of the pairs [pairs, 2, ...]."""
        return values.reshape(-1, *values.shape[2:])

    material = {name: each(factors[name]) for name in ("density", "elasticity", "friction")}
    balls = builder.discs(
        each(jnp.stack([x, y], axis=-1)), radius, jnp.repeat(present, 2), velocity=each(velocity),
        color=factors["color"], **material,
    )  # fmt: skip
    walls = builder.box_walls(options.width, options.height, **builder.material(factors, "wall"))
    closing, gap = factors["speed"].sum(-1), x[:, 1] - x[:, 0] - jnp.sqrt(4 * radius**2 - aside**2)
    derived = {
        "contact_time": jnp.where(present, gap / jnp.where(present, closing, 1.0), 0.0),
        "mass_ratio": jnp.where(present, density[:, 0] / jnp.where(present, density[:, 1], 1.0), 0.0),
    }
    return SampledScene(*builder.assemble(layout(options), [balls, walls], jnp.zeros(2)), derived=derived)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    bodies={"balls": Bodies("circle", ("radius",), speed=("speed",))},
    derived={
        "contact_time": Field(
            "float32", "n pairs", "s", "time at which the balls of a pair meet, if nothing else hits them before"
        ),
        "mass_ratio": Field("float32", "n pairs", "1", "mass of the left ball over that of the right one"),
    },
)
