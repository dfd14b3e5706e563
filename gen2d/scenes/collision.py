"""Two balls that meet head-on: the first comes from the left, the second from the right.

With the numbers of configs/phyworld_collision.yaml it is a scene of the study 'How Far is Video Generation from World
Model' (Kang et al., arXiv 2411.02385).

They are to touch within a window of frames. Where the view is too narrow for that, as both are large or fast, the
window is what is feasible, less its first half. Two balls that stand still never touch.
"""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    CLEARANCE,
    Array,
    Distribution,
    Family,
    Field,
    Layout,
    SampledScene,
    SlotGroup,
    assemble,
    discs,
    option,
)

NEVER = -1.0  # the contact frame of balls that do not approach


@dataclasses.dataclass(frozen=True)
class Options:
    """The balls, the view, and when they shall touch."""

    width: float = option(10.0, float, "m", "of the view", above=0, high=1000)
    height: float = option(10.0, float, "m", "of the view", above=0, high=1000)
    radius_1: Distribution = option([0.5, 1.5], float, "m", "of the first ball", low=1e-3, draw=True)
    radius_2: Distribution = option([0.5, 1.5], float, "m", "of the second ball", low=1e-3, draw=True)
    speed_1: Distribution = option([1.0, 4.0], float, "m/s", "of the first ball, to the right", low=0, draw=True)
    speed_2: Distribution = option([1.0, 4.0], float, "m/s", "of the second ball, to the left", low=0, draw=True)
    density: Distribution = option(1.0, float, "kg/m^2", "of each ball", low=1e-6, high=1e6, draw=True, each="balls")
    elasticity: Distribution = option(1.0, float, "1", "of each ball", low=0, high=1, draw=True, each="balls")
    friction: Distribution = option(0.0, float, "1", "of each ball", low=0, high=100, draw=True, each="balls")
    frame: float = option(0.1, float, "s", "between two frames as contact frames count: 1 / video.fps", above=0)
    contact_frames: tuple[float, ...] = option(
        [8.0, 24.0], float, "frames", "first and last at which the balls may touch, where there is room",
        parts=2, above=0,
    )  # fmt: skip
    contact: Distribution = option(
        [0, 1], float, "1", "of the contact between the first time and the last that are possible",
        draw=True, low=0, high=1,
    )  # fmt: skip
    place: tuple[Distribution, ...] = option(
        [[0, 1], [0, 1]], float, "1", "of both balls among those possible; 0, 0 is the lowest and leftmost",
        parts=2, draw=True, low=0, high=1,
    )  # fmt: skip
    margin: float = option(0.5, float, "m", "above and below the larger ball, at least", low=0)
    color: tuple[Distribution, ...] = option(
        [[90, 254]] * 3, int, "sRGB", "of each ball", parts=3, draw=True, low=0, high=255, each="balls"
    )


def check(options: Options) -> None:
    """ValueError where the view may not hold both balls, or the window is no window."""
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
    """There are two balls."""
    return {"balls": 2}


def layout(options: Options) -> Layout:
    """The first ball and the second."""
    reach = max(options.radius_1.support[1], options.radius_2.support[1])
    return Layout((SlotGroup("circle", 2),), (0.0, 0.0, options.width, options.height), reach)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: the balls on one line, as far apart as the time of their contact asks for."""
    radius = jnp.stack([factors["radius_1"], factors["radius_2"]])
    speed = jnp.stack([factors["speed_1"], factors["speed_2"]])
    time, gap = _contact(factors["contact"], speed.sum(), options.width - 2 * radius.sum(), options)
    spare = options.width - 2 * radius.sum() - gap
    first = radius[0] + factors["place"][0] * spare
    nearest = radius.max() + options.margin
    y = nearest + factors["place"][1] * (options.height - 2 * nearest)
    balls = discs(
        jnp.stack([jnp.stack([first, y]), jnp.stack([first + radius.sum() + gap, y])]), radius,
        velocity=jnp.stack([speed, jnp.zeros(2)], 1) * jnp.asarray([[1.0], [-1.0]]),
        **{name: factors[name] for name in ("density", "elasticity", "friction", "color")},
    )  # fmt: skip
    derived = {"contact_frame": jnp.where(speed.sum() > 0, time / options.frame, NEVER)}
    return SampledScene(*assemble(layout(options), [balls], jnp.zeros(2)), derived=derived)


def _contact(share: Array, closing: Array, room: Array, options: Options) -> tuple[Array, Array]:
    """After how many seconds two balls touch, at this share of the window, and how far apart they start, in m.

    `closing` is the speed at which they approach, `room` how far apart they may be.
    """
    first, last = (frame * options.frame for frame in options.contact_frames)
    latest = jnp.minimum(last, room / closing)
    earliest = jnp.where(latest >= first, first, latest / 2)
    time = earliest + share * (latest - earliest)
    return time, jnp.where(closing > 0, closing * time, CLEARANCE + share * (room - CLEARANCE))


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    sizes=sizes,
    derived={
        "contact_frame": Field(
            "float32", "n", "frames", "when the balls touch, from the start, in units of scene.frame; -1: they never do"
        )
    },
)
