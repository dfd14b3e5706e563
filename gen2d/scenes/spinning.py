"""Balls that move to the right with a spin, each on its own floor; with enough back-spin they come back.

A ball slides until it rolls, and then has the speed (2 v - r w) / 3, regardless of friction, because its angular
momentum about a point of the floor is conserved.
"""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import STATIC, Array, Distribution, Family, Layout, SampledScene, SlotGroup, builder, common


@dataclasses.dataclass(frozen=True)
class Options:
    """The balls and their floors."""

    balls: Distribution = common.count("balls", [1, 3], "number of balls in a video, one above the other")
    width: float = common.size("width of the view; the floors go on beyond it", 14.0)
    floor_spacing: float = common.size("distance from floor to floor", 2.5)
    radius: Distribution = common.radius("each ball", [0.5, 0.9], each="balls")
    density: Distribution = common.density("each ball", each="balls")
    speed: Distribution = common.speed("each ball, to the right", [2.0, 6.0], each="balls")
    spin: Distribution = common.spin("each ball, counter-clockwise: back-spin", [0.0, 20.0], each="balls")
    relative_position: Distribution = common.fraction("position; 0: leftmost, 1: rightmost", [0.1, 0.5], each="balls")
    friction: Distribution = common.friction("each ball", [0.1, 0.5], each="balls")
    floor_friction: Distribution = common.friction("the floors", 1.0)
    gravity: tuple[Distribution, ...] = common.gravity()
    color: tuple[Distribution, ...] = common.color("each ball", each="balls")
    floor_color: tuple[Distribution, ...] = common.color("the floors", [150] * 3)


def check(options: Options) -> None:
    """Raise ValueError if a ball may not fit its storey."""
    largest = options.radius.support[1]
    if not 2 * largest < min(options.floor_spacing, options.width):
        raise ValueError(
            f"radius may be {largest:g} m, but a ball must fit a storey of {options.width:g} x "
            f"{options.floor_spacing:g} m"
        )


def layout(options: Options) -> Layout:
    """The balls, then their floors, both from the lowest up."""
    most = int(options.balls.support[1])
    groups = SlotGroup("circle", most), SlotGroup("segment", most, STATIC)
    return Layout(groups, (0.0, 0.0, options.width, most * options.floor_spacing), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: each ball on its floor, at its speed and spin."""
    radius, most = factors["radius"], len(factors["radius"])
    present, floor = jnp.arange(most) < factors["balls"], options.floor_spacing * jnp.arange(most)
    x = radius + factors["relative_position"] * (options.width - 2 * radius)
    balls = builder.discs(
        jnp.stack([x, floor + radius], 1), radius, present,
        velocity=jnp.stack([factors["speed"], jnp.zeros(most)], 1),
        spin=factors["spin"], **builder.material(factors),
    )  # fmt: skip
    # The floors are so long that balls are far out of view when they reach the ends.
    left, right = (jnp.stack([jnp.full(most, end * options.width), floor], 1) for end in (-9.0, 10.0))
    floors = builder.segments(left, right, present, **builder.material(factors, "floor"))
    return SampledScene(*builder.assemble(layout(options), [balls, floors], factors["gravity"]))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
