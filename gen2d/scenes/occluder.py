"""Balls that pass behind a screen, which hides them and collides with nothing."""

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
    """The balls, the screen and the box."""

    balls: Distribution = common.count("balls", [1, 3], "number of balls in a video, each at a height of its own")
    width: float = common.size("width of the box, inside", 10.0)
    height: float = common.size("height of the box, inside", 8.0)
    walls: bool = option(True, bool, "", "whether the box has walls; without them balls leave the view")
    screen_width: Distribution = option([2.5, 4.5], float, "m", "width of the screen", above=0, draw=True)
    screen_height: Distribution = option([5.0, 7.0], float, "m", "height of the screen", above=0, draw=True)
    screen_position: tuple[Distribution, ...] = common.fractions(
        "position of the screen, across and up, with room for a ball on both sides"
    )
    screen_color: tuple[Distribution, ...] = common.color("the screen", [[60, 140]] * 3)
    radius: Distribution = common.radius("each ball", [0.4, 0.7], each="balls")
    side: Distribution = option(
        {"choice": [-1, 1]}, int, "1", "side that each ball comes from; -1: left, 1: right", low=-1, high=1,
        draw=True, each="balls",
    )  # fmt: skip
    relative_position: tuple[Distribution, ...] = common.fractions(
        "position of each ball: across, 1: at the screen; up, within its own part of the screen", each="balls"
    )
    speed: Distribution = option([2, 5], float, "m/s", "speed of each ball", above=0, draw=True, each="balls")
    density: Distribution = common.density("each ball", each="balls")
    elasticity: Distribution = common.elasticity("each ball", 1.0, each="balls")
    friction: Distribution = common.friction("each ball", 0.0, each="balls")
    wall_elasticity: Distribution = common.elasticity("the box", 1.0)
    wall_friction: Distribution = common.friction("the box", 0.0)
    gravity: tuple[Distribution, ...] = common.gravity((0, 0))
    color: tuple[Distribution, ...] = common.color("each ball", each="balls")


def check(options: Options) -> None:
    """Raise ValueError if a ball does not fit behind the screen or beside it, or the screen into the box."""
    largest, most = options.radius.support[1], options.balls.support[1]
    (narrow, wide), (low, high) = options.screen_width.support, options.screen_height.support
    if not 2 * largest < narrow:
        raise ValueError(f"screen_width may be {narrow:g} m, but must hide a ball, whose radius may be {largest:g} m")
    if not 2 * largest * most < low:
        raise ValueError(
            f"screen_height may be {low:g} m, but must hide {most:g} balls above each other, whose radius may be "
            f"{largest:g} m"
        )
    if not wide + 4 * largest < options.width:
        raise ValueError(
            f"screen_width may be {wide:g} m, but must leave a ball, whose radius may be {largest:g} m, room on both "
            f"sides in a width of {options.width:g} m"
        )
    if not high <= options.height:
        raise ValueError(f"screen_height may be {high:g} m, but must be {options.height:g} m, the box's, or less")


def layout(options: Options) -> Layout:
    """The balls, then floor, right wall, ceiling, left wall if there are walls, then the screen."""
    largest = options.radius.support[1]
    box = (SlotGroup("segment", 4, STATIC),) if options.walls else ()
    screen = SlotGroup("polygon", 1, STATIC, vertices=4, layer=2, collides=False)
    groups = (SlotGroup("circle", int(options.balls.support[1])), *box, screen)
    return Layout(groups, (0.0, 0.0, options.width, options.height), largest)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: balls that move towards the screen, each to its own part of it."""
    radius, side, speed = factors["radius"], factors["side"], factors["speed"]
    number, largest = jnp.arange(len(radius)), options.radius.support[1]
    present = number < factors["balls"]
    size = jnp.stack([factors["screen_width"], factors["screen_height"]])
    beside = jnp.asarray([2 * largest, 0.0])
    corner = beside + factors["screen_position"] * (jnp.asarray([options.width, options.height]) - size - 2 * beside)

    left, right = corner[0], options.width - corner[0] - size[0]  # m, between the walls and the screen
    distance = radius + factors["relative_position"][:, 0] * (jnp.where(side < 0, left, right) - 2 * radius)
    x = jnp.where(side < 0, distance, options.width - distance)
    part_height = size[1] / factors["balls"]
    y = corner[1] + number * part_height + radius + factors["relative_position"][:, 1] * (part_height - 2 * radius)
    velocity = jnp.stack([-side * speed, jnp.zeros_like(speed)], axis=-1)
    balls = builder.discs(jnp.stack([x, y], axis=-1), radius, present, velocity=velocity, **builder.material(factors))
    parts = [balls]
    if options.walls:
        parts.append(builder.box_walls(options.width, options.height, **builder.material(factors, "wall")))
    parts.append(
        builder.boxes(
            (corner + size / 2)[None], 0.0, *size,
            kind=STATIC, layer=2, collides=False, **builder.material(factors, "screen"),
        )
    )  # fmt: skip
    divisor = jnp.where(present, speed, 1.0)
    hidden_from = (jnp.where(side < 0, left, right) - distance + radius) / divisor
    derived = {"hidden_from": hidden_from, "hidden_for": (size[0] - 2 * radius) / divisor}
    derived = {name: jnp.where(present, values, 0.0) for name, values in derived.items()}
    return SampledScene(*builder.assemble(layout(options), parts, factors["gravity"]), derived=derived)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    bodies={"balls": Bodies("circle", ("radius",), speed=("speed",), bears=("balls",))},
    derived={
        "hidden_from": Field(
            "float32", "n balls", "s", "time at which the ball is first wholly behind the screen, if nothing hits it"
        ),
        "hidden_for": Field("float32", "n balls", "s", "duration for which the ball is wholly behind the screen"),
    },
)
