"""A heavy ball on a chain swings into a tower of blocks."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Distribution,
    Family,
    JointSpec,
    Layout,
    SampledScene,
    SlotGroup,
    assemble,
    boxes,
    capsules_between,
    discs,
    hinge_chain,
    option,
    segments,
)

FAR = 4.0  # the floor's length, over the view's width
PIN, LINK = 0.12, 0.06  # m: radii of the disc that the chain hangs from, and of a link
DEBRIS = 0.8  # of the tower's height: how much is seen beyond the tower


@dataclasses.dataclass(frozen=True)
class Options:
    """How many links, and what is drawn at random."""

    links: int = option(4, int, "links", "of the chain, which pass through all; 1: a rod", low=1, high=64)
    blocks: Distribution = option([3, 5], int, "blocks", "in the tower", low=1, high=32, draw=True)
    width: Distribution = option([1.0, 1.5], float, "m", "of the blocks", low=1e-2, high=100, draw=True)
    height: Distribution = option([0.6, 0.9], float, "m", "of the blocks", low=1e-2, high=100, draw=True)
    density: Distribution = option(1.0, float, "kg/m^2", "of the blocks", low=1e-6, high=1e6, draw=True)
    friction: Distribution = option([0.6, 0.9], float, "1", "of all", low=0, high=100, draw=True)
    elasticity: Distribution = option(0.0, float, "1", "of ball and blocks", low=0, high=1, draw=True)
    radius: Distribution = option([0.4, 0.6], float, "m", "of the ball", low=1e-2, high=100, draw=True)
    ball_density: Distribution = option(
        5.0, float, "kg/m^2", "of the ball and its chain", low=1e-6, high=1e6, draw=True
    )
    chain: Distribution = option([3.0, 4.0], float, "m", "from the pin to the ball's middle", low=0.1, draw=True)
    angle: Distribution = option(
        [0.8, 1.4], float, "rad", "of the chain at the start, from hanging down", low=0, high=1.57, draw=True
    )
    aim: Distribution = option(
        [0.4, 0.8], float, "1", "lowest height of the ball's middle, over that of the tower", low=0, high=1, draw=True
    )
    gap: Distribution = option([0.0, 0.2], float, "m", "between ball and tower where it is lowest", low=0, draw=True)
    gravity: tuple[Distribution, ...] = option([0, -9.8], float, "m/s^2", "x right, y up", parts=2, draw=True)
    ball_color: tuple[Distribution, ...] = option(
        [200, 200, 210], int, "sRGB", "of the ball", parts=3, draw=True, low=0, high=255
    )
    color: tuple[Distribution, ...] = option(
        [[60, 254]] * 3, int, "sRGB", "of each block", parts=3, draw=True, low=0, high=255, each="blocks"
    )


def check(options: Options) -> None:
    """ValueError where the ball might swing through the floor."""
    lowest = options.aim.support[0] * options.blocks.support[0] * options.height.support[0]
    if options.radius.support[1] > lowest:
        raise ValueError(
            f"radius may be {options.radius.support[1]:g} m, but the ball's middle may swing as low as {lowest:g} m "
            "(aim times blocks times height)"
        )


def layout(options: Options) -> Layout:
    """The floor, the pin, the links of the chain, the ball, then the blocks from the lowest up."""
    n, most = options.links, int(options.blocks.support[1])
    width, height, radius, chain = (getattr(options, x).support[1] for x in ("width", "height", "radius", "chain"))
    runs = (
        SlotGroup("segment", 1, STATIC),
        SlotGroup("circle", 1, STATIC, layer=3, collides=False),
        SlotGroup("capsule", n, layer=2, collides=False),
        SlotGroup("circle", 1, layer=3),
        SlotGroup("polygon", most, vertices=4),
    )
    ties = [JointSpec("revolute", 1 + i, 2 + i) for i in range(n)] + [JointSpec("revolute", 2 + n, 1 + n)]
    tower = most * height
    left = -2 * radius - options.gap.support[1] - chain
    top = max(options.aim.support[1] * tower + chain + PIN, tower)
    reach = max(chain / n / 2 + LINK, radius, (width**2 + height**2) ** 0.5 / 2)
    return Layout(runs, (left, 0.0, width + DEBRIS * tower, top), reach, tuple(ties))


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: the tower's left side at 0, the ball at rest on its taut chain."""
    layers, n, most = layout(options), options.links, int(options.blocks.support[1])
    width, height, radius, chain, angle = (factors[x] for x in ("width", "height", "radius", "chain", "angle"))
    surface = {name: factors[name] for name in ("elasticity", "friction")}
    wide = FAR * layers.bounds[2]
    floor = segments([(-wide, 0.0)], [(wide, 0.0)], friction=factors["friction"])
    lowest = factors["aim"] * factors["blocks"] * height
    top = jnp.stack([-radius - factors["gap"], lowest + chain])
    pin = discs(top[None], PIN, kind=STATIC, layer=3, collides=False)
    way = chain * jnp.stack([-jnp.sin(angle), -jnp.cos(angle)])
    corners = top + (jnp.arange(n + 1.0) / n)[:, None] * way
    heavy = factors["ball_density"]
    links = capsules_between(corners[:-1], corners[1:], LINK, density=heavy, layer=2, collides=False)
    ball = discs(corners[-1:], radius, density=heavy, color=factors["ball_color"], layer=3, **surface)
    numbers = jnp.arange(most)
    places = jnp.stack([jnp.full(most, 0.5) * width, (numbers + 0.5) * height], -1)
    blocks = boxes(
        places, 0.0, width, height, numbers < factors["blocks"], density=factors["density"], color=factors["color"],
        **surface,
    )  # fmt: skip
    parts = [floor, pin, links, ball, blocks]
    return SampledScene(*assemble(layers, parts, factors["gravity"], hinge_chain(links, tail=True)))


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check)
