"""Billiards, seen from above: a cue ball hits a triangle of balls, between four cushions.

The scene has no friction of the cloth; `physics.damping`, a rate in 1/s, slows the balls down.
"""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np

from gen2d.plugin import (
    STATIC,
    Array,
    Bodies,
    Distribution,
    Family,
    Layout,
    SampledScene,
    SlotGroup,
    builder,
    common,
    option,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The table, the rack and the stroke."""

    rows: Distribution = common.count("rows", [3, 5], "number of rows of the rack: 1, 3, 6, 10, ... balls", high=21)
    width: float = common.size("width of the table, inside", 10.0)
    height: float = common.size("height of the table, inside", 5.0)
    head_distance: float = option(2.5, float, "m", "largest distance from the left cushion to the cue ball", above=0)
    spot_distance: float = option(
        6.0, float, "m", "distance from the left cushion to the first ball of the rack", above=0
    )
    radius: Distribution = common.radius("the balls", 0.24)
    gap: Distribution = common.length("gap between neighbours in the rack", 0.01, low=1e-3)
    density: Distribution = common.density("the balls")
    speed: Distribution = common.speed("the cue ball", [6.0, 12.0])
    aim_angle: Distribution = common.angle("angle of the stroke from the line to the rack", [-0.08, 0.08])
    relative_position: tuple[Distribution, ...] = common.position("the cue ball")
    elasticity: Distribution = common.elasticity("the balls", 0.97)
    friction: Distribution = common.friction("the balls", 0.05)
    cushion_elasticity: Distribution = common.elasticity("the cushions", 0.85)
    cushion_friction: Distribution = common.friction("the cushions", 0.2)
    cue_color: tuple[Distribution, ...] = common.color("the cue ball", [245, 245, 240])
    color: tuple[Distribution, ...] = common.color(
        "each ball of the rack", [[90, 254], [40, 180], [90, 254]], each="rack"
    )
    cushion_color: tuple[Distribution, ...] = common.color("the cushions", [120, 72, 40])


def check(options: Options) -> None:
    """Raise ValueError if the rack or the cue ball may not fit the table."""
    rows, radius = int(options.rows.support[1]), options.radius.support[1]
    side = (rows - 1) * (2 * radius + options.gap.support[1])
    if not (
        options.spot_distance + side * math.sqrt(0.75) + radius < options.width and side + 2 * radius < options.height
    ):
        raise ValueError(
            f"rows may be {rows}, but with a radius of {radius:g} m they must fit a table of {options.width:g} x "
            f"{options.height:g} m, {options.spot_distance:g} m from its left side"
        )
    if not (radius < options.head_distance and options.head_distance + 2 * radius < options.spot_distance):
        raise ValueError(
            f"head_distance is {options.head_distance:g} m, but the cue ball, with a radius of up to {radius:g} m, "
            f"must start between the left cushion and the rack, at {options.spot_distance:g} m"
        )


def sizes(options: Options) -> dict[str, int]:
    """The number of balls in the largest rack."""
    rows = int(options.rows.support[1])
    return {"rack": rows * (rows + 1) // 2}


def layout(options: Options) -> Layout:
    """The cue ball and the rack's, then floor, right, ceiling and left cushion."""
    groups = SlotGroup("circle", 1 + sizes(options)["rack"]), SlotGroup("segment", 4, STATIC)
    return Layout(groups, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and initial state: the rack at rest, and the cue ball moving towards it."""
    radius, rows = factors["radius"], factors["rows"]
    nearest, farthest = jnp.stack([radius, radius]), jnp.stack([options.head_distance, options.height - radius])
    cue = nearest + factors["relative_position"] * (farthest - nearest)
    spot = jnp.asarray([options.spot_distance, options.height / 2])
    rack = spot + _triangle(int(options.rows.support[1])) * (2 * radius + factors["gap"])
    direction = jnp.arctan2(*(spot - cue)[::-1]) + factors["aim_angle"]
    stroke = factors["speed"] * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
    balls = builder.discs(
        jnp.concatenate([cue[None], rack]),
        radius,
        jnp.arange(1 + len(rack)) <= rows * (rows + 1) // 2,
        velocity=jnp.zeros((1 + len(rack), 2)).at[0].set(stroke),
        **builder.material(factors) | {"color": jnp.concatenate([factors["cue_color"][None], factors["color"]])},
    )
    cushions = builder.box_walls(options.width, options.height, **builder.material(factors, "cushion"))
    return SampledScene(*builder.assemble(layout(options), [balls, cushions], jnp.zeros(2)))


def _triangle(rows: int) -> np.ndarray:
    """Points [rows (rows + 1) / 2, 2] of a triangle, a unit apart, row by row from the origin to the right."""
    return np.array([[math.sqrt(0.75) * row, k - row / 2] for row in range(rows) for k in range(row + 1)], np.float32)


FAMILY = Family(
    options=Options,
    layout=layout,
    sample=sample,
    check=check,
    sizes=sizes,
    bodies={"balls": Bodies("circle", ("radius",), speed=("speed",))},
)
