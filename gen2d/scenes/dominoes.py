"""Dominoes in a row; a ball pushes the first, or it begins to fall by itself."""

import dataclasses

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
    maximum,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The row of dominoes and the ball."""

    dominoes: Distribution = common.count("dominoes", [6, 10])
    height: Distribution = common.length("height of the dominoes", [1.2, 1.8], low=1e-2, high=100)
    thickness: Distribution = common.length("thickness of the dominoes", [0.15, 0.25], low=1e-3, high=100)
    gap: Distribution = common.length("gap between two dominoes", [0.4, 0.8], low=2e-4, high=100)
    density: Distribution = common.density("the dominoes and the ball")
    elasticity: Distribution = common.elasticity("the dominoes and the ball", 0.0)
    friction: Distribution = common.friction("the dominoes and the ball", [0.4, 0.6])
    floor_friction: Distribution = common.friction("the floor", 1.0)
    radius: Distribution = common.radius("the ball", [0.2, 0.3], high=100)
    ball_height: Distribution = common.fraction("height of the ball's centre, over that of a domino", [0.75, 0.95])
    ball_distance: Distribution = common.length("gap between ball and first domino", [0.2, 0.6], low=1e-3, high=100)
    speed: Distribution = common.speed("the ball", [2.0, 4.0], high=1000)
    spin: Distribution = common.spin("the first domino at the start, about its right foot")
    gravity: tuple[Distribution, ...] = common.gravity()
    ball_color: tuple[Distribution, ...] = common.color("the ball", [254, 254, 254])
    color: tuple[Distribution, ...] = common.color("each domino", [[60, 254]] * 3, each="dominoes")


def check(options: Options) -> None:
    """Raise ValueError if the ball would begin in the floor."""
    lowest = options.ball_height.support[0] * options.height.support[0]
    if not options.radius.support[1] <= lowest:
        raise ValueError(
            f"radius may be {options.radius.support[1]:g} m, but the ball's centre may be as low as {lowest:g} m "
            "(ball_height times height)"
        )


def layout(options: Options) -> Layout:
    """The floor, the ball, then the dominoes from left to right."""
    most = int(options.dominoes.support[1])
    names = ("height", "thickness", "gap", "radius", "ball_distance", "ball_height")
    height, thickness, gap, radius, ball_distance, ball_height = (getattr(options, name).support[1] for name in names)
    row = most * thickness + (most - 1) * gap
    width = 2 * radius + ball_distance + row + height  # room for the last one to fall
    groups = SlotGroup("segment", 1, STATIC), SlotGroup("circle", 1), SlotGroup("polygon", most, vertices=4)
    top = maximum(1.2 * height, ball_height * height + radius)
    reach = maximum((height**2 + thickness**2) ** 0.5 / 2, radius)
    return Layout(groups, (0.0, 0.0, width, top), reach)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: the ball, the row and room for its fall, centred in the view."""
    scene_layout = layout(options)
    count, most = factors["dominoes"], int(options.dominoes.support[1])
    height, thickness, gap, radius = (factors[name] for name in ("height", "thickness", "gap", "radius"))
    run_up, numbers = 2 * radius + factors["ball_distance"], jnp.arange(most)
    length = run_up + count * thickness + (count - 1) * gap + height
    first = (scene_layout.bounds[2] - length) / 2 + run_up
    x = first + thickness / 2 + numbers * (thickness + gap)
    positions = jnp.stack([x, jnp.full(most, 1.0) * height / 2], -1)
    is_first = numbers == 0
    # The centre is above and left of the foot about which the first domino turns.
    velocity = factors["spin"] * jnp.stack([-height, -thickness]) / 2
    row = builder.boxes(
        positions, 0.0, thickness, height, numbers < count,
        velocity=is_first[:, None] * velocity, spin=is_first * factors["spin"], **builder.material(factors),
    )  # fmt: skip
    ball = builder.discs(
        jnp.stack([first - factors["ball_distance"] - radius, factors["ball_height"] * height])[None], radius,
        velocity=jnp.stack([factors["speed"], jnp.zeros(())]),
        **builder.material(factors) | builder.material(factors, "ball"),
    )  # fmt: skip
    ground = builder.floor(scene_layout, 2.0, **builder.material(factors, "floor"))
    return SampledScene(*builder.assemble(scene_layout, [ground, ball, row], factors["gravity"]))


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    bodies={
        "dominoes": Bodies("box", ("thickness", "height"), bears=("dominoes",)),
        "ball": Bodies("circle", ("radius",), speed=("speed",)),
    },
)
