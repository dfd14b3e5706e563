"""Balls that pass behind a screen, which is drawn before them and which nothing touches."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Distribution,
    Family,
    Field,
    Layout,
    SampledScene,
    SlotGroup,
    assemble,
    box_walls,
    boxes,
    discs,
    option,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random, and the box."""

    balls: Distribution = option(
        [1, 3], int, "balls", "in a video, each at a height of its own", low=1, high=64, draw=True
    )
    width: float = option(10.0, float, "m", "of the box, inside", above=0, high=1000)
    height: float = option(8.0, float, "m", "of the box, inside", above=0, high=1000)
    walls: bool = option(True, bool, "", "of the box; without them balls leave the view")
    screen_width: Distribution = option([2.5, 4.5], float, "m", "of the screen", above=0, draw=True)
    screen_height: Distribution = option([5.0, 7.0], float, "m", "of the screen", above=0, draw=True)
    screen_place: tuple[Distribution, ...] = option(
        [[0, 1]] * 2, float, "1", "of the screen: across, 0 as far left as leaves room for a ball, 1 as far right; "
        "up, 0 lowest, 1 highest",
        parts=2, low=0, high=1, draw=True,
    )  # fmt: skip
    screen_color: tuple[Distribution, ...] = option(
        [[60, 140]] * 3, int, "sRGB", "of the screen", parts=3, draw=True, low=0, high=255
    )
    radius: Distribution = option([0.4, 0.7], float, "m", "of each ball", low=1e-3, draw=True, each="balls")
    side: Distribution = option(
        {"choice": [-1, 1]}, int, "1", "where each ball comes from: -1 left, 1 right", low=-1, high=1,
        draw=True, each="balls",
    )  # fmt: skip
    place: tuple[Distribution, ...] = option(
        [[0, 1]] * 2, float, "1", "of each ball at the start: across, 0 at the side, 1 at the screen; "
        "up, 0 lowest in its part of the screen's height, 1 highest", parts=2, low=0, high=1, draw=True, each="balls",
    )  # fmt: skip
    speed: Distribution = option(
        [2, 5], float, "m/s", "of each ball, towards the screen", above=0, draw=True, each="balls"
    )
    density: Distribution = option(1.0, float, "kg/m^2", "of each ball", low=1e-6, high=1e6, draw=True, each="balls")
    elasticity: Distribution = option(1.0, float, "1", "of each ball", low=0, high=1, draw=True, each="balls")
    friction: Distribution = option(0.0, float, "1", "of each ball", low=0, high=100, draw=True, each="balls")
    wall_elasticity: Distribution = option(1.0, float, "1", "of the box", low=0, high=1, draw=True)
    wall_friction: Distribution = option(0.0, float, "1", "of the box", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option(
        [0, 0], float, "m/s^2", "x right, y up; the same for a whole video", parts=2, draw=True
    )
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of each ball", parts=3, draw=True, low=0, high=255, each="balls"
    )


def check(options: Options) -> None:
    """ValueError where a ball does not fit behind the screen or beside it, or the screen into the box."""
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
    runs = (SlotGroup("circle", int(options.balls.support[1])), *box, screen)
    return Layout(runs, (0.0, 0.0, options.width, options.height), largest)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: balls on their way to the screen, each in its own part of the screen's height."""
    radius, side, speed = factors["radius"], factors["side"], factors["speed"]
    number, largest = jnp.arange(len(radius)), options.radius.support[1]
    present = number < factors["balls"]
    size = jnp.stack([factors["screen_width"], factors["screen_height"]])
    beside = jnp.asarray([2 * largest, 0.0])
    corner = beside + factors["screen_place"] * (jnp.asarray([options.width, options.height]) - size - 2 * beside)

    left, right = corner[0], options.width - corner[0] - size[0]  # m, between the walls and the screen
    across = radius + factors["place"][:, 0] * (jnp.where(side < 0, left, right) - 2 * radius)
    x = jnp.where(side < 0, across, options.width - across)
    part = size[1] / factors["balls"]
    y = corner[1] + number * part + radius + factors["place"][:, 1] * (part - 2 * radius)
    velocity = jnp.stack([-side * speed, jnp.zeros_like(speed)], axis=-1)
    material = {name: factors[name] for name in ("density", "elasticity", "friction", "color")}
    balls = discs(jnp.stack([x, y], axis=-1), radius, present, velocity=velocity, **material)
    box = {"elasticity": factors["wall_elasticity"], "friction": factors["wall_friction"]}
    walls = [box_walls(options.width, options.height, **box)] if options.walls else []
    screen = boxes(
        (corner + size / 2)[None], 0.0, *size, kind=STATIC, layer=2, collides=False, color=factors["screen_color"]
    )
    there = jnp.where(present, speed, 1.0)
    hidden_from = (jnp.where(side < 0, left, right) - across + radius) / there
    derived = {"hidden_from": hidden_from, "hidden_for": (size[0] - 2 * radius) / there}
    derived = {name: jnp.where(present, values, 0.0) for name, values in derived.items()}
    return SampledScene(*assemble(layout(options), [balls, *walls, screen], factors["gravity"]), derived=derived)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    derived={
        "hidden_from": Field(
            "float32", "n balls", "s", "when the ball is first wholly behind the screen, if nothing hits it"
        ),
        "hidden_for": Field("float32", "n balls", "s", "how long it then is"),
    },
)
