"""A heavy ball on a chain swings into a tower of blocks."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
    Array,
    Bodies,
    Distribution,
    Family,
    JointSpec,
    Layout,
    SampledScene,
    SlotGroup,
    builder,
    common,
    maximum,
    option,
)

PIN, LINK = 0.12, 0.06  # m: radii of the disc that the chain hangs from, and of a link
DEBRIS = 0.8  # margin of the view beyond the tower, over its height


@dataclasses.dataclass(frozen=True)
class Options:
    """The ball, its chain and the tower."""

    links: int = option(4, int, "links", "number of links in the chain; 1: a rod", low=1, high=64)
    blocks: Distribution = common.count("blocks", [3, 5], "number of blocks in the tower", high=32)
    width: Distribution = common.length("width of the blocks", [1.0, 1.5], low=1e-2, high=100)
    height: Distribution = common.length("height of the blocks", [0.6, 0.9], low=1e-2, high=100)
    density: Distribution = common.density("the blocks")
    friction: Distribution = common.friction("all", [0.6, 0.9])
    elasticity: Distribution = common.elasticity("ball and blocks", 0.0)
    radius: Distribution = common.radius("the ball", [0.4, 0.6], low=1e-2, high=100)
    ball_density: Distribution = common.density("the ball and its chain", 5.0)
    chain_length: Distribution = common.length("distance from the pin to the ball's centre", [3.0, 4.0], low=0.1)
    link_radius: float | None = option(
        None, float, "m", f"radius of a link of the chain; null: {LINK}", above=0, high=10, optional=True, later=True
    )
    angle: Distribution = common.angle("angle of the chain, from hanging down", [0.8, 1.4], low=0, high=1.57)
    ball_height: Distribution = common.fraction("lowest height of the ball's centre, over the tower's", [0.4, 0.8])
    gap: Distribution = common.length("gap between the tower and the ball when lowest", [0.0, 0.2])
    gravity: tuple[Distribution, ...] = common.gravity()
    ball_color: tuple[Distribution, ...] = common.color("the ball", [200, 200, 210])
    color: tuple[Distribution, ...] = common.color("each block", [[60, 254]] * 3, each="blocks")


def check(options: Options) -> None:
    """Raise ValueError if the ball might swing through the floor."""
    lowest = options.ball_height.support[0] * options.blocks.support[0] * options.height.support[0]
    if options.radius.support[1] > lowest:
        raise ValueError(
            f"radius may be {options.radius.support[1]:g} m, but the ball's middle may swing as low as {lowest:g} m "
            "(ball_height times blocks times height)"
        )


def layout(options: Options) -> Layout:
    """The floor, the pin, the links of the chain, the ball, then the blocks from the lowest up."""
    n, most = options.links, int(options.blocks.support[1])
    width, height, radius, chain = (
        getattr(options, x).support[1] for x in ("width", "height", "radius", "chain_length")
    )
    groups = (
        SlotGroup("segment", 1, STATIC),
        SlotGroup("circle", 1, STATIC, layer=3, collides=False),
        SlotGroup("capsule", n, layer=2, collides=False),
        SlotGroup("circle", 1, layer=3),
        SlotGroup("polygon", most, vertices=4),
    )
    ends = [(1 + i, 2 + i) for i in range(n)] + [(2 + n, 1 + n)]
    joints = [JointSpec("revolute", *of, limited=False) for of in ends]
    tower = most * height
    left = -2 * radius - options.gap.support[1] - chain
    top = maximum(options.ball_height.support[1] * tower + chain + PIN, tower)
    reach = maximum(chain / n / 2 + (options.link_radius or LINK), radius, (width**2 + height**2) ** 0.5 / 2)
    return Layout(groups, (left, 0.0, width + DEBRIS * tower, top), reach, tuple(joints))


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: the tower's left side at x = 0, and the ball at rest on its taut chain."""
    scene_layout, n, most = layout(options), options.links, int(options.blocks.support[1])
    width, height, radius, chain, angle = (factors[x] for x in ("width", "height", "radius", "chain_length", "angle"))
    ground = builder.floor(scene_layout, friction=factors["friction"])
    lowest = factors["ball_height"] * factors["blocks"] * height
    top = jnp.stack([-radius - factors["gap"], lowest + chain])
    pin = builder.discs(top[None], PIN, kind=STATIC, layer=3, collides=False)
    chain_vector = chain * jnp.stack([-jnp.sin(angle), -jnp.cos(angle)])
    corners = top + (jnp.arange(n + 1.0) / n)[:, None] * chain_vector
    links = builder.capsules_between(
        corners[:-1], corners[1:], options.link_radius or LINK, density=factors["ball_density"], layer=2, collides=False
    )
    ball = builder.discs(corners[-1:], radius, layer=3, **builder.material(factors) | builder.material(factors, "ball"))
    numbers = jnp.arange(most)
    positions = jnp.stack([jnp.full(most, 0.5) * width, (numbers + 0.5) * height], -1)
    blocks = builder.boxes(positions, 0.0, width, height, numbers < factors["blocks"], **builder.material(factors))
    parts, joints = [ground, pin, links, ball, blocks], builder.hinge_chain(links, tail=True)
    return SampledScene(*builder.assemble(scene_layout, parts, factors["gravity"], joints))


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    bodies={
        "blocks": Bodies("box", ("width", "height"), bears=("blocks",)),
        "ball": Bodies("circle", ("radius",), "ball_density"),
    },
)
