"""A ball that rolls or slides down a slope, or a capsule that slides down or stays, then a floor and a wall.

The friction of a contact is the product of both (physics.mixing). A ball rolls where it is above tan(slope) / 3, at
2/3 g sin(slope); below, it slides, at g (sin - friction cos). A capsule stays where it is above tan(slope).
"""

import dataclasses
import math

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
    capsules,
    discs,
    option,
    segments,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The slope, and what is on it."""

    shape: str = option("ball", str, "", "of what is on the slope", choices=("ball", "capsule"))
    width: float = option(10.0, float, "m", "of the view, and of slope and floor together", above=0, high=1000)
    height: float = option(6.0, float, "m", "of the view", above=0, high=1000)
    foot: float = option(7.0, float, "m", "from the left side to where the slope meets the floor", above=0, high=1000)
    slope: Distribution = option([0.25, 0.6], float, "rad", "down to the right", low=0.01, high=1.5, draw=True)
    radius: Distribution = option([0.35, 0.6], float, "m", "of the ball or the capsule's ends", low=1e-3, draw=True)
    half_length: Distribution = option(
        [0.3, 0.6], float, "m", "half the distance between the centres of a capsule's ends", low=0, draw=True
    )
    place: Distribution = option(
        [0, 0.25], float, "1", "of the start on the slope; 0: highest possible, 1: lowest", low=0, high=1, draw=True
    )
    density: Distribution = option(1.0, float, "kg/m^2", "of what is on the slope", low=1e-6, high=1e6, draw=True)
    friction: Distribution = option([0.0, 0.4], float, "1", "of what is on the slope", low=0, high=100, draw=True)
    elasticity: Distribution = option([0.0, 0.5], float, "1", "of what is on the slope", low=0, high=1, draw=True)
    ground_friction: Distribution = option(1.0, float, "1", "of slope, floor and wall", low=0, high=100, draw=True)
    ground_elasticity: Distribution = option(1.0, float, "1", "of slope, floor and wall", low=0, high=1, draw=True)
    gravity: tuple[Distribution, ...] = option([0, -9.8], float, "m/s^2", "x right, y up", parts=2, draw=True)
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of what is on the slope", parts=3, draw=True, low=0, high=255
    )
    ground_color: tuple[Distribution, ...] = option(
        [150, 150, 150], int, "sRGB", "of slope, floor and wall", parts=3, draw=True, low=0, high=255
    )


def check(options: Options) -> None:
    """ValueError where the slope may leave the view, or be too short."""
    radius, steepest = options.radius.support[1], options.slope.support[1]
    most = 2 * (radius + (options.half_length.support[1] if options.shape == "capsule" else 0.0))
    if not options.foot < options.width:
        raise ValueError(f"foot is {options.foot:g} m, but must be left of the wall, at {options.width:g} m")
    if not most < options.foot:
        raise ValueError(
            f"radius may be {radius:g} m, but what is up to {most:g} m long must fit a slope with its foot at "
            f"{options.foot:g} m"
        )
    if not options.foot * math.tan(steepest) + 2 * radius < options.height:
        raise ValueError(
            f"slope may be {steepest:g} rad, but with its foot at {options.foot:g} m, and {2 * radius:g} m on top, it "
            f"must fit a view {options.height:g} m high"
        )


def layout(options: Options) -> Layout:
    """What is on the slope; slope, floor and wall."""
    long = options.half_length.support[1] if options.shape == "capsule" else 0.0
    runs = SlotGroup("circle" if options.shape == "ball" else "capsule", 1), SlotGroup("segment", 3, STATIC)
    return Layout(runs, (0.0, 0.0, options.width, options.height), options.radius.support[1] + long)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: a ball or capsule at rest that touches the slope."""
    slope, radius = factors["slope"], factors["radius"]
    half = factors["half_length"] if options.shape == "capsule" else jnp.zeros(())
    length, top = options.foot / jnp.cos(slope), options.foot * jnp.tan(slope)
    nearest = half + radius  # to both ends, along the slope: within the view, and clear of the floor
    along = nearest + factors["place"] * (length - 2 * nearest)
    downhill, normal = jnp.stack([jnp.cos(slope), -jnp.sin(slope)]), jnp.stack([jnp.sin(slope), jnp.cos(slope)])
    start = (jnp.stack([jnp.zeros(()), top]) + along * downhill + radius * normal)[None]
    material = {name: factors[name] for name in ("density", "friction", "elasticity", "color")}
    if options.shape == "ball":
        body = discs(start, radius, angle=-slope, **material)
    else:
        body = capsules(start, -slope, half, radius, **material)
    foot, corner = jnp.asarray([options.foot, 0.0]), jnp.asarray([options.width, 0.0])
    ends = jnp.stack([jnp.stack([jnp.zeros(()), top]), foot, corner, jnp.asarray([options.width, options.height])])
    ground = segments(
        ends[:-1], ends[1:], friction=factors["ground_friction"], elasticity=factors["ground_elasticity"],
        color=factors["ground_color"],
    )  # fmt: skip
    return SampledScene(*assemble(layout(options), [body, ground], factors["gravity"]), derived={"length": length})


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    derived={"length": Field("float32", "n", "m", "of the slope")},
)
