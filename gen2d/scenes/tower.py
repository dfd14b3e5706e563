"""A tower of blocks, each offset from the one below: some towers stand, some fall."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import (
    STATIC,
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

AROUND = 0.75  # margin of the view on either side, over the tower's height, for falling blocks


@dataclasses.dataclass(frozen=True)
class Options:
    """The blocks of the tower."""

    blocks: Distribution = common.count("blocks", [3, 6], "number of blocks in the tower", high=32)
    width: Distribution = common.length("width of each block", [1.2, 2.0], each="blocks", low=1e-2, high=100)
    height: Distribution = common.length("height of each block", [0.6, 1.0], each="blocks", low=1e-2, high=100)
    offset: Distribution = option(
        [-0.7, 0.7], float, "1", "offset of each block from the one below, over half of the latter's width",
        low=-1, high=1, draw=True, each="blocks",
    )  # fmt: skip
    density: Distribution = common.density("each block", {"log_uniform": [0.5, 2.0]}, each="blocks")
    elasticity: Distribution = common.elasticity("each block", 0.0, each="blocks")
    friction: Distribution = common.friction("each block", [0.7, 0.9], each="blocks")
    floor_friction: Distribution = common.friction("the floor", 0.8)
    gravity: tuple[Distribution, ...] = common.gravity()
    color: tuple[Distribution, ...] = common.color("each block", [[60, 254]] * 3, each="blocks")


def layout(options: Options) -> Layout:
    """The floor, then the blocks from the lowest up."""
    most, width, height = int(options.blocks.support[1]), options.width.support[1], options.height.support[1]
    aside = maximum(*map(abs, options.offset.support))
    half = maximum(AROUND * most * height, width / 2 * (1 + aside * (most - 1) / 2)) + width / 2
    groups = SlotGroup("segment", 1, STATIC), SlotGroup("polygon", most, vertices=4)
    return Layout(groups, (-half, 0.0, half, most * height), (width**2 + height**2) ** 0.5 / 2)


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: the tower at rest in the middle of the view."""
    width, height = factors["width"], factors["height"]
    present = jnp.arange(len(width)) < factors["blocks"]
    steps = jnp.concatenate([jnp.zeros(1), factors["offset"][1:] * width[:-1] / 2])
    x, y = jnp.cumsum(steps), jnp.cumsum(height) - height / 2
    left, right = (jnp.where(present, x + s * width / 2, s * -jnp.inf) for s in (-1, 1))
    x = x - (left.min() + right.max()) / 2
    scene_layout = layout(options)
    ground = builder.floor(scene_layout, **builder.material(factors, "floor"))
    blocks = builder.boxes(jnp.stack([x, y], -1), 0.0, width, height, present, **builder.material(factors))
    margin = _margin(x, width, blocks.objects["mass"], present)
    derived = {"stable": (margin > 0).astype(jnp.float32), "margin": margin}
    return SampledScene(*builder.assemble(scene_layout, [ground, blocks], factors["gravity"]), derived=derived)


def _margin(x: Array, width: Array, mass: Array, present: Array) -> Array:
    """Smallest distance in m, over all joints, of the centre of mass above the joint from the edge of its support.

    The contact with the floor counts as a joint. Under vertical gravity, a stack in which each block lies on one other
    stands if and only if the margin is positive.
    """
    above = jnp.cumsum(mass[::-1])[::-1]
    centre = jnp.cumsum((mass * x)[::-1])[::-1] / jnp.where(above > 0, above, 1.0)
    left, right = x - width / 2, x + width / 2
    left = jnp.concatenate([left[:1], jnp.maximum(left[1:], left[:-1])])
    right = jnp.concatenate([right[:1], jnp.minimum(right[1:], right[:-1])])
    return jnp.where(present, jnp.minimum(centre - left, right - centre), jnp.inf).min()


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    bodies={"blocks": Bodies("box", ("width", "height"), bears=("blocks",))},
    derived={
        "stable": Field("float32", "n", "1", "static stability of the tower; 1: stable, 0: unstable"),
        "margin": Field(
            "float32",
            "n",
            "m",
            "smallest distance, over all joints, from a joint's edge to the centre of mass above it; negative: beyond",
        ),
    },
)
