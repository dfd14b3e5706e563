"""Billiards, seen from above: a cue ball hits a triangle of balls, between four cushions.

What the cloth takes away is `physics.damping`, a rate in 1/s; nothing in the scene does.
"""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np

from gen2d.plugin import (
    STATIC,
    Array,
    Distribution,
    Family,
    Layout,
    SampledScene,
    SlotGroup,
    assemble,
    box_walls,
    discs,
    option,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """The table, the rack and the stroke."""

    rows: Distribution = option([3, 5], int, "rows", "of the rack: 1, 3, 6, 10, ... balls", low=1, high=21, draw=True)
    width: float = option(10.0, float, "m", "of the table, inside", above=0, high=1000)
    height: float = option(5.0, float, "m", "of the table, inside", above=0, high=1000)
    head: float = option(2.5, float, "m", "from the left cushion to where the cue ball starts, at most", above=0)
    spot: float = option(6.0, float, "m", "from the left cushion to the first ball of the rack", above=0)
    radius: Distribution = option(0.24, float, "m", "of the balls", low=1e-3, draw=True)
    gap: Distribution = option(0.01, float, "m", "between neighbours in the rack", low=1e-3, draw=True)
    density: Distribution = option(1.0, float, "kg/m^2", "of the balls", low=1e-6, high=1e6, draw=True)
    speed: Distribution = option([6.0, 12.0], float, "m/s", "of the cue ball", low=0, draw=True)
    aim: Distribution = option(
        [-0.08, 0.08], float, "rad", "off the way to the first ball of the rack, counter-clockwise", draw=True
    )
    place: tuple[Distribution, ...] = option(
        [[0, 1], [0, 1]], float, "1", "of the cue ball among those possible; 0, 0 is the lowest and leftmost",
        parts=2, draw=True, low=0, high=1,
    )  # fmt: skip
    elasticity: Distribution = option(0.97, float, "1", "of the balls", low=0, high=1, draw=True)
    friction: Distribution = option(0.05, float, "1", "of the balls", low=0, high=100, draw=True)
    cushion_elasticity: Distribution = option(0.85, float, "1", "of the cushions", low=0, high=1, draw=True)
    cushion_friction: Distribution = option(0.2, float, "1", "of the cushions", low=0, high=100, draw=True)
    cue_color: tuple[Distribution, ...] = option(
        [245, 245, 240], int, "sRGB", "of the cue ball", parts=3, draw=True, low=0, high=255
    )
    color: tuple[Distribution, ...] = option(
        [[90, 254], [40, 180], [90, 254]], int, "sRGB", "of each ball of the rack",
        parts=3, draw=True, low=0, high=255, each="rack",
    )  # fmt: skip
    cushion_color: tuple[Distribution, ...] = option(
        [120, 72, 40], int, "sRGB", "of the cushions", parts=3, draw=True, low=0, high=255
    )


def check(options: Options) -> None:
    """ValueError where the rack or the cue ball may not fit the table."""
    rows, radius = int(options.rows.support[1]), options.radius.support[1]
    side = (rows - 1) * (2 * radius + options.gap.support[1])
    if not (options.spot + side * math.sqrt(0.75) + radius < options.width and side + 2 * radius < options.height):
        raise ValueError(
            f"rows may be {rows}, but with a radius of {radius:g} m they must fit a table of {options.width:g} x "
            f"{options.height:g} m, {options.spot:g} m from its left side"
        )
    if not (radius < options.head and options.head + 2 * radius < options.spot):
        raise ValueError(
            f"head is {options.head:g} m, but the cue ball, with a radius of up to {radius:g} m, must start between "
            f"the left cushion and the rack, at {options.spot:g} m"
        )


def sizes(options: Options) -> dict[str, int]:
    """The balls of the largest rack."""
    rows = int(options.rows.support[1])
    return {"rack": rows * (rows + 1) // 2}


def layout(options: Options) -> Layout:
    """The cue ball and the rack's, then floor, right, ceiling and left cushion."""
    runs = SlotGroup("circle", 1 + sizes(options)["rack"]), SlotGroup("segment", 4, STATIC)
    return Layout(runs, (0.0, 0.0, options.width, options.height), options.radius.support[1])


def sample(key: Array, factors: dict[str, Array], options: Options) -> SampledScene:
    """One video's scene and start: the rack at its spot, and the cue ball on its way there."""
    radius, rows = factors["radius"], factors["rows"]
    nearest, farthest = jnp.stack([radius, radius]), jnp.stack([options.head, options.height - radius])
    cue = nearest + factors["place"] * (farthest - nearest)
    spot = jnp.asarray([options.spot, options.height / 2])
    rack = spot + _triangle(int(options.rows.support[1])) * (2 * radius + factors["gap"])
    way = jnp.arctan2(*(spot - cue)[::-1]) + factors["aim"]
    stroke = factors["speed"] * jnp.stack([jnp.cos(way), jnp.sin(way)])
    balls = discs(
        jnp.concatenate([cue[None], rack]),
        radius,
        jnp.arange(1 + len(rack)) <= rows * (rows + 1) // 2,
        velocity=jnp.zeros((1 + len(rack), 2)).at[0].set(stroke),
        color=jnp.concatenate([factors["cue_color"][None], factors["color"]]),
        **{name: factors[name] for name in ("density", "elasticity", "friction")},
    )
    cushions = box_walls(
        options.width, options.height, elasticity=factors["cushion_elasticity"], friction=factors["cushion_friction"],
        color=factors["cushion_color"],
    )  # fmt: skip
    return SampledScene(*assemble(layout(options), [balls, cushions], jnp.zeros(2)))


def _triangle(rows: int) -> np.ndarray:
    """Places [rows (rows + 1) / 2, 2] a unit apart, row by row from the one at the origin to the right."""
    return np.array([[math.sqrt(0.75) * row, k - row / 2] for row in range(rows) for k in range(row + 1)], np.float32)


FAMILY = Family(options=Options, layout=layout, sample=sample, check=check, sizes=sizes)
