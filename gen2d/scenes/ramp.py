"""A ball that rolls or slides down a slope, or a capsule that slides down or stays, then a floor and a wall.

The friction of a contact is the product of both bodies' (physics.mixing). If it is above tan(slope) / 3, a ball rolls
with acceleration 2/3 g sin(slope); otherwise it slides with g (sin(slope) - friction cos(slope)). A capsule stays at
rest if the friction is above tan(slope).
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
    builder,
    common,
    option,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The slope and the body on it."""

    shape: str = option("ball", str, "", "shape of the body on the slope", choices=("ball", "capsule"))
    width: float = common.size("width of the view, and of slope and floor together", 10.0)
    height: float = common.size("height of the view", 6.0)
    foot_distance: float = common.size("distance from the left side to where the slope meets the floor", 7.0)
    slope: Distribution = common.angle("slope, down to the right", [0.25, 0.6], low=0.01, high=1.5)
    radius: Distribution = common.radius("the ball or the capsule's ends", [0.35, 0.6])
    half_length: Distribution = common.length("half the distance between a capsule's ends", [0.3, 0.6])
    relative_position: Distribution = common.fraction("position on the slope; 0: highest, 1: lowest", [0, 0.25])
    density: Distribution = common.density("the body on the slope")
    friction: Distribution = common.friction("the body on the slope", [0.0, 0.4])
    elasticity: Distribution = common.elasticity("the body on the slope", [0.0, 0.5])
    ground_friction: Distribution = common.friction("slope, floor and wall", 1.0)
    ground_elasticity: Distribution = common.elasticity("slope, floor and wall", 1.0)
    gravity: tuple[Distribution, ...] = common.gravity()
    color: tuple[Distribution, ...] = common.color("the body on the slope")
    ground_color: tuple[Distribution, ...] = common.color("slope, floor and wall", [150] * 3)


def check(options: Options) -> None:
    """Raise ValueError if the slope may leave the view, or be too short."""
    radius, steepest = options.radius.support[1], options.slope.support[1]
    most = 2 * (radius + (options.half_length.support[1] if options.shape == "capsule" else 0.0))
    if not options.foot_distance < options.width:
        raise ValueError(
            f"foot_distance is {options.foot_distance:g} m, but must be left of the wall, at {options.width:g} m"
        )
    if not most < options.foot_distance:
        raise ValueError(
            f"radius may be {radius:g} m, but what is up to {most:g} m long must fit a slope with its foot at "
            f"{options.foot_distance:g} m"
        )
    if not options.foot_distance * math.tan(steepest) + 2 * radius < options.height:
        raise ValueError(
            f"slope may be {steepest:g} rad, but with its foot at {options.foot_distance:g} m, and "
            f"{2 * radius:g} m on top, it must fit a view {options.height:g} m high"
        )


def layout(options: Options) -> Layout:
    """The body on the slope; slope, floor and wall."""
    long = options.half_length.support[1] if options.shape == "capsule" else 0.0
    groups = SlotGroup("circle" if options.shape == "ball" else "capsule", 1), SlotGroup("segment", 3, STATIC)
    return Layout(groups, (0.0, 0.0, options.width, options.height), options.radius.support[1] + long)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: a ball or capsule at rest on the slope."""
    slope, radius = factors["slope"], factors["radius"]
    half = factors["half_length"] if options.shape == "capsule" else jnp.zeros(())
    length, top = options.foot_distance / jnp.cos(slope), options.foot_distance * jnp.tan(slope)
    nearest = half + radius  # to both ends, along the slope: within the view, and clear of the floor
    along = nearest + factors["relative_position"] * (length - 2 * nearest)
    downhill, normal = jnp.stack([jnp.cos(slope), -jnp.sin(slope)]), jnp.stack([jnp.sin(slope), jnp.cos(slope)])
    start = (jnp.stack([jnp.zeros(()), top]) + along * downhill + radius * normal)[None]
    if options.shape == "ball":
        body = builder.discs(start, radius, angle=-slope, **builder.material(factors))
    else:
        body = builder.capsules(start, -slope, half, radius, **builder.material(factors))
    foot, corner = jnp.asarray([options.foot_distance, 0.0]), jnp.asarray([options.width, 0.0])
    ends = jnp.stack([jnp.stack([jnp.zeros(()), top]), foot, corner, jnp.asarray([options.width, options.height])])
    ground = builder.segments(ends[:-1], ends[1:], **builder.material(factors, "ground"))
    return SampledScene(
        *builder.assemble(layout(options), [body, ground], factors["gravity"]), derived={"length": length}
    )


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    derived={"length": Field("float32", "n", "m", "length of the slope")},
)
