"""A ball that runs down several ramps, one after the other, from side to side."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np

from gen2d.plugin import STATIC, Array, Distribution, Family, Layout, SampledScene, SlotGroup, builder, common, option

CLEARANCE = 0.02  # m, smallest spare room for the ball between two ramps


@dataclasses.dataclass(frozen=True)
class Options:
    """The ramps, the ball and their box."""

    ramps: Distribution = common.count("ramps", [3, 4], high=16)
    width: float = common.size("width of the box, inside", 4.0)
    height: float = common.size("height of the box, inside", 6.5)
    slope: Distribution = option(
        [0.16, 0.3], float, "rad", "slope of each ramp, down from the wall that it begins at", above=0, high=1.5,
        draw=True, each="ramps",
    )  # fmt: skip
    length: Distribution = common.fraction("horizontal length of each ramp, over the width", [0.6, 0.78], each="ramps")
    radius: Distribution = common.radius("the ball", [0.16, 0.24])
    relative_position: Distribution = common.fraction("position; 0: at the wall, 1: over the first ramp's middle")
    drop_height: Distribution = common.length("height of the ball above the first ramp", [0.0, 0.3])
    density: Distribution = common.density("the ball")
    elasticity: Distribution = common.elasticity("the ball", [0.2, 0.6])
    friction: Distribution = common.friction("the ball", [0.0, 0.8])
    ramp_elasticity: Distribution = common.elasticity("ramps and box", 0.7)
    ramp_friction: Distribution = common.friction("ramps and box", 0.8)
    gravity: tuple[Distribution, ...] = common.gravity()
    color: tuple[Distribution, ...] = common.color("the ball")
    ramp_color: tuple[Distribution, ...] = common.color("ramps", [170] * 3)


def check(options: Options) -> None:
    """Raise ValueError if the ball could miss a ramp, or not pass between two."""
    largest, (short, long) = options.radius.support[1], options.length.support
    ramps, steep = options.ramps.support[1], options.slope.support[1]
    if not short > 0.5:
        raise ValueError(f"length may be {short:g}, but must be above 0.5: each ramp must catch what leaves the last")
    if not (1 - long) * options.width > 2 * largest + CLEARANCE:
        raise ValueError(
            f"length may be {long:g}, but must leave the ball, whose radius may be {largest:g} m, room to fall"
        )
    # Each ramp after the first passes `room` below the end of the previous one, and rises from there to its wall.
    down = (long + (ramps - 1) * (2 * long - 1)) * options.width * math.tan(steep)
    room = (options.height - headroom(options) - down) / ramps
    if not room * math.cos(steep) > 2 * largest + CLEARANCE:
        raise ValueError(
            f"slope may be {steep:g} rad, but a height of {options.height:g} m leaves {room:g} m between {ramps:g} "
            f"ramps then, too little for the ball, whose radius may be {largest:g} m"
        )


def headroom(options: Options) -> float:
    """Height that the ball needs above the first ramp's upper end, m."""
    largest = options.radius.support[1]
    return largest * (1 + 1 / np.cos(options.slope.support[1])) + options.drop_height.support[1]


def layout(options: Options) -> Layout:
    """The ball, the ramps from top to bottom, then floor, right wall, ceiling, left wall."""
    groups = (
        SlotGroup("circle", 1),
        SlotGroup("segment", int(options.ramps.support[1]), STATIC),
        SlotGroup("segment", 4, STATIC),
    )
    return Layout(groups, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: ramps as far apart as the height allows, and the ball above the first.

    The first begins at the left wall, the next at the right one, and so on.
    """
    number = jnp.arange(len(factors["slope"]))
    present = number < factors["ramps"]
    across, rise = factors["length"] * options.width, jnp.tan(factors["slope"])
    falls = across * rise
    # The next ramp passes `room` below a ramp's lower end, and rises from there to the wall.
    rises = jnp.where(present, options.width - across, 0.0) * jnp.append(rise[1:], 0.0)
    top = options.height - headroom(options)
    room = (top - falls.sum() + rises.sum()) / factors["ramps"]
    upper = top - jnp.cumsum(falls - rises + room) + (falls - rises + room)
    left = number % 2 == 0
    begins, ends = (jnp.where(left, x, options.width - x) for x in (jnp.zeros_like(across), across))

    radius, slope = factors["radius"], factors["slope"][0]
    x = radius + 1e-3 + factors["relative_position"] * (across[0] / 2 - radius)
    y = top - x * rise[0] + radius / jnp.cos(slope) + factors["drop_height"]
    board = {"elasticity": factors["ramp_elasticity"], "friction": factors["ramp_friction"]}
    starts, stops = (jnp.stack(point, axis=-1) for point in ((begins, upper), (ends, upper - falls)))
    parts = [
        builder.discs(jnp.stack([x, y])[None], radius, **builder.material(factors)),
        builder.segments(starts, stops, present, color=factors["ramp_color"], **board),
        builder.box_walls(options.width, options.height, **board),
    ]
    return SampledScene(*builder.assemble(layout(options), parts, factors["gravity"]))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
