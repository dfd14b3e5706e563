"""Blocks stacked one on another, each a little aside: some towers stand, some fall."""

import dataclasses

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
    boxes,
    option,
    segments,
)

FAR = 4.0  # the floor's length, over the view's width
AROUND = 0.75  # of the tower's height: how much is seen on either side, for what falls


@dataclasses.dataclass(frozen=True)
class Options:
    """What is drawn at random."""

    blocks: Distribution = option([3, 6], int, "blocks", "in a tower", low=1, high=32, draw=True)
    width: Distribution = option([1.2, 2.0], float, "m", "of each block", low=1e-2, high=100, draw=True, each="blocks")
    height: Distribution = option([0.6, 1.0], float, "m", "of each block", low=1e-2, high=100, draw=True, each="blocks")
    offset: Distribution = option(
        [-0.7, 0.7], float, "1", "of each block from the middle of the one below, over half of that one's width",
        low=-1, high=1, draw=True, each="blocks",
    )  # fmt: skip
    density: Distribution = option(
        {"log_uniform": [0.5, 2.0]}, float, "kg/m^2", "of each block", low=1e-6, high=1e6, draw=True, each="blocks"
    )
    elasticity: Distribution = option(0.0, float, "1", "of each block", low=0, high=1, draw=True, each="blocks")
    friction: Distribution = option([0.7, 0.9], float, "1", "of each block", low=0, high=100, draw=True, each="blocks")
    floor_friction: Distribution = option(0.8, float, "1", "of the floor", low=0, high=100, draw=True)
    gravity: tuple[Distribution, ...] = option([0, -9.8], float, "m/s^2", "x right, y up", parts=2, draw=True)
    color: tuple[Distribution, ...] = option(
        [[60, 254]] * 3, int, "sRGB", "of each block", parts=3, draw=True, low=0, high=255, each="blocks"
    )


def layout(options: Options) -> Layout:
    """The floor, then the blocks from the lowest up."""
    most, width, height = int(options.blocks.support[1]), options.width.support[1], options.height.support[1]
    aside = max(map(abs, options.offset.support))
    half = max(AROUND * most * height, width / 2 * (1 + aside * (most - 1) / 2)) + width / 2
    runs = SlotGroup("segment", 1, STATIC), SlotGroup("polygon", most, vertices=4)
    return Layout(runs, (-half, 0.0, half, most * height), (width**2 + height**2) ** 0.5 / 2)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: the tower at rest in the middle of the view."""
    width, height = factors["width"], factors["height"]
    present = jnp.arange(len(width)) < factors["blocks"]
    steps = jnp.concatenate([jnp.zeros(1), factors["offset"][1:] * width[:-1] / 2])
    x, y = jnp.cumsum(steps), jnp.cumsum(height) - height / 2
    left, right = (jnp.where(present, x + s * width / 2, s * -jnp.inf) for s in (-1, 1))
    x = x - (left.min() + right.max()) / 2
    layers = layout(options)
    reach = FAR * layers.bounds[2]
    floor = segments([(-reach, 0.0)], [(reach, 0.0)], friction=factors["floor_friction"])
    material = {name: factors[name] for name in ("density", "elasticity", "friction", "color")}
    blocks = boxes(jnp.stack([x, y], -1), 0.0, width, height, present, **material)
    margin = _margin(x, width, blocks.objects["mass"], present)
    derived = {"stable": (margin > 0).astype(jnp.float32), "margin": margin}
    return SampledScene(*assemble(layers, [floor, blocks], factors["gravity"]), derived=derived)


def _margin(x: Array, width: Array, mass: Array, present: Array) -> Array:
    """The least distance in m of the centre of mass of all above a joint from the edges of what carries it.

    A stack in which each block lies on one other stands if, and only if, it is above 0 at every joint (the floor's
    too), as long as gravity is upright.
    """
    above = jnp.cumsum(mass[::-1])[::-1]
    centre = jnp.cumsum((mass * x)[::-1])[::-1] / jnp.where(above > 0, above, 1.0)
    left, right = x - width / 2, x + width / 2
    left, right = (
        jnp.concatenate([end[:1], choose(end[1:], end[:-1])])
        for end, choose in ((left, jnp.maximum), (right, jnp.minimum))
    )
    return jnp.where(present, jnp.minimum(centre - left, right - centre), jnp.inf).min()


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    derived={
        "stable": Field("float32", "n", "1", "1 where statics says that the tower stands, else 0"),
        "margin": Field(
            "float32",
            "n",
            "m",
            "from the centre of mass above a joint to its edge, at the joint where that is least; below 0: beyond it",
        ),
    },
)
