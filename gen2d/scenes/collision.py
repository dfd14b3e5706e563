"""Two balls that meet head-on: the first comes from the left, the second from the right.

With the values of configs/phyworld_collision.yaml it is a scene of the study 'How Far is Video Generation from World
Model' (Kang et al., arXiv 2411.02385).

They touch within a window of frames. If the view is too narrow for that, because both are large or fast, the time of
contact lies in the second half of the possible interval. Two balls at rest never touch.
"""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    CLEARANCE,
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
    maximum,
    option,
)

NEVER = -1.0  # the contact frame of balls that do not approach


@dataclasses.dataclass(frozen=True)
class Options:
    """The balls, the view and the time of contact."""

    width: float = common.size("width of the view", 10.0)
    height: float = common.size("height of the view", 10.0)
    radius_1: Distribution = common.radius("the first ball", [0.5, 1.5])
    radius_2: Distribution = common.radius("the second ball", [0.5, 1.5])
    speed_1: Distribution = common.speed("the first ball, to the right", [1.0, 4.0])
    speed_2: Distribution = common.speed("the second ball, to the left", [1.0, 4.0])
    density: Distribution = common.density("each ball", each="balls")
    elasticity: Distribution = common.elasticity("each ball", 1.0, each="balls")
    friction: Distribution = common.friction("each ball", 0.0, each="balls")
    frame_interval: float = option(0.1, float, "s", "time between frames in contact_frames: 1 / video.fps", above=0)
    contact_frames: tuple[float, ...] = option(
        [8.0, 24.0], float, "frames", "first and last frame at which the balls may touch, where there is room",
        parts=2, above=0,
    )  # fmt: skip
    contact_fraction: Distribution = common.fraction("time of the contact, from the first that is possible to the last")
    relative_position: tuple[Distribution, ...] = common.position("both balls")
    margin: float = option(0.5, float, "m", "smallest distance of the larger ball from the top and bottom", low=0)
    color: tuple[Distribution, ...] = common.color("each ball", each="balls")


def check(options: Options) -> None:
    """Raise ValueError if the view may not hold both balls, or the first contact frame is after the last."""
    largest = options.radius_1.support[1], options.radius_2.support[1]
    if not 2 * sum(largest) + 2 * CLEARANCE < options.width:
        raise ValueError(
            f"radius_1 may be {largest[0]:g} m, but beside a second ball of {largest[1]:g} m it must fit a view "
            f"{options.width:g} m wide"
        )
    if not 2 * (max(largest) + options.margin) < options.height:
        raise ValueError(
            f"margin is {options.margin:g} m, but with a ball of {max(largest):g} m it must fit a view "
            f"{options.height:g} m high"
        )
    if options.contact_frames[0] > options.contact_frames[1]:
        raise ValueError(f"contact_frames is {list(options.contact_frames)}, but must have the first frame first")


def sizes(options: Options) -> dict[str, int]:
    """The number of balls, two."""
    return {"balls": 2}


def layout(options: Options) -> Layout:
    """The first ball and the second."""
    reach = maximum(options.radius_1.support[1], options.radius_2.support[1])
    return Layout((SlotGroup("circle", 2),), (0.0, 0.0, options.width, options.height), reach)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: balls on one line, with a gap that follows from the time of contact."""
    radius = jnp.stack([factors["radius_1"], factors["radius_2"]])
    speed = jnp.stack([factors["speed_1"], factors["speed_2"]])
    time, gap = _contact(factors["contact_fraction"], speed.sum(), options.width - 2 * radius.sum(), options)
    spare = options.width - 2 * radius.sum() - gap
    first = radius[0] + factors["relative_position"][0] * spare
    nearest = radius.max() + options.margin
    y = nearest + factors["relative_position"][1] * (options.height - 2 * nearest)
    balls = builder.discs(
        jnp.stack([jnp.stack([first, y]), jnp.stack([first + radius.sum() + gap, y])]), radius,
        velocity=jnp.stack([speed, jnp.zeros(2)], 1) * jnp.asarray([[1.0], [-1.0]]),
        **builder.material(factors),
    )  # fmt: skip
    derived = {"contact_frame": jnp.where(speed.sum() > 0, time / options.frame_interval, NEVER)}
    return SampledScene(*builder.assemble(layout(options), [balls], jnp.zeros(2)), derived=derived)


def _contact(share: Array, closing: Array, room: Array, options: Options) -> tuple[Array, Array]:
    """Time in s until two balls touch, at this fraction of the window, and the gap in m between them at the start.

    `closing` is the speed in m/s at which they approach, `room` the largest possible gap in m.
    """
    first, last = (frame * options.frame_interval for frame in options.contact_frames)
    latest = jnp.minimum(last, room / closing)
    earliest = jnp.where(latest >= first, first, latest / 2)
    time = earliest + share * (latest - earliest)
    return time, jnp.where(closing > 0, closing * time, CLEARANCE + share * (room - CLEARANCE))


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    bodies={
        "the first ball": Bodies("circle", ("radius_1",), speed=("speed_1",)),
        "the second ball": Bodies("circle", ("radius_2",), speed=("speed_2",)),
    },
    sizes=sizes,
    derived={
        "contact_frame": Field(
            "float32", "n", "frames", "time of the contact of the balls, in units of scene.frame_interval; -1: never"
        )
    },
)
