"""A ball that runs down several ramps, one after the other, from side to side."""

import dataclasses
import math

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
    box_walls,
    discs,
    option,
    segments,
)

CLEARANCE = 0.02  # m: how much more room than it needs the ball has between two ramps, at least


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random, and the box."""

    ramps: Distribution = option([3, 4], int, "ramps", "in a video", low=1, high=16, draw=True)
    width: float = option(4.0, float, "m", "of the box, inside", above=0, high=1000)
    height: float = option(6.5, float, "m", "of the box, inside", above=0, high=1000)
    slope: Distribution = option(
        [0.16, 0.3], float, "rad", "of each ramp, down from the side that it begins at", above=0, high=1.5,
        draw=True, each="ramps",
    )  # fmt: skip
    length: Distribution = option(
        [0.6, 0.78], float, "1", "of each ramp, across, over the width", low=0, high=1, draw=True, each="ramps"
    )
    radius: Distribution = option([0.16, 0.24], float, "m", "of the ball", low=1e-3, draw=True)
    place: Distribution = option(
        [0.0, 1.0], float, "1", "of the ball at the start: 0 at the side, 1 over the middle of the first ramp",
        low=0, high=1, draw=True,
    )  # fmt: skip
    drop: Distribution = option([0.0, 0.3], float, "m", "of the ball, down to the first ramp", low=0, draw=True)
    density: Distribution = option(1.0, float, "kg/m^2", "of the ball", low=1e-6, high=1e6, draw=True)
    elasticity: Distribution = option([0.2, 0.6], float, "1", "of the ball", low=0, high=1, draw=True)
    friction: Distribution = option([0.0, 0.8], float, "1", "of the ball", low=0, high=100, draw=True)
    ramp_elasticity: Distribution = option(0.7, float, "1", "of ramps and box", low=0, high=1, draw=True)
    ramp_friction: Distribution = option(0.8, float, "1", "of ramps and box", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option(
        [0, -9.8], float, "m/s^2", "x right, y up; the same for a whole video", parts=2, draw=True
    )
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of the ball", parts=3, draw=True, low=0, high=255
    )
    ramp_color: tuple[Distribution, ...] = option(
        [170] * 3, int, "sRGB", "of ramps", parts=3, draw=True, low=0, high=255
    )


def check(options: Options) -> None:
    """ValueError where the ball could miss a ramp, or not pass between two."""
    largest, (short, long) = options.radius.support[1], options.length.support
    ramps, steep = options.ramps.support[1], options.slope.support[1]
    if not short > 0.5:
        raise ValueError(f"length may be {short:g}, but must be above 0.5: each ramp must catch what leaves the last")
    if not (1 - long) * options.width > 2 * largest + CLEARANCE:
        raise ValueError(
            f"length may be {long:g}, but must leave the ball, whose radius may be {largest:g} m, room to fall"
        )
    # All but the first ramp begin as far above the end of the last one as they rise to the wall from there.
    down = (long + (ramps - 1) * (2 * long - 1)) * options.width * math.tan(steep)
    room = (options.height - headroom(options) - down) / ramps
    if not room * math.cos(steep) > 2 * largest + CLEARANCE:
        raise ValueError(
            f"slope may be {steep:g} rad, but a height of {options.height:g} m leaves {room:g} m between {ramps:g} "
            f"ramps then, too little for the ball, whose radius may be {largest:g} m"
        )


def headroom(options: Options) -> float:
    """What the ball needs above the first ramp's upper end, m."""
    largest = options.radius.support[1]
    return largest * (1 + 1 / math.cos(options.slope.support[1])) + options.drop.support[1]


def layout(options: Options) -> Layout:
    """The ball, the ramps from top to bottom, then floor, right wall, ceiling, left wall."""
    runs = (
        SlotGroup("circle", 1),
        SlotGroup("segment", int(options.ramps.support[1]), STATIC),
        SlotGroup("segment", 4, STATIC),
    )
    return Layout(runs, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: ramps as far below each other as the height allows, and the ball over the first.

    The first begins at the left wall, the next at the right one, and so on.
    """
    number = jnp.arange(len(factors["slope"]))
    present = number < factors["ramps"]
    across, rise = factors["length"] * options.width, jnp.tan(factors["slope"])
    falls = across * rise
    # The next ramp is under a ramp's lower end by `room`, and rises from there to the wall.
    rises = jnp.where(present, options.width - across, 0.0) * jnp.append(rise[1:], 0.0)
    top = options.height - headroom(options)
    room = (top - falls.sum() + rises.sum()) / factors["ramps"]
    upper = top - jnp.cumsum(falls - rises + room) + (falls - rises + room)
    left = number % 2 == 0
    begins, ends = (jnp.where(left, x, options.width - x) for x in (jnp.zeros_like(across), across))

    radius, slope = factors["radius"], factors["slope"][0]
    x = radius + 1e-3 + factors["place"] * (across[0] / 2 - radius)
    y = top - x * rise[0] + radius / jnp.cos(slope) + factors["drop"]
    material = {name: factors[name] for name in ("density", "elasticity", "friction", "color")}
    board = {"elasticity": factors["ramp_elasticity"], "friction": factors["ramp_friction"]}
    starts, stops = (jnp.stack(point, axis=-1) for point in ((begins, upper), (ends, upper - falls)))
    parts = [
        discs(jnp.stack([x, y])[None], radius, **material),
        segments(starts, stops, present, color=factors["ramp_color"], **board),
        box_walls(options.width, options.height, **board),
    ]
    return SampledScene(*assemble(layout(options), parts, factors["gravity"]))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
