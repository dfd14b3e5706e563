"""Dominoes in a row; a ball pushes the first, or it begins to fall by itself."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Distribution,
    Family,
    Layout,
    SampledScene,
    SlotGroup,
    assemble,
    boxes,
    discs,
    option,
    segments,
)

FAR = 2.0  # the floor's length, over the view's width


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random."""

    dominoes: Distribution = option([6, 10], int, "dominoes", "in a row", low=1, high=64, draw=True)
    height: Distribution = option([1.2, 1.8], float, "m", "of the dominoes", low=1e-2, high=100, draw=True)
    thickness: Distribution = option([0.15, 0.25], float, "m", "of the dominoes", low=1e-3, high=100, draw=True)
    gap: Distribution = option([0.4, 0.8], float, "m", "between two dominoes", low=2e-4, high=100, draw=True)
    density: Distribution = option(1.0, float, "kg/m^2", "of the dominoes", low=1e-6, high=1e6, draw=True)
    elasticity: Distribution = option(0.0, float, "1", "of the dominoes and the ball", low=0, high=1, draw=True)
    friction: Distribution = option([0.4, 0.6], float, "1", "of the dominoes and the ball", low=0, high=100, draw=True)
    floor_friction: Distribution = option(1.0, float, "1", "of the floor", low=0, high=100, draw=True)
    radius: Distribution = option([0.2, 0.3], float, "m", "of the ball", low=1e-3, high=100, draw=True)
    aim: Distribution = option(
        [0.75, 0.95], float, "1", "height of the ball at the start, over that of a domino", low=0, high=1, draw=True
    )
    way: Distribution = option(
        [0.2, 0.6], float, "m", "from the ball to the first domino", low=1e-3, high=100, draw=True
    )
    speed: Distribution = option([2.0, 4.0], float, "m/s", "of the ball", low=0, high=1000, draw=True)
    spin: Distribution = option(
        0.0, float, "rad/s", "of the first domino at the start, about its right foot", draw=True
    )
    gravity: tuple[Distribution, ...] = option([0, -9.8], float, "m/s^2", "x right, y up", parts=2, draw=True)
    ball_color: tuple[Distribution, ...] = option(
        [254, 254, 254], int, "sRGB", "of the ball", parts=3, draw=True, low=0, high=255
    )
    color: tuple[Distribution, ...] = option(
        [[60, 254]] * 3, int, "sRGB", "of each domino", parts=3, draw=True, low=0, high=255, each="dominoes"
    )


def check(options: Options) -> None:
    """ValueError where the ball would begin in the floor."""
    lowest = options.aim.support[0] * options.height.support[0]
    if not options.radius.support[1] <= lowest:
        raise ValueError(
            f"radius may be {options.radius.support[1]:g} m, but the ball's centre may be as low as {lowest:g} m (aim "
            "times height)"
        )


def layout(options: Options) -> Layout:
    """The floor, the ball, then the dominoes from left to right."""
    most = int(options.dominoes.support[1])
    ends = {name: getattr(options, name).support[1] for name in ("height", "thickness", "gap", "radius", "way", "aim")}
    row = most * ends["thickness"] + (most - 1) * ends["gap"]
    width = 2 * ends["radius"] + ends["way"] + row + ends["height"]  # the last one's fall
    runs = SlotGroup("segment", 1, STATIC), SlotGroup("circle", 1), SlotGroup("polygon", most, vertices=4)
    top = max(1.2 * ends["height"], ends["aim"] * ends["height"] + ends["radius"])
    reach = max((ends["height"] ** 2 + ends["thickness"] ** 2) ** 0.5 / 2, ends["radius"])
    return Layout(runs, (0.0, 0.0, width, top), reach)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: ball, row and the last one's fall are in the middle of the view."""
    layers = layout(options)
    count, most = factors["dominoes"], int(options.dominoes.support[1])
    height, thickness, gap, radius = (factors[name] for name in ("height", "thickness", "gap", "radius"))
    run_up, numbers = 2 * radius + factors["way"], jnp.arange(most)
    length = run_up + count * thickness + (count - 1) * gap + height
    first = (layers.bounds[2] - length) / 2 + run_up
    x = first + thickness / 2 + numbers * (thickness + gap)
    places = jnp.stack([x, jnp.full(most, 1.0) * height / 2], -1)
    tips = numbers == 0
    turning = factors["spin"] * jnp.stack([-height, -thickness]) / 2  # its centre is up and left of its right foot
    material = {name: factors[name] for name in ("density", "elasticity", "friction")}
    row = boxes(
        places, 0.0, thickness, height, numbers < count, velocity=tips[:, None] * turning, spin=tips * factors["spin"],
        color=factors["color"], **material,
    )  # fmt: skip
    ball = discs(
        jnp.stack([first - factors["way"] - radius, factors["aim"] * height])[None], radius,
        velocity=jnp.stack([factors["speed"], jnp.zeros(())]), color=factors["ball_color"], **material,
    )  # fmt: skip
    wide = FAR * layers.bounds[2]
    floor = segments([(-wide, 0.0)], [(wide, 0.0)], friction=factors["floor_friction"])
    return SampledScene(*assemble(layers, [floor, ball, row], factors["gravity"]))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
